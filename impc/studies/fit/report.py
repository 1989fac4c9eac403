"""Report of a fit: sections, figures, checks, and text for a paper."""

from __future__ import annotations

import functools

import numpy as np
from markupsafe import Markup

from impc.arrays import Array
from impc.assess.lack_of_fit import LIMIT
from impc.assess.printed_gain import LastingResponse, lasting_responses
from impc.checking import replace
from impc.inverse.minimiser import Ended
from impc.levels import Level
from impc.reporting.document import (
    Block,
    Check,
    Checks,
    Draw,
    Fold,
    Lines,
    Quiet,
    Report,
    Section,
    Terms,
)
from impc.reporting.exchange import long_finding
from impc.reporting.finding import Chart, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import fixed, number, probability
from impc.reporting.shown_units import shown_unit, signal_name
from impc.reporting.verdict import Key
from impc.studies.charts import trajectories
from impc.studies.fit import facts, figures, findings
from impc.studies.fit.body_words import (
    added_sentence,
    body_sentence_of,
    lack_finding,
    parameter_words,
)
from impc.studies.fit.data import fit_data
from impc.studies.fit.movement import movement_section
from impc.studies.fit.paper import paper_text
from impc.studies.fit.result import FitResult, shown_trials, trial_name
from impc.studies.fit.settings import plain_settings
from impc.studies.fit.structures import structure_section
from impc.studies.fit.verdict import FALLEN, GAIN, RULES, SHARE, WEIGHTS, little
from impc.studies.methods_figure import explained, methods_figure
from impc.studies.methods_table import methods_finding, provenance_section

_HIDDEN = "Not shown as a result, because of the warning above."


def fit_report(
    result: FitResult, provenance: Provenance, truth: Array | None = None, missing: str = ""
) -> Report:
    """Report of a fit; `truth` (m, n) is the gain of a simulated subject."""
    verdict, subject = RULES.verdict(result), str(result.given.recordings[0].label.subject)
    trials, dt = result.given.recordings, result.given.plant.dt
    seconds = sum(trial.samples for trial in trials) * dt
    count = "1 trial" if len(trials) == 1 else f"{len(trials)} trials"
    meta = [subject, *(["simulated"] if truth is not None else []), f"{count}, {seconds:.3g} s"]
    window = shown_trials(result)[0]
    meta = list(dict.fromkeys(meta))
    return Report(
        f"Fit report: {subject}" if subject else "Fit report",
        "fit report",
        verdict,
        _sections(result, provenance, truth, missing),
        [part for part in (*meta, provenance.made[:10]) if part],
        _hero(result, window),
        _keys(result),
        _draws(result, window),
        paper_text(result, verdict, provenance),
        beside=[
            findings.trajectory_finding(result),
            *findings.response_findings(result),
            long_finding(findings.result_long(result)),
        ],
        data={**fit_data(result, provenance), "truth": None if truth is None else {"K": truth}},
        provenance=provenance,
    )


def fallen_report(falls: tuple[str, ...], provenance: Provenance) -> Report:
    """Report for a subject who fell in every trial."""
    verdict = FALLEN.verdict(falls)
    made = Section("Provenance", [Terms(provenance.terms)])
    sections = [Section("Falls", [Lines(falls)]), made]
    words = dict.fromkeys(("headline", "reason"), verdict.headline)
    row = {"trials": 0, "verdict": verdict.level.value, **words}
    data = {"falls": falls, "summary": row}
    return Report("Fit report", "fit report", verdict, sections, data=data, provenance=provenance)


def _hero(result: FitResult, index: int) -> Picture:
    plant, run = result.fitted.problem.plant, result.inverse_mpc.runs[index]
    trial = result.fitted.problem.recordings[index]
    factor, unit = shown_unit(plant, plant.outputs[0])
    left = factor * (trial.corrected - run.x @ plant.C.T)[:, 0]
    said = facts.with_unit(number(float(np.sqrt(np.nanmean(left**2))), 2), unit)
    limit = "; orange: at the limit" if facts.given_limit(result) else ""
    name = trial_name(result, index)
    return Picture(
        "movement",
        f"Recorded and modelled outputs, and the command within its limit, in {name}",
        f"Part of {name.replace('Trial ', 'trial ')}. Grey: recorded; blue: model{limit}. In the "
        f"whole trial they differ by {said} (RMS, {signal_name(plant, plant.outputs[0])}).",
    )


