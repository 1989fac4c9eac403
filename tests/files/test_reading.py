"""Recordings from files: values, labels, gaps, findings."""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import pytest

from impc.arrays import Array
from impc.errors import DataError, InputError
from impc.files.causality import misaligned
from impc.files.configuration import Configuration, read_configuration
from impc.files.reading import read_recordings
from impc.model.plant import Plant
from impc.model.recordings import Label, Recording
from plants import seated_balance_plant, ternary_torque
from tests.files.samples import csv_text, pushed_seat, settings


@pytest.fixture(scope="module")
def seat() -> Plant:
    return Plant(seated_balance_plant(), ["command"])


def configured(folder: Path, *changes: tuple[str, str]) -> Configuration:
    path = folder / "subject.toml"
    path.write_text(settings(*changes), encoding="utf-8")
    return read_configuration(path)


def read(folder: Path, plant: Plant, text: str, *changes: tuple[str, str]) -> Recording:
    (folder / "S01_3.csv").write_text(text)
    return read_recordings([folder / "S01_3.csv"], configured(folder, *changes), plant)[0]


def seated(rate: float = 100.0, seconds: float = 30.0, **changed: Array) -> dict[str, Array]:
    return {**pushed_seat(round(seconds * rate), rate), **changed}


def test_values_in_si_units_with_offset_and_sign(tmp_path: Path, seat: Plant) -> None:
    columns = seated()
    changes = (
        ('column = "trunk"\nunit = "deg"', 'column = "trunk"\nunit = "deg"\noffset = 2.0\nsign=-1'),
        ('unit = "Nm"', 'unit = "N cm"'),
    )
    trial = read(tmp_path, seat, csv_text(columns), *changes)
    np.testing.assert_allclose(trial.outputs[:, 0], np.deg2rad(columns["seat"]), atol=1e-10)
    np.testing.assert_allclose(trial.outputs[:, 1], -np.deg2rad(columns["trunk"] - 2), atol=1e-10)
    np.testing.assert_allclose(trial.disturbance[:, 0], columns["push"] / 100, rtol=1e-12)
    np.testing.assert_array_equal(trial.x0, np.zeros(seat.n))
    # Removing an offset that the sensor does not have introduces one.
    assert "theta2 is off by about -2 deg" in trial.findings[0]
    assert trial.findings[0].endswith("set signals.theta2.offset = 0")


def test_a_unit_of_the_file_is_overruled_in_so_many_words(tmp_path: Path, seat: Plant) -> None:
    columns = seated()
    radians = csv_text(columns).replace(",trunk", ",trunk (rad)", 1)
    with pytest.raises(DataError, match=r"set signals.theta2.overrule_unit = true if the file"):
        read(tmp_path, seat, radians)
    column = 'column = "trunk"\nunit = "deg"'
    trial = read(tmp_path, seat, radians, (column, f"{column}\noverrule_unit = true"))
    np.testing.assert_allclose(trial.outputs[:, 1], np.deg2rad(columns["trunk"]), atol=1e-10)
    assert "read in 'deg' as signals.theta2 says; the file states 'rad'" in trial.findings[0]
    none = read(tmp_path, seat, csv_text(columns).replace(",trunk", ",trunk (1)", 1))
    assert "the file states '1'" in none.findings[0]
    assert (
        read(tmp_path, seat, csv_text(columns).replace(",trunk", ",trunk (Grad)", 1)).findings == ()
    )


def test_labels_from_the_configuration_and_from_the_name(tmp_path: Path, seat: Plant) -> None:
    text = csv_text(seated())
    assert read(tmp_path, seat, text).label == Label("S01", "", "", "S01_3")
    pattern = "pattern = '(?P<subject>[^_]+)_(?P<trial>[0-9]+)'\nvisit = \"2\""
    trial = read(tmp_path, seat, text, ('subject = "S01"', pattern))
    assert trial.label == Label("S01", "2", "", "3")


def test_a_clock_in_milliseconds_that_begins_anywhere_and_a_cut(
    tmp_path: Path, seat: Plant
) -> None:
    columns = seated()
    late = csv_text({**columns, "time": 1000 * columns["time"] + 50_000})
    cut = 'time = "time"\ntime_unit = "ms"\nstart = 55.0\nstop = 70.0'
    trial = read(tmp_path, seat, late, ('time = "time"', cut))
    assert trial.samples == 1501
    assert trial.outputs[0, 0] == pytest.approx(np.deg2rad(columns["seat"][500]))


