"""The inverse problem: recordings, and the closed loop that is to explain them.

For a gain K and a metric S the residual is vec(Y_sim - Y), all recordings in a row and every output
divided by its scale, and its derivatives with respect to K and S are exact. The weights enter
through K and S only, so every method of the package is one of two searches over this residual: for
a gain, or for weights. What else is not known of a recording, the state in which each trial starts,
offsets of outputs and physical parameters of the plant, is searched together with the gain; `at`
gives the problem at other values of these (docs/theory.md, section 6; docs/fitting.md). Commands
that were recorded are fitted as further outputs; of what is missing nothing is asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

import numpy as np

from impc.arrays import Array, BoolArray, finite_array, frozen
from impc.checking import Value, checked, replace
from impc.control.closed_loop import simulate
from impc.control.controller import LONGEST_HORIZON, Controller
from impc.control.named_solver import COMPILED, require_solver
from impc.control.simulation import Scenario
from impc.errors import DataError, InputError, SolverError, WeightsError
from impc.model.bounds import Bounds
from impc.model.foresight import physical_states
from impc.model.plant_family import plant_at
from impc.model.riccati import terminal_matrix

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import ArrayLike

    from impc.control.simulation import Simulation
    from impc.control.terminal_set import TerminalSet
    from impc.model.plant import Plant
    from impc.model.plant_family import PlantFamily
    from impc.model.recordings import Recording
    from impc.model.structure import Structure
    from impc.model.weights import Weights

#: Misfit, of the recorded outputs, up to which they are explained.
EXPLAINED = 1e-9
# Of the states: noise that a laboratory would call none is above, rounding in files is below.
_EXACT = 1e-9
# Of the outputs: beside less noise a stated uncertainty counts as it does beside that.
_NO_NOISE = 1e-4


@dataclass(frozen=True, init=False)
class Problem(Value):
    """Find the controller that made the recordings.

    Parameters
    ----------
    plant : Plant
        That of the family's nominal values, when there is one.
    bounds : Bounds
    horizon : int
        N, in samples.
    recordings : sequence of Recording
    terminal_set, softening, unknown_start, family, structure, feedback_states, solver, \
    terminal_weight
        See the attributes.
    output_scale : array_like, optional
        (p,), positive; by default the root-mean-square of each output over all recordings, so
        that no answer depends on units. An output that is zero throughout counts as the largest.
    command_scale : array_like, optional
        (m,), the same of recorded commands. Smaller ones say that the commands are better known.
    offsets : sequence of str
        See the attributes.

    Attributes
    ----------
    plant : Plant
    bounds : Bounds
    horizon : int
        N, in samples.
    recordings : tuple of Recording
    terminal_set : bool or None
        Whether the controller ends in its maximal invariant set. None, the default: `impc.fit` and
        `impc fit` decide by which explains the recordings better, and the problem of their answer
        says which; everything else takes None for False.
    softening : float
        Cost weight of exceeding a state bound or the terminal set during the search, see
        `Controller`. An answer says how many of its samples do.
    output_scale : Array
        What each output is divided by in the residual (p,), in its unit.
    command_scale : Array
        What each recorded command is divided by there (m,), in its unit.
    offsets : tuple of str
        Outputs of which every trial has an offset that is not known, constant over the trial.
    unknown_start : bool
        Whether the initial states are searched too, from the `x0` of the recordings. By default
        they are, unless the recordings are exact: all states, and the plant follows them to
        rounding.
    family : PlantFamily or None
        Plants among which the search goes on; None when the plant is known.
    logarithms : Array
        Logarithms of the family's parameters over their nominal values at which `plant` is (k,).
    structure : Structure or None
        What may be costed, for the method "structured" and the gain of a person
        (`fit_output_feedback`); other methods do not ask.
    feedback_states : tuple of str
        States on which the preliminary gain (3.20) acts, for the method "preliminary".
    solver : str
        What solves the controller's quadratic programs in every simulation of a search, see
        `Controller`.
    terminal_weight : Array or None
        P (n, n) of the cost x_N'P x_N in the scale in which R[0, 0] = 1, given as 0 for no such
        cost; None for that of the Riccati equation. With a P `impc.fit` searches the weights
        themselves, by "inverse_mpc" alone; what assumes one gain and one metric refuses it.

    Raises
    ------
    PlantError, DataError, InputError
        When the plant is continuous, there is no recording, a scale is not positive, or there is
        no such solver.

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
    offsets: tuple[str, ...]
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
        unknown_start: bool | None = None,
        family: PlantFamily | None = None,
        structure: Structure | None = None,
        feedback_states: Sequence[str] = (),
        solver: str = COMPILED,
        terminal_weight: ArrayLike | None = None,
    ) -> None:
        plant.require_discrete()
        if terminal_weight is not None and (terminal_set or family is not None):
            problem = "goes neither with terminal_set=True nor with a family of plants"
            raise InputError("terminal_weight", problem, "leave one out")
        if not recordings:
            raise DataError("recordings", "there are none", "give at least one trial")
        outputs = [trial.outputs for trial in recordings]
        commands = [trial.commands for trial in recordings if len(trial.commands)]
        scale = _scale("output_scale", output_scale, outputs, len(plant.outputs))
        for name in offsets:
            if name not in plant.outputs:
                known = ", ".join(plant.outputs)
                raise InputError("offsets", f"there is no output {name!r}", f"choose of {known}")
        if family is not None:
            if plant_at(family, np.zeros(len(family.names))).states != plant.states:
                remedy = "give family.make(family.nominal) as plant"
                raise InputError("family", "makes a plant with other states", remedy)
            family = family.with_limits(plant, bounds)
            family = family if family.names else None  # all of it is known
        aimed = aims(plant, recordings)
        P = None if terminal_weight is None else terminal_matrix(plant, terminal_weight)
        self._fill(
            plant=plant,
            bounds=bounds,
            horizon=horizon,
            recordings=tuple(recordings),
            terminal_set=False if terminal_set is None and aimed else terminal_set,
            softening=softening,
            output_scale=frozen(scale),
            command_scale=frozen(_scale("command_scale", command_scale, commands, plant.m)),
            offsets=tuple(offsets),
            unknown_start=(
                not follows_plant(plant, recordings) if unknown_start is None else unknown_start
            ),
            family=family,
            logarithms=frozen(np.zeros(0 if family is None else len(family.names))),
            structure=structure,
            feedback_states=tuple(feedback_states),
            solver=require_solver(solver),
            terminal_weight=P,
        )

    def without_bounds(self) -> Problem:
        """Return the same problem for a plain feedback gain: no bounds, no terminal set."""
        return replace(self, bounds=Bounds(self.plant), terminal_set=False)

    def with_nuisance_fixed(self) -> Problem:
        """Return the problem with its initial states, offsets and parameters as they stand."""
        return replace(self, unknown_start=False, offsets=(), family=None, logarithms=frozen([]))

    def with_body_fixed(self) -> Problem:
        """Return the problem with what has a stated uncertainty held where it stands."""
        if self.family is None or not np.any(self.stated):
            return self
        free = ~self.stated
        family = self.family.part(free, self.logarithms) if np.any(free) else None
        return replace(self, family=family, logarithms=frozen(self.logarithms[free]))

    def leaving_out(self, trial: int) -> Problem:
        """Return the problem without one trial, counted from 0."""
        return replace(self, recordings=self.recordings[:trial] + self.recordings[trial + 1 :])

    def at(self, starts: Array, logarithms: Array, shifts: Array | None = None) -> Problem:
        """Return the problem at other initial states, parameters and offsets.

        Parameters
        ----------
        starts : Array
            Initial states (trials, n).
        logarithms : Array
            Of the family's parameters over their nominal values (k,).
        shifts : Array, optional
            Offsets of the outputs (trials, p); by default those that there are.
        """
        moved = self.shifts if shifts is None else shifts
        recordings = tuple(
            replace(trial, x0=frozen(x0), offset=frozen(offset))
            for trial, x0, offset in zip(self.recordings, starts, moved, strict=True)
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
    def shifts(self) -> Array:
        """Offsets of the outputs of the trials, (trials, p)."""
        return frozen([trial.offset for trial in self.recordings])

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of what was recorded (q,): the outputs, and the controls where commands were."""
        commands = any(len(trial.commands) for trial in self.recordings)
        return (*self.plant.outputs, *self.plant.controls) if commands else self.plant.outputs

    @property
    def scale(self) -> Array:
        """What each of these is divided by in the residual (q,)."""
        both = np.concatenate([self.output_scale, self.command_scale])
        return both[: len(self.measured)]

    @property
    def searched_states(self) -> int:
        """How many states of a trial's start are searched: the first ones, or none."""
        return physical_states(self.plant) if self.unknown_start else 0

    @property
    def own_unknowns(self) -> int:
        """How many unknowns belong to one trial: initial states, then offsets."""
        return self.searched_states + len(self.offsets)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Physical parameters that are fitted (k,)."""
        return () if self.family is None else self.family.names

    @property
    def parameter_units(self) -> Array:
        """Unit of each parameter's logarithm in a search (k,): its deviation where it is stated."""
        return np.zeros(0) if self.family is None else self.family.unit

    @property
    def stated(self) -> BoolArray:
        """Which parameters have a stated uncertainty (k,)."""
        return np.zeros(0, bool) if self.family is None else self.family.stated

    @property
    def trial_sizes(self) -> list[int]:
        """How many numbers of the residual belong to each trial."""
        return [trial.samples * len(self.measured) for trial in self.recordings]

    @property
    def row_sizes(self) -> list[int]:
        """The same with the rows of stated uncertainties, which stand last."""
        stated = int(np.count_nonzero(self.stated))
        return self.trial_sizes + ([stated] if stated else [])

    @property
    def recorded_numbers(self) -> int:
        """How many numbers were recorded in all trials; missing ones do not count."""
        return sum(int(np.isfinite(recorded(self, trial)).sum()) for trial in self.recordings)


def aims(plant: Plant, recordings: Sequence[Recording]) -> bool:
    """Whether the controller regulates to more than rest, so that it has no terminal set."""
    return bool(np.any(plant.observer)) or any(trial.signals for trial in recordings)


def _scale(name: str, given: ArrayLike | None, parts: Sequence[Array], size: int) -> Array:
    """What is given (size,), or the root-mean-square of what was recorded."""
    if given is None:
        values = np.concatenate([*parts, np.zeros((1, size))])[:-1]
        largest = np.max(np.abs(np.nan_to_num(values)), axis=0, initial=0.0)
        unit = np.where(largest > 0, largest, 1.0)  # squares of 1e200 are none
        count = np.maximum(np.sum(np.isfinite(values), axis=0), 1)
        rms = largest * np.sqrt(np.sum(np.nan_to_num(values / unit) ** 2, axis=0) / count)
        given = np.where(rms > 0, rms, np.max(rms) or 1.0)
    scale = finite_array(name, given, (size,))
    if np.any(scale <= 0):
        raise InputError(name, f"got {scale.tolist()}", "give positive numbers")
    return scale


def recorded(problem: Problem, trial: Recording) -> Array:
    """Outputs and, where the problem has them, commands of a trial (samples, q); NaN: missing."""
    outputs, count = trial.outputs, len(problem.measured)
    if count == outputs.shape[1]:
        return outputs
    none = np.full((trial.samples, problem.plant.m), np.nan)
    return np.hstack([outputs, trial.commands if len(trial.commands) else none])


def modelled(problem: Problem, trial: Recording, run: Simulation) -> Array:
    """The same of a simulation (samples, q), with the trial's offsets; no command at the end."""
    outputs = run.x @ problem.plant.C.T + trial.offset
    if len(problem.measured) == outputs.shape[1]:
        return np.asarray(outputs)
    return np.hstack([outputs, np.vstack([run.u, np.full((1, run.u.shape[1]), np.nan)])])


def missed(problem: Problem, trial: Recording, run: Simulation) -> Array:
    """Simulated minus recorded over the scales (samples, q), zero where something is missing."""
    difference = (modelled(problem, trial, run) - recorded(problem, trial)) / problem.scale
    return np.where(np.isnan(difference), 0.0, difference)


def controller_for(
    problem: Problem,
    gain: Array,
    metric: Array,
    near: TerminalSet | None = None,
    weights: Weights | None = None,
) -> Controller:
    """Return the controller of a `gain` (m, n) and `metric` (m, m), or beside a P of `weights`."""
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
        solver=problem.solver,
    )


