"""Convert between continuous feedback u(t) = -G x(t) and the gain K of a held command.

From a state x the continuous loop moves as exp(F s) x, F = A - B G, and the mean of its command
over a sample is

    -G M x,    M = (1/dt) integral of exp(F s) over a sample  (0 to dt).

The held command is that mean: K = G M. After one sample the states differ by O(dt^3), those of a
whole movement by O(dt^2); holding G itself would differ by O(dt) (docs/howto/fit.md). K is a smooth
function of G, which is inverted near K by Powell's hybrid method with the exact derivative.
"""

from __future__ import annotations

import numpy as np
import scipy

from impc.arrays import Array
from impc.errors import InputError, PlantError
from impc.model.plant import Plant

# Relative tolerances for the plant sampled again, and for the gain held again.
_SAMPLED, _HELD = 1e-8, 1e-11
# Smallest ratio of the singular values of A at which A counts as invertible.
_INVERTIBLE = 1e-13


def held_gain(plant: Plant, continuous: Array) -> Array:
    """Gain K (m, n) of the sampled plant that corresponds to a `continuous` gain (m, n)."""
    return _held(*unsampled(plant), plant.dt, continuous)[0]


def continuous_gain(plant: Plant, gain: Array) -> tuple[Array, Array]:
    """Continuous gain (m, n) of a held `gain` (m, n), and its Jacobian (m n, m n)."""
    A, B = unsampled(plant)

    def left(entries: Array) -> tuple[Array, Array]:
        held, slopes = _held(A, B, plant.dt, entries.reshape(gain.shape))
        return (held - gain).ravel(), slopes

    found = scipy.optimize.root(left, gain.ravel(), jac=True, tol=1e-15)
    missed, slopes = left(found.x)
    if not np.max(np.abs(missed)) <= _HELD * np.max(np.abs(gain)):
        raise InputError(
            "gain", "has no continuous-time gain near it", "sample the plant at a higher rate"
        )
    return found.x.reshape(gain.shape), np.asarray(np.linalg.inv(slopes))


def unsampled(plant: Plant) -> tuple[Array, Array]:
    """Continuous-time A (n, n) and B (n, m) whose sampled plant is `plant`."""
    plant.require_discrete()
    n, m = plant.B.shape
    if plant.commands:
        problem = "has changes of commands as controls, which do not exist in continuous time"
        raise PlantError("plant", problem, "pass the plant before with_rates")
    sizes = scipy.linalg.svdvals(scipy.linalg.matrix_balance(plant.A)[0])
    if sizes[-1] <= _INVERTIBLE * sizes[0]:
        problem = "has a singular A, for example because of a delay in samples"
        raise PlantError("plant", problem, "model the delay by pade_delay and sample with c2d")
    scale = np.maximum(np.max(np.abs(plant.B), axis=0), 1e-300)
    held = np.block([[plant.A, plant.B / scale], [np.zeros((m, n)), np.eye(m)]])
    found = scipy.linalg.logm(held)
    again = scipy.linalg.expm(found.real)
    if not np.max(np.abs(again - held)) <= _SAMPLED * np.max(np.abs(held)):
        problem = "has a mode that changes sign at every sample, which no continuous plant has"
        raise PlantError("plant", problem, "sample a continuous plant with c2d")
    rates = found.real / plant.dt
    return np.asarray(rates[:n, :n]), np.asarray(rates[:n, n:] * scale)


def _held(A: Array, B: Array, dt: float, G: Array) -> tuple[Array, Array]:
    """K = G M (m, n) and its Jacobian (m n, m n) with respect to the entries of G.

    exp([F I; 0 0] dt) contains the integral of exp(F s) in its upper right block.
    """
    n, m = B.shape
    whole, change = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 * n))
    whole[:n] = np.hstack([A - B @ G, np.eye(n)]) * dt
    M = scipy.linalg.expm(whole)[:n, n:] / dt
    slopes = []
    for dG in np.eye(m * n).reshape(-1, m, n):
        change[:n, :n] = -B @ dG * dt
        _, moved = scipy.linalg.expm_frechet(whole, change)
        slopes.append((dG @ M + G @ moved[:n, n:] / dt).ravel())
    return np.asarray(G @ M), np.array(slopes, dtype=np.float64).T
