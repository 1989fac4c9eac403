"""Result of a fit of a subject (section 3.5)."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array
from impc.assess.assessments import MethodFit, simulated_vaf
from impc.assess.ceiling import Ceiling
from impc.assess.covariance import TWO_SIDED
from impc.assess.frequency_response import FrequencyResponse
from impc.assess.intent import Intent
from impc.assess.lack_of_fit import LackOfFit, ModelError
from impc.assess.printed_gain import PARAMETER, GainEstimate, Interval, entry_names
from impc.assess.structures import StructureFit
from impc.assess.variance_accounted_for import TrialAgreement
from impc.assess.weights_ranges import Statement
from impc.assess.weights_test import WeightsTest
from impc.control.simulation import Status
from impc.inverse.estimates import Estimate, Identifiability
from impc.inverse.problem import Problem, simulated
from impc.model.plant_family import LIMIT
from impc.reporting.shown_units import shown_unit
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.uncertainty import Uncertainty

if TYPE_CHECKING:
    from impc.output_feedback.models import PersonReport

#: Largest number of trials on a page: 500 trials gave 51 MB and needed 6.3 GB of memory.
MOST_TRIALS = 24

#: VAF (%) of an output below which a fit is not usable.
LITTLE = 50.0


@dataclass(frozen=True)
class FittedParameter:
    """A physical parameter of the plant that was fitted with the gain."""

    name: str  # Argument of the plant's function
    nominal: float  # In the unit of the parameter
    value: float
    deviation: float  # Standard error of the value; infinite if not determined
    stated: float | None = None  # Stated standard deviation; None if the parameter is free
    share: float = 0.0  # Mean share of the variance of the gain's entries that it causes

    @property
    def learned(self) -> float:
        """Standard error after the fit over the stated one: 1 if nothing was learned."""
        return self.deviation / self.stated if self.stated else 0.0

    @property
    def pull(self) -> float:
        """Change by the fit in stated standard deviations; NaN if it is free."""
        return (self.value - self.nominal) / self.stated if self.stated else float("nan")

    @property
    def determined(self) -> bool:
        """Whether it is identified: standard error of its logarithm below 0.5."""
        return self.deviation < PARAMETER * self.value


class LimitFound(NamedTuple):
    """Estimated limit of an input, in its shown unit."""

    given: float
    value: float
    low: float  # At 95 %
    high: float
    unit: str
    known: float  # Largest difference from the given limit that its stated uncertainty allows

    @property
    def disagrees(self) -> bool:
        """Whether the given limit is outside the interval, and further off than was stated."""
        outside = not self.low <= self.given <= self.high
        return outside and abs(self.value - self.given) > max(self.known, 0.01 * self.given)


@dataclass(frozen=True)
class FitResult:
    """Result of `fit_recordings`."""

    settings: FitSettings
    given: Problem  # Problem as posed: nominal plant, trials at rest
    # Gain fitted without weights, with standard errors; the report prints its intervals
    estimate: GainEstimate
    parameters: tuple[FittedParameter, ...]
    intent: Intent
    # Identified directions of the weights, and number of the others
    identifiability: Identifiability
    # Intervals, the set of weights with this gain, and other requested analyses
    uncertainty: Uncertainty
    trials: tuple[TrialAgreement, ...]  # Inverse MPC, one per trial
    # Requested methods; the last is inverse MPC, with the VAF of left-out trials if requested
    methods: tuple[MethodFit, ...]
    # Tests of the model in the first fit and, if an unknown was added, in the last
    lack: tuple[LackOfFit | None, ...]
    seconds: float  # Run time of the whole fit, s
    weights_test: WeightsTest  # Test whether any weights explain the gain
    # Stages that failed, with the reason; their results are missing
    failures: Mapping[str, str] = field(default_factory=dict)
    # Requested structures, [fit.structure] first
    structures: tuple[StructureFit, ...] = ()
    person: PersonReport | None = None  # Result of [fit.observer]; None if not requested
    # Part of the outputs that repeats with the perturbation; None if it does not repeat
    ceiling: Ceiling | None = None
    response: FrequencyResponse | None = None  # From the perturbation to the outputs
    falls: tuple[str, ...] = ()  # Trials that ended in a fall and were not fitted, with the time

    @property
    def limit_found(self) -> LimitFound | None:
        """Estimated limit of the first input that has one; None if not estimated."""
        plant = self.given.plant
        for k, control in enumerate(plant.controls):
            name, given = f"{LIMIT}.{control}", float(self.given.bounds.u_max[k])
            stated = next((one for one in self.parameters if one.name == name), None)
            item, known = self.preferred.get(name), 0.0
            if item is not None and item.value is not None:
                ends = item.value, item.low, item.high
            elif stated is not None and stated.deviation < (stated.stated or np.inf) / 2:
                half, given = TWO_SIDED * stated.deviation, stated.nominal
                ends = stated.value, stated.value - half, stated.value + half
            else:
                continue
            if stated is not None and self.added is None:
                known = stated.stated or 0.0
            factor, unit = shown_unit(plant, control)
            value, low, high = (factor * one for one in ends)
            return LimitFound(factor * given, value, low, high, unit, TWO_SIDED * factor * known)
        return None

    @property
    def usable(self) -> bool:
        """Whether the VAF of every recorded signal is at least 50 %."""
        return bool(np.all(self.inverse_mpc.vaf >= LITTLE))

    @functools.cached_property
    def gain_shares(self) -> Array:
        """VAF (p,) of the estimated gain, %; NaN if a simulation stops early."""
        problem = self.estimate.problem
        runs = simulated(problem, np.array(self.estimate.K), np.array(self.estimate.S))
        return simulated_vaf(problem.plant, problem.recordings, runs)

    @property
    def met(self) -> bool:
        """Whether any bound (input, state, terminal set) is active at any sample."""
        return any(np.any(run.status != Status.FREE) for run in self.inverse_mpc.runs)

    @property
    def gain_intervals(self) -> tuple[Interval, ...]:
        """Intervals of the gain's entries from the sandwich (HAC) covariance."""
        names = entry_names(self.given.plant)
        return tuple(
            item
            for item in self.uncertainty.intervals
            if item.method == "sandwich" and item.name in names
        )

    @property
    def preferred(self) -> dict[str, Interval]:
        """First interval of every number by its name: from the sandwich if there is one."""
        first: dict[str, Interval] = {}
        for item in self.uncertainty.intervals:
            first.setdefault(item.name, item)
        return first

    @property
    def compared(self) -> tuple[Statement, ...]:
        """All comparisons of cost, decided or not."""
        return () if self.uncertainty.weights is None else self.uncertainty.weights.statements

    @property
    def added(self) -> ModelError | None:
        """Model error that the first fit pointed to and that was added as an unknown."""
        first = self.lack[0]
        return first.culprit if len(self.lack) > 1 and first is not None else None

    @property
    def culprit(self) -> ModelError | None:
        """Likeliest error in the last fit, if its tests reject."""
        return None if self.lack[-1] is None else self.lack[-1].culprit

    @property
    def saturated(self) -> float:
        """Share of samples at which the command is at its bound, between 0 and 1."""
        return sum(item.saturated for item in self.trials) / len(self.trials)

    @property
    def inverse_mpc(self) -> MethodFit:
        """The fit by inverse MPC."""
        return self.methods[-1]

    @property
    def fitted(self) -> Estimate:
        """Weights and their gain; its problem holds the fitted initial states and plant."""
        return self.inverse_mpc.estimate


def trial_name(result: FitResult, index: int) -> str:
    """Name of the trial `index`: from its file, else its number."""
    name = result.given.recordings[index].label.trial or str(index + 1)
    return f"Trial {name}" if name.isdigit() else name


def shown_trials(result: FitResult) -> list[int]:
    """Trials with a figure: all, or the `MOST_TRIALS` with the smallest VAF."""
    explained = [float(np.mean(item.vaf)) for item in result.trials]
    least = sorted(range(len(explained)), key=lambda index: explained[index])
    return sorted(least[:MOST_TRIALS])
