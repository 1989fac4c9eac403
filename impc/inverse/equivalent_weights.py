"""The choice of one pair of weights among all that have a given gain.

The fibre of a gain (`gain_fibre`) is a linear space; its positive definite members are the weights
with that gain. Three of them have a name here: the one that shows best that any exist, the one of
least condition number, and the analytic centre. The first and the last do not depend on the units
of states and inputs, the second does (docs/equivalent-weights.md, section 2).
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

# Least eigenvalue, of a mean of 1, from which weights are said to exist: Clarabel errs by 1e-10.
_MARGIN = 1e-9
#: By how much, relatively, the condition number of a convention may exceed the least: with less
#: the members differ by less than the programs can determine.
SLACK = 1e-5
# Relative distance to the dual bound at which a program is not solved again, and counts as failed.
_GAP, _LARGEST_GAP = 1e-9, 1e-4


@dataclass(frozen=True)
class WeightsMargin:
    """Whether a fibre has positive definite members, and by how much."""

    # Largest t with blkdiag(Q, R) >= t I in natural coordinates, at a mean eigenvalue of 1: at most
    # 1, independent of units, negative when no member is even semidefinite
    margin: float
    exist: bool  # Whether the margin is above 1e-9
    weights: Weights | None  # The member of that margin, when they exist


@dataclass(frozen=True)
class EquivalentWeights(Frozen):
    """Weights that have the gain of a fibre."""

    weights: Weights  # Scaled to R[0, 0] = 1
    P: Array  # Their Riccati solution (n, n), solved anew
    condition: float  # Condition number of blkdiag(Q, R)
    gain_error: float  # ||K(Q, R) - K||_F / ||K||_F, with K(Q, R) from that solution
    status: str  # How they were found, and the solver's own word
    # Of `least_condition_weights`: the least condition number, which these weights exceed by up to
    # 2e-5 of it. None for weights that were not chosen by it.
    least: float | None
    gap: float | None  # How much lower, relatively, that could be by the dual bound


@checked
@functools.lru_cache(maxsize=1)  # whoever looks for one member of a fibre looks for others next
def weights_margin(fibre: GainFibre) -> WeightsMargin:
    """Whether any weights have the gain: max t such that X >= t I, X of mean eigenvalue 1."""
    basis, n, size = fibre.natural_basis(), fibre.plant.n, fibre.plant.n + fibre.plant.m
    traces = np.trace(basis, axis1=1, axis2=2)
    if np.linalg.norm(traces) < 1e-12:  # no member has a positive trace, or there is none but 0
        return WeightsMargin(-np.inf, exist=False, weights=None)
    # The trace is eliminated: as an equality, it stops Clarabel at once on one plant in twenty.
    first = np.tensordot(traces * size / (traces @ traces), basis, 1)
    level = np.tensordot(scipy.linalg.null_space(traces[None]).T, basis, 1)
    lowered = np.concatenate([level, -np.eye(size)[None]])
    parts = (slice(0, n), slice(n, size))
    cones = [matrix_inequality(first[part, part], lowered[:, part, part]) for part in parts]
    found = solve_semidefinite(-np.eye(len(lowered))[-1], cones)
    member = first + np.tensordot(found.y[:-1], level, 1)
    # From the member itself, not from the solver's word.
    margin = float(np.linalg.eigvalsh(member)[0])
    if margin > _MARGIN:
        return WeightsMargin(margin, exist=True, weights=fibre.from_natural(member))
    if not abs(margin + found.bound) <= _LARGEST_GAP * max(1.0, -margin):
        raise SolverError("margin", f"Clarabel: {found.status}, undecided", "scale the states")
    return WeightsMargin(margin, exist=False, weights=None)


@checked
def least_condition_weights(
    fibre: GainFibre, member: Weights | None = None, *, rough: bool = False
) -> EquivalentWeights:
    """Return the weights of least condition number that have the gain.

    minimise alpha subject to I <= X <= alpha I, X = blkdiag(Q, R) in the fibre.

    Many weights may have the least condition number. By convention the answer is, of those whose
    condition number is at most 1e-5 larger, that of least Frobenius norm in natural coordinates
    (`gain_fibre`) when their least eigenvalue is 1: it is unique, and the same on every processor.

    A member X0 = LL' of least eigenvalue 1 and largest a sets the scale: the first inequality is
    written for L^-1 X L^-T, the second divided by a, so that all entries are of order one. One
    such program reaches 2e-4 on the seat plant (a condition number of 2e7); from its own answer
    the next reaches 1e-11. As written above it returns twice the least condition number there.

    Parameters
    ----------
    fibre : GainFibre
    member : Weights, optional
        Weights known to have the gain: where to begin when no program finds any. Weights at the
        edge of what a program can determine from none (a margin below 1e-9) are found again like
        this.
    rough : bool
        Whether a least condition number that is proved to 1e-4 is enough, and programs are left as
        they stand and not scaled once more: half of the time or less. Over 150 random plants they
        agree to 2e-6; a search that begins at these weights ends elsewhere within its tolerance.

    Raises
    ------
    WeightsError
        When no weights have the gain.
    SolverError
        When the dual bound stays more than 1e-4 below, or no member is definite to working
        precision in the units of the plant.

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
    enough = _LARGEST_GAP if rough else _GAP
    for _ in range(4):
        before = least
        found, bound, status = _centred_program(fibre, best, rough)
        if condition_number(found) < least:
            best, least = found, condition_number(found)
        gap = abs(1 - bound / least)  # a bound above the value is as wrong as one below
        if gap < enough or before - least < _GAP * least:
            break
    if not gap < _LARGEST_GAP:
        raise SolverError(
            "least condition number",
            f"Clarabel: {status}, condition {least:.6g}, proven only to {gap:.2g}",
            "use `analytic_centre`, or scale the states",
        )
    if not rough:
        chosen = _least_norm(fibre, best, (1 + SLACK) * least)
        if condition_number(chosen) <= (1 + 2 * SLACK) * least:
            best = chosen
    return _member(fibre, best, f"least condition number, Clarabel: {status}", least, gap)


