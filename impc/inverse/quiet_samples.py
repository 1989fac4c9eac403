"""Exact recordings, without simulation: the gain of samples that no bound reaches, then the metric.

From a sample at which no bound is met within the horizon the plan is v = 0, so that

    x_{k+1} - A x_k - E d_k  =  -B K x_k

exactly. Any n of them tell B K, and to how many digits others follow it shows whether they were
such: runs of neighbours are tried, since they come in runs, and sets from anywhere. The pairs
(K, S) with that B K that weights have (`consistent_pairs`) are a family of m - 1 numbers, of a few
more when the inputs outnumber the states, about a loop that is stable. A search over the family
has local minima too, but where one over all of (K, S) needs luck with its start, a few metrics to
begin at were enough in random problems (docs/fitting.md). With noise there are no such samples,
and no start from here.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, BoolArray
from impc.inverse.consistent_pairs import scaled_changes
from impc.inverse.problem import recorded_size, recorded_states
from impc.inverse.residuals import evaluate, unusable
from impc.model.riccati import is_stable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation
    from impc.model.plant import Plant

__all__ = ["follows_plant", "has_bounds", "quiet_feedback", "quiet_pairs"]

# Runs looked at, evenly spread, and sets of samples from anywhere, for recordings with short runs.
_MOST, _ANYWHERE = 500, 2000
# Of the states: noise that a laboratory would call none is above, rounding in files is below. Laws
# are ranked by digits from there to rounding: with two states chance ones have more samples, to
# six digits and no more.
_FOLLOWS, _EXACTLY = 1e-6, 1e-12
# A command this near to its bound, of the largest, counts as at it.
_AT_BOUND = 1e-6
# A set of samples whose states have a larger condition number tells no gain to six digits.
_TELLS = 1e6
# Eigenvalues of S^-1 B'PB are real and between 0 and 1, to the digits that a set tells.
_BETWEEN = 1e-6
# Laws that are tried: of 600 random problems the first was the true one in 597, the second in 2.
_LAWS = 3
# Misfit, of the recorded outputs, at which no other metric is tried; how far about their start
# coordinates (logarithms, in part) are looked for; evaluations of a search, which a valley of one
# problem in a hundred needs.
_ENOUGH, _FAR, _BUDGET = 1e-9, 10.0, 300
# Random metrics that are tried after the given ones (seven were needed at most), and what they have
# of the identity.
_RANDOM, _FLOOR = 15, 0.1
# Condition number from which eigenvectors tell no metric: two eigenvalues are the same but for
# rounding.
_DEFECTIVE = 1e6
# Condition number of a metric from which a Cholesky factor is rounding.
_SINGULAR = 1e12


def quiet_pairs(problem: Problem, metrics: Sequence[Array]) -> list[tuple[Array, Array]]:
    """Gains (m, n) that unbounded samples follow, with metrics (m, m) fitted to the recordings.

    Parameters
    ----------
    metrics : sequence of Array
        (m, m) each: where a search for a metric begins; random ones follow. They are tried until
        one explains the recordings, and then it is the only answer. Without bounds no metric
        shows, and the first stands for all.

    Returns
    -------
    list of (Array, Array)
        (K, S), (m, n) and (m, m) each.
    """
    plant, found = problem.plant, []
    laws = [W for W in quiet_feedback(problem) if is_stable(plant.A - W, discrete=True)]
    if not laws:
        return []
    tried = [*metrics, *_random_metrics(problem)] if has_bounds(problem) else metrics[:1]
    for law, metric in itertools.product(laws, tried):
        pair = _Pairs(problem, law, metric).search()
        if pair is None:
            continue
        found.append(pair[:2])
        if pair[2]:
            return found[-1:]
    return found


def _random_metrics(problem: Problem) -> list[Array]:
    """Metrics (m, m) of all shapes, in units of the recorded commands: the same at every call."""
    _, moved = _free_samples(problem)
    size = np.sqrt(np.mean((moved @ np.linalg.pinv(problem.plant.B).T) ** 2, axis=0))
    unit = np.diag(1 / np.where(size > 0, size, 1.0))
    factors = unit @ np.random.default_rng(0).standard_normal((_RANDOM, *unit.shape))
    return list(factors @ np.swapaxes(factors, 1, 2) + _FLOOR * unit**2)


def quiet_feedback(problem: Problem) -> list[Array]:
    """B K (n, n) of the gains that many samples follow to most digits; the best first.

    Empty where the recordings do not follow the plant.
    """
    if not follows_plant(problem):
        return []
    x, moved = _free_samples(problem)
    n = problem.plant.n
    if len(x) < n or not np.any(moved):
        return []
    sets = _sets(len(x), n)
    sets = sets[np.linalg.cond(x[sets]) < _TELLS]
    laws = -np.swapaxes(np.linalg.solve(x[sets], moved[sets]), 1, 2)
    laws = laws[_can_be_of_weights(problem.plant, laws)]
    wrong = [np.linalg.norm(moved + x @ law.T, axis=1) for law in laws]
    size = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    share = np.array(wrong).reshape(-1, len(x)) / size
    digits = np.log10(_FOLLOWS / np.clip(share, _EXACTLY, _FOLLOWS))
    found: list[Array] = []
    for _ in range(_LAWS):
        if not np.any(digits):
            break
        best = digits[int(np.argmax(np.sum(digits, axis=1)))] > 0
        found.append(-np.linalg.lstsq(x[best], moved[best])[0].T)
        # Other laws of the samples that follow this one are the same again.
        digits = digits * ~best
    return found


def _sets(count: int, n: int) -> Array:
    """Runs of n of so many samples, and n from anywhere: the same at every call."""
    first = np.arange(0, count - n + 1, max(1, (count - n + 1) // _MOST))
    anywhere = np.random.default_rng(0).integers(count, size=(_ANYWHERE, n))
    return np.concatenate([first[:, None] + np.arange(n), anywhere])


def _can_be_of_weights(plant: Plant, laws: Array) -> BoolArray:
    """Which of the laws B K (k, n, n) leave W A^-1 = B S^-1 B'P the eigenvalues that it has.

    They are those of S^-1 B'PB where S = R + B'PB. Where A is singular, all laws pass.
    """
    if np.linalg.matrix_rank(plant.A) < plant.n:
        return np.full(len(laws), fill_value=True)
    basis = scipy.linalg.orth(plant.B)
    values = np.linalg.eigvals(basis.T @ laws @ np.linalg.solve(plant.A, basis))
    within = (values.real > -_BETWEEN) & (values.real < 1 + _BETWEEN)
    return np.asarray(np.all(within & (np.abs(values.imag) < _BETWEEN), axis=1))


def _free_samples(problem: Problem) -> tuple[Array, Array]:
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


class _Pairs:
    """All consistent pairs with a given feedback B K = W, about a first metric.

    With r the rank of B, B V1 of full column rank and B V2 = 0, they are

        K = (V1 + V2 Y) (B V1)^+ W,    S = sum_i exp(s_i) w_i'w_i + D C C'D',   D = V2 - V1 Y',

    w_i being the left eigenvectors of (B V1)^+ W A^-1 B V1, which is the inverse of a positive
    definite matrix times a symmetric one. V2, Y and C, a Cholesky factor with the logarithm of its
    diagonal, are there with more inputs than states only.
    """

    def __init__(self, problem: Problem, law: Array, metric: Array) -> None:
        self.problem, plant = problem, problem.plant
        rank = int(np.linalg.matrix_rank(plant.B))
        V = np.linalg.svd(plant.B)[2].T
        self.V1, self.V2 = V[:, :rank], V[:, rank:]
        self.feedback = np.linalg.pinv(plant.B @ self.V1) @ law
        through = np.linalg.lstsq(plant.A.T, self.feedback.T)[0].T @ plant.B @ self.V1
        values, vectors = np.linalg.eig(through)
        self.usable = not np.iscomplexobj(values) and np.linalg.cond(vectors) < _DEFECTIVE
        self.last: tuple[bytes, Evaluation] | None = None
        if self.usable:
            self.rows = np.linalg.inv(vectors)
            self.start = self._coordinates(metric, vectors)

    def search(self) -> tuple[Array, Array, bool] | None:
        """Least squares: K, S and whether they explain the recordings; None without a start."""
        if not self.usable or self._at(self.start).reason:
            return None
        found = scipy.optimize.least_squares(
            self._residual,
            self.start,
            jac=self._derivative,
            bounds=(self.start - _FAR, self.start + _FAR),
            xtol=1e-12,
            gtol=1e-15,
            max_nfev=_BUDGET,
        )
        misfit = float(np.linalg.norm(self._at(found.x).residual))
        return *self._pair(found.x), misfit <= _ENOUGH * recorded_size(self.problem)

    def _coordinates(self, metric: Array, vectors: Array) -> Array:
        """Those of a pair near a metric: exactly its own where that is consistent."""
        inverse = np.linalg.inv(metric)
        inner = np.linalg.inv(self.V1.T @ inverse @ self.V1)
        logs = np.log(np.diag(vectors.T @ inner @ vectors))
        Y = self.V2.T @ inverse @ self.V1 @ inner
        C = np.linalg.cholesky(self.V2.T @ metric @ self.V2) if self.V2.size else self.V2.T[:, :0]
        np.fill_diagonal(C, np.log(np.diag(C)))
        return np.concatenate([logs, Y.ravel(), C[np.tril_indices(len(C))]])

    def _parts(self, z: Array) -> tuple[Array, Array, Array]:
        """exp(s), Y and C."""
        extra, rank = self.V2.shape[1], self.V1.shape[1]
        logs, flat, entries = np.split(z, [rank, rank + extra * rank])
        C = np.zeros((extra, extra))
        C[np.tril_indices(extra)] = entries
        np.fill_diagonal(C, np.exp(np.diag(C)))
        return np.exp(logs), flat.reshape(extra, rank), C

    def _pair(self, z: Array) -> tuple[Array, Array]:
        factors, Y, C = self._parts(z)
        W, D = self.rows @ self.V1.T, self.V2 - self.V1 @ Y.T
        return (self.V1 + self.V2 @ Y) @ self.feedback, W.T * factors @ W + D @ C @ C.T @ D.T

    def _at(self, z: Array) -> Evaluation:
        key = z.tobytes()
        if self.last is None or self.last[0] != key:
            gain, metric = self._pair(z)
            if np.linalg.cond(metric) > _SINGULAR:
                found = unusable(self.problem, "the metric is singular to working precision")
            else:
                found = evaluate(self.problem, gain, metric)
            self.last = key, found
        return self.last[1]

    def _residual(self, z: Array) -> Array:
        return self._at(z).residual

    def _derivative(self, z: Array) -> Array:
        factors, Y, C = self._parts(z)
        W, D = self.rows @ self.V1.T, self.V2 - self.V1 @ Y.T
        none = np.zeros((len(self.V1), self.problem.plant.n))
        changes = [(none, x * np.outer(w, w)) for x, w in zip(factors, W, strict=True)]
        for row, column in np.ndindex(Y.shape):
            dK = np.outer(self.V2[:, row], self.feedback[column])
            half = -np.outer(self.V1[:, column], (C @ C.T @ D.T)[row])
            changes.append((dK, half + half.T))
        for row, column in zip(*np.tril_indices(len(C)), strict=True):
            unit = C[row, row] if row == column else 1.0
            half = unit * np.outer(D[:, row], (D @ C)[:, column])
            changes.append((none, half + half.T))
        dS = scaled_changes(self._pair(z)[1], np.array([change for _, change in changes]))
        dK = np.array([change for change, _ in changes])
        found, count = self._at(z), len(z)
        on_gain = found.dK.reshape(len(found.residual), -1) @ dK.reshape(count, -1).T
        return np.asarray(on_gain + found.dS.reshape(len(on_gain), -1) @ dS.reshape(count, -1).T)


def has_bounds(problem: Problem) -> bool:
    """Whether any input or state has a bound; the metric shows through bounds only."""
    bounds = problem.bounds
    every = np.concatenate([bounds.u_min, bounds.u_max, bounds.x_min, bounds.x_max])
    return bool(np.any(np.isfinite(every)))


def follows_plant(problem: Problem) -> bool:
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
