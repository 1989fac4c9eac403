"""Test whether residuals depend on the perturbation, and which model error explains it.

Noise is independent of the perturbation. If body or controller differ from the model, part of the
residuals lies along the derivative of the outputs by that error. Each error that was not fitted is
a group of columns c (r, d). Errors of a recorded signal (`impc.model.signal_errors`) have the
derivative of a search: offset and drift of an output in each trial; scale, time shift and clock of
an output or a perturbation, the same in all trials. The others are made by a forcing f_t of the
local loop, with the fitted trajectory x and the local gain G_t of the controller:

    dx_{t+1} = (A_t + B_t G_t) dx_t + f_t,      c_t = C dx_t:

    delay               f = -B (u_t - u_{t-1}), a command that arrives one sample late
    limit               derivative by the command limit
    lean                f = B in one trial, a constant push by or on the subject
    stiffness           f = E y_t and E (y_t - y_{t-1}), stiffness and damping where it acts
    further mode        f = E d_{t-l}, responses later than those of the model
    nonlinear body      f = (B, E) (y^2, y^3)

The test uses the fit with its prior, so that stated uncertainties explain what they can. Rows are
whitened by a first-order autoregression of the residuals, and M projects on the complement of gain,
metric, initial states and parameters. With U an orthonormal basis of M c, e the residual and V the
long-run covariance of U'e (`long_run_covariance`), T = (U'e)' V^-1 (U'e) is chi-squared with d
degrees of freedom under the model; the F distribution with the effective number of independent
samples replaces it. Holm's correction keeps the level over all groups.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.stats

from impc.arrays import Array, Frozen, IntArray
from impc.assess.covariance import by_trial, spread_of_rows
from impc.assess.long_run_covariance import residual_noise
from impc.assess.printed_gain import GainEstimate
from impc.assess.several_tests import holm
from impc.checking import replace
from impc.control.body_steps import slopes_along
from impc.control.closed_loop import prepare_loop, run_loop
from impc.control.constraint_rows import directions
from impc.control.simulation import Simulation
from impc.inverse.columns import trial_span
from impc.inverse.further_unknowns import with_errors_unknown
from impc.inverse.laws import GainLaw
from impc.inverse.problem import Problem, controller_for, drive_of, noise_of_residual
from impc.inverse.residuals import Linear, along_bounds
from impc.inverse.unknowns import Fitted, Unknowns
from impc.model import plant_family
from impc.model.bounds import bound_rows
from impc.model.recordings import Recording

#: Probability of any alarm under a correct model, by these distributions. Trials close to a fall
#: have heavier tails: at this level 4 % of 161 carts gave an alarm, at 0.05 7 %.
LEVEL = 0.02
DELAY, LIMIT, LEAN = "delay", "limit", "lean"
STIFFNESS, MODE, NONLINEAR = "stiffness or damping", "a further mode", "a nonlinear body"
#: Names of the fitted parameters that replace a test, by their beginning.
PARAMETERS = {DELAY: plant_family.DELAY, LIMIT: plant_family.LIMIT}
# Errors of signals that differ from trial to trial; those of devices are the same in all.
_OF_A_TRIAL = ("offset", "drift")
_OF_DEVICES = ("scale", "shift", "clock")
# Later responses that are tested, in shares of the shortest trial.
_LATER = (0.005, 0.01, 0.02, 0.04)
# Least share of a column that the fit cannot compensate.
_LEFT = 1e-3
# Largest number of trials tested.
_MOST = 12
# Residuals below this share of the outputs are rounding; least number of samples.
_EXACT, _FEWEST = 1e-7, 100


@dataclass(frozen=True)
class ModelError(Frozen):
    """One kind of model error, with its test."""

    name: str  # Of an error of a signal: "shift.theta1"
    probability: float  # p-value
    evidence: float  # -log(p-value)
    # Estimated size of the error and its standard error, in samples or shares; NaN for a group of
    # several columns
    size: float
    deviation: float


def signal_of(name: str) -> tuple[str, str] | None:
    """Kind and signal of an error of a recorded signal; None for another error."""
    kind, _, signal = name.partition(".")
    return (kind, signal) if signal else None


@dataclass(frozen=True)
class LackOfFit(Frozen):
    """Tests of all kinds of model error."""

    # Testable kinds, smallest p-value first, before them the one that a refit confirms
    errors: tuple[ModelError, ...]
    alarm: bool  # Whether any test rejects, after Holm's correction
    untestable: tuple[str, ...]  # Kinds that other fitted quantities compensate completely

    @property
    def culprit(self) -> ModelError | None:
        """First error, if there is an alarm."""
        return self.errors[0] if self.alarm else None


def lack_of_fit(estimate: GainEstimate | Fitted) -> LackOfFit | None:
    """Test the model on trials without gaps; None for an exact fit or too few samples."""
    if all(trial.has_gaps for trial in estimate.problem.recordings):
        return None
    # A stated time of a signal is tested like one that is not fitted: its prior may hold it back.
    problem = _some_trials(estimate.problem).with_signals_placed()
    K, S = np.array(estimate.K), np.array(estimate.S)
    signals = untested_errors(problem)
    space = Unknowns(with_errors_unknown(problem, signals), GainLaw(problem, K, S))
    found = space.evaluated(space.start)[0]
    samples = sum(trial.samples for trial in problem.recordings)
    size = np.linalg.norm(found.residual) / np.sqrt(problem.recorded_numbers)
    if found.reason or samples < _FEWEST or size <= _EXACT:
        return None
    every = _columns(problem, K, S)
    first = found.shared + problem.own_unknowns
    for place, (kind, name) in enumerate(signals, first):
        own = [table[:, [place]] for table in found.tables]
        each = kind in _OF_A_TRIAL
        every[f"{kind}.{name}"] = scipy.linalg.block_diag(*own) if each else np.concatenate(own)
    groups = {name: columns for name, columns in every.items() if columns.shape[1]}
    widths = [columns.shape[1] for columns in groups.values()]
    tested = _Tested(problem, found, np.hstack(list(groups.values())))
    ends = np.cumsum(widths)[:-1]
    parts: list[IntArray] = np.split(np.arange(sum(widths)), ends)
    results = {name: tested.of(name, part) for name, part in zip(groups, parts, strict=True)}
    errors = sorted(
        (item for item in results.values() if item is not None), key=lambda item: -item.evidence
    )
    corrected = holm(np.array([item.probability for item in errors]))
    alarm = bool(np.any(np.array(corrected) <= LEVEL))
    return LackOfFit(
        tuple(errors), alarm, tuple(name for name, item in results.items() if item is None)
    )


def untested_errors(problem: Problem) -> list[tuple[str, str]]:
    """Errors of recorded signals that are not fitted: pairs of a kind and a signal."""
    plant, moved = problem.plant, np.zeros(0, bool)
    if not plant.ahead and not np.any(plant.observer):
        moved = np.any([np.any(trial.disturbance, axis=0) for trial in problem.recordings], axis=0)
    pushes = [name for name, one in zip(plant.disturbances, moved, strict=False) if one]
    found = [(kind, name) for kind in _OF_A_TRIAL for name in plant.outputs]
    found += [(kind, name) for kind in _OF_DEVICES for name in (*plant.outputs, *pushes)]
    return [pair for pair in found if pair not in problem.signal_errors]


def _some_trials(problem: Problem) -> Problem:
    """Every k-th trial without gaps, at most `_MOST`: each adds columns, and a few suffice."""
    whole = tuple(trial for trial in problem.recordings if not trial.has_gaps)
    every = max(-(-len(whole) // _MOST), 1)
    return replace(problem, recordings=whole[::every])


class _Tested:
    """Whitened columns after projection on the fitted quantities, and their noise."""

    def __init__(self, problem: Problem, found: Linear, columns: Array) -> None:
        self.problem = problem
        shared, own = found.shared, found.shared + problem.own_unknowns
        rows = np.column_stack([np.concatenate(found.tables)[:, :own], columns, found.residual])
        self.root = np.array(residual_noise(by_trial(problem, found.residual)).root)
        rows = _white_rows(problem, rows, self.root)
        self.scale = noise_of_residual(problem, rows[:, -1])
        # One row for each parameter with a stated uncertainty.
        slopes = self.scale * np.diag(1 / problem.parameter_units)[problem.stated]
        below = np.zeros((len(slopes), rows.shape[1]))
        below[:, shared - len(problem.logarithms) : shared] = slopes
        below[:, -1] = slopes @ problem.logarithms
        rows = np.vstack([rows, below])
        fitted = trial_span(rows[:, shared:own], problem.row_sizes, rows[:, :shared])
        self.whole = np.linalg.norm(rows[:, own:-1], axis=0)
        left = fitted.without(rows[:, own:])
        self.seen, self.residual = left[:, :-1], left[:, -1]
        basis = self._basis(np.arange(columns.shape[1]))
        left = self.residual - basis @ (basis.T @ self.residual)
        everything = fitted.plus(basis).recorded(problem)
        self.noise = residual_noise(by_trial(problem, left), everything)

    def _basis(self, part: IntArray) -> Array:
        """Orthonormal basis of the part of some columns that the fit cannot compensate."""
        size = np.linalg.norm(self.seen[:, part], axis=0)
        usable = part[size > _LEFT * self.whole[part]]
        scaled = self.seen[:, usable] / np.linalg.norm(self.seen[:, usable], axis=0)
        if scaled.shape[1] == 0:
            return np.zeros((len(self.seen), 0))
        left, values, _ = np.linalg.svd(scaled, full_matrices=False)
        return np.asarray(left[:, values > _LEFT])

    def of(self, name: str, part: IntArray) -> ModelError | None:
        """Test one group of columns; None if the fit compensates all of it."""
        U = self._basis(part)
        d = U.shape[1]
        if d == 0:
            return None
        V = spread_of_rows(self.problem, self.noise, U, self.scale)
        score = U.T @ self.residual
        statistic = float(score @ np.linalg.solve(V, score))
        free = self._independent() - d + 1
        scaled = statistic * free / ((free + d - 1) * d)
        evidence = -float(scipy.stats.f.logsf(scaled, d, free))
        if not np.isfinite(evidence):  # the tail of the distribution
            evidence = (free + d) / 2 * float(np.log1p(scaled * d / free))
        size = deviation = np.nan
        if len(part) == 1:
            length = float(np.linalg.norm(self.seen[:, part[0]]))
            side = np.sign(float(U[:, 0] @ self.seen[:, part[0]]))
            size, deviation = -side * float(score[0]) / length, float(np.sqrt(V[0, 0])) / length
        return ModelError(name, float(np.exp(-evidence)), evidence, size, deviation)

    def _independent(self) -> float:
        """Effective number of independent samples."""
        slow = float(np.max(np.clip(self.root, 0.0, None)))
        samples = sum(trial.samples for trial in self.problem.recordings)
        return max(samples * (1 - slow) / (1 + slow), 10.0)


def _white_rows(problem: Problem, rows: Array, root: Array) -> Array:
    """x_t - a x_{t-1} of each trial and output; the first sample scaled to equal variance."""
    parts = []
    for part in by_trial(problem, rows):
        a = root.reshape(-1, *[1] * (part.ndim - 2))
        white = np.array(part)
        white[1:] -= a * part[:-1]
        white[0] *= np.sqrt(1 - a**2)
        parts.append(white.reshape(len(white) * len(root), *rows.shape[1:]))
    return np.concatenate(parts)


def _columns(problem: Problem, K: Array, S: Array) -> dict[str, Array]:
    """Derivatives of the residual by each kind of error that is not fitted, but offsets."""
    controller = controller_for(problem, K, S)
    prepared = prepare_loop(
        controller, directions(controller, problem.plant.n, x0=np.eye(len(K.T)))
    )
    trials = []
    for trial in problem.recordings:
        run, moved = run_loop(prepared, drive_of(trial, trial.x0), local=True, proved=False)
        trials.append(_forced(problem, trial, run, moved.u))
    found = {name: np.concatenate([forced[name] for forced in trials]) for name in trials[0]}
    found[LEAN] = scipy.linalg.block_diag(*(forced[LEAN] for forced in trials))
    rows = bound_rows(problem.bounds, problem.plant)
    moves = np.array([rows.along_limit(control) for control in range(problem.plant.m)])
    found[LIMIT] = along_bounds(problem, K, S, moves[np.any(moves, axis=1)].T)
    fitted = {name.split(".")[0] for name in problem.parameter_names}
    return {name: part for name, part in found.items() if PARAMETERS.get(name) not in fitted}


def _forced(problem: Problem, trial: Recording, run: Simulation, local: Array) -> dict[str, Array]:
    """Columns made by a forcing, for one trial (rows, d); `local` (steps, m, n) are G_t."""
    plant, u, d = problem.plant, np.array(run.u), np.array(trial.disturbance[: len(run.u)])
    y = run.x[:-1] @ plant.C.T
    y = y / np.maximum(np.sqrt(np.mean(y**2, axis=0)), 1e-300)
    A, B, E = slopes_along(plant, run.x[:-1], run.u, d)
    changes, late = np.diff(y, axis=0, prepend=y[:1]), np.diff(u, axis=0, prepend=u[:1])
    shortest = min(one.samples for one in problem.recordings)
    steps = [max(1, round(share * shortest)) for share in _LATER]
    earlier = [np.vstack([np.zeros_like(d[:step]), d[:-step]]) for step in steps]
    forces = {
        DELAY: -B * late[:, None],
        LEAN: B,
        STIFFNESS: np.dstack([_crossed(E, y), _crossed(E, changes)]),
        MODE: np.dstack([E * signals[:, None] for signals in earlier]),
        NONLINEAR: np.dstack([_crossed(slopes, y**power) for slopes in (B, E) for power in (2, 3)]),
    }
    every = np.dstack(list(forces.values()))
    closed, dx = A + B @ local, np.zeros((trial.samples, plant.n, every.shape[2]))
    for t in range(len(u)):
        dx[t + 1] = closed[t] @ dx[t] + every[t]
    rows = np.zeros((trial.samples, len(problem.measured), every.shape[2]))
    rows[:, : len(plant.outputs)] = problem.scaled_outputs @ dx
    ends = np.cumsum([part.shape[2] for part in forces.values()])[:-1]
    return dict(zip(forces, np.split(np.concatenate(rows), ends, axis=1), strict=True))


def _crossed(slopes: Array, signals: Array) -> Array:
    """Forcing (steps, n, k inputs) of each signal (steps, k) through each of the slopes."""
    both: Array = np.einsum("tni,tk->tnki", slopes, signals)
    return both.reshape(*slopes.shape[:2], -1)
