"""Vector of unknowns of a search, in units in which a step of 1 is a large step.

    z = (controller | initial states and errors of signals of each trial | parameters)

The controller is a gain with its metric (`GainLaw`), cost weights of a structure (`WeightLaw`), or
given (`FixedLaw`). Initial states are scaled by the states of the trials (`start_unit`), errors of
signals by the outputs (`signal_errors`), free parameters by a third of themselves, and parameters
with a stated uncertainty by that. The latter have a prior at their nominal value that is never
weakened (docs/why/uncertain_plant.md).

To add an unknown of the controller, write a law; of a trial, add a row to `signal_errors.KINDS`; of
the plant, extend its `PlantFamily`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg

from impc.arrays import Array, Frozen, frozen
from impc.checking import replace
from impc.control.controller import Controller
from impc.control.terminal_set import TerminalSet
from impc.errors import ImpcError
from impc.inverse.columns import triangular_rows
from impc.inverse.minimiser import Ended, Prior, Rows, Stop, log_square, minimise
from impc.inverse.prediction import Correction
from impc.inverse.problem import Problem, explains, noise_of_residual, recorded_size, simulated
from impc.inverse.residuals import Linear, controlled_residual, linearise, unusable
from impc.inverse.solution_set import floored_covariance, natural_coordinates
from impc.model.riccati import stabilises
from impc.model.signal_errors import search_unit

_START_FLOOR = 1e-8
# Relative size below which columns are rounding.
_EXPLAINED = 1e-12


class Law(Protocol):
    """The unknowns of a controller."""

    @property
    def start(self) -> Array:
        """Unknowns at which a search starts (count,)."""

    def reference(self, problem: Problem) -> Array:
        """Gain (m, n) under which the states have the size of a unit."""

    def pair(self, problem: Problem, part: Array) -> tuple[Array, Array]:
        """Gain (m, n) and metric (m, m) at the unknowns `part` (count,)."""

    def controller(
        self,
        problem: Problem,
        part: Array,
        near: TerminalSet | None,
        correction: Correction | None,
    ) -> Controller:
        """Controller at `part`; raises where a search may not simulate it."""

    def columns(self, problem: Problem, part: Array) -> Mapping[str, Array]:
        """Parts of the controller along `part`, then along the parameters (last axis)."""

    def cost_weights(self, part: Array) -> Array | None:
        """Unknowns of the structure at `part`, if it has one."""


def linear_at(
    problem: Problem,
    law: Law,
    part: Array,
    near: TerminalSet | None = None,
    correction: Correction | None = None,
) -> Linear:
    """Residual and derivatives at the unknowns `part` (count,) of a controller.

    Where a search may not simulate it, the residual is large and finite, with a reason.
    """
    try:
        controller = law.controller(problem, part, near, correction)
        return linearise(problem, controller, law.columns(problem, part), correction)
    except ImpcError as error:
        return unusable(problem, len(part) + len(problem.logarithms), str(error))


@dataclass(frozen=True)
class Point:
    """Values at a point of a search."""

    K: Array  # Gain (m, n)
    S: Array  # Metric (m, m)
    problem: Problem  # At the initial states, errors and parameters of the point


@dataclass(frozen=True)
class Compressed:
    """Residual and derivative, compressed trial by trial by QR factorisations."""

    rows: Rows  # Shared: controller and parameters; own: initial states and errors
    split: int  # Number of unknowns of the controller

    @property
    def residual(self) -> Array:
        """Compressed residual (r,)."""
        return np.ravel(self.rows.residual)

    @cached_property
    def jacobian(self) -> Array:
        """Compressed derivative by the q unknowns (r, q)."""
        shared, own = self.rows.shared, self.rows.own
        trials, height, n = own.shape
        starts = np.zeros((trials, height, trials, n))
        starts[np.arange(trials), :, np.arange(trials)] = own
        flat = shared.reshape(trials * height, -1)
        middle = starts.reshape(trials * height, -1)
        return np.hstack([flat[:, : self.split], middle, flat[:, self.split :]])


@dataclass(frozen=True, eq=False)  # identity comparison, so that derived results can be cached
class Fitted(Frozen):
    """End of a search."""

    z: Array  # Its unknowns (q,)
    K: Array  # Gain (m, n)
    S: Array  # Metric (m, m); that of the start if not identified
    problem: Problem  # At the fitted initial states, errors of signals and parameters
    misfit: float  # 2-norm of the residual
    evaluations: int  # Simulations with derivatives
    ended: Ended
    promised: float  # Decrease of `objective` that an undamped step promises
    cost_weights: Array  # Unknowns of the structure (count,); empty if a gain was searched
    unconfirmed: bool = False  # Whether no second search from another start ended here

    @property
    def converged(self) -> bool:
        """Whether this is a minimum."""
        return self.ended in (Ended.EXACT, Ended.CONVERGED)

    @property
    def parameters(self) -> Array:
        """Physical parameters in their units (k,); empty if none are fitted."""
        return self.problem.parameters

    @property
    def objective(self) -> float:
        """-2 log posterior: N log of the squared misfit, and the prior of what is stated."""
        count = self.problem.recorded_numbers
        return float(2 * count * np.log(max(self.misfit, 1e-300))) + self.problem.unlikely

    @property
    def stabilises(self) -> bool:
        """Whether A - BK is stable; without bounds a search may end at an unstable gain."""
        return stabilises(self.problem.plant, np.array(self.K))

    @property
    def explained(self) -> bool:
        """Whether the gain stabilises and the misfit is at most 1e-9 of the recorded outputs."""
        return self.stabilises and explains(self.problem, self.misfit)


class Unknowns:
    """Unknowns of one search, and the residual as their function."""

    def __init__(self, problem: Problem, law: Law, correction: Correction | None = None) -> None:
        self.problem, self.law, self.correction = problem, law, correction
        self.trials, self.own = len(problem.recordings), problem.own_unknowns
        self.own_unit = own_unit(problem, law.reference(problem))
        self.units, self.stated = problem.parameter_units, problem.stated
        # 1 / SD of the unknowns of each trial in units of z; only errors have one, whose unit is
        # diagonal.
        self.own_weights = problem.own_weights * np.diag(self.own_unit)
        first = len(law.start)
        last = first + self.trials * self.own
        #: Places of the three parts in z.
        self.controller, self.trial = slice(0, first), slice(first, last)
        self.parameters = slice(last, last + len(problem.logarithms))
        self.start = np.concatenate([law.start, np.zeros(self.parameters.stop - first)])
        self.last: tuple[bytes, Linear, Compressed] | None = None
        self.near: TerminalSet | None = None

    @property
    def centre(self) -> Array:
        """Prior mean of z (q,): the start; nominal values of stated uncertainties."""
        found = self.start.copy()
        if np.any(self.own_weights):
            none = -self.problem.own_values / np.diag(self.own_unit)
            found[self.trial] = np.where(self.own_weights > 0, none, 0.0).ravel()
        nominal = -self.problem.logarithms / self.units
        found[self.parameters] = np.where(self.stated, nominal, 0.0)
        return found

    def problem_at(self, z: Array) -> Problem:
        """Problem at the initial states, errors and parameters of z (q,)."""
        moved = z[self.trial].reshape(self.trials, self.own) @ self.own_unit.T
        logarithms = self.problem.logarithms + self.units * z[self.parameters]
        return with_own(self.problem, moved, logarithms)

    def unpack(self, z: Array) -> Point:
        """Gain, metric and problem at z (q,)."""
        problem = self.problem_at(z)
        return Point(*self.law.pair(problem, z[self.controller]), problem)

    def changes(self, z: Array) -> tuple[Array, Array]:
        """Derivatives of K (q, m, n), and of S scaled to trace m (q, m, m), by z (q,)."""
        law = self.law.columns(self.problem_at(z), z[self.controller])
        m, n, _ = law["K"].shape
        both = np.zeros((len(z), m, n)), np.zeros((len(z), m, m))
        units = np.concatenate([np.ones(self.controller.stop), self.units])[:, None, None]
        places = np.delete(np.arange(len(z)), self.trial)
        for whole, name in zip(both, "KS", strict=True):
            if name in law:
                whole[places] = units * np.moveaxis(law[name], -1, 0)
        return both

    def placed(self, there: Problem) -> Array:
        """z (q,) of the starting controller at the trials' unknowns and parameters of `there`."""
        z = self.start.copy()
        if self.own:
            away = there.own_values - self.problem.own_values
            z[self.trial] = np.linalg.solve(self.own_unit, away.T).T.ravel()
        z[self.parameters] = (there.logarithms - self.problem.logarithms) / self.units
        return z

    def at(self, z: Array) -> Compressed:
        """Residual and derivative at z (q,), compressed."""
        return self.evaluated(z)[1]

    def misfit(self, z: Array) -> float:
        """2-norm of the residual at z (q,)."""
        if self.last is not None and self.last[0] == z.tobytes():
            return float(np.linalg.norm(self.at(z).residual))
        residual = self.residual(z)
        return float(np.linalg.norm(self.at(z).residual if residual is None else residual))

    def residual(self, z: Array) -> Array | None:
        """Residual (r,) at z (q,) without derivatives; None if infeasible."""
        try:
            problem = self.problem_at(z)  # raises where no input stabilises the plant
            controller = self.law.controller(problem, z[self.controller], None, self.correction)
        except ImpcError:
            return None
        residual, reason = controlled_residual(problem, controller, self.correction)
        return None if reason else residual

    def evaluated(self, z: Array) -> tuple[Linear, Compressed]:
        """Residual and derivative at z (q,), full and compressed; the last point is kept."""
        key = z.tobytes()
        if self.last is None or self.last[0] != key:
            self.last = None  # free memory first: with hundreds of trials two would not fit
            problem, part = self.problem_at(z), z[self.controller]
            found = linear_at(problem, self.law, part, self.near, self.correction)
            self.near = found.terminal or self.near
            self.last = key, found, self._compressed(found)
        return self.last[1:]

    def _compressed(self, found: Linear) -> Compressed:
        """Factorise derivative and residual together, trial by trial, in units of z."""
        tables = [np.column_stack(pair) for pair in zip(found.tables, found.residuals, strict=True)]
        if not self.own:  # one block: no trial-specific columns
            tables = [np.concatenate(tables)]
        rows = []
        for table in tables:
            triangle = triangular_rows([table])
            full = np.zeros((triangle.shape[1], triangle.shape[1]))
            full[: len(triangle)] = triangle
            rows.append(full)
        table, shared = np.stack(rows), found.shared
        on_shared, own, residual = np.split(table, [shared, shared + self.own], axis=2)
        first = self.controller.stop
        on_shared = on_shared * np.concatenate([np.ones(first), self.units])
        count = self.problem.recorded_numbers
        whole = Rows.of_white_noise(count, residual[..., 0], on_shared, own @ self.own_unit)
        return Compressed(whole, first)

    def pulled(self, z: Array, change: Array) -> Array:
        """J'c (q,) of a change c (r,) of the residual, J the derivative at z (q,)."""
        found, row, pulled = self.evaluated(z)[0], 0, np.zeros(len(z))
        shared, own = np.zeros(found.shared), []
        for table in found.tables:
            along = change[row : row + len(table)] @ table
            row += len(table)
            shared += along[: found.shared]
            own.append(along[found.shared :] @ self.own_unit)
        first = self.controller.stop
        pulled[self.controller], pulled[self.parameters] = (
            shared[:first],
            shared[first:] * self.units,
        )
        pulled[self.trial] = np.concatenate(own)
        return pulled

    def without_nuisance(self, z: Array) -> Array:
        """Derivative at z (q,) by the controller, after projection on the other unknowns."""
        rows, noise = self.at(z).rows, noise_of_residual(self.problem, self.at(z).residual)
        own, shared = rows.own, rows.shared
        if np.any(self.own_weights):  # rows of stated errors
            below = noise * self.own_weights[:, None, :] * np.eye(self.own)
            own = np.concatenate([own, below], axis=1)
            shared = np.concatenate([shared, np.zeros((*below.shape[:2], shared.shape[2]))], axis=1)
        left, values, _ = np.linalg.svd(own, full_matrices=False)
        largest = np.max(values, initial=0.0)
        basis = left * (values > _EXPLAINED * largest)[:, None, :]
        shared = shared - basis @ (np.swapaxes(basis, 1, 2) @ shared)
        first = self.controller.stop
        kept, nuisance = np.split(shared.reshape(-1, shared.shape[2]), [first], axis=1)
        held = noise * np.eye(len(self.stated))[self.stated]
        kept = np.vstack([kept, np.zeros((len(held), kept.shape[1]))])
        nuisance = np.vstack([nuisance, held])
        if nuisance.shape[1] == 0:
            return kept
        size = np.sqrt(np.sum(rows.shared[..., first:] ** 2, axis=(0, 1)))
        rest, values, _ = np.linalg.svd(nuisance, full_matrices=False)
        rest = rest[:, values > _EXPLAINED * max(largest, np.max(size))]
        return np.asarray(kept - rest @ (rest.T @ kept))

    def search(
        self,
        z: Array,
        stop: Stop,
        *,
        shared: Array | float = 0.0,
        own: float = 0.0,
        along: Array | None = None,
        centre: Array | None = None,
    ) -> Fitted:
        """Minimise from z (q,) with a normal prior about the centre, `shared` and `own` 1 / SD.

        `along` (shared, k): combinations of controller and parameters that are searched; stated
        parameters are columns of their own, and have their prior.
        """
        model = _Along(self, z, along)
        weights = np.array(np.broadcast_to(shared, model.columns.shape[1]), dtype=np.float64)
        parameters = model.columns[len(model.columns) - len(self.stated) :]
        weights[np.any(parameters[self.stated] != 0, axis=0)] = 1.0
        stated = np.where(self.own_weights > 0, self.own_weights, own) if self.own else own
        prior = Prior(*model.apart(self.centre if centre is None else centre), weights, stated)
        end = minimise(model, prior, model.begin, stop)
        z = model.placed(end.u, end.v)
        return self.ended(z, end.evaluations, end.ended, end.promised)

    def deviations(self, z: Array, count: int | None = None) -> tuple[Array, Array]:
        """Directions of the first `count` unknowns (rows), and their standard errors (a,).

        All other unknowns are fitted too; by default those of the controller.
        """
        seen = self.without_nuisance(z)
        if count is not None and count < seen.shape[1]:
            rest, values, _ = np.linalg.svd(seen[:, count:], full_matrices=False)
            rest = rest[:, values > _EXPLAINED * np.max(values)]
            seen = seen[:, :count] - rest @ (rest.T @ seen[:, :count])
        noise = self.misfit(z) / np.sqrt(self.problem.recorded_numbers)
        _, values, rows = np.linalg.svd(seen, full_matrices=False)
        return rows, noise / np.maximum(values, 1e-300)

    def ended(
        self, z: Array, evaluations: int = 0, ended: Ended = Ended.STOPPED, promised: float = np.inf
    ) -> Fitted:
        """The values at z (q,) as the end of a search."""
        here, misfit = self.unpack(z), self.misfit(z)
        weights = self.law.cost_weights(z[self.controller])
        return Fitted(
            frozen(z),
            frozen(here.K),
            frozen(here.S),
            here.problem,
            misfit,
            evaluations,
            Ended.EXACT if explains(here.problem, misfit) else ended,
            promised,
            frozen([] if weights is None else weights),
        )


