"""All weights (Q, R) that have a given gain K, and the choice of one among them.

With F = A - BK, the P of a candidate (Q, R) follows from one Lyapunov equation, and what makes K
its gain is then linear in (Q, R):

    discrete:    P = F'PF + Q + K'RK,        B'PF = RK
    continuous:  0 = F'P + PF + Q + K'RK,    B'P  = RK

so these weights are the positive definite members of a linear space, the fibre of K. With P
eliminated nothing has to be asked of it: Q, R > 0 give P > 0. Three members have a name here: the
one of least condition number, the analytic centre, and the one that shows best that any exist.

The fibre is computed in natural coordinates, which follow from the plant and the gain alone: in
them white noise at the inputs gives the states a covariance of I, and the inputs are measured in
the metric N that the closed loop reproduces, N ~ B'YB with Y = F'YF + K'NK. They make the answers
independent of units, and the seat plant as well conditioned as a textbook example: its singular
values span a factor of 200, in raw units 5e5. docs/equivalent-weights.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import clarabel
import numpy as np
import scipy.linalg
import scipy.sparse

from impc.arrays import Array, finite_array, frozen, symmetric_matrix
from impc.errors import SolverError, WeightsError
from impc.lqr import is_stable, lyapunov_series, solve_lqr
from impc.step_program import block_basis
from impc.weights import Weights, condition_number, normalised, stage_weights

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.plant import Plant

__all__ = [
    "EquivalentWeights",
    "GainFibre",
    "WeightsMargin",
    "analytic_centre",
    "gain_fibre",
    "least_condition_weights",
    "other_weights",
    "weights_margin",
]

# Singular values of the gain condition below this, of the largest, are zero: exact gains leave
# 1e-15 there (a singular A, or a metric given with its own gain), the seat's smallest is 5e-3.
_RANK = 1e-10
# Least eigenvalue, of a mean of 1, from which weights are said to exist. Clarabel's own error is
# 1e-10; a member closer to singular than this could not be told from one that is.
_MARGIN = 1e-9
# A direction that the inputs hardly reach is stretched no further than this, in variance.
_FLOOR = 1e-8


@dataclass(frozen=True)
class GainFibre:
    """The linear space of the pairs (Q, R) for which the gain is stationary.

    Attributes
    ----------
    plant : Plant
    gain : Array
        K, (m, n).
    Q, R : Array
        Basis of k pairs, (k, n, n) and (k, m, m), in the units of the plant; orthonormal in
        natural coordinates, where a pair is blkdiag(T'QT, G'RG).
    T, G : Array
        Natural coordinates of states x = T z (n, n) and inputs u = G v (m, m).
    singular_values : Array
        Of the gain condition in natural coordinates, largest first: those below 1e-10 of the
        first count as zero.
    """

    plant: Plant
    gain: Array
    Q: Array
    R: Array
    T: Array
    G: Array
    singular_values: Array

    @property
    def dimension(self) -> int:
        """Number of independent pairs, scale counted: k."""
        return len(self.Q)

    def natural_basis(self) -> Array:
        """The basis as blkdiag(T'QT, G'RG), (k, n + m, n + m)."""
        return _blocks(self.T.T @ self.Q @ self.T, self.G.T @ self.R @ self.G)


@dataclass(frozen=True)
class WeightsMargin:
    """Whether a fibre has positive definite members, and by how much.

    Attributes
    ----------
    margin : float
        Largest t with blkdiag(Q, R) >= t I in natural coordinates, at a mean eigenvalue of 1: at
        most 1, independent of units, negative when no member is even semidefinite.
    exist : bool
        Whether the margin is above 1e-9.
    weights : Weights or None
        The member of that margin, when they exist.
    """

    margin: float
    exist: bool
    weights: Weights | None


@dataclass(frozen=True)
class EquivalentWeights:
    """Weights that have the gain of a fibre.

    Attributes
    ----------
    weights : Weights
        Scaled to R[0, 0] = 1.
    P : Array
        Their Riccati solution (n, n), solved anew.
    condition : float
        Condition number of blkdiag(Q, R).
    gain_error : float
        ||K(Q, R) - K||_F / ||K||_F, with K(Q, R) from that solution.
    status : str
        How they were found, and the solver's own word.
    gap : float or None
        Of `least_condition_weights`: how much lower, relatively, the condition number could be by
        the dual bound. None for weights that were not chosen by it.
    """

    weights: Weights
    P: Array
    condition: float
    gain_error: float
    status: str
    gap: float | None


def gain_fibre(plant: Plant, gain: ArrayLike, metric: ArrayLike | None = None) -> GainFibre:
    """Compute the space of the weights that have a given gain.

    Parameters
    ----------
    plant : Plant
        Discrete or continuous.
    gain : array_like
        K (m, n) of u = -Kx.
    metric : array_like, optional
        S (m, m), known up to scale: only pairs whose R + B'PB (continuous: R) is a multiple of
        it. With a single input it says nothing.

    Raises
    ------
    DataError, InputError
        When the gain is not a finite (m, n) matrix or the metric not a symmetric (m, m) one.
    WeightsError
        When A - BK is not stable: no weights have such a gain.
    """
    K = finite_array("gain", gain, (plant.m, plant.n))
    if not is_stable(plant.A - plant.B @ K, discrete=plant.discrete):
        raise WeightsError("gain", "A - BK is not stable", "no weights have such a gain")
    T, G = _natural_coordinates(plant, K)
    z, v = np.linalg.inv(T), np.linalg.inv(G)
    F, B, K_natural = z @ (plant.A - plant.B @ K) @ T, z @ plant.B @ G, v @ K @ T
    units = block_basis(plant.n, plant.m)
    Q, R = units[:, : plant.n, : plant.n], units[:, plant.n :, plant.n :]
    P = _lyapunov(plant, F, Q + K_natural.T @ R @ K_natural)
    product = B.T @ P @ F if plant.discrete else B.T @ P
    conditions = (product - R @ K_natural).reshape(len(units), -1)
    if metric is not None:
        conditions = _add_metric(conditions, R + B.T @ P @ B if plant.discrete else R, G, metric)
    _, singular, directions = np.linalg.svd(conditions.T)
    rank = int(np.count_nonzero(singular > _RANK * singular[0]))
    # The metric's scale is one more unknown: it is left out of the pairs, which stay independent.
    members = np.linalg.qr(directions[rank:, : len(units)].T)[0].T
    return GainFibre(
        plant,
        frozen(K),
        frozen(z.T @ np.tensordot(members, Q, 1) @ z),
        frozen(v.T @ np.tensordot(members, R, 1) @ v),
        frozen(T),
        frozen(G),
        frozen(singular),
    )


def weights_margin(fibre: GainFibre) -> WeightsMargin:
    """Say whether any weights have the gain: max t such that X >= t I, mean eigenvalue of X is 1.

    Raises
    ------
    SolverError
        When Clarabel returns no usable point.
    """
    basis, n, size = fibre.natural_basis(), fibre.plant.n, fibre.plant.n + fibre.plant.m
    traces = np.trace(basis, axis1=1, axis2=2)
    if fibre.dimension == 0 or np.linalg.norm(traces) < _RANK:
        return WeightsMargin(-np.inf, exist=False, weights=None)  # no member has a positive trace
    width = fibre.dimension + 1
    balance = (np.append(traces, 0.0)[None], np.array([float(size)]), clarabel.ZeroConeT(1))
    cones = [balance, *_matrix_inequality(n, np.zeros((size, size)), basis, -np.eye(size))]
    found = _solve(-np.eye(width)[-1], cones)
    member = np.tensordot(np.asarray(found.x)[:-1], basis, 1)
    if not np.all(np.isfinite(member)):
        raise SolverError("margin program", f"Clarabel: {found.status}", "check the gain")
    # From the member itself, not from the solver's word.
    eigenvalues = np.linalg.eigvalsh(member)
    margin = float(eigenvalues[0] / np.mean(eigenvalues))
    exist = margin > _MARGIN
    return WeightsMargin(margin, exist, _from_natural(fibre, member) if exist else None)


def least_condition_weights(fibre: GainFibre) -> EquivalentWeights:
    """Return the weights of least condition number that have the gain.

    minimise alpha subject to I <= X <= alpha I, X = blkdiag(Q, R) in the fibre.

    A member X0 = LL' of least eigenvalue 1 and largest a sets the scale: the first inequality is
    written for L^-1 X L^-T, the second divided by a, so that all entries are of order one. One
    such program reaches 1e-4 on the seat plant (a condition number of 2e7); from its own answer
    the second reaches 1e-9. As written above it fails there.

    Raises
    ------
    WeightsError
        When no weights have the gain.
    SolverError
        When the dual bound stays more than 1e-4 below.
    """
    best = _interior(fibre).block
    least, gap, status = condition_number(_split(fibre, best)), 1.0, ""
    for _ in range(4):
        before = least
        found, bound, status = _centred_program(fibre, best)
        condition = condition_number(_split(fibre, found))
        if condition < least:
            best, least = found, condition
        gap = 1 - bound / least
        if before - least < 1e-9 * least:
            break
    if not gap < 1e-4:
        raise SolverError(
            "least condition number",
            f"Clarabel: {status}, condition {least:.6g}, proven only to {gap:.2g}",
            "use `analytic_centre`, or scale the states",
        )
    return _member(fibre, _split(fibre, best), f"least condition number, Clarabel {status}", gap)


def analytic_centre(fibre: GainFibre) -> EquivalentWeights:
    """Return the member of largest det Q det R among those with trace(N^-1 R) = m.

    N is the metric of the natural coordinates, so the choice does not depend on the units or the
    coordinates of states and inputs. With a single input it is the largest det Q with R fixed.
    Damped Newton, from the member of largest margin.

    Raises
    ------
    WeightsError
        When no weights have the gain, or when the members with that trace are unbounded, which
        they are if and only if (A, B) is not controllable or, discrete, A - BK is singular: the
        cost on a combination of states that is out of reach, or gone in one step, is then free.
    """
    X = _to_natural(fibre, _interior(fibre))
    n, basis = fibre.plant.n, fibre.natural_basis()
    traces = np.trace(basis[:, n:, n:], axis1=1, axis2=2)
    X *= fibre.plant.m / np.trace(X[n:, n:])
    level = np.tensordot(scipy.linalg.null_space(traces[None]).T, basis, 1)
    if len(level) == 0:
        return _member(fibre, _from_natural(fibre, X), "analytic centre, the only member", None)
    for iteration in range(1, 201):
        inverse = np.linalg.inv(np.linalg.cholesky(X))
        seen = (inverse @ level @ inverse.T).reshape(len(level), -1)
        # The Newton step of log det: the least-squares solution of sum d_i seen_i = I.
        step = np.linalg.lstsq(seen.T, np.eye(len(X)).ravel(), rcond=None)[0]
        decrement = float(np.linalg.norm(step @ seen))
        X = X + np.tensordot(step, level, 1) / (1 + decrement if decrement > 0.25 else 1)
        if decrement < 1e-9:
            status = f"analytic centre, {iteration} Newton steps"
            return _member(fibre, _from_natural(fibre, X), status, None)
    raise WeightsError(
        "gain",
        "leaves the cost on some combination of states free, so there is no analytic centre",
        "use `least_condition_weights`, or remove states that are out of reach or gone in one step",
    )


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
    """
    centre = least_condition_weights(fibre)
    ends = _ends(fibre, centre.weights.block, condition_ratio * centre.condition)
    chosen = [centre.weights.block]
    while ends and len(chosen) <= count:
        nearest = [min(_distance(end, item) for item in chosen) for end in ends]
        chosen.append(ends.pop(int(np.argmax(nearest))))
    return tuple(_member(fibre, _split(fibre, X), "another member", None) for X in chosen[1:])


