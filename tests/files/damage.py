"""What a damaged recording is, and how one is registered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from impc.files.formats import write_table
from impc.files.table import make_table
from tests.files.samples import pushed_seat

__all__ = ["OWN_RATE", "Damage", "Made", "register", "written", "written_by_impc"]

#: Path of the file and text of the configuration.
Made = tuple[Path, str]
#: TDMS and C3D tell their rate: the clock is taken out of the configuration.
OWN_RATE = ('time = "time"', "")


@dataclass(frozen=True)
class Damage:
    """How to make a damaged recording, and what must be said of it.

    `in_file` says that the fault shows without a configuration.
    """

    make: Callable[[Path], Made]
    phrase: str
    in_file: bool


def register(
    damages: dict[str, Damage], phrase: str, in_file: bool
) -> Callable[[Callable[[Path], Made]], None]:
    """A decorator that puts a function of a folder among the damages, by its name."""

    def put(make: Callable[[Path], Made]) -> None:
        name = make.__name__.strip("_").replace("_", " ")
        assert name not in damages
        damages[name] = Damage(make, phrase, in_file)

    return put


def written(folder: Path, content: bytes | str, name: str = "trial.csv") -> Path:
    """A file with this content."""
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def written_by_impc(folder: Path, name: str) -> Path:
    """The pushed seat at 100 samples per second, without its clock."""
    columns = pushed_seat()
    columns.pop("time")
    write_table(folder / name, make_table(name, columns, {"seat": "deg", "trunk": "deg"}, 100.0))
    return folder / name
