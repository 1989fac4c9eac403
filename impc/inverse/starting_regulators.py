"""Regulators at which searches begin: balanced ones, and random ones about these.

The balanced regulator is that of Bryson's rule: outputs of recorded size cost as much as commands
of full size (their bound). Every regulator stabilises (docs/fitting.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.errors import WeightsError
from impc.inverse.prediction import command_sizes
from impc.inverse.solution_set import natural_coordinates
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, normalised

if TYPE_CHECKING:
    from impc.inverse.problem import Problem
    from impc.model.riccati import LqrSolution

# Cost weights of states that no output sees, of the others'.
_UNSEEN = 1e-8
# Costs of the command, of that of the balanced regulator.
_EFFORTS = 10.0 ** np.arange(-4, 5)
# Random weights: share of the identity, and decades of the cost of the command on either side.
_DEFINITE, _DECADES = 0.05, 2.0


def balanced_regulator(problem: Problem, effort: float = 1.0) -> LqrSolution:
    """The regulator with R = effort diag(1/u^2), u the size of the commands, Q = C'diag(1/y^2)C."""
    plant, scale = problem.plant, np.asarray(problem.output_scale)
    Q = plant.C.T @ np.diag(1 / scale**2) @ plant.C
    Q += _UNSEEN * np.trace(Q) / plant.n * np.eye(plant.n)
    R = effort * np.diag(1 / command_sizes(problem) ** 2)
    return solve_lqr(plant, normalised(Weights(Q, R)))


def regulators(problem: Problem) -> list[LqrSolution]:
    """Those over eight decades of effort that double precision allows, the balanced one first."""
    found: list[LqrSolution] = []
    refused: list[WeightsError] = []
    for effort in sorted(_EFFORTS, key=lambda one: abs(np.log(one))):
        try:
            found.append(balanced_regulator(problem, effort))
        except WeightsError as error:  # so cheap a command that R is lost beside B'PB
            refused.append(error)
    if not found:
        raise refused[0]
    return found


def state_sizes(problem: Problem, regulator: LqrSolution) -> Array:
    """Unit of states (n, n) in which the outputs are of their recorded size."""
    plant = problem.plant
    T, _ = natural_coordinates(plant, np.array(regulator.K))
    natural = float(np.linalg.norm(plant.C @ T / problem.output_scale[:, None]))
    return T * (np.sqrt(len(plant.outputs)) / natural if natural > 0 else 1.0)


def drawn_start(
    problem: Problem, sizes: Array, rng: np.random.Generator
) -> tuple[Problem, LqrSolution]:
    """A random regulator, and initial states that are random where no output sees them.

    `sizes` (n, n) are those of `state_sizes`; `rng` draws.
    """
    plant, regulator = problem.plant, None
    while regulator is None:
        try:
            regulator = solve_lqr(plant, _random_weights(sizes, command_sizes(problem), rng))
        except WeightsError:  # too far apart for double precision
            continue
    if not problem.unknown_start:
        return problem, regulator
    unseen = np.eye(plant.n) - np.linalg.pinv(plant.C) @ plant.C
    drawn = rng.standard_normal((len(problem.recordings), plant.n)) @ sizes.T @ unseen.T
    return problem.at(problem.starts + drawn, np.array(problem.logarithms)), regulator


def _random_weights(sizes: Array, commands: Array, rng: np.random.Generator) -> Weights:
    """Random weights of states and commands, each over its size."""
    parts = []
    for size in (len(sizes), len(commands)):
        L = np.tril(rng.standard_normal((size, size)))
        parts.append(L @ L.T + _DEFINITE * np.eye(size))
    back, unit = np.linalg.inv(sizes), np.diag(1 / commands)
    R = 10 ** rng.uniform(-_DECADES, _DECADES) * unit @ parts[1] @ unit
    Q = back.T @ parts[0] @ back
    return normalised(Weights((Q + Q.T) / 2, (R + R.T) / 2))
