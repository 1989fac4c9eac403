"""What a method found: the one type for every method, from a feedback gain to inverse MPC.

The unknowns are those of docs/theory.md, section 6; what one more function says of an estimate
(intervals, intent, agreement with trials left out) is in `impc.assess`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.checking import replace
from impc.control.controller import Controller
from impc.control.simulation import Status as SampleStatus
from impc.errors import SolverError, WeightsError
from impc.inverse.least_squares import trial_span
from impc.inverse.problem import (
    controller_for,
    explains,
    misfit,
    missed,
    noise_of_residual,
    recorded_size,
    simulated,
)
from impc.inverse.residuals import evaluate, with_prior_rows
from impc.inverse.solution_set import natural_coordinates
from impc.model.riccati import stabilises
from impc.model.weights import Weights, normalised

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import ArrayLike

    from impc.assess.weights_test import Identifiability
    from impc.control.simulation import Simulation
    from impc.inverse.problem import Problem


class Status(Enum):
    """How a method ended; each has a sentence."""

    EXPLAINED = "explained"
    SETTLED = "settled"
    STOPPED = "stopped"
    GAIN_ONLY = "gain only"
    NONE = "none"

    @property
    def sentence(self) -> str:
        """The same as a sentence (docs/fitting.md)."""
        return _SENTENCES[self]


# What is left is much when half of the recordings' 2-norm is (a VAF of 75 %). Of the noisy carts of
# the tests inverse MPC ends within 0.3 % of the best gain's misfit, inverse LQR 170 % above it.
_MUCH, _MORE = 0.5, 1.05
# Standard deviations of the first autocorrelation of white noise beyond which a residual is not
# white, and its least size: that of noise after a filter on the way to a lower rate is 0.15.
_WHITE, _LEAST = 3.0, 0.3
#: A direction whose singular value is below this, of the largest, is not determined at all.
DETERMINED = 1e-6
#: So is one along which a natural step changes the outputs by less than this share of them.
ROUNDING = 1e-10

_SENTENCES = {
    Status.EXPLAINED: "The weights reproduce the recordings to 1e-9 of them.",
    Status.SETTLED: "The search ended; what it leaves of the recordings counts as noise.",
    Status.STOPPED: "The search was stopped before it ended: the answer may be wrong.",
    Status.GAIN_ONLY: "A gain was found, and no weights that have it.",
    Status.NONE: "The method ended without a gain.",
}


@dataclass(frozen=True)
class Goodness:
    """What the simulation of the recordings says of an answer."""

    # Whether what is left of no output is autocorrelated from one sample to the next; of an exact
    # answer it is rounding
    white: bool
    softened: int  # How many samples exceed a soft bound or the terminal set, and of how many
    samples: int
    # Directions of the gain (of the weights, where the terminal weight is given) identified
    rank: int
    unconfirmed: bool = (
        False  # Whether the best of several searches was alone: the others ended at more
    )
    # Method whose answer leaves less in the model of this one; empty where there is none
    beaten_by: str = ""


@dataclass(frozen=True, eq=False)  # itself alone: so what is derived from one may be cached
class Estimate(Frozen):
    """A controller that a method found behind recordings.

    Attributes
    ----------
    method : str
        A name of `impc.inverse.methods.METHODS`.
    problem : Problem
        As the method saw it (a method of inverse LQR knows no bounds), at the initial states and
        physical parameters that belong to the answer.
    K, S : Array or None
        Gain (m, n) and metric (m, m); None when the method ended without them.
    weights : Weights or None
        Scaled to R[0, 0] = 1; None where the method seeks or finds none.
    metrics : Array
        Basis of the metrics that the recordings do not identify from S (k, m, m), see `GainFit`.
    misfit : float
        2-norm of the output residual, each output over its scale; NaN without a gain.
    noise : float
        The part of it that no weights are asked to explain: that of the best gain of any kind.
    status : Status
    reason : str
        Why there is no gain or no weights, in the words of whatever failed; empty otherwise.
    evaluations : int
        Simulations with derivatives.
    seconds : float
        Time of the method, given what it starts from, s.
    fit : Goodness
        What its simulation of the recordings says against it.
    cost_weights : Array or None
        Unknowns of the problem's structure (count,), for the method that searches them; minus
        infinity is a cost weight of zero.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
    >>> truth = impc.Controller(plant, impc.Weights(1, 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1.0], steps=20).x)
    >>> found = impc.fit(impc.Problem(plant, bounds, 3, [trial]))
    >>> found
    <Estimate inverse_mpc: explained, misfit ...>
    >>> found.status.sentence
    'The weights reproduce the recordings to 1e-9 of them.'
    >>> found.intervals().round(3)
                unit  value    low   high  identified
    name
    K.u[0].x[0]   SI  0.538  0.538  0.538        True
    >>> found.vaf, found.outputs[0].shape
    (array([100.]), (21, 1))
    """

    method: str
    problem: Problem
    K: Array | None
    S: Array | None
    weights: Weights | None
    metrics: Array
    misfit: float
    noise: float
    status: Status
    reason: str
    evaluations: int
    seconds: float
    fit: Goodness
    cost_weights: Array | None = None

    def __str__(self) -> str:
        ended = f"{self.reason}." if self.reason else ""
        gain = "" if self.K is None else f"K = {np.array2string(self.K, precision=4)}"
        misfit = f"Misfit {self.misfit:.3g}."
        said = (self.status.sentence, ended, *self.doubts, misfit, gain)
        return f"{self.method}: {' '.join(part for part in said if part)}"

    def __repr__(self) -> str:
        return f"<Estimate {self.method}: {self.status.value}, misfit {self.misfit:.3g}>"

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentences that say why the answer may be wrong, or is not all of the answer."""
        if self.K is None:
            return ()
        found, doubts = self.fit, []
        if self.problem.terminal_set:
            doubts.append("The controller ends in its terminal set.")
        if found.softened:
            doubts.append(
                f"{found.softened} of {found.samples} samples of its simulation exceed a state "
                "bound or the terminal set, which the search had softened."
            )
        if self.problem.terminal_weight is not None:
            count = 0 if self.cost_weights is None else len(self.cost_weights)
            doubts.append(
                "The horizon ends in a terminal weight of your own: K is the first of its gains, "
                "and the weights are identified otherwise than by one gain. The recordings "
                f"identify {found.rank} of their {count} directions."
            )
        elif found.rank < self.K.size:
            doubts.append(
                f"The recordings identify {found.rank} of the {self.K.size} directions of the gain."
            )
        if self.explained:
            return tuple(doubts)
        share = self.misfit / recorded_size(self.problem)
        if share > _MUCH:
            doubts.append(f"It leaves {100 * share:.0f} % of the recordings.")
            still = not any(np.any(trial.disturbance) for trial in self.problem.recordings)
            if still and self.problem.plant.disturbances:
                names = ", ".join(self.problem.plant.disturbances)
                doubts.append(f"No recording has a disturbance, although the plant has {names}.")
        if self.misfit > _MORE * self.noise:
            doubts.append(
                f"But another gain leaves less, {self.noise:.3g}: not all of it is noise."
            )
        if found.beaten_by:
            doubts.append(f"The answer of {found.beaten_by} leaves less here: the search failed.")
        if found.unconfirmed:
            doubts.append("Of several searches one ended here: a better answer may exist.")
        if not found.white:
            doubts.append(
                "What it leaves is no white noise: noise in the loop, another model, or a better "
                "answer that was not found."
            )
        return tuple(doubts)

    @property
    def gain(self) -> Array:
        """K (m, n).

        Raises
        ------
        SolverError
            When the method ended without one.
        """
        return self._found(self.K)

    @property
    def metric(self) -> Array:
        """S (m, m).

        Raises
        ------
        SolverError
            When the method ended without one.
        """
        return self._found(self.S)

    @property
    def stage_weights(self) -> Weights:
        """The weights.

        Raises
        ------
        WeightsError
            When the method has found none.
        """
        if self.weights is None:
            raise WeightsError(self.method, f"found no weights: {self.reason}", "see its reason")
        return self.weights

    @property
    def explained(self) -> bool:
        """Whether the weights, simulated, reproduce the recordings to 1e-9 of them."""
        return self.status is Status.EXPLAINED

    @property
    def converged(self) -> bool:
        """Whether the search ended by itself."""
        return self.status in (Status.EXPLAINED, Status.SETTLED)

    def controller(self) -> Controller:
        """Return the constrained controller that was found.

        Raises
        ------
        SolverError
            When the method ended without a gain.
        """
        return controller_for(self.problem, self.gain, self.metric, weights=self.weights)

    @cached_property
    def simulations(self) -> tuple[Simulation, ...]:
        """The recorded trials under this controller, one each."""
        return tuple(simulated(self.problem, self.gain, self.metric, self.weights))

    @property
    def time(self) -> tuple[Array, ...]:
        """Of the samples, s: a tuple with an array for each trial, as the next three are."""
        return tuple(run.time for run in self.simulations)

    @property
    def states(self) -> tuple[Array, ...]:
        """Simulated states (samples, n)."""
        return tuple(run.states for run in self.simulations)

    @property
    def outputs(self) -> tuple[Array, ...]:
        """Simulated outputs (samples, p)."""
        return tuple(run.outputs for run in self.simulations)

    @property
    def inputs(self) -> tuple[Array, ...]:
        """Simulated inputs (samples - 1, m)."""
        return tuple(run.inputs for run in self.simulations)

    def frame(self) -> pd.DataFrame:
        """All trials as one table with the names of the signals; the first column counts trials."""
        import pandas as pd  # noqa: PLC0415  # a third of a second

        frames = [run.frame() for run in self.simulations]
        found = pd.concat(dict(enumerate(frames)), names=["trial"]).reset_index("trial")
        found.attrs = frames[0].attrs
        return found

    @property
    def vaf(self) -> Array:
        """Variance accounted for (3.24), over all trials, % (p,)."""
        from impc.assess.assessments import evaluate_method  # noqa: PLC0415  # as all below: where used

        return evaluate_method(self, self.problem.bounds).vaf

    def intervals(self) -> pd.DataFrame:
        """The gain, and free parameters, with 95 % intervals, a row each.

        By name, such as "K.u.x1" for the entry from the state x1 to the input u: `unit`, `value`,
        `low`, `high` and `identified`, whether the recordings determine this number by itself.
        The value is that of least squares along what they determine (docs/fitting.md), and may
        differ from K, which is that of weights.
        """
        from impc.assess.printed_gain import interval_table  # noqa: PLC0415

        return interval_table(self)

    def continuous_gain(self) -> pd.DataFrame:
        """The gain of continuous feedback of which that of `intervals()` is the held one.

        To compare with gains of publications; rows and columns as of `intervals()`, and the same
        covariance to first order, with fitted parameters as they are. What is equal in the two
        loops: `Controller.from_continuous_gain`, the way back.
        """
        from impc.assess.printed_gain import continuous_interval_table  # noqa: PLC0415

        return continuous_interval_table(self)

    def identifiability(self) -> Identifiability:
        """How many directions of the weights the recordings determine (`impc.identifiability`)."""
        from impc.assess.weights_test import identifiability  # noqa: PLC0415

        return identifiability(self.problem, self.stage_weights)

    def simulate(
        self, x0: ArrayLike, steps: int | None = None, disturbance: ArrayLike | None = None
    ) -> Simulation:
        """Simulate the controller found from another state, as `Controller.simulate`.

        Parameters
        ----------
        x0 : array_like
            (n,).
        steps : int, optional
            Needed when there is no disturbance.
        disturbance : array_like, optional
            (steps, d), or (steps,) for a single one.
        """
        return self.controller().simulate(x0, steps=steps, disturbance=disturbance)

    def summary(self) -> str:
        """Method, problem, agreement and doubts, then gain with intervals and weights, as text."""
        from impc.reporting.estimate_text import summary  # noqa: PLC0415

        return summary(self)

    def plot(self, trial: int = 0, axes: Any = None) -> np.ndarray[Any, Any]:
        """Draw the outputs and inputs of a trial, counted from 0; returns matplotlib axes.

        `found.plot()[0].figure.savefig("fit.png")` keeps it. `axes` are an array of your own, one
        for each output and input.
        """
        from impc.reporting.estimate_text import plot  # noqa: PLC0415

        return plot(self, trial, axes)

    def save(self, path: str | Path) -> Path:
        """Write the estimate and its problem into a file (JSON), which `impc.load` reads."""
        from impc.files.saved_estimates import save_estimate  # noqa: PLC0415

        return save_estimate(self, Path(path))

    def _repr_html_(self) -> str:
        from impc.reporting.estimate_text import as_html  # noqa: PLC0415

        return as_html(self)

    def _found(self, matrix: Array | None) -> Array:
        if matrix is None:
            raise SolverError(self.method, f"found no gain: {self.reason}", "try another method")
        return matrix


