"""Rows of the controller's least-distance problem, and their derivatives.

Every constraint is one row (family c, stage k): bound c of `bound_rows`, k samples ahead. With
H = E - F K and the closed loop Phi = A - BK, the row is

    H_c Phi^k x + sum_{i < min(k, N)} H_c Phi^(k-1-i) B v_i + [k < N] F_c v_k  <=  b_c.

Stages k < N are the bounds along the horizon. A row (c, j) of the maximal invariant set is the same
row at stage k = N + j, where no v is left: the terminal set depends on K through the same formula.
In short  T x + M v <= b  (docs/why/theory.md, section 3). The rows of a user-supplied terminal set
are further bounds, E = H and F = 0, at stage N only. If each stage has its own gain, products
Phi_{k-1} ... Phi_i replace the powers.

A long horizon can be solved with the first a inputs v_i and the rows of the first a stages: if the
solution satisfies the rows of all later stages as well, it solves the whole problem.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, IntArray
from impc.checking import checked
from impc.control.compiled_values import RowDirections, Rows
from impc.control.controller import Controller
from impc.errors import DataError, InputError
from impc.model.body import Body
from impc.model.bounds import BoundRows, bound_rows
from impc.model.riccati import FiniteHorizonLqr, finite_horizon_changes


@dataclass(frozen=True)
class Directions:
    """Directions along which a closed loop is differentiated (last axis of every array)."""

    A: Array  # (n, n, p), plant matrices
    B: Array  # (n, m, p)
    E: Array  # (n, d, p)
    K: Array  # (m, n, p), gain; (N m, n, p) if each stage has its own
    S: Array  # (m, m, p), of the scaled metric of `Controller`; or (N m, m, p)
    bounds: Array  # (c, p), right sides b of `bound_rows`
    C: Array  # (outputs, n, p), moves targets
    observer: Array  # (d, p), rates of the observer, move targets
    x0: Array  # (n, p), initial state
    # for each direction, nearby bodies with factors (`PlantDifferential`); may be empty
    bodies: tuple[tuple[tuple[float, Body], ...], ...] = ()

    @property
    def count(self) -> int:
        """Number of directions p."""
        return self.x0.shape[1]


@checked(count=(0, 1_000_000))
def directions(controller: Controller, count: int, **given: Array) -> Directions:
    """Return `count` directions with the given parts; all others are zero.

    Parameters
    ----------
    controller : Controller
        Controller whose loop is differentiated.
    count : int
        Number of directions p.
    **given : ndarray
        Parts by name, in any layout that reshapes to theirs, the last axis of length p: A, B, E, K,
        S, bounds, C, observer or x0; for example K as (m, n, p). For a controller with its own
        terminal weight Q, R and P, (n, n, p), (m, m, p) and (n, n, p), replace A, B, K and S; their
        symmetric parts count.

    Returns
    -------
    Directions
        Arrays with p as last axis.

    Raises
    ------
    InputError, DataError
        If a part has an unknown name or wrong size.

    Examples
    --------
    >>> import impc
    >>> import numpy as np
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> law = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> impc.directions(law, 2, K=np.eye(2)).K.shape
    (1, 2, 2)
    """
    plant = controller.plant
    rows = bound_rows(controller.bounds, plant)
    shapes = {
        "A": plant.A.shape,
        "B": plant.B.shape,
        "E": plant.E.shape,
        "K": controller.K.shape,
        "S": controller.S.shape,
        "bounds": rows.b.shape,
        "C": plant.C.shape,
        "observer": plant.observer.shape,
        "x0": (plant.n,),
    }
    if controller.stages is not None:
        n, m = plant.n, plant.m
        still = {name: np.zeros((*shapes.pop(name), count)) for name in "ABKS"}
        shapes |= {"Q": (n, n), "R": (m, m), "P": (n, n)}
    parts = {name: np.zeros((*shape, count)) for name, shape in shapes.items()}
    for name, values in given.items():
        if name not in shapes:
            raise InputError(name, "is no part of a direction", f"use {', '.join(shapes)}")
        if values.size != parts[name].size:
            problem = f"expected {parts[name].shape}, got {values.shape}"
            raise DataError(name, problem, "give a part for each direction")
        parts[name] = np.ascontiguousarray(values).reshape(*shapes[name], count)
    if controller.stages is not None:
        changes = [np.moveaxis(parts.pop(name), -1, 0) for name in "QRP"]
        parts |= still | _stage_directions(controller.stages, *changes)
    return Directions(**parts, bodies=())


def _stage_directions(stages: FiniteHorizonLqr, *changes: Array) -> dict[str, Array]:
    """K (N m, n, p) and S (N m, m, p) along changes of Q, R and P, each (p, ., .)."""
    dK, dS = finite_horizon_changes(stages, *((dX + dX.swapaxes(1, 2)) / 2 for dX in changes))
    m, trace = stages.S.shape[-1], np.trace(stages.S[0])
    share = np.trace(dS[0], axis1=1, axis2=2)[:, None, None] / trace
    dS = (dS - share * stages.S[:, None]) * (m / trace)  # scaled like the first
    below = (np.moveaxis(part, 1, -1) for part in (dK, dS))
    return {
        name: np.ascontiguousarray(part.reshape(len(part) * part.shape[1], *part.shape[2:]))
        for name, part in zip("KS", below, strict=True)
    }


def build_rows(controller: Controller, stages: int | None = None) -> Rows:
    """Return the rows of the controller's problem, with the inputs of the first `stages` only."""
    stages = controller.horizon if stages is None else stages
    bounds = families(controller)
    family, stage = _pairs(controller, bounds)
    if controller.stages is None:
        powers = _powers(controller, bounds, int(stage.max(initial=0)))
        T = powers[stage, family]
        M = _inputs(stages, family, stage, powers @ controller.plant.B, bounds.F)
    else:
        none = np.zeros((0, *controller.gains.shape))
        T, M, _, _ = _unrolled(controller, bounds, family, stage, none)
    head = _head(controller, stage, stages)
    metrics = controller.metrics[:stages]
    by_stage = np.moveaxis(M[:head].reshape(head, *metrics.shape[:2]), 0, 2)
    W, N = (
        np.ascontiguousarray(np.moveaxis(np.linalg.solve(part, by_stage), 2, 0)).reshape(
            M[:head].shape
        )
        for part in (np.linalg.cholesky(metrics), metrics)
    )
    b = bounds.b[family]
    soft = (bounds.on_state[family] | (stage >= controller.horizon))[:head]
    limit = np.where(soft, controller.penalty / b[:head], np.inf)
    reach = np.minimum(controller.plant.m * (stage[:head] + 1), M.shape[1])
    return Rows(T, M, N, W, W @ W.T, b, limit, family, stage, reach)


