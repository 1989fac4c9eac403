"""Tables of the study of subjects with sensory noise, and summaries of each kind."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import TWO_SIDED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from experiments.noisy_people_score import Score

__all__ = ["HEADS", "means", "pooled", "row", "table"]

#: Headings of the columns.
HEADS = (
    "subjects", "count", "at the limit %", "ended at the truth or above", "converged",
    "least squares: error %", "bias / deviation", "95 % holds %",
    "likelihood: error %", "bias / deviation", "95 % holds % (sandwich)", "(expected)",
    "(profile)", "entries identified, all", "SDs hold %", "seconds: least squares, likelihood",
)  # fmt: skip
# Fall of the likelihood at either end of a 95 % interval, nats.
_LOWER = TWO_SIDED**2 / 2
# An entry is identified if half of its interval is below this share of it.
_IDENTIFIED = 1.0
# A search ended at the truth if it is at most so far below it, nats.
_ENDED = 0.5
# Small bias, in standard errors.
_BIAS = 0.25

Pairs = list[tuple[float, float]]


def table(studies: Sequence[list[Score]]) -> list[str]:
    """Markdown table without columns that are empty in all studies.

    Parameters
    ----------
    studies : sequence of list of Score
        Scores of one kind each.
    """
    rows = [row(each) for each in studies]
    filled = [k for k in range(len(HEADS)) if any(cells[k] != "-" for cells in rows)]
    lines = [[cells[k] for k in filled] for cells in (HEADS, *rows)]
    texts = ["| " + " | ".join(cells) + " |" for cells in lines]
    return [texts[0], "|" + "---|" * len(filled), *texts[1:]]


def row(scores: list[Score]) -> list[str]:
    """Cells of one study, by column.

    Parameters
    ----------
    scores : list of Score
        Scores of the same kind of subjects.
    """
    cells = [
        scores[0].study,
        str(len(scores)),
        f"{100 * np.mean([one.saturated for one in scores]):.0f}",
        f"{sum(one.above >= -_ENDED for one in scores)}",
        f"{sum(one.converged for one in scores)}",
    ]
    for name in ("least", "likely"):
        pairs = [getattr(one, name) for one in scores]
        cells.append(f"{100 * np.median([getattr(one, f'{name}_error') for one in scores]):.1f}")
        cells += [_bias(pairs), _share([_inside(each) for each in pairs])]
    cells.append(_share([_inside(one.expected) for one in scores]))
    cells.append(_share([[nats <= _LOWER for nats in one.fell] for one in scores if one.fell]))
    identified = [
        [pair for pair in one.entries if pair[1] - pair[0] < 2 * _IDENTIFIED] for one in scores
    ]
    some = f"{_share([_around(each) for each in identified])} ({sum(map(len, identified))})"
    cells.append(f"{some}, {_share([_around(one.entries) for one in scores])}")
    cells.append(_share([_levels(one) for one in scores]))
    times = np.median([one.seconds[:2] for one in scores], axis=0)
    return [*cells, ", ".join(f"{value:.1f}" for value in times)]


def means(pairs: Sequence[Pairs]) -> list[tuple[float, float]]:
    """Mean error over SE, with its standard error, of each direction that most subjects identify.

    Parameters
    ----------
    pairs : sequence of list of pairs
        Error and standard error along the identified directions of each subject, best first.
    """
    found = []
    for each in itertools.zip_longest(*pairs):
        ratios = np.array([pair[0] / pair[1] for pair in each if pair is not None])
        if len(ratios) > len(pairs) / 2:
            spread = np.std(ratios, ddof=1) if len(ratios) > 1 else np.nan
            found.append((float(np.mean(ratios)), float(spread / np.sqrt(len(ratios)))))
    return found


def pooled(studies: Sequence[list[Score]]) -> str:
    """Summarise all subjects of several kinds in one line.

    Parameters
    ----------
    studies : sequence of list of Score
        Scores of one kind each.
    """
    scores = list(itertools.chain(*studies))
    biases = [each for one in studies for each in means([score.likely for score in one])]
    far = [one for one in scores if one.likely_error > 1]
    settled = [one for one in far if one.converged]
    small = sum(abs(mean) < _BIAS for mean, _ in biases)
    farthest = max((abs(mean) / error for mean, error in biases if error > 0), default=0.0)
    counts = (
        f"directions {_count([_inside(one.likely) for one in scores])}",
        f"entries {_count([_around(one.entries) for one in scores])}",
        f"noise SDs {_count([_levels(one) for one in scores])}",
        f"converged {sum(one.converged for one in scores)}",
        f"gains off by more than themselves {len(far)}, of which {len(settled)} converged",
        f"mean errors below {_BIAS} {small} of {len(biases)}",
        f"the farthest {farthest:.1f} of its standard errors from none",
        f"mean errors of all {_bias([one.likely for one in scores])}",
    )
    return f"{len(scores)} subjects: " + ", ".join(counts)


def _bias(pairs: Sequence[Pairs]) -> str:
    return ", ".join(f"{mean:.2f} ± {error:.2f}" for mean, error in means(pairs)) or "-"


def _levels(score: Score) -> list[bool]:
    """Whether each noise SD is inside its interval."""
    both = zip(score.levels, score.level_intervals, strict=True)
    return [low <= level <= high for level, (low, high) in both]


def _inside(pairs: Pairs) -> list[bool]:
    return [abs(error) <= TWO_SIDED * deviation for error, deviation in pairs]


def _around(intervals: Pairs) -> list[bool]:
    return [low <= 0 <= high for low, high in intervals]


def _count(holds: list[list[bool]]) -> str:
    inside, all_ = sum(map(sum, holds)), sum(map(len, holds))
    return f"{inside} of {all_} ({100 * inside / max(all_, 1):.1f} %)"


def _share(holds: list[list[bool]]) -> str:
    """Share in % with its standard error for independent subjects; "-" without data."""
    if not holds:
        return "-"
    counts = np.array([[sum(each), len(each)] for each in holds], dtype=np.float64)
    share = counts[:, 0].sum() / max(counts[:, 1].sum(), 1)
    left = counts[:, 0] - share * counts[:, 1]
    error = np.sqrt(np.sum(left**2)) / max(counts[:, 1].sum(), 1)
    return f"{100 * share:.0f} ± {100 * error:.0f}"
