"""Whole fits: one and three trials of W2, a ten times longer one, W1 and a plain script."""

from __future__ import annotations

import numpy as np

from experiments.benchmarks.memory import peak_megabytes
from experiments.benchmarks.peers import casadi_fit, casadi_loop, cvxpy_fit
from experiments.benchmarks.table import Row, compare
from experiments.benchmarks.timing import Timing, side_by_side
from experiments.benchmarks.workloads import example, seat
from experiments.simulated_subjects import noisy_recordings
from impc.arrays import frozen
from impc.checking import replace
from impc.inverse.estimates import Estimate
from impc.inverse.search import refine_gain
from impc.inverse.table31 import inverse_mpc, inverse_mpc_reduced, starting_weights
from impc.model.riccati import solve_lqr
from impc.model.weights import weight_error
from impc.studies.fit.first import FitProgress, first_fits

__all__ = ["fit_rows"]


def fit_rows(runs: int) -> list[Row]:
    """Time the fits; each must reach the true gain, or for W1 the true weights."""
    return [*_seat(runs), *_wrong(runs), *_memory(), *_example(runs)]


def _seat(runs: int) -> list[Row]:
    one, three, long = seat(), seat(trials=3), seat(seconds=300.0)
    loop, quick = casadi_loop(one, "qpoases"), casadi_loop(one, "daqp")
    # From the Table 3.1 start the fit through CasADi ends at another gain.
    true, metric = np.array(one.controller.K), np.array(one.controller.S)
    begin = true * (1 + 0.05 * np.random.default_rng(1).uniform(-1, 1, true.shape))
    if np.linalg.norm(casadi_fit(one, quick, begin) - true) > 1e-4 * np.linalg.norm(true):
        raise AssertionError("the fit through CasADi missed the true gain")
    for work in (one, three, long):
        _check(inverse_mpc_reduced(work.problem), work.controller.K)
    timings = side_by_side(
        {
            "qpoases": lambda: loop(one.controller.K),
            "start": lambda: starting_weights(one.problem),
            "one": lambda: inverse_mpc_reduced(one.problem),
            "search": lambda: refine_gain(one.problem, begin, metric),
            "casadi": lambda: casadi_fit(one, quick, begin),
            "three": lambda: inverse_mpc_reduced(three.problem),
            "long": lambda: inverse_mpc_reduced(long.problem),
        },
        runs,
    )
    unit, own = "one W2 simulation through CasADi conic qpOASES", timings["qpoases"]
    script = "CasADi mapaccum with DAQP under scipy.optimize.least_squares, same start"
    return [
        compare("W2 fit from the Table 3.1 start, one trial", unit, timings["one"], own, 45),
        compare(
            "W2 search from a gain 5 % off, one trial", script, timings["search"], timings["casadi"]
        ),
        compare("the Table 3.1 start itself", unit, timings["start"], own),
        compare("W2 fit, three trials", unit, timings["three"], own, 110),
        compare("W2 fit, 300 s", "W2 fit, 30 s", timings["long"], timings["one"], 10.5),
    ]


def _check(found: Estimate, gain: np.ndarray) -> None:
    if found.weights is None or np.linalg.norm(found.gain - gain) > 1e-6 * np.linalg.norm(gain):
        raise AssertionError(f"the fit missed the true gain: misfit {found.misfit:.3g}")


def _wrong(runs: int) -> list[Row]:
    """Fits of the noisy seat with its tests, and of the same with the push 15 % too small."""
    noisy = noisy_recordings(6.0, 1, 0.99, seconds=15.0)
    right = replace(seat().problem, recordings=noisy, unknown_start=True)
    trials = tuple(
        replace(trial, disturbance=frozen(np.array(trial.disturbance) / 1.15))
        for trial in right.recordings
    )
    wrong = replace(right, recordings=trials)
    found = first_fits(wrong, FitProgress())[4][0]
    if found is None or found.errors[0].name != "scale.perturbation":
        raise AssertionError("the wrong scale was not named")
    timings = side_by_side(
        {
            "right": lambda: first_fits(right, FitProgress()),
            "wrong": lambda: first_fits(wrong, FitProgress()),
        },
        runs,
    )
    what = "W2 fit, noise, a wrong scale of the push, which is named and fitted"
    return [compare(what, "the same recorded right", timings["wrong"], timings["right"])]


def _memory() -> list[Row]:
    empty, short, long = (peak_megabytes("fit", seconds) for seconds in (0, 30, 300))
    million = peak_megabytes("jacobian", 1e4)
    note = f"{empty:.0f} MB of it before the fit"
    both = f"{long:.0f} / {short:.0f} MB"
    return [
        Row("W2 fit, peak memory", "", short, 500, "MB", note),
        Row("W2 fit, 300 s, peak memory", "30 s", long / short, 3, "", both),
        Row("residual + exact Jacobian, 1e6 samples, peak memory", "", million, 1000, "MB", "W2"),
    ]


def _example(runs: int) -> list[Row]:
    work = example()
    start = starting_weights(work.problem)
    for found in (inverse_mpc(work.problem, start), inverse_mpc_reduced(work.problem)):
        if weight_error(found.stage_weights, work.weights) > 1e-6:
            raise AssertionError("W1 missed the true weights")
    timings = side_by_side(
        {
            "direct": lambda: inverse_mpc(work.problem, start),
            "reduced": lambda: inverse_mpc_reduced(work.problem),
        },
        4 * runs,
    )
    weights, simulations = cvxpy_fit(work, start)
    gain, true = (solve_lqr(work.controller.plant, each).K for each in (weights, work.weights))
    slow = side_by_side(
        {
            "direct": lambda: inverse_mpc(work.problem, start),
            "start": lambda: starting_weights(work.problem),
            "script": lambda: cvxpy_fit(work, start),
        },
        3,
    )
    parts = zip(slow["direct"].seconds, slow["start"].seconds, strict=True)
    whole = Timing(tuple(a + b for a, b in parts))
    script = "cvxpy under scipy.optimize.least_squares"
    error = float(np.linalg.norm(gain - true))
    return [
        compare("W1 direct fit", f"{script}, same start", slow["direct"], slow["script"], 1 / 10),
        compare("W1 direct fit with its start", "the same", whole, slow["script"]),
        Row(
            "gain error of cvxpy under least_squares",
            "",
            error,
            note=f"{simulations} simulations; own: < 1e-6",
        ),
        Row("W1 direct fit", "", timings["direct"].median, 0.1, "s"),
        Row("W1 reduced fit", "", timings["reduced"].median, 0.1, "s"),
    ]
