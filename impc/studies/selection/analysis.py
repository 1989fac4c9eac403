"""Selection of sensitive parameters (chapter 4) and of key parameters (chapter 5).

Sensitive, for each subject: fit of all parameters and Fisher information, then fit of the selected
subset, bootstrap intervals, and LASSO for comparison. Bootstrap: fit -> centred residuals ->
resampled, singly or in blocks -> added to the fit's outputs -> fitted again -> percentiles. For
autocorrelated residuals, single draws give intervals that are too narrow; blocks do not
(`impc.assess.resampling.block_length`). Replicate k uses the k-th child of the seed. Sources:
chapter 4; Künsch 1989 for the blocks.

Key, by four consecutive filters (5.5):

    variability        max over subjects and visits of max diag F_s^-1 <= v
    goodness of fit    mean VAF of the refitted subset above a threshold
    reliability        min over the subset of ICC(A,k) between visits (5.6), (5.7); here the lower
                       end of its 95 % interval >= rho, because an ICC of few people varies much
    diversity          number of distinct pathways in the subset; the largest is selected
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, Frozen, frozen, percentiles
from impc.assess.long_run_covariance import residual_noise, white_noise
from impc.assess.resampling import block_residuals
from impc.errors import DataError
from impc.studies.pool import threads
from impc.studies.reliability.icc import GOOD, icc
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
)
from impc.studies.selection.lasso import Lasso, lasso_of_size
from impc.studies.selection.model import ParametricModel, Trial
from impc.studies.selection.model_source import Runner
from impc.studies.selection.settings import SelectSettings


@dataclass(frozen=True)
class StudySelection:
    """Result of `select_study`."""

    nominal: Mapping[str, Nominal]  # Subject and visit -> fit of all parameters, information
    # Sweep over bounds with (5.5): largest variance over all subjects and visits
    worst_case: tuple[Selection, ...]
    # Refitted subset: the best at the bound, or at the first bound of the sweep with a feasible one
    free: tuple[int, ...]
    bound: float  # Bound of its variance
    chosen: Mapping[str, Chosen]  # Subject and visit -> refit of that subset, intervals, LASSO
    lasso: tuple[int, ...]  # Subset that the LASSO selects most often


@dataclass(frozen=True)
class Nominal:
    """Fit of all parameters of one subject, and their identifiability."""

    fit: Estimate
    information: Information  # At this fit


@dataclass(frozen=True)
class Chosen(Frozen):
    """Fits of the selected parameters of one subject, and selection by LASSO."""

    refit: Estimate  # Other parameters fixed at typical values
    exact: Array  # Lower and upper ends (2, free) of the bootstrap intervals of `refit`
    known: PriorFit  # Other parameters with a prior: typical values and their SDs
    lasso: Lasso


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
    best = next((one for one in (at_bound, *worst) if one.subsets), None)
    if best is None:
        raise DataError(
            "selection", "no subset is feasible at any bound", "raise [select] bound or lower least"
        )
    free = best.subsets[0]
    chosen = run(fit_chosen, Chosen, {name: (trials[name], settings, free) for name in trials})
    lasso = Counter(item.lasso.selected for item in chosen.values()).most_common(1)[0][0]
    return StudySelection(nominal, worst, free, best.bound, chosen, lasso)


def fit_nominal(
    model: ParametricModel, trials: Sequence[Trial], settings: SelectSettings
) -> Nominal:
    """Fit all parameters from several starts, and compute the Fisher information."""
    fit = multi_start(model, trials, range(model.size), settings.starts, settings.seed)[0]
    return Nominal(fit, fisher_information(model, np.array(fit.theta), trials))


def fit_chosen(
    model: ParametricModel,
    trials: Sequence[Trial],
    settings: SelectSettings,
    chosen: tuple[int, ...],
) -> Chosen:
    """Fit the chosen parameters with intervals, and select by LASSO for comparison."""
    refit = estimate(model, trials, chosen, np.array(model.typical))
    draw, noise_of = _DRAW[settings.draw]
    drawn = bootstrap_subset(model, trials, refit, settings.replicates, settings.seed, draw)
    known = estimate_with_prior(model, trials, chosen, np.array(refit.theta), noise_of)
    ends = frozen(percentiles(drawn, 0.95))
    return Chosen(refit, ends, known, lasso_of_size(model, trials, settings.size))


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
) -> Array:
    """Free parameters (replicates, free) of a fit, refitted to resampled residuals."""
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
        return np.array(list(pool.map(one, range(replicates))))


@dataclass(frozen=True)
class Candidate:
    """A sensitive subset and its results in the other filters."""

    subset: tuple[int, ...]  # Indices of its parameters
    variance: float  # Largest variance over subjects and visits, in normalised units
    vaf: float  # Mean VAF over subjects and visits, %
    reliability: float  # Smallest ICC(A,k) of its parameters; NaN if undefined
    certain: float  # Smallest lower end of their 95 % intervals; NaN if undefined
    diversity: int  # Number of pathways
    explained: bool  # Whether it passes goodness of fit
    kept: bool  # Whether it passes goodness of fit and reliability


@dataclass(frozen=True)
class KeyParameters(Frozen):
    """Outcome of the filters."""

    selection: Selection  # Subsets of the first filter
    sweep: tuple[Selection, ...]  # The first filter at other bounds
    # Best first: kept ones, then by diversity, then by reliability
    candidates: tuple[Candidate, ...]
    chosen: tuple[int, ...]  # First kept subset; empty if none is kept
    # Estimates with all parameters free (parameters, subjects, visits), in physical units
    nominal: Array
    # Estimates of the chosen subset (chosen, subjects, visits), in physical units
    estimates: Array


def refit_subsets(
    model: ParametricModel, trials: Sequence[Trial], subsets: tuple[tuple[int, ...], ...]
) -> tuple[Estimate, ...]:
    """Fit each of the `subsets`, the other parameters fixed at their typical values."""
    typical = np.array(model.typical)
    return tuple(estimate(model, trials, subset, typical) for subset in subsets)


def key_parameters(
    model: ParametricModel,
    recorded: Mapping[tuple[str, str], Sequence[Trial]],
    settings: SelectSettings,
    run: Runner,
    *,
    bound: float = 0.35,
    least_vaf: float = 69.0,
    least_reliability: float = GOOD,
    most: int = 20,
) -> KeyParameters:
    """Select key parameters of a study; `recorded` by (subject, visit)."""
    subjects, visits = (tuple(dict.fromkeys(one)) for one in zip(*recorded, strict=True))
    whole = sum(all((one, visit) in recorded for visit in visits) for one in subjects)
    if min(whole, len(visits)) < 2:
        found = f"has {whole} subjects with all visits, and {len(visits)} visits"
        raise DataError("study", found, "record at least 2 of each")
    trials = {" visit ".join(filter(None, key)): tuple(item) for key, item in recorded.items()}
    nominal = run(fit_nominal, Nominal, {name: (trials[name], settings) for name in trials})
    informations = [np.asarray(item.information.F) for item in nominal.values()]
    selection = largest_subsets(informations, bound, settings.least)
    subsets = selection.subsets[:most]
    refits = run(
        refit_subsets, tuple[Estimate, ...], {name: (trials[name], subsets) for name in trials}
    )
    candidates = []
    for place, subset in enumerate(subsets):
        fits = [item[place] for item in refits.values()]
        vaf = float(np.mean([np.mean(item.vaf) for item in fits]))
        # (5.6): minimum over the subset of the ICC, and of the lower end of its interval.
        tables = _by_visit(recorded, fits, subset)
        iccs = [icc(table, "A,k", "generalised")[:2] for table in tables]
        reliability, certain = np.min(iccs, axis=0).tolist()
        diversity, explained = len({model.pathways[index] for index in subset}), vaf > least_vaf
        candidates.append(Candidate(
            subset, selection.variances[place], vaf, reliability, certain, diversity, explained,
            explained and certain >= least_reliability,
        ))  # fmt: skip
    candidates.sort(
        key=lambda item: (not item.kept, -item.diversity, -np.nan_to_num(item.reliability))
    )
    chosen = candidates[0].subset if candidates and candidates[0].kept else ()
    alone = [item[subsets.index(chosen)] for item in refits.values()] if chosen else []
    return KeyParameters(
        selection,
        sweep(informations, settings.bounds, settings.least),
        tuple(candidates),
        chosen,
        _by_visit(recorded, [item.fit for item in nominal.values()], range(model.size)),
        _by_visit(recorded, alone, chosen),
    )


def _by_visit(
    keys: Iterable[tuple[str, str]], fits: Sequence[Estimate], subset: Sequence[int]
) -> Array:
    """Estimates of a subset (len(subset), subjects, visits); NaN if a visit is missing."""
    subjects, visits = (list(dict.fromkeys(one)) for one in zip(*keys, strict=True))
    values = np.full((len(subset), len(subjects), len(visits)), np.nan)
    for (subject, visit), found in zip(keys, fits, strict=bool(subset)):
        place = subjects.index(subject), visits.index(visit)
        values[:, *place] = np.array(found.theta)[list(subset)]
    return frozen(values)
