"""What the page of a fit says first: one sentence, and a few that may be copied into a paper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import IDENTIFIED
from impc.assess.intent_statements import dominant_sentence
from impc.reporting.rendering import number
from impc.studies.fit.aim import aim_sentences
from impc.studies.fit.body_words import body_sentences
from impc.studies.fit.result import LITTLE, trial_name
from impc.studies.fit.structure_words import structure_sentences

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.files.plant_sources import PlantSource
    from impc.model.plant import Plant
    from impc.studies.fit.result import FitResult
    from impc.studies.fit.settings import FitSettings


# Parts of a direction below this are not named.
_NAMED = 0.15


def verdict(result: FitResult) -> str:
    """The one sentence that says what may be made of the fit; what forbids most comes first."""
    within = structure_sentences(result)
    cases = (
        (bool(within) and result.structures[0].refused, next(iter(within), "")),
        (not result.usable, _little(result)),
        (
            not result.fitted.converged,
            "The search ended before it converged: a longer or less noisy recording is needed.",
        ),
        (
            result.person is not None and result.person.preferred,
            "A subject with noise inside the loop explains the recordings better than noise in "
            "the recorder: go by the gain of that subject, in its section.",
        ),
        (result.weights_test.rejected, result.weights_test.sentence),
        (
            result.culprit is not None,
            "The controller agrees with the recordings, but the body or the controller that moved "
            "is not that of the model, or noise entered the loop at its limit: do not rely on its "
            "gain, its weights or their intervals.",
        ),
        (
            not bounded(result),
            "No limit of the command or of a state was given: this is inverse LQR, and says "
            "nothing of how the subject uses what strength there is.",
        ),
        (
            not result.met,
            "No bound is ever active: these recordings cannot distinguish inverse MPC from inverse "
            "LQR.",
        ),
        (bool(within), next(iter(within), "")),
        (
            True,
            "Inverse MPC explains the recordings inside the bound: the gain is the subject's, as "
            "far as its intervals say; the weights are a choice, but for what holds for all of "
            "them.",
        ),
    )
    return next(sentence for holds, sentence in cases if holds)


def _little(result: FitResult) -> str:
    """Which signals are explained by less than half."""
    plant = result.given.plant
    least = [
        f"{name} (VAF {value:.0f} %)" if np.isfinite(value) else f"{name} (no simulation ends)"
        for name, value in zip(plant.outputs, result.inverse_mpc.vaf, strict=True)
        if not value >= LITTLE
    ]
    return (
        f"The fitted controller explains less than half of {' and '.join(least)}: do not interpret "
        "it. Check the units, the plant and the limit of the command."
    )


def abstract(result: FitResult) -> tuple[str, ...]:
    """A few plain sentences with numbers."""
    return (
        _what_was_done(result),
        *aim_sentences(result),
        *body_sentences(result),
        _agreement(result),
        *_at_the_bound(result),
        *((_gain(result), _weights(result)) if result.usable else ()),
    )


def _what_was_done(result: FitResult) -> str:
    problem = result.fitted.problem
    plant, horizon = problem.plant, problem.horizon
    trials = result.given.recordings
    seconds = sum(trial.samples for trial in trials) * plant.dt
    bounds = result.given.bounds
    most_of = dict(zip(plant.states, bounds.x_max, strict=True))
    most_of = {name: most_of[name] for name in plant.commands}
    most_of |= zip(plant.controls, bounds.u_max, strict=True)
    limits = [
        f"{number(float(most))} {plant.unit(name)} of {_named(plant, name)}"
        for name, most in most_of.items()
        if np.isfinite(most)
    ]
    bounded = f"limited to {' and '.join(limits)}" if limits else "without a limit"
    count = "one trial" if len(trials) == 1 else f"{len(trials)} trials"
    return (
        f"A model predictive controller (MPC) that looks {horizon * plant.dt:.3g} s ahead "
        f"({horizon} samples), {bounded}, was fitted to {count}, {seconds:.3g} s in all."
    )


def _named(plant: Plant, name: str) -> str:
    words = plant.word(name)
    return f"{name} ({words})" if words else name


def _agreement(result: FitResult) -> str:
    plant = result.fitted.problem.plant
    parts = [
        f"{value:.2f} % of {_named(plant, name)}"
        for name, value in zip(plant.outputs, result.inverse_mpc.vaf, strict=True)
    ]
    text = f"It accounts for {' and '.join(parts)} (VAF)"
    if result.held_out:
        held = np.mean([item.vaf for item in result.held_out], axis=0)
        text += (
            f"; in trials that the fit has not seen, for "
            f"{' and '.join(f'{value:.2f} %' for value in held)}"
        )
    return f"{text}.{_ceiling(result)}"


def _ceiling(result: FitResult) -> str:
    """What any controller without noise can explain, where the perturbation repeats."""
    found = result.ceiling
    if found is None:
        return ""
    parts = [
        f"{value:.1f} % ({low:.1f} to {high:.1f}) of {name}"
        for name, value, low, high in zip(
            result.given.plant.outputs, found.vaf, found.low, found.high, strict=True
        )
    ]
    return (
        f" Of the movement {' and '.join(parts)} repeats with the perturbation: no controller "
        f"without noise of its own explains more ({found.repetitions} repetitions)."
    )


def _at_the_bound(result: FitResult) -> list[str]:
    """How often the command is at its bound, and what inverse LQR needs instead."""
    share = 100 * float(np.mean([item.saturated for item in result.trials]))
    text = f"The command is at its bound for {share:.1f} % of the time"
    methods = {item.name: item for item in result.methods}
    other, own = methods.get("inverse_lqr_output"), result.inverse_mpc
    if other is None or other.estimate.K is None or np.any(np.isnan(other.vaf)):
        return [f"{text}."] if limited(result) else []
    gain = float(np.mean(own.vaf - other.vaf))
    sign = "more" if gain >= 0 else "less"
    plant = result.given.plant
    largest = f"{number(float(other.largest_input[0]))} {plant.unit(plant.controls[0])}"
    than = f"inverse MPC accounts for {abs(gain):.2f} points {sign} than inverse LQR on the outputs"
    if not limited(result):
        return [f"{than[0].upper()}{than[1:]} (largest command {largest})."]
    kept = "keeps the bound too" if other.keeps_bounds else "exceeds the bound"
    return [f"{text}; {than}, which {kept} (largest command {largest})."]


def _gain(result: FitResult) -> str:
    identified = result.estimate.covariance.individually_identified
    count, total = int(np.count_nonzero(identified)), int(np.size(identified))
    zero = sum(item.excludes_zero for item in result.gain_intervals)
    apart = f"the 95 % intervals of {zero} exclude zero"
    if count == total:
        return f"All {total} entries of the gain are individually identified; {apart}."
    return (
        f"Of the {total} entries of the gain {count} are individually identified, of the others "
        f"only combinations; {apart}."
    )


def _weights(result: FitResult) -> str:
    text = (
        "Other weights with exactly the same behaviour turn the dominant cost by up to "
        f"{result.widest_angle:.0f} degrees"
    )
    summary = result.uncertainty.weights
    if result.weights_test.rejected:
        return "No cost weights explain this gain: nothing may be said of the subject's intent."
    if summary is None or not summary.drawn:
        return f"{text}: which weights are reported is a convention."
    made = sum(item.made for item in summary.statements)
    return (
        f"{text}; {made} of {len(summary.statements)} statements on what costs more hold for all "
        "of them, at 95 %."
    )


def remarks(result: FitResult) -> tuple[str, ...]:
    """What stands behind the verdict: how sure it is, and what was chosen."""
    return (
        *structure_sentences(result)[1:],
        *_clipped(result),
        *(_of_weights(result) if result.usable and not result.weights_test.rejected else ()),
        _determined(result),
        *result.fitted.doubts,
        *_failed(result),
        *result.person_sentences,
    )


def missing(settings: FitSettings, source: PlantSource) -> str:
    """What was not given, and what that excludes, in one line; empty where nothing is missing."""
    parts = []
    if settings.u_max is None:
        parts.append("u_max: without a limit of the command inverse MPC is inverse LQR")
    typical = source.assumed()
    own = [name for name in typical if name not in settings.free]
    if own:
        values = ", ".join(f"{name} {typical[name]}" for name in own)
        parts.append(f"the subject's own {' and '.join(own)}: the gains are those of {values}")
    return f"Not given: {'; '.join(parts)}." if parts else ""


def limited(result: FitResult) -> bool:
    """Whether the settings give a limit on any input."""
    return bool(np.any(np.isfinite(result.given.bounds.u_max)))


def bounded(result: FitResult) -> bool:
    """Whether there is a limit on any input or state."""
    bounds = result.given.bounds
    sides = np.concatenate([bounds.u_min, bounds.u_max, bounds.x_min, bounds.x_max])
    return bool(np.any(np.isfinite(sides)))


def direction_name(direction: Array, names: tuple[str, ...]) -> str:
    """A direction (n,) as a sum of parts called by their `names`, the largest first."""
    order = np.argsort(-np.abs(direction), kind="stable")
    parts = [
        f"{direction[index]:+.2f} {names[index]}"
        for index in order
        if abs(direction[index]) >= _NAMED
    ]
    return " ".join(parts)


def _clipped(result: FitResult) -> list[str]:
    """In which trials the law of inverse MPC falls when it is merely clipped, and when."""
    methods = {item.name: item for item in result.methods}
    if "clipped_lqr" not in methods:
        return []
    falls = ", ".join(
        f"{trial_name(result, index)} at {time:.1f} s"
        for index, time in enumerate(methods["clipped_lqr"].fell)
        if time is not None
    )
    if not falls:
        return []
    own = [time for time in methods["inverse_mpc"].fell if time is not None]
    stands = "" if own else "; inverse MPC does not"
    return [f"The same gain merely clipped at the bound falls: {falls}{stands}."]


def _of_weights(result: FitResult) -> tuple[str, str]:
    reading, plant = result.intent.reported, result.fitted.problem.plant
    return dominant_sentence(reading, plant, np.array(result.intent.sizes)), _how_sure(result)


def _failed(result: FitResult) -> tuple[str, ...]:
    """The stages that failed, and why."""
    return tuple(f"Not available, {stage}: {reason}." for stage, reason in result.failures.items())


def _how_sure(result: FitResult) -> str:
    summary = result.uncertainty.weights
    drawn = (
        ""
        if summary is None or not summary.drawn
        else f" Other gains that the recordings allow turn it by up to "
        f"{summary.angle_of_gain:.0f} degrees at 95 %."
    )
    return (
        f"Other weights with exactly the same behaviour turn that direction by up to "
        f"{result.widest_angle:.0f} degrees: so far it was chosen by a rule and not by the "
        f"subject (section 6).{drawn}"
    )


def _determined(result: FitResult) -> str:
    found, covariance = result.identifiability, result.estimate.covariance
    values = covariance.singular_values
    count = int(np.count_nonzero(np.isfinite(covariance.deviations)))
    identified = int(np.count_nonzero(covariance.identified))
    entries = int(np.count_nonzero(covariance.individually_identified))
    return (
        f"Of the {len(values)} directions of the gain the recordings determine {count} above "
        f"rounding and identify {identified}: their standard error is below {IDENTIFIED:g} of a "
        f"natural gain. {entries} of its entries are individually identified. Of the "
        f"{found.free} directions of the weights the recordings determine {found.rank}; the "
        f"other {found.chosen} are a convention."
    )
