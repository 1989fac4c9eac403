"""The closed loop as a CasADi function, for programs of others.

The loop is the compiled one, or that of the controller's solver, behind `casadi.Callback`. Once it
is simulated, each input is linear in small changes of its own state and of the controller (the
active set's equations, docs/theory.md, section 4),

    du_t = L_t dx_t + G_t dtheta,      dx_{t+1} = A dx_t + B du_t + E dd_t,

A, B and E being the slopes of the plant's body at the sample, where it has one,

and every derivative is a pass over these: forward as written, in reverse by the adjoint

    p_t = xbar_t + L_t'ubar_t + (A + B L_t)'p_{t+1},     p_T = xbar_T,
    thetabar = sum G_t'(ubar_t + B'p_{t+1}),    x0bar = p_0,    dbar_t = E'p_{t+1}.

theta are the entries of K and of the scaled metric. The terminal set is made anew for every gain,
by linear programs whose number depends on it: no graph of fixed size has it, and so the loop cannot
be saved or turned into C. The controller at one state can (`casadi_controller.mpc_function`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from impc.arrays import Array, frozen
from impc.checking import checked
from impc.control.body_steps import slopes_along
from impc.control.casadi_callback import Linear, Matrix, Signature, differentiable
from impc.control.closed_loop import prepare_loop, run_loop
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.simulation import Scenario, scenario
from impc.errors import ImpcError, InputError
from impc.model.riccati import regulator_changes, solve_lqr
from impc.model.weights import Weights

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.control.simulation import Simulation
    from impc.control.terminal_set import TerminalSet
    from impc.model.riccati import LqrSolution


@checked(steps=(1, 10_000_000))
def closed_loop_function(
    controller: Controller,
    steps: int | None = None,
    disturbance: ArrayLike | None = None,
    *,
    of: str = "gain",
) -> ca.Function:
    """Closed loop of a plant as a `casadi.Function` of its controller.

    Matrices have one row for each sample, as everywhere in the package. Plant, bounds, horizon,
    softening and solver are those of `controller`; a terminal set is made anew for each gain.
    Where there is no controller (a gain that does not stabilise, weights that are not semidefinite)
    all is NaN, and beyond a sample that has no input (`Status`) what follows is.

    Parameters
    ----------
    controller : Controller
    steps : int, optional
        Samples at which an input is applied. Needed when there is no disturbance; otherwise its
        length is taken.
    disturbance : array_like, optional
        (steps, d), or (steps,) for a single one: a constant of the function, which then has no such
        input. CasADi keeps the pattern of every derivative, and that of 3000 samples of a
        disturbance takes a gigabyte.
    of : str
        "gain": a function of K (m, n) and S (m, m), of which the symmetric part counts and the
        scale does not. "weights": of Q (n, n) and R (m, m), of which the symmetric parts count.

    Returns
    -------
    casadi.Function
        (K, S, x0, disturbance) -> (x, u), or (Q, R, x0, disturbance) -> (x, u), with x0 (n, 1),
        disturbance (steps, d) where it is not given, x (steps + 1, n) and u (steps, m). Its
        derivatives, forward and in reverse, are exact; at samples that are weakly active they are
        one-sided. There are no second ones.

    Raises
    ------
    InputError, DataError
        When `of` is neither, the disturbance is not one of the plant, or there is no length.

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
        raise InputError("of", f"got {of!r}", "choose gain or weights")
    plant = controller.plant
    drive = scenario(plant, np.zeros(plant.n), steps, disturbance).disturbance
    loop = differentiable("closed_loop", _LoopOfGain(controller, drive, disturbance is not None))
    if of == "gain":
        return loop
    regulator = differentiable("regulator", _RegulatorOfWeights(controller))
    Q, R = ca.MX.sym("Q", plant.n, plant.n), ca.MX.sym("R", plant.m, plant.m)
    given = {"Q": Q, "R": R, "x0": ca.MX.sym("x0", plant.n)}
    if disturbance is None:
        given["disturbance"] = ca.MX.sym("disturbance", *drive.shape)
    x, u = loop(*regulator(Q, R), *list(given.values())[2:])
    return ca.Function("closed_loop", [*given.values()], [x, u], [*given], ["x", "u"])


