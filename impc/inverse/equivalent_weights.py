"""Choose one pair of weights among all that have a given gain.

The positive definite members of the linear space `gain_fibre` are the weights with that gain. Three
choices: the largest definiteness margin, the least condition number, and the analytic centre. Only
the second depends on the units of states and inputs (docs/why/equivalent_weights.md).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from impc.arrays import Array, Frozen
from impc.checking import checked
from impc.errors import SolverError, WeightsError
from impc.inverse.semidefinite import (
    Cone,
    matrix_inequality,
    norm_bound,
    solve_semidefinite,
)
from impc.inverse.solution_set import GainFibre, pair_blocks, split_blocks
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, condition_number, normalised

# Least eigenvalue, at mean 1, from which weights count as existing: Clarabel errs by 1e-10.
_MARGIN = 1e-9
#: Relative slack of the least condition number in the tie-break; below it the solutions differ by
#: less than the solver's accuracy.
SLACK = 1e-5
# Relative gap to the dual bound at which a program is not repeated, and at which it fails.
_GAP, _LARGEST_GAP = 1e-9, 1e-4


@dataclass(frozen=True)
class WeightsMargin:
    """Whether a space of weights has positive definite members, and its margin."""

    # Largest t with blkdiag(Q, R) >= t I in whitened coordinates, at a mean eigenvalue of 1: at
    # most 1, independent of units, negative if no member is positive semidefinite
    margin: float
    exist: bool  # Whether the margin is above 1e-9
    weights: Weights | None  # Member with that margin, if any exist


@dataclass(frozen=True)
class EquivalentWeights(Frozen):
    """Weights that have a given gain."""

    weights: Weights  # Scaled to R[0, 0] = 1
    P: Array  # Riccati solution (n, n), recomputed from the weights
    condition: float  # Condition number of blkdiag(Q, R)
    gain_error: float  # ||K(Q, R) - K||_F / ||K||_F for that solution
    status: str  # How they were computed, and the status of the solver
    # `least_condition_weights` only: least condition number, which the weights exceed by up to 2e-5
    # of it; otherwise None
    least: float | None
    gap: float | None  # Relative gap of `least` to its dual bound


@checked
@functools.lru_cache(maxsize=1)  # the same space is often queried several times
def weights_margin(fibre: GainFibre) -> WeightsMargin:
    """Largest t with X >= t I at mean eigenvalue 1; positive if any weights have the gain."""
    basis, n, size = fibre.natural_basis(), fibre.plant.n, fibre.plant.n + fibre.plant.m
    traces = np.trace(basis, axis1=1, axis2=2)
    if np.linalg.norm(traces) < 1e-12:  # no member has a positive trace
        return WeightsMargin(-np.inf, exist=False, weights=None)
    # Eliminate the trace: as an equality it stopped Clarabel on 1 plant in 20.
    first = np.tensordot(traces * size / (traces @ traces), basis, 1)
    level = np.tensordot(scipy.linalg.null_space(traces[None]).T, basis, 1)
    lowered = np.concatenate([level, -np.eye(size)[None]])
    parts = (slice(0, n), slice(n, size))
    cones = [matrix_inequality(first[part, part], lowered[:, part, part]) for part in parts]
    found = solve_semidefinite(-np.eye(len(lowered))[-1], cones)
    member = first + np.tensordot(found.y[:-1], level, 1)
    # Recomputed from the member, not taken from the solver.
    margin = float(np.linalg.eigvalsh(member)[0])
    if margin > _MARGIN:
        return WeightsMargin(margin, exist=True, weights=fibre.from_natural(member))
    if not abs(margin + found.bound) <= _LARGEST_GAP * max(1.0, -margin):
        raise SolverError(
            "margin",
            f"undecided whether weights exist (Clarabel: {found.status})",
            "rescale the states (use other units)",
        )
    return WeightsMargin(margin, exist=False, weights=None)


@checked
def least_condition_weights(fibre: GainFibre, member: Weights | None = None) -> EquivalentWeights:
    """Return the weights of least condition number that have a given gain.

    Solves: minimise alpha subject to I <= X <= alpha I, X = blkdiag(Q, R) in the space of weights
    with this gain. Several weights may have the least condition number. By convention the result
    is, among those within a relative 1e-5 of it, the one of least Frobenius norm in whitened
    coordinates (`gain_fibre`) at least eigenvalue 1. It is unique.

    The program is scaled by a member X0 = LL' of least eigenvalue 1 and largest eigenvalue a: the
    first inequality is written for L^-1 X L^-T, the second divided by a. It is repeated from its
    own solution, because one program is not accurate enough on ill-conditioned plants.

    Parameters
    ----------
    fibre : GainFibre
        Space of the weights with the gain, from `gain_fibre`.
    member : Weights, optional
        Weights known to have the gain; the starting point if the program finds no definite member.

    Returns
    -------
    EquivalentWeights
        Weights, condition number, gain error, and the gap to the dual bound.

    Raises
    ------
    WeightsError
        If no weights have the gain.
    SolverError
        If the dual bound stays more than 1e-4 below, or no member is definite to working precision
        in the units of the plant.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> gain = impc.solve_lqr(plant, impc.Weights([[1, 0], [0, 1]], 1)).K
    >>> found = impc.least_condition_weights(impc.gain_fibre(plant, gain))
    >>> round(found.condition, 6), found.weights.Q.round(6).diagonal()
    (1.0, array([1., 1.]))
    """
    best = _interior(fibre, member)
    least, gap, status = condition_number(best), 1.0, ""
    for _ in range(4):
        before = least
        found, bound, status = _centred_program(fibre, best)
        if condition_number(found) < least:
            best, least = found, condition_number(found)
        gap = abs(1 - bound / least)  # a bound above the value is as wrong as one below
        if gap < _GAP or before - least < _GAP * least:
            break
    if not gap < _LARGEST_GAP:
        raise SolverError(
            "least condition number",
            f"condition number {least:.6g} proved only to {gap:.2g} (Clarabel: {status})",
            "use `analytic_centre`, or rescale the states (use other units)",
        )
    chosen = _least_norm(fibre, best, (1 + SLACK) * least)
    if condition_number(chosen) <= (1 + 2 * SLACK) * least:
        best = chosen
    return _member(fibre, best, f"least condition number, Clarabel: {status}", least, gap)


def nearest_weights(fibre: GainFibre, weights: Weights) -> EquivalentWeights:
    """Member X nearest to weights LL', in |L^-1 X L^-T - I|_F."""
    inverse, raw = inverse_factor(fibre, weights), pair_blocks(fibre.Q, fibre.R)
    seen = (inverse @ raw @ inverse.T).reshape(len(raw), -1)
    shares = np.linalg.lstsq(seen.T, np.eye(len(inverse)).ravel())[0]
    X = np.tensordot(shares, raw, 1)
    if np.linalg.eigvalsh(X)[0] <= 0:
        raise WeightsError("gain", "has no weights near those given", "use `weights_margin`")
    return _member(fibre, split_blocks(X, fibre.plant.n), "nearest to other weights")