def test_a_recording_at_1_khz_comes_to_the_rate_of_the_plant(tmp_path: Path, seat: Plant) -> None:
    time = np.arange(10_000) / 1000
    wave = 3 * np.sin(2 * np.pi * 0.7 * time)
    hum = 0.5 * np.sin(2 * np.pi * 130 * time)  # would alias to 30 Hz
    push = pushed_seat(10_000, 1000.0)["push"]
    columns = {"time": time, "seat": wave + hum, "trunk": -wave, "push": push}
    trial = read(tmp_path, seat, csv_text(columns))
    inside = slice(30, -30)
    exact = np.deg2rad(3 * np.sin(2 * np.pi * 0.7 * 0.01 * np.arange(1000)))
    assert trial.samples == 1000
    assert np.abs(trial.outputs[inside, 0] - exact[inside]).max() < 1e-3 * np.deg2rad(3)
    # Held for 0.2 s and jumping within a millisecond: exact means except at the jumps.
    assert np.mean(np.abs(trial.disturbance[:, 0] - push[::10]) < 1e-9) > 0.94
    assert trial.disturbance.sum() * 0.01 == pytest.approx(push.sum() * 0.001, abs=0.01)


def test_a_slower_recording_says_what_it_cannot_know(tmp_path: Path, seat: Plant) -> None:
    trial = read(tmp_path, seat, csv_text(seated(50.0)))
    assert trial.samples == 2999
    assert any("nothing above 25 Hz" in finding for finding in trial.findings)


def test_gaps_are_filled_only_where_allowed_and_reported(tmp_path: Path, seat: Plant) -> None:
    columns = seated()
    lost = {name: np.delete(values, slice(700, 705)) for name, values in columns.items()}
    lost["trunk"][1500:1503] = np.nan
    allowed = ('time = "time"', 'time = "time"\nfill_gaps = 0.06')
    trial = read(tmp_path, seat, csv_text(lost), allowed)
    assert trial.samples == 3000
    assert [
        word in " ".join(trial.findings)
        for word in ("5 rows missing, none for longer than 0.06 s: inter", "3 of 2995")
    ] == [True, True]
    whole = np.deg2rad(np.column_stack([columns["seat"], columns["trunk"]]))
    assert np.abs(trial.outputs - whole).max() < np.deg2rad(0.1)
    kept = np.r_[0:690, 720:1490, 1520:3000]
    np.testing.assert_allclose(trial.outputs[kept], whole[kept], atol=1e-9)
    with pytest.raises(InputError, match="1 gaps"):
        read(tmp_path, seat, csv_text(lost), (allowed[0], allowed[1].replace("6", "5")))


def test_gaps_below_a_sample_of_the_model_are_filled_by_default(
    tmp_path: Path, seat: Plant
) -> None:
    columns = seated(1000.0, 10.0)
    rng = np.random.default_rng(5)  # seed 5
    kept = np.flatnonzero((rng.random(10_000) > 0.05) | (np.arange(10_000) % 9_999 == 0))
    lost = {name: values[kept] for name, values in columns.items()}
    lost["trunk"][1500:1503] = np.nan
    trial, whole = (read(tmp_path, seat, csv_text(one)) for one in (lost, columns))
    said = f"{10_000 - len(kept)} rows missing, none for longer than a model sample: interpolated"
    assert any(finding.endswith(said) for finding in trial.findings)
    assert np.abs(trial.outputs - whole.outputs).max() < np.deg2rad(0.02)
    with pytest.raises(InputError, match="gaps, the first at"):
        read(tmp_path, seat, csv_text(lost), ('"time"', '"time"\nfill_gaps = 0.0'))
    beyond = {name: np.delete(values, slice(700, 711)) for name, values in columns.items()}
    with pytest.raises(InputError, match="1 gaps"):
        read(tmp_path, seat, csv_text(beyond))