def _keys(result: FitResult) -> list[Key]:
    plant, held = result.given.plant, facts.held_out(result)
    vaf = explained(result.inverse_mpc)
    names = [signal_name(plant, name) for name in plant.outputs]
    others = "; ".join(
        f"{name} {value:.2f} %" for name, value in zip(names[1:], vaf[1:], strict=True)
    )
    where = "left-out trials" if held is not None else "fitted trials"
    keys = [
        Key(f"{vaf[0]:.2f}", "%", "of the variance explained",
            f"{names[0]}, {where}{'; ' + others if others else ''}")
    ]  # fmt: skip
    if SHARE in RULES.forbidden(result) and result.limit_found is not None:
        found = result.limit_found
        keys.append(
            Key(number(found.value), f"{found.unit}, not {number(found.given)}",
                "limit that fits best", facts.limit_ends(found))
        )  # fmt: skip
    elif facts.given_limit(result) and result.met:
        each = [100 * one.saturated for one in result.trials]
        keys.append(
            Key(f"{100 * result.saturated:.1f}", "% of the time", "at the limit",
                f"{min(each):.1f} to {max(each):.1f} % in single trials")
        )  # fmt: skip
    else:
        largest = facts.amount(result, result.inverse_mpc.largest_input)
        value, _, unit = largest.partition(" ")
        limit = facts.given_limit(result)
        keys.append(
            Key(value, unit, "largest command in the model",
                f"with a limit of {limit}" if limit else "no limit was given")
        )  # fmt: skip
    row, gains = facts.first_gain(result), facts.named_gains(result)
    if row is None or GAIN in RULES.forbidden(result):
        known = 0 if GAIN in RULES.forbidden(result) else sum(row.determined for _, row in gains)
        keys.append(Key(str(known), f"of {len(gains)}", "gains to report", "see the warning"))
    else:
        unit = row.unit if row.unit == "-" else f"{row.unit} per {row.per[1:].partition(' of ')[0]}"
        keys.append(
            Key(number(row.value), unit.replace("per  ", "per "), f"opposing command, {row.state}",
                f"95 % CI {row.ends}")
        )  # fmt: skip
    return keys


def _draws(result: FitResult, window: int) -> dict[str, Draw]:
    """Functions that draw the figures of the page."""
    found: dict[str, Draw] = {
        "movement": functools.partial(figures.movement_figure, result.inverse_mpc, window),
        "methods": functools.partial(methods_figure, result.methods[::-1]),
        "residuals": functools.partial(figures.residual_figure, result.inverse_mpc),
    }
    if result.response is not None:
        response = functools.partial(figures.frequency_figure, result, result.response)
        found["frequency-response"] = response
    if result.compared and WEIGHTS not in RULES.forbidden(result):
        found["statements"] = functools.partial(figures.statements_figure, result)
    return found


def _sections(
    result: FitResult, provenance: Provenance, truth: Array | None, missing: str
) -> list[Section]:
    """Sections of the page; add a line here for a new section."""
    no = RULES.forbidden(result)
    return [
        Section("Feedback gain", _gain(result, GAIN in no)),
        *([] if result.person is None else [result.person.section()]),
        Section("Does the limit matter?", _limit(result, SHARE in no), "Limit"),
        *movement_section(result),
        *([structure_section(result)] if result.structures else []),
        Section("Intent: what the cost weights say", _intent(result, WEIGHTS in no), "Intent"),
        *([Section("Frequency response", _response(result))] if result.response else []),
        Section("Checks", _checks(result, truth)),
        _made(result, provenance, missing),
    ]


def _gain(result: FitResult, hidden: bool) -> list[Block]:
    if not result.preferred:
        return [Quiet(_HIDDEN)]
    tables = [
        findings.gain_finding(result),
        findings.direction_finding(result),
        *findings.parameter_findings(result),
    ]
    if hidden:
        return [
            *facts.aim_sentences(result),
            Quiet(f"{_HIDDEN} The numbers below are for troubleshooting only."),
            Fold("Gains (do not report)", [findings.per_unit_finding(result), *tables]),
            *findings.error_findings(result),
        ]
    lasting = [_lasting(result, one) for one in lasting_responses(result.estimate)]
    return [
        "A gain is the opposing command per unit of a deviation, as long as the limit is not "
        f"reached. {body_sentence_of(result)}",
        *filter(None, lasting),
        *facts.aim_sentences(result),
        *([added_sentence(result)] if result.added else []),
        *facts.shift_words(result),
        findings.per_unit_finding(result),
        Fold(
            "All gains in SI units, combinations and parameters",
            [*tables, *filter(None, [parameter_words(result)])],
        ),
        *findings.error_findings(result),
    ]