@checked
def analytic_centre(fibre: GainFibre) -> EquivalentWeights:
    """Return the member of largest det Q det R with trace(N^-1 R) = m, by damped Newton steps.

    N is the metric of the whitened coordinates, so the choice does not depend on the units of
    states and inputs. With a single input it is the largest det Q with R fixed.
    """
    n, basis = fibre.plant.n, fibre.natural_basis()
    X = fibre.to_natural(_interior(fibre))
    traces = np.trace(basis[:, n:, n:], axis1=1, axis2=2)
    X *= fibre.plant.m / np.trace(X[n:, n:])
    level = np.tensordot(scipy.linalg.null_space(traces[None]).T, basis, 1)
    for iteration in range(1, 201):
        inverse = np.linalg.inv(np.linalg.cholesky(X))
        seen = (inverse @ level @ inverse.T).reshape(len(level), X.size)
        # Newton step of log det: least-squares solution of sum d_i seen_i = I.
        step = np.linalg.lstsq(seen.T, np.eye(len(X)).ravel())[0]
        decrement = float(np.linalg.norm(step @ seen))
        X = X + np.tensordot(step, level, 1) / (1 + decrement if decrement > 0.25 else 1)
        if decrement < 1e-9:
            status = f"analytic centre, {iteration} Newton steps"
            return _member(fibre, fibre.from_natural(X), status)
        if np.linalg.cond(X) > 1e14:
            break
    raise WeightsError(
        "gain",
        "leaves the cost of some combination of states free, so there is no analytic centre",
        "use `least_condition_weights`, or remove uncontrollable and deadbeat states",
    )


