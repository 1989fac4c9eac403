"""The rows of the controller's least-distance problem, and their derivatives.

Every constraint is one row (family c, stage k): the bound c of `bound_rows`, k samples ahead. With
H = E - F K and the closed loop Phi = A - BK, the row says

    H_c Phi^k x + sum_{i < min(k, N)} H_c Phi^(k-1-i) B v_i + [k < N] F_c v_k  <=  b_c.

Stages k < N are the bounds along the horizon. A row (c, j) of the maximal invariant set is the
same row at the stage k = N + j, where no v is left: the terminal set needs no code of its own,
and follows K through the same derivative. In short  T x + M v <= b  (docs/theory.md, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, IntArray
from impc.checking import checked
from impc.errors import DataError, InputError
from impc.model.bounds import bound_rows

if TYPE_CHECKING:
    from impc.control.controller import Controller
    from impc.model.body import Body
    from impc.model.bounds import BoundRows


class Rows(NamedTuple):
    """T x + M v <= b, and what the solver needs of it.

    A named tuple rather than a dataclass because compiled code takes it as it is.
    """

    T: Array  # (r, n)
    M: Array  # (r, N m), the columns of one stage beside each other
    N: Array  # M S^-1, (r, N m), with the metric S of each stage
    W: Array  # M L^-T with S = L L', (r, N m): the rows in coordinates in which S is the identity
    gram: Array  # W W' = M S^-1 M', (r, r)
    b: Array  # (r,)
    # Largest multiplier of each row (r,): infinite for a hard row, the cost weight of a unit of
    # excess for a soft one
    limit: Array
    family: IntArray  # Which bound, and how many samples ahead (r,)
    stage: IntArray


class RowDirections(NamedTuple):
    """Derivatives of `Rows` along p directions, which are the last axis of every array."""

    T: Array  # (r, n, p)
    M: Array  # (r, N m, p)
    b: Array  # (r, p)


@dataclass(frozen=True)
class Directions:
    """Directions along which a closed loop is differentiated, the last axis of every array."""

    A: Array  # Plant matrices: (n, n, p), (n, m, p), (n, d, p)
    B: Array
    E: Array
    K: Array  # Gain (m, n, p)
    S: Array  # Metric (m, m, p), of the scaled metric of `Controller`
    bounds: Array  # Right sides b of `bound_rows` (c, p)
    C: Array  # Outputs (outputs, n, p) and the observer's rates (d, p): they move targets
    observer: Array
    x0: Array  # Initial state (n, p)
    # For each direction, bodies nearby with factors (`PlantDifferential`); may be left empty
    bodies: tuple[tuple[tuple[float, Body], ...], ...] = ()

    @property
    def count(self) -> int:
        """Number of directions p."""
        return self.x0.shape[1]


@checked(count=(0, 1_000_000))
def directions(controller: Controller, count: int, **given: Array) -> Directions:
    """Return `count` directions with the given parts; those not given are zero.

    Parameters
    ----------
    count : int
        Number of directions p.
    **given : Array
        Fields of `Directions` by name, in any layout that reshapes to theirs: K to (m, n, p).

    Raises
    ------
    InputError, DataError
        When a part is of another name or size.

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
    parts = {name: np.zeros((*shape, count)) for name, shape in shapes.items()}
    for name, values in given.items():
        if name not in shapes:
            raise InputError(name, "is no part of a direction", f"give some of {', '.join(shapes)}")
        if values.size != parts[name].size:
            problem = f"expected {parts[name].shape}, got {values.shape}"
            raise DataError(name, problem, "give a part for each direction")
        parts[name] = np.ascontiguousarray(values).reshape(*shapes[name], count)
    return Directions(**parts, bodies=())


def build_rows(controller: Controller) -> Rows:
    """Return the rows of the controller's problem."""
    bounds = bound_rows(controller.bounds, controller.plant)
    family, stage = _pairs(controller, bounds)
    powers = _powers(controller, bounds, int(stage.max(initial=0)))
    M = _inputs(controller, family, stage, powers @ controller.plant.B, bounds.F)
    m = controller.plant.m
    factor = np.linalg.cholesky(controller.S)
    by_stage = M.reshape(-1, m).T
    W = np.ascontiguousarray(np.linalg.solve(factor, by_stage).T).reshape(M.shape)
    N = np.ascontiguousarray(np.linalg.solve(controller.S, by_stage).T).reshape(M.shape)
    b = bounds.b[family]
    soft = bounds.on_state[family] | (stage >= controller.horizon)
    limit = np.where(soft, controller.penalty / b, np.inf)
    return Rows(powers[stage, family], M, N, W, W @ W.T, b, limit, family, stage)


def differentiate_rows(controller: Controller, along: Directions) -> RowDirections:
    """Return the derivatives of the rows along the given directions.

    With G_k = H Phi^k:  dG_{k+1} = dG_k Phi + G_k dPhi,  dPhi = dA - dB K - B dK,  dH = -F dK.
    """
    plant, K = controller.plant, controller.K
    bounds = bound_rows(controller.bounds, plant)
    family, stage = _pairs(controller, bounds)
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
    dM = _inputs(controller, family, stage, dresponse, np.zeros_like(dresponse[0]))
    dT = np.ascontiguousarray(np.moveaxis(dpowers[stage, :, family], 1, -1))
    return RowDirections(dT, dM, along.bounds[family])


def _pairs(controller: Controller, bounds: BoundRows) -> tuple[IntArray, IntArray]:
    """The pairs (family, stage) in order: the horizon first, then the terminal set.

    A state bound at stage 0 cannot be influenced. It stays while it is hard, so that a state
    outside is reported; softened it would be a constant and is left out.
    """
    family, stage = np.meshgrid(np.arange(len(bounds.b)), np.arange(controller.horizon))
    keep = (stage > 0) | ~bounds.on_state[family] | (controller.softening is None)
    families, stages = [family[keep]], [stage[keep]]
    if controller.terminal is not None:
        families.append(np.asarray(controller.terminal.family))
        stages.append(np.asarray(controller.terminal.step) + controller.horizon)
    return np.concatenate(families).astype(np.int64), np.concatenate(stages).astype(np.int64)


def _powers(controller: Controller, bounds: BoundRows, last: int) -> Array:
    """H Phi^k for k = 0..last: (last + 1, c, n)."""
    plant = controller.plant
    closed = plant.A - plant.B @ controller.K
    powers = np.empty((last + 1, len(bounds.b), plant.n))
    powers[0] = bounds.E - bounds.F @ controller.K
    for k in range(last):
        powers[k + 1] = powers[k] @ closed
    return powers


def _inputs(
    controller: Controller, family: IntArray, stage: IntArray, response: Array, direct: Array
) -> Array:
    """Place the response H Phi^j B at column k - 1 - j, and the direct term at column k < N."""
    horizon, m = controller.horizon, controller.plant.m
    placed = np.zeros((len(family), horizon, *direct.shape[1:]))
    delay = stage[:, None] - 1 - np.arange(horizon)
    row, column = np.nonzero(delay >= 0)
    placed[row, column] = response[delay[row, column], family[row]]
    inside = np.nonzero(stage < horizon)[0]
    placed[inside, stage[inside]] = direct[family[inside]]
    return placed.reshape(len(family), horizon * m, *direct.shape[2:])
