"""Report section and result data of an output-feedback fit."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.arrays import Array, Frozen
from impc.control.simulation import Status
from impc.inverse.regulator_span import kept_to
from impc.output_feedback.intervals import FARTHEST
from impc.reporting.document import Block, Fold, Section
from impc.reporting.finding import Finding
from impc.reporting.shown_units import shown_unit, signal_name

if TYPE_CHECKING:
    from impc.model.plant import Plant
    from impc.output_feedback.fit import OutputFeedbackFit
    from impc.output_feedback.intervals import PersonCovariance

# A noise SD counts as identified if its 95 % interval ends within a factor of ten.
_IDENTIFIED = np.log(10)
# Correlation of gain and noise from which they can hardly be separated.
_CONFUSED = 0.9
# AIC differences below this do not decide (Burnham and Anderson 2002).
_UNDECIDED = 4.0
_WHITE = 0.01
# From simulated subjects (experiments/output_feedback.md).
_AT_LIMIT = (
    "A limit was reached, so these intervals are approximate: in simulations they contained 80 to "
    "95 % of the true values."
)
_KINDS = {
    "motor": "noise in", "share": "noise in proportion to", "process": "unmodelled change of",
    "sensory": "sensory noise of", "walk": "assumed step of", "recorder": "recording noise of",
}  # fmt: skip
_PROFILED = ", by profile likelihood"
_ENDS = {"low": "95 % CI low", "high": "95 % CI high", "sd": "SD"}


@dataclass(frozen=True)
class PersonModel:
    """One competing model, fitted or not."""

    name: str  # in words
    fit: OutputFeedbackFit | None  # None if its likelihood is undefined
    reason: str  # why there is no fit

    @property
    def criterion(self) -> float:
        """AIC; infinite without a fit."""
        return np.inf if self.fit is None else self.fit.criterion

    def data(self) -> dict[str, Any]:
        """Entry of result.json."""
        heads = {"log_likelihood": "log_likelihood", "aic": "criterion", "count": "count"}
        numbers = {head: getattr(self.fit, name, None)
                   for head, name in {**heads, "converged": "converged"}.items()}  # fmt: skip
        return {"name": self.name, **numbers, "reason": self.reason}


@dataclass(frozen=True)
class PersonReport(Frozen):
    """Content of the report section on noise in senses and muscles."""

    models: tuple[PersonModel, ...]  # the requested one first
    plant: Plant
    least: Array  # (m, n), gain of least squares
    fit: OutputFeedbackFit | None  # of the requested model, if its likelihood is defined
    covariance: PersonCovariance | None  # sandwich covariance of `fit`
    profiled: bool  # whether intervals are by profile likelihood
    # 95 % intervals of the noise SDs (l, 2), in their units: sandwich; if profiled, by profile for
    # weakly identified ones
    levels: Array
    # 95 % intervals of the gain entries (entries, 2); if profiled, all by profile, and NaN where an
    # entry is not individually identified
    entries: Array
    confusion: float  # largest correlation of gain and noise; NaN without a fit
    whiteness: Array  # (p,), p-values of whiteness of the innovations of each output
    ahead: tuple[int, ...]  # prediction horizons in samples
    errors: Array  # (k, p), root-mean-square prediction errors, in the outputs' units

    @property
    def at_limit(self) -> bool:
        """Whether a bound was reached, so that the likelihood is approximate."""
        return self.fit is not None and any(
            np.any(trial.status != Status.FREE) for trial in self.fit.identified.trials
        )

    @property
    def preferred(self) -> bool:
        """Whether the requested model converged and no other one has a clearly lower AIC."""
        asked = self.models[0]
        if asked.fit is None or not asked.fit.converged:
            return False
        least = min(item.criterion for item in self.models)
        return asked.criterion < least + _UNDECIDED

    def sentences(self) -> list[str]:
        """Findings as sentences."""
        asked, fit, entries = self.models[0], self.fit, np.array(self.entries)
        if fit is None:
            return [f"No model with noise in senses or muscles could be fitted: {asked.reason}."]
        found, together = [self._compared()], self.confusion
        if len(entries):
            count = int(np.count_nonzero((entries[:, 0] > 0) | (entries[:, 1] < 0)))
            loose = " The search did not converge: do not report these gains." * (not fit.converged)
            found.append(f"The 95 % CI of {count} of {len(entries)} gains excludes zero.{loose}")
        if self.at_limit:
            found.append(_AT_LIMIT)
        if together >= _CONFUSED:
            how = f"correlation {together:.2f}"
            found.append(f"Gain and noise can hardly be separated here ({how}).")
        outputs = zip(self.plant.outputs, self.whiteness, strict=True)
        left = [signal_name(self.plant, name) for name, p in outputs if p < _WHITE]
        if left:
            named = " and ".join(left)
            found.append(f"Residuals of {named} are autocorrelated: the model is incomplete.")
        return found

    def _compared(self) -> str:
        asked, *others = self.models
        best = min(others, key=lambda item: item.criterion, default=asked)
        if best is asked or best.fit is None:
            return "No other model of sensing could be fitted for comparison."
        apart = best.criterion - asked.criterion
        if abs(apart) < _UNDECIDED:
            return (f"The recordings do not decide between the models “{asked.name}” and "
                    f"“{best.name}” (AIC differs by {abs(apart):.1f}).")  # fmt: skip
        first, second = (asked, best) if apart > 0 else (best, asked)
        return (f"The model “{first.name}” explains the recordings better than the model "
                f"“{second.name}” (AIC lower by {abs(apart):.1f}).")  # fmt: skip

    def section(self) -> Section:
        """Section of the report."""
        blocks: list[Block] = [*self.sentences(), _model_finding(self)]
        if self.fit is not None:
            fold = Fold(
                "Noise and models, in numbers", [_level_finding(self, self.fit), blocks.pop()]
            )
            blocks += [_gain_finding(self, self.fit), fold]
        return Section("Noise in the loop", blocks)

    def data(self) -> dict[str, Any]:
        """Entry of result.json."""
        fit = self.fit
        found: dict[str, Any] = {"models": [item.data() for item in self.models]}
        if fit is None:
            return found
        return found | {
            "K": fit.K,
            "at_limit": self.at_limit,
            "profiled": self.profiled,
            "K_intervals": self.entries.reshape(*fit.K.shape, 2),
            "sensed": fit.observer.sensed,
            "known": fit.observer.walk is None,
            "levels": {
                name: {"value": value, "low": low, "high": high}
                for name, value, (low, high) in zip(
                    fit.space.names, fit.levels, self.levels, strict=True
                )
            },
            "confusion": self.confusion,
            "whiteness": self.whiteness,
            "ahead": self.ahead,
            "errors_ahead": self.errors,
        }


def _model_finding(report: PersonReport) -> Finding:
    least = min(item.criterion for item in report.models)
    rows = [
        (item.name, item.fit.count, float(item.fit.log_likelihood), float(item.criterion - least),
         item.fit.converged, item.reason)
        if item.fit is not None else (item.name, None, np.nan, np.nan, None, item.reason)
        for item in report.models
    ]  # fmt: skip
    heads = ["the_person", "searched", "log_likelihood", "criterion", "settled", "reason"]
    labels = {"searched": "Numbers fitted", "criterion": "AIC over the lowest",
              "settled": "Converged", "reason": "Why not"}  # fmt: skip
    caption = "Models of sensing on the same recordings, the requested one first."
    table = pd.DataFrame(rows, columns=heads)
    hidden = () if any(item.reason for item in report.models) else ("reason",)
    return Finding("person_models", table, caption, digits=6, labels=labels, hidden=hidden)


def _level_finding(report: PersonReport, fit: OutputFeedbackFit) -> Finding:
    """Table of noise SDs; for one that is not identified only the upper end is shown."""
    rows, plant = [], report.plant
    names = zip(fit.space.names, fit.levels, report.levels, strict=True)
    for (kind, signal), value, ends in ((one[0].split(" ", 1), *one[1:]) for one in names):
        factor, unit = (100.0, "%") if kind == "share" else shown_unit(plant, signal)
        reach = np.log(ends[1] / value)
        sd, low = (value, ends[0]) if reach < _IDENTIFIED else (np.nan, 0.0)
        high = ends[1] if reach < FARTHEST else np.inf
        words = f"{_KINDS[kind]} {signal_name(plant, signal)}"
        rows.append((words, *(factor * float(one) for one in (sd, low, high)), unit))
    table = pd.DataFrame(rows, columns=["noise", "sd", "low", "high", "unit"])
    caption = f"Noise: SD of one sample, with 95 % intervals{_PROFILED * report.profiled}."
    return Finding("person_levels", table, caption, digits=3, labels=_ENDS)


def _gain_finding(report: PersonReport, fit: OutputFeedbackFit) -> Finding:
    plant, rows = report.plant, []
    numbers = np.column_stack([np.ravel(fit.K), report.entries, np.ravel(report.least)])
    for k, (control, state) in enumerate(itertools.product(plant.controls, plant.states)):
        (above, unit), (below, per) = shown_unit(plant, control), shown_unit(plant, state)
        by = f", {signal_name(plant, control)}" * (plant.m > 1)
        shown = map(float, above / below * numbers[k])
        rows.append((f"{signal_name(plant, state)}{by}", *shown, f"{unit} per {per}"))
    heads = ["gain", "maximum_likelihood", "low", "high", "without_noise_in_the_loop", "unit"]
    kept = kept_to(fit.problem)
    among = "" if kept is None else f", restricted to gains of weights over {kept.name}"
    caption = f"Gain of this person{among}, with 95 % intervals{_PROFILED * report.profiled}."
    labels = {**_ENDS, "maximum_likelihood": "Value"}
    table = pd.DataFrame(rows, columns=heads)
    return Finding("person_gain", table, caption, labels=labels, digits=3)