@checked(count=0, condition_ratio=1)
def other_weights(
    fibre: GainFibre, count: int = 2, *, condition_ratio: float = 10.0
) -> tuple[EquivalentWeights, ...]:
    """Return weights far from those of least condition number, with the same gain.

    Starts at the weights of least condition number and follows each basis direction of the space,
    both ways, until the condition number reaches its limit. The end points farthest from all
    previous choices are returned. The distance is the SD of the logarithms of the relative
    eigenvalues, which depends on neither scale nor units.

    Parameters
    ----------
    fibre : GainFibre
        Space of the weights with the gain, from `gain_fibre`.
    count : int, default 2
        Number of weights; fewer are returned if the space has fewer end points, none if it has only
        one member.
    condition_ratio : float, default 10
        Largest condition number, as a multiple of the least.

    Returns
    -------
    tuple of EquivalentWeights

    Raises
    ------
    WeightsError, SolverError
        As `least_condition_weights`.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> gain = impc.solve_lqr(plant, impc.Weights([[1, 0], [0, 1]], 1)).K
    >>> others = impc.other_weights(impc.gain_fibre(plant, gain), 2, condition_ratio=10)
    >>> [(round(item.condition, 4), item.gain_error < 1e-9) for item in others]
    [(10.0, True), (10.0, True)]
    """
    centre = least_condition_weights(fibre)
    ends, frame = _ends(fibre, centre.weights, condition_ratio * centre.condition)
    chosen: list[Array] = [np.eye(len(frame))]
    while ends and len(chosen) <= count:
        nearest = [min(_distance(end, item) for item in chosen) for end in ends]
        chosen.append(ends.pop(int(np.argmax(nearest))))
    status = f"{condition_ratio:g} times the least condition number"
    return tuple(
        _member(fibre, fibre.from_natural(frame @ X @ frame.T), status) for X in chosen[1:]
    )


def _interior(fibre: GainFibre, member: Weights | None = None) -> Weights:
    try:
        found = weights_margin(fibre)
    except SolverError:
        if member is None:
            raise
        return member
    if found.weights is None and member is not None:
        return member
    if found.weights is None:
        raise WeightsError(
            "gain",
            f"no positive definite weights have it (margin {found.margin:.3g})",
            "use inverse_lqr_gradient for the nearest gain that has weights",
        )
    return found.weights


@dataclass(frozen=True)
class _Centred:
    """Space in coordinates of a member of least eigenvalue 1 and largest eigenvalue `largest`."""

    raw: Array
    seen: Array  # L^-1 raw L^-T, orthonormal, so that programs are well scaled
    lower: Array  # L^-1 L^-T
    largest: float
    natural: Array  # raw in the basis of the space, orthonormal in whitened coordinates
    blocks: tuple[slice, slice]

    @classmethod
    def about(cls, fibre: GainFibre, centre: Weights) -> _Centred:
        n, eigenvalues = fibre.plant.n, np.linalg.eigvalsh(centre.block)
        if eigenvalues[0] <= 0:
            raise SolverError(
                "least condition number",
                "the weights are singular to working precision in the units of the plant",
                "rescale the states (use other units)",
            )
        inverse = inverse_factor(fibre, centre) * np.sqrt(eigenvalues[0])
        lower = inverse @ inverse.T
        raw = pair_blocks(fibre.Q, fibre.R)
        seen, triangle = np.linalg.qr((inverse @ raw @ inverse.T).reshape(len(raw), -1).T)
        back = np.linalg.inv(triangle).T
        return cls(
            np.tensordot(back, raw, 1),
            seen.T.reshape(-1, *lower.shape),
            lower,
            float(eigenvalues[-1] / eigenvalues[0]),
            back,
            (slice(0, n), slice(n, len(lower))),
        )

    def cones(self, limit: float | None) -> list[Cone]:
        """I <= X <= limit I; without a limit X <= s largest I with a further variable s."""
        size, cones = len(self.lower), []
        more = np.zeros((1, size, size)), np.eye(size)[None] * (limit is None)
        seen = np.concatenate([self.seen, more[0]])
        upper = np.concatenate([-self.raw / self.largest, more[1]])
        most = np.zeros((size, size)) if limit is None else limit / self.largest * np.eye(size)
        for part in self.blocks:
            cones.append(matrix_inequality(-self.lower[part, part], seen[:, part, part]))
            cones.append(matrix_inequality(most[part, part], upper[:, part, part]))
        return cones

    def member(self, y: Array) -> Weights:
        return split_blocks(np.tensordot(y, self.raw, 1), self.blocks[0].stop)


