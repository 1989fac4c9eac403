"""The least-distance problem of one sample, built and solved by CasADi with a solver by its name.

`compiled_dual` has a method of its own for it (docs/theory.md, section 4). Any other finds the same
answer, and is asked for what only a solver can determine: which rows hold. With those the input and
its derivative follow from the equations of the active set (`closed_loop`), and a solver whose own
answer is not that one, to 1e-4 of its size, is not believed. What a solver says of its success is
not asked for.

    minimise  z'z / 2 + cost weight sum(t)   subject to  A z <= d + t,  t >= 0 for soft rows

is the problem in numbers of size one: z is v in coordinates in which S is the identity, over the
distance of a typical row; rows are divided by their bounds. Soft rows enter it only where the hard
problem has no answer, or one whose multipliers exceed the cost weight of the rows.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import scipy.optimize

from impc.arrays import Array, BoolArray, IntArray
from impc.control.compiled_dual import DEPENDENT
from impc.errors import InputError
from impc.settings_files import IPOPT_ALONE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from impc.control.constraint_rows import Rows

#: The package's own method, see `compiled_dual`.
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
#: Plugin of CasADi and its options, of each solver that may be asked for.
# Active-set methods end at round-off, IPOPT's interior-point method at
# its tolerance, which is tightened from 1e-8. Of 180 random loops (hard state bounds, soft ones,
# soft ones at a cost weight of a million) these three find every input. Not offered: qrqp, which
# had no answer in 2 of 30 loops with hard rows and in most with soft ones; OSQP, in 7 of 90;
# fatrop, which wants the stages apart and prints.
PLUGINS: dict[str, tuple[str, dict[str, Any]]] = {
    "daqp": ("daqp", {"error_on_fail": False}),
    "qpoases": (
        "qpoases",
        {
            "printLevel": "none",
            "error_on_fail": False,
            "sparse": False,
            # By default it starts at lower bounds, which are infinite here: of 180 random loops one
            # ended in a division by zero.
            "initialStatusBounds": "inactive",
        },
    ),
    "ipopt": ("nlpsol", {"error_on_fail": False, "nlpsol": "ipopt", "nlpsol_options": _IPOPT}),
}
#: Names of CasADi's solvers that may be asked for.
SOLVERS = tuple(PLUGINS)

# Slacks enter the cost linearly, so the Hessian is singular, which DAQP does not take. They get a
# quadratic cost about a centre, of this share of their cost weight, and the problem is solved again
# about what was found until that no longer moves: then the quadratic cost has no effect (proximal
# point).
_PROXIMAL, _ROUNDS = 1e-3, 10
# Relative to 1 and to the largest slack.
_SETTLED = 1e-7
# What the conditions of optimality may be broken by in a solver's own answer, and what its z may
# differ from that of the equations by, relative to the larger of 1 and z. DAQP keeps rows to 1e-5
# where a cost weight of a million is paid. The answer of the equations is checked to 1e-9.
_AGREES = 1e-4

# Share of their bounds by which rows that no plan keeps are exceeded at least: HiGHS ends at 1e-7.
_EXCEEDED = 1e-6

_own = threading.local()  # a CasADi function is not to be evaluated in two threads at a time
_printing = threading.Lock()

_Answer = tuple[Array, Array, Array, float]


@dataclass(frozen=True)
class Program:
    """The problem of the module's text for one controller; made by `build_program`."""

    solver: str  # One of `SOLVERS`
    A: Array  # Rows in the problem's numbers (r, N m)
    squares: Array  # Squared length of each row of A (r,)
    unit: float  # What z is multiplied by to become L'v, S = LL'
    b: Array  # Bounds (r,)
    soft: BoolArray  # Which rows may be exceeded (r,)
    cost_weight: float  # Of the excess, in the problem's numbers
    # H, rows and least y of  min y'H y / 2 + g'y,  with all rows hard and with slacks
    hard: tuple[ca.DM, ...]
    softened: tuple[ca.DM, ...]


@dataclass(frozen=True)
class ActiveSet:
    """What a solver found at one sample."""

    tight: IntArray  # Rows that hold with equality, linearly independent (a,)
    given_up: BoolArray  # Soft rows that are exceeded (r,)
    w: Array  # The solver's own answer L'v with S = LL' (N m,)
    agrees: float  # What w may differ from that of the equations by, in its unit


