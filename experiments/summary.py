"""Shares of intervals that cover the truth, with their own intervals, and Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import scipy.stats

__all__ = ["clustered", "counted", "markdown"]


def counted(inside: int, count: int) -> str:
    """A count of independent cases with the 95 % interval of its share (Clopper-Pearson)."""
    if not count:
        return "none of 0"
    low, high = scipy.stats.binomtest(inside, count).proportion_ci()
    share = 100 * inside / count
    return f"{inside} of {count}, {share:.1f} % ({100 * low:.0f} to {100 * high:.0f} %)"


def clustered(held: Sequence[Sequence[bool]]) -> tuple[float, float]:
    """Share in % and its standard error; the cases of one subject, a sequence, may be dependent."""
    counts = np.array([[sum(each), len(each)] for each in held], dtype=np.float64).reshape(-1, 2)
    inside, total = counts.sum(axis=0)
    if not total:
        return np.nan, np.nan
    left = counts[:, 0] - inside / total * counts[:, 1]
    return float(100 * inside / total), float(100 * np.sqrt(np.sum(left**2)) / total)


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown table."""
    first, *others = ["| " + " | ".join(cells) + " |" for cells in (head, *rows)]
    return "\n".join([first, "|" + "---|" * len(head), *others])
