"""Inverse problem: recordings, and the closed loop that explains them.

For a gain K and a metric S the residual is vec(Y_sim - Y), all recordings stacked and every output
divided by its scale. Weights enter only through K and S, so each method searches either a gain or
weights over this residual. Unknown initial states, errors of signals and physical parameters are
searched jointly (`impc.inverse.unknowns`). Recorded commands are fitted as further outputs; missing
values have zero residuals.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, BoolArray, finite_array, frozen, with_shape
from impc.checking import Value, checked, replace
from impc.control.closed_loop import simulate
from impc.control.controller import LONGEST_HORIZON, Controller
from impc.control.named_solver import COMPILED, require_solver
from impc.control.simulation import Scenario, Simulation
from impc.control.terminal_set import TerminalSet
from impc.errors import DataError, InputError, SolverError, WeightsError
from impc.model.bounds import Bounds
from impc.model.foresight import physical_states
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily, plant_at
from impc.model.recordings import Recording
from impc.model.riccati import terminal_matrix
from impc.model.signal_errors import KINDS, SHIFT, distorted
from impc.model.structure import Structure
from impc.model.weights import Weights

#: Largest misfit, relative to the recorded outputs, of recordings that count as explained.
EXPLAINED = 1e-9
# Largest relative error of exact recordings: above rounding in files, below any measurement noise.
_EXACT = 1e-9
# Least noise relative to the outputs, for the weight of stated uncertainties.
_NO_NOISE = 1e-4


@dataclass(frozen=True, init=False)
class Problem(Value):
    """Inverse problem: find the controller that made the recordings.

    Parameters
    ----------
    plant : Plant
        Discrete-time plant; with a family, the plant at its nominal parameters.
    bounds : Bounds
        Bounds of inputs and states.
    horizon : int
        Prediction horizon N in samples.
    recordings : sequence of Recording
        At least one trial.
    terminal_set, softening, unknown_start, family, structure, feedback_states, solver, \
    terminal_weight
        See Attributes.
    output_scale : array_like of shape (p,), optional
        Positive scale of each output, in its unit. By default the root mean square over all
        recordings, so that results do not depend on units; an output that is zero throughout gets
        the largest of these values.
    command_scale : array_like of shape (m,), optional
        Likewise for recorded commands; a smaller scale gives the commands more weight.
    offsets : sequence of str, optional
        Outputs with an unknown offset: short for ``signal_errors={"offset": offsets}``.
    signal_errors : mapping of str to sequence of str, optional
        Outputs and disturbances with an unknown error in each trial, by kind: "offset", "drift",
        "scale" (of the values), "shift" (positive: the output is recorded late, or the disturbance
        acts later than recorded) or "clock" (share of the time by which that delay grows). Not for
        a disturbance that drives a nonlinear body or that the controller knows.

    Attributes
    ----------
    plant : Plant
    bounds : Bounds
    horizon : int
        Prediction horizon N in samples.
    recordings : tuple of Recording
    terminal_set : bool or None
        Whether the controller ends in its maximal invariant set. With None, `impc.fit` and
        `impc fit` choose the variant that explains the recordings better, and the problem of the
        estimate states the choice; other functions treat None as False.
    softening : float
        Cost weight of violating a state bound or the terminal set during the search: a violation
        is weighed against half of the sum of v_k'S v_k (see `Controller`). The estimate counts the
        samples that violate them.
    output_scale : ndarray of shape (p,)
        Scale of each output in the residual, in its unit.
    command_scale : ndarray of shape (m,)
        Scale of each recorded command in the residual, in its unit.
    signal_errors : tuple of tuple of str
        Pairs (kind, signal) of the errors that are estimated in each trial.
    unknown_start : bool
        Whether the initial states are estimated, starting from `x0` of the recordings. Default:
        True, unless all states are recorded and follow the plant to rounding.
    family : PlantFamily or None
        Plants with unknown physical parameters to estimate; None if the plant is known.
    logarithms : ndarray of shape (k,)
        Logarithms of the family's parameters over their nominal values, for the current `plant`.
    structure : Structure or None
        Cost structure for the method "structured" and for `fit_output_feedback`; other methods
        ignore it.
    feedback_states : tuple of str
        States with feedback in the method "preliminary" (3.20).
    solver : str
        Solver of the controller's quadratic programs, see `Controller`. Searches use the compiled
        one; the answer is simulated with this one.
    terminal_weight : ndarray of shape (n, n), or None
        P of the terminal cost x_N'P x_N, in the scale in which R[0, 0] = 1; pass 0 for none. None
        uses the Riccati solution. With a given P, `impc.fit` estimates the weights directly and
        only with "inverse_mpc"; functions that assume one gain and one metric raise an error.

    Raises
    ------
    PlantError, DataError, InputError
        If the plant is in continuous time, there are no recordings, a scale is not positive, or the
        solver is unknown.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], [[1, 0], [0, 1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> truth = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1, 3], steps=20).x)
    >>> impc.Problem(plant, bounds, 3, [trial]).without_bounds().bounds.u_max
    array([inf])
    """

    _rules: ClassVar[Mapping[str, Any]] = {
        "horizon": (1, LONGEST_HORIZON),
        "output_scale": "p",
        "command_scale": "m",
        "logarithms": "*",
        "terminal_weight": "n n",
    }

    plant: Plant
    bounds: Bounds
    horizon: int
    recordings: tuple[Recording, ...]
    terminal_set: bool | None
    softening: float
    output_scale: Array
    command_scale: Array
    signal_errors: tuple[tuple[str, str], ...]
    unknown_start: bool
    family: PlantFamily | None
    logarithms: Array
    structure: Structure | None
    feedback_states: tuple[str, ...]
    solver: str
    terminal_weight: Array | None = None

    @checked(horizon=(1, LONGEST_HORIZON), output_scale="p", command_scale="m")
    def __init__(
        self,
        plant: Plant,
        bounds: Bounds,
        horizon: int,
        recordings: Sequence[Recording],
        *,
        terminal_set: bool | None = None,
        softening: float = 1e6,
        output_scale: ArrayLike | None = None,
        command_scale: ArrayLike | None = None,
        offsets: Sequence[str] = (),
        signal_errors: Mapping[str, Sequence[str]] | None = None,
        unknown_start: bool | None = None,
        family: PlantFamily | None = None,
        structure: Structure | None = None,
        feedback_states: Sequence[str] = (),
        solver: str = COMPILED,
        terminal_weight: ArrayLike | None = None,
    ) -> None:
        plant.require_discrete()
        if terminal_weight is not None and (terminal_set or family is not None):
            problem = "cannot be combined with terminal_set=True or a family"
            raise InputError("terminal_weight", problem, "remove one of them")
        if not recordings:
            missing = "expected at least one trial, got none"
            raise DataError("recordings", missing, "pass [Recording(...)]")
        commands = [trial.commands for trial in recordings if len(trial.commands)]
        outputs = [trial.outputs for trial in recordings]
        if family is not None:
            if plant_at(family, np.zeros(len(family.names))).states != plant.states:
                remedy = "pass plant=family.make(family.nominal)"
                raise InputError("family", "its plant and `plant` have different states", remedy)
            family = family.with_limits(plant, bounds)
            family = family if family.names else None  # no unknown parameter
        if unknown_start is None:
            unknown_start = not follows_plant(plant, recordings)
        if terminal_set is None and aims(plant, recordings):
            terminal_set = False
        P = None if terminal_weight is None else terminal_matrix(plant, terminal_weight)
        self._fill(
            plant=plant,
            bounds=bounds,
            horizon=horizon,
            recordings=tuple(recordings),
            terminal_set=terminal_set,
            softening=softening,
            output_scale=frozen(_scale("output_scale", output_scale, outputs, len(plant.outputs))),
            command_scale=frozen(_scale("command_scale", command_scale, commands, plant.m)),
            signal_errors=_error_pairs(plant, offsets, signal_errors or {}, recordings),
            unknown_start=unknown_start,
            family=family,
            logarithms=frozen(np.zeros(0 if family is None else len(family.names))),
            structure=structure,
            feedback_states=tuple(feedback_states),
            solver=require_solver(solver),
            terminal_weight=P,
        )

    def without_bounds(self) -> Problem:
        """Copy without bounds and terminal set: a plain feedback gain."""
        return replace(self, bounds=Bounds(self.plant), terminal_set=False)

    def with_nuisance_fixed(self) -> Problem:
        """Copy with initial states, errors and parameters fixed at their current values."""
        fixed = self.with_parameters_fixed()
        return replace(fixed, unknown_start=False, signal_errors=())

    def with_parameters_fixed(self) -> Problem:
        """Copy with the physical parameters fixed at their current values."""
        return replace(self, family=None, logarithms=frozen([]))

    def with_body_fixed(self) -> Problem:
        """Copy with the parameters of stated uncertainty fixed at their current values."""
        if self.family is None or not np.any(self.stated):
            return self
        free = ~self.stated
        family = self.family.part(free, self.logarithms) if np.any(free) else None
        return replace(self, family=family, logarithms=frozen(self.logarithms[free]))

    def with_signals_placed(self) -> Problem:
        """Copy whose disturbances act when the fit says, without a stated uncertainty of it."""
        if not np.any(self.own_weights):
            return self
        trials, p = [], len(self.plant.outputs)
        for trial, drive in zip(self.recordings, scenarios(self), strict=True):
            errors, pushes = np.array(trial.errors), np.array(trial.disturbance)
            errors[:, p:], pushes[:-1] = 0.0, drive.disturbance
            trials.append(
                replace(
                    trial,
                    disturbance=frozen(pushes),
                    errors=frozen(errors),
                    timing=frozen(0 * trial.timing),
                )
            )
        pairs = zip(self.signal_errors, np.any(self.own_weights, axis=0)[self.searched_states :],
                    strict=True)  # fmt: skip
        kept = tuple(pair for pair, stated in pairs if not stated)
        return replace(self, recordings=tuple(trials), signal_errors=kept)

    @checked(trial=0)
    def leaving_out(self, trial: int) -> Problem:
        """Copy without one trial, counted from 0."""
        if trial >= len(self.recordings):
            raise InputError("trial", f"got {trial}", f"give one below {len(self.recordings)}")
        return replace(self, recordings=self.recordings[:trial] + self.recordings[trial + 1 :])

    @checked(starts="recordings n", logarithms="logarithms", errors="recordings * *")
    def at(self, starts: Array, logarithms: Array, errors: Array | None = None) -> Problem:
        """Return a copy at other initial states, parameters and errors of signals.

        Parameters
        ----------
        starts : ndarray of shape (trials, n)
            Initial states.
        logarithms : ndarray of shape (k,)
            Logarithms of the family's parameters over their nominal values.
        errors : ndarray of shape (trials, kinds, p + d), optional
            Errors of the signals; unchanged by default.
        """
        moved = self.errors if errors is None else with_shape("errors", errors, self.errors.shape)
        recordings = tuple(
            replace(trial, x0=frozen(x0), errors=frozen(error))
            for trial, x0, error in zip(self.recordings, starts, moved, strict=True)
        )
        plant, bounds = self.plant, self.bounds
        if self.family is not None and not np.array_equal(logarithms, self.logarithms):
            plant = plant_at(self.family, logarithms)
            bounds = self.family.bounds_at(plant, bounds, logarithms)
        return replace(
            self,
            plant=plant,
            bounds=bounds,
            recordings=recordings,
            logarithms=frozen(logarithms),
        )

    @property
    def starts(self) -> Array:
        """Initial states of the trials, (trials, n)."""
        return frozen([trial.x0 for trial in self.recordings])

    @property
    def errors(self) -> Array:
        """Errors of the signals of the trials, (trials, kinds, p + d)."""
        return frozen([trial.errors for trial in self.recordings])

    @property
    def offsets(self) -> tuple[str, ...]:
        """Outputs with an unknown offset in each trial."""
        return tuple(name for kind, name in self.signal_errors if kind == "offset")

    @property
    def error_places(self) -> list[tuple[int, int]]:
        """Row and column in `Recording.errors` of each error that is searched."""
        signals, kinds = (*self.plant.outputs, *self.plant.disturbances), list(KINDS)
        return [(kinds.index(kind), signals.index(name)) for kind, name in self.signal_errors]

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the q recorded signals: outputs, then controls if commands were recorded."""
        commands = any(len(trial.commands) for trial in self.recordings)
        return (*self.plant.outputs, *self.plant.controls) if commands else self.plant.outputs

    @property
    def scale(self) -> Array:
        """Residual scale of each recorded signal (q,)."""
        both = np.concatenate([self.output_scale, self.command_scale])
        return both[: len(self.measured)]

    @property
    def searched_states(self) -> int:
        """Number of initial states that are searched (the first ones); 0 if they are known."""
        return physical_states(self.plant) if self.unknown_start else 0

    @property
    def fitted_errors(self) -> list[tuple[str, str, Array]]:
        """Kind, signal and values (trials,) of each error that is searched, with time in s."""
        errors, dt = self.errors, self.plant.dt
        pairs = zip(self.signal_errors, self.error_places, strict=True)
        return [
            (kind, name, dt ** KINDS[kind][3] * errors[:, row, column])
            for (kind, name), (row, column) in pairs
        ]

    @property
    def own_unknowns(self) -> int:
        """Number of unknowns of one trial: initial states, then errors of signals."""
        return self.searched_states + len(self.signal_errors)

    @property
    def own_values(self) -> Array:
        """Searched initial states and errors of signals (trials, own)."""
        errors, places = self.errors, self.error_places
        starts = self.starts[:, : self.searched_states]
        return np.column_stack([starts, *(errors[:, kind, column] for kind, column in places)])

    @property
    def own_weights(self) -> Array:
        """1 / SD of the unknowns of each trial (trials, own), in samples; 0 if none is stated."""
        found = np.zeros((len(self.recordings), self.own_unknowns))
        for place, (kind, column) in enumerate(self.error_places, self.searched_states):
            for row, trial in enumerate(self.recordings):
                if kind == SHIFT and trial.timing[column] > 0:
                    found[row, place] = self.plant.dt / trial.timing[column]
        return found

    @property
    def unlikely(self) -> float:
        """-2 log prior density of stated parameters and times, up to a constant."""
        body = (self.logarithms / self.parameter_units)[self.stated]
        return float(body @ body + np.sum((self.own_weights * self.own_values) ** 2))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the k fitted physical parameters."""
        return () if self.family is None else self.family.names

    @property
    def parameters(self) -> Array:
        """Fitted physical parameters in their units (k,)."""
        return np.zeros(0) if self.family is None else self.family.values(self.logarithms)

    @property
    def parameter_units(self) -> Array:
        """Scale of each log-parameter in a search (k,): its SD if an uncertainty is stated."""
        return np.zeros(0) if self.family is None else self.family.unit

    @property
    def stated(self) -> BoolArray:
        """Mask of the parameters with a stated uncertainty (k,)."""
        return np.zeros(0, bool) if self.family is None else self.family.stated

    @property
    def trial_sizes(self) -> list[int]:
        """Number of residual entries of each trial."""
        return [trial.samples * len(self.measured) for trial in self.recordings]

    @property
    def row_sizes(self) -> list[int]:
        """Rows of each trial with its stated unknowns, then of stated parameters, if any."""
        stated = int(np.count_nonzero(self.stated))
        own = int(np.count_nonzero(np.any(self.own_weights, axis=0)))
        return [size + own for size in self.trial_sizes] + ([stated] if stated else [])

    @property
    def recorded_rows(self) -> BoolArray:
        """Mask of the rows that are recorded values, not stated uncertainties."""
        sizes, rows = self.row_sizes, []
        for size, seen in itertools.zip_longest(sizes, self.trial_sizes, fillvalue=0):
            rows.append(np.arange(size) < seen)
        return np.concatenate(rows)

    @property
    def scaled_outputs(self) -> Array:
        """Outputs over their scale, as rows over the states (p, n)."""
        return self.plant.C / self.output_scale[:, None]

    @property
    def recorded_numbers(self) -> int:
        """Number of recorded values in all trials, missing ones excluded."""
        return sum(int(np.isfinite(recorded(self, trial)).sum()) for trial in self.recordings)


def _error_pairs(
    plant: Plant,
    offsets: Sequence[str],
    errors: Mapping[str, Sequence[str]],
    recordings: Sequence[Recording],
) -> tuple[tuple[str, str], ...]:
    """Pairs (kind, signal), given or of uncertain timing.

    Requires known ones, and a plant whose disturbances can be moved.
    """
    for name in sorted(set(offsets) - set(plant.outputs)):
        said = f"choose from: {', '.join(plant.outputs)}"
        raise InputError("offsets", f"no output is named {name!r}", said)
    pairs = [("offset", name) for name in offsets]
    pairs += [(kind, name) for kind, names in errors.items() for name in names]
    known = (*plant.outputs, *plant.disturbances)
    for kind, name in pairs:
        if kind not in KINDS:
            raise InputError("signal_errors", f"got {kind!r}", f"choose from: {', '.join(KINDS)}")
        if name not in known:
            said = f"choose from: {', '.join(known)}"
            raise InputError("signal_errors", f"no signal is named {name!r}", said)
        if name in plant.disturbances and (plant.ahead or np.any(plant.observer)):
            problem = f"{name} is known to the controller"
            raise InputError("signal_errors", problem, "estimate errors of outputs only")
    fixed = plant.disturbances if plant.ahead or np.any(plant.observer) else ()
    uncertain = np.any([trial.timing > 0 for trial in recordings], axis=0)
    pairs += [
        ("shift", name)
        for name, one in zip(known, uncertain, strict=False)
        if one and name not in fixed
    ]
    return tuple(dict.fromkeys(pairs))


def aims(plant: Plant, recordings: Sequence[Recording]) -> bool:
    """Whether the controller tracks targets or signals, so that it has no terminal set."""
    return bool(np.any(plant.observer)) or any(trial.signals for trial in recordings)


def _scale(name: str, given: ArrayLike | None, parts: Sequence[Array], size: int) -> Array:
    """Given scale (size,), or the root mean square of the recordings."""
    if given is None:
        values = np.concatenate([*parts, np.zeros((1, size))])[:-1]
        largest = np.max(np.abs(np.nan_to_num(values)), axis=0, initial=0.0)
        unit = np.where(largest > 0, largest, 1.0)  # avoids overflow of squares
        count = np.maximum(np.sum(np.isfinite(values), axis=0), 1)
        rms = largest * np.sqrt(np.sum(np.nan_to_num(values / unit) ** 2, axis=0) / count)
        given = np.where(rms > 0, rms, np.max(rms) or 1.0)
    scale = finite_array(name, given, (size,))
    if np.any(scale <= 0):
        raise InputError(
            name, f"expected positive numbers, got {scale.tolist()}", "pass positive scales"
        )
    return scale


def recorded(problem: Problem, trial: Recording) -> Array:
    """Outputs, and commands if recorded, of a trial (samples, q); NaN where missing."""
    outputs, count = trial.outputs, len(problem.measured)
    if count == outputs.shape[1]:
        return outputs
    none = np.full((trial.samples, problem.plant.m), np.nan)
    return np.hstack([outputs, trial.commands if len(trial.commands) else none])


def modelled(problem: Problem, trial: Recording, run: Simulation) -> Array:
    """Simulated counterpart of `recorded` with its errors (samples, q); last command NaN."""
    outputs = run.x @ problem.plant.C.T
    errors = trial.errors[:, : outputs.shape[1]]
    if np.any(errors):
        outputs = distorted(outputs, errors, held=False)
    if len(problem.measured) == outputs.shape[1]:
        return np.asarray(outputs)
    return np.hstack([outputs, np.vstack([run.u, np.full((1, run.u.shape[1]), np.nan)])])


def missed(problem: Problem, trial: Recording, run: Simulation) -> Array:
    """(Simulated - recorded) / scale, shape (samples, q); zero for missing values."""
    difference = (modelled(problem, trial, run) - recorded(problem, trial)) / problem.scale
    return np.where(np.isnan(difference), 0.0, difference)


def controller_for(
    problem: Problem,
    gain: Array,
    metric: Array,
    near: TerminalSet | None = None,
    weights: Weights | None = None,
) -> Controller:
    """Controller of a `gain` (m, n) and `metric` (m, m), or of `weights` with a fixed P.

    With the compiled solver: one by name is for answers (`Estimate.simulations`), not for searches.
    """
    if problem.terminal_weight is not None and weights is not None:
        return weights_controller(problem, weights)
    require_riccati(problem)
    return Controller.from_gain(
        problem.plant,
        gain,
        problem.bounds,
        problem.horizon,
        metric=metric,
        terminal_set=bool(problem.terminal_set),
        softening=problem.softening,
        near=near,
    )


def weights_controller(problem: Problem, weights: Weights, *, hard: bool = False) -> Controller:
    """Controller of these weights; state bounds and terminal set soft or `hard`."""
    return Controller(
        problem.plant,
        weights,
        problem.bounds,
        problem.horizon,
        terminal_set=bool(problem.terminal_set),
        softening=None if hard else problem.softening,
        terminal_weight=problem.terminal_weight,
    )


def require_riccati(problem: Problem) -> None:
    """Raise InputError if the user fixed the terminal weight: the caller needs one gain."""
    if problem.terminal_weight is not None:
        raise InputError(
            "terminal_weight",
            "gives every stage its own gain, but this function needs a single gain",
            "use impc.fit(problem), or remove terminal_weight",
        )


def scenarios(problem: Problem) -> list[Scenario]:
    """Initial state and external signals of every recording."""
    return [drive_of(trial, trial.x0) for trial in problem.recordings]


def drive_of(trial: Recording, x0: Array) -> Scenario:
    """Initial state (n,) and external signals of a trial."""
    pushes = trial.disturbance[:-1]
    errors = trial.errors[:, trial.outputs.shape[1] :]
    if np.any(errors):
        pushes = frozen(distorted(pushes, errors, held=True))
    return Scenario(frozen(x0), pushes, trial.target, trial.signals)


def recorded_size(problem: Problem) -> float:
    """2-norm of all recorded values over their scales."""
    parts = [(recorded(problem, trial) / problem.scale).ravel() for trial in problem.recordings]
    return float(np.linalg.norm(np.nan_to_num(np.concatenate(parts))))


def recorded_states(plant: Plant, recordings: Sequence[Recording]) -> list[Array] | None:
    """States (samples, n) of each trial; None if the outputs do not determine them."""
    C = plant.C
    gaps = any(trial.has_gaps for trial in recordings)
    if gaps or C.shape[0] != C.shape[1] or np.linalg.matrix_rank(C) < len(C):
        return None
    return [
        np.asarray(np.linalg.solve(C, trial.outputs.T).T, dtype=np.float64) for trial in recordings
    ]


def follows_plant(plant: Plant, recordings: Sequence[Recording]) -> bool:
    """Whether all states are recorded and follow the plant and `x0` to rounding."""
    rank, states = int(np.linalg.matrix_rank(plant.B)), recorded_states(plant, recordings)
    if states is None or rank == plant.n:
        return False
    left = np.linalg.svd(plant.B)[0][:, rank:]
    missed, size = 0.0, 0.0
    for x, trial in zip(states, recordings, strict=True):
        rest = x[1:] - x[:-1] @ plant.A.T - trial.disturbance[:-1] @ plant.E.T
        begun = float(np.sum((x[0] - trial.x0 - np.linalg.solve(plant.C, trial.offset)) ** 2))
        missed += begun + float(np.sum((rest @ left) ** 2))
        size += float(np.sum(x**2))
    return missed <= _EXACT**2 * size


def explains(problem: Problem, misfit: float) -> bool:
    """Whether a misfit is at most 1e-9 of the recorded outputs."""
    return misfit <= EXPLAINED * recorded_size(problem)


class _Fitted(Protocol):
    @property
    def misfit(self) -> float: ...


T = TypeVar("T", bound=_Fitted)


def with_or_without_set(
    problem: Problem, fit: Callable[[Problem], T], settled: Callable[[T], bool]
) -> T:
    """Better fit of the variants with and without terminal set, if the problem leaves it open."""
    if problem.terminal_set is not None:
        return fit(problem)
    without = fit(replace(problem, terminal_set=False))
    if settled(without):
        return without
    try:
        within = fit(replace(problem, terminal_set=True))
    except (InputError, SolverError, WeightsError):  # no controller with the terminal set fits
        return without
    return within if within.misfit < without.misfit else without


def noise_of_residual(problem: Problem, residual: Array) -> float:
    """Root mean square of a residual (r,), bounded below by `_NO_NOISE`; scales priors."""
    least = _NO_NOISE * recorded_size(problem)
    return float(max(np.linalg.norm(residual), least) / np.sqrt(problem.recorded_numbers))


def typical_output(problem: Problem) -> float:
    """Root mean square of all recorded outputs over their scales; 1 at the default scales."""
    return recorded_size(problem) / float(np.sqrt(problem.recorded_numbers)) or 1.0


def simulated(
    problem: Problem,
    gain: Array,
    metric: Array,
    weights: Weights | None = None,
    solver: str = COMPILED,
) -> list[Simulation]:
    """Simulate every recording with a `gain` (m, n) and a `metric` (m, m)."""
    controller = controller_for(problem, gain, metric, weights=weights)
    controller = replace(controller, solver=solver)
    return [simulate(controller, drive) for drive in scenarios(problem)]


def misfit(problem: Problem, simulations: list[Simulation]) -> float:
    """2-norm of (simulated - recorded) / scale over all trials."""
    parts = [
        missed(problem, trial, run)
        for run, trial in zip(simulations, problem.recordings, strict=True)
    ]
    return float(np.linalg.norm(np.concatenate([part.ravel() for part in parts])))
