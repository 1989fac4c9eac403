"""The least-distance problem of one sample, solved by a named solver of CasADi.

The solver only determines the active set (docs/why/theory.md, section 4). The input and its
derivative follow from the equations of the active set (`closed_loop`); a solver whose own solution
differs from these by more than 1e-4 of its size is rejected. Its success flag is not used.

    minimise  z'z / 2 + cost weight sum(t)   subject to  A z <= d + t,  t >= 0 for soft rows

is the problem in scaled numbers: z is v in coordinates in which S is the identity, divided by the
distance of a typical row; rows are divided by their bounds. Soft rows are softened only if the hard
problem is infeasible or its multipliers exceed the penalty.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.optimize

from impc.arrays import Array, BoolArray, IntArray
from impc.control.compiled_dual import DEPENDENT
from impc.control.compiled_values import Rows
from impc.control.halfspaces import PIVOTS
from impc.errors import InputError
from impc.settings_files import IPOPT_ALONE

#: Name of the built-in method, see `compiled_dual`.
COMPILED = "compiled"
_IPOPT: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "ipopt": {
        **IPOPT_ALONE,
        "tol": 1e-12,
        "compl_inf_tol": 1e-12,
        "constr_viol_tol": 1e-12,
        "acceptable_tol": 1e-11,
        "bound_relax_factor": 0.0,
        "hessian_constant": "yes",
        "jac_c_constant": "yes",
        "jac_d_constant": "yes",
    },
}
#: CasADi plugin and options of each available solver.
# Active-set methods end at round-off, IPOPT at its tolerance, which is tightened from 1e-8. These
# three find every input in 180 random loops (hard state bounds, soft ones, soft ones with a penalty
# of 1e6). Not offered: qrqp failed in 2 of 30 loops with hard rows and in most with soft ones, OSQP
# in 7 of 90; fatrop needs separate stages and prints.
PLUGINS: dict[str, tuple[str, dict[str, Any]]] = {
    "daqp": ("daqp", {"error_on_fail": False}),
    "qpoases": (
        "qpoases",
        {
            "printLevel": "none",
            "error_on_fail": False,
            "sparse": False,
            # The default starts at lower bounds, which are infinite here: 1 of 180 random loops
            # ended in a division by zero.
            "initialStatusBounds": "inactive",
        },
    ),
    "ipopt": ("nlpsol", {"error_on_fail": False, "nlpsol": "ipopt", "nlpsol_options": _IPOPT}),
}
#: Names of the available CasADi solvers.
SOLVERS = tuple(PLUGINS)

# Slacks are linear in the cost, so the Hessian is singular, which DAQP does not accept. They get a
# quadratic cost about a centre, with this share of their penalty, and the problem is solved again
# about the solution until it no longer moves (proximal point method).
_PROXIMAL, _ROUNDS = 1e-3, 10
# Convergence tolerance relative to 1 and to the largest slack.
_SETTLED = 1e-7
# Tolerance for the optimality conditions of a solver's own solution, and for its difference from
# that of the active-set equations, relative to max(1, |z|). DAQP satisfies rows to 1e-5 for a
# penalty of 1e6. The solution of the equations is checked to 1e-9.
_AGREES = 1e-4

# Smallest relative excess that proves infeasibility: HiGHS ends at 1e-7.
_EXCEEDED = 1e-6

_own = threading.local()  # CasADi functions must not be evaluated by two threads at a time
_printing = threading.Lock()

_Answer = tuple[Array, Array, Array, float]


@dataclass(frozen=True)
class Program:
    """The scaled problem of one controller; made by `build_program`."""

    solver: str  # one of `SOLVERS`
    A: Array  # (r, N m), scaled rows
    squares: Array  # (r,), squared length of each row of A
    unit: float  # factor from z to L'v, S = LL'
    b: Array  # (r,), bounds
    soft: BoolArray  # (r,), which rows may be exceeded
    cost_weight: float  # of the scaled excess
    # H, rows and lower bounds of y in  min y'H y / 2 + g'y,  with all rows hard and with slacks
    hard: tuple[ca.DM, ...]
    softened: tuple[ca.DM, ...]


@dataclass(frozen=True)
class ActiveSet:
    """Active set that a solver found at one sample."""

    tight: IntArray  # (a,), rows that hold with equality, linearly independent
    given_up: BoolArray  # (r,), soft rows that are exceeded
    w: Array  # (N m,), the solver's own solution L'v with S = LL'
    agrees: float  # tolerance for the difference of w from the active-set equations, in its unit


def require_solver(name: str) -> str:
    """Return the name of an available solver in lower case."""
    given, name = name, name.lower()
    if name not in (COMPILED, *SOLVERS):
        known = ", ".join((COMPILED, *SOLVERS))
        raise InputError("solver", f"got {given!r}", f"choose one of {known}")
    if name != COMPILED and not (ca.has_nlpsol if name == "ipopt" else ca.has_conic)(name):
        raise InputError(
            "solver",
            f"{name!r} is not part of the installed CasADi",
            "choose another, or install CasADi from its wheel",
        )
    return name


def described(name: str) -> str:
    """Name of a solver for reports."""
    return "the package's own" if name == COMPILED else f"{name}, of CasADi"


class _Silence:
    """Standard output without the text of one thread."""

    def __init__(self, beneath: Any) -> None:
        self._beneath = beneath
        self._thread = threading.get_ident()

    def write(self, text: str) -> int:
        if threading.get_ident() == self._thread:
            return len(text)
        return int(self._beneath.write(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._beneath, name)


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Suppress the output of a solver; qpOASES always prints its licence."""
    with _printing, contextlib.redirect_stdout(_Silence(sys.stdout)):
        yield


