"""Inverse MPC against inverse LQR over the share of samples at the limit.

A controller with known weights drives a plant under random pushes. For every seed and level, the
limit is the largest with which that share of the samples is at it. All methods then identify the
gain under four conditions: exact, noisy, a wrong limit, and a wrong plant (both with noise).

The error of a gain is |(K - K_true) x| / |K_true x| over the true states x of the recording: that
of the command without limit, whatever the units of the states. At each level, a one-sided sign test
over the seeds compares the errors of two methods; Holm's correction is over the levels.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import control
import numpy as np
import pandas as pd
import scipy.stats

from impc.arrays import Array, Frozen
from impc.assess.several_tests import holm
from impc.assess.variance_accounted_for import saturated_share
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import Simulation, scenario
from impc.errors import ImpcError, SolverError
from impc.files.digests import digest, versions
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS, fit
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.studies.cache import Cache
from impc.studies.pool import Pool, Task, run

#: Shares of samples at the limit, %.
LEVELS = (0, 10, 20, 40, 60)
#: Conditions by name, with the title of their panels.
CONDITIONS = {
    "exact": "Exact recordings",
    "noise": "Noise of 5 %",
    "limit": "Limit 20 % too low, noise",
    "plant": "Plant 10 % wrong, noise",
}
#: The methods, inverse MPC first.
SWEPT = ("inverse_mpc", "inverse_lqr_output", "inverse_lqr_gradient", "inverse_lqr_lmi")
#: Corrected p-value from which inverse LQR is said to be biased.
SIGNIFICANT = 0.05
# Difference of two errors that counts as none, percentage points.
_SAME = 0.01
# SD of the noise over the root mean square of each output; limit and effect of the command in the
# wrong models, relative to the true ones (a mass that is 10 % too large).
_NOISE, _LIMIT, _EFFECT = 0.05, 0.8, 1 / 1.1
# Step between the limits that are tried, relative to the largest command without a limit; smallest.
_STEP, _LEAST = 0.02, 0.2
# Largest difference from the level; largest excursion relative to that without a limit; pushes that
# are tried: an unstable plant may leave every reasonable range before the level is reached.
_NEAR, _FAR, _PUSHES = 0.05, 5.0, 40


@dataclass(frozen=True)
class Setup(Frozen):
    """The simulated loop: plant with one push, true weights, horizon and recording."""

    plant: Plant
    weights: Weights
    horizon: int
    samples: int
    hold: int  # Samples for which a push is held
    amplitude: float  # Of the pushes, which are -1, 0 or 1 times it


def pushed(plant: Plant) -> Plant:
    """The plant with a push that acts as its commands do."""
    both, names = np.hstack([plant.B, plant.B]), [f"push_{name}" for name in plant.controls]
    system = control.ss(
        plant.A, both, plant.C, 0, plant.dt, states=list(plant.states),
        inputs=[*plant.controls, *names], outputs=list(plant.outputs),
    )  # fmt: skip
    return Plant(system, list(plant.controls))


def recorded(setup: Setup, level: float, seed: int) -> tuple[Controller, Simulation, Array]:
    """Controller, its exact run with a share `level` (%) of samples at the limit, and the push."""
    for attempt in range(_PUSHES):
        push = _push(setup, np.random.default_rng([seed, attempt]))
        law, free = _driven(setup, np.inf, push)
        size = np.max(np.abs(free.x @ law.plant.C.T), axis=0)
        for part in (2.0,) if level == 0 else np.arange(1.0, _LEAST, -_STEP):
            law, run = _driven(setup, part * np.max(np.abs(free.u)), push)
            motion = np.max(np.abs(run.x @ law.plant.C.T), axis=0)
            beyond = _share(law, run) - level / 100
            if not run.complete or np.any(motion > _FAR * size) or beyond > _NEAR:
                break
            if beyond >= -_STEP:
                return law, run, push
    raise SolverError("sweep", f"no limit is reached in {level:g} % of the samples", "change seeds")


def _push(setup: Setup, rng: np.random.Generator) -> Array:
    steps, signals = -(-setup.samples // setup.hold), setup.plant.E.shape[1]
    values = setup.amplitude * rng.choice([-1.0, 0.0, 1.0], (steps, signals))
    return np.repeat(values, setup.hold, axis=0)[: setup.samples]


def _driven(setup: Setup, limit: float, push: Array) -> tuple[Controller, Simulation]:
    plant, bounds = setup.plant, Bounds(setup.plant, u_min=-limit, u_max=limit)
    law = Controller(plant, setup.weights, bounds, setup.horizon, terminal_set=False)
    return law, simulate(law, scenario(plant, np.zeros(plant.n), disturbance=push))


def _share(law: Controller, run: Simulation) -> float:
    return saturated_share(run.u, np.array(law.bounds.u_min), np.array(law.bounds.u_max))


def posed(
    law: Controller, run: Simulation, push: Array, condition: str, rng: np.random.Generator
) -> Problem:
    """The inverse problem of a run under a condition."""
    plant, limit, outputs = law.plant, np.array(law.bounds.u_max), run.x @ law.plant.C.T
    if condition != "exact":
        size = _NOISE * np.sqrt(np.mean(outputs**2, axis=0))
        outputs = outputs + size * rng.standard_normal(outputs.shape)
    if condition == "limit":
        limit = _LIMIT * limit
    if condition == "plant":
        plant = replace(plant, B=_EFFECT * plant.B)
    trial = Recording(plant, outputs, np.vstack([push, np.zeros_like(push[:1])]))
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    return Problem(plant, bounds, law.horizon, (trial,), terminal_set=False)


def fit_cell(setup: Setup, condition: str, level: float, seed: int) -> list[dict[str, Any]]:
    """Errors of all methods on one recording, one row per method; a task of the pool."""
    law, run, push = recorded(setup, level, seed)
    problem = posed(law, run, push, condition, np.random.default_rng([seed, 1]))
    true, size = run.x @ law.K.T, np.linalg.norm(run.x @ law.K.T)
    found: dict[str, Estimate] = {}
    failed = ""
    try:
        start = fit(problem)
        found = {name: METHODS[name].estimate(problem, start) for name in SWEPT[1:]}
        found[SWEPT[0]] = start
    except ImpcError as reason:  # no start can be simulated: no method has one
        failed = str(reason)
    rows = []
    for name in SWEPT:
        K = found[name].K if name in found else None
        error = np.nan if K is None else 100 * np.linalg.norm(run.x @ K.T - true) / size
        rows.append({
            "condition": condition, "level_percent": level, "seed": seed,
            "at_limit_percent": 100 * _share(law, run), "method": name,
            "error_percent": float(error),
            "reason": failed or (found[name].reason if K is None else ""),
        })  # fmt: skip
    return rows


@dataclass(frozen=True)
class Sweep:
    """Results of a sweep."""

    fits: pd.DataFrame  # One row per fit, see `fit_cell`
    failures: tuple[str, ...]  # Cells without a recording


def run_sweep(
    setup: Setup,
    seeds: int,
    pool: Pool,
    cache: Cache,
    done: Callable[..., None] = lambda _, *, found: None,
    levels: Sequence[int] = LEVELS,
) -> Sweep:
    """Fit all cells; `done` hears the title of each, and whether it was stored."""
    plant, weights = setup.plant, setup.weights
    loop = (plant.A, plant.B, plant.E, plant.C, weights.Q, weights.R, setup.horizon)
    seal = digest(loop, (setup.samples, setup.hold, setup.amplitude), versions())
    cells = list(itertools.product(range(seeds), levels, CONDITIONS))
    queue = deque(
        Task(f"{condition}-{level}-{seed}", seal, fit_cell, (setup, condition, level, seed))
        for seed, level, condition in cells
    )
    rows: dict[str, list[dict[str, Any]]] = {}
    names, failures = [task.name for task in queue], {}
    for result in run(pool, queue, cache):
        if result.fault is None:
            rows[result.task.name] = result.content
        else:
            failures[result.task.name] = f"{result.task.name}: {result.fault}"
        done(result.task.name, found=result.found)
    table = pd.DataFrame([row for name in names for row in rows.get(name, [])])
    failed = tuple(failures[name] for name in names if name in failures)
    return Sweep(table.astype({"error_percent": float}) if len(table) else table, failed)


def compared(fits: pd.DataFrame) -> pd.DataFrame:
    """Each inverse LQR method against inverse MPC, one row per condition, method and level.

    Columns: median errors, median of the paired difference with a distribution-free interval (at
    least 95 %), seeds with a larger error, one-sided p of the sign test, and p_holm over levels.
    A fit of inverse MPC without a gain counts as worse; one of inverse LQR is left out. Differences
    of up to 0.01 percentage points are ties.
    """
    rows, index = list[dict[str, Any]](), ["condition", "level_percent", "seed"]
    wide = fits.pivot_table("error_percent", index, "method", dropna=False, sort=False)
    for condition, method in itertools.product(CONDITIONS, SWEPT[1:]):
        tested = [
            {"condition": condition, "method": method, "level_percent": level}
            | _tested(cell[SWEPT[0]].to_numpy(), cell[method].to_numpy())
            for level, cell in wide.loc[condition].groupby(level="level_percent")
        ]
        corrected = holm(np.array([row["p"] for row in tested]))
        rows += [row | {"p_holm": float(p)} for row, p in zip(tested, corrected, strict=True)]
    return pd.DataFrame(rows)


def _tested(ours: Array, theirs: Array) -> dict[str, Any]:
    """Medians, paired difference and sign test of the errors of inverse MPC and inverse LQR."""
    known = ~np.isnan(theirs)
    ours, theirs = np.where(np.isnan(ours), np.inf, ours), theirs[known]
    apart = np.sort(theirs - ours[known])
    larger, differ = int(np.sum(apart > _SAME)), int(np.sum(np.abs(apart) > _SAME))
    low, high = median_interval(apart)
    return {
        "inverse_mpc_percent": float(np.median(ours)),
        "inverse_lqr_percent": float(np.median(theirs)) if len(theirs) else np.nan,
        "difference": float(np.median(apart)) if len(theirs) else np.nan,
        "low": low, "high": high, "fits": len(theirs), "larger": larger,
        "p": float(scipy.stats.binomtest(larger, differ, 0.5, "greater").pvalue) if differ else 1.0,
    }  # fmt: skip


def median_interval(ordered: Array, level: float = 0.95) -> tuple[float, float]:
    """Distribution-free interval of the median of sorted values; NaN if there are too few."""
    rank = int(scipy.stats.binom.ppf((1 - level) / 2, len(ordered), 0.5)) if len(ordered) else 0
    return (ordered[rank - 1], ordered[-rank]) if rank else (np.nan, np.nan)


def biased_from(tests: pd.DataFrame, condition: str, method: str) -> pd.Series[Any] | None:
    """Row of the least level from which, at every higher one too, inverse LQR is worse."""
    own = tests[(tests["condition"] == condition) & (tests["method"] == method)]
    worse = (own["p_holm"] < SIGNIFICANT).to_numpy()
    first = len(worse) - int(np.argmin(worse[::-1])) if not worse.all() else 0
    return None if first == len(worse) else own.iloc[first]
