"""Sentences on the body model: its stated uncertainty, and tests against the recordings."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from impc.assess import lack_of_fit
from impc.assess.diagnosis import DIFFERENCE, EXCHANGED, SIGN, SUM
from impc.assess.lack_of_fit import LackOfFit, ModelError
from impc.levels import Level
from impc.model.plant import Plant
from impc.model.signal_errors import KINDS
from impc.reporting.finding import Finding, table_of
from impc.reporting.rendering import number
from impc.reporting.shown_units import error_unit, signal_name
from impc.studies.fit.facts import shifted
from impc.studies.fit.result import FitResult, FittedParameter

# Standard deviation after the fit over the stated one above which nothing was learned.
_AS_BEFORE = 0.9
# Smallest share of the gain's variance for which a parameter is named.
_NAMED = 0.05

_KINDS = {
    lack_of_fit.DELAY: "a delay of the command",
    lack_of_fit.LIMIT: "another limit of the command",
    lack_of_fit.LEAN: "a lean, a constant push in each trial",
    lack_of_fit.STIFFNESS: "another stiffness or damping where the perturbation acts",
    lack_of_fit.MODE: "a further mode of the body",
    lack_of_fit.NONLINEAR: "a nonlinear body, or a reaction to noise at the limit",
}
# Words of mistakes in the meaning of a signal, and what to do.
_MISTAKES = {
    SIGN: ("a reversed sign of the {}", "Reverse its direction (sign in [signals.{}])."),
    EXCHANGED: ("an exchange of the {} with another signal", "Exchange the columns."),
    SUM: ("a {} recorded as its sum with another signal", "Subtract that signal."),
    DIFFERENCE: ("a {} recorded as its difference to another signal", "Add that signal."),
}


def body_sentence_of(result: FitResult) -> str:
    """State which uncertainty of the body model the intervals include."""
    stated = _stated(result)
    if not stated:
        return (
            "The body model was taken as exact: intervals include noise, but not the uncertainty "
            "of masses, lengths, delay and limit; state it in [plant.uncertainty]."
        )
    count = "One parameter" if len(stated) == 1 else f"{len(stated)} parameters"
    return (
        f"{count} of the body, such as its mass and delays, {'is' if len(stated) == 1 else 'are'} "
        f"uncertain. {_wider(result)}"
    )


def parameter_words(result: FitResult) -> Markup:
    """Parameters that cause the gain's variance, and those that the recordings do not improve."""
    stated = _stated(result)
    parts = sorted(stated, key=lambda item: -item.share)
    named = [f"{item.name} {100 * item.share:.0f} %" for item in parts if item.share > _NAMED]
    as_before = [item.name for item in stated if item.learned > _AS_BEFORE]
    said, code = [], Markup("<code>{}</code>")
    if named:
        said.append(f"Shares of the variance of the gain: {code.format(', '.join(named))}.")
    if as_before:
        names = code.format(", ".join(as_before))
        said.append(f"The recordings add no information on {names}: measure them directly.")
    return Markup(" ").join(map(Markup, said))


def _stated(result: FitResult) -> list[FittedParameter]:
    return [
        item
        for item in result.parameters
        if item.stated is not None and not _is_added(result, item)
    ]


def _is_added(result: FitResult, item: FittedParameter) -> bool:
    """Whether a parameter was added because the tests of a first fit pointed to it."""
    added = None if result.added is None else lack_of_fit.PARAMETERS.get(result.added.name)
    return added is not None and item.name.startswith(added)


def _wider(result: FitResult) -> str:
    """Median ratio of the intervals to those with an exactly known body."""
    found, exact = result.estimate.covariance, result.estimate.exact
    identified = np.array(found.individually_identified)
    if exact is None or not np.any(identified):
        return "The intervals allow for it."
    ratio = (np.array(found.entries) / np.array(exact.entries))[identified]
    return f"This makes the intervals {number(float(np.median(ratio)), 2)} times as wide."


def error_words(result: FitResult, error: ModelError) -> str:
    """A model error in words, with its size if it has one."""
    plant, size, deviation = result.given.plant, error.size, error.deviation
    words, signal = name_words(plant, error.name), lack_of_fit.signal_of(error.name)
    if signal is not None:
        return f"{words}{_size_words(plant, *signal, size, deviation)}"
    if not np.isfinite(size):
        return words
    if error.name == lack_of_fit.DELAY:
        return f"{words} of {1e3 * plant.dt * size:.0f} ± {1e3 * plant.dt * deviation:.0f} ms"
    return f"{words}, by {100 * size:+.1f} ± {100 * deviation:.1f} %"


