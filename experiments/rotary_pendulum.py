"""Fit the feedback gain of a machine that prints it: a rotary inverted pendulum.

    python -m experiments.rotary_pendulum FOLDER

FOLDER has `furuta_pinned_sessions_thesis_20260209.zip`, published in Piyushiitk24/
Rotary-Inverted-Pendulum (commit 05a9ffa) and not part of this project. A stepper motor drives an
arm on which a pendulum stands; the firmware's linear feedback accelerates the arm. Only the two
angles are fitted; the logged commands are used for a regression beside it. The page
rotary_pendulum.md and its figure are written from the run.
"""

from __future__ import annotations

import hashlib
import io
import re
import sys
import textwrap
import time
import zipfile
from pathlib import Path
from typing import NamedTuple

import control
import numpy as np
from matplotlib.figure import Figure

import impc
from impc.arrays import Array
from impc.errors import DataError
from impc.output_feedback.fit import OutputFeedbackFit
from impc.output_feedback.intervals import entry_intervals, person_covariance

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


class Session(NamedTuple):
    """One session of the linear controller."""

    name: str
    angles: Array  # (samples, 2), arm and pendulum less their means, rad
    printed: Array  # (4,), gain of the firmware, u = -K x, in 1/s^2 and 1/s
    firmware: Array  # (4,), the same for a command that is held over a logged sample
    regression: Array  # (4,), gain by regression of logged commands on logged states
    explained: float  # Share of the logged commands' variance that this regression explains


class Fitted(NamedTuple):
    """Fit of some sessions together."""

    what: str
    fit: OutputFeedbackFit
    low: Array  # (4,), 95 % sandwich intervals of the gain
    high: Array
    profile: Array  # (4, 2), 95 % profile intervals
    seconds: float


def held(gain: Array) -> Array:
    """Mean gain (4,) over a logged sample of a `gain` (4,) that acts every `TICK`."""
    plant, mean, moved = pendulum(TICK), np.zeros(4), np.eye(4)
    ticks = round(STEP / TICK)
    for _ in range(ticks):
        mean += gain @ moved / ticks
        moved = (plant.A - plant.B @ gain[None]) @ moved
    return mean


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
    """Sessions of the archive in which the linear controller held the arm at zero."""
    path = folder / ARCHIVE
    if not path.is_file():
        raise DataError(ARCHIVE, "is not in the folder", "see the head of this script")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != DIGEST:
        raise DataError(ARCHIVE, "is another version than the published one", "get it again")
    found = []
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for name in sorted(archive.namelist()):
            if not name.endswith("balance_log.csv"):
                continue
            events = archive.read(name.replace("balance_log.csv", "events.txt")).decode()
            moved = re.search(r"thetaTargetDeg=-?[1-9]", events)
            if "mode=LIN" in events and not moved:
                log = np.loadtxt(io.BytesIO(archive.read(name)), delimiter=",", skiprows=1)
                found.append(_session(name.split("/")[-2], log, events))
    return found


def _session(name: str, log: Array, events: str) -> Session:
    """One session, on a regular clock; the mean of the angles is the controller's trim."""
    seconds = log[:, 0] / 1e3
    clock = np.arange(seconds[0], seconds[-1], STEP)
    angles = np.radians([np.interp(clock, seconds, log[:, k]) for k in (3, 1)]).T
    printed = [float(re.findall(rf"{one}=(-?[\d.]+)", events)[0]) for one in NAMES]
    states = np.column_stack([log[:, [3, 1, 4, 2]], np.ones(len(log))])
    slope, *_ = np.linalg.lstsq(states, log[:, 5] / STEPS_A_DEGREE, rcond=None)
    stated = -np.array(printed) / STEPS_A_DEGREE
    regression = np.asarray(-slope[:4], dtype=np.float64)
    centred = angles - angles.mean(axis=0)
    left = log[:, 5] / STEPS_A_DEGREE - states @ slope
    explained = 1 - float(np.var(left) / np.var(log[:, 5] / STEPS_A_DEGREE))
    return Session(name, centred, stated, held(stated), regression, explained)


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
    covariance, K = person_covariance(found), np.array(found.K)
    low, high = covariance.entry_intervals(K).T
    profile = np.asarray(entry_intervals(found, covariance))
    spent = time.perf_counter() - begun
    return Fitted(what, found, low, high, profile, spent), np.array(start.vaf)


