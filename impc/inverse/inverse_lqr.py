"""Inverse LQR: weights (Q, R) whose optimal gain is a given gain, or the nearest one.

Three methods, as in Table 3.1: a linear matrix inequality, feasible only if some weights have
exactly the gain; the same with a cross term x'Su in the cost, always feasible; and the gradient of
the distance between the gains. After Priess et al., IEEE TCST 23 (2015) 770.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.optimize
from numpy.typing import ArrayLike

from impc.arrays import Array, Frozen, finite_array, frozen
from impc.checking import checked
from impc.errors import WeightsError
from impc.inverse.equivalent_weights import least_condition_weights, weights_margin
from impc.inverse.proximal_step import block_basis
from impc.inverse.semidefinite import matrix_inequality, norm_bound, solve_semidefinite
from impc.inverse.solution_set import gain_fibre, natural_coordinates, split_blocks
from impc.model.plant import Plant
from impc.model.riccati import LqrSolution, gain_gradients, is_stable, solve_lqr, stabilises
from impc.model.weights import Weights, condition_number, normalised

# Floor of the eigenvalues in the gradient method, relative to the mean eigenvalue of the start.
_FLOOR = 1e-9


@dataclass(frozen=True)
class InverseLqr(Frozen):
    """Weights for a gain, or the result that none exist."""

    weights: Weights | None  # Scaled to R[0, 0] = 1; None if no weights have the gain
    gain: Array | None  # K(Q, R) of these weights, (m, n)
    gain_error: float  # ||K(Q, R) - K||_F; infinite without weights
    condition: float  # Condition number of blkdiag(Q, R); infinite without weights
    # Whether weights with exactly this gain were found (relative error <= 1e-8)
    feasible: bool
    method: str  # "lmi" or "gradient"
    evaluations: int  # Number of Riccati equations solved
    status: str  # Why the method ended


@checked(gain="m n")
def inverse_lqr_lmi(plant: Plant, gain: ArrayLike) -> InverseLqr:
    """Return the weights of least condition number with exactly a given gain, if any exist.

    Parameters
    ----------
    plant : Plant
        Discrete or continuous.
    gain : array_like of shape (m, n)
        Gain K of the control law u = -Kx.

    Returns
    -------
    InverseLqr
        `feasible` is False and `weights` is None if no weights have the gain: A - BK is not stable,
        or no definite (Q, R) exists.

    Raises
    ------
    SolverError
        If the semidefinite program cannot be solved.

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
    """Return weights whose gain is nearest to a given gain.

    Minimises ||K(Q, R) - K||_F^2 by Levenberg-Marquardt over the Cholesky factors of Q and R, with
    exact derivatives. The infimum may not be attained; Q then slowly approaches a singular matrix,
    and the condition number of the result is large. Two limits bound the search without affecting
    attained minima: the number of evaluations, and a floor Q = LL' + f I, R = GG' + f I with f =
    1e-9 times the mean eigenvalue of the start.

    Parameters
    ----------
    plant : Plant
        Discrete or continuous.
    gain : array_like of shape (m, n)
        Gain K; A - BK may be unstable.
    start : Weights, optional
        Starting weights. Default: weights with a cross term, cross term dropped; the identity if
        A - BK is not stable.
    max_evaluations : int, default 300
        Largest number of evaluations of the gain.

    Returns
    -------
    InverseLqr
        Nearest weights found, with their gain and its error.

    Raises
    ------
    WeightsError
        If the Riccati equation has no stabilising solution at the start.

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
        # No Riccati solution: an infinite residual shrinks the trust region.
        solution = space.solution(parameters)
        return np.full(K.size, np.inf) if solution is None else (solution.K - K).ravel()

    first = space.solution(space.start)
    if first is None:
        raise WeightsError(
            "start", "has no stabilising Riccati solution", "pass other starting weights"
        )
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
    """Q = LL' + f I, R = GG' + f I; parameters: the entries of L, and of G except G[0, 0]."""

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
        """Riccati solution, or None if the equation cannot be solved."""
        L, G = self.factors(parameters)
        Q, R = L @ L.T + self.lift * np.eye(len(L)), G @ G.T + self.lift * np.eye(len(G))
        try:
            return solve_lqr(self.plant, Weights(Q, R))
        except WeightsError:
            return None

    def jacobian(self, parameters: Array) -> Array:
        """d vec(K) / d parameters: dQ = EL' + LE' for the unit matrix E of an entry."""
        solution = self.solution(parameters)
        assert solution is not None  # called only at finite residuals
        L, G = self.factors(parameters)
        gradients = gain_gradients(solution)
        on_q = 2 * (gradients.Q @ L)[..., *np.tril_indices(len(L))]
        on_r = 2 * (gradients.R @ G)[..., *np.tril_indices(len(G))][..., 1:]
        return np.concatenate([on_q, on_r], axis=2).reshape(solution.K.size, -1)


def _default_start(plant: Plant, K: Array) -> Weights:
    if not stabilises(plant, K):
        return Weights(np.eye(plant.n), np.eye(plant.m))
    found = inverse_lqr_cross_term(plant, K)
    # Q is often singular there. A lift of 1e-4 spoils the start on the seat plant (eigenvalues span
    # 1e8): gain error 7 % after 300 evaluations, 6e-6 with this one.
    return Weights(lifted(found.Q, 1e-8 * float(np.linalg.norm(found.Q, 2))), found.R)


def _no_weights(status: str) -> InverseLqr:
    return InverseLqr(None, None, np.inf, np.inf, False, "lmi", 0, status)


def _result(
    solution: LqrSolution, target: Array, method: str, evaluations: int, status: str
) -> InverseLqr:
    error = float(np.linalg.norm(solution.K - target))
    weights = normalised(solution.weights)
    # A zero gain (of a delay state) has an error at the rounding level of A and B.
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
    """Weights of x'Qx + 2 x'Su + u'Ru with exactly a given gain and the least cross term."""

    Q: Array  # Shapes (n, n), (m, m), (n, m); R >= I sets the scale
    R: Array
    S: Array
    norm: float  # ||S||_F
    status: str  # Status of the solver


