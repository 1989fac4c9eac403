"""The report of a fit: its sections, and what result.json has beside their findings.

    vaf.<output>, held_out_vaf.<output>      %, all trials; the mean of the trials left out
    states, controls, outputs, disturbances  names, in the order of every array below
    units.<signal>                           where the plant says them
    body                                     "nonlinear" where the plant's own equations moved, or
                                             "linear"
    solver                                   what solved the quadratic programs
    usable                                   whether half of every recorded signal is explained
    K                                        the gain that the recordings identify
    estimate                                 standard errors of K and of its directions, and which
                                             of them are identified
    Q, R, P, S, weights_gain                 the weights whose gain comes nearest, at R[0][0] = 1
    weights_rule                             which of all weights with that gain Q and R are
    weights_test                             whether any weights explain K: statistic, freedom,
                                             p_value, rejected, return_difference
    terminal_set, doubts                     of the fitted controller; sentences
    horizon, bounds                          as given
    lack_of_fit                              of the first fit and, where something was added, of the
                                             last: alarm, and errors with probability and size
    failures.<stage>                         why the stage has no result
    warnings                                 sentences
    ceiling                                  VAF that repeats with the perturbation, low, high, %
    intent                                   eigenvalues (ascending), dominant, sentence, weights
                                             of every rule
    structures                               weights and gain of each that was named
    person                                   of [fit.observer]: K, levels with intervals, models
                                             with log_likelihood and aic, whiteness, errors ahead
    identifiability                          rank, free, chosen, singular_values
    aim                                      targets, samples that they are known ahead, rates (1/s)
                                             of lasting disturbances, offsets (SI), commands
    trials                                   label, vaf, whiteness, x0, held_out_vaf, findings
    methods.<name>                           as in every result (docs/results.md)
    findings.<name>                          severity, sentences and table of each of the page
    truth                                    K of a truth.json beside the recordings, or null
    plant, settings, files, versions, made

Matrices are lists of rows, in SI units. What is not a number, or not determined, is null.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from impc.assess.intent_statements import dominant_sentence
from impc.control.named_solver import described
from impc.inverse.problem import aims
from impc.reporting.document import (
    Block,
    Details,
    Heading,
    Lines,
    Note,
    Report,
    Section,
    Terms,
    Verdict,
)
from impc.reporting.finding import Chart, Picture
from impc.reporting.shown_units import body_sentence, signal_words
from impc.studies.charts import methods_chart
from impc.studies.fit.aim import aim_data
from impc.studies.fit.figures import fit_figures
from impc.studies.fit.gain_findings import (
    direction_finding,
    gain_finding,
    limit_findings,
    parameter_findings,
    truth_finding,
)
from impc.studies.fit.result import shown_trials, trial_name
from impc.studies.fit.settings import plain_settings
from impc.studies.fit.structures import structure_data, structure_section
from impc.studies.fit.trial_findings import (
    RESIDUALS,
    agreement_finding,
    check_finding,
    command_findings,
    offset_findings,
    residual_findings,
    trajectory_finding,
)
from impc.studies.fit.verdict import abstract, remarks, verdict
from impc.studies.fit.weight_findings import reading_finding, statement_findings, weight_finding
from impc.studies.methods_table import column_terms, methods_data, methods_finding

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.reporting.provenance import Provenance
    from impc.studies.fit.result import FitResult

_LEFT = (
    "What the controller does not explain. A residual that is autocorrelated (a small p-value "
    "above, a curve outside the grey band) is the rule with people: they also move for reasons of "
    "their own. The intervals of the gain allow for that."
)
_METHODS = Picture(
    "methods",
    "Output and command of ten seconds under three methods",
    "The ten seconds in which the methods differ most. A method that leaves the dotted lines uses "
    "more than the subject has; one whose curve ends has fallen.",
)
_SAME_GAIN = (
    "Many weights have exactly the fitted gain, so the same behaviour under the same bounds. Which "
    "of them is reported is a convention. What holds for all of them may be said of the subject; "
    "what differs between them may not."
)


def fit_report(
    result: FitResult,
    provenance: Provenance,
    truth: Array | None = None,
    missing: str = "",
) -> Report:
    """Page, result.json, tables and figures; `truth` (m, n)."""
    subject = str(result.given.recordings[0].label.subject) or "a subject"
    others: list[Block] = [*residual_findings(result)]
    if missing:
        others.append(Note("Not given:", missing.removeprefix("Not given: ")))
    if truth is not None:
        others.append(truth_finding(result, truth))
    return Report(
        f"impc fit: {subject}",
        f"The controller behind the recordings of {subject}",
        [
            Verdict(verdict(result)),
            *others,
            Lines(abstract(result)),
            Details("What stands behind these sentences", (Lines(remarks(result)),)),
        ],
        _sections(result, provenance),
        figures=fit_figures(result),
        beside=[trajectory_finding(result)],
        data={**fit_data(result, provenance), "truth": None if truth is None else {"K": truth}},
        provenance=provenance,
        words=signal_words(result.given.plant),
    )


def _sections(result: FitResult, provenance: Provenance) -> list[Section]:
    """What a page has, in its order; a finding more is a line here."""
    weights: list[Block] = [_SAME_GAIN, *statement_findings(result)]
    methods: list[Block] = [
        _METHODS,
        methods_finding(result.methods),
        Details("What each column says", (column_terms(),)),
    ]
    every = [reading_finding(result), weight_finding(result)]
    return [
        Section("1. The gain, and how sure it is", _gain(result), "Gain", together=True),
        *([structure_section(result)] if result.structures else []),
        *([] if result.person is None else [result.person.section()]),
        Section("2. What may be said of the weights", weights, "Weights"),
        Section("3. Inverse LQR on the same recordings", methods, "Inverse LQR"),
        Section("4. Recorded and simulated", _trajectories(result), "Trajectories"),
        Section("5. What is left", (_LEFT, RESIDUALS), "What is left", folded=True),
        Section("6. All weights with this gain", every, "Intent", folded=True),
        Section("7. Checks of the recordings", (check_finding(result),), "Checks", folded=True),
        Section("8. Settings and versions", _made(result, provenance), "Settings", folded=True),
    ]


def _gain(result: FitResult) -> list[Block]:
    if not result.usable:
        return [verdict(result)]
    limits = limit_findings(result)
    found = [gain_finding(result), *parameter_findings(result), direction_finding(result)]
    found += [*offset_findings(result), *command_findings(result)]
    return [*found, *([Heading("Limit and horizon")] if limits else []), *limits]


def _trajectories(result: FitResult) -> list[Block]:
    shown, trials = shown_trials(result), len(result.given.recordings)
    blocks: list[Block] = [agreement_finding(result)]
    if len(shown) < trials:
        blocks.append(
            f"The {len(shown)} trials that are explained least, of {trials}; the table has all."
        )
    pictures = [
        Picture(
            f"trajectories-trial-{index + 1}",
            f"Recorded and simulated outputs, command and disturbance over time, "
            f"{trial_name(result, index)}",
            f"{trial_name(result, index)}. Grey: recorded. Dashed: simulated from the disturbance "
            "and targets alone. Dotted: bound of the command; shaded: where it is at the bound.",
        )
        for index in shown
    ]
    others = [Details("The other trials", pictures[1:])] if len(pictures) > 1 else []
    data = methods_chart(result.fitted.problem, result.methods[::-1], shown[0])
    return [*blocks, Chart(pictures[0], data), *others]


def _made(result: FitResult, provenance: Provenance) -> list[Block]:
    plant = result.fitted.problem.plant
    arguments = "; ".join(f"{key} = {value}" for key, value in provenance.plant_arguments.items())
    settings = "; ".join(
        f"{key} = {value}" for key, value in plain_settings(result.settings).items()
    )
    code = Markup("<code>{}</code>")
    moved = Markup("<code>{}</code>, sample time {} s, states {} <code>{}</code>").format(
        provenance.plant_name, plant.dt, ", ".join(plant.states), arguments
    )
    return [
        _terminal_set(result),
        code.format(provenance.command),
        Terms(
            [
                ("Made", (f"{provenance.made}, in {result.seconds:.1f} s",)),
                ("Plant", (moved,)),
                ("Settings", (code.format(settings),)),
                ("Body", (body_sentence(plant),)),
                (
                    "Quadratic programs",
                    (f"Solved by {described(result.fitted.problem.solver)}.",),
                ),
                ("Recordings", (", ".join(provenance.files),)),
                ("Versions", (provenance.all_versions,)),
            ]
        ),
    ]


def _terminal_set(result: FitResult) -> str:
    changed = result.terminal_set_difference
    within = bool(result.fitted.problem.terminal_set)
    present = "without" if within else "with"
    problem = result.fitted.problem
    if aims(problem.plant, problem.recordings):
        return "The fitted controller has no terminal set: what it regulates to moves."
    if np.isnan(changed):
        effect = "does not reach the end of every trial"
    else:
        effect = f"differs by {changed:.2g} of an output's size at most"
    ends = "ends in its terminal set" if within else "has no terminal set"
    return f"The fitted controller {ends}. The loop {present} it {effect}."


def fit_data(result: FitResult, provenance: Provenance) -> dict[str, Any]:
    """What result.json has beside the findings."""
    plant, found = result.fitted.problem.plant, result.identifiability
    return _controller(result) | {
        "estimate": _estimate(result),
        "warnings": result.warnings,
        "intent": _intent(result),
        "identifiability": {
            "rank": found.rank,
            "free": found.free,
            "chosen": found.chosen,
            "singular_values": found.singular_values,
        },
        "trials": [_trial(result, index) for index in range(len(result.trials))],
        "methods": methods_data(result.methods),
        "structures": structure_data(result),
        "aim": aim_data(result),
        "person": None if result.person is None else result.person.data(),
        "plant": {
            "name": provenance.plant_name,
            "arguments": dict(provenance.plant_arguments),
            **{name: getattr(plant, name) for name in ("A", "B", "E", "C", "dt")},
        },
        "settings": plain_settings(result.settings),
        "ceiling": None if result.ceiling is None else asdict(result.ceiling),
        "seconds": result.seconds,
    }


def _controller(result: FitResult) -> dict[str, Any]:
    plant, fitted = result.fitted.problem.plant, result.fitted
    weights, bounds = result.intent.reported.weights, result.given.bounds
    held = np.array([item.vaf for item in result.held_out])
    left_out = np.mean(held, axis=0) if len(held) else [None] * len(plant.outputs)
    return {
        "vaf": dict(zip(plant.outputs, result.inverse_mpc.vaf, strict=True)),
        "held_out_vaf": dict(zip(plant.outputs, left_out, strict=True)),
        **{name: getattr(plant, name) for name in ("states", "controls", "outputs")},
        "disturbances": plant.disturbances,
        "units": dict(plant.units),
        "usable": result.usable,
        "K": result.estimate.K,
        "S": fitted.metric * (weights.R[0, 0] / fitted.stage_weights.R[0, 0]),
        "Q": weights.Q,
        "R": weights.R,
        "weights_gain": fitted.gain,
        "weights_rule": result.intent.reported.rule,
        "P": result.reported_P,
        "weights_test": {**asdict(result.weights_test), "rejected": result.weights_test.rejected},
        "terminal_set": bool(fitted.problem.terminal_set),
        "doubts": fitted.doubts,
        "failures": dict(result.failures),
        "lack_of_fit": [None if one is None else asdict(one) for one in result.lack],
        "horizon": fitted.problem.horizon,
        "body": plant.moves,
        "solver": fitted.problem.solver,
        "bounds": {name: getattr(bounds, name) for name in ("x_min", "x_max", "u_min", "u_max")},
    }


def _intent(result: FitResult) -> dict[str, Any]:
    found, reported = result.intent, result.intent.reported
    return {
        "eigenvalues": reported.eigenvalues,
        "vectors": reported.vectors,
        "dominant": reported.dominant,
        "sentence": dominant_sentence(reported, result.fitted.problem.plant, np.array(found.sizes)),
        "widest_angle": result.widest_angle,
        "state_sizes": found.sizes,
        "readings": [
            {
                "rule": item.rule,
                "Q": item.weights.Q,
                "R": item.weights.R,
                "condition_number": item.condition,
                "dominant": item.dominant,
                "angle": item.angle,
            }
            for item in found.readings
        ],
    }


def _estimate(result: FitResult) -> dict[str, Any]:
    estimate, covariance = result.estimate, result.estimate.covariance
    return {
        "S": estimate.S,
        "misfit": estimate.misfit,
        "standard_errors": covariance.entries,
        "standard_errors_exact_body": None if estimate.exact is None else estimate.exact.entries,
        "identified": covariance.individually_identified,
        "singular_values": covariance.singular_values,
        "directions": covariance.directions,
        "direction_standard_errors": covariance.deviations,
        "identified_directions": covariance.identified,
        "natural_coordinates": covariance.T,
        "natural_inputs": covariance.G,
    }


def _trial(result: FitResult, index: int) -> dict[str, Any]:
    trial, found = result.given.recordings[index], result.trials[index]
    held = result.held_out[index] if result.held_out else None
    return {
        **asdict(trial.label),
        "samples": trial.samples,
        "missing": int(np.isnan(trial.outputs).any(axis=1).sum()),
        "findings": trial.findings,
        "vaf": found.vaf,
        "centred_vaf": found.centred_vaf,
        "whiteness": found.whiteness,
        "rms_residual": found.rms,
        "saturated": found.saturated,
        "x0": result.fitted.problem.recordings[index].x0,
        "held_out_vaf": None if held is None else held.vaf,
        "held_out_centred_vaf": None if held is None else held.centred_vaf,
    }