def simulated_estimate(
    method: str,
    problem: Problem,
    K: Array,
    S: Array,
    *,
    noise: float,
    weights: Weights | None = None,
    metrics: Array | None = None,
    reason: str = "",
    evaluations: int = 0,
    settled: bool = True,
    unconfirmed: bool = False,
    cost_weights: Array | None = None,
    rank: int | None = None,
) -> Estimate:
    """What a method found, simulated; the last are fields of `Estimate` and its `Goodness`."""
    known = gain_rank(problem, K, S) if rank is None else rank
    misfit, fit = goodness(problem, simulated(problem, K, S, weights), known)
    if weights is None:
        status = Status.GAIN_ONLY
    elif explains(problem, misfit) and not reason:
        status = Status.EXPLAINED
    else:
        status = Status.SETTLED if settled else Status.STOPPED
    return Estimate(
        method,
        problem,
        frozen(K),
        frozen(S),
        None if weights is None else normalised(weights),
        frozen(S[None] if metrics is None else metrics),
        misfit,
        noise,
        status,
        reason,
        evaluations,
        0.0,
        replace(fit, unconfirmed=unconfirmed),
        None if cost_weights is None else frozen(cost_weights),
    )


def no_estimate(method: str, problem: Problem, reason: str) -> Estimate:
    """A method that ended without a gain, and why."""
    m, none = problem.plant.m, float("nan")
    metrics = frozen(np.zeros((0, m, m)))
    nothing = Goodness(white=True, softened=0, samples=0, rank=0)
    status = Status.NONE
    return Estimate(
        method, problem, None, None, None, metrics, none, none, status, reason, 0, 0.0, nothing
    )


