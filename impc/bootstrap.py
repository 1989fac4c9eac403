"""Bootstrap of a fitted controller: simulate, add residuals drawn again, fit again.

The disturbance is known and the same in every replicate; only the residuals are drawn.

    moving blocks   blocks of the residuals of all trials, laid end to end (Künsch 1989); their
                    length is that of Politis and White (2004) for a first-order process,
                    (6 a^2 / (1 - a^2)^2)^(1/3) T^(1/3), the longest of the outputs
    model           an autoregression for each output by Burg's method, its order by AIC; the rows
                    of its innovations drawn one by one, so that outputs keep their correlation

Replicate k draws from the k-th child of the seed: the same numbers in any order, on any machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.signal
from statsmodels.regression.linear_model import burg

from impc.arrays import Array, Frozen, frozen
from impc.closed_loop import simulate
from impc.errors import InputError
from impc.fitted_controller import fit_controller
from impc.intervals import Interval, entry_names
from impc.inverse_problem import controller_for, scenarios

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.fitted_controller import FittedController
    from impc.inverse_problem import InverseProblem

__all__ = [
    "DRAWS",
    "Draw",
    "Replicate",
    "block_length",
    "block_residuals",
    "bootstrap",
    "bootstrap_intervals",
    "model_residuals",
    "replicate",
]

#: Draws residuals again: (residuals (samples, p) of each trial, generator) -> as many.
Draw = Callable[[list[Array], np.random.Generator], list[Array]]

_HIGHEST_ORDER = 12
_BEFORE = 500


@dataclass(frozen=True)
class Replicate(Frozen):
    """Estimates of one replicate.

    Attributes
    ----------
    K : Array
        (m, n).
    parameters : Array
        Physical parameters in their units (k,).
    """

    K: Array
    parameters: Array


def bootstrap(
    fitted: FittedController,
    count: int,
    seed: int,
    resample: Draw,
    progress: Callable[[int], None] = lambda _: None,
) -> tuple[Replicate, ...]:
    """Fit `count` replicates one after the other; `progress` is told each one's number.

    Parameters
    ----------
    seed : int
        All numbers drawn follow from it.
    resample : Draw
        `block_residuals` or `model_residuals`.

    Raises
    ------
    InputError
        When there are fewer than two replicates.
    WeightsError, SolverError
        When a replicate cannot be fitted.
    """
    if count < 2:
        raise InputError("replicates", f"got {count}", "give at least 2")
    found = []
    for index in range(count):
        found.append(replicate(fitted, index, seed, resample))
        progress(index)
    return tuple(found)


def replicate(
    fitted: FittedController,
    index: int,
    seed: int,
    resample: Draw,
) -> Replicate:
    """One replicate, by its number.

    Parameters
    ----------
    index : int
        The child of the seed that it draws from, from 0.
    seed : int
        That of the whole bootstrap.
    resample : Draw
        As in `bootstrap`.

    Raises
    ------
    WeightsError, SolverError
        When it cannot be fitted.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    clean, residuals = _split(fitted)
    drawn = resample(residuals, rng)
    trials = tuple(
        replace(trial, outputs=frozen(outputs + noise))
        for trial, outputs, noise in zip(fitted.problem.recordings, clean, drawn, strict=True)
    )
    again = fit_controller(replace(fitted.problem, recordings=trials), fitted.weights)
    return Replicate(again.solution.K, frozen(_parameters(again.problem)))


def bootstrap_intervals(
    fitted: FittedController, replicates: Sequence[Replicate], method: str, level: float
) -> tuple[Interval, ...]:
    """Percentile intervals of the entries of K and of the parameters.

    Parameters
    ----------
    method : str
        Name of the bootstrap, kept in each interval.
    level : float
        Share of the replicates inside, between 0 and 1.
    """
    names = list(entry_names(fitted.problem.plant))
    values = [*np.ravel(fitted.solution.K), *_parameters(fitted.problem)]
    if fitted.problem.family is not None:
        names += fitted.problem.family.names
    drawn = np.array([np.append(np.ravel(item.K), item.parameters) for item in replicates])
    ends = np.quantile(drawn, [0.5 - level / 2, 0.5 + level / 2], axis=0)
    return tuple(
        Interval(name, method, level, float(value), float(low), float(high))
        for name, value, low, high in zip(names, values, *ends, strict=True)
    )


