"""Predict people who steer a cursor: delayed feedback, inverse LQR, and inverse MPC.

    python -m experiments.steering FOLDER

FOLDER is experiment/data of the public repository EmDash00/CPHS2017 (Yamagami, Howell, Roth and
Burden, CPHS 2018), which is not part of the project, or has archives *_prepared.tar.gz of its
trials as <person>_<plant>_<trial>.csv with columns time (s), y, slider, push. Rows come at 60 Hz.
The plant is y' = u + d (fo) or y'' = u + d - y' (so), without model error. Each method is fitted to
the first three trials with phases `p` and simulated on all trials with phases `m`.
"""

from __future__ import annotations

import functools
import hashlib
import io
import re
import sys
import tarfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import control
import numpy as np
import scipy.linalg
import scipy.optimize

import impc
from experiments.steering_page import PERIOD, RATE, SETTLE, Case, Fit, write_page
from impc.arrays import Array
from impc.assess.ceiling import ceiling
from impc.errors import DataError, ImpcError
from impc.inverse.problem import controller_for
from impc.jit import njit
from impc.output_feedback.simulation import simulate_person
from plants.actuation import pade_delay

TRAINED, HORIZON, FAR = 3, 20, 1e3
#: Delay (s), lag (s) and learning rate (1/s) at which searches start.
START = (0.25, 0.08, 1.0)
#: Budget of likelihood evaluations of the output-feedback fit; scale of "no noise" in simulations.
EVALUATIONS, QUIET = 250, 1e-6
_RAW = re.compile(r"[\d-]+_[\w-]+_(fo|so)_r-zer_d-sos\+A_s49_p(\d)a1_([+-])1\.csv")
_PREPARED = re.compile(r"([A-Za-z0-9-]+)_(fo|so)_(\d)([pm])\.csv")

Trials = dict[tuple[str, str], dict[str, Array]]


def hand_and_cursor(values: Array, order: int) -> impc.Plant:
    """Plant of cursor, hand and Padé delay from delay (s), lag (s) and, if given, learning rate."""
    delay, lag = values[:2]
    late = pade_delay(delay, 2)
    a, b, c, d = (np.asarray(late.A), np.asarray(late.B), np.asarray(late.C), np.asarray(late.D))
    n = order + 3
    A, B = np.zeros((n, n)), np.zeros((n, 2))
    A[0, 1] = 1.0  # y' = hand + push, or y' = v with v' = hand + push - v
    B[order - 1, 1] = 1.0
    if order == 2:
        A[1, 1], A[1, 2] = -1.0, 1.0
    A[order, order], A[order, order + 1 :] = -1 / lag, np.ravel(c) / lag
    B[order, 0], A[order + 1 :, order + 1 :] = d.item() / lag, a
    B[order + 1 :, 0] = np.ravel(b)
    whole = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, n + 2))]]) / RATE)
    system = control.ss(
        *(whole[:n, :n], whole[:n, n:], np.eye(n)[[0, order]], 0, 1 / RATE),
        states=[*["y", "rate"][:order], "hand", "late 1", "late 2"],
        inputs=["command", "push"],
        outputs=["y", "slider"],
    )
    plant = impc.Plant(system, controls=["command"])
    return impc.with_observer(plant, values[2]) if len(values) > 2 else plant


def read_trials(folder: Path) -> tuple[Trials, str]:
    """Trials (samples, 4) by person and plant and by number and phase; SHA-256 of all files."""
    found: Trials = {}
    digest = hashlib.sha256()
    for file in sorted(folder.glob("*/*.csv")):
        if match := _RAW.fullmatch(file.name):
            content = file.read_bytes()
            digest.update(content)
            # Row k + 1 has the slider and the disturbance that act from sample k to k + 1
            rows = np.loadtxt(io.BytesIO(content), delimiter=",")
            trial = np.column_stack([rows[:-1, [0, 5]], rows[1:, 3:5]])
            number = match[2] + {"+": "p", "-": "m"}[match[3]]
            found.setdefault((file.parent.name, match[1]), {})[number] = trial
    for name, content in _members(folder):
        if match := _PREPARED.fullmatch(name):
            digest.update(content)
            trial = np.loadtxt(io.BytesIO(content), delimiter=",", skiprows=1, ndmin=2)
            found.setdefault((match[1], match[2]), {})[match[3] + match[4]] = trial
    for pair, trials in found.items():
        for number, rows in trials.items():
            if rows.shape[1] != 4 or len(rows) <= 2 * PERIOD or not np.all(np.isfinite(rows)):
                what = "expected 4 columns and over 40 s at 60 Hz"
                raise DataError(f"{' '.join(pair)} {number}", what, "remove the file")
    if not found:
        remedy = "give experiment/data of EmDash00/CPHS2017"
        raise DataError(folder.name, "has no recordings of this study", remedy)
    return found, digest.hexdigest()