def figure(fits: list[Fitted], found: list[Session]) -> Figure:
    """Gain entries as a share of the firmware's, with 95 % intervals."""
    drawn = Figure(figsize=(7.5, 3.6), layout="constrained")
    axes = drawn.subplots()
    true, place = found[0].firmware, np.arange(4)
    axes.axhline(1.0, color="0.3", linewidth=1, label="firmware")
    for k, one in enumerate(fits):
        value = np.array(one.fit.K).ravel()
        ends = np.abs(np.array([value - one.low, one.high - value]) / true)
        axes.errorbar(place + 0.18 * k, value / true, yerr=ends, fmt="o", capsize=3, label=one.what)
    for k, session in enumerate(found):
        axes.plot(place - 0.18 * (k + 1), session.regression / session.printed, "x", color="0.5",
                  label="regression on logged commands" if k == 0 else None)  # fmt: skip
    axes.set_xticks(place, ["arm", "pendulum", "arm rate", "pendulum rate"])
    axes.set_ylabel("gain / firmware's gain")
    drawn.legend(fontsize=8, ncols=3, loc="outside upper center")
    return drawn


def page(fits: list[Fitted], found: list[Session], vaf: Array) -> str:
    """Page with numbers of this run only; the first fit is the headline."""
    best = fits[0]
    levels = (
        f"{best.fit.observer.motor[0]:.2g} rad/s² on the command, and "
        f"{' and '.join(f'{np.degrees(one):.2g}' for one in best.fit.recorder)} degrees in the log"
    )
    end = "All fits converged."
    if late := [one.what for one in fits if not one.fit.converged]:
        end = f"**Not converged: {', '.join(late)}.**"
    parts = [
        "# A machine whose gain is known",
        _verdict(fits, found, vaf),
        "![Gains over those of the firmware](images/rotary_pendulum.svg)",
        "*Each estimated gain over that of the firmware, with its 95 % interval.*",
        "Written by `make reproduce DATA=folder` (`python -m experiments.rotary_pendulum folder`). "
        "The sessions are published in the repository Piyushiitk24/Rotary-Inverted-Pendulum "
        "(commit 05a9ffa) without a licence. They are not part of this project; the script checks "
        "the digest of the archive.",
        "## Gains",
        _gains(best, found),
        _fits(fits),
        f"Intervals are sandwich intervals, which allow for residuals that are not white; profile "
        f"intervals trust the noise model. The estimated noise of “{best.what}” is {levels}. {end}",
        "## What was assumed",
        *ASSUMED,
    ]
    return "\n\n".join(wrapped(one) for one in parts) + "\n"


def wrapped(part: str) -> str:
    """Paragraph or list item in lines of 108 characters; headings, tables and pictures as is."""
    if part[0] in "#|!":
        return part
    return textwrap.fill(part, 108, subsequent_indent="  " if part.startswith("- ") else "")


def _verdict(fits: list[Fitted], found: list[Session], vaf: Array) -> str:
    best, together, pushed = fits
    one, true = steady(found), found[0].firmware
    wrong = abs(one.regression / one.printed - 1).max()
    gained = pushed.fit.log_likelihood - best.fit.log_likelihood
    trusting = best._replace(low=best.profile[:, 0], high=best.profile[:, 1])  # the noise model
    return (
        f"A plain regression on logged commands and states finds the firmware's gain to "
        f"{100 * wrong:.0f} % in {best.what}, because it sees the command. From the two angles "
        f"alone, the likelihood with noise on the command gives 95 % intervals that hold "
        f"{_held(best, true)} of the 4 gains and leave out zero for {_apart(best)} (profile "
        f"intervals: {_held(trusting, true)} and {_apart(trusting)}). What is assumed decides: "
        f"with pushes on the pendulum as a second noise the log-likelihood rises by {gained:.0f}, "
        f"and the intervals hold {_held(pushed, true)}; with both sessions together they hold "
        f"{_held(together, true)} and leave out zero for {_apart(together)}. Neither noise is "
        f"what happened: fingers push seldom and hard, and the motor stands still at low speed. A "
        f"simulation without noise in the loop explains {vaf[0]:.1f} % of the arm and "
        f"{vaf[1]:.1f} % of the pendulum."
    )


