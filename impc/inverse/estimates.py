"""Result type of all estimation methods, from a plain feedback gain to inverse MPC."""

# ruff: noqa: D102 - methods declared for type checkers; their functions have the docstrings

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.attached_methods import attach
from impc.checking import replace
from impc.control.controller import Controller
from impc.control.simulation import Simulation
from impc.control.simulation import Status as SampleStatus
from impc.errors import SolverError, WeightsError
from impc.inverse.columns import trial_span
from impc.inverse.laws import GainLaw
from impc.inverse.minimiser import Ended
from impc.inverse.problem import (
    Problem,
    controller_for,
    explains,
    misfit,
    missed,
    noise_of_residual,
    recorded_size,
    simulated,
)
from impc.inverse.unknowns import Fitted, linear_at
from impc.model.bounds import bound_rows
from impc.model.riccati import stabilises
from impc.model.weights import Weights, normalised

if TYPE_CHECKING:
    import pandas as pd


class Status(Enum):
    """How a method ended."""

    EXPLAINED = "explained"
    SETTLED = "settled"
    STOPPED = "stopped"
    GAIN_ONLY = "gain only"
    NONE = "none"

    @property
    def sentence(self) -> str:
        """Sentence for reports and the terminal."""
        return _SENTENCES[self]


# Residual of half the recorded 2-norm (VAF 75 %) that is reported as large. Inverse MPC ended
# within 0.3 % of the misfit of the best gain on the noisy carts of the tests, inverse LQR 170 %
# above it.
_MUCH, _MORE = 0.5, 1.05
# First autocorrelation from which a residual is not white: in SDs of that of white noise, and its
# least value (noise filtered before resampling has 0.15).
_WHITE, _LEAST = 3.0, 0.3
#: Directions whose singular value is below this share of the largest are not identified.
DETERMINED = 1e-6
#: Nor are directions along which a whitened step moves the outputs by less than this share.
ROUNDING = 1e-10

_SENTENCES = {
    Status.EXPLAINED: "The weights reproduce the recordings to a relative error of 1e-9.",
    Status.SETTLED: "The search converged; the remaining residual is treated as noise.",
    Status.STOPPED: "The search stopped before it converged: the result may be wrong.",
    Status.GAIN_ONLY: "A gain was found, but no weights that have it.",
    Status.NONE: "The method found no gain.",
}


@dataclass(frozen=True)
class Goodness:
    """Diagnostics from the simulation of the recordings."""

    # Whether the residuals of all outputs are white (first autocorrelation)
    white: bool
    softened: int  # Samples that exceed a soft state bound or the terminal set; all samples
    samples: int
    # Number of identified directions of the gain (with a fixed terminal weight: of the weights)
    rank: int
    # Number of identified directions of the metric, of m (m + 1) / 2 - 1
    metric_rank: int = 0
    unconfirmed: bool = False  # Only one of several searches reached this misfit
    # Method whose solution has a smaller misfit in the model of this one; empty if none
    beaten_by: str = ""


@dataclass(frozen=True)
class OtherWeights:
    """Weights other than the reported ones, with their misfit on the same recordings."""

    weights: Weights
    misfit: float  # 2-norm of the output residual


@dataclass(frozen=True)
class SearchEnd(Frozen):
    """End of a search along the directions of the gain that the recordings identify."""

    K: Array  # Gain (m, n) and metric (m, m)
    S: Array
    starts: Array  # As `Problem.at`
    logarithms: Array
    errors: Array
    objective: float  # -2 log posterior
    ended: Ended

    @classmethod
    def of(cls, end: Fitted) -> SearchEnd:
        """Values of an end."""
        at = end.problem
        return cls(end.K, end.S, at.starts, at.logarithms, at.errors, end.objective, end.ended)

    def problem(self, posed: Problem) -> Problem:
        """A problem at the values of this end."""
        return posed.at(np.array(self.starts), np.array(self.logarithms), np.array(self.errors))


@dataclass(frozen=True)
class Identifiability(Frozen):
    """Result of `identifiability`."""

    # Of the derivative of the outputs by relative changes D of blkdiag(Q, R), dX = L D L' with X =
    # L L' (s,), largest first
    singular_values: Array
    free: int  # Directions of (Q, R) without scale
    # Number of identified directions: singular values above 1e-8 of the largest and above 1e-10 of
    # the recorded outputs
    rank: int
    chosen: int  # Directions fixed by convention: free - rank
    tolerance: float  # The threshold 1e-8
    # Other weights with the same gain; empty if they cannot be computed in double precision
    others: tuple[OtherWeights, ...]