def build_program(solver: str, rows: Rows) -> Program:
    """Build the scaled problem for a solver."""
    squares = np.diag(rows.gram)
    reaching = squares > 0
    distances = rows.b[reaching] / np.sqrt(squares[reaching])
    unit = float(np.median(distances)) if reaching.any() else 1.0
    A = unit * rows.W / rows.b[:, None]
    soft = np.isfinite(rows.limit)
    cost_weight = float(np.max(rows.limit[soft] * rows.b[soft], initial=0.0)) / unit**2
    width, slacks = rows.W.shape[1], int(soft.sum())
    curvature = np.r_[np.ones(width), np.full(slacks, _PROXIMAL * np.sqrt(cost_weight))]
    wide = np.column_stack([A, -np.eye(len(A))[:, soft]])
    least = np.r_[np.full(width, -np.inf), np.zeros(slacks)]
    hard, softened = (
        (ca.diag(ca.DM(curvature[:size])), ca.DM(wide[:, :size]), ca.DM(least[:size]))
        for size in (width, width + slacks)
    )
    lengths = unit**2 * squares / rows.b**2
    return Program(solver, A, lengths, unit, rows.b, soft, cost_weight, hard, softened)


def active_set(program: Program, d: Array) -> ActiveSet | None:
    """Active set by the solver; None if its solution violates the optimality conditions."""
    if not (np.all(np.isfinite(program.A)) and np.all(np.isfinite(d))):
        return None
    A, right, soft = program.A, d / program.b, program.soft
    found = _solve(program, program.hard, right, np.zeros(len(d)))
    if soft.any() and (found is None or np.any(found[1][soft] > program.cost_weight)):
        found = _solve_softened(program, right)
    if found is None:
        return None
    z, multipliers, excess, size = found
    # Rule of the primal-dual active-set method: compare each multiplier, as a share of the bound,
    # with the slack, and the rest of the penalty with the excess.
    given_up = soft & (
        excess > np.maximum(program.cost_weight - multipliers, 0.0) * program.squares
    )
    held = np.flatnonzero((multipliers * program.squares > right - A @ z) & ~given_up)
    pull = -z - A.T @ (program.cost_weight * given_up)
    tight = _independent(A, held, multipliers, pull)
    return ActiveSet(tight, given_up, program.unit * z, _AGREES * program.unit * size)


