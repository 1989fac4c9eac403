"""Inverse MPC of people who follow a blurred target, simulated from the target alone.

For every blur the controller, the delay and the lag of the hand are fitted to all trials at once
(section 3.5 of the dissertation, other data), and again without each trial, which is then
predicted. VAF is of the cursor's position, mean removed, without the first second. It is compared
with delayed feedback of error and velocity, fitted in the same way (`experiments.cursor_baseline`).

Intervals are ranges over fits to trials drawn with replacement: 39 of them for 95 %. A delay or lag
whose logarithm has a standard error of 0.5 or more is not determined: it stays at its start.
Results: experiments/cursor_tracking.md.

    python -m experiments.cursor_tracking --out results/cursor-tracking
"""

from __future__ import annotations

import argparse
import functools
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments.cursor_baseline import delayed_feedback, fit_delayed_feedback
from experiments.cursor_ceiling import fit_step_response, follow
from experiments.cursor_data import RATE, Condition, data_file, read_conditions
from experiments.cursor_figure import cursor_figure
from impc.arrays import Array, frozen
from impc.assess.bounded_weights import linear_ranges, weights_set
from impc.assess.covariance import gain_covariance
from impc.assess.input_limits import with_limit
from impc.assess.variance_accounted_for import centred_vaf
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.inverse.estimates import Estimate
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem, controller_for, scenarios
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.solution_set import gain_fibre
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily
from impc.model.recordings import Recording
from impc.reporting.rendering import plain
from impc.reporting.writer import write_files
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings
from plants import cursor_plant

__all__ = [
    "ConditionResult",
    "condition_problem",
    "fit_condition",
    "left_out_vaf",
    "resampled",
    "weight_ratio",
]

_SECOND = round(RATE)
_NOMINAL = (0.15, 0.08)
# Largest condition number of equivalent weights, over the minimum one.
_RATIO = 10.0
# The range of 39 draws contains the next draw with a probability of 95 %.
_RESAMPLES = 39
# Largest standard error of the logarithm of an identified delay or lag.
_IDENTIFIED = 0.5


@dataclass(frozen=True)
class ConditionResult:
    """Results of one blur.

    Attributes
    ----------
    blur : float
        Blur of the target, px.
    trials : int
    delay, lag : float
        Fitted values, s.
    delay_determined, lag_determined : bool
        Whether the recordings identify them.
    vaf_in, vaf_out : list of float
        VAF of each trial, fitted to all trials and to the others, %.
    baseline_out, ceiling_out : list of float
        Held-out VAF of delayed feedback, and of a free linear response (`cursor_ceiling`), %.
    gain : list of float
        Gains of error (1/s^2) and velocity (1/s).
    gain_determined : int
        Directions of the gain, of 7, with a standard error below one whitened unit.
    weight_of_error, cost_weight_low, cost_weight_high : float
        Q_ee at R = 1 in the weights of minimum condition number, and its range over all weights
        with the same gain and a condition number up to ten times the minimum.
    resampled_weight, resampled_gain : list of float
        Cost weight and gain of the error in every fit to resampled trials.
    limit : str
        Finding on an acceleration limit.
    recorded, simulated, target : list of float
        One held-out trial, px.
    """

    blur: float
    trials: int
    delay: float
    lag: float
    delay_determined: bool
    lag_determined: bool
    vaf_in: list[float]
    vaf_out: list[float]
    baseline_out: list[float]
    ceiling_out: list[float]
    gain: list[float]
    gain_determined: int
    weight_of_error: float
    cost_weight_low: float
    cost_weight_high: float
    resampled_weight: list[float]
    resampled_gain: list[float]
    limit: str
    recorded: list[float]
    simulated: list[float]
    target: list[float]


def condition_problem(condition: Condition) -> Problem:
    """Inverse problem of a condition: the error starts as recorded, the hand at rest."""

    def make(values: Array) -> Plant:
        return Plant(cursor_plant(float(values[0]), float(values[1])), ["command"])

    family = PlantFamily(make, ["delay", "lag"], _NOMINAL)
    plant = make(np.array(_NOMINAL))
    trials = []
    for target, response in zip(condition.target, condition.response, strict=True):
        error = response - target
        increments = np.append(np.diff(target), 0.0) * RATE
        trials.append(Recording(plant, error, increments, [error[0], *np.zeros(plant.n - 1)]))
    problem = fit_problem(plant, trials, FitSettings(), family)
    return replace(problem, unknown_start=False)


