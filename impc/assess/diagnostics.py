"""What the residuals of a fit say against it: noise inside the loop, and model error.

Intervals hold for stationary noise in the recorder. Two things break that without lowering the VAF:
noise that enters the loop and is answered (`loop_noise`), and a body that is not the model's
(`residual_structure`). Either becomes a warning that comes first on the page (docs/fitting.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.assess.loop_noise import LoopNoise, loop_noise
from impc.assess.residual_structure import ResidualStructure, residual_structure
from impc.inverse.residuals import evaluate

if TYPE_CHECKING:
    from impc.inverse.problem import Problem

__all__ = ["ResidualDiagnostics", "residual_diagnostics", "residual_warnings"]


@dataclass(frozen=True)
class ResidualDiagnostics:
    """Both tests; each None where there is nothing to test."""

    loop: LoopNoise | None
    structure: ResidualStructure | None

    @property
    def contradicted(self) -> bool:
        """Whether either finds something."""
        return any(test is not None and test.found for test in (self.loop, self.structure))


def residual_diagnostics(problem: Problem, gain: Array, metric: Array) -> ResidualDiagnostics:
    """Run both tests.

    `gain` (m, n); `metric` (m, m).
    """
    found = evaluate(problem, gain, metric)
    if found.reason:
        return ResidualDiagnostics(None, None)
    p, row, residuals = len(problem.plant.outputs), 0, []
    for trial in problem.recordings:
        mine = found.residual[row : row + trial.outputs.size].reshape(-1, p)
        residuals.append(-mine * problem.output_scale)
        row += trial.outputs.size
    structure = residual_structure(problem, gain, found)
    # Nothing but rounding is left of an exact fit: neither test has anything to say.
    loop = None if structure is None else loop_noise(problem.plant, gain, residuals)
    return ResidualDiagnostics(loop, structure)


def residual_warnings(
    found: ResidualDiagnostics, outputs: tuple[str, ...], saturated: float
) -> tuple[str, ...]:
    """What to tell first: one sentence or two for each test that is positive."""
    told = []
    if found.loop is not None and found.loop.found:
        told.append(_loop_sentence(found.loop, outputs, saturated))
    if found.structure is not None and found.structure.found:
        told.append(_structure_sentence(found.structure))
    return tuple(told) if saturated > 0 else tuple(reversed(told))


def _loop_sentence(loop: LoopNoise, outputs: tuple[str, ...], saturated: float) -> str:
    index = int(np.argmax(loop.shares))
    seen = (
        f"Warning: what the fit leaves looks like noise inside the loop and not in the recorder: "
        f"{100 * loop.shares[index]:.0f} % of the residual of {outputs[index]} has the response of "
        f"the fitted loop (likelihood ratio {loop.statistic:.0f}, threshold {loop.threshold:.1f})."
    )
    if saturated > 0:
        return (
            f"{seen} The command stands at its bound for {100 * saturated:.1f} % of the time: the "
            f"gain is then biased by as much as half, at a high VAF too, and 95 % intervals of it "
            f"held the truth in 0 to 40 % of simulated subjects. Do not rely on the gain, the "
            f"weights or their intervals."
        )
    return (
        f"{seen} The gain is scattered more than by noise in the recorder, and 95 % intervals held "
        f"the truth in 83 to 92 % of simulated subjects."
    )


def _structure_sentence(structure: ResidualStructure) -> str:
    least = min(structure.p_linear, structure.p_nonlinear)
    return (
        f"Warning: {100 * structure.share:.0f} % of what the fit leaves follows the perturbation "
        f"or the motion that it caused (p = {least:.3f}), as noise does not: the body or the "
        f"controller that moved is not that of the model. The intervals on this page hold noise "
        f"only. They do not contain this error, which may be many times wider."
    )
