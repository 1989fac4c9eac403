"""Fit the feedback gain of a machine that prints it: a rotary inverted pendulum.

    python -m experiments.rotary_pendulum FOLDER

FOLDER has `furuta_pinned_sessions_thesis_20260209.zip`, published in Piyushiitk24/
Rotary-Inverted-Pendulum (commit 05a9ffa) and not part of this project. A stepper motor drives an
arm on which a pendulum stands; the firmware's feedback accelerates the arm. Only the two angles are
fitted; the logged commands are used for a regression beside it. The command writes
rotary_pendulum.md and its figure.
"""

from __future__ import annotations

import hashlib
import io
import re
import sys
import time
import zipfile
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import control
import numpy as np

import impc
from experiments.reproduction.page import joined, table
from impc.arrays import Array
from impc.errors import DataError
from impc.output_feedback.fit import OutputFeedbackFit
from impc.output_feedback.intervals import entry_intervals, person_covariance
from impc.reporting.style import drawn, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ARCHIVE = "furuta_pinned_sessions_thesis_20260209.zip"
DIGEST = "047a1227a30e303eeffbd734ca3d96c73c7b0497538b662b864ad61d70d4d1db"
# Samples of the log and of the firmware, s.
STEP, TICK, HORIZON = 0.02, 0.005, 10
# Of the thesis: gravity over length and coupling of the arm, 1/s^2; decay of the velocity, 1/s.
GRAVITY, COUPLING, LEAK = 100.8, 1.952, 2.0
# Motor steps a degree, and the gains in the order of the states.
STEPS_A_DEGREE = 4.444
STATES = ("arm, 1/s²", "pendulum, 1/s²", "arm rate, 1/s", "pendulum rate, 1/s")
NAMES = ("K_THETA", "K_ALPHA", "K_THETADOT", "K_ALPHADOT")
# First noise levels: command, rad/s^2, and rate of the pendulum, rad/s a sample.
MOTOR, PUSH = 5.0, 0.05
# Seconds left out before the first step of the reference: clocks of log and events differ.
MARGIN = 0.5
MODES = {"LIN": "linear", "SMC": "sliding mode", "SMC4": "sliding mode, four states"}


class Session(NamedTuple):
    """One session; the gains are those of u = -K x, (4,), in 1/s^2 and 1/s."""

    name: str
    mode: str
    use: str  # What of it is fitted, or why nothing is
    angles: Array  # (samples, 2), arm and pendulum less their means, rad
    printed: Array  # Gain of the firmware
    regression: Array  # Gain by regression of logged commands on logged states
    explained: float  # Share of the logged commands' variance that this regression explains

    @property
    def firmware(self) -> Array:
        """Mean of the printed gain (4,), which acts every `TICK`, over a logged sample."""
        plant, mean, moved = pendulum(TICK), np.zeros(4), np.eye(4)
        ticks = round(STEP / TICK)
        for _ in range(ticks):
            mean += self.printed @ moved / ticks
            moved = (plant.A - plant.B @ self.printed[None]) @ moved
        return mean


class Fitted(NamedTuple):
    """Fit of some sessions together."""

    what: str
    fit: OutputFeedbackFit
    sandwich: Array  # (4, 2), 95 % intervals of the gain
    profile: Array
    seconds: float


def pendulum(step: float = STEP) -> impc.Plant:
    """Arm and pendulum, linearised about upright, with held arm acceleration."""
    A, names = np.zeros((4, 4)), ["arm", "pendulum", "arm_rate", "pendulum_rate"]
    A[0, 2] = A[1, 3] = 1.0
    A[3, 1], A[2, 2], A[3, 2] = GRAVITY, -LEAK, COUPLING * LEAK
    system = control.ss(
        A, [[0], [0], [1], [-COUPLING]], np.eye(2, 4), 0,
        states=names, inputs=["acceleration"], outputs=names[:2],
    )  # fmt: skip
    return impc.Plant(control.c2d(system, step), ["acceleration"])


