"""Predict people who steer a cursor: delayed feedback, inverse LQR, and inverse MPC.

    python -m experiments.steering FOLDER [trials]

FOLDER contains trials of Yamagami, Howell, Roth and Burden (CPHS 2018) as <person>_<plant>_<trial>
.csv, plain or inside *_prepared.tar.gz, with columns time (s), y, slider, push at 60 Hz. They are
public and not part of the project. The plant is y' = u + d (fo) or y'' = u + d - y' (so), without
model error. Each method is fitted to the first `trials` (3) trials with phases `p` and simulated on
all trials with phases `m`. The command writes experiments/steering.md and its figure.
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
from pathlib import Path

import control
import numpy as np
import scipy.linalg
import scipy.optimize

import impc
from experiments.steering_page import Case, Fit, write_page
from impc.arrays import Array
from impc.assess.ceiling import ceiling
from impc.errors import ImpcError
from impc.inverse.problem import controller_for
from impc.jit import njit
from impc.output_feedback.simulation import simulate_person
from plants.actuation import pade_delay

RATE, SETTLE, HORIZON, FAR, PERIOD = 60.0, 5.0, 20, 1e3, 1200
#: Budget of likelihood evaluations of the output-feedback fit.
EVALUATIONS = 250
# Scale of the noise in a simulation without noise.
QUIET = 1e-6
#: SHA-256 of the recordings that were prepared for this page.
DIGESTS = {
    "cphs2017_dp_r0_prepared.tar.gz": (
        "58e42cd4f0fb02baf03f482dfcf34a2490ec9c8ba9ea98604c4362c13188298b"
    ),
    "cphs2017_gy_r0_prepared.tar.gz": (
        "f0c40461dea4c24325c026466e6de61e38944fcce04e5aa420adb1fad74e7e91"
    ),
}
_NAME = re.compile(r"([A-Za-z0-9-]+)_(fo|so)_(\w+)([pm])\.csv")


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


def read_trials(folder: Path) -> tuple[dict[tuple[str, str, str], dict[str, Array]], list[str]]:
    """Trials by person, plant and phase, and what was read; ends with one line if there are none.

    Members of archives are read in memory; links and other files are skipped.
    """
    found: dict[tuple[str, str, str], dict[str, Array]] = {}
    sources = []

    def add(name: str, text: bytes) -> None:
        if match := _NAME.fullmatch(name):
            rows = np.loadtxt(io.StringIO(text.decode()), delimiter=",", skiprows=1, ndmin=2)
            if rows.shape[1] != 4 or len(rows) <= 2 * PERIOD or not np.all(np.isfinite(rows)):
                sys.exit(f"{name}: expected 4 columns and over 40 s at 60 Hz; remove the file")
            found.setdefault((match[1], match[2], match[4]), {})[match[3]] = rows

    for file in sorted(folder.glob("*_prepared.tar.gz")):
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        if DIGESTS.get(file.name, digest) != digest:
            sys.exit(f"{file.name}: its SHA-256 differs from that of the page; get the file again")
        known = "digest checked" if file.name in DIGESTS else "no digest known, not checked"
        sources.append(f"{file.name} ({known})")
        with tarfile.open(file) as archive:
            for member in archive:
                stream = archive.extractfile(member) if member.isreg() else None
                if stream is not None:
                    add(Path(member.name).name, stream.read())
    plain = [file for pattern in ("*.csv", "*/*.csv") for file in sorted(folder.glob(pattern))]
    for file in filter(lambda one: _NAME.fullmatch(one.name), plain):
        add(file.name, file.read_bytes())
        sources.append(f"{file.name} (no digest known, not checked)")
    if not found:
        sys.exit(f"{folder.name}: no *_prepared.tar.gz or <person>_<fo|so>_<trial><p|m>.csv there")
    return found, sources


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


def fit_delayed(case: Case, order: int) -> Fit:
    """Least-squares gains and delay of delayed PI (fo) or PID (so) feedback, by shooting on y."""

    def runs(theta: Array, delay: int, trials: list[Array]) -> list[Array]:
        gains = np.append(theta, np.zeros(3 - len(theta)))
        return [_feedback_loop(gains, delay, one[0, 1], one[:, 3].copy(), order) for one in trials]

    def missed(theta: Array, delay: int) -> float:
        pairs = zip(runs(theta, delay, case.train), case.train, strict=True)
        return float(sum(np.sum((run[:, 0] - own[:, 1]) ** 2) for run, own in pairs))

    best: tuple[float, Array, int] = (np.inf, np.zeros(2), 0)
    for delay in range(2, 31):
        for begun in ([1.0, 0.3, 1.0], [3.0, 1.0, 3.0]):
            found = scipy.optimize.minimize(
                missed, begun[: order + 1], (delay,), "Nelder-Mead", options={"maxfev": 300}
            )
            if found.fun < best[0]:
                best = (float(found.fun), found.x, delay)
    theta, delay = best[1:]
    simulated = runs(theta, delay, case.test)
    named = zip(("kp", "ki", "kd"), theta, strict=False)
    values = (*(f"{name} = {value:.2f}" for name, value in named), f"delay {delay / RATE:.2f} s")
    train = scored(case.train, runs(theta, delay, case.train))
    label = "delayed PI" if order == 1 else "delayed PID"
    return Fit(label, train, scored(case.test, simulated), simulated, parameters=values)


def problem_of(trials: list[Array], values: list[float], order: int, *, free: bool) -> impc.Problem:
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


def fit_of(label: str, found: impc.Estimate, case: Case, seconds: float) -> Fit:
    """Simulate a fitted controller from the recorded cursor, with the hand at rest."""
    if found.K is None:
        return Fit(label, np.zeros((0, 2)), np.zeros((0, 2)), reason=found.reason, seconds=seconds)
    law, C = found.controller(), found.problem.plant.C

    def run(one: Array) -> Array:
        x0 = np.append(one[0, 1], np.zeros(law.plant.n - 1))
        moved = law.simulate(x0, disturbance=one[:, 3]).x[: len(one)] @ C.T
        return np.clip(np.nan_to_num(moved, nan=FAR), -FAR, FAR)

    simulated = [run(one) for one in case.test]
    train = scored(case.train, [run(one) for one in case.train])
    test = scored(case.test, simulated)
    rows: tuple[str, ...] = ()
    if found.method == "inverse_mpc":
        try:
            rows = tuple(_worded(name, row) for name, row in found.intervals().iterrows())
        except ImpcError as error:  # Unidentified parameters can leave every possible plant
            rows = (f"intervals are not available ({error})",)
    return Fit(label, train, test, simulated, "", found.doubts, rows, seconds)


def _worded(name: object, row: object) -> str:
    """Value and 95 % interval of a fitted number; "not identified" for a width over a factor 10."""
    value, low, high = (float(getattr(row, part)) for part in ("value", "low", "high"))
    short = str(name).replace("K.command.", "K ")
    narrow = low * high > 0 and max(high / low, low / high) <= 10
    return f"{short} {value:.3g} ({low:.2g} to {high:.2g})" if narrow else f"{short} not identified"


def fit_noisy(case: Case, values: list[float], order: int) -> Fit:
    """Output feedback with sensory noise on one trial, delay (s) and lag (s) fixed at `values`."""
    label, begun = "output feedback", time.perf_counter()
    trials = case.train[:1]
    motor, walk = float(np.std(trials[0][:, 2])), 0.1 * float(np.std(trials[0][:, 3]))
    try:
        start = impc.fit(problem_of(trials, values, order, free=False))
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
        seconds = time.perf_counter() - begun
        return Fit(label, np.zeros((0, 2)), np.zeros((0, 2)), reason=reason, seconds=seconds)
    law = controller_for(likely.problem, np.array(likely.K), np.array(likely.S))
    # Without noise; the filter depends on ratios of noise only and stays the same.
    quiet = likely.observer.with_levels(np.array(likely.observer.levels) * QUIET)
    quiet = impc.replace(quiet, walk=QUIET * np.array(senses.walk))

    def run(one: Array) -> Array:
        x0 = np.append(one[0, 1], np.zeros(plant.n - 1))
        return np.clip(simulate_person(law, quiet, one[:, 3], x0=x0).outputs, -FAR, FAR)

    simulated = [run(one) for one in case.test]
    train, test = scored(trials, [run(one) for one in trials]), scored(case.test, simulated)
    found = zip(likely.observer.names(plant), likely.observer.levels, strict=True)
    levels = tuple(f"{name} {value:.2g}" for name, value in found if value > 0)
    return Fit(
        label, train, test, simulated, "", ("converged",), levels, time.perf_counter() - begun
    )


def fitted_case(person: str, kind: str, train: list[Array], test: list[Array]) -> Case:
    """Fit every method to one person and plant."""
    order = 1 if kind == "fo" else 2
    mirrored = [
        any(np.allclose(a[:PERIOD, 3], -b[:PERIOD, 3], atol=1e-9) for b in train) for a in test
    ]
    # The last periods only, and a few samples: the ramp before them does not repeat
    whole = problem_of([one[-2 * PERIOD - 6 :] for one in test], [0.25, 0.08], order, free=False)
    top = ceiling(whole, 6 / RATE)
    rows = None if top is None else np.array([top.vaf, top.low, top.high])
    case = Case(person, kind, train, test, [not one for one in mirrored], rows, [], ())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        case.fits.append(fit_delayed(case, order))
        posed = problem_of(train, [0.25, 0.08], order, free=True)
        plain = impc.fit(posed)
        classical = impc.fit(posed, "inverse_lqr", start=plain)
        free = impc.fit(problem_of(train, [0.25, 0.08, 1.0], order, free=True))
        case.fits.append(fit_of("inverse LQR", classical, case, classical.seconds))
        case.fits.append(fit_of("inverse MPC", plain, case, plain.seconds))
        case.fits.append(fit_of("offset-free inverse MPC", free, case, free.seconds))
        at = np.exp(free.problem.logarithms)[:2] * np.array([0.25, 0.08])
        case.fits.append(fit_noisy(case, [float(one) for one in at], order))
    said = sorted({str(one.message).splitlines()[0] for one in caught})
    return Case(person, kind, train, test, case.unseen, rows, case.fits, tuple(said))


def main(folder: Path, most: int) -> None:
    """Fit every person and plant in a folder and write the page."""
    begun = time.perf_counter()
    found, sources = read_trials(folder)
    cases, skipped = [], []
    for person, kind in sorted({key[:2] for key in found}):
        parts = [found.get((person, kind, phase), {}) for phase in "pm"]
        train, test = ([one for _, one in sorted(part.items())] for part in parts)
        if not train or not test:
            skipped.append(f"{person} {kind} (no trials p or no trials m)")
            continue
        print(f"{person} {kind}", flush=True)
        try:
            cases.append(fitted_case(person, kind, train[:most], test))
        except ImpcError as error:
            skipped.append(f"{person} {kind} ({error})")
    if not cases:
        sys.exit(f"{folder.name}: nothing was fitted: {'; '.join(skipped)}")
    write_page(cases, sources, skipped, most, time.perf_counter() - begun)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: python -m experiments.steering FOLDER [trials]")
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 3)