def _natural_coordinates(plant: Plant, K: Array) -> tuple[Array, Array]:
    """T and G of the module's text; reduces to T alone, up to scale, with a single input."""
    F = plant.A - plant.B @ K
    input_factor = np.linalg.cholesky(_floored(_input_metric(plant, K, F)))
    G = np.linalg.inv(input_factor).T
    # Continuous: noise of the same variance, correlated over the mean time constant of F.
    rate = 1.0 if plant.discrete else -float(np.trace(F)) / plant.n
    driven = plant.B @ G
    covariance = _lyapunov(plant, F.T, (driven @ driven.T / rate)[None])[0]
    return np.linalg.cholesky(_floored(covariance)), G


def _input_metric(plant: Plant, K: Array, F: Array) -> Array:
    """N ~ B'YB, Y = F'YF + K'NK: the Perron eigenvector of a map that keeps N >= 0."""
    m = plant.m
    units = block_basis(m, 0)
    images = plant.B.T @ _lyapunov(plant, F, K.T @ units @ K) @ plant.B
    values, vectors = np.linalg.eig(np.tensordot(units, images, ((1, 2), (1, 2))))
    leading = np.tensordot(vectors[:, int(np.argmax(values.real))].real, units, 1)
    trace = float(np.trace(leading))
    # A gain of zero reproduces nothing: the inputs' own units are as good as any.
    return leading * m / trace if abs(trace) > 1e-12 else np.eye(m)