def _lasting(result: FitResult, found: LastingResponse) -> str:
    """What is answered to a quick and to a lasting deviation, in words; empty if unknown."""
    plant = result.given.plant
    (factor, unit), (scale, of) = (shown_unit(plant, one) for one in (found.state, found.control))
    value, low, high = (scale / factor * one for one in (found.value, found.low, found.high))
    words, quick = (
        signal_name(plant, found.state),
        result.preferred.get(f"K.{found.control}.{found.state}"),
    )
    if not found.identified or quick is None or quick.value is None:
        return ""
    at_once = scale / factor * quick.value
    change = "part of it is taken back, and" if abs(value) < abs(at_once) else "more is added, and"
    gravity = dict(plant.gravity).get(found.state)
    times = f", {number(found.value / gravity, 2)} times m g h" if gravity else ""
    return (
        f"A quick {words} of {facts.with_unit('1', unit)} is answered with {fixed(at_once)} {of}. "
        f"If it lasts, {change} {fixed(value)} {of} remain "
        f"(95 % CI {facts.between(low, high)}){times}."
    )


def _limit(result: FitResult, doubtful: bool) -> list[Block]:
    ratio, without = facts.unlimited_ratio(result)
    if facts.given_limit(result) is None or not result.met or doubtful:
        said = facts.no_limit(result)
    elif ratio >= facts.MATTERS:
        said = f"Yes. The same recordings were fitted with and without a limit.{without}"
    else:
        said = f"Not measurably.{without}"
    methods: Block = Picture(
        "methods",
        "Variance not explained, and largest command, of every method",
        "Left: further left is better (logarithmic axis). Right: shading marks commands beyond the "
        "limit. Inverse LQR is the classical method.",
    )
    return [
        said,
        methods,
        *findings.alternative_findings(result),
        Fold("All methods in numbers", [methods_finding(result.methods[::-1])]),
    ]


def _intent(result: FitResult, hidden: bool) -> list[Block]:
    if hidden:
        return [
            Quiet("No comparison of costs is made, because of the warning above."),
            Fold("Cost weights (do not report)", [findings.weight_finding(result)]),
        ]
    plant, summary, made = result.given.plant, result.uncertainty.weights, facts.decided(result)
    tables = findings.weight_findings(result)
    if summary is None:
        return [Quiet(f"Not available: {result.uncertainty.weights_reason}"), *tables]
    drawn = (
        f" We tried {summary.drawn} other gains that fit these recordings as well. Each statement "
        f"held for at least {summary.drawn - 1}."
        if summary.drawn and made
        else ""
    )
    count = f"{len(made)} of {len(summary.statements)} comparisons"
    return [
        "Many cost weights lead to exactly this movement. Only statements that hold for all of "
        f"them describe the person: {count}, at the 95 % level.{drawn}",
        *([Lines([facts.statement_text(plant, item) for item in made])] if made else []),
        *([_STATEMENTS] if summary.statements else []),
        Fold("Cost weights by convention, and their ranges", tables),
    ]


_STATEMENTS = Picture(
    "statements",
    "Ranges of the differences in cost over all weights with the fitted gain",
    "Each bar is the range of one difference in cost over all weights with the fitted gain. Blue: "
    "on one side of zero, also for other gains that the recordings allow. Grey: undecided.",
)


def _response(result: FitResult) -> list[Block]:
    found, plant = result.response, result.given.plant
    assert found is not None
    known = found.coherence > found.threshold[:, None]
    share = 100 * float(np.mean(known))
    return [
        f"Response of the movement to the {signal_name(plant, found.signal)}, estimated in the "
        "same way from recording and model. Points whose coherence could be due to chance are left "
        f"out ({share:.0f} % are shown).",
        Picture(
            "frequency-response",
            "Magnitude, phase and coherence of the response to the perturbation",
            "Grey: recorded, with 95 % intervals; blue: model. Lower panel: coherence of the "
            "recording; dashed: level that chance alone reaches.",
        ),
    ]


def _checks(result: FitResult, truth: Array | None) -> list[Block]:
    checks = [
        _recordings(result),
        Check(Level.RED if little(result) else Level.GREEN, "Explained variance",
              facts.left_out_text(result)),
        _limit_check(result),
        _model(result),
        Check(Level.AMBER if result.weights_test.rejected else Level.GREEN, "Cost weights",
              f"{'No' if result.weights_test.rejected else 'At least one'} cost explains this "
              "gain."),
        *_others(result),
    ]  # fmt: skip
    if truth is not None:
        right, said = findings.truth_found(result, truth)
        checks.append(Check(Level.NOTE if right else Level.AMBER, "Known truth", said))
    residuals = Picture(
        "residuals",
        "Residuals of the first output and their autocorrelation",
        "Blue: first trial; grey: others. Shaded: expected for uncorrelated noise.",
    )
    names = {index: trial_name(result, index) for index in shown_trials(result)}
    chart = Chart("Trials", trajectories(result.fitted.problem, result.methods[::-1], names))
    return [
        Checks(checks),
        residuals,
        Fold("Every trial in numbers", [findings.agreement_finding(result)]),
        Fold("Every trial, to explore", [chart]),
        *([] if result.lack[-1] is None else [lack_finding(result.given.plant, result.lack[-1])]),
    ]


