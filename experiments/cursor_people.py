"""People following a blurred target as people who sense with noise, judged on trials left out.

The hand's velocity follows a command that arrives whole samples late (`plants.pursuit_plant`). The
person sees the error with noise, feels the speed of the hand with noise, and knows how the target
moves: by steps that no step before tells, of the size that they have. Commands follow from the
estimate, by the price of the error beside that of the command. Motor noise enters with the command,
and what moves the cursor beside is white from sample to sample. Everything but the delay is
searched by maximum likelihood (docs/noisy-people.md), for each of some delays; people sit a few
pixels beside the target, so the mean error is taken off, and then what the likelihood would rather
have.

Of each blur the even trials are fitted and the odd ones judged, and the other way round: by the
mean log-likelihood, in nats a sample, of the next position of the cursor given all before and the
target, the first three seconds left out.

    python -m experiments.cursor_people --out results/cursor-people
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

import plants
from experiments.cursor_data import RATE, Condition, data_file, read_conditions
from experiments.cursor_steps import Expected, fit_steps, step_nats
from impc.assess.person_covariance import person_covariance
from impc.assess.person_models import prediction_errors
from impc.assess.person_profile import level_intervals
from impc.checking import replace
from impc.inverse.likelihood_fit import PersonFit, fit_person
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.person_coordinates import PersonCoordinates
from impc.inverse.structured_fit import fit_structured
from impc.inverse.structured_search import PriceCoordinates
from impc.model.observer import Observer
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily
from impc.model.recordings import Recording
from impc.model.structure import Structure
from impc.reporting.writer import write_files
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_problem

if TYPE_CHECKING:
    from impc.arrays import Array, IntArray
    from impc.inverse.problem import Problem

__all__ = ["DELAYS", "FIRST", "Follower", "fit_follower", "follower_problem", "judged", "nats"]

#: Delays that are tried, samples of 1/60 s; and the first sample that is judged.
DELAYS = (6, 8, 10, 12, 14)
FIRST = 180
_LAG = 0.03
# Where levels begin: px, px/s. A search from others ends at the same (tests).
_BESIDE, _MOTOR, _SEEN, _FELT, _RECORDER = 0.3, 60.0, 10.0, 20.0, 0.2
# Logarithm of the price about that of least squares.
_SPREAD = 5.0


@dataclass(frozen=True)
class Follower:
    """The person behind some trials.

    Attributes
    ----------
    delay : int
        Samples.
    offset : float
        Where the cursor is held beside the target, px.
    fit : PersonFit
    """

    delay: int
    offset: float
    fit: PersonFit


def follower_problem(condition: Condition, which: IntArray, delay: int, offset: float) -> Problem:
    """The inverse problem of some trials (k,): the error starts as recorded, the hand at rest."""

    def make(values: Array) -> Plant:
        return Plant(plants.pursuit_plant(delay, float(values[0])), ["command"])

    plant, trials = make(np.array([_LAG])), []
    for target, response in zip(condition.target[which], condition.response[which], strict=True):
        error = response - target - offset
        increments = np.append(np.diff(target), 0.0) * RATE
        trials.append(Recording(plant, error, increments, [error[0], *np.zeros(plant.n - 1)]))
    family = PlantFamily(make, ["lag"], [_LAG])
    return replace(fit_problem(plant, trials, FitSettings(), family), unknown_start=False)


def fit_follower(
    condition: Condition, which: IntArray, delays: tuple[int, ...] = DELAYS
) -> Follower:
    """The likeliest person behind some trials (k,), of those with one of some delays."""
    error = (condition.response[which] - condition.target[which])[:, FIRST:]
    offset = float(np.mean(error))
    tried = [(delay, _fitted(condition, which, delay, offset)) for delay in delays]
    delay, found = max(tried, key=lambda one: nats(one[1]))
    again = offset + _beside(Follower(delay, offset, found), condition, which)
    return Follower(delay, again, _fitted(condition, which, delay, again))


def _fitted(condition: Condition, which: IntArray, delay: int, offset: float) -> PersonFit:
    problem = follower_problem(condition, which, delay, offset)
    near = fit_controller(problem)
    structure = Structure(near.problem.plant, ["error"])
    least_squares = fit_structured(problem, structure, near)
    plant = least_squares.problem.plant
    beside = np.zeros(plant.n)
    beside[0] = _BESIDE
    person = Observer(
        plant,
        ["error", "velocity"],
        motor=_MOTOR,
        process=beside,
        sensory=[_SEEN, _FELT],
        walk=float(np.std([trial.disturbance for trial in problem.recordings])),
        persistence=0.0,
    )
    return fit_person(
        least_squares,
        person,
        recorder=np.array([_RECORDER]),
        spread=_SPREAD,
        held=["walk"],
    )


def judged(follower: Follower, condition: Condition, which: IntArray) -> PersonFit:
    """The same person beside other trials (k,): what the fit would have said of them."""
    fit = follower.fit
    other = follower_problem(condition, which, follower.delay, follower.offset)
    there = other.at(np.array(other.starts), np.array(fit.problem.logarithms))
    structure = fit.problem.structure
    assert structure is not None
    assert fit.prices is not None
    prices = PriceCoordinates(replace(there, structure=structure), structure, np.array(fit.prices))
    space = PersonCoordinates(prices, fit.observer, np.array(fit.recorder))
    told = space.told(space.start)
    return dataclasses.replace(fit, problem=there, told=told, log_likelihood=told.value)


def nats(fit: PersonFit) -> float:
    """Mean log-likelihood of a sample, the first three seconds left out."""
    return float(np.mean([trial.told[FIRST:] for trial in fit.told.trials]))


def _beside(follower: Follower, condition: Condition, which: IntArray) -> float:
    """By how much the offset is to be moved: innovations are linear in it."""
    step = 1.0
    moved = dataclasses.replace(follower, offset=follower.offset + step)
    here, there = (judged(one, condition, which).told.trials for one in (follower, moved))
    first = np.concatenate([one.innovations[FIRST:, 0] for one in here])
    other = np.concatenate([one.innovations[FIRST:, 0] for one in there])
    spread = np.concatenate([one.spreads[FIRST:, 0, 0] for one in here])
    slope = (other - first) / step
    return -float(np.sum(slope * first / spread) / np.sum(slope**2 / spread))


@dataclass(frozen=True)
class _Row:
    """One half of a blur, fitted and judged on the other; or all trials of it, with intervals."""

    blur: float
    half: int
    inside: float
    outside: float
    steps: float
    delay: int
    offset: float
    price: float
    lag: float
    levels: dict[str, float]
    intervals: dict[str, list[float]]
    ahead: list[float]
    evaluations: int
    converged: bool


_AHEAD = (1, 6, 12, 30)
_TOLD = ("outside", "steps")


def _half(condition: Condition, half: int) -> _Row:
    every = np.arange(len(condition.target))
    mine, others = every[half::2], every[1 - half :: 2]
    follower = fit_follower(condition, mine)
    there = judged(follower, condition, others)
    steps = fit_steps(_expected(follower.fit, condition, mine))
    told = nats(there), step_nats(steps, _expected(there, condition, others))
    ahead = prediction_errors(there, _AHEAD)[:, 0].tolist()
    return _row(condition.blur, half, follower, told, {}, ahead)


def _expected(fit: PersonFit, condition: Condition, which: IntArray) -> Expected:
    """What the filter expects of the cursor, from the first sample that is judged."""
    position = condition.response[which]
    off = np.array([trial.innovations[:, 0] for trial in fit.told.trials])
    spread = np.array([trial.spreads[:, 0, 0] for trial in fit.told.trials])
    parts = position, np.roll(position, 1, axis=1), position - off, np.sqrt(spread)
    return Expected(*(part[:, FIRST:].ravel() for part in parts))


def _whole(condition: Condition, delays: tuple[int, ...]) -> _Row:
    follower = fit_follower(condition, np.arange(len(condition.target)), delays)
    intervals = level_intervals(follower.fit, person_covariance(follower.fit))
    named = dict(zip(follower.fit.space.names, intervals.tolist(), strict=True))
    nothing = float("nan"), float("nan")
    return _row(condition.blur, -1, follower, nothing, named, [])


def _row(
    blur: float,
    half: int,
    follower: Follower,
    outside: tuple[float, float],
    intervals: dict[str, list[float]],
    ahead: list[float],
) -> _Row:
    fit = follower.fit
    assert fit.prices is not None
    assert fit.problem.family is not None
    levels = np.exp(fit.theta[fit.space.own :])
    return _Row(
        blur,
        half,
        nats(fit),
        *outside,
        follower.delay,
        follower.offset,
        float(np.exp(fit.prices[0])),
        float(fit.problem.family.nominal[0] * np.exp(fit.problem.logarithms[0])),
        dict(zip(fit.space.names, levels.tolist(), strict=True)),
        intervals,
        ahead,
        fit.evaluations,
        fit.converged,
    )


def _table(rows: list[_Row]) -> str:
    """Halves: how well the other half is told."""
    lines = [
        "| blur, px | nats a sample, even, odd trials left out | mean | with steps and rests "
        "| errors 1, 6, 12, 30 samples ahead, px |",
        "|---|---|---|---|---|",
    ]
    for blur in sorted({row.blur for row in rows}):
        pair = sorted(
            (row for row in rows if row.blur == blur), key=lambda row: -row.half
        )  # half 1 leaves the even trials out
        each = ", ".join(f"{row.outside:.4f}" for row in pair)
        mean, steps = (np.mean([getattr(row, name) for row in pair]) for name in _TOLD)
        ahead = np.sqrt(np.mean(np.square([row.ahead for row in pair]), axis=0))
        far = ", ".join(f"{value:.2f}" for value in ahead)
        lines.append(f"| {blur:.0f} | {each} | {mean:.4f} | {steps:.4f} | {far} |")
    mean, steps = (np.mean([getattr(row, name) for row in rows]) for name in _TOLD)
    return "\n".join([*lines, f"| mean | | {mean:.4f} | {steps:.4f} | |"])


def _numbers(rows: list[_Row]) -> str:
    """Whole blurs: every number of the model, with its interval where it has one."""
    names = list(rows[0].levels)
    lines = [
        "| blur, px | delay, ms | lag, ms | beside, px | price of the error, 1/s^2 | "
        + " | ".join(names)
        + " |",
        "|" + "---|" * (5 + len(names)),
    ]
    for row in rows:
        levels = (_spanned(row.levels[name], row.intervals[name]) for name in names)
        lines.append(
            f"| {row.blur:.0f} | {1e3 * row.delay / RATE:.0f} | {1e3 * row.lag:.0f} "
            f"| {row.offset:.1f} | {row.price:.3g} | " + " | ".join(levels) + " |"
        )
    return "\n".join(lines)


def _spanned(value: float, ends: list[float]) -> str:
    if ends[0] == 0:
        return f"at most {ends[1]:.3g}"
    return f"{value:.3g} ({ends[0]:.3g} to {ends[1]:.3g})"


def main() -> None:
    """Fit every half and every blur; print the tables, write result.json."""
    parser = argparse.ArgumentParser(description="People who sense a blurred target with noise.")
    parser.add_argument("--out", type=Path, default=Path("results", "cursor-people"))
    given = parser.parse_args()
    if not data_file().exists():
        print(f"{data_file().name} is not there: nothing to fit. IMPC_CURSOR_DATA may name it.")
        return
    conditions = read_conditions(data_file())
    jobs = [(condition, half) for condition in conditions for half in (0, 1)]
    with ProcessPoolExecutor(2) as pool:
        found = list(tqdm(pool.map(_half, *zip(*jobs, strict=True)), total=len(jobs)))
        delays = [_both(found, condition.blur) for condition in conditions]
        whole = list(tqdm(pool.map(_whole, conditions, delays), total=len(conditions)))
    print(_table(found), _numbers(whole), sep="\n\n")
    rows = [dataclasses.asdict(row) for row in (*found, *whole)]
    write_files(given.out, {"result.json": json.dumps(rows, indent=1).encode()})


def _both(rows: list[_Row], blur: float) -> tuple[int, ...]:
    """The delays that the halves of a blur have chosen."""
    return tuple(sorted({row.delay for row in rows if row.blur == blur}))


if __name__ == "__main__":
    main()