@checked
def analytic_centre(fibre: GainFibre) -> EquivalentWeights:
    """Return the member of largest det Q det R among those with trace(N^-1 R) = m.

    N is the metric of the natural coordinates, so the choice does not depend on the coordinates
    of states and inputs. With a single input it is the largest det Q with R fixed. Damped Newton.
    """
    n, basis = fibre.plant.n, fibre.natural_basis()
    X = fibre.to_natural(_interior(fibre))
    traces = np.trace(basis[:, n:, n:], axis1=1, axis2=2)
    X *= fibre.plant.m / np.trace(X[n:, n:])
    level = np.tensordot(scipy.linalg.null_space(traces[None]).T, basis, 1)
    for iteration in range(1, 201):
        inverse = np.linalg.inv(np.linalg.cholesky(X))
        seen = (inverse @ level @ inverse.T).reshape(len(level), X.size)
        # The Newton step of log det: the least-squares solution of sum d_i seen_i = I.
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
        "leaves the cost on some combination of states free, so there is no analytic centre",
        "use `least_condition_weights`, or remove states that are out of reach or gone in one step",
    )


@checked(count=0, condition_ratio=1)
def other_weights(
    fibre: GainFibre, count: int = 2, *, condition_ratio: float = 10.0
) -> tuple[EquivalentWeights, ...]:
    """Return weights clearly unlike those of least condition number, with the same gain.

    From the weights of least condition number, straight along each basis direction of the fibre
    and its opposite, as far as the condition number stays below the ratio; of these ends the one
    farthest from all chosen so far, again and again. Distances are spreads of the logarithms of
    relative eigenvalues, in which neither scale nor units count.

    Parameters
    ----------
    count : int
        How many; fewer come back when the fibre has fewer ends, none when it has one member.
    condition_ratio : float
        Largest condition number, as a multiple of the least.

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
            "look for the nearest gain that has, by the gradient of inverse LQR",
        )
    return found.weights


@dataclass(frozen=True)
class _Centred:
    """A fibre as seen from a member, whose least eigenvalue is 1 and whose largest is `largest`."""

    raw: Array
    seen: Array  # L^-1 raw L^-T, orthonormal: the programs' variables are well scaled
    lower: Array  # L^-1 L^-T
    largest: float
    natural: Array  # raw in the fibre's own basis, orthonormal in natural coordinates
    blocks: tuple[slice, slice]

    @classmethod
    def about(cls, fibre: GainFibre, centre: Weights) -> _Centred:
        n, eigenvalues = fibre.plant.n, np.linalg.eigvalsh(centre.block)
        if eigenvalues[0] <= 0:
            raise SolverError(
                "least condition number",
                "the weights are singular to working precision in the units of the plant",
                "scale the states",
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
        """I <= X <= limit I; without a limit X <= s largest I, s one variable more."""
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


def _centred_program(fibre: GainFibre, centre: Weights, scaled: bool) -> tuple[Weights, float, str]:
    """One program of `least_condition_weights`, scaled by a member: (found, bound, status)."""
    at = _Centred.about(fibre, centre)
    last = np.eye(len(at.raw) + 1)[-1]
    found = solve_semidefinite(last, at.cones(None), scaled=scaled)
    return at.member(found.y[:-1]), at.largest * found.bound, found.status


def _least_norm(fibre: GainFibre, centre: Weights, limit: float) -> Weights:
    """Of the members with I <= X <= limit I that of least Frobenius norm in natural coordinates."""
    at = _Centred.about(fibre, centre)
    last = np.eye(len(at.raw) + 1)[-1]
    size = np.linalg.norm(fibre.to_natural(centre)) / np.linalg.eigvalsh(centre.block)[0]
    vectors = np.concatenate([at.natural, np.zeros((1, at.natural.shape[1]))]) / size
    found = solve_semidefinite(last, [norm_bound(vectors, last), *at.cones(limit)])
    return at.member(found.y[:-1])


def _ends(fibre: GainFibre, centre: Weights, limit: float) -> tuple[list[Array], Array]:
    """Ends X of the rays as seen from the centre, and the frame L: L X L' in natural coordinates.

    By bisection, for the condition is quasiconvex. Seen from the centre, which is I there, they are
    definite to the last digit; in other coordinates the condition numbers multiply.
    """
    inverse = inverse_factor(fibre, centre)
    back = np.linalg.inv(inverse)
    seen = (inverse @ pair_blocks(fibre.Q, fibre.R) @ inverse.T).reshape(fibre.dimension, -1)
    # Across the centre itself, seen as I, so that every ray leaves the cone.
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
    return float(np.std(np.log(np.maximum(ratios, 1e-12 * ratios[-1]))))  # rounding ends there


def inverse_factor(fibre: GainFibre, weights: Weights) -> Array:
    """L^-1 (n + m, n + m) of blkdiag(Q, R) = LL', by way of the natural coordinates."""
    factor = np.linalg.cholesky(fibre.to_natural(weights))
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
