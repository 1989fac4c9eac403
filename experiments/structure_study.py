"""Cost structures on simulated subjects: coverage, level and power of the test, global search.

Seat: cost weights of the four body states, log-uniform within a factor of four of (6e3, 9e3, 6e2,
4e2), three trials of 30 s under the ternary torque, no limit, noise on the angles. Carts: two of
`experiments.printed_intervals` with cost weights of four states and two inputs, at their limits in
some percent of the samples; their gain depends on a cross term. The table has all subjects of the
file, with `--subjects 0` at any time. Results: experiments/structures.md.

    python -m experiments.structure_study seat --vaf 90 --subjects 200 --out seat.jsonl
    python -m experiments.structure_study carts --cross 0.5 --subjects 400 --out carts.jsonl
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

import plants
from experiments.driver import Row, kept_rows, with_noise
from experiments.printed_intervals import carts
from experiments.summary import clustered, markdown
from impc.arrays import Array
from impc.assess.structured_weights import Tangent, tangent, weight_covariance
from impc.assess.structures import structure_test
from impc.assess.weight_profiles import WeightProfiles
from impc.control.controller import Controller
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem
from impc.inverse.structured import fit_structure, search_from
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.structure import Structure
from impc.model.weights import Weights
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

__all__ = ["Person", "Score", "cart_person", "score", "seat_person"]

_BODY = ("theta1", "theta2", "theta1_rate", "theta2_rate")
_TYPICAL = np.log([6e3, 9e3, 6e2, 4e2])
# Two searches ended at the same minimum if their misfits differ by less, units of chi-squared.
_GLOBAL = 0.5


class Person(NamedTuple):
    """A simulated subject."""

    structure: Structure  # Fitted structure
    cost_weights: Array  # True logarithms of the cost weights (count,)
    problem: Problem


class Score(NamedTuple):
    """A fit compared with its truth; lists have an item for each cost weight."""

    holds: list[bool]  # Whether the profile interval covers the true value
    normal: list[bool]  # The same of the normal interval
    one_sided: list[bool]  # Whether the profile has no lower end
    errors: list[float | None]  # Errors of the logarithms over their SEs; None: fitted as zero
    excess: float  # Misfit above that of a search from the truth, units of chi-squared
    probability: float  # p value of the test of the structure
    freedom: int  # Degrees of freedom of that test
    power: float  # Predicted power, the largest over cross terms


def seat_person(seed: int, vaf: float, root: float) -> Person:
    """A seated subject whose true controller has a VAF of `vaf` % with noise of that root."""
    rng = np.random.default_rng([seed, round(vaf), round(100 * root)])
    plant = Plant(plants.seated_balance_plant(), ["command"])
    structure = Structure(plant, "diagonal", over=_BODY)
    cost_weights = _TYPICAL + rng.uniform(-np.log(4), np.log(4), 4)
    controller = Controller(
        plant, structure.weights(cost_weights), Bounds(plant), 20, terminal_set=False
    )
    trials = []
    for phase in (None, 1, 2):
        torque = plants.ternary_torque(duration=30.0, rate=100, seed=phase)
        trials.append(with_noise(controller, torque, rng, vaf, root))
    return Person(structure, cost_weights, fit_problem(plant, trials, FitSettings()))


def cart_person(seed: int, vaf: float, root: float, cross: float) -> Person:
    """Two carts; the cross term of the positions is `cross` times their geometric mean."""
    rng = np.random.default_rng([seed, round(vaf), round(100 * root), round(100 * cross)])
    plant = carts(2)
    structure = Structure(plant, "diagonal")
    cost_weights = np.log([4.0, 5.0, 1.0, 1.0, 1.0]) + rng.uniform(-np.log(2), np.log(2), 5)
    weights = structure.weights(cost_weights)
    Q = np.array(weights.Q)
    Q[0, 1] = Q[1, 0] = cross * np.sqrt(Q[0, 0] * Q[1, 1])
    controller = Controller(
        plant, Weights(Q, weights.R), Bounds(plant, u_min=-1, u_max=1), 8, terminal_set=False
    )
    trials = []
    for _ in range(2):
        push = np.repeat(rng.choice([-0.8, 0.0, 0.8], (80, 2)), 10, axis=0)
        trials.append(with_noise(controller, push, rng, vaf, root))
    settings = FitSettings(horizon=8, u_max=1.0)
    return Person(structure, cost_weights, fit_problem(plant, trials, settings))


def score(person: Person, *, intervals: bool = True) -> Score:
    """Fit a subject from the default start, and compare with the truth.

    The test without `intervals` takes a third of the time.
    """
    problem, structure = person.problem, person.structure
    near = fit_controller(problem)
    end = fit_structure(near.problem, structure, np.array(near.gain), np.array(near.metric))
    at = tangent(structure, end.problem, np.array(end.cost_weights))
    found, tested = weight_covariance(at), structure_test(at)
    cost_weights = np.array(end.cost_weights)
    errors = [
        float((cost_weights[i] - person.cost_weights[i]) / found.each[i])
        if np.isfinite(cost_weights[i])
        else None
        for i in range(structure.count)
    ]
    made, excess = [], float("nan")
    if intervals:
        best = search_from(near.problem, structure, person.cost_weights)
        least = _misfit(tangent(structure, best.problem, np.array(best.cost_weights)))
        excess = len(at.residual) * (_misfit(at) - least) / least
        profiles = WeightProfiles(at, found)
        rows = np.eye(structure.count)
        made = [
            profiles.interval(rows[i]) if np.isfinite(cost_weights[i]) else profiles.zero(i)
            for i in range(structure.count)
        ]
    powers = [item.power for item in tested.powers]
    return Score(
        [item.holds(float(true)) for item, true in zip(made, person.cost_weights, strict=False)],
        [error is None or abs(error) <= 1.96 for error in errors],
        [item.low == -np.inf for item in made],
        errors,
        excess,
        tested.probability,
        tested.freedom,
        max(powers, default=0.0),
    )


def _misfit(at: Tangent) -> float:
    """Squared misfit with initial states projected out, as in the intervals."""
    return float(np.sum(at.without_nuisance(np.array(at.residual)[:, None]) ** 2))


def _cells(study: str, scores: Sequence[Score]) -> list[str]:
    """Row of the table."""
    whole = [one.holds for one in scores if one.holds]
    each = 100 * np.mean(whole, axis=0) if whole else []
    return [
        study,
        f"{len(scores)}",
        f"{_share(item for one in scores for item in one.holds)} "
        f"({', '.join(f'{share:.0f}' for share in each)})",
        _share(item for one in scores if None in one.errors for item in one.holds),
        _share(item for one in scores for item in one.one_sided),
        _share(item for one in scores for item in one.normal),
        _share(one.probability < 0.05 for one in scores),
        _share(one.excess < _GLOBAL for one in scores if np.isfinite(one.excess)),
        f"{100 * np.median([one.power for one in scores]):.0f}",
    ]


def _share(items: Iterable[bool]) -> str:
    """Share in %, with the standard error of independent items."""
    share, error = clustered([[item] for item in items])
    return "-" if np.isnan(share) else f"{share:.1f} ± {error:.1f}"


def _row(_: str, seed: int, given: argparse.Namespace) -> Row:
    if given.plant == "seat":
        person = seat_person(seed, given.vaf, given.root)
    else:
        person = cart_person(seed, given.vaf, given.root, given.cross)
    return score(person, intervals=not given.test_only)._asdict()


def main() -> None:
    """Score the subjects that the file does not have, and print the table of the file."""
    parser = argparse.ArgumentParser(description="Cost structures on simulated subjects.")
    parser.add_argument("plant", choices=("seat", "carts"))
    parser.add_argument("--vaf", type=float, default=90.0)
    parser.add_argument("--root", type=float, default=0.0)
    parser.add_argument("--cross", type=float, default=0.0)
    parser.add_argument("--subjects", type=int, default=200)
    parser.add_argument("--test-only", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("results", "structures.jsonl"))
    given = parser.parse_args()
    study = f"{given.plant}, VAF {given.vaf:g}, root {given.root:g}, cross {given.cross:g}"
    tasks = [(study, seed) for seed in range(given.subjects)]
    found = kept_rows(given.out, functools.partial(_row, given=given), tasks)
    head = (
        "study, subjects, profiles cover % (each), if a cost weight is zero %, one-sided %, "
        "normal intervals cover %, rejected at 5 %, global minimum %, predicted power %"
    )
    rows = [
        _cells(name, [Score(**{key: row[key] for key in Score._fields}) for row in rows])
        for name, rows in found.items()
    ]
    print(markdown(head.split(", "), rows))


if __name__ == "__main__":
    main()