def steady(found: list[Session]) -> Session:
    """Session in which the logged commands are best explained by a constant gain."""
    return max(found, key=lambda one: one.explained)


def _apart(one: Fitted) -> int:
    """Number of intervals that leave out zero."""
    return int(np.sum((one.low > 0) | (one.high < 0)))


def _held(one: Fitted, true: Array) -> int:
    """Number of intervals that hold the true gain (4,)."""
    return int(np.sum((one.low <= true) & (true <= one.high)))


def _gains(best: Fitted, found: list[Session]) -> str:
    first, K = found[0], np.array(best.fit.K).ravel()
    heads = ["gain on", "firmware", "held over a logged sample", "estimate from angles (95 %)"]
    heads += ["holds it", "leaves out zero"]
    heads += [f"regression, {one.name.split('_')[-1]}" for one in found]
    rows = [heads, ["---"] * len(heads)]
    for k, name in enumerate(STATES):
        low, high, true = best.low[k], best.high[k], first.firmware[k]
        rows.append([name, f"{first.printed[k]:.2f}", f"{true:.2f}"])
        rows[-1].append(f"{K[k]:.2f} ({low:.2f} to {high:.2f})")
        rows[-1] += ["yes" if one else "**no**" for one in (low <= true <= high, low * high > 0)]
        rows[-1] += [f"{one.regression[k]:.2f}" for one in found]
    share = [f"{100 * one.explained:.1f} %" for one in found]
    rows.append(["commands explained", "", "", "", "", "", *share])
    return _table(rows)


def _fits(fits: list[Fitted]) -> str:
    rows = [["fit", "arm", "pendulum", "arm rate", "pendulum rate", "time, s"], ["---"] * 6]
    for one in fits:
        entries = zip(np.array(one.fit.K).ravel(), one.low, one.high, strict=True)
        cells = [f"{value:.2f} ({low:.2f} to {high:.2f})" for value, low, high in entries]
        rows.append([one.what, *cells, f"{one.seconds:.0f}"])
        cells = [f"{low:.2f} to {high:.2f}" for low, high in one.profile]
        rows.append(["profile intervals", *cells, ""])
    return _table(rows)


def _table(rows: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)


ASSUMED = (
    f"- The plant is linearised about upright: gravity over length {GRAVITY} 1/s², coupling "
    f"{COUPLING}, from the machine's thesis. The firmware lets the arm's velocity decay at "
    f"{LEAK:g}/s; that is part of the plant here. Otherwise it would be added to a gain.",
    "- The firmware acts at 200 Hz and the log has 50 Hz. The fitted controller acts once a logged "
    "sample, so its gain is compared with the mean of the firmware's command over a sample. The "
    "regression sees each command and is compared with the printed gain.",
    "- The firmware trims the upright angle slowly. The mean of each angle was removed; the rest "
    "of the trim counts as noise. The headline is the session in which a constant gain explains "
    "most of the logged commands: the trim moved in the other one.",
    "- Everything that is not in the model counts as white noise on the command: pushes by finger, "
    "the resolution of the sensors, and a stepper motor that stands still at low speed.",
    "- Sessions with a moving reference are not used: the log has no column for it, and the event "
    "list prints it once a second. Sessions of sliding-mode controllers have other laws.",
    "- There is no limit: the acceleration stays below that of the motor.",
)


def main(folder: Path) -> None:
    """Fit the sessions one by one and together, and write page and figure."""
    found = sessions(folder)
    one = steady(found)
    what = f"session {one.name.split('_')[-1]}"
    best, vaf = likely(what, [one])
    together, _ = likely("all sessions", found)
    fits = [best, together, likely(f"{what}, with pushes on the pendulum", [one], PUSH)[0]]
    here = Path(__file__).parent
    figure(fits, found).savefig(here / "images" / "rotary_pendulum.svg", metadata={"Date": None})
    (here / "rotary_pendulum.md").write_text(page(fits, found, vaf), encoding="utf-8")
    print(f"Written: {here.name}/rotary_pendulum.md and its figure")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except DataError as error:
        sys.exit(f"experiments.rotary_pendulum: {error}")
