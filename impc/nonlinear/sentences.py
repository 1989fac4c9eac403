"""What the page of an optimal control problem's fit says in words.

See docs/nonlinear.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.nonlinear.result import reached, signal_vaf

if TYPE_CHECKING:
    from impc.nonlinear.result import OptimalFit

# % of a signal below which a fit explains less than it leaves.
_LITTLE = 50.0


def verdict(fit: OptimalFit) -> str:
    """The one sentence that says what may be made of the fit; what forbids most comes first."""
    estimate, told = fit.estimate, fit.estimate.combinations
    poor = [name for name, value in signal_vaf(estimate).items() if value < _LITTLE]
    if not estimate.settled:
        return (
            "The search ended before it converged: begin nearer, or allow it more evaluations; "
            "its parameters are not an answer."
        )
    if poor:
        return (
            f"The problem explains less than half of {', '.join(poor)}: its equations, its cost or "
            "its limits are not those of the recordings."
        )
    if not told.told:
        return "The recordings tell none of the parameters."
    ends = estimate.intervals().items()
    open_ones = [name for name, (low, high) in ends if not high - low < np.inf]
    if not open_ones:
        return (
            "The problem explains the recordings, which tell every parameter by itself, as far as "
            "the intervals say."
        )
    return (
        "The problem explains the recordings, but they do not tell all of its parameters: "
        f"{', '.join(open_ones)} may be others, alone or together, as the sentences below say."
    )


def abstract(fit: OptimalFit) -> tuple[str, ...]:
    """A few plain sentences with numbers."""
    return (
        _what_was_done(fit),
        _agreement(fit),
        *_at_the_limit(fit),
        *fit.estimate.combinations.sentences,
    )


def _what_was_done(fit: OptimalFit) -> str:
    estimate, problem = fit.estimate, fit.estimate.problem
    count, loops = len(estimate.recordings), sum(one.closed_loop for one in estimate.recordings)
    samples = sum(len(one.u) for one in estimate.recordings)
    each = "one recording" if count == 1 else f"{count} recordings"
    kind = {
        0: "of one plan" if count == 1 else "of one plan each",
        count: "of a controller that plans anew at every sample",
    }.get(loops, f"of which {loops} are of a controller that plans anew at every sample")
    ahead = "" if fit.dt is None else f" ({problem.horizon * fit.dt:.3g} s)"
    known = f" (and {len(fit.known)} known)" if fit.known else ""
    return (
        f"An optimal control problem over {problem.horizon} samples{ahead} with "
        f"{len(estimate.theta)} unknown parameters{known} was fitted to {each} {kind}, "
        f"{samples} samples in all."
    )


def _agreement(fit: OptimalFit) -> str:
    parts = [
        f"{value:.2f} % of {name}"
        for name, value in signal_vaf(fit.estimate).items()
        if not np.isnan(value)
    ]
    return f"It accounts for {', '.join(parts)} (VAF)."


def _at_the_limit(fit: OptimalFit) -> list[str]:
    parts = [
        f"{one.name} at {one.samples} of {one.of} samples" if one.samples else f"{one.name} never"
        for one in reached(fit.estimate)
    ]
    return [f"Constraints at their limit: {', '.join(parts)}."] if parts else []
