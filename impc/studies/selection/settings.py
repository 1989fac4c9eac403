"""Settings of a selection: the [select] table of a study file (docs/ref/settings.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

Variance = Annotated[float, Meta(gt=0, le=1e100)]
Count = Annotated[int, Meta(ge=1, le=1000)]


@dataclass(frozen=True)
class SelectSettings:
    """Settings of `impc select` and `impc key-parameters`.

    Attributes
    ----------
    bound : float
        Largest allowed variance of each parameter of the selected subset, in squared halves of its
        range.
    bounds : list of float
        Bounds of the variance in the sweep.
    least : int
        Smallest number of parameters in a subset.
    size : int
        Largest number of parameters that the LASSO selects.
    starts : int
        Number of starts of the fit of all parameters.
    replicates : int
        Number of bootstrap replicates.
    draw : "single" or "block"
        Resampling of the residuals in the bootstrap: single samples, or moving blocks (for
        autocorrelated residuals).
    seed : int
        Seed of starts and replicates.
    """

    bound: Variance = 0.05
    bounds: Annotated[list[Variance], Meta(min_length=1)] = field(
        default_factory=lambda: [0.05 + 0.1 * k for k in range(10)]
    )
    least: Count = 2
    size: Count = 5
    starts: Annotated[int, Meta(ge=1, le=100_000)] = 3
    replicates: Annotated[int, Meta(ge=2, le=100_000)] = 200
    draw: Literal["single", "block"] = "block"
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
