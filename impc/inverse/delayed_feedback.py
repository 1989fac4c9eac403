"""Preliminary estimate of the dissertation: gains on a few states, and parameters.

    u = -K_4 x_4,   K = [K_4, 0]                                                         (3.20)
    fitted to the outputs together with the free physical parameters                     (3.19)

without bounds. On the seat x_4 are angles and rates. Delay and muscle states have no gain, so the
model excludes prediction over the delay; the parameters compensate for it as far as they can.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impc.arrays import Array, BoolArray
from impc.errors import InputError, SolverError
from impc.inverse.laws import GainLaw
from impc.inverse.minimiser import PROMISE, Stop
from impc.inverse.problem import Problem
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.solution_set import natural_coordinates
from impc.inverse.starts import regulators
from impc.inverse.unknowns import Unknowns
from impc.model.plant import Plant

_SCALES = np.geomspace(1.0, 1e-3, 25)
_EVALUATIONS = 60


def preliminary_gain(problem: Problem, states: Sequence[str]) -> tuple[Array, Problem]:
    """Fit gains on `states`, initial states and parameters: gain (m, n) and problem."""
    loose = problem.without_bounds()
    names = problem.plant.states
    unknown = [name for name in states if name not in names]
    if unknown or not states:
        raise InputError(
            "[fit] feedback_states",
            f"expected states of the plant, got {unknown or 'none'}",
            f"choose from {list(names)}",
        )
    kept: BoolArray = np.isin(names, states)
    gain, centre = _start(loose, kept)
    basis = _basis(loose.plant, centre, kept)
    law = GainLaw(loose, centre, np.eye(problem.plant.m), basis)
    space = Unknowns(loose, law)
    z = space.start.copy()
    z[space.controller] = law.at_gain(gain)
    found = space.search(z, Stop(PROMISE, 0.0, _EVALUATIONS))
    return np.where(kept, found.K, 0.0), found.problem


def _basis(plant: Plant, gain: Array, kept: BoolArray) -> Array:
    """Gains on the kept states (k, m, n), orthonormal in whitened coordinates of `gain`."""
    T, G = natural_coordinates(plant, gain)
    entries = np.eye(gain.size).reshape(-1, *gain.shape)[np.tile(kept, plant.m)]
    natural, _ = np.linalg.qr(np.linalg.solve(G, entries @ T).reshape(len(entries), -1).T)
    return np.asarray(G @ natural.T.reshape(entries.shape) @ np.linalg.inv(T))


def _start(problem: Problem, kept: BoolArray) -> tuple[Array, Array]:
    """Best multiple of a balanced gain restricted to the kept states, and the full gain."""
    metric = np.eye(problem.plant.m)
    best: tuple[Array, Array] | None = None
    least = np.inf
    for solution in regulators(problem):
        gain: Array = np.asarray(solution.K * kept, dtype=np.float64)
        for scale in _SCALES:
            misfit, reason = misfit_or_reason(problem, scale * gain, metric)
            if not reason and misfit < least:
                best, least = (scale * gain, np.array(solution.K)), misfit
    if best is None:
        raise SolverError(
            "preliminary gain",
            "no gain on these states alone stabilises the plant",
            "choose other states in [fit] feedback_states",
        )
    return best
