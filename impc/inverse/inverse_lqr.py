"""Inverse LQR: the weights (Q, R) whose regulator has a given gain, or the nearest one.

Three ways, as in Table 3.1: the linear matrix inequality, which has an answer only when some
weights have exactly the gain; the same with a cross term x'Su in the cost, which always has one;
and the gradient of the distance between the gains. After Priess et al., IEEE TCST 23 (2015) 770.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array, Frozen, finite_array, frozen
from impc.checking import checked
from impc.errors import WeightsError
from impc.inverse.equivalent_weights import least_condition_weights, weights_margin
from impc.inverse.proximal_step import block_basis
from impc.inverse.semidefinite import matrix_inequality, norm_bound, solve_semidefinite
from impc.inverse.solution_set import gain_fibre, natural_coordinates, split_blocks
from impc.model.riccati import gain_gradients, is_stable, solve_lqr, stabilises
from impc.model.weights import Weights, condition_number, normalised

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.model.plant import Plant
    from impc.model.riccati import LqrSolution

# Of the mean eigenvalue of a start: no nearer to singular does the gradient method come.
_FLOOR = 1e-9


@dataclass(frozen=True)
class InverseLqr(Frozen):
    """Weights for a gain, or the finding that there are none."""

    weights: Weights | None  # Scaled to R[0, 0] = 1; None when the method found that there are none
    gain: Array | None  # K(Q, R) of these weights, (m, n)
    gain_error: float  # ||K(Q, R) - K||_F; infinite without weights
    condition: float  # Condition number of blkdiag(Q, R); infinite without weights
    # Whether weights with exactly this gain were found: a relative error of 1e-8 or less
    feasible: bool
    method: str  # "lmi" or "gradient"
    evaluations: int  # Riccati equations solved
    status: str  # Why the method ended


@checked(gain="m n")
def inverse_lqr_lmi(plant: Plant, gain: ArrayLike) -> InverseLqr:
    """Weights of least condition number with exactly the gain, if there are any.

    Parameters
    ----------
    plant : Plant
        Discrete or continuous.
    gain : array_like
        K (m, n) of u = -Kx.

    Returns
    -------
    InverseLqr
        Not feasible, and without weights, when no weights have the gain: because A - BK is not
        stable, or because the fibre of the gain has no definite member.

    Raises
    ------
    SolverError
        When the semidefinite program ends without an answer.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> gain = impc.solve_lqr(plant, impc.Weights([[1, 0], [0, 1]], 1)).K
    >>> found = impc.inverse_lqr_lmi(plant, gain)
    >>> found.feasible, round(found.condition, 6)
    (True, 1.0)
    """
    K = finite_array("gain", gain, (plant.m, plant.n))
    if not stabilises(plant, K):
        return _no_weights("A - BK is not stable")
    fibre = gain_fibre(plant, K)
    margin = weights_margin(fibre)
    if not margin.exist:
        return _no_weights(f"no definite weights have this gain, margin {margin.margin:.3g}")
    found = least_condition_weights(fibre)
    return _result(solve_lqr(plant, found.weights), K, "lmi", 1, found.status)


@checked(gain="m n", max_evaluations=1)
def inverse_lqr_gradient(
    plant: Plant,
    gain: ArrayLike,
    start: Weights | None = None,
    *,
    max_evaluations: int = 300,
) -> InverseLqr:
    """Weights whose gain is nearest: minimise ||K(Q, R) - K||_F^2.

    Levenberg-Marquardt in a trust region over the Cholesky factors of Q and R, with the exact
    derivatives of K. The infimum need not be attained: Q then tends to a singular matrix, slowly,
    and the condition number of the result says. Two limits keep that orderly, neither of which
    touches a problem whose minimum is attained: evaluations are capped, and Q = LL' + f I,
    R = GG' + f I with f 1e-9 times the mean eigenvalue of the start.

    Parameters
    ----------
    gain : array_like
        K (m, n); A - BK need not be stable.
    start : Weights, optional
        By default the cross-term weights without their cross term, or the identity when A - BK is
        not stable.
    max_evaluations : int
        Of the gain, at most.

    Raises
    ------
    WeightsError
        When the start has no stabilising Riccati solution.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> gain = impc.solve_lqr(plant, impc.Weights([[1, 0], [0, 1]], 1)).K
    >>> impc.inverse_lqr_gradient(plant, gain).gain_error < 1e-6
    True
    """
    K = finite_array("gain", gain, (plant.m, plant.n))
    begin = _default_start(plant, K) if start is None else start
    space = _FactorSpace.around(plant, begin, _FLOOR)

    def difference(parameters: Array) -> Array:
        # Where the Riccati equation fails, the trust region shrinks: it does so for infinity.
        solution = space.solution(parameters)
        return np.full(K.size, np.inf) if solution is None else (solution.K - K).ravel()

    first = space.solution(space.start)
    if first is None:
        raise WeightsError("start", "has no stabilising Riccati solution", "give other weights")
    found = scipy.optimize.least_squares(
        difference,
        space.start,
        jac=space.jacobian,
        max_nfev=max_evaluations,
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
    )
    solution = space.solution(found.x)
    last = first if solution is None else solution
    return _result(last, K, "gradient", int(found.nfev), str(found.message))


@dataclass(frozen=True)
class _FactorSpace(Frozen):
    """Q = LL' + f I and R = GG' + f I, the entries of L and G but G[0, 0] as parameters."""

    plant: Plant
    start: Array
    fixed: float  # G[0, 0]
    lift: float  # f

    @classmethod
    def around(cls, plant: Plant, weights: Weights, floor: float) -> _FactorSpace:
        scaled = normalised(weights)
        lift = floor * float(np.trace(scaled.block)) / (plant.n + plant.m)
        factors = [
            np.linalg.cholesky(matrix - lift * np.eye(len(matrix)))
            for matrix in (lifted(scaled.Q, 2 * lift), lifted(scaled.R, 2 * lift))
        ]
        entries = [factor[np.tril_indices(len(factor))] for factor in factors]
        return cls(
            plant,
            frozen(np.concatenate([entries[0], entries[1][1:]])),
            float(entries[1][0]),
            lift,
        )

    def factors(self, parameters: Array) -> tuple[Array, Array]:
        n, m = self.plant.n, self.plant.m
        L, G, count = np.zeros((n, n)), np.zeros((m, m)), n * (n + 1) // 2
        L[np.tril_indices(n)] = parameters[:count]
        G[np.tril_indices(m)] = np.concatenate([[self.fixed], parameters[count:]])
        return L, G

    def solution(self, parameters: Array) -> LqrSolution | None:
        """The regulator, or None where the Riccati equation cannot be solved."""
        L, G = self.factors(parameters)
        Q, R = L @ L.T + self.lift * np.eye(len(L)), G @ G.T + self.lift * np.eye(len(G))
        try:
            return solve_lqr(self.plant, Weights(Q, R))
        except WeightsError:
            return None

    def jacobian(self, parameters: Array) -> Array:
        """d vec(K) / d parameters: dQ = EL' + LE' for the unit matrix E of an entry."""
        solution = self.solution(parameters)
        assert solution is not None  # asked for only where the difference is finite
        L, G = self.factors(parameters)
        gradients = gain_gradients(solution)
        on_q = 2 * (gradients.Q @ L)[..., *np.tril_indices(len(L))]
        on_r = 2 * (gradients.R @ G)[..., *np.tril_indices(len(G))][..., 1:]
        return np.concatenate([on_q, on_r], axis=2).reshape(solution.K.size, -1)


def _default_start(plant: Plant, K: Array) -> Weights:
    if not stabilises(plant, K):
        return Weights(np.eye(plant.n), np.eye(plant.m))
    found = inverse_lqr_cross_term(plant, K)
    # Q is often singular there. A lift of 1e-4 would undo the start on the seat plant, where the
    # eigenvalues span 1e8: a gain error of 7 % after 300 evaluations, from this one 6e-6.
    return Weights(lifted(found.Q, 1e-8 * float(np.linalg.norm(found.Q, 2))), found.R)


def _no_weights(status: str) -> InverseLqr:
    return InverseLqr(None, None, np.inf, np.inf, False, "lmi", 0, status)


def _result(
    solution: LqrSolution, target: Array, method: str, evaluations: int, status: str
) -> InverseLqr:
    error = float(np.linalg.norm(solution.K - target))
    weights = normalised(solution.weights)
    # A gain of zero, as of a delay, is found to the round-off of the matrices that it is made of.
    plant = solution.plant
    usual = float(np.linalg.norm(plant.A) / np.linalg.norm(plant.B))
    size = float(np.linalg.norm(target)) + 1e-4 * usual
    return InverseLqr(
        weights,
        solution.K,
        error,
        condition_number(weights),
        error <= 1e-8 * size,
        method,
        evaluations,
        status,
    )


@dataclass(frozen=True)
class CrossTerm(Frozen):
    """Weights of  x'Qx + 2 x'Su + u'Ru  that have the gain exactly, with the least cross term."""

    Q: Array  # Shapes (n, n), (m, m), (n, m); R >= I sets the scale
    R: Array
    S: Array
    norm: float  # ||S||_F
    status: str  # The solver's word