class _LoopOfGain:
    """(K, S, x0) -> (x, u) under a disturbance, or (K, S, x0, disturbance) -> (x, u)."""

    def __init__(self, controller: Controller, disturbance: Array, fixed: bool) -> None:
        n, m, steps = controller.plant.n, controller.plant.m, len(disturbance)
        inputs: dict[str, tuple[int, int]] = {"K": (m, n), "S": (m, m), "x0": (n, 1)}
        if not fixed:
            inputs["disturbance"] = (steps, disturbance.shape[1])
        self.signature = Signature(inputs, {"x": (steps + 1, n), "u": (steps, m)})
        self._fixed = [disturbance] if fixed else []
        self._controller = controller
        self._near: TerminalSet | None = controller.terminal

    def value(self, point: list[Array]) -> list[Array]:
        """States and inputs."""
        point = [*point, *self._fixed]
        made = self._make(point)
        if made is None:
            return [np.full(shape, np.nan) for shape in self.signature.outputs.values()]
        run, _ = run_loop(prepare_loop(made, directions(made, 0)), _scenario(point))
        return list(_reached(run))

    def linearised(self, point: list[Array]) -> Linear:
        """The linear map of changes at a point, and its adjoint."""
        point = [*point, *self._fixed]
        made = self._make(point)
        plant, steps = self._controller.plant, len(point[3])
        n, m = plant.n, plant.m
        low = np.tril_indices(m)
        count = n + m * n + len(low[0])
        dx0, dK = np.eye(n, count), np.eye(m * n, count, n)
        dS = np.zeros((m, m, count))
        at = np.arange(n + m * n, count)
        dS[low[0], low[1], at] = dS[low[1], low[0], at] = 1.0
        local: Array = np.full((steps, m, count), np.nan)
        x: Array = np.zeros((steps, n))
        u: Array = np.zeros((steps, m))
        if made is not None:
            along = directions(made, count, x0=dx0, K=dK, S=dS)
            run, moved = run_loop(prepare_loop(made, along), _scenario(point), local=True)
            local[: run.reached] = moved.u[: run.reached]
            x, u = run.x[:-1], run.u
        slopes = slopes_along(plant, x, u, point[3])
        return _LinearLoop(slopes, local[..., :n], local[..., n:], point[1], bool(self._fixed))

    def _make(self, point: list[Array]) -> Controller | None:
        K, S, x0, disturbance = point
        if not all(np.all(np.isfinite(part)) for part in (K, S, x0, disturbance)):
            return None
        given = self._controller
        try:
            made = Controller.from_gain(
                given.plant,
                K,
                given.bounds,
                given.horizon,
                metric=(S + S.T) / 2,
                terminal_set=given.terminal is not None,
                softening=given.softening,
                near=self._near,
                solver=given.solver,
            )
        except ImpcError:  # there is no such controller, which NaN says
            return None
        self._near = made.terminal
        return made


class _RegulatorOfWeights:
    """(Q, R) -> (K, S) by the Riccati equation."""

    def __init__(self, controller: Controller) -> None:
        n, m = controller.plant.n, controller.plant.m
        self.signature = Signature({"Q": (n, n), "R": (m, m)}, {"K": (m, n), "S": (m, m)})
        self._plant = controller.plant

    def value(self, point: list[Array]) -> list[Array]:
        """Gain and metric."""
        found = self._solve(point)
        if found is None:
            return [np.full(shape, np.nan) for shape in self.signature.outputs.values()]
        return [found.K, found.S]

    def linearised(self, point: list[Array]) -> Linear:
        """The linear map of changes at a point, and its adjoint: a matrix, which is small."""
        n, m = self._plant.n, self._plant.m
        found, count = self._solve(point), n * n + m * m
        if found is None:
            return Matrix(np.full((m * n + m * m, count), np.nan), self.signature)
        units = np.eye(count)
        dQ, dR = units[:, : n * n].reshape(-1, n, n), units[:, n * n :].reshape(-1, m, m)
        dQ, dR = (dQ + dQ.swapaxes(1, 2)) / 2, (dR + dR.swapaxes(1, 2)) / 2
        still = np.zeros((count, n, n)), np.zeros((count, n, m))
        dK, dS = regulator_changes(found, dQ, dR, *still)
        return Matrix(
            np.column_stack([dK.reshape(count, -1), dS.reshape(count, -1)]).T, self.signature
        )

    def _solve(self, point: list[Array]) -> LqrSolution | None:
        Q, R = ((part + part.T) / 2 for part in point)
        try:
            return solve_lqr(self._plant, Weights(Q, R))
        except ImpcError:  # no weights, or none with a regulator, which NaN says
            return None


