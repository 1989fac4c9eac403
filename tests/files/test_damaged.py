"""Damaged recordings end in one line and exit status 2, and nothing is returned or written."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from impc.cli.main import main
from impc.cli.plant import find_plant
from impc.errors import InputError
from impc.files.configuration import read_configuration
from impc.files.plant_sources import make_plant
from impc.files.reading import read_recordings
from impc.model.plant import Plant
from tests.files.damaged import DAMAGED, PLANT
from tests.files.samples import csv_text, pushed_seat, settings


@pytest.fixture(scope="module")
def seat() -> Plant:
    return make_plant(find_plant(PLANT, {}), ("perturbation",))


def test_there_are_sixty_of_them() -> None:
    assert len(DAMAGED) >= 60


@pytest.mark.parametrize("name", DAMAGED)
def test_one_line_from_the_library(name: str, tmp_path: Path, seat: Plant) -> None:
    path, text = DAMAGED[name].make(tmp_path)
    (tmp_path / "subject.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_recordings([path], read_configuration(tmp_path / "subject.toml"), seat)
    message = str(caught.value)
    assert DAMAGED[name].phrase in message
    assert "\n" not in message
    assert message.count(path.name) <= 1  # no message within a message
    assert all((caught.value.subject, caught.value.problem, caught.value.remedy))
    assert len(message) - len(str(tmp_path)) < 420


@pytest.mark.parametrize("name", DAMAGED)
def test_one_line_and_status_2_from_the_command(name: str, tmp_path: Path) -> None:
    damage = DAMAGED[name]
    path, text = damage.make(tmp_path)
    config = tmp_path / "subject.toml"
    config.write_text(text, encoding="utf-8")
    before = sorted(tmp_path.iterdir())
    calls = [[str(path), "--config", str(config), "--plant", PLANT]]
    if damage.in_file:
        calls.append([str(path), "--out", str(tmp_path / "new.toml")])
    for call in calls:
        result = CliRunner().invoke(main, ["inspect", *call])
        assert result.exit_code == 2
        assert result.stdout == ""
        assert result.stderr.startswith("impc: error: ")
        assert damage.phrase in result.stderr
        assert result.stderr.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_the_recording_that_they_are_made_from_is_sound(tmp_path: Path, seat: Plant) -> None:
    (tmp_path / "trial.csv").write_text(csv_text(pushed_seat()))
    (tmp_path / "subject.toml").write_text(settings())
    configuration = read_configuration(tmp_path / "subject.toml")
    (trial,) = read_recordings([tmp_path / "trial.csv"], configuration, seat)
    assert trial.samples == 600
    assert trial.findings == ()
