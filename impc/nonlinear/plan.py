"""Optimal plan of a problem by CasADi's solvers, with exact derivatives.

    grad L = 0,    c = 0,    h + s = 0,    s lam = mu,    s, lam > 0

with multipliers y of the equations c and of the rows h (lam), and slacks s of the rows, define the
unknowns w = (x_0, u_0, x_1, ...) smoothly in theta and x_0. IPOPT solves them for a target mu,
starting from the result of another solver or a nearby plan. Its return status is not used: Newton
steps on the conditions finish the solution, and their residual decides.

    [H   A'         ] [dw]     [grad L        ]
    [A   - s / lam  ] [dy] = - [c,  h + mu/lam],     A the derivative of c and h

is their sparse system, factorised once per plan for the derivatives by all parameters and x_0.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy
from scipy.sparse.linalg import splu

from impc.arrays import Array, Frozen
from impc.errors import InfeasibleError, InputError, SolverError
from impc.nonlinear.expressions import Stages
from impc.settings_files import IPOPT_ALONE

# Tolerance of the gradient relative to the largest multiplier, and of c and h + s.
_TOLERANCE = 1e-10
_PRODUCT = 1e-3  # tolerance of s lam - mu, relative to mu
_STEPS = 8
_CENTRAL = 1e-2
_EXCESS = 1e-6  # excess of a row from which a problem without a plan is called infeasible
# Range of multiplier over slack that counts as weakly active: at mu = 1e-10 an active row with
# multiplier 1 has 1e10.
_WEAK = (1e-3, 1e3)
_SILENT: dict[str, Any] = {"print_time": False, "error_on_fail": False}
# mu has the same meaning in the conditions only if IPOPT neither scales nor relaxes.
_IPOPT = IPOPT_ALONE | {
    "max_iter": 300, "tol": 1e-8, "nlp_scaling_method": "none", "bound_relax_factor": 0.0,
}  # fmt: skip
_NEAR = dict.fromkeys(
    ("warm_start_bound_push", "warm_start_bound_frac", "warm_start_slack_bound_push",
     "warm_start_slack_bound_frac", "warm_start_mult_bound_push"), 1e-16,
) | {"warm_start_init_point": "yes", "max_iter": 60}  # fmt: skip
_OPTIONS: dict[str, dict[str, Any]] = {
    "ipopt": {},
    "fatrop": {
        "structure_detection": "auto", "fatrop": {"print_level": 0, "tol": 1e-8, "max_iter": 300},
    },
}  # fmt: skip
#: Interior-point solvers, without or with use of the stage structure.
SOLVERS = tuple(_OPTIONS)


def require_solver(name: str) -> str:
    """Return the name of an available solver in lower case."""
    given, name = name, name.lower()
    if name not in SOLVERS:
        raise InputError("solver", f"got {given!r:.40}", f"choose one of {', '.join(SOLVERS)}")
    if not ca.has_nlpsol(name):
        raise InputError("solver", f"{name} is not in this CasADi", "choose ipopt")
    return name


class Program:
    """Nonlinear program with p = (x_0, d, theta); x_0 is an unknown, as fatrop requires."""

    def __init__(self, problem: Stages) -> None:
        f, cost, e, h, h_end = problem.functions
        n, m, N = problem.n, problem.m, problem.horizon
        x0, d = ca.SX.sym("x0", n), ca.SX.sym("d", problem.disturbance_count, N)
        theta, x = ca.SX.sym("theta", len(problem.parameter_names)), ca.SX.sym("x", n)
        # Rows that the input does not affect are dropped at the first sample.
        movable = ca.DM(h.jac_sparsity(0, 1), 1).full().any(axis=1)
        w, g, total = [], [], ca.SX(0)
        equal: list[bool] = []
        #: Name and sample of each row of h.
        self.labels: list[tuple[str, int]] = []
        for k in range(N):
            u, following = ca.SX.sym("u", m), ca.SX.sym("x", n)
            given = (x, u, d[:, k], theta)
            kept = np.flatnonzero(movable) if k == 0 else np.arange(len(problem.rows))
            w += [x, u]
            g += [following - f(*given), *([x - x0] if k == 0 else [])]
            g += [h(*given)[kept.tolist()]] if len(kept) else []
            equal += [True] * (n + n * (k == 0)) + [False] * len(kept)
            self.labels += [(problem.rows[row], k) for row in kept]
            total += cost(*given)
            x = following
        last = (x, ca.SX.zeros(m), ca.SX.zeros(problem.disturbance_count), theta)
        self.equal = np.array(equal + [False] * len(problem.terminal_rows))
        self.labels += [(name, N) for name in problem.terminal_rows]
        unknowns, rows = ca.vertcat(*w, x), ca.vertcat(*g, h_end(*last))
        total += e(*last)
        p, own = ca.vertcat(x0, ca.vec(d), theta), ca.vertcat(theta, x0)
        y, price = ca.SX.sym("y", rows.numel()), ca.SX.sym("price")
        A, gradient = ca.jacobian(rows, unknowns), ca.gradient(total, unknowns)
        H = ca.hessian(price * total + ca.dot(y, rows), unknowns)[0]
        slope = gradient + A.T @ y
        self.nlp = {"x": unknowns, "p": p, "f": total, "g": rows}
        #: With a cost factor of 1.
        self.conditions = ca.Function("c", [unknowns, y, p, price], [slope, rows, H, A])
        sides = ca.jacobian(ca.vertcat(slope, rows), own)
        self.sides = ca.Function("sides", [unknowns, y, p], [sides])
        #: Shared by the IPOPT solvers of all mu.
        self.derivatives = {
            "grad_f": ca.Function("g", [unknowns, p], [total, gradient]),
            "jac_g": ca.Function("j", [unknowns, p], [rows, A]),
            "hess_lag": ca.Function("h", [unknowns, p, price, y], [ca.triu(H)]),
        }
        self._solvers: dict[tuple[str, float, bool], Any] = {}

    def _solver(self, name: str, mu: float, near: bool) -> Any:
        """CasADi solver by name; IPOPT for a target mu, with or without a warm start."""
        options = _SILENT | _OPTIONS[name]
        if name == "fatrop":
            options["equality"] = self.equal.tolist()
        if name == "ipopt":
            there = _NEAR | {"mu_init": mu} if near else {}
            options |= self.derivatives | {"ipopt": _IPOPT | {"mu_target": mu} | there}
        return ca.nlpsol("plan", name, self.nlp, options)

    def answer(
        self, name: str, p: Array, w: Array, y: Array | None, mu: float
    ) -> tuple[Array, Array]:
        """Run a solver from a guess w (and y for a warm start); the result is not checked."""
        key = (name, mu if name == "ipopt" else 0.0, y is not None)
        if key not in self._solvers:
            self._solvers[key] = self._solver(*key)
        given = {"x0": w, "p": p, "lbg": np.where(self.equal, 0.0, -np.inf), "ubg": 0.0}
        found = self._solvers[key](**given, **({} if y is None else {"lam_g0": y}))
        return found["x"].full().ravel(), found["lam_g"].full().ravel()


@functools.lru_cache(maxsize=64)
def program_of(problem: Stages) -> Program:
    """Program of a problem, cached."""
    return Program(problem)


@dataclass(frozen=True, eq=False)
class Plan(Frozen):
    """A solution of the relaxed conditions, with its derivatives by theta and x_0."""

    problem: Stages
    p: Array  # x_0, disturbances and parameters
    w: Array  # states and inputs, x_0, u_0, x_1, ...
    y: Array  # multipliers of equations and rows
    s: Array  # slacks of the rows
    slope: Array  # derivative of (w, y), each (p + n,)
    x: Array  # (N + 1, n), states
    u: Array  # (N, m), inputs
    dx: Array  # (N + 1, n, p + n), derivative of the states
    du: Array  # (N, m, p + n), derivative of the inputs

    @property
    def theta(self) -> Array:
        """Parameters (p,)."""
        return self.p[-len(self.problem.parameter_names) :]

    @property
    def d(self) -> Array:
        """Disturbances that the plan assumes (N, d)."""
        known = self.p[self.problem.n : -len(self.problem.parameter_names)]
        return known.reshape(self.problem.horizon, -1)

    @property
    def active(self) -> tuple[tuple[str, int], ...]:
        """Name and sample of the rows at their limit."""
        return self._rows(1.0, np.inf)

    @property
    def weakly_active(self) -> tuple[tuple[str, int], ...]:
        """Name and sample of the rows that are about to become active or inactive."""
        return self._rows(*_WEAK)

    def _rows(self, low: float, high: float) -> tuple[tuple[str, int], ...]:
        program = program_of(self.problem)
        ratio = self.y[~program.equal] / self.s
        return tuple(program.labels[k] for k in np.flatnonzero((ratio > low) & (ratio < high)))


def solve_plan(
    problem: Stages,
    theta: Array,
    x0: Array,
    *,
    d: Array | None = None,
    solver: str = "ipopt",
    mu: float = 1e-10,
    guess: tuple[Array, Array] | None = None,
) -> Plan:
    """Solve from a guess or from rest at `theta` (p,), `x0` (n,), `d` (N, d); raise if none."""
    solver = require_solver(solver)
    if not 1e-12 <= mu <= 1e6:
        raise InputError("mu", f"got {mu:g}", "give 1e-12 to 1e6")
    N = problem.horizon
    d = np.zeros((N, problem.disturbance_count)) if d is None else d
    held, still = np.repeat(x0[None], N + 1, axis=0), np.zeros((N, problem.m))
    guesses = [*([] if guess is None else [guess]), (held, still), (0 * held, still)]
    _require_finite_start(problem, theta, d, *guesses[0])
    for x, u in guesses:
        found = solved_plan(problem, theta, d, np.vstack([x0, x[1:]]), u, solver, mu)
        if found is not None and not _flat(problem, found.p, found.w, found.y, found.s):
            return found
    x, u = guesses[0]
    raise _no_plan(problem, _parameters(x0, d, theta), _stages(np.vstack([x0, x[1:]]), u))


def solved_plan(
    problem: Stages,
    theta: Array,
    d: Array,
    x: Array,
    u: Array,
    solver: str,
    mu: float,
) -> Plan | None:
    """Plan from x (N + 1, n), u (N, m), also by way of a large mu; None if it fails."""
    p, w = _parameters(x[0], d, theta), _stages(x, u)
    paths = ([(solver, first), ("ipopt", mu)] for first in dict.fromkeys([mu, max(mu, 1e-1)]))
    return _first(problem, p, w, None, paths)


def nearby_plan(plan: Plan, theta: Array, x0: Array, mu: float) -> Plan | None:
    """Plan at other theta (p,), x0 (n,) or mu, from a warm start along its derivative, or None."""
    change = np.concatenate([theta - plan.theta, x0 - plan.x[0]])
    moved = np.concatenate([plan.w, plan.y]) + plan.slope @ change
    w, y = np.split(moved, [len(plan.w)])
    y = np.where(program_of(plan.problem).equal, y, np.maximum(y, 0.1 * plan.y))
    # A larger mu helps where a multiplier must vanish: at 1e-10 its slack keeps it.
    paths = [[("ipopt", mu)], [("ipopt", max(mu, _CENTRAL)), ("ipopt", mu)]]
    return _first(plan.problem, _parameters(x0, plan.d, theta), w, y, paths)


def _parameters(x0: Array, d: Array, theta: Array) -> Array:
    return np.concatenate([x0, d.ravel(), theta])


def _stages(x: Array, u: Array) -> Array:
    return np.concatenate([np.hstack([x[:-1], u]).ravel(), x[-1]])


def _states_and_inputs(problem: Stages, w: Array) -> tuple[Array, Array]:
    """Split stages (N (n + m) + n, ...) into (N + 1, n, ...) and (N, m, ...)."""
    n = problem.n
    stages = w[:-n].reshape(problem.horizon, n + problem.m, *w.shape[1:])
    return np.concatenate([stages[:, :n], w[None, -n:]]), stages[:, n:]


def _first(
    problem: Stages,
    p: Array,
    w: Array,
    y: Array | None,
    paths: Iterable[list[tuple[str, float]]],
) -> Plan | None:
    """First plan that is found along paths of (solver, mu) pairs."""
    for path in paths:
        found: tuple[Array, Any] = w, y
        for solver, mu in dict.fromkeys(path):
            found = program_of(problem).answer(solver, p, *found, mu)
        ended = _ended(problem, p, *found, path[-1][1])
        if ended is not None:
            return ended
    return None


def _ended(problem: Stages, p: Array, w: Array, y: Array, mu: float) -> Plan | None:
    """Plan from a solver's result w, y by Newton steps on the conditions; None if they fail."""
    program = program_of(problem)
    rows, y, s = ~program.equal, y.copy(), np.zeros(0)
    for step in range(_STEPS):
        gradient, g, H, A = program.conditions(w, y, p, 1)
        gradient, g, A = gradient.full().ravel(), g.full().ravel(), A.sparse()
        if step == 0:  # keep the larger of each pair (s, lam)
            s = np.maximum(-g[rows], np.sqrt(mu))
            held = y[rows] > s
            y[rows] = np.where(held, y[rows], mu / s)
            s = np.where(held, mu / y[rows], s)
        lam, left, left_y, damping = y[rows], g.copy(), g.copy(), np.zeros(len(y))
        left[rows] += s
        left_y[rows] += mu / lam
        damping[rows] = s / lam
        size = max(1.0, float(np.max(np.abs(y))))
        off = float(np.max(np.abs(s * lam - mu), initial=0.0)) / mu * _TOLERANCE / _PRODUCT
        error = max(np.max(np.abs(gradient)) / size, np.max(np.abs(left)), off)
        K = scipy.sparse.bmat([[H.sparse(), A.T], [A, scipy.sparse.diags(-damping)]], format="csc")
        try:
            factors = splu(K)
        except (RuntimeError, ValueError):  # singular, or not finite
            return None
        if error < _TOLERANCE:
            slope = factors.solve(-program.sides(w, y, p).full())
            found = _states_and_inputs(problem, w), _states_and_inputs(problem, slope[: len(w)])
            return Plan(problem, p, w, y, s, slope, *found[0], *found[1])
        dw, dy = np.split(factors.solve(-np.concatenate([gradient, left_y])), [len(w)])
        ds = -(left + A @ dw)[rows]
        fall = max(np.max(-ds / s, initial=0.0), np.max(-dy[rows] / lam, initial=0.0))
        length = min(1.0, 0.995 / max(fall, 1e-300))
        w, y, s = w + length * dw, y + length * dy, s + length * ds
    return None