def goodness(problem: Problem, runs: list[Simulation], rank: int) -> tuple[float, Goodness]:
    """Misfit of the simulated recordings, and what else they say; the rank is known."""
    status = np.concatenate([run.status for run in runs])
    softened = int(np.count_nonzero(status == SampleStatus.SOFTENED))
    left = misfit(problem, runs)
    return left, Goodness(_is_white(problem, runs), softened, len(status), rank)


def gain_rank(problem: Problem, gain: Array, metric: Array) -> int:
    """How many directions of a `gain` (m, n) with a `metric` (m, m) the recordings identify."""
    found = evaluate(problem, gain, metric)
    if found.reason:
        return 0
    found = with_prior_rows(problem, found, noise_of_residual(problem, found.residual))
    plant = problem.plant
    stable = stabilises(plant, gain)
    T, G = natural_coordinates(plant, gain) if stable else (np.eye(plant.n), np.eye(plant.m))
    beside = np.hstack([found.dS.reshape(len(found.residual), -1), found.dparameters])
    left = trial_span(found.own, problem.row_sizes, beside).without(found.along_gain(T, G))
    values: Array = np.asarray(np.linalg.svd(left, compute_uv=False), dtype=np.float64)
    return int(np.count_nonzero(determined(problem, values)))


def determined(problem: Problem, values: Array) -> BoolArray:
    """Which falling singular values (k,) of the outputs' derivative are more than rounding (k,)."""
    return np.asarray(values > max(DETERMINED * values[0], ROUNDING * recorded_size(problem)))


def _is_white(problem: Problem, runs: list[Simulation]) -> bool:
    before, after = [], []
    for run, trial in zip(runs, problem.recordings, strict=True):
        left = missed(problem, trial, run)[:, : len(problem.plant.outputs)]
        before.append(left[:-1])
        after.append(left[1:])
    first, second = np.concatenate(before), np.concatenate(after)
    squares = np.maximum(np.sum(first**2, axis=0), 1e-300)
    correlation = np.sum(first * second, axis=0) / squares
    return bool(np.all(np.abs(correlation) <= max(_WHITE / np.sqrt(len(first)), _LEAST)))
