"""Damaged recordings give one line and exit status 2; nothing is returned or written."""

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
from tests.files.damaged_files import DAMAGED, PLANT
from tests.files.samples import csv_text, pushed_seat, settings


@pytest.fixture(scope="module")
def seat() -> Plant:
    return make_plant(find_plant(PLANT, {}), ("perturbation",))


@pytest.mark.parametrize("name", DAMAGED)
def test_one_line_says_what_where_and_what_to_do(name: str, tmp_path: Path, seat: Plant) -> None:
    phrase, make = DAMAGED[name]
    path, text = make(tmp_path)
    (tmp_path / "subject.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_recordings([path], read_configuration(tmp_path / "subject.toml"), seat)
    message = str(caught.value)
    assert phrase in message
    assert "\n" not in message
    assert message.count(path.name) <= 1  # no message within a message
    assert all((caught.value.subject, caught.value.problem, caught.value.remedy))
    assert len(message) - len(str(tmp_path)) < 420


@pytest.mark.parametrize("command", ["inspect", "fit", "draft"])
def test_a_command_ends_with_status_2_and_writes_nothing(command: str, tmp_path: Path) -> None:
    phrase, make = DAMAGED["truncated mat"]
    path, text = make(tmp_path)
    (tmp_path / "subject.toml").write_text(text, encoding="utf-8")
    before = sorted(tmp_path.iterdir())
    words = ["inspect" if command == "draft" else command, str(path)]
    if command != "inspect":
        words += ["--out", str(tmp_path / "out")]
    if command != "draft":
        words += ["--config", str(tmp_path / "subject.toml"), "--plant", PLANT]
    done = CliRunner().invoke(main, words)
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.startswith("impc: error: ")
    assert phrase in done.stderr
    assert done.stderr.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_the_recording_that_they_are_made_from_is_sound(tmp_path: Path, seat: Plant) -> None:
    (tmp_path / "trial.csv").write_text(csv_text(pushed_seat()))
    (tmp_path / "subject.toml").write_text(settings())
    configuration = read_configuration(tmp_path / "subject.toml")
    (trial,) = read_recordings([tmp_path / "trial.csv"], configuration, seat)
    assert trial.samples == 600
    assert trial.findings == ()