def weights_controller(problem: Problem, weights: Weights, *, hard: bool = False) -> Controller:
    """Return the controller of the problem with these weights, its rows soft or `hard`."""
    return Controller(
        problem.plant,
        weights,
        problem.bounds,
        problem.horizon,
        terminal_set=bool(problem.terminal_set),
        softening=None if hard else problem.softening,
        solver=problem.solver,
        terminal_weight=problem.terminal_weight,
    )


def require_riccati(problem: Problem) -> None:
    """Refuse a terminal weight of the user's own where one gain and metric have to be all."""
    if problem.terminal_weight is not None:
        raise InputError(
            "terminal_weight",
            "of your own gives each stage a gain, and this needs one gain for all",
            "use impc.fit(problem), or leave the terminal weight out",
        )


def scenarios(problem: Problem) -> list[Scenario]:
    """What drives each recording."""
    return [drive_of(trial, trial.x0) for trial in problem.recordings]


def drive_of(trial: Recording, x0: Array) -> Scenario:
    """What drives a trial from a state (n,)."""
    return Scenario(frozen(x0), trial.disturbance[:-1], trial.target, trial.signals)


def recorded_size(problem: Problem) -> float:
    """2-norm of all that was recorded, each divided by its scale."""
    parts = [(recorded(problem, trial) / problem.scale).ravel() for trial in problem.recordings]
    return float(np.linalg.norm(np.nan_to_num(np.concatenate(parts))))


