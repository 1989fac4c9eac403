"""What the fit of an optimal control problem found, with what its page says of it.

See docs/nonlinear.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Frozen
from impc.inverse.estimates import Status

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.arrays import Array
    from impc.nonlinear.fit import OptimalControlEstimate
    from impc.nonlinear.problem import OptimalControlProblem

#: Recordings that are drawn, the first ones.
MOST_TRIALS = 6
# Of the largest value that a row has: nearer to zero it is at its limit. An active row with a
# multiplier of lam is kept at a distance of 1e-10 / lam.
_AT_LIMIT = 1e-5
_EXACT = 1e-9


@dataclass(frozen=True, eq=False)
class OptimalFit(Frozen):
    """An estimate, and where its recordings come from."""

    estimate: OptimalControlEstimate
    trials: tuple[str, ...]  # A name for each recording
    findings: tuple[tuple[str, ...], ...]  # What the checks of each let pass
    dt: float | None = None  # Sample time, s; None where nobody says it
    # Parameters that were not searched: value and unit
    known: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)  # As the user gave them

    @property
    def status(self) -> Status:
        """How the search ended."""
        estimate = self.estimate
        recorded = [np.hstack([one.x[1:], one.u]) / estimate.scales for one in estimate.recordings]
        size = sum(float(np.nansum(item**2)) for item in recorded)
        if float(estimate.residual @ estimate.residual) <= _EXACT**2 * size:
            return Status.EXPLAINED
        return Status.SETTLED if estimate.settled else Status.STOPPED

    @property
    def names(self) -> tuple[str, ...]:
        """Of the states and the inputs, in this order."""
        problem = self.estimate.problem
        return (*problem.state_names, *problem.input_names)


@dataclass(frozen=True)
class Reached:
    """How often a constraint is at its limit."""

    name: str  # Of the constraint
    samples: int  # Those at which one of its rows is at its limit, and all
    of: int


def signal_vaf(estimate: OptimalControlEstimate) -> dict[str, float]:
    """(3.24) of each state and input over all recordings, %; NaN where nothing was measured."""
    problem = estimate.problem
    recorded = np.vstack([_beside(one.x[1:], one.u) for one in estimate.recordings])
    simulated = np.vstack([_beside(x[1:], u) for x, u in estimate.runs])
    found = {}
    for k, name in enumerate((*problem.state_names, *problem.input_names)):
        kept = np.isfinite(recorded[:, k])
        size = float(np.sum(recorded[kept, k] ** 2))
        left = float(np.sum((recorded[kept, k] - simulated[kept, k]) ** 2))
        found[name] = 100 * (1 - left / size) if size > 0 else np.nan
    return found


def row_name(row: str) -> str:
    """The name of the constraint that a row is of: "force" of "force[0]"."""
    return row.rpartition("[")[0] if row.endswith("]") else row


def reached(estimate: OptimalControlEstimate) -> tuple[Reached, ...]:
    """How often each constraint of the path is at its limit, in the estimate's own runs."""
    problem = estimate.problem
    values = np.vstack([_rows(problem, estimate, index) for index in range(len(estimate.runs))])
    size = np.max(np.abs(values), axis=0, initial=0.0)
    at_limit = values > -_AT_LIMIT * np.where(size > 0, size, 1.0)
    families = [row_name(row) for row in problem.rows]
    return tuple(
        Reached(
            name,
            int(np.count_nonzero(at_limit[:, [item == name for item in families]].any(axis=1))),
            len(values),
        )
        for name in dict.fromkeys(families)
    )


def limits_of(problem: OptimalControlProblem, theta: Array) -> dict[str, list[float]]:
    """Values that a row of the constraints sets to one state or input, by the signal's name.

    A row that is linear in one signal and has no other: its root at theta (p,).
    """
    h = problem.functions[3]
    names = (*problem.state_names, *problem.input_names)
    found: dict[str, list[float]] = {}

    def at(k: int, value: float) -> Array:
        w = np.zeros(len(names))
        w[k] = value
        d = np.zeros(problem.disturbance_count)
        return np.asarray(h(w[: problem.n], w[problem.n :], d, theta).full().ravel())

    depends = np.hstack([_sparsity(h, index) for index in range(3)])
    for row in range(len(problem.rows)):
        involved = np.flatnonzero(depends[row])
        if len(involved) != 1 or involved[0] >= len(names):
            continue
        k = int(involved[0])
        zero, one, three = (float(at(k, value)[row]) for value in (0.0, 1.0, 3.0))
        slope = one - zero
        if slope != 0 and np.isclose(three - zero, 3 * slope, rtol=1e-9):
            found.setdefault(names[k], []).append(-zero / slope)
    return found


def _sparsity(function: Any, index: int) -> Array:
    pattern = function.jac_sparsity(0, index)
    found = np.zeros(pattern.shape)
    rows, columns = pattern.get_triplet()
    found[rows, columns] = 1
    return found


def _beside(x: Array, u: Array) -> Array:
    """States and inputs of one sample in a row."""
    return np.hstack([x, u])


def _rows(problem: OptimalControlProblem, estimate: OptimalControlEstimate, index: int) -> Array:
    """Values of the constraints (steps, q) along a run."""
    (x, u), d = estimate.runs[index], estimate.recordings[index].d
    steps = len(u)
    theta = np.repeat(np.array(list(estimate.theta.values()))[:, None], steps, axis=1)
    values = problem.functions[3].map(steps)(x[:-1].T, u.T, d.T, theta)
    return np.asarray(values.full().T).reshape(steps, len(problem.rows))