def _floored(covariance: Array) -> Array:
    """Make it definite: unit variance where there is none, correlations floored at 1e-8."""
    variance = np.diag(covariance)
    scale = np.where(variance > 0, np.sqrt(np.maximum(variance, 1e-300)), 1.0)
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    values, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
    return np.outer(scale, scale) * ((vectors * np.maximum(values, _FLOOR)) @ vectors.T)


def _lyapunov(plant: Plant, F: Array, stack: Array) -> Array:
    """P of P = F'PF + M, or of 0 = F'P + PF + M, for a stack of M."""
    if plant.discrete:
        return lyapunov_series(F.T, stack)
    return np.array([scipy.linalg.solve_continuous_lyapunov(F.T, -item) for item in stack])


def _add_metric(conditions: Array, S: Array, G: Array, metric: ArrayLike) -> Array:
    """Rows S - s metric = 0, with one more unknown s."""
    given = G.T @ symmetric_matrix("metric", metric, len(G)) @ G
    rows = np.hstack([conditions, S.reshape(len(S), -1)])
    scale = np.concatenate([np.zeros(conditions.shape[1]), -given.ravel() / np.linalg.norm(given)])
    return np.vstack([rows, scale])


def _centred_program(fibre: GainFibre, centre: Array) -> tuple[Array, float, str]:
    """One program of `least_condition_weights`, its scale set by a member: X, bound, status."""
    eigenvalues = np.linalg.eigvalsh(centre)
    largest = float(eigenvalues[-1] / eigenvalues[0])
    inverse = np.linalg.inv(np.linalg.cholesky(centre / eigenvalues[0]))
    basis = _blocks(fibre.Q, fibre.R)
    # Orthonormal as seen from the centre: the program's own variables are well scaled too.
    seen, triangle = np.linalg.qr((inverse @ basis @ inverse.T).reshape(len(basis), -1).T)
    basis = np.tensordot(np.linalg.inv(triangle).T, basis, 1)
    size, n = len(centre), fibre.plant.n
    nothing = np.zeros((size, size))
    cones = [
        *_matrix_inequality(n, -inverse @ inverse.T, seen.T.reshape(basis.shape), nothing),
        *_matrix_inequality(n, nothing, -basis / largest, np.eye(size)),
    ]
    found = _solve(np.eye(len(basis) + 1)[-1], cones)
    member = np.tensordot(np.asarray(found.x)[:-1], basis, 1)
    if not np.all(np.isfinite(member)):
        raise SolverError("least condition number", f"Clarabel: {found.status}", "check the gain")
    return member, largest * float(found.obj_val_dual), str(found.status)


