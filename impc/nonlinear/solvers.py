"""CasADi's solvers of nonlinear programs by name, as starts of `impc.nonlinear.plan`.

The program is written with x_0 as an unknown that one equation fixes, and in the order x, u stage
by stage, which is the structure that fatrop looks for. A solver's own word on how it ended is not
used: with a mu_target above zero IPOPT converges and says that it did not. What it leaves is taken
as a start, and judged by the conditions of docs/nonlinear.md.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from impc.arrays import Array, BoolArray
from impc.errors import InputError
from impc.nonlinear.conditions import Point, wanted_rows
from impc.settings_files import IPOPT_ALONE

if TYPE_CHECKING:
    from impc.nonlinear.problem import OptimalControlProblem

#: Names of the solvers: interior points, sequential quadratic programs, structured interior points.
SOLVERS = ("ipopt", "sqpmethod", "fatrop")
_SILENT: dict[str, Any] = {"print_time": False, "error_on_fail": False}


def require_solver(name: str) -> str:
    """Return the name of one of `SOLVERS` that CasADi has; it may be given in capitals."""
    given, name = name, name.lower()
    if name not in SOLVERS:
        raise InputError("solver", f"got {given!r:.40}", f"choose one of {', '.join(SOLVERS)}")
    if not ca.has_nlpsol(name):
        raise InputError("solver", f"{name} is not in this CasADi", "choose ipopt")
    return name


def _options(name: str, problem: OptimalControlProblem, mu: float) -> dict[str, Any]:
    if name == "ipopt":
        return _SILENT | {"ipopt": {
            **IPOPT_ALONE, "max_iter": 300, "tol": 1e-8, "mu_target": mu,
            # mu means the same as in the conditions only if IPOPT scales and relaxes nothing.
            "nlp_scaling_method": "none", "bound_relax_factor": 0.0,
        }}  # fmt: skip
    if name == "sqpmethod":
        return _SILENT | {
            "print_header": False, "print_iteration": False, "print_status": False,
            "qpsol": "proxqp", "qpsol_options": {"error_on_fail": False},
            "convexify_strategy": "eigen-clip", "max_iter": 300, "tol_du": 1e-8, "tol_pr": 1e-8,
        }  # fmt: skip
    equal = np.concatenate([_equal(problem, k) for k in range(problem.horizon + 1)])
    return _SILENT | {
        "structure_detection": "auto", "equality": equal.tolist(),
        "fatrop": {"print_level": 0, "tol": 1e-8, "max_iter": 300},
    }  # fmt: skip


def _equal(problem: OptimalControlProblem, k: int) -> BoolArray:
    """Which constraints of a stage are equations: dynamics, and x_0 itself."""
    if k == problem.horizon:
        return np.zeros(len(problem.terminal_rows), dtype=bool)
    first = problem.n if k == 0 else 0
    rows = int(wanted_rows(problem)[k].sum())
    return np.arange(problem.n + first + rows) < problem.n + first


def _program(problem: OptimalControlProblem) -> dict[str, Any]:
    """The whole program as expressions, of p = (x_0, d, theta)."""
    f, cost, e, h, h_end = problem.functions
    n, m, N = problem.n, problem.m, problem.horizon
    x0 = ca.MX.sym("x0", n)
    d = ca.MX.sym("d", problem.disturbance_count, N)
    theta = ca.MX.sym("theta", len(problem.parameter_names))
    wanted = wanted_rows(problem)
    unknowns: list[Any] = []
    constraints: list[Any] = []
    total = ca.MX(0)
    x = ca.MX.sym("x_0", n)
    for k in range(N):
        u, following = ca.MX.sym(f"u_{k}", m), ca.MX.sym(f"x_{k + 1}", n)
        given = (x, u, d[:, k], theta)
        unknowns += [x, u]
        constraints.append(following - f(*given))
        if k == 0:
            constraints.append(x - x0)
        rows = h(*given)
        constraints += [rows[int(row)] for row in np.flatnonzero(wanted[k])]
        total += cost(*given)
        x = following
    at_end = (x, ca.MX.zeros(m), ca.MX.zeros(problem.disturbance_count), theta)
    unknowns.append(x)
    constraints.append(h_end(*at_end))
    return {
        "x": ca.vertcat(*unknowns), "p": ca.vertcat(x0, ca.vec(d), theta),
        "f": total + e(*at_end), "g": ca.vertcat(*constraints),
    }  # fmt: skip


@functools.lru_cache(maxsize=64)
def _solver(problem: OptimalControlProblem, name: str, mu: float) -> Any:
    plain = all(item.is_a("SXFunction") for item in problem.functions)
    options = _options(name, problem, mu) | {"expand": plain}
    return ca.nlpsol("plan", name, _program(problem), options)


def start_of(
    problem: OptimalControlProblem,
    name: str,
    theta: Array,
    d: Array,
    x: Array,
    u: Array,
    mu: float,
) -> Point:
    """What a solver makes of a guess: no claim, it may be anything.

    `theta` (p,); `d` (N, d); `x` (N + 1, n); `u` (N, m).
    """
    equal = np.concatenate([_equal(problem, k) for k in range(problem.horizon + 1)])
    answer = _solver(problem, name, mu if name == "ipopt" else 0.0)(
        x0=np.r_[np.hstack([x[:-1], u]).ravel(), x[-1]],
        p=np.r_[x[0], d.ravel(), theta],
        lbg=np.where(equal, 0.0, -np.inf),
        ubg=0.0,
    )
    return _point(problem, answer["x"].full().ravel(), answer["lam_g"].full().ravel(), x[0], mu)


def _point(
    problem: OptimalControlProblem, values: Array, multipliers: Array, x0: Array, mu: float
) -> Point:
    """A point with slacks inside: of each pair (s, lam) the larger is believed."""
    n, N = problem.n, problem.horizon
    stages = values[:-n].reshape(N, -1)
    x = np.vstack([x0, stages[1:, :n], values[-n:]])
    wanted = wanted_rows(problem)
    nu, lam = np.zeros((N, n)), np.zeros(wanted.shape)
    place = 0
    for k in range(N):
        nu[k] = -multipliers[place : place + n]
        place += 2 * n if k == 0 else n
        count = int(wanted[k].sum())
        lam[k, wanted[k]] = multipliers[place : place + count]
        place += count
    return Point(x, stages[:, n:], nu, lam, np.zeros_like(lam), multipliers[place:],
                 np.zeros(len(problem.terminal_rows)))  # fmt: skip


def worst_row(
    problem: OptimalControlProblem, theta: Array, d: Array, x: Array, u: Array
) -> tuple[str, int, float]:
    """Name, sample and excess of the row that a plan of least total excess exceeds most.

    The state is that of x[0], the guess x (N + 1, n), u (N, m); theta (p,), d (N, d).
    """
    program = _program(problem)
    equal = np.concatenate([_equal(problem, k) for k in range(problem.horizon + 1)])
    if np.all(equal):
        return "", -1, 0.0
    excess = ca.MX.sym("excess", int((~equal).sum()))
    placed = np.zeros((len(equal), excess.numel()))
    placed[np.flatnonzero(~equal), np.arange(excess.numel())] = 1
    soft = {
        "x": ca.vertcat(program["x"], excess), "p": program["p"], "f": ca.sum1(excess),
        "g": program["g"] - ca.mtimes(ca.DM(placed), excess),
    }  # fmt: skip
    ipopt = IPOPT_ALONE | {"max_iter": 500}
    solver = ca.nlpsol("worst", "ipopt", soft, _SILENT | {"ipopt": ipopt})
    guess = np.r_[np.hstack([x[:-1], u]).ravel(), x[-1]]
    answer = solver(
        x0=np.r_[guess, np.ones(excess.numel())], p=np.r_[x[0], d.ravel(), theta],
        lbx=np.r_[np.full(len(guess), -np.inf), np.zeros(excess.numel())],
        lbg=np.where(equal, 0.0, -np.inf), ubg=0.0,
    )  # fmt: skip
    left = answer["x"].full().ravel()[len(guess) :]
    wanted = wanted_rows(problem)
    labels = [
        (problem.rows[j], k) for k in range(problem.horizon) for j in np.flatnonzero(wanted[k])
    ]
    labels += [(name, problem.horizon) for name in problem.terminal_rows]
    worst = int(np.argmax(left))
    return labels[worst][0], labels[worst][1], float(left[worst])