def sessions(folder: Path) -> list[Session]:
    """All sessions of the archive, by time."""
    path = folder / ARCHIVE
    if not path.is_file():
        raise DataError(ARCHIVE, "is not in the folder", "see the head of this script")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != DIGEST:
        raise DataError(ARCHIVE, "is another version than the published one", "get it again")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = sorted(one for one in archive.namelist() if one.endswith("balance_log.csv"))
        return [
            _session(
                name.split("/")[-2].split("_")[-1],
                np.loadtxt(io.BytesIO(archive.read(name)), delimiter=",", skiprows=1),
                archive.read(name.replace("balance_log.csv", "events.txt")).decode(),
            )
            for name in names
        ]


def _session(name: str, log: Array, events: str) -> Session:
    """One session, on a regular clock; the mean of the angles is the controller's trim."""
    mode = re.findall(r"mode=(\w+)", events)[0]
    use = "all of it" if mode == "LIN" else "nothing: its law has no constant gain"
    if moved := re.search(r"(\S+ \S+): Device: thetaTargetDeg=-?[1-9]", events):
        engaged = re.search(r"(\S+ \S+): Device: ENGAGED", events)
        assert engaged is not None
        begin, end = (datetime.fromisoformat(one[1]) for one in (engaged, moved))
        kept = (end - begin).total_seconds() - MARGIN
        log = log[log[:, 0] - log[0, 0] < 1e3 * kept]
        use = f"the first {kept:.0f} s: later the reference moves, and the log has no column for it"
    seconds = log[:, 0] / 1e3
    clock = np.arange(seconds[0], seconds[-1], STEP)
    angles = np.radians([np.interp(clock, seconds, log[:, k]) for k in (3, 1)]).T
    printed = [float(re.findall(rf"{one}=(-?[\d.]+)", events)[0]) for one in NAMES]
    states = np.column_stack([log[:, [3, 1, 4, 2]], np.ones(len(log))])
    commands = log[:, 5] / STEPS_A_DEGREE
    slope, *_ = np.linalg.lstsq(states, commands, rcond=None)
    explained = 1 - float(np.var(commands - states @ slope) / np.var(commands))
    stated, own = -np.array(printed) / STEPS_A_DEGREE, np.asarray(-slope[:4], dtype=np.float64)
    return Session(name, MODES[mode], use, angles - angles.mean(axis=0), stated, own, explained)


def likely(what: str, chosen: list[Session], push: float = 0.0) -> tuple[Fitted, Array]:
    """Maximum-likelihood gain with noise in the loop, and the VAF of a simulation, %.

    With a `push`, noise on the pendulum's rate is fitted as well as noise on the command.
    """
    plant, begun = pendulum(), time.perf_counter()
    trials = [impc.Recording(plant, one.angles) for one in chosen]
    problem = impc.fit_problem(plant, trials, impc.FitSettings(horizon=HORIZON))
    start = impc.fit(problem, "inverse_mpc")
    observer = impc.Observer(plant, motor=MOTOR, process=[0, 0, 0, push])
    found = impc.fit_output_feedback(start, observer)
    covariance = person_covariance(found)
    profile = np.asarray(entry_intervals(found, covariance))
    ends, spent = covariance.entry_intervals(np.array(found.K)), time.perf_counter() - begun
    return Fitted(what, found, np.asarray(ends), profile, spent), np.array(start.vaf)


def figure(fits: list[Fitted], used: list[Session]) -> Figure:
    """Gain entries as a share of the firmware's, with 95 % intervals."""
    drawing = new_figure(7.5, 3.6)
    axes, true, place = drawing.subplots(), used[0].firmware, np.arange(4)
    axes.axhline(1.0, color="0.3", linewidth=1, label="firmware")
    for k, one in enumerate(fits):
        value = np.array(one.fit.K).ravel()
        ends = np.abs((one.sandwich.T - value) / true)
        axes.errorbar(place + 0.13 * k, value / true, yerr=ends, fmt="o", capsize=3, label=one.what)
    for k, session in enumerate(used):
        axes.plot(place - 0.13 * (k + 1), session.regression / session.printed, "x", color="0.5",
                  label="regression on logged commands" if k == 0 else None)  # fmt: skip
    axes.set_xticks(place, ["arm", "pendulum", "arm rate", "pendulum rate"])
    axes.set_ylabel("gain / firmware's gain")
    drawing.legend(fontsize=8, ncols=3, loc="outside upper center")
    return drawing