def _matrix_inequality(
    n: int, constant: Array, basis: Array, last: Array
) -> list[tuple[Array, Array, Any]]:
    """constant + sum y_i basis_i + y_last last >= 0, a cone for each diagonal block."""
    cones = []
    for block in (slice(0, n), slice(n, len(constant))):
        columns = np.vstack([_triangle(basis[:, block, block]), _triangle(last[None, block, block])])
        cone = clarabel.PSDTriangleConeT(block.stop - block.start)
        cones.append((-columns.T, _triangle(constant[None, block, block])[0], cone))
    return cones


def _triangle(stack: Array) -> Array:
    """Upper triangles by columns, off-diagonals times sqrt(2): Clarabel's order."""
    rows, columns = np.tril_indices(stack.shape[-1])
    return np.where(rows == columns, 1.0, np.sqrt(2.0)) * stack[:, columns, rows]


def _solve(objective: Array, cones: list[tuple[Array, Array, Any]]) -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    return clarabel.DefaultSolver(
        scipy.sparse.csc_matrix((len(objective), len(objective))),
        objective,
        scipy.sparse.csc_matrix(np.vstack([rows for rows, _, _ in cones])),
        np.concatenate([right for _, right, _ in cones]),
        [cone for _, _, cone in cones],
        settings,
    ).solve()