def differentiate_rows(
    controller: Controller, along: Directions, stages: int | None = None
) -> RowDirections:
    """Return the derivatives of the rows along the given directions, `stages` as in `build_rows`.

    With G_k = H Phi^k:  dG_{k+1} = dG_k Phi + G_k dPhi,  dPhi = dA - dB K - B dK,  dH = -F dK.
    """
    stages = controller.horizon if stages is None else stages
    plant, K = controller.plant, controller.K
    bounds = families(controller)
    family, stage = _pairs(controller, bounds)
    head = _head(controller, stage, stages)
    family, stage = family[:head], stage[:head]
    fixed = np.zeros((len(bounds.b) - len(along.bounds), along.count))
    db = np.concatenate([along.bounds, fixed])[family]
    if controller.stages is not None:
        gains = np.moveaxis(along.K, -1, 0).reshape(-1, *controller.gains.shape)
        _, _, dT, dM = _unrolled(controller, bounds, family, stage, gains)
        return RowDirections(dT, dM, db)
    last = int(stage.max(initial=0))
    dK, dA, dB = (np.moveaxis(part, -1, 0) for part in (along.K, along.A, along.B))
    closed = plant.A - plant.B @ K
    dclosed = dA - dB @ K - plant.B @ dK
    powers = _powers(controller, bounds, last)
    dpowers = np.empty((last + 1, along.count, len(bounds.b), plant.n))
    dpowers[0] = -bounds.F @ dK
    for k in range(last):
        dpowers[k + 1] = dpowers[k] @ closed + powers[k] @ dclosed
    dresponse = dpowers @ plant.B + powers[:, None] @ dB  # of H Phi^k B, (stage, p, c, m)
    dresponse = np.moveaxis(dresponse, 1, -1)
    dM = _inputs(stages, family, stage, dresponse, np.zeros_like(dresponse[0]))
    dT = np.ascontiguousarray(np.moveaxis(dpowers[stage, :, family], 1, -1))
    return RowDirections(dT, dM, db)


