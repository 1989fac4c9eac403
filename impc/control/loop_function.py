"""The closed loop as a CasADi function with exact Jacobian.

The loop is simulated behind `casadi.Callback`. Each input is then linear in small changes of its
own state and of the controller (equations of the active set, docs/why/theory.md, section 4),

    du_t = L_t dx_t + G_t dtheta,      dx_{t+1} = A dx_t + B du_t + E dd_t,

where A, B and E are the slopes of a nonlinear body at the sample, if the plant has one, and theta
are the entries of K and of the scaled metric. One pass over these equations gives the Jacobian.
The terminal set is recomputed for every gain by a varying number of linear programs, which no graph
of fixed size represents: the loop cannot be saved or exported to C. The controller at one state can
(`casadi_controller.mpc_function`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, frozen
from impc.checking import checked
from impc.control.body_steps import slopes_along
from impc.control.closed_loop import prepare_loop, run_loop
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.simulation import Scenario, scenario
from impc.errors import ImpcError, InputError
from impc.model.riccati import regulator_changes, solve_lqr
from impc.model.weights import Weights

if TYPE_CHECKING:
    Shapes = dict[str, tuple[int, int]]

# CasADi does not keep Python callbacks alive; this list does.
_alive: list[Any] = []


@checked(steps=(1, 10_000_000))
def closed_loop_function(
    controller: Controller,
    steps: int | None = None,
    disturbance: ArrayLike | None = None,
    *,
    of: str = "gain",
) -> ca.Function:
    """Return the closed loop of a plant as a `casadi.Function` of its controller.

    Matrices have one row per sample, as everywhere in the package. Plant, bounds, horizon,
    softening and solver are those of `controller`; a terminal set is recomputed for each gain. The
    result is NaN if there is no controller (the gain does not stabilise, or the weights are not
    semidefinite), and from the first sample without an input (`Status`) on.

    Parameters
    ----------
    controller : Controller
        Controller with its plant.
    steps : int, optional
        Number of samples with an input; required without a disturbance, whose length is used
        otherwise.
    disturbance : array_like, optional
        Disturbance (steps, d), or (steps,) for a single one, as a constant of the function, which
        then has no such input. CasADi stores the pattern of every derivative: that of 3000 samples
        of a disturbance takes 1 GB.
    of : str
        "gain": function of K (m, n) and S (m, m), of which the symmetric part counts and the scale
        does not. "weights": function of Q (n, n) and R (m, m), of which the symmetric parts count.

    Returns
    -------
    casadi.Function
        (K, S, x0, disturbance) -> (x, u), or (Q, R, x0, disturbance) -> (x, u), with x0 (n, 1),
        disturbance (steps, d) unless it is given, x (steps + 1, n) and u (steps, m). First
        derivatives, forward and reverse, are exact, and one-sided at weakly active samples; there
        are no second ones.

    Raises
    ------
    InputError, DataError
        If `of` is unknown, the disturbance does not fit the plant, or `steps` is missing.

    Examples
    --------
    >>> import casadi
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> law = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> loop = impc.closed_loop_function(law, steps=20)
    >>> K = casadi.MX.sym("K", 1, 2)
    >>> x, u = loop(K, 1, [1, 3], casadi.DM(20, 0))  # this plant has no disturbance
    >>> slope = casadi.Function("slope", [K], [casadi.jacobian(casadi.sumsqr(x), K)])
    >>> slope(law.K).shape
    (1, 2)
    """
    if of not in ("gain", "weights"):
        raise InputError("of", f"got {of!r}", 'choose "gain" or "weights"')
    if controller.stages is not None:
        problem = "has a terminal weight of its own, and a gain for each stage"
        raise InputError("controller", problem, "use impc.simulate_and_differentiate")
    plant = controller.plant
    if np.any(plant.observer) or plant.ahead:
        raise InputError(
            "plant", "has targets that move", "use a plant without observer and preview"
        )
    drive = scenario(plant, np.zeros(plant.n), steps, disturbance).disturbance
    n, m, steps = plant.n, plant.m, len(drive)
    inputs: Shapes = {"Q": (n, n), "R": (m, m)} if of == "weights" else {"K": (m, n), "S": (m, m)}
    inputs["x0"] = (n, 1)
    if disturbance is None:
        inputs["disturbance"] = (steps, drive.shape[1])
    outputs: Shapes = {"x": (steps + 1, n), "u": (steps, m)}
    loop = _Loop(controller, drive, of == "weights")
    return _Matrices("closed_loop", inputs, outputs, loop.value, loop.slopes)


class _Matrices(ca.Callback):
    """Callback from matrices to matrices, optionally with its Jacobian."""

    def __init__(
        self,
        name: str,
        inputs: Shapes,
        outputs: Shapes,
        evaluate: Callable[[list[Array]], list[Array]],
        slopes: Callable[[list[Array]], list[list[Array]]] | None = None,
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs, self._evaluate = inputs, outputs, evaluate
        self._slopes = slopes  # of each output by each input, (rows, columns, rows, columns)
        _alive.append(self)
        self.construct(name, {"enable_forward": False, "enable_reverse": False})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_name_in(self, index: int) -> str:
        return list(self._inputs)[index]

    def get_name_out(self, index: int) -> str:
        return list(self._outputs)[index]

    def get_sparsity_in(self, index: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*list(self._inputs.values())[index])

    def get_sparsity_out(self, index: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*list(self._outputs.values())[index])

    def eval(self, given: Sequence[ca.DM]) -> list[Array]:
        return self._evaluate([np.asarray(part.full()) for part in given])

    def has_jacobian(self) -> bool:
        return self._slopes is not None

    def get_jacobian(
        self, name: str, names: Sequence[str], identified: Sequence[str], _: Any
    ) -> ca.Function:
        """Jacobian blocks, entries in column order; it also takes the outputs as inputs."""
        ins, outs = list(self._inputs.values()), list(self._outputs.values())
        blocks = [(a * b, rows * columns) for a, b in outs for rows, columns in ins]

        def evaluate(point: list[Array]) -> list[Array]:
            assert self._slopes is not None
            found = [part for parts in self._slopes(point[: len(ins)]) for part in parts]
            return [
                part.transpose(1, 0, 3, 2).reshape(shape)
                for part, shape in zip(found, blocks, strict=True)
            ]

        given = dict(zip(names, ins + outs, strict=True))
        return _Matrices(name, given, dict(zip(identified, blocks, strict=True)), evaluate)


class _Loop:
    """Values and derivatives at a point: K and S or Q and R, x0, and maybe a disturbance."""

    def __init__(self, controller: Controller, given: Array, of_weights: bool) -> None:
        self.controller, self.given, self.of_weights = controller, given, of_weights
        self.near = controller.terminal

    def value(self, point: list[Array]) -> list[Array]:
        """Compute x (steps + 1, n) and u (steps, m)."""
        plant, steps = self.controller.plant, len(self.given)
        law = self._law(*self._regulator(*point[:2])[:2], *point[2:])
        if law is None:
            return [np.full((steps + 1, plant.n), np.nan), np.full((steps, plant.m), np.nan)]
        run, _ = run_loop(prepare_loop(law, directions(law, 0)), self._drive(*point[2:]))
        x, u = np.array(run.x), np.array(run.u)
        if not run.complete:
            x[run.reached + 1 :], u[run.reached :] = np.nan, np.nan
        return [x, u]

    def slopes(self, point: list[Array]) -> list[list[Array]]:
        """Derivatives of both by each part of the point."""
        plant, (steps, d) = self.controller.plant, self.given.shape
        n, m = plant.n, plant.m
        count = n + m * n + m * m
        local: Array = np.full((steps, m, count), np.nan)
        x: Array = np.zeros((steps, n))
        u: Array = np.zeros((steps, m))
        driven = self._drive(*point[2:])
        K, S, chain = self._regulator(*point[:2])
        law = self._law(K, S, *point[2:])
        if law is not None:
            dS = np.concatenate([np.zeros((m, m, n + m * n)), _scaled(S)], axis=2)
            along = directions(law, count, x0=np.eye(n, count), K=np.eye(m * n, count, n), S=dS)
            run, moved = run_loop(prepare_loop(law, along), driven, local=True)
            local[: run.reached] = moved.u[: run.reached]
            x, u = run.x[:-1], run.u
        A, B, E = slopes_along(plant, x, u, driven.disturbance)
        L, G = local[..., :n], np.concatenate([np.zeros((steps, m, n)), local[..., n:]], axis=2)
        closed = A + B @ L
        dx = _passed(closed, np.eye(n, count), lambda t: B[t] @ G[t])
        found = []
        for part in (dx, L @ dx[:-1] + G):
            moves = part[..., n:] if chain is None else part[..., n:] @ chain()
            parts = np.split(moves, [point[0].size], axis=2)
            pair = zip(parts, point[:2], strict=True)
            blocks = [one.reshape(*one.shape[:2], *given.shape) for one, given in pair]
            found.append([*blocks, part[..., :n, None]])
        if len(point) == 4:
            unit = np.eye(steps * d).reshape(steps, d, steps * d)
            dx = _passed(closed, np.zeros((n, steps * d)), lambda t: E[t] @ unit[t])
            found[0].append(dx.reshape(steps + 1, n, steps, d))
            found[1].append((L @ dx[:-1]).reshape(steps, m, steps, d))
        return found

    def _regulator(
        self, first: Array, second: Array
    ) -> tuple[Array, Array, Callable[[], Array] | None]:
        """K and S, and for weights what computes their derivatives, by columns; NaN if none."""
        if not self.of_weights:
            return first, second, None
        n, m = len(first), len(second)
        try:
            found = solve_lqr(
                self.controller.plant, Weights((first + first.T) / 2, (second + second.T) / 2)
            )
        except ImpcError:  # invalid weights or no regulator: the caller returns NaN
            none = np.zeros((m * n + m * m, n * n + m * m))
            return np.full((m, n), np.nan), np.full((m, m), np.nan), lambda: none

        def chain() -> Array:
            units = np.eye(n * n + m * m)
            dQ, dR = units[:, : n * n].reshape(-1, n, n), units[:, n * n :].reshape(-1, m, m)
            dQ, dR = (dQ + dQ.swapaxes(1, 2)) / 2, (dR + dR.swapaxes(1, 2)) / 2
            changes = regulator_changes(found, dQ, dR, np.zeros_like(dQ), np.zeros((len(dQ), n, m)))
            return np.hstack([part.reshape(len(units), -1) for part in changes]).T

        return found.K, found.S, chain

    def _law(self, K: Array, S: Array, *others: Array) -> Controller | None:
        if not all(np.all(np.isfinite(part)) for part in (K, S, *others)):
            return None
        given, terminal = self.controller, self.controller.terminal
        own = terminal is not None and terminal.own
        try:
            law = Controller.from_gain(
                given.plant,
                K,
                given.bounds,
                given.horizon,
                metric=(S + S.T) / 2,
                terminal_set=terminal if terminal and own else terminal is not None,
                softening=given.softening,
                near=self.near,
                solver=given.solver,
            )
        except ImpcError:  # no such controller: the caller returns NaN
            return None
        self.near = law.terminal
        return law

    def _drive(self, x0: Array, disturbance: Array | None = None) -> Scenario:
        driven = self.given if disturbance is None else disturbance
        return Scenario(frozen(x0.ravel()), frozen(driven))


def _passed(closed: Array, start: Array, push: Callable[[int], Array]) -> Array:
    """Propagate derivatives of the states over the samples (steps + 1, n, columns)."""
    x = np.empty((len(closed) + 1, *start.shape))
    x[0] = start
    for t, step in enumerate(closed):
        x[t + 1] = step @ x[t] + push(t)
    return x


def _scaled(S: Array) -> Array:
    """Derivative of the scaled metric with respect to the entries of S (m, m, m * m)."""
    m, trace = len(S), np.trace(S)
    units = np.eye(m * m).reshape(m, m, -1)
    symmetric = (units + units.swapaxes(0, 1)) / 2
    along = np.trace(symmetric) / trace
    return np.asarray((symmetric - ((S + S.T) / 2)[..., None] * along) * (m / trace))