@checked(gain="m n")
def inverse_lqr_cross_term(plant: Plant, gain: ArrayLike) -> CrossTerm:
    """Least cross term with which a quadratic cost has exactly the `gain` (m, n).

    minimise ||S||_F subject to R >= I, [Q S; S' R] >= 0, where P and R are free and, with
    F = A - BK,

        discrete:    S' = RK - B'PF,    Q = P - F'PF + SK + K'S' - K'RK
        continuous:  S' = RK - B'P,     Q = -F'P - PF + SK + K'S' - K'RK

    P >= 0 follows because F is stable. Without S the weights start `inverse_lqr_gradient`.
    """
    n, m = plant.n, plant.m
    K = finite_array("gain", gain, (m, n))
    F = plant.A - plant.B @ K
    if not is_stable(F, discrete=plant.discrete):
        raise WeightsError("gain", "A - BK is not stable", "pass a stabilising gain")
    P, R = block_basis(n, m)[:, :n, :n], block_basis(n, m)[:, n:, n:]
    cost_to_go = plant.B.T @ P @ F if plant.discrete else plant.B.T @ P
    decay = P - F.T @ P @ F if plant.discrete else -(F.T @ P + P @ F)
    S = (R @ K - cost_to_go).transpose(0, 2, 1)
    Q = decay + S @ K + (S @ K).transpose(0, 2, 1) - K.T @ R @ K
    joint = np.block([[Q, S], [S.transpose(0, 2, 1), R]])
    # Scale the joint inequality by the whitened sizes of states and inputs, with orthonormal
    # unknowns: ||S|| is then accurate to 3e-8 on the published example; in full whitened
    # coordinates only to 7e-4.
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
    # The solver keeps Q >= 0 and R >= I only to 1e-11 of its largest number: a negative eigenvalue
    # in 11 of 406 random exact recordings.
    total[:n, :n] = lifted(total[:n, :n], 0.0)
    total[n:, n:] = lifted(total[n:, n:], 1.0)
    weights = split_blocks(total, n)
    return CrossTerm(weights.Q, weights.R, cross, float(np.linalg.norm(cross)), found.status)


def lifted(matrix: Array, least: float) -> Array:
    """Symmetric matrix with eigenvalues raised to at least `least`."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    raised: Array = (vectors * np.maximum(values, least)) @ vectors.T
    return (raised + raised.T) / 2


def _padded(stack: Array) -> Array:
    """Append a zero matrix for the bound variable, which does not enter here."""
    return np.concatenate([stack, np.zeros_like(stack[:1])])
