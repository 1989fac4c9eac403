"""The constrained controller: gain, metric, bounds, horizon and terminal set.

With P from the Riccati equation, the cost of (3.1) along any input sequence is

    x_0'P x_0 + sum_k v_k' S v_k,      v_k = u_k + K x_k,   S = R + B'PB

(proof: docs/why/theory.md, section 2), so a controller is determined by its gain K, its metric S up
to scale, bounds, horizon and terminal set. Weights are one way to specify K and S. With another
terminal weight the same holds with one gain and metric per stage.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, frozen, symmetric_matrix
from impc.attached_methods import attach
from impc.checking import Value, checked
from impc.control.named_solver import COMPILED, require_solver
from impc.control.simulation import Simulation
from impc.control.terminal_set import TerminalSet, maximal_invariant_set, own_terminal_set
from impc.errors import InputError
from impc.model.bounds import Bounds
from impc.model.continuous_gain import held_gain
from impc.model.plant import Plant
from impc.model.riccati import (
    FiniteHorizonLqr,
    solve_finite_horizon,
    solve_lqr,
    stabilises,
    terminal_matrix,
)
from impc.model.weights import Weights

#: Samples; memory of the rows is quadratic in the horizon (0.4 GB at this one with two bounds).
LONGEST_HORIZON = 5000


@dataclass(frozen=True, init=False)
class Controller(Value):
    """Minimise sum_{k<N} v_k'S v_k subject to the bounds, with x_N in the terminal set.

    The constructor takes stage weights: it is the controller (3.1) with terminal weight (3.4).
    `from_gain` takes a gain instead.

    Parameters
    ----------
    plant : Plant
        Discrete-time, stabilisable plant.
    weights : Weights
        Stage weights Q and R.
    bounds : Bounds
        Bounds of states and inputs.
    horizon : int
        Prediction horizon N >= 1, in samples.
    terminal_set : bool, pair of array_like, or TerminalSet
        Whether x_N must lie in the maximal invariant set of the regulator under the bounds, as in
        the dissertation; or the set {x : H x <= h} as a pair (H, h) of shapes (r, n) and (r,),
        h > 0. If that is not invariant, a later sample can be infeasible.
    softening, solver : optional
        See the attributes.
    terminal_weight : array_like, optional
        Weight P (n, n) of the terminal cost x_N'P x_N, positive semidefinite, or 0 for none. By
        default that of the Riccati equation; any other requires ``terminal_set=False`` or a set of
        your own.

    Attributes
    ----------
    plant : Plant
        Discrete-time plant.
    K : ndarray of shape (m, n)
        Gain in u_k = -K x_k + v_k; that of the first stage if each stage has its own.
    S : ndarray of shape (m, m)
        Metric, scaled to a mean diagonal of 1 (its scale has no effect); likewise of the first.
    bounds : Bounds
        Bounds of states and inputs.
    horizon : int
        Prediction horizon N, in samples.
    terminal : TerminalSet or None
        Set that x_N must reach; None for no such constraint.
    softening : float or None
        None: state bounds and terminal set are hard. A number: exceeding one of their rows
        E x <= b by s adds ``softening * U^2 * s / b`` to half of the sum of v_k'S v_k, with S as
        scaled here and U the smallest finite input bound (1 without any). The penalty is exact:
        while it exceeds the multipliers, the solution is that of the hard problem if that is
        feasible. Input bounds are always hard.
    solver : str
        Method where the gain violates a bound: "compiled" (built in), or "daqp", "qpoases" or
        "ipopt" of CasADi.
    stages : FiniteHorizonLqr or None
        Weights, gains and metrics of all stages if a terminal weight was given.

    Raises
    ------
    PlantError, WeightsError, InputError
        If the plant is continuous, no stabilising Riccati solution exists, the horizon is not a
        positive integer, a terminal weight is not semidefinite, the origin is not inside a terminal
        set, or the solver is unknown.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], [[1, 0], [0, 1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> truth = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> truth.K.round(3)
    array([[ 1.494, -0.881]])
    """

    _rules: ClassVar[Mapping[str, Any]] = {"K": "m n", "S": "m m", "horizon": (1, LONGEST_HORIZON)}

    plant: Plant
    K: Array
    S: Array
    bounds: Bounds
    horizon: int
    terminal: TerminalSet | None
    softening: float | None
    solver: str
    stages: FiniteHorizonLqr | None = None

    if TYPE_CHECKING:  # attached

        def simulate(  # noqa: D102 - its function has the docstring
            self,
            x0: ArrayLike,
            steps: int | None = None,
            disturbance: ArrayLike | None = None,
            target: Mapping[str, ArrayLike] | None = None,
        ) -> Simulation: ...

    @checked(horizon=(1, LONGEST_HORIZON))
    def __init__(
        self,
        plant: Plant,
        weights: Weights,
        bounds: Bounds,
        horizon: int,
        *,
        terminal_set: bool | TerminalSet | tuple[ArrayLike, ArrayLike] = True,
        softening: float | None = None,
        solver: str = COMPILED,
        terminal_weight: ArrayLike | None = None,
    ) -> None:
        plant.require_discrete()
        stages = None
        if terminal_weight is None:
            solution = solve_lqr(plant, weights)
            K, S = solution.K, solution.S
        elif terminal_set is True:
            problem = "True is the invariant set of the Riccati gain, not of this terminal weight"
            raise InputError("terminal_set", problem, "set False, or give a set of your own")
        else:
            P = terminal_matrix(plant, terminal_weight)
            stages = solve_finite_horizon(plant, weights, P, horizon)
            K, S = stages.K[0], stages.S[0]
        made = Controller.from_gain(
            plant,
            K,
            bounds,
            horizon,
            metric=S,
            terminal_set=terminal_set,
            softening=softening,
            solver=solver,
        )
        self._fill(**vars(made) | {"stages": stages})

    def _check(self, known: Collection[str]) -> None:
        super()._check(known)
        plant, made = self.plant, self.stages
        if made is not None:
            same = (made.plant.A, plant.A), (made.plant.B, plant.B), (made.K[0], self.K)
            if len(made.K) != self.horizon or not all(np.array_equal(*pair) for pair in same):
                problem = "its stage gains belong to another plant, gain or horizon"
                raise InputError("Controller", problem, "construct it again from weights")

    @classmethod
    @checked(gain="m n", metric="m m", horizon=(1, LONGEST_HORIZON))
    def from_gain(
        cls,
        plant: Plant,
        gain: ArrayLike,
        bounds: Bounds,
        horizon: int,
        *,
        metric: ArrayLike | None = None,
        terminal_set: bool | TerminalSet | tuple[ArrayLike, ArrayLike] = True,
        softening: float | None = None,
        near: TerminalSet | None = None,
        solver: str = COMPILED,
    ) -> Controller:
        """Construct a controller from its gain, u = -K x away from the bounds.

        Parameters
        ----------
        plant : Plant
            Discrete-time plant.
        gain : array_like
            Gain K (m, n); with the maximal invariant set it must stabilise the plant.
        bounds : Bounds
            Bounds of states and inputs.
        horizon : int
            Prediction horizon N >= 1, in samples.
        metric : array_like, optional
            Metric S (m, m), positive definite; by default the identity. Irrelevant with one input.
        terminal_set, softening, solver
            As in the constructor; a set of your own is a pair of shapes (r, n) and (r,).
        near : TerminalSet, optional
            Terminal set of a similar gain, which saves time; see `maximal_invariant_set`.

        Returns
        -------
        Controller

        Raises
        ------
        InputError
            If the gain does not stabilise the plant, the metric is not positive definite, or the
            solver is unknown.
        """
        plant.require_discrete()
        K = np.asarray(gain)
        if terminal_set is True and not stabilises(plant, K):
            raise InputError(
                "gain", "does not stabilise the plant", "give one with |eig(A - BK)| < 1"
            )
        S = np.eye(plant.m) if metric is None else symmetric_matrix("metric", metric, plant.m)
        if np.linalg.eigvalsh(S)[0] <= 0:
            raise InputError("metric", "is not positive definite", "give R + B'PB")
        if softening is not None and not 0 < softening < np.inf:
            raise InputError("softening", f"got {softening!r}", "give a positive number, or None")
        if isinstance(terminal_set, bool):
            terminal = maximal_invariant_set(plant, K, bounds, near=near) if terminal_set else None
        else:
            terminal = own_terminal_set(plant, terminal_set)
        made = object.__new__(cls)
        made._fill(
            plant=plant,
            K=frozen(K),
            S=frozen(S * (plant.m / np.trace(S))),
            bounds=bounds,
            horizon=horizon,
            terminal=terminal,
            softening=softening,
            solver=require_solver(solver),
            stages=None,
        )
        return made

    @classmethod
    @checked(gain="m n", horizon=(1, LONGEST_HORIZON))
    def from_continuous_gain(
        cls, plant: Plant, gain: ArrayLike, bounds: Bounds, horizon: int, **settings: Any
    ) -> Controller:
        """Construct a controller from a gain of continuous feedback, u(t) = -Gx(t).

        Its own gain K is that of a held command that equals, over each sample, the mean command of
        u = -Gx from the state at its start. After one sample the states of both loops differ by the
        cube of the sample time, after a fixed time by its square. `Estimate.continuous_gain` is the
        inverse.

        Parameters
        ----------
        plant : Plant
            Discrete-time plant, sampled from a continuous one with a zero-order hold.
        gain : array_like
            Continuous gain G (m, n).
        bounds, horizon, **settings
            As in `from_gain`.

        Returns
        -------
        Controller

        Raises
        ------
        PlantError
            If the plant is not sampled from a continuous one: it has a delay in whole samples, or
            its controls are changes (`with_rates`).
        InputError
            As in `from_gain`.

        Examples
        --------
        >>> import control
        >>> import impc
        >>> cart = control.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0)
        >>> plant = impc.Plant(control.c2d(cart, 0.1))
        >>> law = impc.Controller.from_continuous_gain(plant, [[4, 3]], impc.Bounds(plant), 10)
        >>> law.K.round(3)
        array([[3.454, 2.759]])
        """
        held = held_gain(plant, np.asarray(gain))
        return cls.from_gain(plant, held, bounds, horizon, **settings)

    @property
    def gains(self) -> Array:
        """Gain of each stage (N, m, n)."""
        if self.stages is not None:
            return self.stages.K
        return np.broadcast_to(self.K, (self.horizon, *self.K.shape))

    @property
    def metrics(self) -> Array:
        """Metric of each stage (N, m, m), scaled like the first."""
        if self.stages is not None:
            return np.asarray(self.stages.S * (len(self.S) / np.trace(self.stages.S[0])))
        return np.broadcast_to(self.S, (self.horizon, *self.S.shape))

    @property
    def penalty(self) -> float:
        """Cost of a relative excess of 1; infinite if the rows are hard."""
        if self.softening is None:
            return float("inf")
        sides = np.abs(np.concatenate([self.bounds.u_min, self.bounds.u_max]))
        finite = sides[np.isfinite(sides)]
        unit = float(finite.min()) if len(finite) else 1.0
        return self.softening * unit**2


attach(Controller)
