"""The largest subsets of parameters that are estimated well enough together (C.4).

    maximise |s|  subject to  rcond(F_s) > eps,  max diag F_s^-1 <= v,  |s| >= n_min

F_s is the part of the information of the chosen parameters, the others being known. Taking one
more parameter never lowers the variance of the others, so that every subset of a feasible set is
feasible: sets are grown one parameter at a time, and only from feasible ones. With twelve
parameters that is exhaustive search (4083 subsets of two and more) without the hopeless ones; with
many it is a branch and bound with the same answer.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from impc.arrays import Array

_EPS = float(np.finfo(np.float64).eps)
# Subsets of one size that are looked at, and at a time: a minute, and 0.1 GB for ten parameters.
_MOST, _AT_ONCE = 1_000_000, 50_000


@dataclass(frozen=True)
class Selection:
    """Feasible subsets of the largest size for one bound."""

    bound: float  # v
    # Best first: least largest variance. Empty when none of n_min or more is feasible.
    subsets: tuple[tuple[int, ...], ...]
    variances: tuple[float, ...]  # Largest variance of each

    @property
    def size(self) -> int:
        """Number of parameters in each subset; 0 when there is none."""
        return len(self.subsets[0]) if self.subsets else 0


def subset_variances(informations: Sequence[Array], subsets: Sequence[Sequence[int]]) -> Array:
    """Largest diagonal entry of F_s^-1 for s subsets of one size, worst over all F: (s,).

    Infinite where F_s is singular to working precision. (5.5) with several subjects and visits:
    `informations` (k, k) of each.
    """
    chosen = np.asarray(subsets, dtype=int)
    worst = np.zeros(len(chosen))
    for F in informations:
        parts = np.asarray(F)[chosen[:, :, None], chosen[:, None, :]]
        # Scaled to a unit diagonal, so that rcond is that of correlations.
        size = np.sqrt(np.einsum("sii->si", parts))
        size = np.where(size > 0, size, 1.0)
        scaled = parts / size[:, :, None] / size[:, None, :]
        values, vectors = np.linalg.eigh(scaled)
        usable = values[:, 0] > _EPS * values[:, -1]
        inverse = np.einsum(
            "sij,sj,sij->si", vectors, 1 / np.where(values > 0, values, np.inf), vectors
        )
        largest = np.max(inverse / size**2, axis=1)
        worst = np.maximum(worst, np.where(usable, largest, np.inf))
    return worst


def largest_subsets(informations: Sequence[Array], bound: float, least: int = 2) -> Selection:
    """Largest feasible subsets.

    `informations` (k, k).
    """
    if not informations or not bound > 0:
        raise InputError("selection", "needs an information and a positive bound", "give both")
    count = len(informations[0])
    level = [(index,) for index in range(count)]
    kept = _feasible(informations, level, bound)
    best = kept
    while kept:
        best = kept
        known = [subset for subset, _ in kept]
        grown = list(itertools.islice(_grown(known, count), _MOST + 1))
        if len(grown) > _MOST:
            raise InputError(
                "selection", f"more than {_MOST} subsets keep a variance of {bound:g}",
                "lower bound and bounds in [select]",
            )  # fmt: skip
        kept = _feasible(informations, grown, bound) if grown else []
    if not best or len(best[0][0]) < least:
        return Selection(bound, (), ())
    ordered = sorted(best, key=lambda item: item[1])
    return Selection(bound, tuple(item[0] for item in ordered), tuple(item[1] for item in ordered))


def _grown(known: Sequence[tuple[int, ...]], count: int) -> Iterator[tuple[int, ...]]:
    """Subsets of one parameter more, each of whose parts is among the known ones."""
    among = set(known)
    for subset in known:
        for index in range(subset[-1] + 1, count):
            parts = ((*subset[:place], *subset[place + 1 :], index) for place in range(len(subset)))
            if all(part in among for part in parts):
                yield (*subset, index)


def exhaustive(informations: Sequence[Array], bound: float, least: int = 2) -> Selection:
    """`largest_subsets` by trying every subset: for checks, and up to twenty parameters.

    `informations` (k, k).
    """
    count = len(informations[0])
    if count > 20:
        raise InputError("parameters", f"are {count}", "use `largest_subsets`")
    for size in range(count, least - 1, -1):
        subsets = list(itertools.combinations(range(count), size))
        found = _feasible(informations, subsets, bound)
        if found:
            ordered = sorted(found, key=lambda item: item[1])
            return Selection(
                bound, tuple(item[0] for item in ordered), tuple(item[1] for item in ordered)
            )
    return Selection(bound, (), ())


def sweep(
    informations: Sequence[Array], bounds: Sequence[float], least: int = 2
) -> tuple[Selection, ...]:
    """Selections over several bounds: .05, .15, ... .95 in the dissertation.

    `informations` (k, k) and `least` are those of `largest_subsets`.
    """
    return tuple(largest_subsets(informations, bound, least) for bound in bounds)


def _feasible(
    informations: Sequence[Array], subsets: Sequence[tuple[int, ...]], bound: float
) -> list[tuple[tuple[int, ...], float]]:
    parts = [subsets[at : at + _AT_ONCE] for at in range(0, len(subsets), _AT_ONCE)]
    variances = np.concatenate([subset_variances(informations, part) for part in parts])
    return [
        (subset, float(value))
        for subset, value in zip(subsets, variances, strict=True)
        if value <= bound
    ]