def excluded_row(rows: Rows, slack: Array) -> int:
    """Index of a hard row that is incompatible with the others, by linear programming, or -1.

    The smallest share t of their bounds by which all rows are exceeded, M v <= slack + t b, is
    positive; the row is the one with the largest multiplier. `slack` (r,).
    """
    hard = np.isinf(rows.limit)
    width, b = rows.M.shape[1], rows.b[hard]
    if not (
        np.all(np.isfinite(rows.M)) and np.all(np.isfinite(slack))
    ):  # unstable prediction overflowed
        return -1
    answer: Any = scipy.optimize.linprog(
        np.r_[np.zeros(width), 1.0],
        A_ub=np.column_stack([rows.M[hard] / b[:, None], -np.ones(len(b))]),
        b_ub=slack[hard] / b,
        bounds=[*[(None, None)] * width, (-1.0, None)],
        method="highs",
        options={"maxiter": PIVOTS * (width + len(b))},
    )
    if answer.status != 0 or not answer.x[-1] > _EXCEEDED:
        return -1
    return int(np.flatnonzero(hard)[np.argmax(-answer.ineqlin.marginals)])


def _solve_softened(program: Program, right: Array) -> _Answer | None:
    centre: Array = np.zeros(len(right))
    for _ in range(_ROUNDS):
        found = _solve(program, program.softened, right, centre)
        if found is None:
            return None
        excess = found[2]
        if np.abs(excess - centre).max() <= _SETTLED * max(1.0, excess.max()):
            return found
        centre = excess
    return None


def _solve(
    program: Program, given: tuple[ca.DM, ...], right: Array, centre: Array
) -> _Answer | None:
    """Solution of the solver, if it satisfies rows and optimality conditions."""
    A, soft = program.A, program.soft
    H, rows, least = given
    (count, width) = A.shape
    pull = program.cost_weight - _PROXIMAL * np.sqrt(program.cost_weight) * centre[soft]
    g = np.r_[np.zeros(width), pull][: H.size1()]
    function = _function(program.solver, H.size1(), count)
    with silent():
        answer = function(h=H, g=g, a=rows, lba=-np.inf, uba=right, lbx=least, ubx=np.inf)
    found, multipliers = answer["x"].full().ravel(), answer["lam_a"].full().ravel()
    if not (np.all(np.isfinite(found)) and np.all(np.isfinite(multipliers))):
        return None
    z, excess = found[:width], np.zeros(count)
    if len(found) > width:
        excess[soft] = found[width:]
    size = max(1.0, float(np.abs(z).max()))
    most = max(1.0, float(np.abs(multipliers).max()))
    with np.errstate(over="ignore", invalid="ignore"):  # overflow on unstable plants: rejected
        kept = (A @ z - right - excess).max() <= _AGREES * size
        stationary = np.abs(z + A.T @ multipliers).max() <= _AGREES * max(size, most)
    signed = multipliers.min() >= -_AGREES * most
    return (z, multipliers, excess, size) if kept and stationary and signed else None


def _independent(A: Array, held: IntArray, multipliers: Array, pull: Array) -> IntArray:
    """Linearly independent rows among `held` that carry the pull; by `nnls` if dependent."""
    if len(held) == 0:
        return held
    diagonal = np.abs(np.diagonal(np.linalg.qr(A[held].T, mode="r")))
    lengths = np.linalg.norm(A[held], axis=1)[: len(diagonal)]
    if len(held) <= A.shape[1] and np.all(diagonal > DEPENDENT * lengths):
        return held
    order = held[np.argsort(-multipliers[held], kind="stable")]
    chosen, _ = scipy.optimize.nnls(A[order].T, pull)
    return np.sort(order[chosen > 0])


def _function(solver: str, width: int, count: int) -> Callable[..., Any]:
    """Solver for problems of this size, one for each thread."""
    kept: dict[tuple[str, int, int], Any] = _own.__dict__.setdefault("functions", {})
    key = solver, width, count
    if key not in kept:
        name, options = PLUGINS[solver]
        shapes = {"h": ca.Sparsity.diag(width), "a": ca.Sparsity.dense(count, width)}
        with silent():
            kept[key] = ca.conic("mpc", name, shapes, options)
    return kept[key]  # type: ignore[no-any-return]