@checked(gain="m n")
def inverse_lqr_cross_term(plant: Plant, gain: ArrayLike) -> CrossTerm:
    """Least cross term with which a quadratic cost has exactly the `gain` (m, n).

    minimise ||S||_F subject to R >= I, [Q S; S' R] >= 0, where P and R are free and, with
    F = A - BK,

        discrete:    S' = RK - B'PF,    Q = P - F'PF + SK + K'S' - K'RK
        continuous:  S' = RK - B'P,     Q = -F'P - PF + SK + K'S' - K'RK

    P >= 0 follows, for F is stable. Dropping S gives a start for `inverse_lqr_gradient`.
    """
    n, m = plant.n, plant.m
    K = finite_array("gain", gain, (m, n))
    F = plant.A - plant.B @ K
    if not is_stable(F, discrete=plant.discrete):
        raise WeightsError("gain", "A - BK is not stable", "no quadratic cost has such a gain")
    P, R = block_basis(n, m)[:, :n, :n], block_basis(n, m)[:, n:, n:]
    cost_to_go = plant.B.T @ P @ F if plant.discrete else plant.B.T @ P
    decay = P - F.T @ P @ F if plant.discrete else -(F.T @ P + P @ F)
    S = (R @ K - cost_to_go).transpose(0, 2, 1)
    Q = decay + S @ K + (S @ K).transpose(0, 2, 1) - K.T @ R @ K
    joint = np.block([[Q, S], [S.transpose(0, 2, 1), R]])
    # The joint inequality is written in units of the natural spread of states and inputs, and the
    # unknowns are rotated to be orthonormal in it: ||S|| to 3e-8 on the published example; in full
    # natural coordinates, correlations too, only to 7e-4.
    spread = np.concatenate(
        [np.linalg.norm(part, axis=1) for part in natural_coordinates(plant, K)]
    )
    scaled = joint * np.outer(spread, spread)
    seen, triangle = np.linalg.qr(scaled.reshape(len(joint), -1).T)
    joint = np.tensordot(np.linalg.inv(triangle).T, joint, 1)
    S, R = joint[:, :n, n:].reshape(len(joint), -1), joint[:, n:, n:]
    bound = np.eye(len(joint) + 1)[-1]
    cones = [
        norm_bound(_padded(S / np.linalg.norm(S)), bound),
        matrix_inequality(-np.eye(m), _padded(R)),
        matrix_inequality(np.zeros((n + m, n + m)), _padded(seen.T.reshape(joint.shape))),
    ]
    found = solve_semidefinite(bound, cones)
    total = np.tensordot(found.y[:-1], joint, 1)
    cross = frozen((total[:n, n:] + total[n:, :n].T) / 2)
    # The solver keeps Q >= 0 and R >= I to 1e-11 of the largest number in the program, which left a
    # negative eigenvalue in 11 of 406 random exact recordings.
    total[:n, :n] = lifted(total[:n, :n], 0.0)
    total[n:, n:] = lifted(total[n:, n:], 1.0)
    weights = split_blocks(total, n)
    return CrossTerm(weights.Q, weights.R, cross, float(np.linalg.norm(cross)), found.status)


def lifted(matrix: Array, least: float) -> Array:
    """A symmetric matrix with its eigenvalues raised to a least one."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    raised: Array = (vectors * np.maximum(values, least)) @ vectors.T
    return (raised + raised.T) / 2


def _padded(stack: Array) -> Array:
    """One more member, of zeros: the bound does not enter here."""
    return np.concatenate([stack, np.zeros_like(stack[:1])])
