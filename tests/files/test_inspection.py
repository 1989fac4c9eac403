"""`impc inspect`: what it prints, and that its draft can be read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from impc.cli.main import main
from impc.cli.plant import find_plant
from impc.errors import InputError
from impc.files.configuration import FILL_IN, read_configuration
from impc.files.formats import write_table
from impc.files.plant_sources import PlantSource, make_plant
from impc.files.reading import read_recordings
from impc.files.table import make_table
from impc.model.plant import Plant
from impc.studies.fit.settings import fit_settings
from plants import seated_balance_plant
from tests.files.damaged_files import PLANT
from tests.files.samples import csv_text, pushed_seat, settings

ROOT = Path(__file__).parents[2]


def inspect(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["inspect", *map(str, arguments)])


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    columns = pushed_seat(600)
    columns["theta 2"] = columns.pop("trunk")
    columns["push"][5] = np.nan
    text = csv_text(columns).replace("time,seat", "time (s),theta1 (deg)", 1)
    header, *rows = text.strip().split("\n")
    path = tmp_path / "trial.csv"
    path.write_text("\n".join([header + ",side", *(row + ",left" for row in rows)]) + "\n")
    return path


def test_units_of_other_languages_are_to_be_filled_in(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("Zeit (Sek);theta1 (Grad);push (Ellen)\n0;1;2\n0,1;2;3\n")
    text = inspect(path).stdout
    remedy = "is ambiguous: write deg for degrees, gon otherwise"
    assert re.search(rf'unit = "\?" +# the file states .Grad., which {remedy}', text)
    assert '[signals."push (Ellen)"]' in text  # no unit that is known


def test_the_table_of_columns(trial: Path) -> None:
    result = inspect(trial)
    assert result.exit_code == 0
    lines = result.stdout.split("\n")
    heads = ["column", "unit", "samples", "min", "max", "mean", "not", "finite", "rate"]
    assert lines[0].split() == heads
    assert lines[1].split() == ["time", "s", "600", "0", "5.99", "2.995", "0", "100"]
    assert lines[3].split()[:2] == ["push", "600"]
    assert lines[3].split()[-1] == "1"
    assert "Not read: side is text, such as 'left' in line 2" in result.stdout


@pytest.mark.parametrize("plant", [(), ("--plant", PLANT)])
def test_what_it_writes_only_needs_units_filled_in(
    trial: Path, tmp_path: Path, plant: tuple[str, ...]
) -> None:
    out = tmp_path / "new.toml"
    result = inspect(trial, "--out", out, *plant)
    assert result.exit_code == 0
    configuration = read_configuration(out)
    assert configuration.recording.time == "time"
    assert configuration.recording.time_unit == "s"
    columns = {name: entry.column for name, entry in configuration.signals.items()}
    if plant:
        assert columns == {"theta1": "theta1", "theta2": "theta 2", "perturbation": "push"}
        assert configuration.signals["theta1"].unit == "deg"
    else:
        assert columns == {name: name for name in ("theta1", "push", "theta 2")}
    assert configuration.signals["theta1"].unit == "deg"
    shown = inspect(trial, *plant).stdout
    assert out.read_text(encoding="utf-8") in shown


def test_from_a_file_never_seen_to_a_recording(tmp_path: Path) -> None:
    path, out = tmp_path / "trial.csv", tmp_path / "new.toml"
    columns = pushed_seat(600)
    names = ["t", "theta1", "theta2", "torque"]
    path.write_text(csv_text(dict(zip(names, columns.values(), strict=True))))
    assert inspect(path, "--out", out, "--plant", PLANT).exit_code == 0
    plant = Plant(seated_balance_plant(), ["command"])
    with pytest.raises(InputError, match="is still '\\?'"):
        read_recordings([path], read_configuration(out), plant)
    text = out.read_text(encoding="utf-8")
    for unit in ("deg", "deg", "Nm"):
        text = text.replace(f'unit = "{FILL_IN}"  ', f'unit = "{unit}"  ', 1)
    out.write_text(text, encoding="utf-8")
    (found,) = read_recordings([path], read_configuration(out), plant)
    np.testing.assert_allclose(found.outputs[:, 0], np.deg2rad(columns["seat"]), atol=1e-10)
    result = inspect(path, "--config", out, "--plant", PLANT)
    assert result.stdout == "trial: 600 samples at 100 per second\nThe checks found no problems.\n"


def test_a_column_is_not_taken_for_a_signal_of_another_kind(tmp_path: Path) -> None:
    """EMG in mV is the first column: the draft names it, and does not use it for an angle."""
    path, out = tmp_path / "trial.csv", tmp_path / "new.toml"
    columns = pushed_seat(600)
    units = {"emg (mV)": "seat", "lean (deg)": "trunk", "push (N*m)": "push"}
    text = csv_text(columns)
    header, rest = text.split("\n", 1)
    names = {before: after for after, before in units.items()}
    header = ",".join(names.get(name, name) for name in header.split(","))
    path.write_text(f"{header}\n{rest}")
    done = inspect(path, "--out", out, "--plant", PLANT)
    assert done.exit_code == 0, done.output
    found = read_configuration(out).signals
    assert (found["theta1"].column, found["theta1"].unit) == ("lean", "deg")
    assert found["perturbation"].column == "push"
    assert found["theta2"].column == FILL_IN
    text = out.read_text()
    assert '# Columns that are not used: "emg" (mV)' in text
    assert "A GUESS from its unit: check it" in text
    assert "no remaining column fits: enter its name" in text
    plant = Plant(seated_balance_plant(), ["command"])
    with pytest.raises(InputError, match=r"theta2.column: is still '\?'; fill in its name"):
        read_recordings([path], read_configuration(out), plant)


def test_counters_constants_and_second_clocks_are_no_guesses(tmp_path: Path) -> None:
    columns = pushed_seat(600)
    count = np.arange(600.0)
    made = {
        "Frame": count, "Time": columns["time"], "EMG time": columns["time"] + 5,
        "gain": 0 * count + 2, "SeatAngle (deg)": columns["seat"],
        "lean_deg": columns["trunk"], "shove": columns["push"],
    }  # fmt: skip
    path, out = tmp_path / "trial.csv", tmp_path / "new.toml"
    path.write_text(csv_text(made))
    assert inspect(path, "--out", out, "--plant", PLANT).exit_code == 0
    text = out.read_text()
    found = read_configuration(out)
    assert found.recording.time == "Time"
    assert [found.signals[name].column for name in ("theta1", "theta2", "perturbation")] == [
        *("SeatAngle", "lean_deg", "shove")
    ]
    assert re.search(r'unit = "deg" +# a guess from its name', text)
    assert (
        '# Columns that are not used: "Frame" (a clock or counter), '
        '"EMG time" (a clock or counter), "gain" (constant)'
    ) in text
    assert "# a recorded perturbation; delete this table if it was not recorded" in text


def test_day_numbers_of_excel_are_a_clock(tmp_path: Path) -> None:
    columns = pushed_seat(600)
    days = [f"{45352.4 + second / 86_400:.11f}" for second in columns["time"]]
    header, *rows = csv_text(columns).strip().split("\n")
    cells = [",".join([day, *row.split(",")[1:]]) for day, row in zip(days, rows, strict=True)]
    path = tmp_path / "trial.csv"
    path.write_text("\n".join([header, *cells]) + "\n")
    assert re.search(
        r'time_unit = "day" +# a guess: day numbers of a spreadsheet', inspect(path).stdout
    )
    (tmp_path / "a.toml").write_text(settings())
    plant = Plant(seated_balance_plant(), ["command"])
    trial = read_recordings([path], read_configuration(tmp_path / "a.toml"), plant)[0]
    assert trial.samples == 600
    assert "read as day numbers of a spreadsheet" in trial.findings[0]


def test_settings_that_only_the_user_knows_are_asked_for(trial: Path, tmp_path: Path) -> None:
    """The subject's own numbers, and arguments without default, are rejected until filled in."""
    out = tmp_path / "new.toml"
    done = inspect(trial, "--out", out, "--plant", "seated-balance")
    assert done.exit_code == 0
    assert done.stdout.endswith("guesses to check; then run impc fit with it.\n")
    with pytest.raises(InputError, match=r"\[plant\] mass: is still '\?'; fill it in"):
        make_plant(find_plant("seated-balance", read_configuration(out).plant), ())
    text = out.read_text()
    assert 'mass = "?"                # the subject\'s own; without this line' in text
    assert "without this line the plant's 79.7 is used" in text
    assert 'height = "?"' in text
    assert '# sex = "male"' in text
    assert "opposite direction; positive to the right: the right edge of the seat goes" in text
    assert "command in N m" in text
    assert "0.2 s" in text
    table = read_configuration(out).fit
    assert table == {"horizon": 20, "u_max": FILL_IN}
    with pytest.raises(InputError, match=r"\[fit\] u_max: is still '\?'; fill it in, or remove"):
        fit_settings(table)
    assert fit_settings({"horizon": 20, "u_max": 60.0}).u_max == 60.0

    def seat(mass: float, height: float = 1.66) -> None:
        pytest.fail("what is not filled in is refused before")

    source = PlantSource("mine:seat", seat, {})
    assert source.defaults() == {"mass": FILL_IN, "height": 1.66}
    with pytest.raises(InputError, match=r"\[plant\] mass: is still '\?'; fill it in"):
        make_plant(PlantSource("mine:seat", seat, {"mass": FILL_IN}), ())