def page(fits: list[Fitted], found: list[Session], vaf: Array) -> str:
    """Page with numbers of this run only; the first fit is the headline."""
    best, used = fits[0], [one for one in found if one.mode == MODES["LIN"]]
    noise = np.degrees(best.fit.recorder)
    end = "All fits converged."
    if late := [one.what for one in fits if not one.fit.converged]:
        end = f"**Not converged: {', '.join(late)}.**"
    doubts = [f"- {one.what}: {' '.join(one.fit.doubts) or 'none.'}" for one in fits]
    return joined(
        "# A machine whose gain is known",
        _verdict(fits, used, vaf),
        "![Gains over those of the firmware](images/rotary_pendulum.svg)",
        "*Each estimated gain over that of the firmware, with its 95 % interval.*",
        "Written by `make reproduce DATA=folder` (`python -m experiments.rotary_pendulum folder`). "
        "The sessions are published in the repository Piyushiitk24/Rotary-Inverted-Pendulum "
        "(commit 05a9ffa) without a licence. They are not part of this project; the script checks "
        "the digest of the archive.",
        "## Sessions",
        _sessions(found),
        "The last column is the variance of the logged commands that a constant gain explains. A "
        "sliding-mode law is near a linear one but has no printed gain to compare with.",
        "## Gains",
        _gains(best, used),
        _fits(fits),
        "Intervals are sandwich intervals, which allow for residuals that are not white; profile "
        f"intervals trust the noise model. The estimated noise of “{best.what}” is "
        f"{best.fit.observer.motor[0]:.2g} rad/s² on the command, and {noise[0]:.2g} and "
        f"{noise[1]:.2g} degrees in the log. {end}",
        "`OutputFeedbackFit.doubts` says of each fit:",
        "\n".join(doubts),
        "## What was assumed",
        ASSUMED,
    )


def _verdict(fits: list[Fitted], used: list[Session], vaf: Array) -> str:
    best, *others, together, pushed = fits
    one, true = steady(used), used[0].firmware
    wrong = abs(one.regression / one.printed - 1).max()
    gained = pushed.fit.log_likelihood - best.fit.log_likelihood
    doubted = sum(bool(one.fit.doubts) for one in fits)
    alone = " and ".join(f"{_held(one.sandwich, true)} ({one.what})" for one in others)
    return (
        f"A plain regression on logged commands and states finds the firmware's gain to "
        f"{100 * wrong:.0f} % in {best.what}, because it sees the command. From the two angles "
        f"alone, the likelihood with noise on the command gives 95 % intervals that hold "
        f"{_held(best.sandwich, true)} of the 4 gains and leave out zero for "
        f"{_apart(best.sandwich)} (profile intervals: {_held(best.profile, true)} and "
        f"{_apart(best.profile)}). Of the other sessions they hold {alone} of 4, and of all "
        f"together {_held(together.sandwich, true)}. What is assumed decides: with pushes on the "
        f"pendulum as a second noise the log-likelihood of {best.what} rises by {gained:.0f}, and "
        f"the intervals hold {_held(pushed.sandwich, true)}. Neither noise is what happened: "
        f"fingers push seldom and hard, and the motor stands still at low speed. The fits say so: "
        f"{doubted} of {len(fits)} have doubts. A simulation without noise in the loop explains "
        f"{vaf[0]:.1f} % of the arm and {vaf[1]:.1f} % of the pendulum."
    )


def steady(found: list[Session]) -> Session:
    """Session in which the logged commands are best explained by a constant gain."""
    return max(found, key=lambda one: one.explained)


