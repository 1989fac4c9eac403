"""Selection of sensitive parameters (chapter 4).

For each subject: fit of all parameters and Fisher information, then fit of the selected subset,
bootstrap intervals, and LASSO for comparison.

Bootstrap: fit -> centred residuals -> resampled, singly or in blocks -> added to the fit's outputs
-> fitted again -> percentiles. For autocorrelated residuals, single draws give intervals that are
too narrow; blocks do not (`impc.assess.resampling.block_length`). Replicate k uses the k-th child
of the seed. Sources: chapter 4; Künsch 1989 for the blocks.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen, percentiles
from impc.assess.long_run_covariance import residual_noise, white_noise
from impc.assess.resampling import block_residuals
from impc.errors import DataError
from impc.studies.pool import threads
from impc.studies.selection.estimation import (
    Estimate,
    PriorFit,
    estimate,
    estimate_with_prior,
    multi_start,
    residuals,
)
from impc.studies.selection.fisher import (
    Information,
    Selection,
    fisher_information,
    largest_subsets,
    sweep,
    unseen_scalings,
)
from impc.studies.selection.lasso import Lasso, lasso_of_size, table_c1
from impc.studies.selection.model import Trial

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from impc.studies.selection.model import ParametricModel
    from impc.studies.selection.model_source import Runner
    from impc.studies.selection.settings import SelectSettings


@dataclass(frozen=True)
class StudySelection:
    """Result of `select_study`."""

    # Subject (and visit) -> fit of all parameters, information, feasible subsets
    nominal: Mapping[str, Nominal]
    # Sweep over bounds with (5.5): largest variance over all subjects and visits
    worst_case: tuple[Selection, ...]
    # Refitted subset: the best of the worst case at the bound, or at the first bound of the sweep
    # with a feasible one; otherwise the most frequent subset of the subjects
    free: tuple[int, ...]
    bound: float  # Bound of its variance
    chosen: Mapping[str, Chosen]  # Subject -> refit of that subset, intervals, LASSO
    lasso: tuple[int, ...]  # Subset that the LASSO selects most often
    # Run time of "fim", "lasso" and, if requested, "nelder_mead", s, mean over subjects
    seconds: Mapping[str, float]


def select_study(
    recorded: Mapping[str, Sequence[Trial]], settings: SelectSettings, run: Runner
) -> StudySelection:
    """Select sensitive parameters."""
    if not recorded:
        raise DataError("study", "has no subject", "check [study] recordings, table or bids")
    trials = {name: tuple(item) for name, item in recorded.items()}
    nominal = run(fit_nominal, Nominal, {name: (trials[name], settings) for name in trials})
    informations = [np.asarray(item.information.F) for item in nominal.values()]
    worst = sweep(informations, settings.bounds, settings.least)
    at_bound = largest_subsets(informations, settings.bound, settings.least)
    bound, free = _free(at_bound, worst, nominal)
    chosen = run(fit_chosen, Chosen, {name: (trials[name], settings, free) for name in trials})
    seconds = {
        "fim": float(np.mean([item.seconds for item in nominal.values()])),
        "lasso": float(np.mean([item.seconds_lasso for item in chosen.values()])),
    }
    if settings.nelder_mead:
        spent = [item.seconds_nelder_mead for item in chosen.values()]
        seconds["nelder_mead"] = float(np.mean(spent))
    return StudySelection(
        nominal,
        worst,
        free,
        bound,
        chosen,
        Counter(item.lasso.selected for item in chosen.values()).most_common(1)[0][0],
        seconds,
    )


def _free(
    at_bound: Selection, worst: tuple[Selection, ...], nominal: Mapping[str, Nominal]
) -> tuple[float, tuple[int, ...]]:
    """Subset to refit, and its bound."""
    for selection in (at_bound, *worst):
        if selection.subsets:
            return selection.bound, selection.subsets[0]
    first = [item.sweep[0] for item in nominal.values()]
    counted = Counter(subset for selection in first for subset in selection.subsets)
    if not counted:
        raise DataError(
            "selection", "no subset is feasible at any bound", "raise [select] bound or lower least"
        )
    return first[0].bound, counted.most_common(1)[0][0]


@dataclass(frozen=True)
class Nominal:
    """Fit of all parameters of one subject, and their identifiability."""

    fit: Estimate  # Fit of all parameters
    information: Information  # At this fit
    # Sets of parameters whose common scaling changes the outputs by less than their noise
    scalings: tuple[tuple[str, ...], ...]
    sweep: tuple[Selection, ...]
    seconds: float  # Run time of information and sweep, s


@dataclass(frozen=True)
class Chosen:
    """Fits of the selected parameters of one subject, and selection by LASSO."""

    refit: Estimate  # Other parameters fixed at typical values
    exact: BootstrapIntervals  # Bootstrap intervals of `refit`
    known: PriorFit  # Other parameters with a prior: typical values and their SDs
    lasso: Lasso
    nelder_mead: Lasso | None  # Table C.1, if requested
    seconds_lasso: float  # Run time, s
    seconds_nelder_mead: float


def fit_nominal(
    model: ParametricModel, trials: Sequence[Trial], settings: SelectSettings
) -> Nominal:
    """Fit all parameters; compute information, null directions and feasible subsets."""
    nominal = multi_start(model, trials, range(model.size), settings.starts, settings.seed)[0]
    started = time.perf_counter()
    found = fisher_information(model, np.array(nominal.theta), trials)
    swept = sweep([found.F], settings.bounds, settings.least)
    seconds = time.perf_counter() - started
    return Nominal(nominal, found, unseen_scalings(model, found), swept, seconds)


def fit_chosen(
    model: ParametricModel,
    trials: Sequence[Trial],
    settings: SelectSettings,
    chosen: tuple[int, ...],
) -> Chosen:
    """Fit the chosen parameters with intervals, and select by LASSO for comparison."""
    refit = estimate(model, trials, chosen, np.array(model.typical))
    draw, noise_of = _DRAW[settings.draw]
    exact = bootstrap_subset(model, trials, refit, settings.replicates, settings.seed, draw)
    known = estimate_with_prior(model, trials, chosen, np.array(refit.theta), noise_of)
    started = time.perf_counter()
    lasso = lasso_of_size(model, trials, settings.size)
    between = time.perf_counter()
    nelder_mead = table_c1(model, trials, settings.size) if settings.nelder_mead else None
    ended = time.perf_counter()
    return Chosen(refit, exact, known, lasso, nelder_mead, between - started, ended - between)


@dataclass(frozen=True)
class BootstrapIntervals(Frozen):
    """Intervals from the 2.5th to the 97.5th percentile of the replicates."""

    value: Array  # Free parameters (free,), in their units
    low: Array
    high: Array
    drawn: Array  # (replicates, free)

    @property
    def width(self) -> Array:
        """Widths of the intervals (free,), in the parameters' units."""
        return np.asarray(self.high - self.low)


