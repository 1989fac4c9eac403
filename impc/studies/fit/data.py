"""Content of a fit's result.json in addition to verdict and findings.

    vaf.<output>, held_out_vaf.<output>      VAF of all trials; mean VAF of left-out trials, %
    states, controls, outputs, disturbances  names, in the order of all arrays below
    units.<signal>                           units, if the plant states them
    body                                     "nonlinear" or "linear"
    solver                                   solver of the quadratic programs
    usable                                   whether the VAF of every recorded signal is >= 50 %
    K                                        estimated gain (without the restriction to weights)
    estimate                                 standard errors of K; whether its entries, and its
                                             directions as in their table, are identified
    Q, R, P, S, weights_gain                 weights with the nearest gain, scaled to R[0][0] = 1
    weights_rule                             convention by which Q and R were selected
    weights_test                             test whether any weights explain K: statistic, freedom,
                                             p_value, rejected, return_difference
    terminal_set, doubts                     whether the controller has one; warnings as sentences
    horizon, bounds                          as given
    lack_of_fit                              tests of the first fit and, if an unknown was added, of
                                             the last: alarm, and errors with probability and size
    failures.<stage>                         reason why the stage has no result
    ceiling                                  VAF that repeats with the perturbation, low, high, %
    limit                                    given, value, low, high of the limit, if estimated
    lasting                                  steady-state command for an output of 1, with interval
    falls                                    trials that ended in a fall, with the time
    intent                                   eigenvalues (ascending), dominant direction, weights by
                                             each convention
    structures                               weights and gain of each structure
    person                                   [fit.observer]: K, noise SDs with intervals, whiteness,
                                             models with log_likelihood and aic, prediction errors
    identifiability                          rank, free, chosen (by convention), singular_values of
                                             the weights
    aim                                      targets, samples known ahead, observer rates (1/s),
                                             errors of signals (SI), recorded commands
    trials                                   label, vaf, whiteness, x0, held_out_vaf, findings
    methods.<name>                           as in every result
    summary.<column>                         row of impc results, in shown units: limit, and
                                             gain.<control>.<state> with _low, _high, _unit, null
                                             where the page forbids it (reason)
    truth                                    K of a truth.json next to the recordings, or null
    plant, settings, files, versions, made

Matrices are lists of rows, in SI units. NaN, infinity and undetermined values are null.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from impc.assess.assessments import ASSESSMENTS
from impc.assess.intent import dominant_sentence
from impc.assess.printed_gain import lasting_responses
from impc.model.riccati import solve_lqr
from impc.reporting.provenance import Provenance
from impc.reporting.shown_units import shown_unit
from impc.studies.fit.facts import aim_data, named_gains
from impc.studies.fit.result import FitResult
from impc.studies.fit.settings import plain_settings
from impc.studies.fit.structures import structure_data
from impc.studies.fit.verdict import GAIN, RULES
from impc.studies.methods_table import problem_data


def fit_data(result: FitResult, provenance: Provenance) -> dict[str, Any]:
    """Entries of result.json in addition to the findings."""
    plant, found = result.fitted.problem.plant, result.identifiability
    estimate, covariance = result.estimate, result.estimate.covariance
    return _controller(result) | {
        "estimate": {
            "S": estimate.S,
            "misfit": estimate.misfit,
            "standard_errors": covariance.entries,
            "identified": covariance.individually_identified,
            "identified_directions": covariance.identified,
        },
        "limit": None if result.limit_found is None else result.limit_found._asdict(),
        "lasting": [asdict(one) for one in lasting_responses(result.estimate)],
        "falls": result.falls,
        "intent": _intent(result),
        "identifiability": {
            name: getattr(found, name) for name in ("rank", "free", "chosen", "singular_values")
        },
        "trials": [_trial(result, index) for index in range(len(result.trials))],
        "structures": structure_data(result),
        "aim": aim_data(result),
        "person": None if result.person is None else result.person.data(),
        "plant": {
            "name": provenance.plant_name,
            "arguments": dict(provenance.plant_arguments),
            **{name: getattr(plant, name) for name in ("A", "B", "E", "C", "dt")},
        },
        "settings": plain_settings(result.settings),
        "summary": _summary(result),
        "ceiling": None if result.ceiling is None else asdict(result.ceiling),
        "seconds": result.seconds,
    }


def _summary(result: FitResult) -> dict[str, Any]:
    """Row of the fit in a table of fits, in shown units; gains that the page forbids are None."""
    plant, verdict = result.given.plant, RULES.verdict(result)
    label, why = result.given.recordings[0].label, RULES.reason(result, GAIN)
    vaf = map(float, result.inverse_mpc.vaf)
    row: dict[str, Any] = {
        **{name: str(getattr(label, name)) for name in ("subject", "visit", "condition")},
        "trials": len(result.trials),
        "verdict": verdict.level.value,
        "headline": verdict.headline,
        **{f"vaf.{name}": one for name, one in zip(plant.outputs, vaf, strict=True)},
    }
    for name, limit in zip(plant.controls, result.given.bounds.u_max, strict=True):
        head = "limit" if plant.m == 1 else f"limit.{name}"
        row[head] = float(shown_unit(plant, name)[0] * limit)
    unknown = []
    for name, gain in named_gains(result):
        reported = not why and gain.determined
        unknown += [] if reported else [name]
        head = f"gain{gain.interval.name[1:]}"  # after K: control and state
        for end, value in (("", gain.value), ("_low", gain.low), ("_high", gain.high)):
            row[f"{head}{end}"] = float(value) if reported else None
        row[f"{head}_unit"] = f"{gain.unit} for {gain.per}"
    left = f"Not known to within half of its value: {', '.join(unknown)}" if unknown else ""
    return row | {"reason": why or left}


def _controller(result: FitResult) -> dict[str, Any]:
    plant, fitted = result.fitted.problem.plant, result.fitted
    weights, bounds = result.intent.reported.weights, result.given.bounds
    left_out = ASSESSMENTS["held_out_vaf"].find(result.inverse_mpc)
    return problem_data(fitted.problem, result.methods) | {
        "vaf": dict(zip(plant.outputs, result.inverse_mpc.vaf, strict=True)),
        "held_out_vaf": dict(zip(plant.outputs, left_out, strict=True)),
        "disturbances": plant.disturbances,
        "usable": result.usable,
        "K": result.estimate.K,
        "S": fitted.metric * (weights.R[0, 0] / fitted.stage_weights.R[0, 0]),
        "Q": weights.Q,
        "R": weights.R,
        "weights_gain": fitted.gain,
        "weights_rule": result.intent.reported.rule,
        "P": solve_lqr(plant, weights).P,
        "weights_test": {**asdict(result.weights_test), "rejected": result.weights_test.rejected},
        "terminal_set": bool(fitted.problem.terminal_set),
        "doubts": fitted.doubts,
        "failures": dict(result.failures),
        "lack_of_fit": [None if one is None else asdict(one) for one in result.lack],
        "bounds": {name: getattr(bounds, name) for name in ("x_min", "x_max", "u_min", "u_max")},
    }


def _intent(result: FitResult) -> dict[str, Any]:
    found, reported, summary = result.intent, result.intent.reported, result.uncertainty.weights
    over_set = 0.0 if summary is None else summary.widest_angle
    return {
        "eigenvalues": reported.eigenvalues,
        "vectors": reported.vectors,
        "dominant": reported.dominant,
        "sentence": dominant_sentence(reported, result.fitted.problem.plant, np.array(found.sizes)),
        "widest_angle": max(found.widest_angle, over_set),
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


def _trial(result: FitResult, index: int) -> dict[str, Any]:
    trial, found = result.given.recordings[index], result.trials[index]
    held = result.inverse_mpc.held_out
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
        "held_out_vaf": held[index] if len(held) else None,
    }
