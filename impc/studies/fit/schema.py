"""result.json of a fit: the numbers of the page for other programs.

    vaf.<output>, held_out_vaf.<output>      %, all trials; the mean of the trials left out
    states, controls, outputs, disturbances  names, in the order of every array below
    units.<signal>                           where the plant says them
    body                                     "nonlinear" where the plant's own equations moved, or
                                             "linear"
    solver                                   what solved the quadratic programs
    usable                                   whether half of every recorded signal is explained
    K                                        the gain that the recordings identify; its intervals
                                             are in intervals
    Q, R, P, S, weights_gain                 the weights whose gain comes nearest, at R[0][0] = 1
    weights_rule                             which of all weights with that gain Q and R are
    weights_test                             whether any weights explain K: statistic, freedom,
                                             p_value, rejected, return_difference
    terminal_set, doubts                     of the fitted controller; sentences
    horizon, bounds, other_limit             as given; the fit with the limit free, or null
    failures.<stage>                         why the stage has no result
    estimate                                 standard errors of K and of its directions, and which
                                             of them are identified
    intervals.<number>                       of the gain and of the parameters
    warnings, residuals                      sentences; the tests behind them
    intent                                   eigenvalues (ascending), dominant, sentence, readings
    structures                               of each that was named: prices and ratios with
                                             intervals, rank, directions, test, vaf, aic
    person                                   of [fit.observer]: K, levels with intervals, models
                                             with log_likelihood and aic, whiteness, errors ahead
    identifiability                          rank, free, chosen, singular_values
    parameters.<name>                        nominal, value, deviation, determined
    trials                                   label, vaf, whiteness, x0, held_out_vaf, findings
    methods.<name>                           as in every result (docs/results.md)
    truth                                    K of a truth.json beside the recordings, or null
    plant, settings, files, versions, made

Matrices are lists of rows, in SI units. What is not a number, or not determined, is null.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.assess.intent_rules import dominant_sentence
from impc.studies.fit.structures import structure_data
from impc.studies.methods_table import methods_data

if TYPE_CHECKING:
    from impc.assess.printed_gain import GainEstimate
    from impc.reporting.provenance import Provenance
    from impc.studies.fit.result import FitResult


def fit_data(result: FitResult, provenance: Provenance) -> dict[str, Any]:
    """Content of result.json."""
    person = None if result.person is None else result.person.data()
    within = {"structures": structure_data(result), "person": person}
    return _controller(result) | _found(result) | within | _made(result, provenance)


def _controller(result: FitResult) -> dict[str, Any]:
    plant, fitted = result.fitted.problem.plant, result.fitted
    weights = result.intent.reported.weights
    scale = weights.R[0, 0] / fitted.stage_weights.R[0, 0]
    bounds, other = result.given.bounds, result.other_limit
    held = np.array([item.vaf for item in result.held_out])
    return {
        "vaf": dict(zip(plant.outputs, result.inverse_mpc.vaf, strict=True)),
        "held_out_vaf": {
            name: np.mean(held[:, index]) if len(held) else None
            for index, name in enumerate(plant.outputs)
        },
        "states": plant.states,
        "controls": plant.controls,
        "outputs": plant.outputs,
        "disturbances": plant.disturbances,
        "units": dict(plant.units),
        "usable": result.usable,
        "K": result.estimate.K,
        "S": fitted.metric * scale,
        "Q": weights.Q,
        "R": weights.R,
        "weights_gain": fitted.gain,
        "weights_rule": result.intent.reported.rule,
        "P": result.reported_P,
        "weights_test": {**asdict(result.weights_test), "rejected": result.weights_test.rejected},
        "terminal_set": bool(fitted.problem.terminal_set),
        "doubts": fitted.doubts,
        "failures": dict(result.failures),
        "other_limit": None
        if other is None
        else {
            "given": other.given,
            "limit": asdict(other.limit),
            "K": other.fitted.gain,
            "misfit": other.fitted.misfit,
            "contradicted": other.contradicted,
        },
        "horizon": result.fitted.problem.horizon,
        "body": plant.moves,
        "solver": result.fitted.problem.solver,
        "bounds": {name: getattr(bounds, name) for name in ("x_min", "x_max", "u_min", "u_max")},
    }


def _found(result: FitResult) -> dict[str, Any]:
    found, intent = result.identifiability, result.intent
    plant = result.fitted.problem.plant
    return {
        "estimate": _estimate(result.estimate),
        "warnings": result.warnings,
        "residuals": {
            name: None if test is None else {**asdict(test), "found": test.found}
            for name, test in (
                ("loop_noise", result.diagnostics.loop),
                ("structure", result.diagnostics.structure),
            )
        },
        "intent": {
            "eigenvalues": intent.reported.eigenvalues,
            "vectors": intent.reported.vectors,
            "dominant": intent.reported.dominant,
            "sentence": dominant_sentence(intent.reported, plant, np.array(intent.sizes)),
            "widest_angle": result.widest_angle,
            "state_sizes": intent.sizes,
            "readings": [
                {
                    "rule": item.rule,
                    "Q": item.weights.Q,
                    "R": item.weights.R,
                    "condition_number": item.condition,
                    "dominant": item.dominant,
                    "angle": item.angle,
                }
                for item in intent.readings
            ],
            "missing": intent.missing,
        },
        "identifiability": {
            "rank": found.rank,
            "free": found.free,
            "chosen": found.chosen,
            "singular_values": found.singular_values,
        },
        **_certainty(result),
        "parameters": {
            item.name: {**asdict(item), "determined": item.determined} for item in result.parameters
        },
        "trials": [_trial(result, index) for index in range(len(result.trials))],
        "methods": methods_data(result.methods),
    }


def _estimate(estimate: GainEstimate) -> dict[str, Any]:
    covariance = estimate.covariance
    return {
        "S": estimate.S,
        "misfit": estimate.misfit,
        "standard_errors": covariance.entries,
        "identified": covariance.told_entries,
        "singular_values": covariance.singular_values,
        "directions": covariance.directions,
        "direction_standard_errors": covariance.deviations,
        "identified_directions": covariance.told,
        "natural_coordinates": covariance.T,
        "natural_inputs": covariance.G,
    }


def _certainty(result: FitResult) -> dict[str, Any]:
    found = result.certainty
    preferred: dict[str, Any] = {}
    for item in found.intervals:  # the sandwich's come first
        told = {key: value for key, value in asdict(item).items() if key != "name"}
        preferred.setdefault(item.name, told)
    return {
        "intervals": preferred,
        "all_intervals": [asdict(item) for item in found.intervals],
        "weights_set": None if found.weights is None else asdict(found.weights),
        "limits": [asdict(item) for item in found.limits],
        "alternatives": [asdict(item) for item in found.alternatives],
    }


def _trial(result: FitResult, index: int) -> dict[str, Any]:
    trial, told = result.given.recordings[index], result.trials[index]
    held = result.held_out[index] if result.held_out else None
    return {
        **asdict(trial.label),
        "samples": trial.samples,
        "findings": trial.findings,
        "vaf": told.vaf,
        "centred_vaf": told.centred_vaf,
        "whiteness": told.whiteness,
        "rms_residual": told.rms,
        "saturated": told.saturated,
        "x0": result.fitted.problem.recordings[index].x0,
        "held_out_vaf": None if held is None else held.vaf,
        "held_out_centred_vaf": None if held is None else held.centred_vaf,
    }


def _made(result: FitResult, provenance: Provenance) -> dict[str, Any]:
    plant = result.fitted.problem.plant
    return {
        "plant": {
            "name": provenance.plant_name,
            "arguments": dict(provenance.plant_arguments),
            "A": plant.A,
            "B": plant.B,
            "E": plant.E,
            "C": plant.C,
            "dt": plant.dt,
        },
        "settings": asdict(result.settings),
        "seconds": result.seconds,
    }