def draw_single(parts: list[Array], rng: np.random.Generator) -> list[Array]:
    """Resample rows of the centred residuals `parts` (samples, p), pooled over trials."""
    pooled = np.concatenate([item - np.mean(item, axis=0) for item in parts])
    return [pooled[rng.integers(len(pooled), size=len(item))] for item in parts]


# Model of the residuals: resampling in the bootstrap, and noise for the fit with a prior.
_DRAW = {"single": (draw_single, white_noise), "block": (block_residuals, residual_noise)}


def bootstrap_subset(
    model: ParametricModel,
    trials: Sequence[Trial],
    fit: Estimate,
    replicates: int,
    seed: int,
    draw: Callable[[list[Array], np.random.Generator], list[Array]] = draw_single,
) -> BootstrapIntervals:
    """Bootstrap intervals of the free parameters of a fit."""
    theta = np.array(fit.theta)
    left = residuals(model, theta, trials)
    clean = [np.asarray(model.simulate(theta, item.input)) for item in trials]

    def one(index: int) -> Array:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
        again = [
            Trial(item.input, outputs + noise)
            for item, outputs, noise in zip(trials, clean, draw(left, rng), strict=True)
        ]
        return np.array(estimate(model, again, fit.free, theta).theta)[list(fit.free)]

    with threads(2) as pool:
        drawn = np.array(list(pool.map(one, range(replicates))))
    low, high = percentiles(drawn, 0.95)
    return BootstrapIntervals(
        frozen(theta[list(fit.free)]), frozen(low), frozen(high), frozen(drawn)
    )
