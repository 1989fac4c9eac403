"""Draw gains within the uncertainty of the fit.

Each drawn gain is that of weights X = L exp(D) L', where LL' = blkdiag(Q, R) is the fit:

    log p(D) = -1/2 sum_i (d_i' vec(G^-1 (K(X) - K) T) / s_i)^2 - 1/2 |D|^2 / ln(10)^2 + const

K is the estimate (`gain_estimate`), d_i, s_i, G and T those of its `GainCovariance`; the second
term limits unidentified directions to weights of the same order of magnitude. Sampling is
elliptical slice sampling (Murray, Adams and MacKay 2010) about the linearised posterior, so that
the curvature of K(X) counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.errors import WeightsError
from impc.inverse.proximal_step import block_basis
from impc.inverse.solution_set import split_blocks
from impc.model.riccati import gain_gradients, solve_lqr

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.assess.covariance import GainCovariance
    from impc.model.plant import Plant
    from impc.model.riccati import LqrSolution
    from impc.model.weights import Weights

#: Number of draws whose range is a 95 % interval.
DRAWS = 39
# Prior SD of log weights: a factor of ten.
_DECADE = np.log(10.0)
# Sampler steps between two draws.
_STEPS = 6
# Least standard error in whitened units: exact data are limited by rounding and search.
_SHARPEST = 1e-6


def drawn_gains(
    plant: Plant,
    weights: Weights,
    gain: Array,
    covariance: GainCovariance,
    count: int = DRAWS,
) -> tuple[LqrSolution, ...]:
    """Regulators with gains within the uncertainty of `gain` (m, n)."""
    rng = np.random.default_rng(0)
    n = plant.n
    factor: Array = np.asarray(np.linalg.cholesky(weights.block), dtype=np.float64)
    centre = solve_lqr(plant, weights)
    deviations = np.maximum(np.array(covariance.deviations), _SHARPEST)
    basis, left, values = _directions(centre, factor, covariance, deviations)
    spread = 1 / np.sqrt(values**2 + 1 / _DECADE**2)
    # The linearised posterior has its mean at the weights nearest to the estimate.
    wrong = covariance.along(centre.K - gain) / deviations
    mean = -spread * values * (left.T @ wrong)[: len(values)]

    def regulator(a: Array) -> LqrSolution:
        step = np.tensordot((mean + a) * spread, basis, 1)
        return solve_lqr(plant, split_blocks(factor @ scipy.linalg.expm(step) @ factor.T, n))

    def excess(a: Array) -> float:
        """Log density relative to the linearised posterior, in which a ~ N(0, I)."""
        try:
            K = regulator(a).K
        except WeightsError:
            return -np.inf
        off, far = covariance.along(K - gain) / deviations, (mean + a) * spread / _DECADE
        return float(a @ a - off @ off - far @ far) / 2

    a: Array = np.zeros(len(spread))
    here = excess(a)
    drawn = []
    for _ in range(count):
        for _ in range(_STEPS):
            a, here = _slice(a, here, excess, rng)
        drawn.append(regulator(a))
    return tuple(drawn)


def _directions(
    centre: LqrSolution, factor: Array, covariance: GainCovariance, deviations: Array
) -> tuple[Array, Array, Array]:
    """Steps D that move the gain (k, n + m, n + m), left singular vectors, singular values."""
    n, m = centre.plant.n, centre.plant.m
    basis = block_basis(n, m)
    moved = factor @ basis @ factor.T
    slopes = gain_gradients(centre)
    dK = np.einsum("abij,kij->kab", slopes.Q, moved[:, :n, :n])
    dK += np.einsum("abij,kij->kab", slopes.R, moved[:, n:, n:])
    derivative = np.array([covariance.along(one) for one in dK]).T
    # Steps that keep the gain are covered by the set of weights.
    _, _, moving = np.linalg.svd(derivative, full_matrices=False)
    left, values, rows = np.linalg.svd(derivative @ moving.T / deviations[:, None])
    return np.tensordot(rows, np.tensordot(moving, basis, 1), 1), left, values


def _slice(
    a: Array, here: float, excess: Callable[[Array], float], rng: np.random.Generator
) -> tuple[Array, float]:
    """One step of elliptical slice sampling from N(0, I) exp(excess); `here` is excess(a)."""
    other = rng.standard_normal(len(a))
    level = here + np.log(rng.uniform())
    angle = rng.uniform(0, 2 * np.pi)
    low, high = angle - 2 * np.pi, angle
    while True:
        moved = a * np.cos(angle) + other * np.sin(angle)
        there = excess(moved)
        if high - low < 1e-9:
            return a, here
        if there > level:
            return moved, there
        low, high = (angle, high) if angle < 0 else (low, angle)
        angle = rng.uniform(low, high)
