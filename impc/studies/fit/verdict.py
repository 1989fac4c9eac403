"""Rules of a fit's verdict, for one subject and for every fit of a cohort, worst first.

The page shows the headline of the first kind that applies and an alert for each of its level;
results that they forbid are hidden.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from impc.assess.lack_of_fit import LIMIT, signal_of
from impc.checking import replace
from impc.levels import Level
from impc.reporting.rendering import number
from impc.reporting.rules import Kind, Line, Rules, always
from impc.studies.fit import facts
from impc.studies.fit.body_words import (
    alternative_reason,
    error_words,
    name_words,
    probability_words,
    remedy_words,
)
from impc.studies.fit.result import LITTLE, FitResult

# VAF (%) below which the residual is large; p of the whiteness test that rules out white noise.
_MUCH, _COLOURED = 90.0, 1e-3
# Recorded numbers below which the VAF of left-out trials is unreliable.
_SHORT = 200
#: Results that a kind may forbid: gains, cost weights, time at the limit.
GAIN, WEIGHTS, SHARE = "gain", "weights", "share"
#: Name of the kind in which no gain is determined.
UNDETERMINED = "undetermined"
_NO_GAIN = frozenset([GAIN, WEIGHTS])
_NOTHING = frozenset([GAIN, WEIGHTS, SHARE])


def little(result: FitResult) -> bool:
    """Whether the model does not describe the recordings."""
    found, where = facts.reported_shares(result)
    # Uncertain gains predict short trials badly even if the model is right.
    short = where == "left-out trials" and result.given.recorded_numbers < _SHORT
    return bool(not np.all(found >= LITTLE) and not (short and _weak(result)))


def _disagrees(result: FitResult) -> bool:
    found = result.limit_found
    return found is not None and facts.given_limit(result) is not None and found.disagrees


def _named_cause(result: FitResult) -> str:
    """Kind of the likeliest model error: "limit", "signal", "body", or empty."""
    error = result.culprit
    if error is None or _disagrees(result):  # a wrong limit has the same effects
        return ""
    signal = signal_of(error.name) is not None
    return "limit" if error.name == LIMIT else "signal" if signal else "body"


def _corrected(result: FitResult) -> bool:
    """Whether an error of a signal, other than its timing, was removed by the second fit."""
    signal = None if result.added is None else signal_of(result.added.name)
    return signal is not None and signal[0] != "shift" and result.culprit is None


def _noise(result: FitResult) -> bool:
    """Whether a large residual is not white: noise in the loop may have caused it."""
    small = float(np.min(result.inverse_mpc.vaf)) > _MUCH
    coloured = all(np.nanmin(one.whiteness) < _COLOURED for one in result.trials)
    return not small and coloured and result.person is None and not result.weights_test.rejected


def _weak(result: FitResult) -> bool:
    return not any(row.determined for _, row in facts.named_gains(result))


def _of_limit(result: FitResult) -> str:
    refitted = result.added is not None and result.added.name == LIMIT
    if refitted and result.culprit is None:
        return f"The gains on this page are those of a fit with {_found_limit(result)}."
    return (
        "With a wrong limit, gains may be several times too small or too large, and their "
        "intervals do not show this."
    )


def _found_limit(result: FitResult) -> str:
    found = result.limit_found
    return "" if found is None else f"{number(found.value)} {found.unit}"


def _seems(result: FitResult) -> str:
    if _reason(result):
        return "the person may react to noise"
    signal = _named_cause(result) == "signal"
    return "a recorded signal seems to be wrong" if signal else "the body model seems to be inexact"


def _reason(result: FitResult) -> str:
    return "" if result.culprit is None else alternative_reason(result, result.culprit)


def _error(result: FitResult) -> str:
    error = result.culprit
    return "" if error is None else f"{error_words(result, error)} ({probability_words(error)})"


def _added(result: FitResult) -> str:
    return "" if result.added is None else name_words(result.given.plant, result.added.name)


def _names(result: FitResult, *, known: bool) -> str:
    """Names of the gains that are known to within half of their value, or of the others."""
    names = [name for name, row in facts.named_gains(result) if row.determined == known]
    return ", ".join(dict.fromkeys(names))


def _step(when: Callable[[FitResult], object], text: str) -> Callable[[FitResult], str]:
    """A step that is named only in some cases."""
    return lambda it: text if when(it) else ""


def _many(count: int, one: str) -> str:
    return f"1 {one}" if count == 1 else f"{count} {one}s"


_WORDS: dict[str, Callable[[FitResult], object]] = {
    "limit": lambda it: facts.given_limit(it) or "no limit of the command",
    "largest": lambda it: facts.amount(it, it.inverse_mpc.largest_input),
    "explained": facts.explained_words,
    "where": lambda it: facts.reported_shares(it)[1],
    "shares": lambda it: f"{facts.shares(it, it.inverse_mpc.vaf, 0)} of the variance",
    "gain_shares": lambda it: facts.shares(it, it.gain_shares, 0),
    "left_out": facts.left_out_text,
    "status": lambda it: it.fitted.status.sentence,
    "found": _found_limit,
    "found_value": lambda it: number(it.limit_found.value) if it.limit_found else "",
    "found_ends": lambda it: facts.limit_ends(it.limit_found) if it.limit_found else "",
    "of_limit": _of_limit,
    "error": _error,
    "reason": _reason,
    "seems": _seems,
    "also": lambda it: f", also with {_added(it)}" if it.added else "",
    "added": _added,
    "remedy": lambda it: remedy_words(it, it.added) if it.added else "",
    "observer_step": _step(_reason, "Add [fit.observer] to the settings and fit again."),
    "signal_step": _step(
        lambda it: _named_cause(it) == "signal",
        "Check units, zeros and clocks of the recording devices.",
    ),
    "offset": facts.outside_offset,
    "weights": lambda it: it.weights_test.sentence,
    "conflict": lambda it: it.weights_test.conflict,
    "structure": lambda it: it.structures[0].structure.name if it.structures else "",
    "used": lambda it: len(it.trials),
    "count": lambda it: len(it.trials) + len(it.falls),
    "others": lambda it: "other" if len(it.falls) == 1 else "others",
    "falls": lambda it: "; ".join(it.falls),
    "fell": lambda it: "One trial" if len(it.falls) == 1 else f"{len(it.falls)} trials",
    "gains": lambda it: len(facts.named_gains(it)),
    "ends": facts.ends_words,
    "enough": facts.enough_words,
    "held": lambda it: (
        "It predicts trials it was not fitted to, a" if len(it.inverse_mpc.held_out) else "A"
    ),
    "matters": lambda it: (
        "The limit matters."
        if facts.unlimited_ratio(it)[0] >= facts.MATTERS
        else "The limit is reached."
    ),
    "time": lambda it: f"{100 * it.saturated:.1f} %",
    "without": lambda it: facts.unlimited_ratio(it)[1],
    "known": lambda it: _names(it, known=True),
    "unknown": lambda it: _names(it, known=False),
    "example": facts.example_gain,
    "comparisons": lambda it: _many(len(facts.decided(it)), "comparison"),
    "chosen": lambda it: it.identifiability.chosen,
    "free": lambda it: it.identifiability.free,
    "rank": lambda it: it.identifiability.free - it.identifiability.chosen,
    "no_limit": facts.no_limit,
    "trials": lambda it: _many(len(it.trials), "trial"),
}

_INEXACT = Kind["FitResult"](
    Level.AMBER,
    lambda it: _named_cause(it) in ("signal", "body"),
    "The model follows the movement, but {seems}.",
    "Part of the residual follows the perturbation. The error of the gains may be larger than "
    "their intervals show, so do not report them yet.",
    "The residual depends on the perturbation",
    "Part of the residual follows the perturbation, unlike measurement noise{also}. The likeliest "
    "of the tested errors is {error}.{reason}",
    "The gains compensate for part of the error. Their intervals do not include it; the true "
    "uncertainty may be several times larger.",
    (
        "{observer_step}",
        "{signal_step}",
        "Check body mass, height and sex in the settings, and the dimensions of the device.",
        "State how well they are known in [plant.uncertainty], or fit a doubtful one with "
        "free = [...], and report how much the gains change.",
        "For group comparisons, use the same model for everyone: much of the error then cancels.",
    ),
    _NO_GAIN,
)

_KINDS: tuple[Kind[FitResult], ...] = (
    Kind(
        Level.RED,
        little,
        "The model explains less than half of a recorded signal.",
        "It explains {explained} in {where}. Do not interpret the other numbers on this page.",
        "The model does not describe these recordings",
        "In {where} it explains {explained}. If a model suits the recordings, values above 90 % "
        "are typical.",
        "Gains and cost weights come from a poor fit and do not describe the person.",
        (
            "Look at the figure above. If the model moves in the opposite direction, a sign may be "
            "reversed; if it lags or leads, the clocks of two devices may differ; if it has the "
            "wrong size, a unit may be wrong.",
            "Run impc inspect and compare the range of each signal with what you expect.",
            "Check that the column of the perturbation is what reached the person, and that "
            "nothing else did.",
            "If all of this is right, the search may have failed, the person may have moved on "
            "purpose, or this body model does not apply.",
        ),
        _NOTHING,
    ),
    Kind(
        Level.AMBER,
        _disagrees,
        "The model follows the movement, but a limit of {limit} is probably wrong.",
        "The recordings agree better with a limit of {found}. Until this is resolved, do not "
        "report gains or cost weights from this page.",
        "The limit does not agree with the recordings",
        "It was given as {limit}. Fitted together with the gain it is {found} ({found_ends}).",
        "{of_limit} A high percentage of explained variance does not exclude this error.",
        (
            "Set u_max = {found_value} if the person can produce no more, and fit again.",
            "If a warning remains, allow for noise in muscles and senses: add [fit.observer].",
            "If it still remains, check body mass, height and the model of the body.",
        ),
        _NOTHING,
    ),
    Kind(
        Level.AMBER,
        lambda it: not it.fitted.converged,
        "The model follows the movement, but the search did not converge.",
        "Gains and cost weights may still change: do not report them.",
        "The search stopped before it converged",
        "{status}",
        "A better fit with other gains may exist.",
        (
            "Fit longer or less noisy recordings.",
            "Fit fewer unknowns: remove names from free in [fit].",
        ),
        _NO_GAIN,
    ),
    Kind(
        Level.AMBER,
        _corrected,
        "The model follows the movement after a correction of a recorded signal.",
        "The recordings point to {added}. Correct it, and fit again.",
        "A recorded signal seems to be wrong",
        "With {added}, the model explains the recordings.",
        "The gains on this page are those with this error removed. If the error has another cause, "
        "they may be wrong.",
        ("{remedy}", "Then fit again."),
    ),
    Kind(
        Level.AMBER,
        facts.outside_offset,
        "The model follows the movement only about a level that was never recorded.",
        "A fitted offset lies outside the recorded signal. Do not report the gains.",
        "A fitted offset lies outside the recorded signal",
        "{offset}",
        "The model balances about another point than the person did, so its gains belong to "
        "another movement.",
        (
            "Check the zero and the sign of this signal.",
            "Remove the offset from [fit], or fit a lean with offsets of the body's angle only.",
        ),
        _NO_GAIN,
    ),
    Kind(
        Level.AMBER,
        lambda it: it.person is not None and it.person.preferred,
        "The model follows the movement, and the person seems to react to noise.",
        "Report the gains of the section on noise in the loop, not those of the model without it.",
        "The person seems to react to noise",
        "By AIC, the model with noise in senses or muscles explains the recordings better than all "
        "other models that were compared, or about as well.",
        "Gains of the model without this noise may be wrong by half of their value.",
        ("Report the gains of the section on noise in the loop, with their intervals.",),
        _NO_GAIN,
    ),
    replace(
        _INEXACT,
        when=lambda it: _named_cause(it) == "limit",
        todo=(
            "Set u_max to the most that the person can produce, or state its uncertainty in "
            "[plant.uncertainty], and fit again.",
            *_INEXACT.todo,
        ),
        forbids=_NOTHING,
    ),
    _INEXACT,
    Kind(
        Level.AMBER,
        _noise,
        "The model follows part of the movement; the person may react to noise.",
        "The reaction to noise in muscles or senses is probably part of the movement. Do not "
        "report gains of a model without this noise yet.",
        "Much of the movement is not explained, and the residual is not white noise",
        "The model explains {shares}. The residual is autocorrelated, as movement is and white "
        "measurement noise is not.",
        "Measurement noise does not bias the gains, because the person does not react to it. Noise "
        "in muscles or senses does: if the person reacts to it at the limit, or if it causes much "
        "of the movement, gains may be wrong by half of their value.",
        (
            "Add [fit.observer] to the settings and fit again; expect about half an hour.",
            "Report the gains of that fit, with its intervals, if its checks pass.",
            "For new recordings, use a stronger perturbation: the reaction to noise is then a "
            "smaller part of the movement.",
        ),
        _NO_GAIN,
    ),
    Kind(
        Level.AMBER,
        lambda it: it.weights_test.rejected,
        "The gain is identified, but no cost weights explain it.",
        "The recordings reject all quadratic costs of this form (p < 0.001). You may report the "
        "gain; you may not infer intent.",
        "No cost weights lead to this gain",
        "{weights}",
        "Either the person does not minimise a cost of this form, or an error in the body model, "
        "the delay or the limit has shifted the gain.",
        (
            "Report the gain with its intervals; leave out cost weights and intent.",
            "Fit uncertain parameters of the model too (free in [fit]), and check whether the "
            "conflict remains.",
            "Do not enter a similar gain by hand to obtain weights: they would not describe this "
            "person.",
        ),
        frozenset([WEIGHTS]),
    ),
    Kind(
        Level.AMBER,
        lambda it: it.weights_test.conflicting,
        "The model explains the movement, but its gain is less certain than its interval.",
        "Another gain explains the recordings about as well. You may report the explained "
        "variance, but no single gain.",
        "The interval of the gain is too narrow",
        "{conflict}",
        "The model is not contradicted, but the recordings leave a wider range of gains than the "
        "interval.",
        (
            "Record longer trials, or more of them, and fit all together.",
            "Compare groups by measures of movement, or by all people together (impc cohort).",
        ),
        _NO_GAIN,
    ),
    Kind(
        Level.AMBER,
        lambda it: it.structures and it.structures[0].refused,
        "The gain is identified, but the structure “{structure}” does not explain it.",
        "Do not report cost weights within this structure.",
        "The recordings reject the structure “{structure}”",
        "Gains outside the structure explain the recordings better than its cost weights.",
        "The cost weights within this structure do not describe the person.",
        ("Report the gain without the structure, or try another structure.",),
        frozenset([WEIGHTS]),
    ),
    Kind(
        Level.AMBER,
        _weak,
        "The model explains the movement, but the recordings do not determine its gains.",
        "Very different gains produce nearly the same movement. You may report the explained "
        "variance, but no single gain.",
        "The recordings are too short, or the perturbation is too weak",
        "None of the {gains} gains is known to within half of its value.{ends}",
        "The model is not contradicted, but many controllers would have moved in this way.",
        (
            "Record more{enough}, or use a stronger or faster perturbation.",
            "Compare groups by measures of movement, or by all people together: a gain that is "
            "uncertain in each person may be known for the group (impc cohort).",
        ),
        _NO_GAIN,
        name=UNDETERMINED,
    ),
    Kind(
        Level.AMBER,
        lambda it: it.falls,
        "The model explains {used} of {count} trials; in the {others} the person fell.",
        "The results below come from the trials without a fall.",
        "{fell} ended in a fall",
        "{falls}. The other trials were fitted.",
        "After a fall the person no longer balances, so there is nothing to fit. Leaving out "
        "trials that ended in a fall makes a person, or a group, look steadier than it is.",
        (
            "Report how many trials ended in a fall, in each group.",
            "To use the part before a fall, set stop in [recording] for that file and fit again.",
            "If nobody fell, the recording has a jump or a wrong unit: run impc inspect.",
        ),
    ),
    Kind(
        Level.GREEN,
        lambda it: facts.given_limit(it) is None,
        "A linear feedback explains this movement; no limit was given.",
        "You may report the gains. Nothing can be said about a limit of the command.",
        "Note: no limit of the command was given",
        "The model was fitted without a limit: it is the model of inverse LQR.",
        "Gains and cost weights are valid only if the person never reached a limit.",
        ("Set u_max in [fit] to find out whether a limit matters.",),
    ),
    Kind(
        Level.GREEN,
        lambda it: not it.met,
        "The controller explains this movement, but its limit was never reached.",
        "You may report the gains. Nothing can be said about the limit: the largest command was "
        "{largest}, with a limit of {limit}.",
        "Note: the limit was not reached",
        "The largest command in the model is {largest}. Models with and without the limit give the "
        "same movement here.",
        "Gains and cost weights are as valid as without a limit. The recordings show only that the "
        "limit is not below {largest}.",
        (
            "Do not report the limit as a finding, or that it matters.",
            "To study the limit, record again with a stronger perturbation: impc plan shows how "
            "strong.",
        ),
    ),
    Kind(
        Level.GREEN,
        always,
        "A controller with a limit of {limit} explains this movement.",
        "{held} limit is reached, and at least one gain (command per unit of tilt or velocity) is "
        "identified.",
    ),
)


def _allows(result: FitResult, what: str = "") -> bool:
    """Whether the model describes the recordings, and this result is not forbidden."""
    return not little(result) and what not in RULES.forbidden(result)


def _limit_matters(result: FitResult) -> bool:
    return _allows(result, SHARE) and result.met and facts.given_limit(result) is not None


_MAY: tuple[Line[FitResult], ...] = (
    Line(little, "That this model does not explain the movement.",
         "It explains {explained} in {where}."),
    Line(lambda it: _allows(it) and it.weights_test.rejected,
         "A linear feedback follows the movement.",
         "Its gain explains {gain_shares} of the variance; the nearest gain with cost weights "
         "explains {shares}."),
    Line(lambda it: _allows(it) and not it.weights_test.rejected, "The model follows the movement.",
         "{left_out}"),
    Line(_limit_matters, "{matters}",
         "The command is at its limit for {time} of the time.{without}"),
    Line(lambda it: _allows(it) and it.limit_found is not None and it.met,
         "The limit is {found} ({found_ends}).", "Estimated from the movement, not only assumed."),
    Line(lambda it: _allows(it, GAIN), "The gain on {known}, with intervals.", "{example}"),
    Line(lambda it: _allows(it, WEIGHTS) and facts.decided(it),
         "{comparisons} of cost, listed under Intent.",
         "Each holds for all cost weights that fit the recordings."),
    Line(lambda it: it.falls, "The number and times of the falls.", "{falls}."),
)  # fmt: skip


_MAY_NOT: tuple[Line[FitResult], ...] = (
    Line(lambda it: GAIN in RULES.forbidden(it), "Any gain.", "See the warning above."),
    Line(lambda it: GAIN not in RULES.forbidden(it) and _names(it, known=False),
         "The gain on {unknown}, by itself.", "It is not known to within half of its value."),
    Line(lambda it: WEIGHTS in RULES.forbidden(it), "Any cost weight, or comparison of costs.",
         "See the warning above."),
    Line(lambda it: WEIGHTS not in RULES.forbidden(it),
         "The matrix of cost weights, or one of its entries, as a property of the person.",
         "{free} numbers describe the cost. These recordings fix {rank}; a convention chooses the "
         "other {chosen}."),
    Line(lambda it: SHARE in RULES.forbidden(it) or facts.given_limit(it) is None or not it.met,
         "The time at the limit, or that the limit matters.", "{no_limit}"),
    Line(always, "That the person computes an optimal plan.",
         "Another rule that gives the same command would look the same."),
    Line(always, "Other tasks, people or perturbations.",
         "{trials} of one person in one condition."),
)  # fmt: skip

RULES: Rules[FitResult] = Rules(_WORDS, _KINDS, _MAY, _MAY_NOT)

#: Rules if every trial ended in a fall, so that nothing was fitted.
FALLEN = Rules[tuple[str, ...]](
    {"falls": "; ".join},
    (
        Kind(
            Level.RED,
            always,
            "The person fell in every trial.",
            "Nothing was fitted: after a fall the person no longer balances.",
            "No trial is long enough to fit",
            "{falls}.",
            "The recordings show that the task was too hard; they do not show how it was "
            "controlled.",
            (
                "Report the times of the falls; they are a result.",
                "For new recordings, use a weaker perturbation or a more stable seat: impc plan "
                "predicts the number of falls.",
                "If nobody fell, a recording has a jump or a wrong unit: run impc inspect.",
            ),
        ),
    ),
    (Line(always, "The number and times of the falls."),),
    (Line(always, "Gains, torque limit, cost weights.", "No controller was fitted."),),
)
