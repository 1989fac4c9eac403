"""Metrics that weights with a given gain can have, and the one that fits best.

With S = R + B'PB the gain is K = S^-1 B'P A, so S K A^-1 B = B'PB is symmetric: K A^-1 B is
self-adjoint in S (docs/why/theory.md). Its eigenvalues are real and between 0 and 1, and with V its
eigenvectors

    S = V^-T diag(exp d) V^-1,

with one number per input, m - 1 up to scale. S has an effect only at samples with an active bound.
If the inputs outnumber the rank of B, S has a further block:

    B = B V1 V1',   V2 = null(B),   K = (V1 + V2 Y) F,   D = V2 - V1 Y',   C lower triangular,
    S = V1 V^-T diag(exp d) V^-1 V1' + D C C'D'.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from impc.arrays import Array
from impc.inverse.laws import GainLaw
from impc.inverse.problem import Problem
from impc.inverse.residuals import misfit_or_reason, unusable
from impc.inverse.unknowns import linear_at
from impc.model.plant import Plant

# Largest condition number of the eigenvectors, and relative imaginary part that counts as real.
_DEFECTIVE, _REAL = 1e8, 1e-4
# Grid of each d in decades, most points simulated, and starts of a search among them.
_GRID, _MOST, _STARTS = np.linspace(-3, 3, 13), 400, 3
_EVALUATIONS, _FAR = 60, 20.0
# Metric directions below this share of the largest singular value are not identified.
_IDENTIFIED = 1e-8


@dataclass(frozen=True)
class MetricFamily:
    """All metrics that weights with one gain can have."""

    rows: Array  # V^-1 V1' (r, m), rows normalised
    others: Array  # D and V2 (m, e), for inputs beyond the rank of B
    idle: Array

    @property
    def count(self) -> int:
        """Number of unknowns, including the scale of S."""
        extra = self.others.shape[1]
        return len(self.rows) + extra * (extra + 1) // 2

    def metric(self, z: Array) -> Array:
        """S (m, m) at z (count,): d, then C with logarithms of its diagonal."""
        logs, C = self._split(z)
        D = self.others
        return np.asarray((self.rows.T * np.exp(logs)) @ self.rows + D @ C @ C.T @ D.T)

    def changes(self, z: Array) -> Array:
        """Derivatives of S (count, m, m) at `z` (count,)."""
        logs, C = self._split(z)
        D = self.others
        found = [
            size * np.outer(row, row) for size, row in zip(np.exp(logs), self.rows, strict=True)
        ]
        for row, column in zip(*np.tril_indices(len(C)), strict=True):
            unit = C[row, row] if row == column else 1.0
            half = unit * np.outer(D[:, row], D @ C[:, column])
            found.append(half + half.T)
        return np.array(found)

    def nearest(self, metric: Array) -> Array:
        """z (count,) of a `metric` (m, m) in the family, or of a member near it."""
        inverse, extra = np.linalg.inv(metric), self.others.shape[1]
        sizes = np.einsum("ri,ij,rj->r", self.rows, inverse, self.rows)
        square: Array = self.idle.T @ metric @ self.idle
        C: Array = np.asarray(np.linalg.cholesky(square)) if extra else square
        np.fill_diagonal(C, np.log(np.diag(C)))
        return np.concatenate([-np.log(sizes), C[np.tril_indices(extra)]])

    def _split(self, z: Array) -> tuple[Array, Array]:
        extra, rank = self.others.shape[1], len(self.rows)
        C = np.zeros((extra, extra))
        C[np.tril_indices(extra)] = z[rank:]
        np.fill_diagonal(C, np.exp(np.diag(C)))
        return z[:rank], C


def metric_family(plant: Plant, gain: Array) -> MetricFamily | None:
    """Metrics of a gain (m, n); None if it has none, to 1e-4."""
    rank = int(np.linalg.matrix_rank(plant.B))
    directions = np.linalg.svd(plant.B)[2].T
    V1, V2 = directions[:, :rank], directions[:, rank:]
    F = V1.T @ gain
    Y = V2.T @ gain @ np.linalg.pinv(F)
    through = np.linalg.lstsq(plant.A.T, F.T)[0].T @ plant.B @ V1
    values, vectors = np.linalg.eig(through)
    size = float(np.max(np.abs(values), initial=1e-300))
    if np.max(np.abs(values.imag), initial=0.0) > _REAL * size:
        return None
    V = np.real(vectors)
    if np.linalg.cond(V) > _DEFECTIVE:
        return None
    rows = np.linalg.inv(V) @ V1.T
    rows = rows / np.linalg.norm(rows, axis=1)[:, None]
    return MetricFamily(rows, V2 - V1 @ Y.T, V2)


def fitted_metric(
    problem: Problem, gain: Array, family: MetricFamily, near: Array | None = None
) -> Array:
    """Coordinates (count,) of the metric that fits best for a gain (m, n); also tries `near`.

    Grid over the family, then least squares from its best points.
    """
    starts: list[Array] = _grid(family) if family.count > 1 else [np.zeros(family.count)]
    if near is not None:
        starts.insert(0, family.nearest(near))
    tried = []
    for place, z in enumerate(starts):
        size, reason = misfit_or_reason(problem, gain, family.metric(z))
        if not reason:
            tried.append((size, place, z))
    if not tried or family.count == 1:
        return starts[0]
    ends = [_searched(problem, gain, family, z) for _, _, z in sorted(tried)[:_STARTS]]
    return min(ends, key=lambda end: end[0])[1]


def unidentified_metrics(problem: Problem, gain: Array, family: MetricFamily, z: Array) -> Array:
    """Metric at z (count,), then directions (k, m, m) that the recordings do not identify."""
    S, changes = family.metric(z), family.changes(z)
    law = GainLaw(problem, gain, S)
    slopes = linear_at(problem, law, law.start).parts(problem)[0]
    seen = slopes @ law.along(np.zeros((len(changes), *gain.shape)), changes).T
    # SVD of the triangle: that of all samples would need quadratic memory.
    _, values, rows = np.linalg.svd(np.linalg.qr(seen, mode="r"))
    size = float(np.linalg.norm(slopes @ law.along(gain[None], np.zeros((1, *S.shape)))[0]))
    identified = np.count_nonzero(values > _IDENTIFIED * max(size, float(np.max(values))))
    free = np.tensordot(rows[identified:], changes, 1).reshape(-1, S.size)
    # Remove the direction of the scale.
    unit = S.ravel() / np.linalg.norm(S)
    _, sizes, others = np.linalg.svd(free - np.outer(free @ unit, unit), full_matrices=False)
    others = others[sizes > _IDENTIFIED * np.linalg.norm(free, 2)]
    return np.concatenate([S[None], others.reshape(-1, *S.shape)])


def _grid(family: MetricFamily) -> list[Array]:
    """Log ratios to the first number over six decades, least ratios first."""
    extra = family.others.shape[1]
    rows, columns = np.tril_indices(extra)
    logs = np.concatenate(
        [np.arange(1, len(family.rows)), len(family.rows) + np.flatnonzero(rows == columns)]
    )
    if len(_GRID) ** len(logs) <= _MOST:
        ratios = np.array(list(itertools.product(_GRID, repeat=len(logs))))
    else:
        ratios = np.random.default_rng(0).uniform(_GRID[0], _GRID[-1], (_MOST, len(logs)))
    ratios = ratios[np.argsort(np.max(np.abs(ratios), axis=1), kind="stable")]
    found = np.zeros((len(ratios), family.count))
    found[:, logs] = np.log(10.0) * ratios
    return list(found)


def _searched(problem: Problem, gain: Array, family: MetricFamily, z: Array) -> tuple[float, Array]:
    last: dict[bytes, tuple[Array, Array]] = {}

    def at(z: Array) -> tuple[Array, Array]:
        if z.tobytes() not in last:
            last.clear()
            S, changes = family.metric(z), family.changes(z)
            try:
                law = GainLaw(problem, gain, S)
            except np.linalg.LinAlgError:  # singular to rounding: the search rejects the step
                far = unusable(problem, 0, "the metric is singular").residual
                last[z.tobytes()] = far, np.zeros((len(far), len(changes)))
            else:
                found = linear_at(problem, law, law.start)
                along = law.along(np.zeros((len(changes), *gain.shape)), changes)
                last[z.tobytes()] = found.residual, found.parts(problem)[0] @ along.T
        return last[z.tobytes()]

    def residual(z: Array) -> Array:
        return at(z)[0]

    def slope(z: Array) -> Array:
        return at(z)[1]

    bounds = z - _FAR, z + _FAR
    found = scipy.optimize.least_squares(
        residual, z, jac=slope, bounds=bounds, xtol=1e-12, gtol=1e-15, max_nfev=_EVALUATIONS
    )
    return float(found.cost), np.asarray(found.x)
