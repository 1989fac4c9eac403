"""Exact recordings, without simulation: the gain of samples that no bound reaches, then the metric.

From a sample at which no bound is met within the horizon the plan is v = 0, so that

    x_{k+1} - A x_k - E d_k  =  -B K x_k

exactly. Such samples come in runs: each run of n tells B K, and how many others follow it shows
whether it was one. The metrics with which that K is consistent are those of m positive factors
(`consistent_pairs`), so that S is a search over m - 1 numbers about a loop that is stable. On exact
recordings of random plants with two and three inputs searches over all of (K, S) end in local
minima where this does not (docs/fitting.md). With noise there is no such run, and no start from
here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array
from impc.consistent_pairs import consistent_metrics, consistent_pair, scaled_changes
from impc.evaluation import evaluate, unusable
from impc.inverse_problem import recorded_size
from impc.lqr import is_stable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.evaluation import Evaluation
    from impc.inverse_problem import InverseProblem

__all__ = ["follows_plant", "quiet_feedback", "quiet_pairs", "recorded_states"]

# Runs looked at, evenly spread.
_MOST = 500
# Of the states: noise that a laboratory would call none is above, rounding in files is below.
_FOLLOWS = 1e-6
# A command this near to its bound, of the largest, counts as at it.
_AT_BOUND = 1e-6
# A run of samples whose states have a larger condition number tells no gain to six digits.
_TELLS = 1e6
# Laws that are tried: of 200 random problems the first was the true one in 191, the second in 6.
_LAWS = 3
# Misfit, of the recorded outputs, at which no other metric is tried; logarithms of the metric's
# factors are looked for this far about their start; evaluations of such a search.
_ENOUGH, _FAR, _BUDGET = 1e-9, 10.0, 30
# Condition number of a metric from which a Cholesky factor is rounding.
_SINGULAR = 1e12


def quiet_pairs(problem: InverseProblem, metrics: Sequence[Array]) -> list[tuple[Array, Array]]:
    """Gains (m, n) that unbounded samples follow, with metrics (m, m) fitted to the recordings.

    Parameters
    ----------
    metrics : sequence of Array
        Where each search for a metric begins; tried in order until one explains the recordings.
    """
    plant, found = problem.plant, []
    for law in quiet_feedback(problem):
        for metric in metrics:
            root = np.linalg.inv(np.linalg.cholesky(metric)).T  # S^-1 = root root'
            # Of the gains with this B K, if there are several, the least in the metric.
            gain = np.asarray(root @ np.linalg.pinv(plant.B @ root) @ law)
            if not is_stable(plant.A - plant.B @ gain, discrete=True):
                continue
            search = _MetricSearch(problem, *consistent_pair(plant, gain, metric))
            found.append((search.gain, search.best()))
            if search.explains:
                return found[-1:]
    return found


def quiet_feedback(problem: InverseProblem) -> list[Array]:
    """B K (n, n) of the gains that many neighbouring samples follow exactly; the most first.

    Empty where the recordings do not follow the plant.
    """
    if not follows_plant(problem):
        return []
    x, moved = _free_samples(problem)
    n, size = problem.plant.n, float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    if len(x) < n or size == 0:
        return []
    first = np.arange(0, len(x) - n + 1, max(1, (len(x) - n + 1) // _MOST))
    runs = first[:, None] + np.arange(n)
    runs = runs[np.linalg.cond(x[runs]) < _TELLS]
    laws = -np.swapaxes(np.linalg.solve(x[runs], moved[runs]), 1, 2)
    wrong = np.linalg.norm(moved + x @ np.swapaxes(laws, 1, 2), axis=2)
    follow = wrong < _FOLLOWS * size
    found: list[Array] = []
    for _ in range(_LAWS):
        if not np.any(follow):
            break
        best = follow[int(np.argmax(np.sum(follow, axis=1)))]
        found.append(-np.linalg.lstsq(x[best], moved[best])[0].T)
        # Other laws of the samples that follow this one are the same again.
        follow = follow & ~best
    return found


def _free_samples(problem: InverseProblem) -> tuple[Array, Array]:
    """States, and what commands that are inside their bounds add to their successors."""
    plant, states = problem.plant, recorded_states(problem)
    assert states is not None  # the recordings follow the plant
    pairs = zip(states, problem.recordings, strict=True)
    rest = [x[1:] - x[:-1] @ plant.A.T - trial.disturbance[:-1] @ plant.E.T for x, trial in pairs]
    x, moved = np.concatenate([item[:-1] for item in states]), np.concatenate(rest)
    if np.linalg.matrix_rank(plant.B) < plant.m:  # the commands are not told
        return x, moved
    commands = moved @ np.linalg.pinv(plant.B).T
    low, high = np.array(problem.bounds.u_min), np.array(problem.bounds.u_max)
    size = _AT_BOUND * np.max(np.abs(commands), axis=0)
    inside = np.all((commands > low + size) & (commands < high - size), axis=1)
    return x[inside], moved[inside]


class _MetricSearch:
    """Least squares over the factors of the metrics with which a gain is consistent."""

    def __init__(self, problem: InverseProblem, gain: Array, metric: Array) -> None:
        self.problem, self.gain, self.metric = problem, gain, metric
        self.rows = consistent_metrics(problem.plant, gain)
        self.last: tuple[bytes, Evaluation] | None = None
        self.explains = False

    def best(self) -> Array:
        """The metric (m, m) found; the given one where there is nothing to search."""
        if self.rows is None:
            return self.metric
        vectors = np.linalg.inv(self.rows)
        start = np.log(np.diag(vectors.T @ self.metric @ vectors))
        if self._at(start).reason:
            return self.metric
        found = scipy.optimize.least_squares(
            lambda logs: self._at(logs).residual,
            start,
            jac=self._derivative,
            bounds=(start - _FAR, start + _FAR),
            xtol=1e-12,
            gtol=1e-15,
            max_nfev=_BUDGET,
        )
        misfit = float(np.linalg.norm(self._at(found.x).residual))
        self.explains = misfit <= _ENOUGH * recorded_size(self.problem)
        return self._metric(found.x)

    def _metric(self, logs: Array) -> Array:
        return np.asarray(self.rows.T * np.exp(logs) @ self.rows)

    def _at(self, logs: Array) -> Evaluation:
        key = logs.tobytes()
        if self.last is None or self.last[0] != key:
            metric = self._metric(logs)
            if np.linalg.cond(metric) > _SINGULAR:
                found = unusable(self.problem, "the metric is singular to working precision")
            else:
                found = evaluate(self.problem, self.gain, metric)
            self.last = key, found
        return self.last[1]

    def _derivative(self, logs: Array) -> Array:
        metric = self._metric(logs)
        changes = np.exp(logs)[:, None, None] * self.rows[:, :, None] * self.rows[:, None, :]
        dS = scaled_changes(metric, changes).reshape(len(logs), -1)
        return np.asarray(self._at(logs).dS.reshape(-1, metric.size) @ dS.T)


def follows_plant(problem: InverseProblem) -> bool:
    """Whether the outputs are states that the plant can follow exactly, by some inputs."""
    plant, states = problem.plant, recorded_states(problem)
    if states is None:
        return False
    left = np.linalg.svd(plant.B)[0][:, np.linalg.matrix_rank(plant.B) :]
    missed, size = 0.0, 0.0
    for x, trial in zip(states, problem.recordings, strict=True):
        rest = x[1:] - x[:-1] @ plant.A.T - trial.disturbance[:-1] @ plant.E.T
        missed += float(np.sum((rest @ left) ** 2))
        size += float(np.sum(x**2))
    return missed <= _FOLLOWS**2 * size


def recorded_states(problem: InverseProblem) -> list[Array] | None:
    """States (samples, n) of each trial, where the outputs determine them."""
    C = problem.plant.C
    if C.shape[0] != C.shape[1] or np.linalg.matrix_rank(C) < len(C):
        return None
    return [
        np.asarray(np.linalg.solve(C, trial.outputs.T).T, dtype=np.float64)
        for trial in problem.recordings
    ]