def test_names_that_toml_must_quote_and_units_nobody_knows(tmp_path: Path) -> None:
    path, out = tmp_path / "trial.tdms", tmp_path / "new.toml"
    names = ['say "so"', "back\\slash", "Winkel ä", "a.b", "# no"]
    columns = {name: np.random.default_rng(0).normal(size=50) for name in names}
    write_table(path, make_table("trial", columns, {"a.b": "furlongs!", "# no": "mV"}, 250.0))
    result = inspect(path, "--out", out)
    assert result.exit_code == 0
    assert "The file states a rate of 250 samples per second." in result.stdout
    configuration = read_configuration(out)
    assert configuration.recording.rate is None
    assert list(configuration.signals) == names
    assert [entry.column for entry in configuration.signals.values()] == names
    assert configuration.signals["# no"].unit == "mV"
    assert configuration.signals["a.b"].unit == FILL_IN


def test_it_writes_over_nothing(trial: Path, tmp_path: Path) -> None:
    out = tmp_path / "old.toml"
    out.write_text("old")
    result = inspect(trial, "--out", out)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "already exists" in result.stderr
    assert out.read_text() == "old"
    assert "cannot be written" in inspect(trial, "--out", tmp_path / "none" / "x.toml").stderr


def test_findings_are_shown_and_a_plant_is_needed(tmp_path: Path) -> None:
    columns = pushed_seat(600)
    columns["trunk"] *= 20
    (tmp_path / "trial.csv").write_text(csv_text(columns))
    (tmp_path / "subject.toml").write_text(settings())
    call = (tmp_path / "trial.csv", "--config", tmp_path / "subject.toml")
    assert "check its unit" in inspect(*call, "--plant", PLANT).stdout
    assert "is given without --plant" in inspect(*call).stderr
