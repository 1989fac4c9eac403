"""What a fit found, in sentences with numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import DETERMINED, TOLD
from impc.assess.intent_rules import dominant_sentence
from impc.reporting.rendering import number
from impc.studies.fit.person import person_sentences
from impc.studies.fit.result import trial_name
from impc.studies.fit.structures import structure_sentences

if TYPE_CHECKING:
    from impc.assess.judged import MethodFit
    from impc.studies.fit.result import FitResult

__all__ = ["direction_name", "findings", "limited"]

# Parts of a direction below this are not named.
_NAMED = 0.15


def findings(result: FitResult) -> tuple[str, ...]:
    """The first lines of the page."""
    within = structure_sentences(result)
    refused = bool(within) and result.structures[0].refused
    return (
        *(within if refused else ()),
        *result.warnings,
        *(() if refused else within),
        *_agreement(result),
        *_saturation(result),
        *_against_inverse_lqr(result),
        dominant_sentence(
            result.intent.reported, result.fitted.problem.plant, np.array(result.intent.sizes)
        ),
        _how_sure(result),
        _determined(result),
        *person_sentences(result),
    )


def limited(result: FitResult) -> bool:
    """Whether the settings give a limit on any input."""
    return bool(np.any(np.isfinite(result.given.bounds.u_max)))


def _falls(result: FitResult, method: MethodFit) -> str:
    """The trials in which a method falls, and when; empty when it never does."""
    return ", ".join(
        f"{trial_name(result, index)} at {time:.1f} s"
        for index, time in enumerate(method.fell)
        if time is not None
    )


def direction_name(
    direction: np.ndarray[tuple[int, ...], np.dtype[np.float64]], names: tuple[str, ...]
) -> str:
    """A direction (n,) as a sum of parts called by their `names`, the largest first."""
    order = np.argsort(-np.abs(direction), kind="stable")
    parts = [
        f"{direction[index]:+.2f} {names[index]}"
        for index in order
        if abs(direction[index]) >= _NAMED
    ]
    return " ".join(parts)


def _agreement(result: FitResult) -> list[str]:
    plant = result.fitted.problem.plant
    lines = []
    for index, name in enumerate(plant.outputs):
        text = f"Inverse MPC accounts for {result.inverse_mpc.vaf[index]:.2f} % of {name} (VAF)"
        held = [item.vaf[index] for item in result.held_out]
        if held:
            text += f", and for {np.mean(held):.2f} % of it in trials that the fit has not seen"
        lines.append(text + ".")
    return lines


def _saturation(result: FitResult) -> list[str]:
    if not limited(result):
        return [
            "The settings give no limit on the command ([fit] u_max): inverse MPC is inverse LQR "
            "here, and nothing can be said of how the subject uses what strength there is."
        ]
    share = 100 * float(np.mean([item.saturated for item in result.trials]))
    if share == 0:
        return [
            "The command never reaches its bound: these recordings cannot tell inverse MPC from "
            "inverse LQR."
        ]
    return [f"The command stands at its bound for {share:.1f} % of the time."]


def _against_inverse_lqr(result: FitResult) -> list[str]:
    methods = {item.name: item for item in result.methods}
    other, own = methods.get("inverse_lqr_output"), result.inverse_mpc
    lines = []
    if other is not None and other.estimate.K is not None and not np.any(np.isnan(other.vaf)):
        gain = float(np.mean(own.vaf - other.vaf))
        kept = ", which keeps the bound too" if other.keeps_bounds else ", which exceeds the bound"
        sign = "more" if gain >= 0 else "less"
        plant = result.given.plant
        largest = f"{number(float(other.largest_input[0]))} {plant.unit(plant.controls[0])}"
        lines.append(
            f"Inverse MPC accounts for {abs(gain):.2f} points {sign} than inverse LQR on the "
            f"outputs{kept if limited(result) else ''} (largest command {largest})."
        )
    clipped = _falls(result, methods["clipped_lqr"]) if "clipped_lqr" in methods else ""
    if clipped:
        lines.append(
            f"The same gain merely clipped at the bound falls: {clipped}; inverse MPC stands."
        )
    return lines


def _how_sure(result: FitResult) -> str:
    summary = result.certainty.weights
    drawn = (
        ""
        if summary is None or not summary.drawn
        else f" Other gains that the recordings allow turn it by up to "
        f"{summary.angle_of_gain:.0f} degrees at 95 %."
    )
    return (
        f"Other weights with exactly the same behaviour turn that direction by up to "
        f"{result.widest_angle:.0f} degrees: so far it was chosen by a rule and not by the "
        f"subject (section 4).{drawn}"
    )


def _determined(result: FitResult) -> str:
    found, covariance = result.identifiability, result.estimate.covariance
    values = covariance.singular_values
    count = int(np.count_nonzero(values > DETERMINED * values[0]))
    told = int(np.count_nonzero(covariance.told))
    entries = int(np.count_nonzero(covariance.told_entries))
    return (
        f"Of the {len(values)} directions of the gain the recordings determine {count} above "
        f"rounding and {told} to better than {TOLD:g} of their natural size; {entries} of its "
        f"entries they tell by themselves. Of the {found.free} directions "
        f"of the weights {found.rank}, the other {found.chosen} are a choice."
    )