def _flat(problem: Stages, p: Array, w: Array, y: Array, s: Array) -> str:
    """Description of where the second derivative along the dynamics is not positive, or "".

    It is positive if the Riccati recursion over the stages has positive pivots; rows enter with
    their multiplier over their slack s.
    """
    program, n, size = program_of(problem), problem.n, problem.n + problem.m
    H, A = (item.sparse().tocsr() for item in program.conditions(w, y, p, 1)[2:])
    equations, G = A[program.equal], A[~program.equal]
    H = (H + G.T.multiply(y[~program.equal] / s).tocsr() @ G).tocsr()
    P = H[-n:, -n:].toarray()
    for k in range(problem.horizon - 1, -1, -1):
        here, rows = slice(k * size, (k + 1) * size), (k + 1) * n if k else 0
        F = -equations[rows : rows + n, here].toarray()
        whole = H[here, here].toarray() + F.T @ P @ F
        try:
            np.linalg.cholesky((whole + whole.T)[n:, n:])
        except np.linalg.LinAlgError:
            return f"the cost has no minimum in the inputs of sample {k}"
        P = whole[:n, :n] - whole[:n, n:] @ np.linalg.solve(whole[n:, n:], whole[n:, :n])
    return ""


def _require_finite_start(problem: Stages, theta: Array, d: Array, x: Array, u: Array) -> None:
    """Require that every function is finite along a guess x (N + 1, n), u (N, m)."""
    stages = zip(x, [*u, np.zeros(problem.m)], [*d, np.zeros(d.shape[1])], strict=True)
    for k, stage in enumerate(stages):
        for function in problem.functions:
            at_end = function.name().startswith("terminal")
            if at_end == (k == len(u)) and not np.all(np.isfinite(function(*stage, theta).full())):
                raise InputError(
                    function.name(), f"is not finite at sample {k} of the start",
                    "check the expression, the first parameters and the initial state",
                )  # fmt: skip


