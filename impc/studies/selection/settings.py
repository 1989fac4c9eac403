"""The [select] table of a study file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta

from impc.studies.fit.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Mapping

Variance = Annotated[float, Meta(gt=0, le=1e100)]
Count = Annotated[int, Meta(ge=1, le=1000)]


@dataclass(frozen=True)
class SelectSettings:
    """Settings of `impc select`."""

    # v, largest variance in normalised units, of the subset that is refitted
    bound: Variance = 0.05
    # Of the sweep
    bounds: Annotated[list[Variance], Meta(min_length=1)] = field(
        default_factory=lambda: [0.05 + 0.1 * k for k in range(10)]
    )
    least: Count = 2  # n_min
    size: Count = 5  # Parameters that the LASSO is to leave
    starts: Annotated[int, Meta(ge=1, le=100_000)] = 3  # Of the nominal fit
    replicates: Annotated[int, Meta(ge=2, le=100_000)] = 200  # Of the bootstrap
    draw: Literal["single", "block"] = "block"  # How the bootstrap draws residuals
    nelder_mead: bool = False  # Whether Table C.1 is run too: slow
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0  # Of starts and replicates


def select_settings(table: Mapping[str, Any]) -> SelectSettings:
    """Read the [select] table."""
    return read_settings("select", SelectSettings, table)
