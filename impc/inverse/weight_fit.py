"""Fit weights when the user fixes the terminal weight P.

Such a controller has a gain and a metric per stage (docs/why/theory.md), so that no single gain
links recordings and weights: least squares run over the unknowns of a structure (default: all of Q
and R), initial states and offsets. The rank of the derivative at the solution counts the
identified directions.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array
from impc.checking import replace
from impc.control.closed_loop import prepare_loop, run_loop
from impc.control.constraint_rows import directions
from impc.errors import ImpcError, SolverError
from impc.inverse.coordinates import with_own
from impc.inverse.estimates import determined, simulated_estimate
from impc.inverse.gain_search import regulators
from impc.inverse.problem import (
    explains,
    missed,
    scenarios,
    typical_output,
    weights_controller,
)
from impc.inverse.residuals import measured_slope
from impc.inverse.structured_fit import bryson_cost_weights
from impc.model.structure import Structure

if TYPE_CHECKING:
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem

# Random starts per Bryson start, their SD (log cost weight), and how many starts are searched.
_DRAWN, _SPREAD, _SEARCHED = 3, 1.0, 6
# Residual after an infeasible sample over the typical output; relative tolerance of equal costs.
_NOT_REACHED, _SAME = 1e3, 1e-3


def fit_weights(problem: Problem) -> Estimate:
    """Fit the weights for a terminal weight given by the user, from several starts."""
    structure = problem.structure or Structure(problem.plant, "full", "full")
    posed = replace(problem, terminal_set=False, structure=structure)
    loose, first = replace(posed, terminal_weight=None), regulators(problem)[0]
    ladder = np.array(bryson_cost_weights(loose, structure, np.array(first.K), np.array(first.S)))
    drawn = np.random.default_rng(0).normal(scale=_SPREAD, size=(_DRAWN, *ladder.shape))
    own = np.zeros(len(posed.recordings) * posed.own_unknowns)
    starts = [np.concatenate([z, own]) for z in (*ladder, *np.concatenate(ladder + drawn))]
    sizes = [float(np.linalg.norm(_evaluated(posed, structure, y)[0])) for y in starts]
    spent, ends = 0, []
    for index in np.argsort(sizes)[:_SEARCHED]:
        ends.append(_searched(posed, structure, starts[index]))
        spent += ends[-1].nfev
        if explains(posed, float(np.linalg.norm(ends[-1].fun))):
            break
    best = min(ends, key=lambda end: float(end.cost))
    others = [end.cost > (1 + _SAME) * best.cost for end in ends if end is not best]
    z, found = _parted(posed, best.x)
    weights = structure.weights(z)
    law = weights_controller(found, weights)
    shared, apart = np.split(_evaluated(posed, structure, best.x)[1], [len(z)], axis=1)
    left = shared - apart @ np.linalg.lstsq(apart, shared)[0] if apart.size else shared
    values = np.asarray(np.linalg.svd(left, compute_uv=False))
    estimate = simulated_estimate(
        "inverse_mpc",
        found,
        np.array(law.K),
        np.array(law.S),
        noise=float(np.linalg.norm(best.fun)),
        weights=weights,
        evaluations=spent,
        settled=bool(best.success),
        unconfirmed=bool(others) and all(others),
        cost_weights=z,
        rank=int(np.count_nonzero(determined(found, values))),
    )
    estimate = replace(estimate, weights=weights)  # keep the scale of the terminal weight
    if not all(run.complete for run in estimate.simulations):
        raise SolverError(
            "weights",
            "no weights found whose controller can be simulated on all trials",
            "check plant and bounds",
        )
    return estimate


def _parted(problem: Problem, y: Array) -> tuple[Array, Problem]:
    """Split y: unknowns of the structure, and the problem at initial states and offsets."""
    shape = len(problem.recordings), problem.own_unknowns
    z, own = np.split(y, [len(y) - shape[0] * shape[1]])
    return z, with_own(problem, own.reshape(shape))


def _evaluated(problem: Problem, structure: Structure, y: Array) -> tuple[Array, Array]:
    """Residual (r,) and its derivative (r, len(y)) by weights and unknowns of each trial."""
    z, there = _parted(problem, y)
    q, far = len(z), _NOT_REACHED * typical_output(problem)
    count, searched = q + problem.own_unknowns, problem.searched_states
    try:
        law = weights_controller(there, structure.weights(z))
    except ImpcError:  # no Riccati solution in double precision: the search rejects the step
        rows = sum(problem.trial_sizes)
        return np.full(rows, far), np.zeros((rows, len(y)))
    dQ, dR = (
        np.pad(np.moveaxis(part, 0, -1), ((0, 0), (0, 0), (0, count - q)))
        for part in structure.changes(z)
    )
    x0 = np.zeros((problem.plant.n, count))
    x0[:searched, q : q + searched] = np.eye(searched)
    prepared = prepare_loop(law, directions(law, count, Q=dQ, R=dR, x0=x0))
    errors, slopes = [], []
    for trial, drive in zip(there.recordings, scenarios(there), strict=True):
        run, moved = run_loop(prepared, drive, proved=False, seen=there.scaled_outputs)
        error = missed(there, trial, run)
        if not run.complete:
            error[run.reached + 1 :] = far
        errors.append(error.ravel())
        slopes.append(measured_slope(there, trial, moved, q).reshape(-1, count))
    apart = scipy.linalg.block_diag(*(slope[:, q:] for slope in slopes))
    return np.concatenate(errors), np.hstack([np.concatenate(slopes)[:, :q], apart])


def _searched(
    problem: Problem, structure: Structure, begin: Array
) -> scipy.optimize.OptimizeResult:
    """One trust-region search (scipy)."""

    @functools.lru_cache(maxsize=1)  # scipy asks for residual and derivative separately
    def at(y: tuple[float, ...]) -> tuple[Array, Array]:
        return _evaluated(problem, structure, np.array(y))

    def residual(y: Array) -> Array:
        return at(tuple(y))[0]

    def derivative(y: Array) -> Array:
        return at(tuple(y))[1]

    return scipy.optimize.least_squares(
        residual, begin, derivative, x_scale="jac", ftol=1e-10, xtol=1e-12, gtol=None, max_nfev=200
    )