def _head(controller: Controller, stage: IntArray, stages: int) -> int:
    """Number of rows of the first `stages`; all rows, terminal set included, if these are all."""
    return len(stage) if stages == controller.horizon else int(np.sum(stage < stages))


def families(controller: Controller) -> BoundRows:
    """Bounds of one stage, followed by the rows of a user-supplied terminal set."""
    bounds, terminal = bound_rows(controller.bounds, controller.plant), controller.terminal
    if terminal is None or not terminal.own:
        return bounds
    both = [bounds, terminal.rows]
    E, F, b = (np.concatenate([getattr(one, name) for one in both]) for name in "EFb")
    on_state = np.concatenate([one.on_state for one in both])
    return BoundRows(E, F, b, on_state, bounds.names + terminal.rows.names)


def _pairs(controller: Controller, bounds: BoundRows) -> tuple[IntArray, IntArray]:
    """Pairs (family, stage): the horizon first, then the terminal set.

    A state bound at stage 0 does not depend on the input. It is kept if hard, so that a state
    outside is reported; a soft one would only add a constant.
    """
    terminal = controller.terminal
    own = len(terminal.h) if terminal is not None and terminal.own else 0
    count = len(bounds.b) - own
    family, stage = np.meshgrid(np.arange(count), np.arange(controller.horizon))
    keep = (stage > 0) | ~bounds.on_state[family] | (controller.softening is None)
    which, stages = [family[keep]], [stage[keep]]
    if terminal is not None:
        which.append(np.asarray(terminal.family) + (count if own else 0))
        stages.append(np.asarray(terminal.step) + controller.horizon)
    return np.concatenate(which).astype(np.int64), np.concatenate(stages).astype(np.int64)


def _powers(controller: Controller, bounds: BoundRows, last: int) -> Array:
    """H Phi^k for k = 0..last: (last + 1, c, n)."""
    plant = controller.plant
    closed = plant.A - plant.B @ controller.K
    powers = np.empty((last + 1, len(bounds.b), plant.n))
    powers[0] = bounds.E - bounds.F @ controller.K
    for k in range(last):
        powers[k + 1] = powers[k] @ closed
    return powers


def _unrolled(
    controller: Controller, bounds: BoundRows, family: IntArray, stage: IntArray, dK: Array
) -> tuple[Array, Array, Array, Array]:
    """T, M and their derivatives along dK (p, N, m, n), backwards by x+ = (A - B K_k) x + B v."""
    A, B, gains = controller.plant.A, controller.plant.B, controller.gains
    N, m, _ = gains.shape
    F, last = bounds.F[family], np.minimum(stage, N - 1)
    T = bounds.E[family] - (F[:, None] @ gains[last])[:, 0]  # stage N has no input and F = 0
    dT = -(F[:, None] @ dK[:, last])[:, :, 0]
    M, dM = np.zeros((len(T), N, m)), np.zeros((*dT.shape[:2], N, m))
    for k in reversed(range(N)):
        now, later = stage == k, stage > k
        closed = A - B @ gains[k]
        M[now, k], M[later, k], dM[:, later, k] = F[now], T[later] @ B, dT[:, later] @ B
        dT[:, later] = dT[:, later] @ closed - T[later] @ (B @ dK[:, k])
        T[later] = T[later] @ closed
    dT, dM = (np.ascontiguousarray(np.moveaxis(part, 0, -1)) for part in (dT, dM))
    return T, M.reshape(len(T), -1), dT, dM.reshape(len(T), N * m, len(dK))


def _inputs(
    horizon: int, family: IntArray, stage: IntArray, response: Array, direct: Array
) -> Array:
    """Place the response H Phi^j B at column k - 1 - j, and the direct term at column k < N."""
    placed = np.zeros((len(family), horizon, *direct.shape[1:]))
    delay = stage[:, None] - 1 - np.arange(horizon)
    row, column = np.nonzero(delay >= 0)
    placed[row, column] = response[delay[row, column], family[row]]
    inside = np.nonzero(stage < horizon)[0]
    placed[inside, stage[inside]] = direct[family[inside]]
    return placed.reshape(len(family), horizon * direct.shape[1], *direct.shape[2:])
