"""Text of a fit to copy into a paper: methods, and the results that may be reported."""

from __future__ import annotations

import numpy as np

from impc.levels import Level
from impc.model.foresight import physical_disturbances
from impc.reporting.document import Copy
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number, sentence_case
from impc.reporting.shown_units import shown_unit, signal_name
from impc.reporting.verdict import Verdict
from impc.studies.fit import facts
from impc.studies.fit.result import FitResult
from impc.studies.fit.structures import structure_sentences
from impc.studies.fit.verdict import GAIN, RULES, SHARE, WEIGHTS


def paper_text(result: FitResult, verdict: Verdict, provenance: Provenance) -> Copy | str:
    """Methods and results in words; of a red page there are none."""
    if verdict.level is Level.RED:
        return "There is no text to copy: this model does not describe the recordings."
    return Copy(" ".join(_methods(result, provenance)), " ".join(_results(result)))


def _methods(result: FitResult, provenance: Provenance) -> list[str]:
    plant, problem, limit = result.given.plant, result.fitted.problem, facts.given_limit(result)
    trials, dt = result.given.recordings, plant.dt
    seconds, rate = sum(trial.samples for trial in trials) * dt, f"{1 / dt:.3g}"
    names = " and ".join(signal_name(plant, one) for one in plant.outputs)
    count = "one trial" if len(trials) == 1 else f"{len(trials)} trials"
    bounded = f"with the command limited to ±{limit}" if limit else "without a limit"
    version = provenance.versions["impc"]
    said = [
        f"{sentence_case(names)} of one person, from {count} ({seconds:.3g} s in all), "
        f"were analysed by inverse model predictive control (Ramadan 2018; impc {version}). "
        f"{_pushed(result)}Signals recorded at a higher rate were resampled to {rate} samples per "
        "second with a zero-phase low-pass filter.",
        f"The body model was {_model_name(provenance)}{provenance.arguments}. The controller "
        f"predicted {problem.horizon * dt:.3g} s ahead at {rate} samples per second, {bounded}.",
        *facts.aim_sentences(result),
        "The feedback gain was estimated by minimising the difference between recorded and "
        "modelled outputs in all trials together; 95 % confidence intervals allow for "
        "autocorrelated residuals.",
    ]
    if any(one.stated is not None for one in result.parameters):
        said.append("They include the stated uncertainty of the body model.")
    if facts.held_out(result) is not None:
        said.append("Predictive accuracy was assessed by leaving out one trial at a time.")
    return said


def _pushed(result: FitResult) -> str:
    """Sentence on the perturbation and its size; empty without one."""
    plant, sizes = result.given.plant, list[str]()
    moved = np.concatenate([np.abs(trial.disturbance) for trial in result.given.recordings])
    most = np.max(moved, axis=0, initial=0.0)
    for name, size in zip(plant.disturbances[: physical_disturbances(plant)], most, strict=False):
        factor, unit = shown_unit(plant, name)
        if size > 0:
            sizes.append(
                f"{signal_name(plant, name)} (up to {facts.with_unit(number(factor * size), unit)})"
            )
    return f"The perturbation was the {' and '.join(sizes)}. " if sizes else ""


def _results(result: FitResult) -> list[str]:
    no, held = RULES.forbidden(result), facts.held_out(result)
    left_out = (
        f", and for {facts.shares(result, held)} in left-out trials" if held is not None else ""
    )
    said = [
        f"The model accounted for {facts.shares(result, result.inverse_mpc.vaf)} of the variance"
        f"{left_out}."
    ]
    if result.falls:
        said.append(f"Trials that ended in a fall were left out ({len(result.falls)}).")
    if facts.given_limit(result) and result.met and SHARE not in no:
        share, (_, without) = 100 * result.saturated, facts.unlimited_ratio(result)
        said.append(f"The command was at its limit for {share:.1f} % of the time.{without}")
    if GAIN in no:
        why = RULES.reason(result, GAIN)
        return [*said, f"Gains are not reported: {why[:1].lower()}{why[1:]}."]
    gains = [row.text for _, row in facts.named_gains(result) if row.determined]
    said.append(f"Gains were {'; '.join(gains)}.")
    if WEIGHTS in no:
        return said
    made = [facts.statement_text(result.given.plant, one) for one in facts.decided(result)]
    if made:
        said.append(f"For all cost weights compatible with the recordings: {' '.join(made)}")
    return [*said, *structure_sentences(result)[:1]]


def _model_name(provenance: Provenance) -> str:
    """Name of the plant's function or file in words."""
    name = provenance.plant_name.rpartition(":")[2].removesuffix("_for").replace("_", " ")
    return f"“{name}”" if name else "given by a program"
