"""Compare the standard errors that a plan predicts with the scatter of simulated fits.

    python -m experiments.plan_study cart --fits 100
    python -m experiments.plan_study seat --fits 100

Every experiment of a small grid is planned and fitted with new noise, so the best amplitude of the
plan can be compared with the best one of the fits. The cart is at its limit in up to a fifth of the
samples. The seat has three trials of 30 s, coloured noise and no limit. Results:
experiments/planning.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

import plants
from experiments.driver import each
from experiments.printed_intervals import carts
from experiments.summary import markdown
from impc.arrays import Array
from impc.control.controller import Controller
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.weights import Weights
from impc.studies.plan.designs import Design, Person, Perturbation, designs, try_design
from impc.studies.plan.study import simulated_fits

__all__ = ["cart", "compare", "seat"]


def _person(plant: Plant, diagonal: list[float], bounds: Bounds, horizon: int,
            noise: Array, root: float) -> Person:  # fmt: skip
    """Assumed subject with cost weights of the first states."""
    Q = np.diag(np.append(diagonal, np.zeros(plant.n - len(diagonal))))
    law = Controller(plant, Weights(Q, 1), bounds, horizon, terminal_set=False)
    return Person(law, noise, root, np.full(len(noise), np.inf))


def cart() -> tuple[Person, Perturbation, tuple[Design, ...], int]:
    """A cart pushed at random for 40 s, with white noise."""
    plant = carts(1)
    bounds = Bounds(plant, u_min=-1, u_max=1)
    person = _person(plant, [4.0, 1.0], bounds, 8, np.array([0.03]), 0.0)

    def push(amplitude: float, dwell: float, number: int) -> Array:
        levels = np.random.default_rng([5, number]).choice([-amplitude, 0, amplitude], (400, 1))
        return np.repeat(levels, round(dwell / plant.dt), axis=0)[:400]

    return person, push, designs([0.3, 0.6, 0.8], [0.5, 2.0]), 2


def seat() -> tuple[Person, Perturbation, tuple[Design, ...], int]:
    """The seated subject of experiments/structures.md, noise with a correlation time of 50 ms."""
    plant = Plant(plants.seated_balance_plant(), ["command"])
    noise, root = np.radians([0.05, 0.05]), float(np.exp(-0.01 / 0.05))
    person = _person(plant, [6e3, 9e3, 6e2, 4e2], Bounds(plant), 20, noise, root)

    def torque(amplitude: float, dwell: float, number: int) -> Array:
        return plants.ternary_torque(amplitude, dwell, 30.0, 100.0, seed=number)[:, None]

    return person, torque, designs([3.0, 6.0], [0.125, 0.25]), 3


_PEOPLE: dict[str, Callable[[], tuple[Person, Perturbation, tuple[Design, ...], int]]] = {
    "cart": cart,
    "seat": seat,
}


def _compared(task: tuple[str, int, int]) -> tuple[Design, Array, Array] | None:
    """Predicted and observed standard errors of the experiment of an index of a grid."""
    name, index, fits = task
    person, perturbation, grid, trials = _PEOPLE[name]()
    tried = try_design(person, grid[index], perturbation, trials=trials, draws=trials)
    if tried.expected is None or tried.problem is None:
        return None
    seen = simulated_fits(person, tried.problem, fits, 1)
    gain = tried.expected.gain
    steps = np.array([gain.along(K - person.controller.K) for K in seen.gains])
    known = gain.identified
    return grid[index], gain.deviations[known], np.std(steps[:, known], axis=0)


def compare(name: str, fits: int) -> list[tuple[Design, Array, Array]]:
    """Experiment, then predicted and observed standard errors of identified directions."""
    tasks = [(name, index, fits) for index in range(len(_PEOPLE[name]()[2]))]
    return [found for found in each(_compared, tasks) if found is not None]


def main() -> None:
    """Print a row for each experiment."""
    parser = argparse.ArgumentParser(description="Plans compared with simulated fits.")
    parser.add_argument("person", choices=tuple(_PEOPLE))
    parser.add_argument("--fits", type=int, default=100)
    given = parser.parse_args()
    rows = [
        [f"{design.amplitude:g}", f"{design.dwell:g}", _list(predicted), _list(seen / predicted)]
        for design, predicted, seen in compare(given.person, given.fits)
    ]
    print(markdown(["amplitude", "hold time (s)", "predicted", "observed / predicted"], rows))


def _list(values: Array) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


if __name__ == "__main__":
    main()
