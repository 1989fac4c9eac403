"""All faults of recordings at once, with the field to look at; errors with file and TOML path."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from impc.arrays import Array
from impc.cli.main import main
from impc.errors import InputError
from impc.files.checks import Notice
from impc.files.configuration import Configuration, configuration
from impc.files.reading import examine, recording_of
from impc.files.table import Table, make_table
from impc.levels import Level
from impc.model.plant import Plant
from plants import seated_balance_plant
from tests.files.damaged_files import PLANT
from tests.files.samples import csv_text, pushed_seat, settings

SEAT = Plant(seated_balance_plant(), ["command"])


def trial(source: str, samples: int = 600, **changed: Array) -> Table:
    return make_table(source, {**pushed_seat(samples), **changed})


def configured(*changes: tuple[str, str]) -> Configuration:
    return configuration(tomllib.loads(settings(*changes)), "S01.toml")


def faults(notices: tuple[Notice, ...]) -> list[tuple[str, tuple[str, ...]]]:
    return [(one.file, one.place) for one in notices if one.level is Level.RED]


def test_every_fault_once_and_of_a_configuration_not_for_each_file() -> None:
    asked = ('column = "trunk"\nunit = "deg"', 'column = "?"\nunit = "?"')
    wrong = configured(asked, ("limit = 12.0", "limit = 1.0"))
    short = make_table("c.csv", {"seat": np.arange(9.0) ** 2})
    tables = [trial("Süd 1.csv"), trial("b.csv", push=np.zeros(600)), short]
    found = examine(tables, wrong, SEAT)
    assert faults(found) == [
        ("S01.toml", ("signals", "theta2", "column")),
        ("S01.toml", ("signals", "theta2", "unit")),
        ("Süd 1.csv", ("signals", "theta1", "limit")),
        ("b.csv", ("signals", "theta1", "limit")),
        ("b.csv", ("signals", "perturbation", "column")),
        ("c.csv", ("recording", "time")),
        ("c.csv", ("signals", "perturbation", "column")),
    ]
    with pytest.raises(InputError) as caught:
        recording_of(tables[1], wrong, SEAT)
    assert str(found[0]) == str(caught.value)
    assert str(found[0]) == "signals.theta2.column: is still '?'; fill in its name in the file"


def test_findings_are_those_of_the_recordings_with_their_field() -> None:
    tables = [trial("a.csv", trunk=20 * pushed_seat(600)["trunk"]), trial("b.csv", 500)]
    off = configured(("limit = 12.0", "limit = 12.0\noffset = 2.0"))
    found = examine(tables, off, SEAT)
    said = [text for table in tables for text in recording_of(table, off, SEAT).findings]
    assert [one.text for one in found[:-1]] == said
    assert "trials of unequal length: 500 samples" in found[-1].text
    fell = trial("c.csv", seat=np.repeat([1.0, -1.0, 20.0], 200))
    found += examine([fell], off, SEAT)
    places = {(one.file, one.place) for one in found}
    assert ("c.csv", ("recording", "stop")) in places
    assert {one.level for one in found} == {Level.AMBER}
    assert ("a.csv", ("signals", "theta2", "unit")) in places
    assert ("b.csv", ("signals", "theta1", "offset")) in places


def test_inspect_prints_all_faults(tmp_path: Path) -> None:
    path, config = tmp_path / "Versuch 1.csv", tmp_path / "S01.toml"
    path.write_text(csv_text(pushed_seat(600)))
    changes = ('unit = "Nm"', 'unit = "?"'), ('column = "trunk"', 'column = "Rumpf"')
    config.write_text(settings(*changes), encoding="utf-8")
    done = CliRunner().invoke(main, ["inspect", str(path), "--config", str(config),
                                     "--plant", PLANT])  # fmt: skip
    assert done.exit_code == 2
    assert done.stderr.startswith("impc: error: signals.perturbation.unit: is still '?'; fill in")
    assert done.stdout.startswith(f"{path}: column 'Rumpf': is not in the file; signals.theta2.col")
