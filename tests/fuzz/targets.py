"""What is mutated, and who reads it: each target writes one case and returns why it was refused."""

from __future__ import annotations

import io
import json
import random
from collections.abc import Callable
from operator import methodcaller
from pathlib import Path
from typing import Any

import control
import numpy as np

from impc.errors import ImpcError
from impc.files.configuration import read_configuration
from impc.files.draft import draft, summary
from impc.files.formats import FORMATS, read_table, write_table
from impc.files.plant_sources import make_plant, plant_source
from impc.files.reading import recording_of
from impc.files.table import make_table
from impc.model.plant import Plant
from tests.files.samples import csv_text, hdf5_mat, ods_file, pushed_seat, save_mat
from tests.files.test_blocks import SHAPES
from tests.fuzz.mutation import EDGES, mutated_bytes, mutated_text

__all__ = ["TARGETS", "Fuzzer"]

_TEXT = """[recording]
time = "time"
time_unit = "s"
subject = "S01"
visit = "1"
fill_gaps = 0.05
start = 0.1
stop = 0.5
pattern = '(?P<trial>[a-z_0-9]+)'

[signals.seat]
column = "seat"
unit = "deg"
limit = 12.0
offset = 0.5
sign = -1

[signals.push]
column = "push"
unit = "N*m"

[plant]
mass = 60.0

[fit]
N = 20
"""
_PIECES = (
    "1e308", "-1", "nan", "-inf", "5e-324", "1" * 5000, "9" * 400, "[", "]", "{}", "''", '""',
    "[[a]]", "= =", "\0", "true", "1979-05-27", "0xffffffffffffffffffff", "a.b.c = 1", "[signals]",
    "[signals.x]", '[signals."x\\ny"]', '"a\\nb" = 1', '"\\ud800"', "\ud800", "'(?P<trial>'",
    "'(?P<trial>a{9999999999})'", "'(?P<trial>[[a]&&b])'", "'(?P<trial>(?P<visit>a))'", '"m/0"',
    '"deg**9"', '"s^-9"', '"degC"', '"' + "m" * 39 + '"', "x = " + "[" * 4000, "'''", "#",
)  # fmt: skip


class Fuzzer:
    """One folder, one generator, sound files to begin with."""

    def __init__(self, folder: Path, rng: random.Random) -> None:
        self.folder = folder
        self.rng = rng
        system = control.ss(
            [[0.9, 0.1], [0, 0.8]], [[0, 0], [1, 1]], [[1, 0]], 0, 0.01,
            inputs=["command", "push"], outputs=["seat"],
        )  # fmt: skip
        self.plant = Plant(system, ["command"])
        self.sound = _sound_files(folder)
        self.config = folder / "sound.toml"
        self.config.write_text(_TEXT)
        self.plants = _sound_plants(folder)

    def file(self, suffix: str) -> tuple[Path, Callable[[], Any]]:
        """A mutated recording of a format, and its reading."""
        path = self.folder / f"case{suffix}"
        path.write_bytes(mutated_bytes(self.rng, self.rng.choice(self.sound[suffix])))

        def read() -> None:
            table = read_table(path)
            summary(table)
            draft(table).toml()
            recording_of(table, read_configuration(self.config), self.plant)

        return path, read

    def configuration(self) -> tuple[Path, Callable[[], Any]]:
        """A mutated configuration, and its reading."""
        path = self.folder / "case.toml"
        path.write_bytes(mutated_text(self.rng, _TEXT, _PIECES))

        def read() -> None:
            table = make_table("trial.csv", pushed_seat(60), {"push": "N*m"})
            recording_of(table, read_configuration(path), self.plant)

        return path, read

    def saved_plant(self) -> tuple[Path, Callable[[], Any]]:
        """A mutated file of a plant, or one of odd numbers, sizes and names; and its reading."""
        suffix = self.rng.choice((".json", ".npz", ".mat"))
        path = self.folder / f"plant{suffix}"
        if self.rng.random() < 0.5:
            path.write_bytes(mutated_bytes(self.rng, self.plants[suffix]))
        else:
            path = self.folder / "plant.json"
            path.write_text(json.dumps(_odd_plant(self.rng)))
        return path, lambda: make_plant(plant_source(str(path), {}), ())

    def reason(self, read: Callable[[], Any]) -> str:
        """Why a case is refused; empty when it is read."""
        try:
            read()
        except ImpcError as error:
            message = str(error).replace(str(self.folder), "")
            assert message.isprintable(), message
            assert len(message) < 500, message
            return message
        return ""


