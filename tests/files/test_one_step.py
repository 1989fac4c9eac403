"""Offsets, drifts, shifts, frozen sensors and falls, in simulated stick balancing."""

from __future__ import annotations

import functools
from pathlib import Path

import control
import numpy as np
import pytest

from impc.arrays import Array
from impc.errors import DataError, FallError, InputError
from impc.files.configuration import read_configuration
from impc.files.reading import read_recordings, read_unit
from impc.model.plant import Plant
from impc.model.recordings import Recording

SAMPLES = 600
SETTINGS = """
[recording]
time = "time"
[signals.angle]
column = "tilt"
unit = "deg"
# limit = 20.0
# offset = 0.0
[signals.push]
column = "tap"
unit = "1"
# shift = 0
"""


@functools.cache
def stick() -> control.StateSpace:
    """A stick on a fingertip, 50 samples a second (README)."""
    names = {"states": ["angle", "rate"], "inputs": ["finger", "push"], "outputs": ["angle"]}
    system = control.ss([[0, 1], [14.7, 0]], [[0, 0], [-1.5, 1]], [[1, 0]], 0, **names)
    system = control.c2d(system, 0.02)
    system.units = {"angle": "rad"}
    return system


@functools.cache
def balanced(seed: int) -> tuple[Array, Array]:
    """Angle in degrees, with noise of 0.02 degrees, and pushes."""
    system, rng = stick(), np.random.default_rng(seed)
    push = np.repeat(rng.choice([-1.5, 0.0, 1.5], SAMPLES // 10), 10)
    x, angle = np.zeros(2), np.zeros(SAMPLES)
    for k, d in enumerate(push):
        angle[k] = np.degrees(x[0]) + 0.02 * rng.standard_normal()
        x = system.A @ x + system.B @ [np.clip(25 * x[0] + 7 * x[1], -1.2, 1.2), d]
    return angle, push


def seeds(count: int) -> list[int]:
    """Seeds of trials in which the stick does not fall."""
    return [seed for seed in range(1, 100) if np.ptp(balanced(seed)[0]) < 15][:count]


def read(
    folder: Path, angle: Array, push: Array, *changes: tuple[str, str]
) -> tuple[Recording, tuple[str, ...]]:
    text = SETTINGS
    for old, new in changes:
        text = text.replace(old, new)
    (folder / "a.toml").write_text(text)
    rows = np.column_stack([np.arange(len(angle)) * 0.02, angle, push])
    np.savetxt(folder / "a.csv", rows, "%.6f", ",", header="time,tilt,tap", comments="")
    plant = Plant(stick(), ["finger"])
    (trial,) = read_recordings([folder / "a.csv"], read_configuration(folder / "a.toml"), plant)
    return trial, trial.findings


def test_nothing_is_found_in_clean_recordings(tmp_path: Path) -> None:
    for seed in seeds(20):
        assert read(tmp_path, *balanced(seed))[1] == ()


def test_an_offset_is_found_and_taken_away_where_the_user_says_so(tmp_path: Path) -> None:
    times = 0
    for seed in seeds(20):
        angle, push = balanced(seed)
        _, findings = read(tmp_path, angle + np.ptp(angle) / 8, push)  # a quarter of the motion
        times += any("angle is off by about" in finding for finding in findings)
    assert times >= 12
    angle, push = balanced(1)
    (finding,) = read(tmp_path, angle + 1, push)[1]
    said = float(finding.rpartition("set signals.angle.offset = ")[2])
    assert said == pytest.approx(1, abs=0.15)
    cured = read(tmp_path, angle + 1, push, ("# offset = 0.0", f"offset = {said}"))
    assert cured[1] == ()
    assert np.degrees(cured[0].outputs[0, 0]) == pytest.approx(angle[0] + 1 - said, abs=1e-5)


def test_a_drift_is_found(tmp_path: Path) -> None:
    angle, push = balanced(1)
    (finding,) = read(tmp_path, angle + np.linspace(0, 2, SAMPLES), push)[1]
    assert "angle drifts by about 2.3 deg" in finding
    assert "offset" not in finding


def test_a_sensor_that_stands_still_is_found(tmp_path: Path) -> None:
    for seed in seeds(8):
        angle, push = balanced(seed)
        angle = angle.copy()
        angle[200:350] = angle[200]
        findings = read(tmp_path, angle, push)[1]
        assert "is constant in 1 stretch, 150 samples in total" in findings[0]
        assert "sample 201 (4 s)" in findings[0]


def test_samples_that_were_lost_and_written_as_a_number_are_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    angle, push = balanced(1)
    lost, far = angle.copy(), angle.copy()
    lost[rng.choice(SAMPLES, 12, replace=False)] = 0.0
    findings = read(tmp_path, lost, push)[1]
    (finding,) = (found for found in findings if "jumps to 0 deg and back" in found)
    assert "in 12 samples" in finding
    far[rng.choice(SAMPLES, 12, replace=False)] = -99.0
    with pytest.raises(InputError, match=r"is -99 in 12 of 600 samples.*write missing = -99 in"):
        read(tmp_path, far, push)
    lost = angle.copy()
    lost[100:120] = lost[300:315] = 0
    assert "is constant in 2 stretches, 35 samples in total" in read(tmp_path, lost, push)[1][0]


@pytest.mark.parametrize("late", [-2, -1, 1, 2])
def test_rows_that_act_earlier_or_later_are_found(tmp_path: Path, late: int) -> None:
    for seed in seeds(6):
        angle, push = balanced(seed)
        (finding,) = read(tmp_path, angle, np.roll(push, late))[1]
        assert finding.endswith(f"try signals.push.shift = {-late}")
        assert f"acts {abs(late)} sample" in finding


@pytest.mark.parametrize("shift", ["-1", "-0.02"])
def test_a_shift_in_samples_or_seconds(tmp_path: Path, shift: str) -> None:
    angle, push = balanced(1)
    trial, findings = read(tmp_path, angle, np.roll(push, 1), ("# shift = 0", f"shift = {shift}"))
    assert findings == ()
    assert trial.samples == SAMPLES - 1
    np.testing.assert_allclose(trial.disturbance[:, 0], push[:-1], atol=1e-9)
    np.testing.assert_allclose(np.degrees(trial.outputs[:, 0]), angle[:-1], atol=1e-6)


def test_a_shift_of_a_part_of_a_sample_and_one_too_far(tmp_path: Path) -> None:
    angle, push = balanced(1)
    trial, _ = read(tmp_path, angle, push, ("# shift = 0", "shift = 0.005"))
    means = 0.75 * push[1:] + 0.25 * push[:-1]
    np.testing.assert_allclose(trial.disturbance[:, 0], means, atol=1e-9)
    with pytest.raises(
        DataError, match=r"signals.push.shift: moves the signal by 301 of 600 samples"
    ):
        read(tmp_path, angle, push, ("# shift = 0", "shift = 301"))
    with pytest.raises(InputError, match=r"signals.push.shift: got inf"):
        read(tmp_path, angle, push, ("# shift = 0", "shift = inf"))


def fallen(angle: Array, second: float) -> Array:
    """The stick falls from there on, and comes to rest at 80 degrees."""
    time = np.arange(len(angle)) * 0.02
    return np.minimum(angle + np.where(time > second, np.expm1(4 * (time - second)), 0), 80)


@pytest.mark.parametrize("limit", ["# limit = 20.0", "limit = 20.0"])
def test_a_fall_is_called_a_fall(tmp_path: Path, limit: str) -> None:
    """The sensor saturates at 80 degrees, or the stop is at 20."""
    angle, push = balanced(1)
    with pytest.raises(
        FallError, match=r"the subject fell at 8.\d+ s; leave the trial out"
    ) as caught:
        read(tmp_path, fallen(angle, 8.0), push, ("# limit = 20.0", limit))
    stop = float(str(caught.value).rpartition("recording.stop = ")[2])
    assert 8.0 <= stop < 9.0
    cut = ('time = "time"', f'time = "time"\nstop = {stop}')
    assert read(tmp_path, fallen(angle, 8.0), push, ("# limit = 20.0", limit), cut)[0].samples > 400


def test_what_comes_back_is_no_fall(tmp_path: Path) -> None:
    angle, push = balanced(1)
    with pytest.raises(DataError, match="exceeds its mechanical stop of 20 deg") as caught:
        read(tmp_path, 20 * angle, push, ("# limit = 20.0", "limit = 20.0"))
    assert not isinstance(caught.value, FallError)


def test_other_trials_of_a_unit_are_read(tmp_path: Path) -> None:
    angle, push = balanced(1)
    read(tmp_path, angle, push)
    (tmp_path / "a.csv").rename(tmp_path / "good.csv")
    with pytest.raises(FallError):
        read(tmp_path, fallen(angle, 5.0), push)
    configuration, plant = read_configuration(tmp_path / "a.toml"), Plant(stick(), ["finger"])
    good, bad = tmp_path / "good.csv", tmp_path / "a.csv"
    trials, falls = read_unit([bad, good], configuration, plant)
    assert [trial.label.trial for trial in trials] == ["good"]
    assert [fall.problem.rpartition(" at ")[0] for fall in falls] == ["the subject fell"]
    none, (fall,) = read_unit([bad], configuration, plant)
    assert (none, type(fall)) == ((), FallError)


def test_a_recorded_command_is_no_disturbance(tmp_path: Path) -> None:
    angle, push = balanced(1)
    command = '[signals.finger]\ncolumn = "tap"\nunit = "1"\ncommand = true\n[signals.push]'
    trial, _ = read(tmp_path, angle, push, ("[signals.push]", command))
    assert trial.disturbance.shape == (SAMPLES, 1)
    assert trial.commands.shape == (SAMPLES, 1)
    assert np.isfinite(trial.commands[:-1]).all()
    with pytest.raises(InputError, match=r"signals.angle: is no command of the plant"):
        read(tmp_path, angle, push, ("# limit = 20.0", "command = true"))


@pytest.mark.parametrize(
    ("written", "deviation"),
    [
        ("# shift = 0", 0.01),
        ('shift = "0 ± 2 ms"', 0.002),
        ('shift = "-0 +- 0.001 s"', 0.001),
        ('shift = "0 ± 0 ms"', 0.0),
    ],
)
def test_the_time_of_a_push_is_known_to_half_a_sample_or_as_stated(
    tmp_path: Path, written: str, deviation: float
) -> None:
    angle, push = balanced(1)
    trial, _ = read(tmp_path, angle, push, ("# shift = 0", written))
    np.testing.assert_allclose(trial.timing, [0.0, deviation])


def test_a_stated_time_also_moves_a_signal(tmp_path: Path) -> None:
    angle, push = balanced(1)
    moved, _ = read(tmp_path, angle, np.roll(push, 1), ("# shift = 0", 'shift = "-20 ± 1 ms"'))
    plain, _ = read(tmp_path, angle, np.roll(push, 1), ("# shift = 0", "shift = -0.02"))
    np.testing.assert_array_equal(moved.disturbance, plain.disturbance)
    with pytest.raises(InputError, match=r"signals.push.shift"):
        read(tmp_path, angle, push, ("# shift = 0", 'shift = "about 2 ms"'))