class _Along:
    """Residual along given combinations of the shared unknowns, from a point."""

    def __init__(self, space: Unknowns, z: Array, along: Array | None) -> None:
        self.space, self.z = space, z
        count = len(z) - space.trials * space.own
        self.columns = np.eye(count) if along is None else along
        self.shape = (space.trials, space.own) if space.own else (1, 0)
        self.begin = self.apart(z)
        self.here = z

    def apart(self, z: Array) -> tuple[Array, Array]:
        own = self.space.trial
        return self.columns.T @ np.delete(z, own), z[own].reshape(self.shape)

    def placed(self, u: Array, v: Array) -> Array:
        own = self.space.trial
        moved = np.delete(self.z, own) + self.columns @ (u - self.begin[0])
        return np.concatenate([moved[: own.start], np.ravel(v), moved[own.start :]])

    def rows(self, u: Array, v: Array) -> Rows | None:
        self.here = self.placed(u, v)
        found, compressed = self.space.evaluated(self.here)
        whole = compressed.rows
        if found.reason:
            return None
        # With active bounds the second derivative is unreliable. With several inputs geodesic
        # acceleration solved 20 of 30 random exact problems (half of the outputs), straight steps
        # 14.
        curved = self.space.problem.plant.m > 1 or found.active == 0
        return replace(whole, shared=whole.shared @ self.columns, curved=curved)

    def value(self, u: Array, v: Array) -> float:
        residual = self.space.residual(self.placed(u, v))
        if residual is None:
            return np.inf
        return log_square(self.space.problem.recorded_numbers, float(residual @ residual))

    def bend(self, du: Array, dv: Array, share: float) -> tuple[Array, Array] | None:
        here = self.apart(self.here)
        there = self.space.residual(self.placed(here[0] + share * du, here[1] + share * dv))
        if there is None:
            return None
        change = there - self.space.evaluated(self.here)[0].residual
        pulled_u, pulled_v = self.apart(self.space.pulled(self.here, change))
        return pulled_u, pulled_v


