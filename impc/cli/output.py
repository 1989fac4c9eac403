"""What the commands print alike."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

import click

from impc.errors import one_line

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def print_files(out: Path, written: Sequence[Path]) -> None:
    """Name the files `written` to the folder `out`, one line for each name with its endings."""
    kinds: dict[str, list[str]] = {}
    for path in written:
        kinds.setdefault(path.stem, []).append(path.suffix)
    click.echo(f"\nWritten to {one_line(out)}:")
    for stem, suffixes in kinds.items():
        click.echo(f"  {stem}{' '.join(suffixes)}")


def print_next(command: str, out: Path, *names: str) -> None:
    """Say in one line what to type next: `command` with files of the folder `out`."""
    folder = shlex.quote(one_line(out))
    click.echo(f"next: {command.format(*(f'{folder}/{name}' for name in names))}")
