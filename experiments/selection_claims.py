"""The surviving claims of chapters 4 and 5 beside what this package finds on simulated cohorts.

    python -m experiments.selection_claims --replicates 200

Ten subjects as `impc simulate head-tracking` makes them (chapter 4), and ten about the FIM column
of table 4.3 for the widths of its intervals. The dissertation's numbers are of its own subjects.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

import plants
from impc.selection.bootstrap import bootstrap_subset
from impc.selection.estimation import estimate, free_indices
from impc.selection.fisher import fisher_information
from impc.selection.model import Trial
from impc.selection.source import model_source
from impc.selection.subsets import largest_subsets

__all__ = ["Width", "bootstrap_widths"]

_FREE = ("Kvis", "Kccr", "tau", "tau1A", "tauCNS1")
# Table 4.3, FIM column: SD of the estimates over subjects; mean and SD of the interval widths.
_SPREAD = np.array([27.0, 11.9, 0.024, 0.013, 0.077])
_QUOTED = ((62.0, 19.0), (18.2, 6.0), (0.020, 0.010), (0.030, 0.015), (0.138, 0.069))
_VAF = (0.8265, 0.0757)


@dataclass(frozen=True)
class Width:
    """Width of an interval: ours over ten subjects, and the dissertation's mean and SD."""

    name: str
    mean: float
    spread: float
    quoted: float
    deviation: float


def bootstrap_widths(shortest: float, longest: float, replicates: int) -> tuple[Width, ...]:
    """Mean widths over ten subjects about the FIM column; steps of a duration in s."""
    model = model_source("plants:head_neck_model", {}).model
    nominal = np.array(model.typical)
    centre = np.array(
        [
            base if value is None else value
            for value, base in zip(plants.TABLE_4_3["fim"], nominal, strict=True)
        ],
        dtype=float,
    )
    free = list(free_indices(model, _FREE))
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
        widths.append(bootstrap_subset(model, trials, fit, replicates, subject).width)
    mean, spread = np.mean(widths, axis=0), np.std(widths, axis=0, ddof=1)
    return tuple(
        Width(name, float(a), float(b), *quoted)
        for name, a, b, quoted in zip(_FREE, mean, spread, _QUOTED, strict=True)
    )


def main() -> None:
    """Print the widths for several step durations, and the subsets at the nominal column."""
    parser = argparse.ArgumentParser(description="Claims of chapters 4 and 5.")
    parser.add_argument("--replicates", type=int, default=60)
    given = parser.parse_args()
    for shortest, longest in ((0.3, 0.9), (0.2, 0.6), (0.5, 1.5)):
        print(f"\nwidths of 95 % intervals, ten subjects, steps of {shortest} to {longest} s")
        for item in bootstrap_widths(shortest, longest, given.replicates):
            inside = abs(item.mean - item.quoted) <= item.deviation
            print(
                f"  {item.name:8} {item.mean:8.3g} ± {item.spread:7.2g}   dissertation "
                f"{item.quoted:g} ± {item.deviation:g}   {'inside' if inside else 'outside'}"
            )
    model = model_source("plants:head_neck_model", {}).model
    theta = np.array(model.typical)
    trials = []
    for number in range(3):
        reference = plants.step_reference(seed=number)[:, None]
        trials.append(Trial(reference, model.simulate(theta, reference)))
    power = np.mean(np.concatenate([item.outputs for item in trials]) ** 2)
    found = fisher_information(model, theta, trials, float((1 / 0.8226 - 1) * power))
    print(f"\nnominal column: rank {found.rank} of 12")
    for bound in (0.05, 0.15, 0.35, 0.95):
        selection = largest_subsets([found.F], bound)
        names = ", ".join(model.names[index] for index in selection.subsets[0])
        print(f"  v = {bound:.2f}: {len(selection.subsets)} subsets of {selection.size}; {names}")
        if bound == 0.05:
            place = selection.subsets.index(free_indices(model, _FREE)) + 1
            print(f"           the dissertation's {', '.join(_FREE)} is number {place}")


if __name__ == "__main__":
    main()