def _recordings(result: FitResult) -> Check:
    said = [
        f"{trial_name(result, index)}: {line}"
        for index, trial in enumerate(result.given.recordings)
        for line in trial.findings
    ]
    if result.falls:
        return Check(Level.AMBER, "Recordings", "; ".join([*result.falls, *said]))
    used = f"{len(result.trials)} of {len(result.trials)} trials used"
    if said:
        return Check(Level.NOTE, "Recordings", f"{used}; {'; '.join(said)}")
    return Check(Level.GREEN, "Recordings", f"{used}; no gaps, jumps or unit problems; no fall.")


def _limit_check(result: FitResult) -> Check:
    limit, found, last = facts.given_limit(result), result.limit_found, result.lack[-1]
    level, said = Level.NOTE, f"Given as {limit}; it was not tested."
    if limit is None or not result.met:
        said = facts.no_limit(result)
    elif found is not None:
        level = Level.AMBER if found.disagrees else Level.GREEN
        ends = f"{number(found.value)} {found.unit} ({facts.limit_ends(found)})"
        said = f"Given as {limit}; the recordings point to {ends}."
    elif last is not None:
        tested = [one for one in last.errors if one.name == LIMIT]
        if result.culprit is not None and result.culprit.name == LIMIT:
            level, said = Level.AMBER, "The residual points to another limit."
        elif tested and not last.alarm:
            p = probability(tested[0].probability)
            level = Level.GREEN
            said = f"Given as {limit}; the residual points to no other ({p})."
    return Check(level, "Limit", said)


def _model(result: FitResult) -> Check:
    last, level = result.lack[-1], Level.AMBER
    if last is None:
        said = "Not tested: the recordings are too short, exact, or have gaps. Gains may be wrong."
    elif last.alarm:
        said = "Part of the residual follows the perturbation; see the warning."
    else:
        level, least = Level.GREEN, min((one.probability for one in last.errors), default=1.0)
        said = f"{len(last.errors)} tests found no model error (smallest {probability(least)})."
    return Check(level, "Body model", said)


def _others(result: FitResult) -> list[Check]:
    """Notes: residuals, repeatable variance, doubts of the search, failed stages."""
    white = min(float(np.nanmin(one.whiteness)) for one in result.trials)
    coloured = "Autocorrelated" if white < 0.05 else "Not autocorrelated"
    found = [
        Check(Level.NOTE, "Residuals",
              f"{coloured} ({probability(white)}). Intervals allow for autocorrelation.")
    ]  # fmt: skip
    if result.ceiling is not None:
        one = result.ceiling
        found.append(
            Check(Level.NOTE, "Repeatable movement",
                  f"{facts.shares(result, one.vaf, 1)} of the variance repeats with the "
                  f"perturbation ({one.repetitions} repetitions): a model without noise cannot "
                  "explain more.")
        )  # fmt: skip
    doubts, gain = list(result.fitted.doubts), result.estimate
    if result.fitted.fit.unconfirmed and gain.ended in (Ended.STUCK, Ended.STOPPED):
        doubts.append(
            "The search for the gain did not end at a minimum, and no search from another start "
            "confirmed the gain: a better one may exist."
        )
    found += [Check(Level.NOTE, "Search", doubt) for doubt in doubts]
    for stage, reason in result.failures.items():
        found.append(Check(Level.NOTE, f"Not available: {stage}", reason))
    return found


def _made(result: FitResult, provenance: Provenance, missing: str) -> Section:
    found, problem = provenance_section(result.fitted.problem, provenance), result.fitted.problem
    code, plain = Markup("<code>{}</code>"), plain_settings(result.settings)
    how = [
        ("Terminal set", "yes" if problem.terminal_set else "no"),
        ("Time of the fit", f"{result.seconds:.1f} s"),
        *((name, code.format(value)) for name, value in plain.items()),
    ]
    first = [Terms([("Not given", missing.removeprefix("Not given: "))])] if missing else []
    fold = Fold("All settings", [Terms(how)])
    return replace(found, blocks=[*first, *found.blocks, fold])