def _no_plan(problem: Stages, p: Array, w: Array) -> InfeasibleError | SolverError:
    """Error without a plan: the row with the largest excess at minimum total excess, or cost."""
    program = program_of(problem)
    rows, nlp = np.flatnonzero(~program.equal), program.nlp
    if len(rows):
        excess = type(nlp["f"]).sym("excess", len(rows))
        placed = ca.DM.eye(len(program.equal))[:, rows.tolist()]
        soft = {
            "x": ca.vertcat(nlp["x"], excess), "p": nlp["p"], "f": ca.sum1(excess),
            "g": nlp["g"] - placed @ excess,
        }  # fmt: skip
        answer = ca.nlpsol("worst", "ipopt", soft, _SILENT | {"ipopt": IPOPT_ALONE})(
            x0=np.r_[w, np.ones(len(rows))], p=p, ubg=0.0,
            lbx=np.r_[np.full(len(w), -np.inf), np.zeros(len(rows))],
            lbg=np.where(program.equal, 0.0, -np.inf),
        )  # fmt: skip
        left = answer["x"].full().ravel()[len(w) :]
        name, sample = program.labels[int(np.argmax(left))]
        if np.max(left) > _EXCESS:
            return InfeasibleError(
                f"constraint {name}", f"no plan was found that satisfies it at sample {sample}: the"
                f" least excess is {np.max(left):.3g}",
                "use other starting parameters or another initial state",
            )  # fmt: skip
    w, y = program.answer("ipopt", p, w, None, 1e-10)
    y = np.where(program.equal, y, np.maximum(y, 0))
    s = np.maximum(-program.conditions(w, y, p, 1)[1].full().ravel()[rows], 1e-10)
    reason = _flat(problem, p, w, y, s) if np.isfinite(w).all() else ""
    return SolverError(
        "plan", reason or "the search for a plan did not converge",
        "give every input a cost weight" if reason else "start nearer, or try another solver",
    )  # fmt: skip
