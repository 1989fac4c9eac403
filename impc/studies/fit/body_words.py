"""What a fit says of the body: how well it is known, and whether the recordings contradict it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from impc.assess.lack_of_fit import (
    DELAY,
    LEAN,
    LIMIT,
    MODE,
    NONLINEAR,
    OFFSET,
    PARAMETERS,
    PUSH,
    STIFFNESS,
)
from impc.reporting.finding import Finding, Level, table_of
from impc.reporting.rendering import number

if TYPE_CHECKING:
    from impc.assess.lack_of_fit import LackOfFit, ModelError
    from impc.studies.fit.result import FitResult, FittedParameter

# Of a stated deviation: what is known no better after the fit is not identified by it.
_AS_BEFORE = 0.9
# Of the variance of the gain: a smaller share of a parameter is not named.
_NAMED = 0.05

_KINDS = {
    DELAY: "a delay of the command",
    LIMIT: "another limit of the command",
    LEAN: "a lean, a constant push in each trial",
    OFFSET: "an offset of the recorded outputs",
    PUSH: "another size of the perturbation, or another inertia",
    STIFFNESS: "another stiffness or damping where the perturbation acts",
    MODE: "a further mode of the body",
    NONLINEAR: "a body that is not linear, or noise that the person answers at the limit",
}


def body_sentence_of(result: FitResult) -> str:
    """How well the body is known, and what that makes of the intervals."""
    stated = _stated(result)
    if not stated:
        return (
            "The body model was taken as exact: intervals contain noise, and not what is uncertain "
            "about masses, lengths, delay and limit; state it in [plant.uncertainty]."
        )
    count = "one parameter was" if len(stated) == 1 else f"{len(stated)} parameters were"
    return (
        f"The body is not known exactly: {count} fitted within the stated uncertainty, and the "
        f"intervals include it{_wider(result)}."
    )


def parameter_words(result: FitResult) -> Markup:
    """Which parameters cause the uncertainty of the gain, and which only a measurement improves."""
    stated = _stated(result)
    parts = sorted(stated, key=lambda item: -item.share)
    named = [f"{item.name} {100 * item.share:.0f} %" for item in parts if item.share > _NAMED]
    as_before = [item.name for item in stated if item.learned > _AS_BEFORE]
    said, code = [], Markup("<code>{}</code>")
    if named:
        said.append(f"Of the variance of the gain these cause: {code.format(', '.join(named))}.")
    if as_before:
        names = code.format(", ".join(as_before))
        said.append(f"The recordings add nothing on {names}: they can only be measured.")
    return Markup(" ").join(map(Markup, said))


def _stated(result: FitResult) -> list[FittedParameter]:
    return [
        item
        for item in result.parameters
        if item.stated is not None and not _is_added(result, item)
    ]


def _is_added(result: FitResult, item: FittedParameter) -> bool:
    """Whether a parameter is fitted because a first fit was found to lack it."""
    added = None if result.added is None else PARAMETERS.get(result.added.name)
    return added is not None and item.name.startswith(added)


def _wider(result: FitResult) -> str:
    """How much wider the intervals are than for an exact body."""
    found, exact = result.estimate.covariance, result.estimate.exact
    identified = np.array(found.individually_identified)
    if exact is None or not np.any(identified):
        return ""
    ratio = (np.array(found.entries) / np.array(exact.entries))[identified]
    return f", {number(float(np.median(ratio)), 2)} times as wide as for an exact body"


def error_words(result: FitResult, error: ModelError) -> str:
    """An error of the model, with its size where it has one."""
    plant, size, deviation = result.given.plant, error.size, error.deviation
    words = _KINDS[error.name]
    if not np.isfinite(size):
        return words
    if error.name == DELAY:
        return f"{words} of {1e3 * plant.dt * size:.0f} ± {1e3 * plant.dt * deviation:.0f} ms"
    return f"{words}, by {100 * size:+.1f} ± {100 * deviation:.1f} %"


def added_sentence(result: FitResult) -> str:
    """What was fitted too because a first fit lacked it; empty where nothing was."""
    added = result.added
    if added is None:
        return ""
    said = (
        f"The residuals of a first fit pointed to {error_words(result, added)} "
        f"({probability_words(added)}). It was fitted too: all numbers come from that fit."
    )
    unknown = [
        item for item in result.parameters if _is_added(result, item) and not item.determined
    ]
    if added.name != DELAY or not unknown:
        return said
    return (
        f"{said} A gain on the last command makes up for much of a delay, so that the intervals "
        "are wide: measure it, and state it in [plant.uncertainty] extra_delay."
    )


def alternative_reason(result: FitResult, error: ModelError) -> str:
    """That noise in the loop does the same, where the limit is reached and it may be that."""
    if result.saturated == 0 or error.name not in (LEAN, NONLINEAR):
        return ""
    return (
        " Noise in muscles or senses that the person answers at the limit does the same: it is "
        "mistaken for a reaction to the perturbation."
    )


def probability_words(error: ModelError) -> str:
    """The probability of as much where the model holds."""
    return "p < 0.0001" if error.probability < 1e-4 else f"p = {error.probability:.4f}"


def lack_finding(found: LackOfFit) -> Finding:
    """Every error of the model that was tested."""
    table = table_of(
        found.errors,
        {
            "error": lambda item: item.name,
            "p": lambda item: float(item.probability),
            "size": lambda item: float(item.size),
            "standard_error": lambda item: float(item.deviation),
        },
    )
    untestable = ", ".join(_KINDS[name] for name in found.untestable)
    caption = (
        "Errors of the model that would move the outputs as the residuals do; p is the probability "
        "of as much if the model holds, each test by itself. Sizes: delay in samples, limit and "
        "perturbation as shares."
    )
    if untestable:
        caption += (
            f" The fit makes up for {untestable}, whatever the size: it can only be measured."
        )
    level = Level.AMBER if found.alarm else Level.GREEN
    return Finding(
        "residual_tests", table, caption, level=level, folded="Tests of the model, one by one"
    )
