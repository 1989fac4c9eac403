"""Verdict of a fit: findings that restrict the report, ordered by severity.

Each finding is one function that maps the result to a `Kind`, or None if it does not apply. The
page shows the headline of the first and an alert for each; results that they forbid are hidden.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.lack_of_fit import LIMIT, signal_of
from impc.reporting.finding import Level
from impc.reporting.rendering import number
from impc.reporting.shown_units import signal_name
from impc.reporting.verdict import Alert, Claim, Verdict
from impc.studies.fit.body_words import (
    alternative_reason,
    error_words,
    name_words,
    probability_words,
    remedy_words,
)
from impc.studies.fit.facts import (
    amount,
    decided,
    ends_words,
    enough_words,
    given_limit,
    held_out,
    lasting_or_first,
    left_out_text,
    limit_ends,
    named_gains,
    no_limit,
    saturation,
    shares_text,
    unlimited_ratio,
)
from impc.studies.fit.result import LITTLE

if TYPE_CHECKING:
    from impc.studies.fit.result import FitResult

# VAF (%) below which the residual is large; p of the whiteness test that rules out white noise.
_MUCH, _COLOURED = 90.0, 1e-3
# Recorded numbers below which the VAF of left-out trials is unreliable.
_SHORT = 200
#: Results that a kind may forbid: gains, cost weights, time at the limit.
GAIN, WEIGHTS, SHARE = "gain", "weights", "share"


@dataclass(frozen=True)
class Kind:
    """A finding that restricts what may be reported."""

    headline: str
    sentence: str
    alert: Alert
    forbids: frozenset[str]


def fit_kinds(result: FitResult) -> list[Kind]:
    """Findings that apply, worst first."""
    found = [kind(result) for kind in _KINDS]
    return [kind for kind in found if kind is not None]


def forbidden(result: FitResult) -> frozenset[str]:
    """Results that the page must not show."""
    return frozenset().union(*(kind.forbids for kind in fit_kinds(result)))


def fit_verdict(result: FitResult) -> Verdict:
    """The verdict of a fit."""
    kinds = fit_kinds(result)
    may, may_not = _may(result), _may_not(result)
    if kinds:
        red = [kind for kind in kinds if kind.alert.level is Level.RED]
        shown = red or kinds
        worst = shown[0]
        alerts = [kind.alert for kind in shown]
        return Verdict(worst.alert.level, worst.headline, worst.sentence, alerts, may, may_not)
    headline, sentence, note = _explained(result)
    return Verdict(Level.GREEN, headline, sentence, [note] if note else [], may, may_not)


def fallen_verdict(falls: tuple[str, ...]) -> Verdict:
    """Verdict if every trial ended in a fall, so that nothing was fitted."""
    alert = Alert(
        Level.RED,
        "No trial is long enough to fit",
        f"{'; '.join(falls)}.",
        "The recordings show that the task was too hard; they do not show how it was controlled.",
        (
            "Report the times of the falls; they are a result.",
            "For new recordings, use a weaker perturbation or a more stable seat: impc plan "
            "predicts the number of falls.",
            "If nobody fell, a recording has a jump or a wrong unit: run impc inspect.",
        ),
    )
    return Verdict(
        Level.RED,
        "The person fell in every trial.",
        "Nothing was fitted: after a fall the person no longer balances.",
        [alert],
        [Claim("The number and times of the falls.")],
        [Claim("Gains, torque limit, cost weights.", "No controller was fitted.")],
    )


def _explained(result: FitResult) -> tuple[str, str, Alert | None]:
    """Headline and sentence of a green verdict, and a note if no limit was reached."""
    limit = given_limit(result)
    if limit is None:
        note = Alert(
            Level.NOTE,
            "Note: no limit of the command was given",
            "The model was fitted without a limit: it is the model of inverse LQR.",
            "Gains and cost weights are valid only if the person never reached a limit.",
            ("Set u_max in [fit] to find out whether a limit matters.",),
        )
        return (
            "A linear feedback explains this movement; no limit was given.",
            "You may report the gains. Nothing can be said about a limit of the command.",
            note,
        )
    if not result.met:
        largest = amount(result, result.inverse_mpc.largest_input)
        note = Alert(
            Level.NOTE,
            "Note: the limit was not reached",
            f"The largest command in the model is {largest}. Models with and without the limit "
            "give the same movement here.",
            "Gains and cost weights are as valid as without a limit. The recordings show only that "
            f"the limit is not below {largest}.",
            (
                "Do not report the limit as a finding, or that it matters.",
                "To study the limit, record again with a stronger perturbation: impc plan shows "
                "how strong.",
            ),
        )
        return (
            "The controller explains this movement, but its limit was never reached.",
            f"You may report the gains. Nothing can be said about the limit: the largest command "
            f"was {largest}, with a limit of {limit}.",
            note,
        )
    held = "It predicts trials it was not fitted to, a" if result.held_out else "A"
    return (
        f"A controller with a limit of {limit} explains this movement.",
        f"{held} limit is reached, and at least one gain (command per unit of tilt or velocity) is "
        "identified.",
        None,
    )


def _little(result: FitResult) -> Kind | None:
    outputs, held = result.given.plant.outputs, held_out(result)
    shares = held if held is not None and result.usable else result.inverse_mpc.vaf
    if result.usable and not np.any(shares < LITTLE):
        return None
    if result.weights_test.rejected and result.gain_vaf > LITTLE:
        return None  # the gain explains the movement, only its nearest weights do not
    short = result.given.recorded_numbers < _SHORT
    if result.usable and short and _weak(result) is not None:
        return None  # uncertain gains predict short trials badly even if the model is right
    said = " and ".join(
        f"{value:.0f} % of the {signal_name(result.given.plant, name)}"
        if np.isfinite(value)
        else f"an unknown part of the {signal_name(result.given.plant, name)} (the simulation "
        "stops early)"
        for name, value in zip(outputs, shares, strict=True)
    )
    where = "left-out trials" if result.usable else "the recordings"
    alert = Alert(
        Level.RED,
        "The model does not describe these recordings",
        f"In {where} it explains {said}. If a model suits the recordings, values above 90 % are "
        "typical.",
        "Gains and cost weights come from a poor fit and do not describe the person. They are kept "
        "under details for troubleshooting only.",
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
    )
    return Kind(
        "The model explains less than half of a recorded signal.",
        f"It explains {said} in {where}. Do not interpret the other numbers on this page.",
        alert,
        frozenset([GAIN, WEIGHTS, SHARE]),
    )


def _unfinished(result: FitResult) -> Kind | None:
    if result.fitted.converged:
        return None
    alert = Alert(
        Level.AMBER,
        "The search stopped before it converged",
        f"{result.fitted.status.sentence}",
        "A better fit with other gains may exist.",
        (
            "Fit longer or less noisy recordings.",
            "Fit fewer unknowns: remove names from free in [fit].",
        ),
    )
    return Kind(
        "The model follows the movement, but the search did not converge.",
        "Gains and cost weights may still change: do not report them.",
        alert,
        frozenset([GAIN, WEIGHTS]),
    )


def _limit(result: FitResult) -> Kind | None:
    limit, estimated = given_limit(result), result.limit_found
    if limit is None or estimated is None or not estimated.disagrees:
        return None
    unit = estimated.unit
    value = f"{number(estimated.value)} {unit}"
    ends = limit_ends(estimated)
    refitted = result.added is not None and result.added.name == LIMIT
    culprit = result.culprit is not None
    of_what = (
        f"The gains on this page are those of a fit with {value}."
        if refitted and not culprit
        else "With a wrong limit, gains may be several times too small or too large, and their "
        "intervals do not show this."
    )
    alert = Alert(
        Level.AMBER,
        "The limit does not agree with the recordings",
        f"It was given as {limit}. Fitted together with the gain it is {value} ({ends}).",
        f"{of_what} A high percentage of explained variance does not exclude this error.",
        (
            f"Set u_max = {number(estimated.value)} if the person can produce no more, and fit "
            "again.",
            "If a warning remains, allow for noise in muscles and senses: add [fit.observer].",
            "If it still remains, check body mass, height and the model of the body.",
        ),
    )
    return Kind(
        f"The model follows the movement, but a limit of {limit} is probably wrong.",
        f"The recordings agree better with a limit of {value}. Until this is resolved, do not "
        "report gains or cost weights from this page.",
        alert,
        frozenset([GAIN, WEIGHTS, SHARE]),
    )


def _observer(result: FitResult) -> Kind | None:
    if result.person is None or not result.person.preferred:
        return None
    alert = Alert(
        Level.AMBER,
        "The person seems to react to noise",
        "By AIC, the model with noise in senses or muscles explains the recordings better than all "
        "other models that were compared, or about as well.",
        "Gains of the model without this noise may be wrong by half of their value.",
        ("Report the gains of the section on noise in the loop, with their intervals.",),
    )
    return Kind(
        "The model follows the movement, and the person seems to react to noise.",
        "Report the gains of the section on noise in the loop, not those of the model without it.",
        alert,
        frozenset([GAIN, WEIGHTS]),
    )


def _body(result: FitResult) -> Kind | None:
    error = result.culprit
    if error is None or _limit(result) is not None:  # a wrong limit has the same effects
        return None
    reason, of_limit = alternative_reason(result, error), error.name == LIMIT
    of_signal = signal_of(error.name) is not None
    added = result.added
    tried = f", also with {name_words(result.given.plant, added.name)}" if added else ""
    most = "the most that the person can produce, or state its uncertainty in [plant.uncertainty]"
    alert = Alert(
        Level.AMBER,
        "The residual depends on the perturbation",
        f"Part of the residual follows the perturbation, unlike measurement noise{tried}. The "
        f"likeliest of the tested errors is {error_words(result, error)} "
        f"({probability_words(error)}).{reason}",
        "The gains compensate for part of the error. Their intervals do not include it; the true "
        "uncertainty may be several times larger.",
        (
            *(("Add [fit.observer] to the settings and fit again.",) if reason else ()),
            *((f"Set u_max to {most}, and fit again.",) if of_limit else ()),
            *(("Check units, zeros and clocks of the recording devices.",) if of_signal else ()),
            "Check body mass, height and sex in the settings, and the dimensions of the device.",
            "State how well they are known in [plant.uncertainty], or fit a doubtful one with "
            "free = [...], and report how much the gains change.",
            "For group comparisons, use the same model for everyone: much of the error then "
            "cancels.",
        ),
    )
    seems = (
        "a recorded signal seems to be wrong" if of_signal else "the body model seems to be inexact"
    )
    what = "the person may react to noise" if reason else seems
    headline = f"The model follows the movement, but {what}."
    return Kind(
        headline,
        "Part of the residual follows the perturbation. The error of the gains may be larger than "
        "their intervals show, so do not report them yet.",
        alert,
        frozenset([GAIN, WEIGHTS, SHARE] if of_limit else [GAIN, WEIGHTS]),
    )


def _corrected(result: FitResult) -> Kind | None:
    """An error of a signal, other than its timing, that the second fit removed."""
    added = result.added
    signal = None if added is None else signal_of(added.name)
    if added is None or signal is None or signal[0] == "shift" or result.culprit is not None:
        return None
    words = name_words(result.given.plant, added.name)
    alert = Alert(
        Level.AMBER,
        "A recorded signal seems to be wrong",
        f"With {words}, the model explains the recordings.",
        "The gains on this page are those with this error removed. If the error has another cause, "
        "they may be wrong.",
        (
            remedy_words(result, added),
            "Then fit again.",
        ),
    )
    return Kind(
        "The model follows the movement after a correction of a recorded signal.",
        f"The recordings point to {words}. Correct it, and fit again.",
        alert,
        frozenset(),
    )


def _noise(result: FitResult) -> Kind | None:
    """A large residual that is not white: noise in the loop may have caused it."""
    least = float(np.min(result.inverse_mpc.vaf))
    coloured = all(np.nanmin(one.whiteness) < _COLOURED for one in result.trials)
    if least > _MUCH or not coloured or result.person is not None or result.weights_test.rejected:
        return None
    alert = Alert(
        Level.AMBER,
        "Much of the movement is not explained, and the residual is not white noise",
        f"The model explains {shares_text(result)}. The residual is autocorrelated, as movement is "
        "and white measurement noise is not.",
        "Measurement noise does not bias the gains, because the person does not react to it. Noise "
        "in muscles or senses does: if the person reacts to it at the limit, or if it causes much "
        "of the movement, gains may be wrong by half of their value.",
        (
            "Add [fit.observer] to the settings and fit again; expect about half an hour.",
            "Report the gains of that fit, with its intervals, if its checks pass.",
            "For new recordings, use a stronger perturbation: the reaction to noise is then a "
            "smaller part of the movement.",
        ),
    )
    return Kind(
        "The model follows part of the movement; the person may react to noise.",
        "The reaction to noise in muscles or senses is probably part of the movement. Do not "
        "report gains of a model without this noise yet.",
        alert,
        frozenset([GAIN, WEIGHTS]),
    )


def _no_weights(result: FitResult) -> Kind | None:
    if not result.weights_test.rejected:
        return None
    alert = Alert(
        Level.AMBER,
        "No cost weights lead to this gain",
        result.weights_test.sentence,
        "Either the person does not minimise a cost of this form, or an error in the body model, "
        "the delay or the limit has shifted the gain.",
        (
            "Report the gain with its intervals; leave out cost weights and intent.",
            "Fit uncertain parameters of the model too (free in [fit]), and check whether the "
            "conflict remains.",
            "Do not enter a similar gain by hand to obtain weights: they would not describe this "
            "person.",
        ),
    )
    return Kind(
        "The gain is identified, but no cost weights explain it.",
        "The recordings reject all quadratic costs of this form (p < 0.001). You may report the "
        "gain; you may not infer intent.",
        alert,
        frozenset([WEIGHTS]),
    )


def _fell(result: FitResult) -> Kind | None:
    if not result.falls:
        return None
    used, count = len(result.trials), len(result.trials) + len(result.falls)
    one = len(result.falls) == 1
    alert = Alert(
        Level.AMBER,
        "One trial ended in a fall" if one else f"{len(result.falls)} trials ended in a fall",
        f"{'; '.join(result.falls)}. The other trials were fitted.",
        "After a fall the person no longer balances, so there is nothing to fit. Leaving out "
        "trials that ended in a fall makes a person, or a group, look steadier than it is.",
        (
            "Report how many trials ended in a fall, in each group.",
            "To use the part before a fall, set stop in [recording] for that file and fit again.",
            "If nobody fell, the recording has a jump or a wrong unit: run impc inspect.",
        ),
    )
    return Kind(
        f"The model explains {used} of {count} trials; in the other{'' if one else 's'} the person "
        "fell.",
        "The results below come from the trials without a fall.",
        alert,
        frozenset(),
    )


def _weak(result: FitResult) -> Kind | None:
    gains = named_gains(result)
    if any(row.determined for _, row in gains):
        return None
    alert = Alert(
        Level.AMBER,
        "The recordings are too short, or the perturbation is too weak",
        f"None of the {len(gains)} gains is known to within half of its value."
        f"{ends_words(result)} Combinations of gains may be identified; they are listed under "
        "details.",
        "The model is not contradicted, but many controllers would have moved in this way.",
        (
            f"Record more{enough_words(result)}, or use a stronger or faster perturbation: impc "
            "plan shows how many intervals would become narrow enough.",
            "Compare groups by the combinations that are identified, or by measures of movement.",
        ),
    )
    return Kind(
        "The model explains the movement, but the recordings do not determine its gains.",
        "Very different gains produce nearly the same movement. You may report the explained "
        "variance, but no single gain.",
        alert,
        frozenset([GAIN, WEIGHTS]),
    )


def _structure(result: FitResult) -> Kind | None:
    if not result.structures or not result.structures[0].refused:
        return None
    name = result.structures[0].structure.name
    alert = Alert(
        Level.AMBER,
        f"The recordings reject the structure “{name}”",
        "Gains outside the structure explain the recordings better than its cost weights.",
        "The cost weights within this structure do not describe the person.",
        ("Report the gain without the structure, or try another structure.",),
    )
    return Kind(
        f"The gain is identified, but the structure “{name}” does not explain it.",
        "Do not report cost weights within this structure.",
        alert,
        frozenset([WEIGHTS]),
    )


_KINDS: tuple[Callable[[FitResult], Kind | None], ...] = (
    _little,
    _limit,
    _unfinished,
    _corrected,
    _observer,
    _body,
    _noise,
    _no_weights,
    _structure,
    _weak,
    _fell,
)


def _may(result: FitResult) -> list[Claim]:
    """Statements that may be reported, with their numbers."""
    no = forbidden(result)
    if _little(result) is not None:
        return [Claim("That this model does not explain the movement.",
                      f"It explains {shares_text(result)}.")]  # fmt: skip
    if result.weights_test.rejected:
        claims = [Claim("A linear feedback follows the movement.",
                        f"Its gain explains {result.gain_vaf:.1f} % of the variance, the nearest "
                        f"gain with cost weights {shares_text(result)}.")]  # fmt: skip
    else:
        claims = [Claim("The model follows the movement.", left_out_text(result))]
    limit = given_limit(result)
    if result.met and limit is not None and SHARE not in no:
        without = unlimited_ratio(result)
        claims.append(Claim("The limit matters." if without else "The limit is reached.",
                            f"The command is at its limit for {saturation(result):.1f} % of the "
                            f"time.{without}"))  # fmt: skip
    found = result.limit_found
    if found is not None:
        ends = f"({limit_ends(found)})"
        claims.append(
            Claim(f"The limit is {number(found.value)} {found.unit} {ends}.",
                  "Estimated from the movement, not only assumed.")
        )  # fmt: skip
    if GAIN not in no:
        known = [name for name, row in named_gains(result) if row.determined]
        claims.append(
            Claim(f"The gain on {', '.join(dict.fromkeys(known))}, with intervals.",
                  lasting_or_first(result))
        )  # fmt: skip
    count = len(decided(result))
    if WEIGHTS not in no and count:
        many = "One comparison" if count == 1 else f"{count} comparisons"
        claims.append(Claim(f"{many} of cost, listed under Intent.",
                            "They hold for all cost weights that fit the recordings."))  # fmt: skip
    if result.falls:
        claims.append(Claim("The number and times of the falls.", "; ".join(result.falls) + "."))
    return claims


def _may_not(result: FitResult) -> list[Claim]:
    no, found = forbidden(result), result.identifiability
    count = "1 trial" if len(result.trials) == 1 else f"{len(result.trials)} trials"
    claims = []
    if GAIN in no:
        claims.append(Claim("Any gain.", "See the warning above."))
    else:
        unknown = [name for name, row in named_gains(result) if not row.determined]
        if unknown:
            claims.append(
                Claim(f"The gain on {', '.join(dict.fromkeys(unknown))}, by itself.",
                      "It is not known to within half of its value.")
            )  # fmt: skip
    if WEIGHTS in no:
        claims.append(Claim("Any cost weight, or comparison of costs.", "See the warning above."))
    else:
        claims += [
            Claim("The matrix of cost weights, or one of its entries, as a property of the person.",
                  f"{found.chosen} of its {found.free} dimensions are set by convention.")
        ]  # fmt: skip
    if SHARE in no or given_limit(result) is None or not result.met:
        claims.append(Claim("The time at the limit, or that the limit matters.", no_limit(result)))
    claims += [
        Claim("That the person computes an optimal plan.",
              "Any controller with the same commands moves identically."),
        Claim("Other tasks, people or perturbations.",
              f"{count} of one person in one condition."),
    ]  # fmt: skip
    return claims
