"""What a fit says of the body: how well it is known, and whether the recordings contradict it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

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
from impc.reporting.finding import Finding, Severity, table_of
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


def body_sentences(result: FitResult) -> tuple[str, ...]:
    """How well the body is known, and what that makes of the intervals."""
    stated = [
        item
        for item in result.parameters
        if item.stated is not None and not _is_added(result, item)
    ]
    if not stated:
        return (
            "The body was taken as exact: the intervals on this page contain noise, and not what "
            "is uncertain of masses, lengths, delay and limit ([plant.uncertainty] states it).",
        )
    parts = sorted(stated, key=lambda item: -item.share)
    named = [f"{item.name} {100 * item.share:.0f} %" for item in parts if item.share > _NAMED]
    found_as_before = [item.name for item in stated if item.learned > _AS_BEFORE]
    count = "one parameter was" if len(stated) == 1 else f"{len(stated)} parameters were"
    said = [
        f"The body is not known exactly: {count} fitted within the stated uncertainty, and the "
        f"intervals contain it{_wider(result)}."
    ]
    if named:
        said.append(f"Of the variance of the gain come from {', '.join(named)}.")
    if found_as_before:
        said.append(
            f"These recordings say nothing of {', '.join(found_as_before)}: a gain makes up for "
            "them. They cannot be tested here, only measured."
        )
    return tuple(said)


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
        f"A first fit left what {error_words(result, added)} explains ({_probability(added)}). It "
        "was fitted too: all numbers are of that fit."
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


def lack_sentence(result: FitResult) -> str:
    """The warning that the model does not fit, with the most probable reason; or nothing."""
    culprit = result.culprit
    if culprit is None:
        return ""
    noise = (
        " Noise that enters the loop and is answered at the limit does the same; [fit.observer] "
        "asks for a subject with such noise."
    )
    return (
        "Warning: a part of what the fit leaves follows the perturbation, as noise does not. "
        f"{error_words(result, culprit).capitalize()} explains most of it "
        f"({_probability(culprit)}). The intervals on this page do not contain this error."
        f"{noise if result.saturated > 0 and culprit.name in (LEAN, NONLINEAR) else ''}"
    )


def _probability(error: ModelError) -> str:
    return "p < 0.0001" if error.probability < 1e-4 else f"p = {error.probability:.4f}"


def lack_finding(result: FitResult, found: LackOfFit) -> Finding:
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
        "Each is an error of the model that would move the outputs as the residuals do; p is of as "
        "much where the model holds, each test by itself. Sizes: delay in samples, limit and "
        "perturbation as shares."
    )
    if untestable:
        caption += f" The fit makes up for {untestable}, whatever the size."
    return Finding(
        "residual_tests",
        table,
        caption,
        result.warnings,
        severity=Severity.AMBER if found.alarm else Severity.GREEN,
        folded="Tests of the model",
    )
