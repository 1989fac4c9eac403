"""Everything that a fit of a subject found (section 3.5), as values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.assess.covariance import TWO_SIDED
from impc.assess.printed_gain import PARAMETER, entry_names
from impc.control.simulation import Status
from impc.inverse.problem import recorded_size
from impc.model.plant_family import LIMIT
from impc.model.riccati import solve_lqr
from impc.reporting.shown_units import shown_unit

if TYPE_CHECKING:
    import pandas as pd

    from impc.arrays import Array
    from impc.assess.all_intervals import Uncertainty
    from impc.assess.assessments import MethodFit
    from impc.assess.ceiling import Ceiling
    from impc.assess.frequency_response import FrequencyResponse
    from impc.assess.intent_statements import Intent, Statement
    from impc.assess.lack_of_fit import LackOfFit, ModelError
    from impc.assess.limit_curve import LimitCurve
    from impc.assess.printed_gain import GainEstimate, Interval
    from impc.assess.structures import StructureFit
    from impc.assess.variance_accounted_for import HeldOut, TrialAgreement
    from impc.assess.weights_test import Identifiability, WeightsTest
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.output_feedback.page import PersonReport
    from impc.studies.fit.settings import FitSettings

#: Trials that are drawn one by one: 500 made a page of 51 MB and took 6.3 GB.
MOST_TRIALS = 24

# Share of what a given limit leaves, below which another that was tried is better.
_BETTER = 0.7
#: % of an output below which a fit explains less than it leaves.
LITTLE = 50.0


@dataclass(frozen=True)
class FittedParameter:
    """A physical parameter of the plant that was fitted with the gain."""

    name: str  # An argument of the plant's function
    nominal: float  # In its unit
    value: float
    # Standard deviation of the value, in its unit; infinite when nothing determines it
    deviation: float
    stated: float | None = None  # Standard deviation that was stated, in its unit; None when free
    share: float = 0.0  # Of the variance of the gain's entries, on average, that it causes

    @property
    def learned(self) -> float:
        """Standard deviation after the fit over the stated one: 1 where nothing was learned."""
        return self.deviation / self.stated if self.stated else 0.0

    @property
    def pull(self) -> float:
        """How far it was moved, in stated deviations; NaN when it is free."""
        return (self.value - self.nominal) / self.stated if self.stated else float("nan")

    @property
    def determined(self) -> bool:
        """Whether it is identified: to a factor of e at 95 %, its logarithm to 0.5.

        What is not stays near its nominal value, where the search began.
        """
        return self.deviation < PARAMETER * self.value


class LimitFound(NamedTuple):
    """The limit of a control as the recordings have it, in its shown unit."""

    given: float
    value: float
    low: float  # At 95 %
    high: float
    unit: str
    known: float  # How far it may be from the given one by what was stated about it
    fitted: bool = True  # Whether low and high are of 95 %, else the next limits that were tried

    @property
    def disagrees(self) -> bool:
        """Whether the given limit is outside the interval, and beyond what was stated."""
        outside = not self.low <= self.given <= self.high
        return outside and abs(self.value - self.given) > max(self.known, 0.01 * self.given)


@dataclass(frozen=True)
class FitResult:
    """Result of `fit_recordings`."""

    settings: FitSettings
    given: Problem  # The problem as it was posed: nominal plant, trials at rest
    # Weights and their gain; `fitted.problem` holds the initial states and the plant found
    fitted: Estimate
    # The gain that the recordings identify, and how far: what is printed with intervals
    estimate: GainEstimate
    parameters: tuple[FittedParameter, ...]
    intent: Intent
    # Directions of the weights that the recordings determine, and how many they leave
    identifiability: Identifiability
    # Intervals, the set of weights with this gain, and what else was asked for
    uncertainty: Uncertainty
    trials: tuple[TrialAgreement, ...]  # Of inverse MPC, one a trial
    held_out: tuple[HeldOut, ...]  # One a trial; empty for a single trial or when not asked for
    # Those of `impc.inverse.methods` that a fit asks for; the last is inverse MPC
    methods: tuple[MethodFit, ...]
    # The tests of the model: of the first fit and, where one unknown was added, of the last
    lack: tuple[LackOfFit | None, ...]
    # Largest change of a scaled output when the terminal set is added (or taken away); NaN when the
    # loop with it does not reach the end
    terminal_set_difference: float
    seconds: float  # Time of the whole fit, s
    weights_test: WeightsTest  # Whether any weights explain the gain
    # Stages that failed, and why; what they would have found is missing
    failures: Mapping[str, str] = field(default_factory=dict)
    # Those that were asked for, that of [fit.structure] first
    structures: tuple[StructureFit, ...] = ()
    person: PersonReport | None = None  # Of [fit.observer]; None where none was asked for
    # The part of the outputs that repeats with the perturbation; None where it does not repeat
    ceiling: Ceiling | None = None
    # The gain by regression on recorded commands (`command_regression`); None where there are none
    commands: pd.DataFrame | None = None
    curves: tuple[LimitCurve, ...] = ()  # Of the controls that reach their limit
    response: FrequencyResponse | None = None  # From the perturbation to the outputs
    falls: tuple[str, ...] = ()  # Trials that ended in a fall and were not fitted, and when

    @property
    def limit_found(self) -> LimitFound | None:
        """The limit of the first control that has one, where it was estimated."""
        for control, item in zip(self.given.plant.controls, self.uncertainty.limits, strict=False):
            if item.value is not None:
                given = float(self.given.bounds.u_max[self.given.plant.controls.index(control)])
                return self._limit(control, given, item.value, item.low, item.high)
        for one in self.parameters:
            kind, _, control = one.name.partition(".")
            if kind == LIMIT and (one.stated is None or one.deviation < one.stated / 2):
                half = TWO_SIDED * one.deviation
                return self._limit(control, one.nominal, one.value, one.value - half,
                                   one.value + half)  # fmt: skip
        for curve in self.curves:
            best = curve.best
            if curve.left[best] < _BETTER * curve.left[curve.own]:
                around = curve.limits[[max(best - 1, 0), min(best + 1, len(curve.limits) - 1)]]
                found = self._limit(curve.control, curve.given, curve.limits[best], *around)
                return found._replace(fitted=False)
        return None

    def _limit(self, control: str, *numbers: float) -> LimitFound:
        factor, unit = shown_unit(self.given.plant, control)
        stated = {one.name: one.stated or 0.0 for one in self.parameters}
        known = 0.0 if self.added is not None else stated.get(f"{LIMIT}.{control}", 0.0)
        given, value, low, high = (factor * one for one in numbers)
        return LimitFound(given, value, low, high, unit, TWO_SIDED * factor * known)

    @property
    def usable(self) -> bool:
        """Whether half of every recorded signal is explained: else nothing may be said."""
        return bool(np.all(self.inverse_mpc.vaf >= LITTLE))

    @property
    def gain_vaf(self) -> float:
        """Variance that the identified gain explains, over all outputs in their scales, %."""
        size = recorded_size(self.given)
        return 100 * (1 - (self.estimate.misfit / size) ** 2) if size else float("nan")

    @property
    def met(self) -> bool:
        """Whether a bound of an input or a state is active at any sample."""
        return any(np.any(run.status != Status.FREE) for run in self.inverse_mpc.runs)

    @property
    def gain_intervals(self) -> tuple[Interval, ...]:
        """The intervals of the gain's entries, by the sandwich."""
        names = entry_names(self.given.plant)
        return tuple(
            item
            for item in self.uncertainty.intervals
            if item.method == "sandwich" and item.name in names
        )

    @property
    def preferred(self) -> dict[str, Interval]:
        """The first interval of every number by its name: the sandwich's, where it has one."""
        first: dict[str, Interval] = {}
        for item in self.uncertainty.intervals:
            first.setdefault(item.name, item)
        return first

    @property
    def compared(self) -> tuple[Statement, ...]:
        """Comparisons of cost that were tried."""
        return () if self.uncertainty.weights is None else self.uncertainty.weights.statements

    @property
    def reported_P(self) -> Array:  # noqa: N802
        """Terminal weight (3.4) of the reported weights (n, n)."""
        return solve_lqr(self.fitted.problem.plant, self.intent.reported.weights).P

    @property
    def widest_angle(self) -> float:
        """How far other weights with this gain turn the dominant direction, degrees."""
        found = self.uncertainty.weights
        over_set = 0.0 if found is None else found.widest_angle
        return max(self.intent.widest_angle, over_set)

    @property
    def added(self) -> ModelError | None:
        """What a first fit was found to lack, so that it was fitted too."""
        first = self.lack[0]
        return first.culprit if len(self.lack) > 1 and first is not None else None

    @property
    def culprit(self) -> ModelError | None:
        """What explains most of what follows the perturbation in the last fit's residuals."""
        return None if self.lack[-1] is None else self.lack[-1].culprit

    @property
    def saturated(self) -> float:
        """Share of the samples at which the command is at its bound."""
        return sum(item.saturated for item in self.trials) / len(self.trials)

    @property
    def inverse_mpc(self) -> MethodFit:
        """The method that the page is about."""
        return self.methods[-1]


def trial_name(result: FitResult, index: int) -> str:
    """What the trial `index` is called: as its file says, else by its number."""
    name = result.given.recordings[index].label.trial or str(index + 1)
    return f"Trial {name}" if name.isdigit() else name


def shown_trials(result: FitResult) -> list[int]:
    """Trials of a `result` that have a figure: all, or of many those that are explained least."""
    explained = [float(np.mean(item.vaf)) for item in result.trials]
    least = sorted(range(len(explained)), key=lambda index: explained[index])
    return sorted(least[:MOST_TRIALS])
