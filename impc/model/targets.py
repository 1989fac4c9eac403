"""Steady states of a plant for given targets (target calculator).

    minimise |H x_s - r|^2 + |D z_s|^2 over z_s = (x_s, u_s)
    subject to x_s = A x_s + B u_s + E d,  E_b x_s + F_b u_s <= b

where r are targets of the signals H x and d is a lasting disturbance. D spans what neither the
equation nor the targets determine, so that the solution of minimum norm is taken. If no steady
state lies within the bounds they are ignored: the controller then stays at its limit. For given
active bounds z_s solves one linear system, whose derivative is that of the target
(docs/why/theory.md, section 7).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from impc.arrays import Array, as_numbers
from impc.checking import checked
from impc.errors import DataError
from impc.model.bounds import BoundRows, Bounds, bound_rows
from impc.model.plant import Plant

# Relative violation up to which a target satisfies a bound.
_KEPT = 1e-12


@dataclass(frozen=True)
class PlantChange:
    """Derivatives of a plant along p directions (last axis)."""

    A: Array  # (n, n, p)
    B: Array  # (n, m, p)
    E: Array  # (n, d, p)
    H: Array  # (q, n, p), rows of the signals with targets
    bounds: Array  # (c, p), right sides


@checked(disturbance="d")
def steady_state(
    plant: Plant,
    target: Mapping[str, float] | None = None,
    disturbance: ArrayLike | None = None,
    bounds: Bounds | None = None,
) -> tuple[Array, Array]:
    """Return the steady state and command of a plant at a target, as near as its bounds allow.

    Parameters
    ----------
    plant : Plant
        Discrete-time plant.
    target : mapping of str to float, optional
        Values of outputs or states by name, in their units.
    disturbance : array_like, optional
        Lasting disturbance (d,); zero by default.
    bounds : Bounds, optional
        Bounds of states and inputs; none by default.

    Returns
    -------
    x : ndarray of shape (n,)
        State; of several solutions the one of minimum norm.
    u : ndarray of shape (m,)
        Command.

    Raises
    ------
    DataError
        If the plant has no such signal, or a value is not finite.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> spring = control.ss([[0.9, 0.1], [-0.2, 0.8]], [[0], [0.1]], [[1, 0]], 0, 0.1)
    >>> plant = impc.Plant(spring)
    >>> x, u = impc.steady_state(plant, {"y[0]": 0.5})
    >>> x.round(3), u.round(3)
    (array([0.5, 0.5]), array([2.]))
    """
    plant.require_discrete()
    values, names = reference(plant, target, 1)
    push = np.zeros((1, plant.E.shape[1]))
    if disturbance is not None:
        push += np.asarray(disturbance)
    found = SteadyStates(plant, signal_rows(plant, names), bounds or Bounds(plant))
    z, _ = found.at(values, push)
    return z[0, : plant.n], z[0, plant.n :]


def reference(
    plant: Plant, target: Mapping[str, ArrayLike] | None, samples: int
) -> tuple[Array, tuple[str, ...]]:
    """Targets as columns (samples, q), and their names; a number holds for all samples."""
    names = tuple(target or {})
    signal_rows(plant, names)
    columns = np.empty((samples, len(names)))
    for place, (name, given) in enumerate((target or {}).items()):
        values = as_numbers(f"target {name}", given)
        if values.shape not in ((), (samples,)) or not np.all(np.isfinite(values)):
            raise DataError(
                f"target {name}",
                f"has shape {values.shape}, or values that are not finite",
                f"give one number, or {samples} of them",
            )
        columns[:, place] = values
    return columns, names


def signal_rows(plant: Plant, names: tuple[str, ...]) -> Array:
    """Rows (q, n) that give outputs or states by name."""
    rows = dict(zip(plant.states, np.eye(plant.n), strict=True))
    rows |= dict(zip(plant.outputs, plant.C, strict=True))
    for name in names:
        if name not in rows:
            known = ", ".join(dict.fromkeys((*plant.outputs, *plant.states)))
            raise DataError("target", f"there is no signal {name!r}", f"choose from {known}")
    return np.array([rows[name] for name in names]).reshape(len(names), plant.n)


def expected_disturbance(plant: Plant, disturbance: Array, rates: Array) -> tuple[Array, Array]:
    """Disturbance estimated by the plant's observer (steps, d); derivative along rates (d, p).

    dh+ = dh + (1 - exp(-rate dt)) (d - dh), from dh = 0; d itself if the rate is infinite.
    """
    expected = np.array(disturbance)
    slopes = np.zeros((*disturbance.shape, rates.shape[1]))
    for place, rate in enumerate(plant.observer):
        if np.isinf(rate):
            continue
        left = np.exp(-rate * plant.dt)
        late = np.r_[0.0, disturbance[:-1, place]] if len(disturbance) else disturbance[:, place]
        expected[:, place] = scipy.signal.lfilter([1 - left], [1, -left], late)
        missed = np.r_[0.0, late[1:] - expected[:-1, place]]
        slope = scipy.signal.lfilter([plant.dt * left], [1, -left], missed)
        slopes[:, place] = np.multiply.outer(slope, rates[place])
    return expected, slopes


class SteadyStates:
    """Target calculator of a plant with rows H (q, n) of the signals that have a target."""

    def __init__(self, plant: Plant, H: Array, bounds: Bounds) -> None:
        self.plant, self.n, size = plant, plant.n, plant.n + plant.m
        self.rows: BoundRows = bound_rows(bounds, plant)
        self.G = np.hstack([self.rows.E, self.rows.F])
        self.rest = np.hstack([plant.A - np.eye(plant.n), plant.B])
        wide = np.hstack([H, np.zeros((len(H), plant.m))])
        free = scipy.linalg.null_space(np.vstack([self.rest, wide])).T
        self.wide = np.vstack([wide, free.reshape(-1, size)])
        self.count = len(H)

    def at(self, values: Array, pushes: Array) -> tuple[Array, list[tuple[tuple[int, ...], Array]]]:
        """Steady states (T, n + m) at `values` (T, q) and `pushes` (T, d); active bounds.

        The latter are pairs (active bounds, indices of the samples at which they are active).
        """
        z = self._solve((), values, pushes)[:, : self.G.shape[1]]
        excess = z @ self.G.T - self.rows.b
        beyond = np.any(excess > _KEPT * self.rows.b, axis=1)
        groups: dict[tuple[int, ...], list[int]] = {}
        if not np.all(beyond):
            groups[()] = np.flatnonzero(~beyond).tolist()
        for place in np.flatnonzero(beyond).tolist():
            groups.setdefault(self._active(-excess[place]), []).append(place)
        found = [(active, np.array(places, dtype=int)) for active, places in groups.items()]
        for active, places in found:
            if active:
                z[places] = self._solve(active, values[places], pushes[places])[:, : z.shape[1]]
        return z, found

    def slopes(
        self,
        values: Array,
        pushes: Array,
        dpushes: Array,
        groups: list[tuple[tuple[int, ...], Array]],
        along: PlantChange,
    ) -> Array:
        """Derivatives (T, n + m, p) of targets along changes of plant and pushes."""
        width, p = self.G.shape[1], along.A.shape[2]
        slopes = np.zeros((len(values), width, p))
        drest = np.concatenate([along.A, along.B], axis=1)
        dwide = np.zeros((*self.wide.shape, p))
        dwide[: self.count, : self.n] = along.H
        # The null-space basis rotates with the plant: dD' = -N^+ dN D', N = [A - I, B; H, 0].
        free, kept = self.wide[self.count :], np.vstack([self.rest, self.wide[: self.count]])
        dkept = np.concatenate([drest, dwide[: self.count]])
        dwide[self.count :] = -np.einsum("jr,rip,ki->kjp", np.linalg.pinv(kept), dkept, free)
        for active, places in groups:
            solved = self._solve(active, values[places], pushes[places])
            z, lam = solved[:, :width], solved[:, width : width + self.n]
            r = np.hstack([values[places], np.zeros((len(places), len(dwide) - self.count))])
            left = r - z @ self.wide.T
            right = np.zeros((len(places), solved.shape[1], p))
            right[:, :width] = np.einsum("tr,rip->tip", left, dwide)
            right[:, :width] -= np.einsum("ri,rjp,tj->tip", self.wide, dwide, z)
            right[:, :width] -= np.einsum("rip,tr->tip", drest, lam)
            right[:, width : width + self.n] = (
                -np.einsum("ijp,tj->tip", along.E, pushes[places])
                - np.einsum("ij,tjp->tip", self.plant.E, dpushes[places])
                - np.einsum("ijp,tj->tip", drest, z)
            )
            right[:, width + self.n :] = along.bounds[list(active)]
            flat = right.transpose(1, 0, 2).reshape(solved.shape[1], -1)
            moved = np.linalg.solve(self._system(active), flat).reshape(-1, len(places), p)
            slopes[places] = moved[:width].transpose(1, 0, 2)
        return slopes

    def _system(self, active: tuple[int, ...]) -> Array:
        equations = np.vstack([self.rest, self.G[list(active)]])
        zero = np.zeros((len(equations), len(equations)))
        return np.block([[self.wide.T @ self.wide, equations.T], [equations, zero]])

    def _solve(self, active: tuple[int, ...], values: Array, pushes: Array) -> Array:
        limits = np.tile(self.rows.b[list(active)], (len(values), 1))
        aimed = values @ self.wide[: self.count]
        right = np.hstack([aimed, -pushes @ self.plant.E.T, limits])
        return np.asarray(np.linalg.solve(self._system(active), right.T).T)

    def _active(self, slack: Array) -> tuple[int, ...]:
        """Bounds that are active at the target; none if no target satisfies them.

        From the unbounded target z the cost is |y|^2 with y = R c, z + N c, QR = wide N: a
        least-distance problem, solved as non-negative least squares (Lawson and Hanson).
        """
        N = scipy.linalg.null_space(self.rest)
        R = np.linalg.qr(self.wide @ N, mode="r")
        towards = -scipy.linalg.solve_triangular(R, (self.G @ N).T, trans="T") / self.rows.b
        table = np.vstack([towards, -slack / self.rows.b])
        wanted = np.r_[np.zeros(len(towards)), 1.0]
        multipliers, distance = scipy.optimize.nnls(table, wanted)
        if distance <= _KEPT:
            return ()
        return tuple(np.flatnonzero(multipliers > 0).tolist())