def _members(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the regular files in the archives of a folder, read in memory."""
    for file in sorted(folder.glob("*_prepared.tar.gz")):
        with tarfile.open(file) as archive:
            for member in archive:
                stream = archive.extractfile(member) if member.isreg() else None
                if stream is not None:
                    yield Path(member.name).name, stream.read()


def scored(trials: list[Array], simulated: list[Array]) -> Array:
    """VAF of cursor and slider after the settling time (trials, 2), %."""
    first = round(SETTLE * RATE)
    pairs = zip(trials, simulated, strict=True)
    return np.array([impc.vaf(own[first:, 1:3], run[first:]) for own, run in pairs])


@njit()
def _feedback_loop(gains: Array, delay: int, start: float, push: Array, order: int) -> Array:
    """Simulate u = -kp y - ki (integral of y) - kd y', `delay` samples late (samples, 2)."""
    h, e = 1 / RATE, np.exp(-1 / RATE)
    out, v, rates = np.zeros((len(push), 2)), 0.0, np.zeros(len(push))
    out[0, 0], total = start, 0.0
    for t in range(len(push) - 1):
        seen = out[t - delay, 0] if t >= delay else 0.0
        rate = rates[t - delay] if t >= delay else 0.0
        total += seen * h
        u = -gains[0] * seen - gains[1] * total - gains[2] * rate
        if order == 1:
            y = out[t, 0] + h * (u + push[t])
        else:
            y = out[t, 0] + (1 - e) * v + (h - (1 - e)) * (u + push[t])
            v = e * v + (1 - e) * (u + push[t])
        out[t + 1, 0] = min(max(y, -FAR), FAR)  # Diverging simulations stay finite
        out[t, 1], rates[t + 1] = min(max(u, -FAR), FAR), min(max(v, -FAR), FAR)
    return out


def fit_delayed(label: str, trained: list[Array], case: Case) -> Fit:
    """Least-squares gains and delay of delayed PI (fo) or PID (so) feedback, by shooting on y."""
    order, begun = case.order, time.perf_counter()

    def runs(theta: Array, delay: int, trials: list[Array]) -> list[Array]:
        gains = np.append(theta, np.zeros(3 - len(theta)))
        return [_feedback_loop(gains, delay, one[0, 1], one[:, 3].copy(), order) for one in trials]

    def missed(theta: Array, delay: int) -> float:
        pairs = zip(runs(theta, delay, trained), trained, strict=True)
        return float(sum(np.sum((run[:, 0] - own[:, 1]) ** 2) for run, own in pairs))

    best: tuple[float, Array, int] = (np.inf, np.zeros(2), 0)
    for delay in range(2, 31):
        for start in ([1.0, 0.3, 1.0], [3.0, 1.0, 3.0]):
            found = scipy.optimize.minimize(
                missed, start[: order + 1], (delay,), "Nelder-Mead", options={"maxfev": 300}
            )
            if found.fun < best[0]:
                best = (float(found.fun), found.x, delay)
    theta, delay = best[1:]
    simulated = runs(theta, delay, case.test)
    values = dict(zip(("kp", "ki", "kd"), map("{:.2f}".format, theta), strict=False))
    values["delay"] = f"{delay / RATE:.2f}"
    train = scored(trained, runs(theta, delay, trained))
    seconds = time.perf_counter() - begun
    return Fit(label, train, scored(case.test, simulated), simulated, values, seconds=seconds)


def problem_of(
    trials: list[Array], values: tuple[float, ...], order: int, *, free: bool
) -> impc.Problem:
    """Inverse problem of some trials, without bounds; with `free` parameters or fixed ones."""
    plant = hand_and_cursor(np.array(values), order)
    family = impc.PlantFamily(
        functools.partial(hand_and_cursor, order=order),
        ["delay", "lag", "learning"][: len(values)],
        values,
    )
    recordings = [impc.Recording(plant, one[:, 1:3], one[:, 3]) for one in trials]
    return impc.Problem(
        *(plant, impc.Bounds(plant), HORIZON, recordings),
        family=family if free else None,
        terminal_set=False,
    )


def fit_of(label: str, found: impc.Estimate, case: Case) -> Fit:
    """Simulate a fitted controller from the recorded cursor, with the hand at rest."""
    if found.K is None:
        return Fit(label, reason=found.reason, seconds=found.seconds)
    law, C = found.controller(), found.problem.plant.C

    def run(one: Array) -> Array:
        x0 = np.append(one[0, 1], np.zeros(law.plant.n - 1))
        moved = law.simulate(x0, disturbance=one[:, 3]).x[: len(one)] @ C.T
        return np.clip(np.nan_to_num(moved, nan=FAR), -FAR, FAR)

    simulated = [run(one) for one in case.test]
    train = scored(case.train, [run(one) for one in case.train])
    test, rows = scored(case.test, simulated), {}
    if label.startswith("offset-free"):
        try:
            rows = {str(name): _worded(row) for name, row in found.intervals().iterrows()}
        except ImpcError as error:  # Unidentified parameters can leave every possible plant
            rows = {"intervals": f"not available ({error})"}
    return Fit(label, train, test, simulated, rows, found.doubts, seconds=found.seconds)


def _worded(row: object) -> str:
    """Value and 95 % interval of a fitted number; "not identified" for a width over a factor 10."""
    value, low, high = (float(getattr(row, part)) for part in ("value", "low", "high"))
    narrow = low * high > 0 and max(high / low, low / high) <= 10
    return f"{value:.2g} ({low:.2g} to {high:.2g})" if narrow else "not identified"


def fit_noisy(case: Case, delay: float, lag: float) -> Fit:
    """Output feedback with sensory noise on one trial, at a fixed delay (s) and lag (s)."""
    label, begun = "output feedback", time.perf_counter()
    trials = case.train[:1]
    motor, walk = float(np.std(trials[0][:, 2])), 0.1 * float(np.std(trials[0][:, 3]))
    try:
        start = impc.fit(problem_of(trials, (delay, lag), case.order, free=False))
        plant = start.problem.plant
        sensory = 0.2 * float(np.std(trials[0][:, 1]))
        senses = impc.Observer(plant, ["y"], motor=0.3 * motor, sensory=sensory, walk=walk)
        likely = impc.fit_output_feedback(
            start, senses, counted=round(RATE), max_evaluations=EVALUATIONS
        )
        reason = f"its search did not converge in {likely.evaluations} evaluations"
    except ImpcError as error:
        reason, likely = str(error), None
    if likely is None or not likely.converged:
        return Fit(label, reason=reason, seconds=time.perf_counter() - begun)
    law = controller_for(likely.problem, np.array(likely.K), np.array(likely.S))
    # Without noise; the filter depends on ratios of noise only and stays the same.
    quiet = likely.observer.with_levels(np.array(likely.observer.levels) * QUIET)
    quiet = impc.replace(quiet, walk=QUIET * np.array(senses.walk))

    def run(one: Array) -> Array:
        x0 = np.append(one[0, 1], np.zeros(plant.n - 1))
        return np.clip(simulate_person(law, quiet, one[:, 3], x0=x0).outputs, -FAR, FAR)

    simulated = [run(one) for one in case.test]
    train, test = scored(trials, [run(one) for one in trials]), scored(case.test, simulated)
    return Fit(label, train, test, simulated, {}, likely.doubts, "", time.perf_counter() - begun)


def fitted_case(person: str, kind: str, train: list[Array], test: list[Array]) -> Case:
    """Fit every method to one person and plant."""
    mirrored = [
        any(np.allclose(a[:PERIOD, 3], -b[:PERIOD, 3], atol=1e-9) for b in train) for a in test
    ]
    case = Case(person, kind, train, test, [not one for one in mirrored])
    order = case.order
    # The last periods only, and a few samples: the ramp before them does not repeat
    whole = problem_of([one[-2 * PERIOD - 6 :] for one in test], START[:2], order, free=False)
    top = ceiling(whole, 6 / RATE)
    case.ceiling = None if top is None else np.array([top.vaf, top.low, top.high])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        case.fits.append(fit_delayed("delayed PI", train, case))
        case.fits.append(fit_delayed("delayed PI, fitted to these trials", test, case))
        posed = problem_of(train, START[:2], order, free=True)
        plain = impc.fit(posed)
        free = impc.fit(problem_of(train, START, order, free=True))
        case.fits.append(fit_of("inverse LQR", impc.fit(posed, "inverse_lqr", start=plain), case))
        case.fits.append(fit_of("inverse MPC", plain, case))
        case.fits.append(fit_of("offset-free inverse MPC", free, case))
        delay, lag = np.exp(free.problem.logarithms)[:2] * np.array(START[:2])
        case.fits.append(fit_noisy(case, float(delay), float(lag)))
    case.warned = sorted({str(one.message).splitlines()[0] for one in caught})
    return case


def main(folder: Path) -> None:
    """Fit every person and plant in a folder and write the page."""
    begun = time.perf_counter()
    found, digest = read_trials(folder)
    cases, skipped = [], []
    for (person, kind), trials in sorted(found.items()):
        train, test = ([trials[key] for key in sorted(trials) if key[1] == phase] for phase in "pm")
        print(f"{person} {kind}", flush=True)
        if not train or not test:
            skipped.append(f"{person} {kind} (no trials p or no trials m)")
            continue
        try:
            cases.append(fitted_case(person, kind, train[:TRAINED], test))
        except ImpcError as error:
            skipped.append(f"{person} {kind} ({error})")
    if not cases:
        raise DataError(folder.name, f"nothing was fitted: {'; '.join(skipped)}", "see the list")
    write_page(cases, digest, skipped, time.perf_counter() - begun)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m experiments.steering FOLDER")
    try:
        main(Path(sys.argv[1]))
    except DataError as error:
        sys.exit(f"experiments.steering: {error}")