def test_clocks_and_counters_beside_a_rate(tmp_path: Path, seat: Plant) -> None:
    columns = seated()
    counted = {"count": np.arange(3000.0), **columns}
    at_rate = ('time = "time"', "rate = 100.0")
    assert read(tmp_path, seat, csv_text(counted), at_rate).findings == ()
    rounded = seated(300.0, 10.0)
    rounded["time"] = np.round(rounded["time"], 3)
    assert read(tmp_path, seat, csv_text(rounded), (at_rate[0], "rate = 300")).findings == ()
    lost = {name: np.delete(values, slice(700, 705)) for name, values in counted.items()}
    for name in ("count", "time"):
        one = {**lost, "count": counted["count"][:2995], name: lost[name]}
        one = one if name == "time" else {**one, "time": columns["time"][:2995]}
        (found,) = read(tmp_path, seat, csv_text(one), at_rate).findings
        assert f"column '{name}' skips 5 rows, first after sample 700" in found
    with pytest.raises(DataError, match="has 100 samples per second, but the rate is 200"):
        read(tmp_path, seat, csv_text(counted), (at_rate[0], "rate = 200"))


def test_jitter_is_a_finding_and_values_come_to_even_instants(tmp_path: Path, seat: Plant) -> None:
    rng = np.random.default_rng(3)  # seed 3
    columns = seated()
    time = columns["time"] + 0.001 * rng.uniform(-1, 1, 3000)
    wave = 3 * np.sin(2 * np.pi * 0.7 * time)
    trial = read(tmp_path, seat, csv_text({**columns, "time": time, "seat": wave}))
    assert any("jitter" in finding and "interpolated" in finding for finding in trial.findings)
    at = 0.01 * np.arange(trial.samples)
    exact = np.deg2rad(3 * np.sin(2 * np.pi * 0.7 * at))
    assert np.abs(trial.outputs[:, 0] - exact).max() < 1e-2 * np.deg2rad(3)


def test_a_rounded_clock_is_even(tmp_path: Path, seat: Plant) -> None:
    # 300 samples per second, written in milliseconds: intervals of 3, 3 and 4.
    columns = seated(300.0, 10.0)
    columns["time"] = np.round(columns["time"], 3)
    trial = read(tmp_path, seat, csv_text(columns))
    assert trial.samples == 1000
    exact = np.deg2rad(pushed_seat(3000, 300.0)["seat"][::3])
    assert np.abs(trial.outputs[20:-20, 0] - exact[20:-20]).max() < np.deg2rad(0.1)


def test_a_little_clipping_and_a_wide_angle_are_findings(tmp_path: Path, seat: Plant) -> None:
    columns = seated()
    level = float(np.quantile(columns["trunk"], 0.97))
    clipped = {**columns, "trunk": np.minimum(columns["trunk"], level)}
    findings = read(tmp_path, seat, csv_text(clipped)).findings
    assert len(findings) == 1
    assert "is clipped at" in findings[0]
    wide = {**columns, "trunk": 20 * columns["trunk"]}
    assert "check its unit" in read(tmp_path, seat, csv_text(wide)).findings[0]


@pytest.mark.parametrize("levels", [8, 20, 60, 4096])
def test_a_converter_of_few_levels_is_not_clipped(tmp_path: Path, seat: Plant, levels: int) -> None:
    columns = seated()
    for name in ("seat", "trunk"):
        step = np.ptp(columns[name]) / levels
        columns[name] = step * np.round(columns[name] / step)
    assert read(tmp_path, seat, csv_text(columns)).findings == ()


def test_trials_of_unequal_length_in_the_order_given(tmp_path: Path, seat: Plant) -> None:
    paths = [tmp_path / name for name in ("b.csv", "a.csv")]
    for path, seconds in zip(paths, (30.0, 25.0), strict=True):
        path.write_text(csv_text(seated(seconds=seconds)))
    trials = read_recordings(paths, configured(tmp_path), seat)
    assert [trial.label.trial for trial in trials] == ["b", "a"]
    assert trials[0].findings == ()
    assert "2500 samples, the longest has 3000" in trials[1].findings[0]
    with pytest.raises(InputError, match="is given twice"):
        read_recordings([paths[0], tmp_path / "." / "b.csv"], configured(tmp_path), seat)
    (tmp_path / "link.csv").symlink_to(paths[0])
    with pytest.raises(InputError, match=r"link.csv: is given twice, also as .*b.csv"):
        read_recordings([paths[0], tmp_path / "link.csv"], configured(tmp_path), seat)
    (tmp_path / "copy.csv").write_bytes(paths[0].read_bytes())
    with pytest.raises(InputError, match=r"copy.csv: is a copy of .*b.csv, byte for byte"):
        read_recordings([paths[0], tmp_path / "copy.csv"], configured(tmp_path), seat)
    with pytest.raises(InputError, match="no file is given"):
        read_recordings([], configured(tmp_path), seat)


