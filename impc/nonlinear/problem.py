"""An optimal control problem with parameters anywhere, from CasADi expressions of the user's own.

    minimise    e(x_N; theta) + sum_{k<N} l(x_k, u_k; theta)      over u_0 .. u_{N-1}, subject to
                x_{k+1} = f(x_k, u_k, d_k; theta),   x_0 given,
                h(x_k, u_k; theta) <= 0,   k = 0 .. N-1,       h_N(x_N; theta) <= 0

A row of h that no input moves is not asked for at k = 0, where nothing can be done about it.
docs/nonlinear.md has the derivation and an example.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from impc.arrays import Array, BoolArray, Frozen, finite_array
from impc.checking import checked
from impc.errors import InputError
from impc.nonlinear.expressions import (
    function_of,
    names_of,
    require_influence,
    stacked,
    symbols_of,
)
from impc.nonlinear.recordings import optimal_recording

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.nonlinear.closed_loop import ClosedLoop
    from impc.nonlinear.plan import Plan
    from impc.nonlinear.recordings import OptimalRecording

_LONGEST = 10_000  # stages: the program has as many as it has unknowns times states


@dataclass(frozen=True, init=False, eq=False)
class OptimalControlProblem(Frozen):
    """The problem as a value: CasADi functions, names and sizes, checked once.

    Parameters
    ----------
    states, inputs : casadi.SX or casadi.MX, or a list of them
        Symbols x (n) and u (m): one vector, or scalars whose names are those of the signals.
    parameters : dict
        Name of each unknown -> its scalar symbol in the expressions.
    next_state : casadi expression
        f(x, u, d; theta) (n).
    stage_cost : casadi expression
        l(x, u; theta), a number; as a rule prices times features, one price a known number.
    horizon : int
        N, samples.
    terminal_cost : casadi expression
        e(x; theta), a number; none by default.
    constraints, terminal_constraints : dict
        Name -> expression, every entry of which is to be at most 0: rows of h(x, u; theta) and of
        h_N(x; theta).
    disturbances : casadi.SX or casadi.MX
        Symbols d; they are known to the plant and 0 to a controller that looks ahead.
    signed : sequence of str
        Parameters that may have any sign; the others are positive and are searched in logarithms.
    units : dict
        Unit of a parameter, a state, an input or a disturbance by its name, for tables.
    dt : float
        Sample time, s, of recordings in files.

    Attributes
    ----------
    horizon : int
        N.
    state_names, input_names, disturbance_names, parameter_names : tuple of str
        n, m, d and p of them.
    rows, terminal_rows : tuple of str
        A name for each row of h and h_N.
    positive : BoolArray
        Which parameters are (p,).
    units : dict
        Units of parameters and signals by name, where they are given.
    dt : float or None
        Sample time, s; None where it is not said.
    functions : tuple
        casadi.Function of (x, u, d, theta): f, l, e, h, h_N.

    Raises
    ------
    InputError
        When an expression has a symbol that is not among states, inputs, disturbances and
        parameters, or the wrong size; when a parameter is in no expression.

    Examples
    --------
    A point that is driven to the origin at the least effort, its force limited; mass and price are
    not known.

    >>> import casadi as ca
    >>> import impc
    >>> x, u = ca.SX.sym("x", 2), ca.SX.sym("force")
    >>> mass, price = ca.SX.sym("mass"), ca.SX.sym("price")
    >>> problem = impc.OptimalControlProblem(
    ...     x, u, {"mass": mass, "price": price},
    ...     next_state=x + 0.1 * ca.vertcat(x[1], u / mass),
    ...     stage_cost=price * ca.sumsqr(x) + u**2,
    ...     constraints={"force": ca.vertcat(u - 1, -u - 1)},
    ...     horizon=20,
    ... )
    >>> plan = problem.plan({"mass": 1.5, "price": 10.0}, [1.0, 0.0])
    >>> plan.x.shape, bool(plan.u.min() > -1.0 - 1e-9)
    ((21, 2), True)
    """

    #: Why commands for linear plants refuse it.
    no_plant = ("is an optimal control problem", "impc fit takes one, this does not")

    horizon: int
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    disturbance_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    rows: tuple[str, ...]
    terminal_rows: tuple[str, ...]
    positive: BoolArray
    units: dict[str, str]
    dt: float | None
    functions: tuple[Any, ...]

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
        constraints: Mapping[str, Any] | None = None,
        terminal_constraints: Mapping[str, Any] | None = None,
        disturbances: Any = None,
        signed: Sequence[str] = (),
        units: Mapping[str, str] | None = None,
        dt: float | None = None,
    ) -> None:
        if dt is not None and not 0 < dt < np.inf:
            raise InputError("dt", f"got {dt}", "give a sample time above 0, s")
        if hasattr(next_state, "updfcn"):
            raise InputError("next_state", "is a system of python-control", "call its function"
                             " with the symbols, as docs/nonlinear.md does")  # fmt: skip
        x, u = symbols_of("states", states), symbols_of("inputs", inputs)
        d = [] if disturbances is None else symbols_of("disturbances", disturbances)
        theta = []
        for name, symbol in parameters.items():
            theta += symbols_of(f"parameter {name}", symbol)
            if len(names_of(theta)) != len(theta) or symbol.numel() != 1:
                raise InputError(f"parameter {name}", "is not a scalar symbol", "give each a name")
        for subject, symbols in {"states": x, "inputs": u, "parameters": theta}.items():
            if not symbols:
                raise InputError(subject, "there are none", "give at least one")
        path, rows = stacked(constraints or {})
        last, terminal_rows = stacked(terminal_constraints or {})
        groups, signals = (x, u, d, theta), [names_of(item) for item in (x, u, d)]
        functions = (
            function_of("next_state", next_state, groups, len(signals[0])),
            function_of("stage_cost", stage_cost, groups, 1),
            function_of("terminal_cost", terminal_cost, groups, 1, alone=True),
            function_of("constraints", path, groups, len(rows)),
            function_of("terminal_constraints", last, groups, len(terminal_rows), alone=True),
        )
        names, given = tuple(parameters), dict(units or {})
        require_influence(names, functions)
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

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.state_names)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.input_names)

    @property
    def disturbance_count(self) -> int:
        """Number of disturbances."""
        return len(self.disturbance_names)

    @checked(horizon=(1, _LONGEST))
    def with_horizon(self, horizon: int) -> OptimalControlProblem:
        """The same problem over another `horizon` in samples."""
        return self._changed(horizon=horizon)

    @checked
    def with_known(self, known: Mapping[str, float]) -> OptimalControlProblem:
        """The same problem with the values of some parameters `known` by name.

        Raises
        ------
        InputError
            When one is unknown or has no such value, or when none is left.
        """
        numbers = {name: self._value(name, value) for name, value in known.items()}
        free = [k for k, name in enumerate(self.parameter_names) if name not in numbers]
        if not free:
            raise InputError("parameters", "are all known", "leave one to be searched")
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
        """Values of the parameters (p,) in their order, from `theta`, values by name.

        Raises
        ------
        InputError
            When one is missing, unknown, not finite, or not positive and not signed.
        """
        found = {name: self._value(name, value) for name, value in theta.items()}
        for name in self.parameter_names:
            if name not in found:
                raise InputError(f"parameter {name}", "has no value", "give one for each name")
        return np.array([found[name] for name in self.parameter_names])

    def _value(self, name: str, value: object) -> float:
        if name not in self.parameter_names:
            known = f"known: {', '.join(self.parameter_names)}"
            raise InputError(f"parameter {name}", "is not known", known)
        if isinstance(value, bool) or not isinstance(value, Real):
            raise InputError(f"parameter {name}", f"got {value!r:.40}", "give a number")
        positive, number = self.positive[self.parameter_names.index(name)], float(value)
        if not np.isfinite(number) or (positive and number <= 0):
            wanted = "a positive one, or name it in signed" if positive else "a finite one"
            raise InputError(f"parameter {name}", f"got {number:g}", f"give {wanted}")
        return number

    @checked
    def plan(
        self, theta: Mapping[str, float], x0: Any, *, solver: str = "ipopt", mu: float = 1e-10
    ) -> Plan:
        """The optimal plan from a state x0 (n,), at values theta of the parameters by name.

        `solver` is one of `impc.nonlinear.plan.SOLVERS`, and mu that of the relaxed conditions
        lam g = -mu. Raises InfeasibleError or SolverError where there is none.
        """
        from impc.nonlinear.plan import solve_plan  # noqa: PLC0415 - it stands on this module

        start = finite_array("x0", x0, (self.n,))
        return solve_plan(self, self.values(theta), start, solver=solver, mu=mu)

    @checked(steps=1)
    def closed_loop(
        self,
        theta: Mapping[str, float],
        x0: Any,
        steps: int,
        *,
        d: Any = None,
        solver: str = "ipopt",
        mu: float = 1e-10,
    ) -> ClosedLoop:
        """The closed loop of `steps` samples: at each the first input of the plan from there.

        Disturbances d (steps, d) are seen by the plant and not by the controller; theta, x0 (n,),
        solver and mu are as in `plan`.
        """
        from impc.nonlinear.closed_loop import closed_loop_from  # noqa: PLC0415 - see plan

        shape = (steps, self.disturbance_count)
        known = finite_array("d", np.zeros(shape) if d is None else d, shape)
        first = self.plan(theta, x0, solver=solver, mu=mu)
        return closed_loop_from(first, first.theta, first.x[0], known, mu)

    def recorded_plan(self, x: Any, u: Any = None, **more: Any) -> OptimalRecording:
        """A recording that is one plan: x (N + 1, n), u (N, m); NaN is not measured.

        More may be d (N, d), x0 (n,) and `unknown_start`: whether x0 is searched from what is
        given, by default where it is the first of x.
        """
        return optimal_recording(self, x, u, closed_loop=False, **more)

    def recorded_loop(self, x: Any, u: Any = None, **more: Any) -> OptimalRecording:
        """A recording of the closed loop: x (steps + 1, n), u (steps, m), as `recorded_plan`."""
        return optimal_recording(self, x, u, closed_loop=True, **more)


def _fixed(values: Any) -> BoolArray:
    found = np.array(values, dtype=bool)
    found.flags.writeable = False
    return found
