"""Test the verdicts of `impc fit` on simulated subjects of nine kinds.

    python -m experiments.verdicts --seeds 10

Each kind is a cart (`experiments.coverage`) whose recordings make one verdict right. The script
prints, for each kind, the number of right verdicts and the other ones. It then prints how many
intervals of reportable gains cover, and how many reportable comparisons of cost are true. Results:
experiments/coverage.md.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

import impc
from experiments.coverage import cart
from experiments.driver import each
from impc.arrays import Array
from impc.checking import replace
from impc.levels import Level
from impc.model.riccati import solve_lqr
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.facts import decided, named_gains
from impc.studies.fit.result import FitResult
from impc.studies.fit.subject import fit_recordings
from impc.studies.fit.verdict import FALLEN, GAIN, RULES, WEIGHTS

_LIMIT, _HORIZON, _SAMPLES, _TRIALS = 1.0, 10, 900, 2
_WEIGHTS = np.array([[4.0, 0.8], [0.8, 1.0]])
_NOISE, _FAR = 0.003, 3.0


class Made(NamedTuple):
    """Fit of a simulated subject, with its true gain."""

    result: FitResult
    gain: Array


def subject(
    seed: int,
    *,
    size: float = 0.75,
    limit: float = _LIMIT,
    unknown: float = 0.0,
    noise: float = _NOISE,
    wander: float = 0.0,
    plant: impc.Plant | None = None,
    gain: Array | None = None,
    samples: int = _SAMPLES,
    settle: float = 1.0,
) -> Made:
    """Simulate and fit a cart; `unknown` scales pushes that are not recorded."""
    rng, known = np.random.default_rng(seed), cart()
    body = plant or known
    weights = impc.Weights(_WEIGHTS, 1)
    bounds = impc.Bounds(body, u_min=-limit, u_max=limit)
    law = impc.Controller(body, weights, bounds, _HORIZON, terminal_set=False)
    true = np.array(solve_lqr(body, weights).K) if gain is None else gain
    trials: list[impc.Recording] = []
    while len(trials) < _TRIALS:
        push = size * np.repeat(rng.choice([-1.0, 0.0, 1.0], samples // 10), 10)
        pushed = push + unknown * rng.standard_normal(samples)
        y = _linear(body, gain, pushed) if gain is not None else _moved(law, pushed)
        if not np.all(np.abs(y) < _FAR):  # A fall: draw again
            continue
        own = wander * np.cumsum(rng.standard_normal((samples, 1)), axis=0)
        y = y + noise * rng.standard_normal(y.shape) + own - own.mean()
        label = impc.Label(trial=str(len(trials) + 1))
        trials.append(impc.Recording(known, y, push, label=label))
    settings = impc.FitSettings(horizon=_HORIZON, u_max=_LIMIT, settle=settle)
    problem = fit_problem(known, trials, settings)
    return Made(fit_recordings(problem, settings), true)


def _moved(law: impc.Controller, push: Array) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(law.simulate([0, 0], disturbance=push).x[: len(push), :1])


def _linear(plant: impc.Plant, gain: Array, push: Array) -> Array:
    """Outputs under u = -Kx without a limit."""
    x = np.zeros((len(push), plant.n))
    for k in range(len(push) - 1):
        x[k + 1] = plant.A @ x[k] - plant.B @ (gain @ x[k]) + plant.E[:, 0] * push[k]
    return x[:, :1]


def _softer(share: float) -> impc.Plant:
    plant = cart()
    return replace(plant, A=plant.A + share * (plant.A - np.eye(2)) * np.array([[0, 0], [1, 1]]))


def _fell(seed: int) -> Made:
    made = subject(seed)
    return made._replace(result=replace(made.result, falls=("trial 3: fell at 5.1 s",)))


_without_weights = functools.partial(subject, size=0.15, gain=np.array([[1.5, 0.2]]), noise=3e-4)
#: Kind -> function that makes a subject, right level, and words of the right headline.
KINDS: dict[str, tuple[Callable[[int], Made], Level, str]] = {
    "explained": (subject, Level.GREEN, "explains this movement"),
    "limit": (functools.partial(subject, limit=0.7), Level.AMBER, "probably wrong"),
    "noise in the loop": (functools.partial(subject, unknown=1.0), Level.AMBER, "noise"),
    "half": (functools.partial(subject, wander=0.05), Level.RED, "less than half"),
    "no weights": (_without_weights, Level.AMBER, "no cost weights"),
    "body": (lambda seed: subject(seed, plant=_softer(1.0)), Level.AMBER, "body"),
    "fell": (_fell, Level.AMBER, "fell"),
    "never reached": (functools.partial(subject, size=0.15), Level.GREEN, "never reached"),
    "weak": (
        functools.partial(subject, size=0.3, noise=0.015, samples=30, settle=0.2),
        Level.AMBER,
        "do not determine",
    ),
}


def _true_statements(result: FitResult) -> list[bool]:
    """Whether each decided comparison of cost is true."""
    states, sizes = result.given.plant.states, np.array(result.intent.sizes)
    scaled, true = _WEIGHTS * np.outer(sizes, sizes), []
    for item in decided(result):
        i, j = states.index(item.first), states.index(item.second)
        value = scaled[i, i] - scaled[j, j] if item.kind == "order" else scaled[i, j]
        true.append(bool((value > 0) == item.holds))
    return true


def _judged(task: tuple[str, int]) -> tuple[str, list[bool], list[bool]]:
    """Wrong verdict or "right", intervals of reportable gains that cover, and comparisons."""
    name, seed = task
    make, level, words = KINDS[name]
    result, gain = make(seed)
    verdict, no = RULES.verdict(result), RULES.forbidden(result)
    held: list[bool] = []
    if GAIN not in no:
        rows = zip(gain.ravel(), named_gains(result), strict=False)
        held = [bool(row.interval.low <= truth <= row.interval.high)
                for truth, (_, row) in rows if row.determined]  # fmt: skip
    true = _true_statements(result) if WEIGHTS not in no and name != "body" else []
    right = verdict.level is level and words in verdict.headline
    return "right" if right else f"{verdict.level.value}: {verdict.headline}", held, true


def _count(lists: Iterable[list[bool]]) -> str:
    items = list(itertools.chain(*lists))
    return f"{sum(items)} of {len(items)}"


def main() -> None:
    """Print the rates of right verdicts, intervals and comparisons."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    given = parser.parse_args()
    tasks = list(itertools.product(given.kinds, range(given.seeds)))
    found = each(_judged, tasks)
    for name in given.kinds:
        said = Counter(one[0] for task, one in zip(tasks, found, strict=True) if task[0] == name)
        others = "; ".join(f"{count} {text}" for text, count in said.items() if text != "right")
        print(f"{name:<20}{said['right']} of {given.seeds}  {others}")
    fallen = FALLEN.verdict(("trial 1: fell at 3.2 s",))
    print(f"{'fell in all':<20}{fallen.level.value}: {fallen.headline}")
    print(f"intervals of reportable gains that cover: {_count(one[1] for one in found)}")
    print(f"reportable comparisons of cost that are true: {_count(one[2] for one in found)}")


if __name__ == "__main__":
    main()
