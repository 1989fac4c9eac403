"""The dissertation's preliminary estimate: gains on a few states, and physical parameters.

    u = -K_4 x_4,   K = [K_4, 0]                                                         (3.20)
    fitted to the outputs together with the free physical parameters                     (3.19)

without bounds. On the seat x_4 are angles and rates; delay and muscle get no gain, so a person who
predicts over the delay is not in this family, and the parameters make up for it as far as they can.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.errors import InputError, SolverError
from impc.inverse.coordinates import start_unit
from impc.inverse.diagonal_start import bryson_regulators
from impc.inverse.residuals import evaluate, misfit_or_reason

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.problem import Problem

__all__ = ["PreliminaryGain", "preliminary_gain"]

_SCALES = np.geomspace(1.0, 1e-3, 25)
_PARAMETER_UNIT = 1 / 3


@dataclass(frozen=True)
class PreliminaryGain(Frozen):
    """Result of `preliminary_gain`.

    Attributes
    ----------
    K : Array
        (m, n), zero outside the chosen states.
    problem : Problem
        Without bounds, at the initial states and parameters found.
    misfit : float
        2-norm of the scaled residual.
    """

    K: Array
    problem: Problem
    misfit: float


def preliminary_gain(problem: Problem, states: Sequence[str]) -> PreliminaryGain:
    """Fit gains on some states, with initial states and physical parameters, without bounds.

    From the gains of Bryson's regulators on those states, at the scale at which they fit best.

    Raises
    ------
    InputError
        When a state is unknown.
    SolverError
        When no gain of that form that stabilises the plant was found.
    """
    loose = problem.without_bounds()
    names = problem.plant.states
    unknown = [name for name in states if name not in names]
    if unknown or not states:
        raise InputError(
            "[fit] feedback_states", f"{unknown or 'is empty'}", f"known: {list(names)}"
        )
    kept: BoolArray = np.isin(names, states)
    search = _Search(loose, kept, _start(loose, kept))
    found = scipy.optimize.least_squares(
        search.residual, search.start, jac=search.derivative, x_scale="jac", ftol=1e-8, max_nfev=60
    )
    K, here = search.unpack(found.x)
    misfit = float(np.linalg.norm(evaluate(here, K, np.eye(problem.plant.m)).residual))
    return PreliminaryGain(frozen(K), here, misfit)


def _start(problem: Problem, kept: BoolArray) -> Array:
    """The best stabilising multiple of a Bryson regulator's gains on the kept states."""
    metric = np.eye(problem.plant.m)
    best: Array | None = None
    least = np.inf
    for _, solution in bryson_regulators(problem):
        gain: Array = np.asarray(solution.K * kept, dtype=np.float64)
        for scale in _SCALES:
            misfit, reason = misfit_or_reason(problem, scale * gain, metric)
            if not reason and misfit < least:
                best, least = scale * gain, misfit
    if best is None:
        raise SolverError(
            "preliminary gain",
            "no gain on these states alone stabilises the plant",
            "choose others in [fit] feedback_states",
        )
    return best


class _Search:
    """Unknowns: kept entries of K over their start, initial states, logarithms of parameters."""

    def __init__(self, problem: Problem, kept: BoolArray, start: Array) -> None:
        self.problem, self.gain = problem, start
        self.at_entry = np.flatnonzero(np.tile(kept, problem.plant.m))
        self.unit = start_unit(problem, start)
        self.trials = len(problem.recordings) if problem.unknown_start else 0
        self.n = problem.plant.n
        sizes = (len(self.at_entry), self.trials * self.n, len(problem.logarithms))
        self.ends = np.cumsum(sizes)
        self.start = np.zeros(int(self.ends[-1]))
        size = np.abs(np.ravel(start)[self.at_entry])
        self.scale = np.maximum(size, 1e-3 * np.max(size))

    def unpack(self, z: Array) -> tuple[Array, Problem]:
        entries, starts, logarithms = np.split(z, self.ends[:-1])
        gain = self.gain.copy()
        gain.ravel()[self.at_entry] += entries * self.scale
        x0 = np.array([trial.x0 for trial in self.problem.recordings])
        if self.trials:
            x0 = x0 + starts.reshape(self.trials, self.n) @ self.unit.T
        here = self.problem.logarithms + _PARAMETER_UNIT * logarithms
        return gain, self.problem.at(x0, here)

    def residual(self, z: Array) -> Array:
        gain, problem = self.unpack(z)
        return evaluate(problem, gain, np.eye(problem.plant.m)).residual

    def derivative(self, z: Array) -> Array:
        gain, problem = self.unpack(z)
        found = evaluate(problem, gain, np.eye(problem.plant.m))
        rows = len(found.residual)
        columns = [found.dK.reshape(rows, -1)[:, self.at_entry] * self.scale]
        first = 0
        for trial in problem.recordings[: self.trials]:
            mine = slice(first, first + trial.outputs.size)
            first = mine.stop
            block = np.zeros((rows, self.n))
            block[mine] = found.dx0[mine] @ self.unit
            columns.append(block)
        columns.append(found.dparameters * _PARAMETER_UNIT)
        return np.hstack(columns)
