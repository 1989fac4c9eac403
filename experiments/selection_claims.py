"""Compare the surviving claims of chapters 4 and 5 with simulated cohorts.

    python -m experiments.selection_claims --replicates 200 --nelder-mead

Ten subjects of `impc simulate head-tracking` (chapter 4), and ten about the FIM column of table 4.3
for the widths of its intervals. Results: experiments/reliability_selection.md.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

import plants
from experiments.summary import markdown
from impc.arrays import Array, percentiles
from impc.studies.selection.analysis import bootstrap_subset
from impc.studies.selection.estimation import estimate, free_indices
from impc.studies.selection.fisher import (
    Information,
    Selection,
    fisher_information,
    largest_subsets,
    subset_variances,
    sweep,
)
from impc.studies.selection.lasso import lasso_objective, lasso_of_size
from impc.studies.selection.model import ParametricModel, Trial, normalised
from impc.studies.selection.model_source import model_source

__all__ = [
    "FIM_SUBSET",
    "Width",
    "bootstrap_widths",
    "exhaustive",
    "mean_subject",
    "nominal_information",
    "reduced_widths",
    "search_times",
    "table_c1",
]

#: The five parameters that the dissertation's Fisher information selects.
FIM_SUBSET = ("Kvis", "Kccr", "tau", "tau1A", "tauCNS1")
# Table 4.3, FIM column: SD of the estimates over subjects; mean and SD of the interval widths.
_SPREAD = np.array([27.0, 11.9, 0.024, 0.013, 0.077])
_LASSO = ("Kvis", "Kvcr", "Kccr", "tau", "tauC")
_COMMON = ("Kvis", "Kccr", "tau")
_QUOTED = ((62.0, 19.0), (18.2, 6.0), (0.020, 0.010), (0.030, 0.015), (0.138, 0.069))
_VAF = (0.8265, 0.0757)


@dataclass(frozen=True)
class Width:
    """Interval width over ten simulated subjects, and mean and SD in the dissertation."""

    name: str
    mean: float
    spread: float
    quoted: float
    deviation: float


def bootstrap_widths(shortest: float, longest: float, replicates: int) -> tuple[Width, ...]:
    """Mean widths over ten subjects about the FIM column; durations of the steps in s."""
    model = model_source("plants:head_neck_model", {}).model
    nominal, centre = np.array(model.typical), plants.table_4_3_column("fim")
    free = list(free_indices(model, FIM_SUBSET))
    low, high = np.array(model.low)[free], np.array(model.high)[free]
    margin = 1e-3 * (high - low)
    widths = []
    for subject in range(10):
        rng = np.random.default_rng([7, subject])
        theta = centre.copy()
        drawn = centre[free] + _SPREAD * rng.standard_normal(5)
        theta[free] = np.clip(drawn, low + margin, high - margin)
        vaf = float(np.clip(rng.normal(*_VAF), 0.6, 0.95))
        trials = []
        for number in range(3):
            reference = plants.step_reference(
                shortest=shortest, longest=longest, seed=100 * subject + number
            )[:, None]
            head = model.simulate(theta, reference)
            noise = np.sqrt((1 / vaf - 1) * np.mean(head**2))
            trials.append(Trial(reference, head + noise * rng.standard_normal(head.shape)))
        fit = estimate(model, trials, free, nominal)
        drawn = bootstrap_subset(model, trials, fit, replicates, subject)
        widths.append(np.ptp(percentiles(drawn, 0.95), axis=0))
    mean, spread = np.mean(widths, axis=0), np.std(widths, axis=0, ddof=1)
    return tuple(
        Width(name, float(a), float(b), *quoted)
        for name, a, b, quoted in zip(FIM_SUBSET, mean, spread, _QUOTED, strict=True)
    )


def mean_subject() -> tuple[ParametricModel, Array, list[Trial]]:
    """Subject of the FIM column of table 4.3: three trials, noise for a VAF of 82.65 %."""
    model = model_source("plants:head_neck_model", {}).model
    theta = plants.table_4_3_column("fim")
    rng, trials = np.random.default_rng(0), []
    for number in range(3):
        reference = plants.step_reference(seed=number)[:, None]
        head = model.simulate(theta, reference)
        noise = np.sqrt((1 / _VAF[0] - 1) * np.mean(head**2))
        trials.append(Trial(reference, head + noise * rng.standard_normal(head.shape)))
    return model, theta, trials


def nominal_information() -> tuple[ParametricModel, Information]:
    """Information at the nominal column of table 4.3, with noise for its VAF of 82.26 %."""
    model = model_source("plants:head_neck_model", {}).model
    theta = np.array(model.typical)
    trials = []
    for number in range(3):
        reference = plants.step_reference(seed=number)[:, None]
        trials.append(Trial(reference, model.simulate(theta, reference)))
    power = np.mean(np.concatenate([item.outputs for item in trials]) ** 2)
    return model, fisher_information(model, theta, trials, float((1 / 0.8226 - 1) * power))


def reduced_widths(replicates: int) -> dict[str, Array]:
    """Widths of the intervals of Kvis, Kccr and tau when 12, FIM-5 and LASSO-5 are free.

    The other parameters keep their true values, so all three fits can reach the truth.
    """
    model, theta, trials = mean_subject()
    shown = free_indices(model, _COMMON)
    found = {}
    for label, names in (("all twelve", model.names), ("FIM", FIM_SUBSET), ("LASSO", _LASSO)):
        free = free_indices(model, names)
        fit = estimate(model, trials, free, theta)
        widths = np.ptp(
            percentiles(bootstrap_subset(model, trials, fit, replicates, 0), 0.95), axis=0
        )
        found[label] = widths[[free.index(index) for index in shown]]
    return found


def exhaustive(F: Array, bound: float, least: int = 2) -> Selection:
    """`largest_subsets` of one information matrix (k, k) by exhaustive search."""
    for size in range(len(F), least - 1, -1):
        subsets = list(itertools.combinations(range(len(F)), size))
        tried = zip(subsets, subset_variances([F], subsets).tolist(), strict=True)
        found = sorted((item for item in tried if item[1] <= bound), key=lambda item: item[1])
        if found:
            return Selection(bound, *zip(*found, strict=True))
    return Selection(bound, (), ())


def _print_reduction(replicates: int) -> None:
    widths = reduced_widths(replicates)
    print(f"\nintervals of {', '.join(_COMMON)}, relative to those with all twelve free")
    print("  dissertation   FIM 11, 15, 59 %    LASSO 43, 56, 96 %")
    for label in ("FIM", "LASSO"):
        shares = 100 * widths[label] / widths["all twelve"]
        print(f"  here, {label:6}  {', '.join(f'{item:.0f}' for item in shares)} %")


def table_c1(
    model: ParametricModel, trials: Sequence[Trial], count: int, *, solves: int = 12
) -> tuple[tuple[int, ...], float, float]:
    """Table C.1: Nelder-Mead, lambda adjusted until `count` parameters exceed the threshold.

    Returns the selected parameters, lambda, and (C.5). The dissertation does not give the rule for
    lambda: it is multiplied by 2 if too many parameters moved, divided by 2 if too few; the
    factor's logarithm is halved if the direction changes. At most `solves` problems are solved.
    """
    typical = normalised(model, np.asarray(model.typical))
    weight, factor, before = 0.13, 2.0, 0
    for number in range(1, solves + 1):

        def value(u: Array, weight: float = weight) -> float:
            return lasso_objective(model, trials, np.sin(u), weight)

        found = scipy.optimize.minimize(
            value, np.arcsin(np.clip(typical, -1, 1)), method="Nelder-Mead",
            options={"maxfev": 200 * len(typical)},
        )  # fmt: skip
        moved = np.flatnonzero(np.abs(np.sin(found.x) - typical) > 0.005)
        if len(moved) == count or number == solves:
            break
        direction = 1 if len(moved) > count else -1
        if before and direction != before:
            factor = float(np.sqrt(factor))
        weight, before = weight * factor**direction, direction
    return tuple(moved.tolist()), weight, float(found.fun)


def search_times(*, nelder_mead: bool) -> dict[str, tuple[float, tuple[int, ...]]]:
    """LASSO by each method for the mean subject: run time over that of the FIM, and selection."""
    model, theta, trials = mean_subject()
    started = time.perf_counter()
    sweep([fisher_information(model, theta, trials).F], [0.05 + 0.1 * k for k in range(10)])
    fim = time.perf_counter() - started
    searches: dict[str, Callable[[], tuple[int, ...]]]
    searches = {"proximal": lambda: lasso_of_size(model, trials, 5).selected}
    if nelder_mead:
        searches["Table C.1"] = lambda: table_c1(model, trials, 5)[0]
    found = {}
    for label, search in searches.items():
        started = time.perf_counter()
        selected = search()
        found[label] = (time.perf_counter() - started) / fim, selected
    return found


def main() -> None:
    """Print widths for several step durations, their reduction, run times and subsets."""
    parser = argparse.ArgumentParser(description="Claims of chapters 4 and 5.")
    parser.add_argument("--replicates", type=int, default=60)
    parser.add_argument("--nelder-mead", action="store_true", help="Table C.1 too: minutes")
    given = parser.parse_args()
    for shortest, longest in ((0.3, 0.9), (0.2, 0.6), (0.5, 1.5)):
        rows = [
            [item.name, f"{item.quoted:g} ± {item.deviation:g}",
             f"{item.mean:.3g} ± {item.spread:.2g}",
             "inside" if abs(item.mean - item.quoted) <= item.deviation else "outside"]
            for item in bootstrap_widths(shortest, longest, given.replicates)
        ]  # fmt: skip
        head = ["width", "dissertation", f"steps of {shortest} to {longest} s", "within one SD"]
        print(markdown(head, rows), flush=True)
    _print_reduction(given.replicates)
    model, found = nominal_information()
    for label, (times, selected) in search_times(nelder_mead=given.nelder_mead).items():
        names = ", ".join(model.names[index] for index in selected)
        print(f"\nLASSO, {label}: {times:.0f} times as long as information and sweep; {names}")
    print(f"\nnominal column: rank {found.rank} of 12")
    for bound in (0.05, 0.15, 0.35, 0.95):
        selection = largest_subsets([found.F], bound)
        names = ", ".join(model.names[index] for index in selection.subsets[0])
        print(f"  v = {bound:.2f}: {len(selection.subsets)} subsets of {selection.size}; {names}")
        if bound == 0.05:
            place = selection.subsets.index(free_indices(model, FIM_SUBSET)) + 1
            print(f"           the dissertation's {', '.join(FIM_SUBSET)} is number {place}")


if __name__ == "__main__":
    main()
