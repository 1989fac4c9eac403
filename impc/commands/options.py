"""Options that several commands have alike."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from impc.commands.numbers import LARGEST_SEED

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

__all__ = ["out_option", "scheduler_options", "seed_option", "yes_option"]

F = TypeVar("F", bound="Callable[..., Any]")

#: --seed of everything that is simulated.
seed_option = click.option(
    "--seed",
    type=click.IntRange(0, LARGEST_SEED),
    default=0,
    help="All numbers drawn follow from it.",
)

#: --yes of what may take hours, see `impc.commands.consent`.
yes_option = click.option(
    "--yes", is_flag=True, help="Do not ask before what takes hours or much memory."
)


def out_option(folder: str, holds: str) -> Callable[[F], F]:
    """--out: a `folder` inside results/ by default; its help says what it `holds`."""
    return click.option(
        "--out",
        type=click.Path(path_type=Path),
        default=Path("results", folder),
        help=f"Folder for {holds}.",
    )


def scheduler_options(command: F) -> F:
    """Add --scheduler and --workers to a `command`."""
    address = click.option(
        "--scheduler", help="Address of a running Dask scheduler, such as tcp://host:8786."
    )
    local = click.option(
        "--workers",
        type=click.IntRange(1, 1024),
        help="Workers on this machine; one a core by default.",
    )
    return address(local(command))