def left_out_vaf(condition: Condition, index: int) -> tuple[float, float, Array]:
    """Held-out VAF of a trial by inverse MPC and by delayed feedback, and the predicted cursor."""
    others = np.arange(len(condition.target)) != index
    problem = condition_problem(condition)
    kept = tuple(trial for trial, keep in zip(problem.recordings, others, strict=True) if keep)
    fitted = fit_controller(replace(problem, recordings=kept))
    cursor = _cursor(fitted, problem, condition, index)
    gains, delay = fit_delayed_feedback(condition.target[others], condition.response[others])
    baseline = delayed_feedback(condition.target[index][None], gains, delay)[0]
    recorded = condition.response[index]
    return _vaf(recorded, cursor), _vaf(recorded, baseline), cursor


def resampled(condition: Condition, count: int, seed: int = 0) -> tuple[list[float], list[float]]:
    """Cost weight (R = 1) and gain of the error in `count` fits to resampled trials.

    On this plant all weights with one gain have the same cost weight of the error.
    """
    problem = condition_problem(condition)
    cost_weights, gains = [], []
    for index in range(count):
        rng = np.random.default_rng(seed + index)
        drawn = rng.integers(len(problem.recordings), size=len(problem.recordings))
        trials = tuple(problem.recordings[trial] for trial in drawn)
        fitted = fit_controller(replace(problem, recordings=trials))
        weights = fitted.stage_weights
        cost_weights.append(float(weights.Q[0, 0] / weights.R[0, 0]))
        gains.append(float(fitted.gain[0, 0]))
    return cost_weights, gains


