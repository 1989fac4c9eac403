"""The inverse problem: recordings, and the closed loop that is to explain them.

For a gain K and a metric S the residual is vec(Y_sim - Y), all recordings in a row and every output
divided by its scale, and its derivatives with respect to K and S are exact. The weights enter
through K and S only, so every method of the package is one of two searches over this residual: for
a gain, or for weights. What else is not known of a recording, the state in which each trial starts
and physical parameters of the plant, is searched together with the gain; `moved` gives the problem
at other values of these (docs/theory.md, section 6; docs/fitting.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

import numpy as np

from impc.arrays import Array, finite_array, frozen
from impc.checking import Value, checked, replace
from impc.control.closed_loop import simulate
from impc.control.controller import LONGEST_HORIZON, Controller
from impc.control.named_solver import COMPILED, require_solver
from impc.control.simulation import Scenario
from impc.errors import DataError, InputError, SolverError, WeightsError
from impc.model.bounds import Bounds
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
    unknown_start: bool
    family: PlantFamily | None
    logarithms: Array
    structure: Structure | None
    feedback_states: tuple[str, ...]
    solver: str
    terminal_weight: Array | None = None

    @checked(horizon=(1, LONGEST_HORIZON), output_scale="p")
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
        P = None if terminal_weight is None else terminal_matrix(plant, terminal_weight)
        given = _root_mean_square(recordings) if output_scale is None else output_scale
        scale = finite_array("output_scale", given, (len(plant.outputs),))
        if np.any(scale <= 0):
            raise InputError("output_scale", f"got {scale.tolist()}", "give positive numbers")
        self._fill(
            plant=plant,
            bounds=bounds,
            horizon=horizon,
            recordings=tuple(recordings),
            terminal_set=terminal_set,
            softening=softening,
            output_scale=frozen(scale),
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
        """Return the problem with its initial states and parameters taken as they stand."""
        return replace(self, unknown_start=False, family=None, logarithms=frozen([]))

    def leaving_out(self, trial: int) -> Problem:
        """Return the problem without one trial, counted from 0."""
        return replace(self, recordings=self.recordings[:trial] + self.recordings[trial + 1 :])

    def at(self, starts: Array, logarithms: Array) -> Problem:
        """Return the problem at other initial states and other parameters.

        Parameters
        ----------
        starts : Array
            Initial states (trials, n).
        logarithms : Array
            Of the family's parameters over their nominal values (k,).
        """
        recordings = tuple(
            replace(trial, x0=frozen(x0)) for trial, x0 in zip(self.recordings, starts, strict=True)
        )
        plant = self.plant
        if self.family is not None and not np.array_equal(logarithms, self.logarithms):
            plant = plant_at(self.family, logarithms)
        return replace(self, plant=plant, recordings=recordings, logarithms=frozen(logarithms))

    @property
    def starts(self) -> Array:
        """Initial states of the trials, (trials, n)."""
        return frozen([trial.x0 for trial in self.recordings])

    @property
    def trial_sizes(self) -> list[int]:
        """How many numbers were recorded in each trial."""
        return [trial.outputs.size for trial in self.recordings]

    @property
    def recorded_numbers(self) -> int:
        """How many numbers were recorded in all trials."""
        return sum(self.trial_sizes)


def _root_mean_square(recordings: Sequence[Recording]) -> Array:
    outputs = np.concatenate([trial.outputs for trial in recordings])
    largest = np.max(np.abs(outputs), axis=0)
    unit = np.where(largest > 0, largest, 1.0)  # squares of 1e200 are none
    size = largest * np.sqrt(np.mean((outputs / unit) ** 2, axis=0))
    return np.where(size > 0, size, np.max(size) or 1.0)


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
    return [Scenario(trial.x0, trial.disturbance[:-1]) for trial in problem.recordings]


def recorded_size(problem: Problem) -> float:
    """2-norm of all recorded outputs, each divided by its scale."""
    parts = [(trial.outputs / problem.output_scale).ravel() for trial in problem.recordings]
    return float(np.linalg.norm(np.concatenate(parts)))


def recorded_states(plant: Plant, recordings: Sequence[Recording]) -> list[Array] | None:
    """States (samples, n) of each trial, where the outputs determine them."""
    C = plant.C
    if C.shape[0] != C.shape[1] or np.linalg.matrix_rank(C) < len(C):
        return None
    return [
        np.asarray(np.linalg.solve(C, trial.outputs.T).T, dtype=np.float64) for trial in recordings
    ]


def follows_plant(plant: Plant, recordings: Sequence[Recording]) -> bool:
    """Whether recordings of all states are exact: what inputs cannot do is rounding."""
    rank, states = int(np.linalg.matrix_rank(plant.B)), recorded_states(plant, recordings)
    if states is None or rank == plant.n:
        return False
    left = np.linalg.svd(plant.B)[0][:, rank:]
    missed, size = 0.0, 0.0
    for x, trial in zip(states, recordings, strict=True):
        rest = x[1:] - x[:-1] @ plant.A.T - trial.disturbance[:-1] @ plant.E.T
        missed, size = missed + float(np.sum((rest @ left) ** 2)), size + float(np.sum(x**2))
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
    """2-norm of all simulated minus recorded outputs, each divided by its scale."""
    parts = [
        (run.x @ problem.plant.C.T - trial.outputs) / problem.output_scale
        for run, trial in zip(simulations, problem.recordings, strict=True)
    ]
    return float(np.linalg.norm(np.concatenate([part.ravel() for part in parts])))
