"""The dissertation's findings of chapter 2, each looked for in a study; and its own p-values.

The lower body is the first output, the upper body the second, as in the dissertation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.studies.reliability.verdict import band_of

if TYPE_CHECKING:
    from impc.studies.reliability.analysis import Reliability

#: p-values of tables 2.5 (RMS) and 2.6 (energy) that survive in the text, lower and upper body.
#: They are the dissertation's, of its own thirty subjects, and are never compared with as truth.
QUOTED = {
    "rms": {"EO": (0.05, 0.29), "EC": (0.14, 0.66), "VIB": (0.02, 0.71)},
    "energy": {"EO": (0.06, 0.37), "EC": (0.44, 0.57), "VIB": (0.05, 0.70)},
}


@dataclass(frozen=True)
class Finding:
    """A statement of the dissertation, and what this study says of it."""

    statement: str  # Of the dissertation, chapter 2
    found: bool  # Whether it holds here
    numbers: str  # Those of this study


def findings(result: Reliability) -> tuple[Finding, ...]:
    """Excellent between visits; lower body above upper; within visits above between."""
    values = {
        (item.measure, item.output, item.condition): item.icc.value
        for item in result.measures
        if item.icc is not None
    }
    told = []
    if values:
        least = min(values.values())
        told.append(
            Finding(
                "Between-visit reliability is excellent (ICC of 0.75 or more) for every measure.",
                least >= 0.75,
                f"least ICC {least:.2f}, {band_of(least)}",
            )
        )
    if len(result.outputs) > 1 and values:
        lower, upper = (
            [value for key, value in values.items() if key[1] == result.outputs[place]]
            for place in (0, 1)
        )
        told.append(
            Finding(
                "The lower body is more reliable than the upper body.",
                float(np.mean(lower)) > float(np.mean(upper)),
                f"mean ICC {np.mean(lower):.2f} ({result.outputs[0]}) and {np.mean(upper):.2f} "
                f"({result.outputs[1]})",
            )
        )
    pairs = [
        (float(np.nanmean(item.within)), float(np.nanmean(item.between)))
        for item in result.cmc
        if np.any(np.isfinite(item.within)) and np.any(np.isfinite(item.between))
    ]
    if pairs:
        told.append(
            Finding(
                "Transfer functions agree better within a visit than between visits (CMC).",
                all(one > other for one, other in pairs),
                f"mean CMC {np.mean([a for a, _ in pairs]):.3f} within, "
                f"{np.mean([b for _, b in pairs]):.3f} between",
            )
        )
    return tuple(told)