def recorded_states(plant: Plant, recordings: Sequence[Recording]) -> list[Array] | None:
    """States (samples, n) of each trial, where the outputs determine them."""
    C = plant.C
    gaps = any(trial.has_gaps for trial in recordings)
    if gaps or C.shape[0] != C.shape[1] or np.linalg.matrix_rank(C) < len(C):
        return None
    return [
        np.asarray(np.linalg.solve(C, trial.outputs.T).T, dtype=np.float64) for trial in recordings
    ]


def follows_plant(plant: Plant, recordings: Sequence[Recording]) -> bool:
    """Whether recordings of all states are exact: what inputs cannot do is rounding.

    So is what the first of them differs by from the `x0` of its trial.
    """
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
    """The better fit of a `problem` that leaves open whether there is a terminal set."""
    if problem.terminal_set is not None:
        return fit(problem)
    without = fit(replace(problem, terminal_set=False))
    if settled(without):
        return without
    try:
        within = fit(replace(problem, terminal_set=True))
    except (InputError, SolverError, WeightsError):  # no controller with the set comes near
        return without
    return within if within.misfit < without.misfit else without


def noise_of_residual(problem: Problem, residual: Array) -> float:
    """Root-mean-square of a residual (r,), at least what is no noise, by which priors count."""
    least = _NO_NOISE * recorded_size(problem)
    return float(max(np.linalg.norm(residual), least) / np.sqrt(problem.recorded_numbers))


def typical_output(problem: Problem) -> float:
    """Root-mean-square of all recorded outputs over their scales: 1 at the default scales."""
    return recorded_size(problem) / float(np.sqrt(problem.recorded_numbers)) or 1.0


def simulated(
    problem: Problem, gain: Array, metric: Array, weights: Weights | None = None
) -> list[Simulation]:
    """Every recording under the controller of a `gain` (m, n) and a `metric` (m, m)."""
    controller = controller_for(problem, gain, metric, weights=weights)
    return [simulate(controller, drive) for drive in scenarios(problem)]


def misfit(problem: Problem, simulations: list[Simulation]) -> float:
    """2-norm of all that was simulated minus what was recorded, each divided by its scale."""
    parts = [
        missed(problem, trial, run)
        for run, trial in zip(simulations, problem.recordings, strict=True)
    ]
    return float(np.linalg.norm(np.concatenate([part.ravel() for part in parts])))