def _apart(ends: Array) -> int:
    """Number of intervals (4, 2) that leave out zero."""
    return int(np.sum((ends[:, 0] > 0) | (ends[:, 1] < 0)))


def _held(ends: Array, true: Array) -> int:
    """Number of intervals (4, 2) that hold the true gain (4,)."""
    return int(np.sum((ends[:, 0] <= true) & (true <= ends[:, 1])))


def _sessions(found: list[Session]) -> str:
    rows = [
        [one.name, one.mode, f"{len(one.angles) * STEP:.0f}", one.use, f"{100 * one.explained:.1f}"]
        for one in found
    ]
    return table(["session", "controller", "s", "what is fitted", "constant gain, %"], rows)


def _gains(best: Fitted, used: list[Session]) -> str:
    first, K, rows = used[0], np.array(best.fit.K).ravel(), []
    for k, name in enumerate(STATES):
        (low, high), true = best.sandwich[k], first.firmware[k]
        held = ("yes" if one else "**no**" for one in (low <= true <= high, low * high > 0))
        entries = (f"{one.regression[k]:.2f}" for one in used)
        estimate = f"{K[k]:.2f} ({low:.2f} to {high:.2f})"
        rows.append([name, f"{first.printed[k]:.2f}", f"{true:.2f}", estimate, *held, *entries])
    heads = ["gain on", "firmware", "held over a logged sample", "estimate from angles (95 %)"]
    heads += ["holds it", "leaves out zero", *(f"regression, {one.name}" for one in used)]
    return table(heads, rows)


def _fits(fits: list[Fitted]) -> str:
    rows = []
    for one in fits:
        entries = zip(np.array(one.fit.K).ravel(), one.sandwich, strict=True)
        cells = [f"{value:.2f} ({low:.2f} to {high:.2f})" for value, (low, high) in entries]
        rows.append([one.what, *cells, f"{one.seconds:.0f}"])
        ends = [f"{low:.2f} to {high:.2f}" for low, high in one.profile]
        rows.append(["profile intervals", *ends, ""])
    return table(["fit", "arm", "pendulum", "arm rate", "pendulum rate", "time, s"], rows)


ASSUMED = f"""
- The plant is linearised about upright: gravity over length {GRAVITY} 1/s², coupling {COUPLING},
  from the machine's thesis. The firmware lets the arm's velocity decay at {LEAK:g}/s; that is part
  of the plant here. Otherwise it would be added to a gain.
- The firmware acts at 200 Hz and the log has 50 Hz. The fitted controller acts once a logged
  sample, so its gain is compared with the mean of the firmware's command over a sample. The
  regression sees each command and is compared with the printed gain.
- The firmware trims the upright angle slowly. The mean of each angle was removed; the rest of the
  trim counts as noise. The headline is the session in which a constant gain explains most of the
  logged commands: the trim moved in the others.
- Everything that is not in the model counts as white noise on the command: pushes by finger, the
  resolution of the sensors, and a stepper motor that stands still at low speed.
- There is no limit: the acceleration stays below that of the motor.
"""


def main(folder: Path) -> None:
    """Fit the linear sessions one by one and together, and write page and figure."""
    found = sessions(folder)
    used = [one for one in found if one.mode == MODES["LIN"]]
    first = steady(used)
    what = f"session {first.name}"
    best, vaf = likely(what, [first])
    fits = [best]
    fits += [likely(f"session {one.name}", [one])[0] for one in used if one is not first]
    fits.append(likely("all sessions", used)[0])
    fits.append(likely(f"{what}, with pushes on the pendulum", [first], PUSH)[0])
    here = Path(__file__).parent
    image = drawn(lambda: figure(fits, used), "svg")
    (here / "images" / "rotary_pendulum.svg").write_bytes(image)
    (here / "rotary_pendulum.md").write_text(page(fits, found, vaf), encoding="utf-8")
    print(f"Written: {here.name}/rotary_pendulum.md and its figure")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except DataError as error:
        sys.exit(f"experiments.rotary_pendulum: {error}")