def with_own(problem: Problem, moved: Array, logarithms: Array | None = None) -> Problem:
    """Problem with initial states and errors of signals shifted by `moved` (trials, own)."""
    starts, errors = np.array(problem.starts), np.array(problem.errors)
    size = problem.searched_states
    starts[:, :size] += moved[:, :size]
    for place, (kind, column) in enumerate(problem.error_places):
        errors[:, kind, column] += moved[:, size + place]
    return problem.at(starts, problem.logarithms if logarithms is None else logarithms, errors)


def own_unit(problem: Problem, gain: Array) -> Array:
    """Unit of the unknowns of one trial (own, own): `start_unit` and units of the errors."""
    size = problem.searched_states
    whole = start_unit(problem, gain) if size else np.zeros((0, 0))
    if size < len(whole):  # the other states are known
        whole = np.asarray(np.linalg.cholesky((whole @ whole.T)[:size, :size]), dtype=np.float64)
    samples = max(trial.samples for trial in problem.recordings)
    pushes = np.concatenate([trial.disturbance for trial in problem.recordings])
    sizes = np.concatenate([problem.output_scale, np.sqrt(np.mean(pushes**2, axis=0))])
    errors = [search_unit(kind, sizes[column] or 1.0, samples) for kind, column in
              problem.error_places]  # fmt: skip
    return np.asarray(scipy.linalg.block_diag(whole, np.diag(errors)))


def start_unit(problem: Problem, gain: Array) -> Array:
    """Unit of initial states (n, n): factor of the second moments of the states under `gain`.

    Those of the trial with the largest outputs. Without excitation, or if the loop diverges: white
    noise at the inputs of the size of the outputs.
    """
    plant = problem.plant
    if problem.terminal_weight is not None:  # there is no single gain
        return np.eye(plant.n)
    largest = max(problem.recordings, key=lambda trial: float(np.nansum(trial.outputs**2)))
    (run,) = simulated(replace(problem, recordings=(largest,)), gain, np.eye(plant.m))
    second = run.x.T @ run.x / len(run.x)
    if run.complete and np.all(np.isfinite(second)) and np.all(np.diag(second) > 0):
        return np.asarray(np.linalg.cholesky(floored_covariance(second, _START_FLOOR)))
    T, _ = natural_coordinates(plant, gain)
    natural = float(np.linalg.norm(problem.scaled_outputs @ T))
    samples = sum(trial.samples for trial in problem.recordings)
    size = recorded_size(problem) / np.sqrt(samples)
    return size / natural * T if size > 0 and natural > 0 else T
