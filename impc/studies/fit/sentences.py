"""What a fit found, in sentences with numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import TOLD
from impc.assess.intent_rules import dominant_sentence
from impc.studies.fit.result import trial_name
from impc.studies.fit.structure_words import structure_sentences

if TYPE_CHECKING:
    from impc.files.plant_sources import PlantSource
    from impc.studies.fit.result import FitResult
    from impc.studies.fit.settings import FitSettings

# Parts of a direction below this are not named.
_NAMED = 0.15


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
        f"subject (section 6).{drawn}"
    )


def _determined(result: FitResult) -> str:
    found, covariance = result.identifiability, result.estimate.covariance
    values = covariance.singular_values
    count = int(np.count_nonzero(np.isfinite(covariance.deviations)))
    told = int(np.count_nonzero(covariance.told))
    entries = int(np.count_nonzero(covariance.told_entries))
    return (
        f"Of the {len(values)} directions of the gain the recordings determine {count} above "
        f"rounding and identify {told}: their standard error is below {TOLD:g} of a natural gain. "
        f"{entries} of its entries are individually identified. Of the {found.free} directions of "
        f"the weights the recordings determine {found.rank}; the other {found.chosen} are a "
        "convention."
    )