#: Who makes a case, by what it is.
TARGETS: dict[str, Callable[[Fuzzer], tuple[Path, Callable[[], Any]]]] = {
    **{suffix: methodcaller("file", suffix) for suffix in FORMATS},
    "configuration": Fuzzer.configuration,
    "plant": Fuzzer.saved_plant,
}


def _sound_files(folder: Path) -> dict[str, list[bytes]]:
    """By ending; .mat in versions 5, 7 and 7.3, with cells, text and structs."""
    columns = pushed_seat(60)
    table = make_table("sound", columns, {"seat": "deg", "push": "N*m"}, 100.0)
    found: dict[str, list[bytes]] = {}
    for suffix in (".csv", ".tsv", ".txt", ".xlsx", ".tdms", ".c3d"):
        path = folder / f"sound{suffix}"
        write_table(path, table)
        found[suffix] = [path.read_bytes()]
    found[".csv"].append(csv_text(columns, ";", ",").encode())
    ods_file(folder / "sound.ods", {"a": [list(columns), *zip(*columns.values(), strict=True)]})
    found[".ods"] = [(folder / "sound.ods").read_bytes()]
    for suffix, lines in SHAPES.values():
        text = "\n".join(lines).replace("tilt", "seat").replace("tap", "push")
        found.setdefault(suffix, []).append(text.encode())
    path = folder / "sound.mat"
    more = {"c": np.array(["x", 1.0], dtype=object), "t": "text", "s": {"a": np.arange(60)}}
    found[".mat"] = []
    for packed in (False, True):
        save_mat(path, {**columns, **more}, do_compression=packed)
        found[".mat"].append(path.read_bytes())
    hdf5_mat(path, {**columns, "s/a": np.arange(60.0)})
    found[".mat"] += [path.read_bytes()] * 2
    hdf5_mat(path, {name: np.atleast_2d(values) for name, values in columns.items()})
    found[".mat"].append(path.read_bytes())
    return found


def _sound_plants(folder: Path) -> dict[str, bytes]:
    matrices = {"A": [[1.0, 0.1], [0.0, 1.0]], "B": [[0.0], [0.1]], "C": [[1.0, 0.0]], "dt": 0.1}
    arrays = io.BytesIO()
    save: Any = np.savez_compressed  # its stub takes every keyword for allow_pickle
    save(arrays, **matrices)
    names = np.array(["x", "v"], dtype=object)
    save_mat(folder / "plant.mat", {**matrices, "states": names})
    return {
        ".json": json.dumps({**matrices, "states": ["x", "v"]}).encode(),
        ".npz": arrays.getvalue(),
        ".mat": (folder / "plant.mat").read_bytes(),
    }


def _odd_plant(rng: random.Random) -> dict[str, Any]:
    """Sizes that may agree, numbers at the edge among others, names that may be those."""
    n, m, p = (rng.choice((0, 1, 1, 2, 3)) for _ in range(3))

    def number(odd: bool) -> float:
        return rng.choice(EDGES) if odd and rng.random() < 0.3 else rng.gauss(0, 1)

    def matrix(rows: int, columns: int) -> list[list[float]]:
        odd = rng.random() < 0.2
        return [[number(odd) for _ in range(columns)] for _ in range(rows)]

    wrong = rng.random() < 0.2
    found: dict[str, Any] = {
        "A": matrix(n, n + wrong),
        "B": matrix(n, m),
        "C": matrix(p, n),
        "dt": rng.choice((0.1, 0.1, 0.1, 0, True, None, "0.1", [0.1], *EDGES)),
    }
    for name, size in (("states", n), ("inputs", m), ("outputs", p)):
        if rng.random() < 0.3:
            names = ("x", "y", "", "a\nb", "$x", "1")
            found[name] = [rng.choice(names) for _ in range(size)]
    return found