def name_words(plant: Plant, name: str) -> str:
    """A tested error in words, without its size."""
    signal = lack_of_fit.signal_of(name)
    if signal is None:
        return _KINDS[name]
    kind, words = signal[0], signal_name(plant, signal[1])
    if kind in _MISTAKES:
        return _MISTAKES[kind][0].format(words)
    return f"{KINDS[kind][0]} of the {words}"


def remedy_words(result: FitResult, error: ModelError) -> str:
    """What to do about an error that the fit has corrected."""
    kind, name = lack_of_fit.signal_of(error.name) or (error.name, "")
    if kind in _MISTAKES:
        return _MISTAKES[kind][1].format(name)
    values = {pair[:2]: pair[2] for pair in result.estimate.problem.fitted_errors}
    factor, unit = error_unit(result.given.plant, kind, name)
    size = number(factor * float(np.mean(values[kind, name])), 3)
    if kind == "offset":
        return f"If the zero of the sensor is off, add {size} {unit} to offset in [signals.{name}]."
    signal = signal_name(result.given.plant, name)
    what = f"{KINDS[kind][0]} of {size} {unit}"
    return f"Correct the {signal} for {what}, in the file or at the device."


def _size_words(plant: Plant, kind: str, name: str, size: float, deviation: float) -> str:
    """What an error of a signal means for the recording, if it is the same in all trials."""
    if kind not in ("scale", "shift", "clock") or not np.isfinite(size):
        return ""
    unit = 1e3 * plant.dt if kind == "shift" else 100
    much = f"{unit * abs(size):.3g} ± {unit * deviation:.2g} {'ms' if kind == 'shift' else '%'}"
    if kind == "shift":
        return f" (it {shifted(plant, name, much, late=size > 0)})"
    return f" (by {'+' if size > 0 else '-'}{much})"


def added_sentence(result: FitResult) -> str:
    """Sentence on the unknown that was added after a first fit; empty if there is none."""
    added = result.added
    if added is None:
        return ""
    words = error_words(result, added)
    signal = lack_of_fit.signal_of(added.name)
    if signal:  # its size is that of the second fit
        words = name_words(result.given.plant, added.name)
    done = "corrected" if signal and signal[0] in _MISTAKES else "added to the unknowns"
    said = (
        f"The residuals of a first fit pointed to {words} "
        f"({probability_words(added)}). It was {done}: all numbers come from the second fit."
    )
    unknown = [
        item for item in result.parameters if _is_added(result, item) and not item.determined
    ]
    if added.name != lack_of_fit.DELAY or not unknown:
        return said
    return (
        f"{said} A gain on the last command compensates for much of a delay, so the intervals are "
        "wide: measure the delay, and state it in [plant.uncertainty] extra_delay."
    )


def alternative_reason(result: FitResult, error: ModelError) -> str:
    """Alternative explanation by noise in the loop, if the limit is reached; else empty."""
    if result.saturated == 0 or error.name not in (lack_of_fit.LEAN, lack_of_fit.NONLINEAR):
        return ""
    return (
        " A reaction to noise in muscles or senses at the limit has the same effect: the test "
        "mistakes it for a reaction to the perturbation."
    )


def probability_words(error: ModelError) -> str:
    """Format the p-value of a model error."""
    return "p < 0.0001" if error.probability < 1e-4 else f"p = {error.probability:.4f}"


def lack_finding(plant: Plant, found: LackOfFit) -> Finding:
    """Table of all model errors that were tested."""
    table = table_of(
        found.errors,
        {
            "error": lambda item: item.name,
            "p": lambda item: float(item.probability),
            "size": lambda item: float(item.size),
            "standard_error": lambda item: float(item.deviation),
        },
    )
    untestable = ", ".join(name_words(plant, name) for name in found.untestable)
    caption = (
        "Tests for errors of the model whose effect on the outputs resembles the residual. p: "
        "p-value of each test if the model is right, without correction for several tests. Sizes: "
        "delay and time shift in samples; the others as fractions."
    )
    if untestable:
        caption += (
            f" The fit compensates for {untestable}, whatever the size: check by measurement."
        )
    level = Level.AMBER if found.alarm else Level.GREEN
    return Finding(
        "residual_tests", table, caption, level=level, folded="Tests of the model, one by one"
    )