def fit_condition(
    condition: Condition, seed: int = 0, resamples: int = _RESAMPLES
) -> ConditionResult:
    """Fit a condition, predict each of its trials, and evaluate its cost weights."""
    problem = condition_problem(condition)
    fitted = fit_controller(problem)
    count = len(condition.target)
    inside = [
        _vaf(condition.response[k], _cursor(fitted, problem, condition, k)) for k in range(count)
    ]
    outside = [left_out_vaf(condition, index) for index in range(count)]
    covariance = gain_covariance(fitted.problem, np.array(fitted.gain), np.array(fitted.metric))
    plant = fitted.problem.plant
    found = weights_set(gain_fibre(plant, fitted.gain), _RATIO)
    of_error = np.zeros((1, plant.n + 1, plant.n + 1))
    of_error[0, 0, 0] = 1.0
    (cost_weight,) = linear_ranges(found, of_error)
    delay, lag = _parameters(fitted)
    identified = np.array(covariance.parameters) < _IDENTIFIED
    cost_weights, gains = resampled(condition, resamples, seed)
    shown = int(np.argsort([item[0] for item in outside])[count // 2])
    return ConditionResult(
        condition.blur,
        count,
        delay,
        lag,
        bool(identified[0]),
        bool(identified[1]),
        inside,
        [item[0] for item in outside],
        [item[1] for item in outside],
        [_ceiling(condition, index) for index in range(count)],
        fitted.gain[0, :2].tolist(),
        int(np.count_nonzero(np.array(covariance.deviations) < 1)),
        float(found.least.weights.Q[0, 0]),
        cost_weight.low,
        cost_weight.high,
        cost_weights,
        gains,
        _limit(fitted),
        condition.response[shown].tolist(),
        outside[shown][2].tolist(),
        condition.target[shown].tolist(),
    )


def _ceiling(condition: Condition, index: int) -> float:
    """VAF of one trial by the free linear response of the others, %."""
    others = np.arange(len(condition.target)) != index
    response = fit_step_response(condition.target[others], condition.response[others])
    return _vaf(condition.response[index], follow(condition.target[index], response))


def _limit(fitted: Estimate) -> str:
    """Effect of a command bound with everything else fixed.

    Finds the smallest bound that raises the misfit by less than 1 %, and whether any bound lowers
    it by as much.
    """
    known = replace(fitted.problem, family=None, logarithms=frozen([]))
    K, S = np.array(fitted.gain), np.array(fitted.metric)
    controller = controller_for(known, K, S)
    peak = max(float(np.max(np.abs(simulate(controller, d).u))) for d in scenarios(known))
    free, _ = misfit_or_reason(known, K, S)
    least, best = peak, free
    for share in np.linspace(0.95, 0.2, 16):
        misfit, reason = misfit_or_reason(with_limit(known, float(share * peak)), K, S)
        best = min(best, misfit)
        if reason or misfit > 1.01 * free:
            break
        least = float(share * peak)
    identified = "no bound fits better" if best > 0.99 * free else "a bound fits better"
    return f"peak {peak:.0f}; {identified}; bounds above {least:.0f} fit as well"


def _parameters(fitted: Estimate) -> tuple[float, float]:
    family = fitted.problem.family
    assert family is not None
    delay, lag = family.nominal * np.exp(fitted.problem.logarithms)
    return float(delay), float(lag)


def _cursor(fitted: Estimate, problem: Problem, condition: Condition, index: int) -> Array:
    """Simulate the cursor of one trial from its target."""
    one = replace(fitted.problem, recordings=(problem.recordings[index],))
    known = replace(one, family=None, logarithms=frozen([]))
    controller = controller_for(known, np.array(fitted.gain), np.array(fitted.metric))
    run = simulate(controller, scenarios(known)[0])
    return np.asarray(run.x[:, 0] + condition.target[index])


def _vaf(recorded: Array, cursor: Array) -> float:
    return float(centred_vaf(recorded[_SECOND:, None], cursor[_SECOND:, None])[0])


def _table(results: list[ConditionResult]) -> str:
    lines = [
        "blur px  trials  delay ms  lag ms  VAF in %  VAF out % (least)  delayed feedback %"
        "  free response %"
        "  K error 1/s^2 (interval)  K velocity 1/s  gain determined  cost weight of error "
        "(interval)"
        "  acceleration, px/s^2"
    ]
    for item in results:
        lines.append(
            f"{item.blur:7.0f} {item.trials:7d} {_time(item.delay, item.delay_determined):>9} "
            f"{_time(item.lag, item.lag_determined):>7} "
            f"{np.mean(item.vaf_in):9.1f} {np.mean(item.vaf_out):10.1f} ({min(item.vaf_out):5.1f}) "
            f"{np.mean(item.baseline_out):17.1f} {np.mean(item.ceiling_out):15.1f}  "
            f"{item.gain[0]:11.1f} ({_span(item.resampled_gain)}) {item.gain[1]:11.2f} "
            f"{item.gain_determined:16d} of 7"
            f"{item.weight_of_error:12.3g} ({_span(item.resampled_weight)})  "
            f"{item.limit}"
        )
    return "\n".join(lines)


def _time(seconds: float, determined: bool) -> str:
    return f"{1e3 * seconds:.0f}" if determined else "n.d."


def _span(values: list[float]) -> str:
    return f"{min(values):.3g} to {max(values):.3g}" if values else "no interval"


def weight_ratio(results: list[ConditionResult]) -> str:
    """Sentence on the ratio of the cost weights at the smallest and the largest blur."""
    first, last = results[0], results[-1]
    ratios = [
        one / other
        for one, other in zip(first.resampled_weight, last.resampled_weight, strict=False)
    ]
    if not ratios:
        return "Without resampled trials the change of the cost weight of the error is unknown."
    count, least, most = len(first.resampled_weight), np.min(ratios), np.max(ratios)
    level = 100 * (count - 1) / (count + 1)
    identified = "falls" if least > 1 else "is not distinguished from constant: it changes"
    return (
        f"From {first.blur:g} to {last.blur:g} px the cost weight of the error {identified} by a "
        "factor of "
        f"{first.weight_of_error / last.weight_of_error:.3g} ({level:.0f} %: {least:.3g} to "
        f"{most:.3g})."
    )


def main() -> None:
    """Fit every condition, print the table, and write figure and result.json."""
    parser = argparse.ArgumentParser(description="Inverse MPC of human target tracking.")
    parser.add_argument("--out", type=Path, default=Path("results", "cursor-tracking"))
    parser.add_argument("--resamples", type=int, default=_RESAMPLES)
    given = parser.parse_args()
    if not data_file().exists():
        print(f"{data_file().name} is not there; set IMPC_CURSOR_DATA to its path.")
        return
    conditions = read_conditions(data_file())
    with ProcessPoolExecutor(2) as pool:
        fit = functools.partial(fit_condition, resamples=given.resamples)
        # Different seeds, so that the draws of conditions are independent.
        found = pool.map(fit, conditions, range(0, 1000 * len(conditions), 1000))
        results = list(tqdm(found, total=len(conditions), unit="condition", disable=None))
    print(_table(results))
    print(weight_ratio(results))
    content: Any = plain({f"{item.blur:g} px": asdict(item) for item in results})
    files = {"result.json": (json.dumps(content, indent=1) + "\n").encode()}
    write_files(given.out, files | cursor_figure(results))
    print(f"\nwritten to {given.out}")


if __name__ == "__main__":
    main()