def _centred_program(fibre: GainFibre, centre: Weights) -> tuple[Weights, float, str]:
    """One program of `least_condition_weights` scaled by a member: (found, bound, status)."""
    at = _Centred.about(fibre, centre)
    last = np.eye(len(at.raw) + 1)[-1]
    found = solve_semidefinite(last, at.cones(None))
    return at.member(found.y[:-1]), at.largest * found.bound, found.status


def _least_norm(fibre: GainFibre, centre: Weights, limit: float) -> Weights:
    """Member with I <= X <= limit I of least Frobenius norm in whitened coordinates."""
    at = _Centred.about(fibre, centre)
    last = np.eye(len(at.raw) + 1)[-1]
    size = np.linalg.norm(fibre.to_natural(centre)) / np.linalg.eigvalsh(centre.block)[0]
    vectors = np.concatenate([at.natural, np.zeros((1, at.natural.shape[1]))]) / size
    found = solve_semidefinite(last, [norm_bound(vectors, last), *at.cones(limit)])
    return at.member(found.y[:-1])


def _ends(fibre: GainFibre, centre: Weights, limit: float) -> tuple[list[Array], Array]:
    """End points X of the rays from the centre, and L with L X L' in whitened coordinates.

    Bisection (the condition number is quasiconvex) in coordinates in which the centre is I.
    """
    inverse = inverse_factor(fibre, centre)
    back = np.linalg.inv(inverse)
    seen = (inverse @ pair_blocks(fibre.Q, fibre.R) @ inverse.T).reshape(fibre.dimension, -1)
    # Orthogonal to the centre, so that every ray leaves the cone.
    flat = np.eye(len(back)).ravel() / np.sqrt(len(back))
    across = seen - np.outer(seen @ flat, flat)
    directions = np.linalg.svd(across, full_matrices=False)[2][: fibre.dimension - 1]
    rays = np.concatenate([directions, -directions]).reshape(-1, *back.shape)
    low, high = np.zeros(len(rays)), -1 / np.linalg.eigvalsh(rays)[:, 0]
    for _ in range(40):
        middle = (low + high) / 2
        values = np.linalg.eigvalsh(centre.block + middle[:, None, None] * (back @ rays @ back.T))
        inside = values[:, -1] <= limit * values[:, 0]
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    natural = scipy.linalg.block_diag(fibre.T, fibre.G).T @ back
    return list(np.eye(len(back)) + low[:, None, None] * rays), natural


def _distance(X: Array, Y: Array) -> float:
    ratios = scipy.linalg.eigvalsh(X, Y)
    return float(np.std(np.log(np.maximum(ratios, 1e-12 * ratios[-1]))))  # rounding level


def inverse_factor(fibre: GainFibre, weights: Weights) -> Array:
    """L^-1 (n + m, n + m) of blkdiag(Q, R) = LL', computed through whitened coordinates."""
    try:
        factor = np.linalg.cholesky(fibre.to_natural(weights))
    except np.linalg.LinAlgError:
        problem = "are singular to working precision in whitened coordinates"
        raise SolverError("weights", problem, "scale the states") from None
    return np.linalg.inv(factor) @ scipy.linalg.block_diag(fibre.T, fibre.G).T


def _member(
    fibre: GainFibre,
    found: Weights,
    status: str,
    least: float | None = None,
    gap: float | None = None,
) -> EquivalentWeights:
    checked = normalised(Weights(found.Q, found.R))
    solution = solve_lqr(fibre.plant, checked)
    size = max(float(np.linalg.norm(fibre.gain)), 1e-300)
    error = float(np.linalg.norm(solution.K - fibre.gain)) / size
    condition = condition_number(checked)
    return EquivalentWeights(checked, solution.P, condition, error, status, least, gap)
