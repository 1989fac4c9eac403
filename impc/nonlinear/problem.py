"""Optimal control problem with unknown parameters, from CasADi expressions of the user.

    minimise    e(x_N; theta) + sum_{k<N} l(x_k, u_k; theta)      over u_0 .. u_{N-1}, subject to
                x_{k+1} = f(x_k, u_k, d_k; theta),   x_0 given,
                h(x_k, u_k; theta) <= 0,   k = 0 .. N-1,       h_N(x_N; theta) <= 0

A row of h that no input affects is dropped at k = 0 (docs/howto/nonlinear.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from impc.arrays import Array, BoolArray, Expression, finite_array
from impc.checking import asked, checked
from impc.errors import InputError
from impc.nonlinear import expressions
from impc.nonlinear.closed_loop import (
    ClosedLoop,
    OptimalRecording,
    closed_loop_from,
    optimal_recording,
)
from impc.nonlinear.plan import Plan, solve_plan

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_LONGEST = 10_000  # stages; the size of the program is proportional


@dataclass(frozen=True, init=False, eq=False)
class OptimalControlProblem(expressions.Stages):
    """An optimal control problem with unknown parameters.

    Parameters
    ----------
    states, inputs : casadi.SX or casadi.MX, or a list of them
        Symbols x (n) and u (m): one vector, or scalars named after the signals.
    parameters : dict
        Scalar symbol of each unknown parameter by name.
    next_state : casadi expression
        Next state f(x, u, d; theta), length n.
    stage_cost : casadi expression
        Scalar cost l(x, u; theta); usually cost weights times features, with one weight fixed to a
        number.
    horizon : int
        Prediction horizon N in samples.
    terminal_cost : casadi expression
        Scalar cost e(x; theta); zero by default.
    constraints, terminal_constraints : dict
        Expressions by name, all entries of which must be <= 0: rows of h(x, u; theta) and of
        h_N(x; theta).
    disturbances : casadi.SX or casadi.MX
        Symbols d; the plant is simulated with them, while predictions of the closed loop assume 0.
    signed : sequence of str
        Parameters of any sign; the others are positive and are estimated in logarithms.
    units : dict
        Units of parameters and signals by name, for tables.
    dt : float
        Sample time of recordings in files, s.

    Attributes
    ----------
    horizon : int
        Prediction horizon N in samples.
    state_names, input_names, disturbance_names, parameter_names : tuple of str
        Names, of lengths n, m, d and p.
    rows, terminal_rows : tuple of str
        Name of each row of h and h_N.
    positive : ndarray of shape (p,)
        Which parameters are positive.
    units : dict
        Units of parameters and signals by name, where given.
    dt : float or None
        Sample time, s.
    functions : tuple
        casadi.Function of (x, u, d, theta): f, l, e, h, h_N.

    Raises
    ------
    InputError
        If an expression has the wrong size or a symbol that is not a state, input, disturbance or
        parameter; or if a parameter occurs in no expression.

    Examples
    --------
    A point that is driven to the origin with limited force; mass and cost weight are unknown.

    >>> import casadi as ca
    >>> import impc
    >>> x, u = ca.SX.sym("x", 2), ca.SX.sym("force")
    >>> mass, weight = ca.SX.sym("mass"), ca.SX.sym("weight")
    >>> problem = impc.OptimalControlProblem(
    ...     x, u, {"mass": mass, "weight": weight},
    ...     next_state=x + 0.1 * ca.vertcat(x[1], u / mass),
    ...     stage_cost=weight * ca.sumsqr(x) + u**2,
    ...     constraints={"force": ca.vertcat(u - 1, -u - 1)},
    ...     horizon=20,
    ... )
    >>> plan = problem.plan({"mass": 1.5, "weight": 10.0}, [1.0, 0.0])
    >>> plan.x.shape, bool(plan.u.min() > -1.0 - 1e-9)
    ((21, 2), True)
    """

    #: Message of commands for linear plants.
    no_plant = ("is an optimal control problem", "use `impc fit`, which accepts one")

    @checked(horizon=(1, _LONGEST))
    def __init__(
        self,
        states: Any,
        inputs: Any,
        parameters: Mapping[str, Any],
        next_state: Any,
        stage_cost: Any,
        horizon: int,
        *,
        terminal_cost: Any = 0,
        constraints: Mapping[str, Expression] | None = None,
        terminal_constraints: Mapping[str, Expression] | None = None,
        disturbances: Any = None,
        signed: Sequence[str] = (),
        units: Mapping[str, str] | None = None,
        dt: float | None = None,
    ) -> None:
        if dt is not None and not 0 < dt < np.inf:
            raise InputError("dt", f"got {dt}", "give a sample time above 0, s")
        if asked("next_state", hasattr, next_state, "updfcn"):
            raise InputError("next_state", "is a system of python-control", "call its function"
                             " with the symbols: docs/howto/nonlinear.md")  # fmt: skip
        x, u = expressions.symbols_of("states", states), expressions.symbols_of("inputs", inputs)
        d = [] if disturbances is None else expressions.symbols_of("disturbances", disturbances)
        theta = []
        for name, symbol in parameters.items():
            theta += expressions.symbols_of(f"parameter {name}", symbol)
            if len(expressions.names_of(theta)) != len(theta) or symbol.numel() != 1:
                raise InputError(f"parameter {name}", "is not a scalar symbol", "give each a name")
        for subject, symbols in {"states": x, "inputs": u, "parameters": theta}.items():
            if not symbols:
                raise InputError(subject, "is empty", "give at least one")
        path, rows = expressions.stacked(constraints or {})
        last, terminal_rows = expressions.stacked(terminal_constraints or {})
        groups, signals = (x, u, d, theta), [expressions.names_of(item) for item in (x, u, d)]
        functions = (
            expressions.function_of("next_state", next_state, groups, len(signals[0])),
            expressions.function_of("stage_cost", stage_cost, groups, 1),
            expressions.function_of("terminal_cost", terminal_cost, groups, 1, alone=True),
            expressions.function_of("constraints", path, groups, len(rows)),
            expressions.function_of(
                "terminal_constraints", last, groups, len(terminal_rows), alone=True
            ),
        )
        names, given = tuple(parameters), dict(units or {})
        expressions.require_influence(names, functions)
        for name in (*signed, *(set(given).difference(*signals))):
            if name not in names:
                problem = "is not among the parameters"
                raise InputError(f"parameter {name}", problem, f"known: {', '.join(names)}")
        vars(self).update({
            "horizon": horizon, "state_names": signals[0], "input_names": signals[1],
            "disturbance_names": signals[2], "parameter_names": names, "rows": rows,
            "terminal_rows": terminal_rows, "units": given, "dt": dt, "functions": functions,
            "positive": _fixed([name not in signed for name in names]),
        })  # fmt: skip

    @checked(horizon=(1, _LONGEST))
    def with_horizon(self, horizon: int) -> OptimalControlProblem:
        """Return the same problem with another `horizon` in samples."""
        return self._changed(horizon=horizon)

    @checked
    def with_known(self, known: Mapping[str, float]) -> OptimalControlProblem:
        """Return the same problem with some parameters fixed at `known` values by name.

        Raises
        ------
        InputError
            If a name is unknown, a value is invalid, or no parameter is left.
        """
        numbers = {name: self._value(name, value) for name, value in known.items()}
        free = [k for k, name in enumerate(self.parameter_names) if name not in numbers]
        if not free:
            raise InputError("parameters", "are all known", "leave at least one to be estimated")
        theta = ca.SX(ca.DM([numbers.get(name, 0.0) for name in self.parameter_names]))
        theta[free] = left = ca.SX.sym("theta", len(free))
        given = [ca.SX.sym(key, self.functions[0].numel_in(k)) for k, key in enumerate("xud")]
        return self._changed(
            parameter_names=tuple(self.parameter_names[k] for k in free),
            positive=_fixed(self.positive[free]),
            functions=tuple(
                ca.Function(one.name(), [*given, left], [one(*given, theta)])
                for one in self.functions
            ),
        )

    def _changed(self, **fields: Any) -> OptimalControlProblem:
        made = object.__new__(OptimalControlProblem)
        vars(made).update({**vars(self), **fields})
        return made

    @checked
    def values(self, theta: Mapping[str, float]) -> Array:
        """Return the parameters as an array (p,) from values `theta` by name.

        Raises
        ------
        InputError
            If one is missing, unknown, not finite, or neither positive nor signed.
        """
        found = {name: self._value(name, value) for name, value in theta.items()}
        for name in self.parameter_names:
            if name not in found:
                raise InputError(f"parameter {name}", "has no value", "give one for each name")
        return np.array([found[name] for name in self.parameter_names])

    def _value(self, name: str, number: float) -> float:
        if name not in self.parameter_names:
            known = f"known: {', '.join(self.parameter_names)}"
            raise InputError(f"parameter {name}", "is not known", known)
        positive = self.positive[self.parameter_names.index(name)]
        if not np.isfinite(number) or (positive and number <= 0):
            wanted = "a positive one, or name it in signed" if positive else "a finite one"
            raise InputError(f"parameter {name}", f"got {number:g}", f"give {wanted}")
        return number

    @checked
    def plan(
        self, theta: Mapping[str, float], x0: ArrayLike, *, solver: str = "ipopt", mu: float = 1e-10
    ) -> Plan:
        """Return the optimal plan from a state x0 (n,), at values theta by name.

        `solver` is "ipopt" or "fatrop"; mu is that of the relaxed conditions lam g = -mu. Raises
        InfeasibleError or SolverError if there is no plan.
        """
        start = finite_array("x0", x0, (self.n,))
        return solve_plan(self, self.values(theta), start, solver=solver, mu=mu)

    @checked(steps=1)
    def closed_loop(
        self,
        theta: Mapping[str, float],
        x0: ArrayLike,
        steps: int,
        *,
        d: ArrayLike | None = None,
        solver: str = "ipopt",
        mu: float = 1e-10,
    ) -> ClosedLoop:
        """Simulate the closed loop for `steps` samples, each with the first input of a new plan.

        Disturbances d (steps, d) act on the plant and are unknown to the controller; theta, x0
        (n,), solver and mu as in `plan`.
        """
        shape = (steps, self.disturbance_count)
        known = finite_array("d", np.zeros(shape) if d is None else d, shape)
        first = self.plan(theta, x0, solver=solver, mu=mu)
        return closed_loop_from(first, first.theta, first.x[0], known, mu)

    @checked
    def recorded_plan(
        self,
        x: ArrayLike,
        u: ArrayLike | None = None,
        *,
        d: ArrayLike | None = None,
        x0: ArrayLike | None = None,
        unknown_start: bool | None = None,
    ) -> OptimalRecording:
        """Make a recording of one plan: x (N + 1, n), u (N, m); NaN marks missing values.

        Further arguments: d (N, d), x0 (n,) and `unknown_start`, whether x0 is estimated; by
        default it is if x0 is not given.
        """
        return optimal_recording(self, x, u, d, x0, unknown_start, closed_loop=False)

    @checked
    def recorded_loop(
        self,
        x: ArrayLike,
        u: ArrayLike | None = None,
        *,
        d: ArrayLike | None = None,
        x0: ArrayLike | None = None,
        unknown_start: bool | None = None,
    ) -> OptimalRecording:
        """Make a recording of a closed loop: x (steps + 1, n), u (steps, m), d (steps, d), x0 (n,).

        All arguments are as in `recorded_plan`.
        """
        return optimal_recording(self, x, u, d, x0, unknown_start, closed_loop=True)


def _fixed(values: Any) -> BoolArray:
    found = np.array(values, dtype=bool)
    found.flags.writeable = False
    return found
