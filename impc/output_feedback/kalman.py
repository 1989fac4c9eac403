"""The stationary Kalman filter and its exact derivatives.

    z+ = F z + w,  w ~ N(0, Q),      y = C z + e,  e ~ N(0, R)
    P = F P F' + Q - L S L',         S = C P C' + R,         L = F P C' S^-1

where P is the covariance of z given all earlier y. The equation is the regulator's with F', C' for
A, B, and likewise stationary in L, so that its differential does not contain dL: with G = F - L C
and dG = dF - L dC,

    dP = G dP G' + dG P G' + G P dG' + dQ + L dR L'
    dL = (dF P C' + F dP C' + F P dC' - L dS) S^-1,    dS = C dP C' + dC P C' + C P dC' + dR
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Array
from impc.errors import SolverError
from impc.model.riccati import is_stable, lyapunov_series

# Doublings: 2^40 samples exceed the memory of any filter that is stable in double precision.
_DOUBLINGS = 40
_SETTLED = 1e-16
# Entries beyond this count as divergent; their square is still finite.
_LARGEST = 1e100


class StationaryFilter(NamedTuple):
    """A stationary filter."""

    P: Array  # (n, n), covariance of the state given all earlier outputs
    L: Array  # (n, p), gain from an innovation to the next state
    S: Array  # (p, p), covariance of an innovation


class FilterChanges(NamedTuple):
    """Derivatives of a `StationaryFilter` along k directions (first axis)."""

    P: Array  # (k, n, n)
    L: Array  # (k, n, p)
    S: Array  # (k, p, p)


def stationary_filter(F: Array, C: Array, Q: Array, R: Array) -> StationaryFilter:
    """Solve the Riccati equation by doubling (Anderson 1978), insensitive to scaling.

    `F` (n, n); `C` (p, n); `Q` (n, n); `R` (p, p).
    """
    try:
        P = _doubled(F, C, Q, R)
        S = C @ P @ C.T + R
        L = np.linalg.solve(S, C @ P @ F.T).T
    except np.linalg.LinAlgError:
        raise _no_filter() from None
    if not is_stable(F - L @ C, discrete=True):
        raise _no_filter()
    return StationaryFilter(P, np.asarray(L), S)


def _doubled(F: Array, C: Array, Q: Array, R: Array) -> Array:
    eye = np.eye(len(F))
    A, G, P = F.T, C.T @ np.linalg.solve(R, C), np.array(Q)
    for _ in range(_DOUBLINGS):
        if not (np.max(np.abs(A)) < _LARGEST and np.max(np.abs(P)) < _LARGEST):
            raise _no_filter()
        left = np.linalg.solve((eye + G @ P).T, A.T).T  # A (I + G P)^-1
        change = A.T @ P @ np.linalg.solve(eye + G @ P, A)
        A, G, P = left @ A, G + left @ G @ A.T, P + (change + change.T) / 2
        if np.max(np.abs(change)) <= _SETTLED * np.max(np.abs(P)):
            break
    return P


def filter_changes(
    found: StationaryFilter,
    given: tuple[Array, Array],
    dF: Array,
    dC: Array,
    dQ: Array,
    dR: Array,
) -> FilterChanges:
    """Differentiate a stationary filter along k directions.

    `dF` (k, n, n); `dC` (k, p, n); `dQ` (k, n, n); `dR` (k, p, p).
    """
    F, C = given
    P, L, S = found
    turned = (dF - L @ dC) @ P @ (F - L @ C).T
    dP = lyapunov_series(F - L @ C, turned + turned.transpose(0, 2, 1) + dQ + L @ dR @ L.T)
    seen = dC @ P @ C.T
    dS = C @ dP @ C.T + seen + seen.transpose(0, 2, 1) + dR
    product = dF @ P @ C.T + F @ dP @ C.T + F @ P @ dC.transpose(0, 2, 1) - L @ dS
    dL = np.linalg.solve(S.T, product.transpose(0, 2, 1)).transpose(0, 2, 1)
    return FilterChanges(dP, np.asarray(dL), dS)


def _no_filter() -> SolverError:
    return SolverError(
        "observer",
        "has no stationary Kalman filter: a mode that does not decay is unobserved or noise-free",
        "add a signal to `sensed`, or set motor or process noise above zero",
    )
