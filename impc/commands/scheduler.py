"""Options of commands whose work goes to workers."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import click

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

__all__ = ["scheduler_options"]

F = TypeVar("F", bound="Callable[..., Any]")


def scheduler_options(command: F) -> F:
    """Add --scheduler and --workers to a `command`."""
    address = click.option(
        "--scheduler", help="Address of a running Dask scheduler, such as tcp://host:8786."
    )
    local = click.option(
        "--workers",
        type=click.IntRange(min=1),
        help="Workers on this machine; one a core by default.",
    )
    return address(local(command))
