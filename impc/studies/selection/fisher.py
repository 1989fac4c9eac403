"""Fisher information of normalised parameters, and feasible subsets.

    F = (1 / sigma^2) sum_k (dy_k/dt)' (dy_k/dt)                 (A.2), (A.6)

F^-1 bounds the covariance of any unbiased estimate (A.5). If F is singular, a combination of
parameters has no effect on the outputs.

Largest subsets s of parameters that can be estimated together (C.4):

    maximise |s|  subject to  rcond(F_s) > eps,  max diag F_s^-1 <= v,  |s| >= n_min

F_s is the submatrix of the chosen parameters; the others are assumed known. An additional parameter
never lowers the variances of the others, so every subset of a feasible set is feasible: sets are
grown by one parameter at a time from feasible sets, with the same result as exhaustive search.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.errors import InputError
from impc.studies.selection.model import ParametricModel, Trial, stacked

# Relative size below which singular values of the sensitivity count as zero.
_RANK = 1e-6


@dataclass(frozen=True)
class Information(Frozen):
    """Fisher information of all trials."""

    F: Array  # (k, k), in normalised units
    theta: Array  # Parameters (k,) at which it is computed
    variance: float  # Residual variance sigma^2
    # Number of singular values of the sensitivity to the logarithms of the parameters above 1e-6 of
    # the largest
    rank: int


def fisher_information(
    model: ParametricModel, theta: Array, trials: Sequence[Trial], variance: float | None = None
) -> Information:
    """Fisher information at `theta` (k,)."""
    errors, table = stacked(model, theta, trials)
    squares = sum(float(np.sum(part**2)) for part in errors)
    sigma2 = squares / (len(table) - model.size) if variance is None else variance
    sizes = np.linalg.svd(table / model.gain * theta, compute_uv=False)
    rank = int(np.count_nonzero(sizes > _RANK * sizes[0]))
    return Information(frozen(table.T @ table / sigma2), frozen(theta), float(sigma2), rank)


def unseen_scalings(model: ParametricModel, found: Information) -> tuple[tuple[str, ...], ...]:
    """Sets of parameters whose common scaling by e changes the outputs by at most the noise SD.

    Only parameters whose units begin alike form a set, for example N m/rad and N m s/rad.
    """
    kinds: dict[str, list[str]] = {}
    for name, unit in zip(model.names, model.units, strict=True):
        kinds.setdefault(unit.split("/")[0].split(" s")[0], []).append(name)
    unseen = []
    for kind, names in kinds.items():
        moved = np.isin(model.names, names) * np.asarray(found.theta) / model.gain
        if kind and len(names) > 1 and moved @ np.asarray(found.F) @ moved <= 1:
            unseen.append(tuple(names))
    return tuple(unseen)


_EPS = float(np.finfo(np.float64).eps)
# Largest number of subsets of one size (0.2 GB for ten parameters).
_MOST = 100_000


@dataclass(frozen=True)
class Selection:
    """Feasible subsets of the largest size for one bound."""

    bound: float  # v
    # Best (smallest largest variance) first; empty if none with n_min or more is feasible
    subsets: tuple[tuple[int, ...], ...]
    variances: tuple[float, ...]  # Largest variance of each

    @property
    def size(self) -> int:
        """Number of parameters in each subset; 0 if there is no subset."""
        return len(self.subsets[0]) if self.subsets else 0


def subset_variances(informations: Sequence[Array], subsets: Sequence[Sequence[int]]) -> Array:
    """Largest diagonal entry of F_s^-1 over `informations`, by subset (5.5); inf if singular."""
    chosen = np.asarray(subsets, dtype=int)
    worst = np.zeros(len(chosen))
    for F in informations:
        parts = np.asarray(F)[chosen[:, :, None], chosen[:, None, :]]
        # Scaled to a unit diagonal: rcond of the correlations.
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
    """Largest feasible subsets for `informations` (k, k)."""
    count = len(informations[0])
    tried: list[tuple[int, ...]] = [(index,) for index in range(count)]
    best: dict[tuple[int, ...], float] = {}
    while tried:
        if len(tried) > _MOST:
            raise InputError(
                "selection", f"more than {_MOST} subsets keep a variance of {bound:g}",
                "lower bound and bounds in [select]",
            )  # fmt: skip
        variances = subset_variances(informations, tried).tolist()
        kept = {one: size for one, size in zip(tried, variances, strict=True) if size <= bound}
        best = kept or best
        tried = list(itertools.islice(_grown(kept, count), _MOST + 1))
    ordered = sorted(best, key=lambda one: best[one])
    if not ordered or len(ordered[0]) < least:
        return Selection(bound, (), ())
    return Selection(bound, tuple(ordered), tuple(best[one] for one in ordered))


def _grown(known: Collection[tuple[int, ...]], count: int) -> Iterator[tuple[int, ...]]:
    """Subsets with one more parameter, all of whose subsets are among the known ones."""
    for subset in known:
        for index in range(subset[-1] + 1, count):
            parts = ((*subset[:place], *subset[place + 1 :], index) for place in range(len(subset)))
            if all(part in known for part in parts):
                yield (*subset, index)


def sweep(
    informations: Sequence[Array], bounds: Sequence[float], least: int = 2
) -> tuple[Selection, ...]:
    """`largest_subsets` for several bounds."""
    return tuple(largest_subsets(informations, bound, least) for bound in bounds)