class _LinearLoop:
    """The equations of the module's text at one point."""

    def __init__(
        self, slopes: tuple[Array, Array, Array], L: Array, G: Array, S: Array, fixed: bool
    ) -> None:
        A, self._B, self._E = slopes  # (steps, n, ...)
        self._L, self._G, self._fixed = L, G, fixed
        self._F = A + self._B @ L  # (steps, n, n)
        self._S = (S + S.T) / 2
        self._low = np.tril_indices(len(S))

    def forward(self, seeds: list[Array]) -> list[Array]:
        """Directions of the inputs (k, ...) to those of the outputs."""
        dK, dS, dx0, *drive = seeds
        count, steps = len(dK), len(self._F)
        theta = np.column_stack([dK.reshape(count, -1), self._scaled(dS)[:, *self._low]])
        moved = np.moveaxis(self._G @ theta.T, 1, 2)  # (steps, k, m)
        push = moved @ np.swapaxes(self._B, 1, 2)
        for dd in drive:
            push = push + np.moveaxis(dd, 0, 1) @ np.swapaxes(self._E, 1, 2)
        x = np.empty((steps + 1, count, dx0.shape[1]))
        x[0] = dx0[..., 0]
        for t in range(steps):
            x[t + 1] = x[t] @ self._F[t].T + push[t]
        u = x[:-1] @ np.swapaxes(self._L, 1, 2) + moved
        return [np.moveaxis(x, 1, 0), np.moveaxis(u, 1, 0)]

    def reverse(self, seeds: list[Array]) -> list[Array]:
        """Weights of the outputs (k, ...) to those of the inputs."""
        x, u = (np.moveaxis(part, 0, 1) for part in seeds)  # (steps, k, ...)
        p = np.array(x)
        p[:-1] += u @ self._L
        for t in range(len(self._F) - 1, -1, -1):
            p[t] += p[t + 1] @ self._F[t]
        pull = u + p[1:] @ self._B
        theta = np.einsum("tkm,tmq->kq", pull, self._G)
        count, m, n = x.shape[1], u.shape[2], x.shape[2]
        entries = np.zeros((count, m, m))
        entries[:, *self._low] = theta[:, m * n :]
        return [
            theta[:, : m * n].reshape(count, m, n),
            self._scaled_back(entries),
            p[0][..., None],
            *([] if self._fixed else [np.moveaxis(p[1:] @ self._E, 1, 0)]),
        ]

    def _scaled(self, dS: Array) -> Array:
        """Change of the metric that a controller takes: symmetric, with a mean diagonal of 1."""
        m, trace = len(self._S), np.trace(self._S)
        symmetric = (dS + np.swapaxes(dS, 1, 2)) / 2
        along = np.trace(symmetric, axis1=1, axis2=2)[:, None, None]
        scaled: Array = (symmetric - self._S * along / trace) * (m / trace)
        return scaled

    def _scaled_back(self, entries: Array) -> Array:
        """The adjoint of `_scaled` for weights of the lower triangle."""
        m, trace = len(self._S), np.trace(self._S)
        symmetric = (entries + np.swapaxes(entries, 1, 2)) / 2
        along = np.einsum("kij,ij->k", symmetric, self._S)[:, None, None]
        scaled: Array = (symmetric - np.eye(m) * along / trace) * (m / trace)
        return scaled


def _scenario(point: list[Array]) -> Scenario:
    return Scenario(frozen(point[2].ravel()), frozen(point[3]))


def _reached(run: Simulation) -> tuple[Array, Array]:
    x, u = np.array(run.x), np.array(run.u)
    if not run.complete:
        x[run.reached + 1 :], u[run.reached :] = np.nan, np.nan
    return x, u