@dataclass(frozen=True, eq=False)  # identity comparison, so that derived results can be cached
class Estimate(Frozen):
    """Controller identified from recordings by one method.

    Attributes
    ----------
    method : str
        Identifier in `impc.inverse.methods.METHODS`.
    problem : Problem
        Problem that the method solved (inverse LQR: without bounds), at the fitted initial states,
        errors of signals and physical parameters.
    K, S : ndarray of shape (m, n) and (m, m), or None
        Gain of u = -Kx and input metric; None if the method found none.
    weights : Weights or None
        Cost weights scaled to R[0, 0] = 1; None if the method does not estimate or find any.
    metrics : ndarray of shape (k, m, m)
        Basis of the metrics between which the recordings cannot distinguish; S is one of them.
    misfit : float
        2-norm of the output residual, each output divided by its scale; NaN without a gain.
    noise : float
        Part of the misfit that is attributed to noise: for inverse MPC, the misfit of the best
        gain.
    status : Status
        How the method ended.
    reason : str
        Why there is no gain, why there are no weights, or why the weights fit worse than the gain;
        empty otherwise.
    evaluations : int
        Number of simulations with derivatives.
    seconds : float
        Run time of the method in s, without its starting estimate.
    fit : Goodness
        Diagnostics of the simulation: white residuals, violated soft bounds, identified directions.
    cost_weights : ndarray of shape (count,), or None
        Unknowns of the cost structure (logarithms of cost weights), if the method estimates them;
        minus infinity stands for a cost weight of zero.
    refitted : SearchEnd or None
        End of the search whose gain has the intervals; None if they need a search of their own.
    rivals : tuple of SearchEnd
        Other ends of the search for the gain; intervals include those within noise of the best.

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
    'The weights reproduce the recordings to a relative error of 1e-9.'
    >>> found.intervals().round(3)
                unit  value    low   high  determined
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
    refitted: SearchEnd | None = None
    rivals: tuple[SearchEnd, ...] = ()

    if TYPE_CHECKING:  # attached by `impc.attached_methods`

        @property
        def vaf(self) -> Array: ...
        def intervals(self) -> pd.DataFrame: ...
        def continuous_gain(self) -> pd.DataFrame: ...
        def identifiability(self) -> Identifiability: ...
        def summary(self) -> str: ...
        def plot(self, trial: int = 0, axes: Any = None) -> np.ndarray[Any, Any]: ...
        def save(self, path: str | Path) -> Path: ...
        def _repr_html_(self) -> str: ...

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
        """Sentences that qualify the result: soft bounds, misfit, unidentified directions."""
        if self.K is None:
            return ()
        found, doubts = self.fit, []
        if self.problem.terminal_set:
            doubts.append("The controller has a terminal set.")
        if found.softened:
            doubts.append(
                f"{found.softened} of {found.samples} simulated samples exceed a state bound or "
                "the terminal set; both are soft constraints during the search."
            )
        if self.problem.terminal_weight is not None:
            count = 0 if self.cost_weights is None else len(self.cost_weights)
            doubts.append(
                "The terminal weight is fixed, so that every stage of the horizon has its own "
                f"gain; K is the first. The recordings identify {found.rank} of the {count} "
                "directions of the weights."
            )
        elif found.rank < self.K.size:
            doubts.append(
                f"The recordings identify {found.rank} of the {self.K.size} directions of the gain."
            )
        doubts += self._open_metric()
        if self.explained:
            return tuple(doubts)
        share = self.misfit / recorded_size(self.problem)
        if share > _MUCH:
            doubts.append(f"The residual is {100 * share:.0f} % of the recordings (2-norm).")
            still = not any(np.any(trial.disturbance) for trial in self.problem.recordings)
            if still and self.problem.plant.disturbances:
                names = ", ".join(self.problem.plant.disturbances)
                doubts.append(f"No recording has a disturbance, although the plant has {names}.")
        if self.misfit > _MORE * self.noise:
            doubts.append(
                f"Another gain has a smaller misfit, {self.noise:.3g}: "
                "part of the residual is not noise."
            )
        if found.beaten_by:
            doubts.append(
                f"The solution of {found.beaten_by} has a smaller misfit here: the search failed."
            )
        if found.unconfirmed:
            doubts.append("No second search confirms this misfit: a better solution may exist.")
        if not found.white:
            doubts.append(
                "The residuals are autocorrelated: noise inside the loop, a wrong model, or a "
                "better solution that the search missed."
            )
        return tuple(doubts)

    def _open_metric(self) -> list[str]:
        """Sentence on unidentified directions of S, which has no effect without bounds."""
        m, bounds = len(self.metric), bound_rows(self.problem.bounds, self.problem.plant)
        known, count = self.fit.metric_rank, m * (m + 1) // 2 - 1
        if known == count or len(bounds.b) == 0 or self.problem.terminal_weight is not None:
            return []
        return [
            f"The recordings identify {known} of the {count} directions of the metric S, which "
            "decides between inputs where a limit is active."
        ]

    @property
    def gain(self) -> Array:
        """Gain K (m, n); raises SolverError if the method found none."""
        return self._found(self.K)

    @property
    def metric(self) -> Array:
        """Input metric S (m, m); raises SolverError if the method found none."""
        return self._found(self.S)

    @property
    def stage_weights(self) -> Weights:
        """Cost weights; raises WeightsError if the method found none."""
        if self.weights is None:
            raise WeightsError(
                self.method, f"found no weights: {self.reason}", "use the gain, or another method"
            )
        return self.weights

    @property
    def explained(self) -> bool:
        """Whether the simulated weights reproduce the recordings to a relative error of 1e-9."""
        return self.status is Status.EXPLAINED

    @property
    def converged(self) -> bool:
        """Whether the search converged."""
        return self.status in (Status.EXPLAINED, Status.SETTLED)

    def controller(self) -> Controller:
        """Return the identified controller with its bounds; SolverError without a gain."""
        found = controller_for(self.problem, self.gain, self.metric, weights=self.weights)
        return replace(found, solver=self.problem.solver)

    @cached_property
    def simulations(self) -> tuple[Simulation, ...]:
        """Simulations of the recorded trials under this controller, one per trial."""
        problem = self.problem
        return tuple(simulated(problem, self.gain, self.metric, self.weights, problem.solver))

    @property
    def time(self) -> tuple[Array, ...]:
        """Time of the samples in s, one array per trial; likewise for the next three."""
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
        """All simulated trials as one table with signal names; the first column is the trial."""
        import pandas as pd  # noqa: PLC0415  # a third of a second

        frames = [run.frame() for run in self.simulations]
        found = pd.concat(dict(enumerate(frames)), names=["trial"]).reset_index("trial")
        found.attrs = frames[0].attrs
        return found

    def simulate(
        self, x0: ArrayLike, steps: int | None = None, disturbance: ArrayLike | None = None
    ) -> Simulation:
        """Simulate the identified controller from another state, as `Controller.simulate`.

        Parameters
        ----------
        x0 : array_like of shape (n,)
            Initial state.
        steps : int, optional
            Number of samples; required without a disturbance.
        disturbance : array_like of shape (steps, d) or (steps,), optional
            Disturbance signals.

        Returns
        -------
        Simulation
        """
        return self.controller().simulate(x0, steps=steps, disturbance=disturbance)

    def _found(self, matrix: Array | None) -> Array:
        if matrix is None:
            raise SolverError(self.method, f"found no gain: {self.reason}", "try another method")
        return matrix


attach(Estimate)


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
    """Build an estimate: simulate the recordings and set status and diagnostics."""
    ranks = gain_ranks(problem, K, S) if rank is None else (rank, 0)
    misfit, fit = goodness(problem, simulated(problem, K, S, weights), *ranks)
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
    """Estimate without a gain, with the reason."""
    m, none = problem.plant.m, float("nan")
    metrics = frozen(np.zeros((0, m, m)))
    nothing = Goodness(white=True, softened=0, samples=0, rank=0)
    status = Status.NONE
    return Estimate(
        method, problem, None, None, None, metrics, none, none, status, reason, 0, 0.0, nothing
    )


def goodness(
    problem: Problem, runs: list[Simulation], rank: int, metric_rank: int = 0
) -> tuple[float, Goodness]:
    """Misfit and diagnostics of simulated recordings, for known ranks."""
    status = np.concatenate([run.status for run in runs])
    softened = int(np.count_nonzero(status == SampleStatus.SOFTENED))
    left, white = misfit(problem, runs), _is_white(problem, runs)
    return left, Goodness(white, softened, len(status), rank, metric_rank)


def gain_ranks(problem: Problem, gain: Array, metric: Array) -> tuple[int, int]:
    """Numbers of directions of a `gain` (m, n) and of a `metric` (m, m) that the data identify."""
    law = GainLaw(problem, gain, metric, whitened=stabilises(problem.plant, gain))
    found = linear_at(problem, law, law.start)
    if found.reason:
        return 0, 0
    noise = noise_of_residual(problem, found.residual)
    slopes, on_parameters, trial = found.with_prior(problem, noise).parts(problem)
    blocks, ranks = np.split(slopes, [gain.size], axis=1), []
    for own, other in (blocks, blocks[::-1]):
        beside = trial_span(trial, problem.row_sizes, np.hstack([other, on_parameters]))
        values = np.asarray(np.linalg.svd(beside.without(own), compute_uv=False))
        ranks.append(int(np.count_nonzero(determined(problem, values))) if values.size else 0)
    return ranks[0], ranks[1]


def determined(problem: Problem, values: Array) -> BoolArray:
    """Mask (k,) of the singular values (k,), largest first, above rounding level."""
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