def block_residuals(residuals: list[Array], rng: np.random.Generator) -> list[Array]:
    """A `Draw` in moving blocks: `residuals` (samples, p) of each trial to as many, (samples, p).

    `rng` is what is drawn from.
    """
    centred = [part - np.mean(part, axis=0) for part in residuals]
    length = block_length(residuals)
    drawn = []
    for part in centred:
        blocks: list[Array] = []
        while sum(map(len, blocks)) < len(part):
            source = centred[rng.integers(len(centred))]
            first = rng.integers(max(len(source) - length, 0) + 1)
            blocks.append(source[first : first + length])
        drawn.append(np.concatenate(blocks)[: len(part)])
    return drawn


def block_length(residuals: list[Array]) -> int:
    """Samples of a block for `residuals` (samples, p), by the rule of the module's text."""
    above = sum(np.sum(part[1:] * part[:-1], axis=0) for part in residuals)
    below = sum(np.sum(part**2, axis=0) for part in residuals)
    root = np.clip(np.divide(above, below, out=np.zeros_like(below), where=below > 0), -0.99, 0.99)
    total = sum(map(len, residuals))
    best = np.max(np.cbrt(6 * root**2 / (1 - root**2) ** 2 * total))
    return int(np.clip(np.ceil(best), 1, min(map(len, residuals))))


def model_residuals(residuals: list[Array], rng: np.random.Generator) -> list[Array]:
    """A `Draw` by autoregressions: `residuals` (samples, p) of each trial to as many, (samples, p).

    They are fitted to all trials; `rng` is what is drawn from.
    """
    centred = [part - np.mean(part, axis=0) for part in residuals]
    outputs = centred[0].shape[1]
    models = [_autoregression([part[:, output] for part in centred]) for output in range(outputs)]
    longest = max(map(len, models))
    innovations = np.concatenate(
        [
            np.column_stack(
                [scipy.signal.lfilter(model, [1.0], part[:, i]) for i, model in enumerate(models)]
            )[longest - 1 :]
            for part in centred
        ]
    )
    drawn = []
    for part in centred:
        rows = innovations[rng.integers(len(innovations), size=len(part) + _BEFORE)]
        columns = [
            scipy.signal.lfilter([1.0], model, rows[:, i])[_BEFORE:]
            for i, model in enumerate(models)
        ]
        drawn.append(np.column_stack(columns))
    return drawn


#: By the word that `bootstrap` of [fit] gives.
DRAWS: dict[str, Draw] = {"block": block_residuals, "model": model_residuals}


def _autoregression(parts: list[Array]) -> Array:
    """1, -a_1, ..., -a_r: Burg's on the trials end to end, its order by AIC."""
    joined = np.concatenate(parts)
    best, chosen = np.inf, np.array([1.0])
    for order in range(1, _HIGHEST_ORDER + 1):
        coefficients, variance = burg(joined, order, demean=False)
        criterion = len(joined) * np.log(variance) + 2 * order
        if criterion < best:
            best, chosen = criterion, np.append(1.0, -coefficients)
    return np.asarray(chosen)


def _split(fitted: FittedController) -> tuple[list[Array], list[Array]]:
    """Simulated outputs of every trial, and what is left of the recorded ones."""
    known = replace(fitted.problem, unknown_start=False, family=None, logarithms=frozen([]))
    controller = controller_for(known, np.array(fitted.solution.K), np.array(fitted.solution.S))
    runs = [simulate(controller, drive) for drive in scenarios(known)]
    clean = [np.asarray(run.x @ known.plant.C.T) for run in runs]
    residuals = [
        np.asarray(trial.outputs - outputs)
        for trial, outputs in zip(known.recordings, clean, strict=True)
    ]
    return clean, residuals


def _parameters(problem: InverseProblem) -> Array:
    if problem.family is None:
        return np.zeros(0)
    return np.asarray(problem.family.nominal * np.exp(problem.logarithms))