def require_solver(name: str) -> str:
    """Return the name of a solver that there is."""
    given, name = name, name.lower()
    if name not in (COMPILED, *SOLVERS):
        known = ", ".join((COMPILED, *SOLVERS))
        raise InputError("solver", f"got {given!r}", f"choose one of {known}")
    if name != COMPILED and not (ca.has_nlpsol if name == "ipopt" else ca.has_conic)(name):
        raise InputError(
            "solver",
            f"{name!r} is not part of the CasADi that is installed",
            "choose another, or install CasADi from its wheel",
        )
    return name


def described(name: str) -> str:
    """A solver by its `name` as a page says it."""
    return "the package's own" if name == COMPILED else f"{name}, of CasADi"


class _Silence:
    """Standard output but for what one thread writes."""

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
    """Keep off standard output what a solver prints; qpOASES always prints its licence."""
    with _printing, contextlib.redirect_stdout(_Silence(sys.stdout)):
        yield


def build_program(solver: str, rows: Rows) -> Program:
    """Write the problem of rows for a solver."""
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
    """Ask a solver which rows hold; None when its answer breaks the conditions of optimality."""
    if not (np.all(np.isfinite(program.A)) and np.all(np.isfinite(d))):
        return None
    A, right, soft = program.A, d / program.b, program.soft
    found = _solve(program, program.hard, right, np.zeros(len(d)))
    if soft.any() and (found is None or np.any(found[1][soft] > program.cost_weight)):
        found = _solve_softened(program, right)
    if found is None:
        return None
    z, multipliers, excess, size = found
    # The rule of the primal-dual active-set method: a multiplier, as the share of the bound that it
    # stands for, against the slack; and what the cost weight leaves of it against the excess.
    given_up = soft & (
        excess > np.maximum(program.cost_weight - multipliers, 0.0) * program.squares
    )
    held = np.flatnonzero((multipliers * program.squares > right - A @ z) & ~given_up)
    pull = -z - A.T @ (program.cost_weight * given_up)
    tight = _independent(A, held, multipliers, pull)
    return ActiveSet(tight, given_up, program.unit * z, _AGREES * program.unit * size)


def excluded_row(rows: Rows, slack: Array) -> int:
    """A hard row that no input sequence keeps beside the others, by linear programming; -1 if none.

    The least share t of their bounds by which all rows are exceeded, M v <= slack + t b, is
    positive; the row is the one that weighs most in the dual. `slack` (r,).
    """
    hard = np.isinf(rows.limit)
    width, b = rows.M.shape[1], rows.b[hard]
    if not (
        np.all(np.isfinite(rows.M)) and np.all(np.isfinite(slack))
    ):  # of a plant that runs away
        return -1
    answer: Any = scipy.optimize.linprog(
        np.r_[np.zeros(width), 1.0],
        A_ub=np.column_stack([rows.M[hard] / b[:, None], -np.ones(len(b))]),
        b_ub=slack[hard] / b,
        bounds=[*[(None, None)] * width, (-1.0, None)],
        method="highs",
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
    """The solver's answer, when it keeps the rows and its multipliers belong to it."""
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
    with np.errstate(over="ignore", invalid="ignore"):  # of a plant that runs away: then it is none
        kept = (A @ z - right - excess).max() <= _AGREES * size
        stationary = np.abs(z + A.T @ multipliers).max() <= _AGREES * max(size, most)
    signed = multipliers.min() >= -_AGREES * most
    return (z, multipliers, excess, size) if kept and stationary and signed else None


def _independent(A: Array, held: IntArray, multipliers: Array, pull: Array) -> IntArray:
    """Rows among those held that carry the pull, independent; where some depend, by `nnls`."""
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
    """The solver for problems of this size, one for each thread."""
    kept: dict[tuple[str, int, int], Any] = _own.__dict__.setdefault("functions", {})
    key = solver, width, count
    if key not in kept:
        name, options = PLUGINS[solver]
        shapes = {"h": ca.Sparsity.diag(width), "a": ca.Sparsity.dense(count, width)}
        with silent():
            kept[key] = ca.conic("mpc", name, shapes, options)
    return kept[key]  # type: ignore[no-any-return]