def _ends(fibre: GainFibre, X: Array, limit: float) -> list[Array]:
    """Ends of the rays from X: bisection on all at once, for the condition number is quasiconvex."""
    L = np.linalg.cholesky(X)
    inverse = np.linalg.inv(L)
    seen = (inverse @ _blocks(fibre.Q, fibre.R) @ inverse.T).reshape(fibre.dimension, -1)
    # Across X itself, so that every ray leaves the cone.
    flat = np.eye(len(X)).ravel() / np.sqrt(len(X))
    across = seen - np.outer(seen @ flat, flat)
    directions = np.linalg.svd(across)[2][: fibre.dimension - 1].reshape(-1, *X.shape)
    rays = np.concatenate([directions, -directions])
    if len(rays) == 0:
        return []
    low, high = np.zeros(len(rays)), -1 / np.linalg.eigvalsh(rays)[:, 0]
    for _ in range(40):
        middle = (low + high) / 2
        values = np.linalg.eigvalsh(X + L @ (middle[:, None, None] * rays) @ L.T)
        inside = values[:, -1] <= limit * values[:, 0]
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return list(X + L @ (low[:, None, None] * rays) @ L.T)


def _distance(X: Array, Y: Array) -> float:
    return float(np.std(np.log(scipy.linalg.eigvalsh(X, Y))))


def _interior(fibre: GainFibre) -> Weights:
    found = weights_margin(fibre)
    if found.weights is None:
        raise WeightsError(
            "gain",
            f"no positive definite weights have it (margin {found.margin:.3g})",
            "look for the nearest such gain: `inverse_lqr_gradient`",
        )
    return found.weights


def _member(fibre: GainFibre, weights: Weights, status: str, gap: float | None) -> EquivalentWeights:
    checked = normalised(stage_weights(weights.Q, weights.R))
    solution = solve_lqr(fibre.plant, checked)
    error = float(np.linalg.norm(solution.K - fibre.gain) / np.linalg.norm(fibre.gain))
    return EquivalentWeights(checked, solution.P, condition_number(checked), error, status, gap)


def _blocks(Q: Array, R: Array) -> Array:
    n, m = Q.shape[-1], R.shape[-1]
    joined = np.zeros((len(Q), n + m, n + m))
    joined[:, :n, :n], joined[:, n:, n:] = Q, R
    return joined


def _split(fibre: GainFibre, X: Array) -> Weights:
    n, X = fibre.plant.n, (X + X.T) / 2
    return Weights(frozen(X[:n, :n]), frozen(X[n:, n:]))


def _to_natural(fibre: GainFibre, weights: Weights) -> Array:
    T, G = fibre.T, fibre.G
    return np.asarray(scipy.linalg.block_diag(T.T @ weights.Q @ T, G.T @ weights.R @ G))


def _from_natural(fibre: GainFibre, X: Array) -> Weights:
    back = np.linalg.inv(scipy.linalg.block_diag(fibre.T, fibre.G))
    return _split(fibre, back.T @ X @ back)
