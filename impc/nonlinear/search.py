"""Levenberg and Marquardt's method over a falling sequence of mu (docs/nonlinear.md).

`along_mu` searches the recordings as they are. `guided` takes every recorded state for the start of
a plan of its own, of which the first input and the next state were recorded: of a closed loop
that is what it is; of one plan it holds because the rest of an optimal plan is optimal (Bellman
1957). Such plans do not run away from the recording where the first parameters are wrong.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, frozen
from impc.checking import replace
from impc.nonlinear.derivatives import differentiate_plan
from impc.nonlinear.plan import Plan, solved_plan
from impc.nonlinear.residuals import (
    Evaluation,
    assembled,
    evaluate,
    residuals_of,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.nonlinear.recordings import OptimalRecording
    from impc.nonlinear.residuals import Residuals

_LONGEST_STEP = 0.7  # in a logarithm: a factor of two
_SMALL_STEP = 1e-9
_LEAST_DAMPING, _MOST_DAMPING = 1e-14, 1e6


class Count:
    """Evaluations that are done, and how many may be."""

    def __init__(self, most: int) -> None:
        self.most, self.done, self.before = most, 0, 0

    @property
    def all(self) -> int:
        """Those of earlier searches too."""
        return self.before + self.done

    def again(self) -> None:
        """Begin another search."""
        self.before, self.done = self.all, 0

    def evaluate(
        self, given: Residuals, unknowns: Array, mu: float, before: Evaluation
    ) -> Evaluation | None:
        """`impc.nonlinear.residuals.evaluate` at unknowns (k,) and mu, counted."""
        self.done += 1
        return evaluate(given, unknowns, mu, before)


def along_mu(
    given: Residuals, current: Evaluation, mu_steps: Sequence[float], count: Count
) -> tuple[Evaluation, bool]:
    """Search at each of the falling `mu_steps`; whether the last search ended by itself."""
    settled = True
    for mu in mu_steps:
        if mu != current.mu:
            followed = None
            if count.done < count.most:
                followed = count.evaluate(given, current.unknowns, mu, current)
            if followed is None:
                return current, False
            current = followed
        current, settled = _levenberg(given, current, mu == mu_steps[-1], count)
    return current, settled


def _levenberg(
    given: Residuals, current: Evaluation, last: bool, count: Count
) -> tuple[Evaluation, bool]:
    """Steps until the loss no longer falls; at a mu on the way a rough answer is enough."""
    damping, patience, enough = (1e-3, 60, 1e-13) if last else (1e-2, 12, 1e-2)
    for _ in range(patience):
        left, values, right = np.linalg.svd(current.jacobian, full_matrices=False)
        drive = left.T @ current.residual
        while True:
            gain = values / (values**2 + damping * values[0] ** 2)
            step = -right.T @ (gain * drive)
            step *= min(1.0, _LONGEST_STEP / max(float(np.max(np.abs(step))), 1e-300))
            if current.loss == 0 or np.max(np.abs(step)) < _SMALL_STEP:
                return current, True
            if count.done >= count.most:
                return current, False
            expected = current.residual + current.jacobian @ step
            predicted = current.loss - float(expected @ expected)
            tried = count.evaluate(given, current.unknowns + step, current.mu, current)
            ratio = -1.0 if tried is None else (current.loss - tried.loss) / max(predicted, 1e-300)
            if tried is not None and ratio > 1e-4:
                break
            damping *= 8
            if damping > _MOST_DAMPING or predicted < 1e-14 * current.loss:
                return current, True
        damping = max(damping / 10 if ratio > 0.5 else damping * 2, _LEAST_DAMPING)
        fell = (current.loss - tried.loss) / current.loss
        current = tried
        if fell < enough or current.loss < 1e-28 * len(current.residual):
            return current, True
    return current, not last


def guided(given: Residuals, theta: Array, mu_steps: Sequence[float], count: Count) -> Array | None:
    """Parameters (p,) by each recorded state's own plan, from theta (p,) along falling `mu_steps`.

    States from which theta has no plan are left out; None when none is left.
    """
    parts: list[OptimalRecording] = []
    runs = []
    for one in given.recordings:
        old: Plan | None = None
        for part in _parts(one):
            problem, still = part.problem, np.zeros((part.problem.horizon, part.problem.m))
            x, u = np.repeat(part.x0[None], problem.horizon + 1, axis=0), still
            if old is not None:
                size = problem.horizon
                later = np.concatenate([old.x[1:], old.x[-1:]])[: size + 1]
                x, u = np.vstack([part.x0, later[1:]]), np.vstack([old.u[1:], old.u[-1:]])[:size]
            if not one.closed_loop:
                t = len(one.u) - problem.horizon
                x, u = one.x[t:], one.u[t:]
            found = solved_plan(problem, theta, part.d, x, u, given.solver, mu_steps[0])
            if isinstance(found, Plan):
                parts.append(part)
                runs.append((found, differentiate_plan(found)))
                old = found
    if not parts:
        return None
    own = residuals_of(given.problem, tuple(parts), given.solver, given.scales)
    first = assembled(own, own.unknowns(theta), theta, mu_steps[0], tuple(runs))
    count.done += 1
    return along_mu(own, first, mu_steps, count)[0].theta


def _parts(one: OptimalRecording) -> list[OptimalRecording]:
    """A recording of one step from every state that was measured whole, and its plan's problem."""
    found = []
    T, n, m = len(one.u), one.problem.n, one.problem.m
    for t in range(T):
        if not np.all(np.isfinite(one.x[t])) or not np.any(np.isfinite(one.u[t])):
            continue
        problem = one.problem if one.closed_loop else one.problem.with_horizon(T - t)
        N = problem.horizon
        x, u = np.full((N + 1, n), np.nan), np.full((N, m), np.nan)
        x[0], u[0] = one.x[t], one.u[t]
        # The plan of a controller that knows no disturbance does not say where the plant goes.
        if not one.closed_loop or not np.any(one.d[t]):
            x[1] = one.x[t + 1]
        d = np.zeros((N, one.d.shape[1])) if one.closed_loop else np.array(one.d[t:])
        found.append(replace(
            one, problem=problem, x=frozen(x), u=frozen(u), d=frozen(d), x0=frozen(one.x[t]),
            closed_loop=False, unknown_start=False,
        ))  # fmt: skip
    return found