def test_a_plant_without_recorded_disturbance(tmp_path: Path) -> None:
    plant = Plant(seated_balance_plant(), ["command", "perturbation"])
    push = '[signals.perturbation]\ncolumn = "push"\nunit = "Nm"\n'
    trial = read(tmp_path, plant, csv_text(seated()), (push, ""))
    assert trial.disturbance.shape == (3000, 0)


# Cause and effect -----------------------------------------------------------------------------


def balanced(plant: Plant, seed: int) -> tuple[Array, Array]:
    """Torque and seat angle of a simulated subject (LQR) with further movement; 30 s."""
    rng = np.random.default_rng(seed)
    gain, _, _ = control.dlqr(plant.A, plant.B, np.eye(plant.n), np.eye(plant.m))
    torque = ternary_torque(seed=seed)
    state, angles = np.zeros(plant.n), np.zeros(len(torque))
    for index, push in enumerate(torque):
        angles[index] = plant.C[0] @ state
        own = plant.B @ rng.normal(size=plant.m)
        state = (plant.A - plant.B @ gain) @ state + plant.E[:, 0] * push + own
    return torque, angles


def test_a_balancing_loop_is_aligned_and_a_shifted_one_is_not(seat: Plant) -> None:
    found = {0: 0, 40: 0, 100: 0}
    for seed in range(10):  # seeds 0 to 9
        torque, angles = balanced(seat, seed)
        for lead in found:
            reason = misaligned(torque[: 3000 - lead], angles[lead:], 0.01)
            found[lead] += "precedes the disturbance" in reason
            assert "is not correlated" not in reason
    assert found == {0: 0, 40: 10, 100: 10}


def test_the_response_of_another_trial_has_nothing_in_common() -> None:
    for seed in range(20):  # seeds 0 to 19
        push, other = pushed_seat(3000, seed=seed)["push"], pushed_seat(3000, seed=seed + 100)
        assert "is not correlated" in misaligned(push, other["seat"], 0.01)


def test_of_a_sinusoid_nothing_is_said() -> None:
    time = 0.01 * np.arange(3000)
    assert misaligned(np.sin(3 * time), np.sin(3 * time + 1), 0.01) == ""
    assert misaligned(np.sin(3 * time[:30]), np.sin(3 * time[:30]), 0.01) == ""


@pytest.mark.parametrize(
    ("signal", "before", "after", "words"),
    [
        ("theta2", 'column = "trunk"\nunit = "deg"', 'column = "trunk"\nunit = "mV"', "in rad"),
        ("perturbation", 'unit = "Nm"', 'unit = "N"', "in N m"),
    ],
)
def test_a_unit_of_another_kind_is_refused(
    tmp_path: Path, seat: Plant, signal: str, before: str, after: str, words: str
) -> None:
    """EMG in mV is no angle."""
    with pytest.raises(InputError, match=words) as refused:
        read(tmp_path, seat, csv_text(seated()), (before, after))
    assert refused.value.subject == f"signals.{signal}.unit"
    without = Plant(seated_balance_plant(), ["command"], units={})
    assert read(tmp_path, without, csv_text(seated()), (before, after)).samples > 0


def test_a_plant_in_degrees_is_refused(tmp_path: Path) -> None:
    """Recordings are converted to SI units: they would be too small by a factor of 57."""
    plant = Plant(seated_balance_plant(), ["command"], units={"theta1": "deg"})
    with pytest.raises(InputError, match="make the plant in SI units"):
        read(tmp_path, plant, csv_text(seated()))


@pytest.mark.parametrize(("rate", "offered"), [(1000.0, False), (100.0, True)])
def test_a_push_that_jumps_between_samples_is_offered_to_the_fit(
    tmp_path: Path, seat: Plant, rate: float, offered: bool
) -> None:
    """Every 125 ms: at 100 Hz every second jump lies in the middle of a sample."""
    columns = seated(rate, push=ternary_torque(rate=rate, seed=9))
    trial = read(tmp_path, seat, csv_text(columns))
    assert len(trial.finer) == (trial.samples if offered else 0)
    said = "perturbation switches every 0.125 s; its edges are placed between samples"
    assert any(said in finding for finding in trial.findings) == offered
    if offered:
        fine = ternary_torque(rate=8000.0, seed=9).reshape(-1, 80)[: trial.samples - 15]
        np.testing.assert_allclose(trial.finer[: len(fine), 0], fine.mean(axis=1), atol=1e-9)
