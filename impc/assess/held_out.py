"""A trial as the controller that was fitted to the others predicts it, by VAF (3.24)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.variance_accounted_for import centred_vaf, vaf
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.inverse.initial_states import with_fitted_starts
from impc.inverse.problem import controller_for, scenarios
from impc.inverse.solution_set import natural_coordinates

if TYPE_CHECKING:
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.model.recordings import Recording


@dataclass(frozen=True)
class HeldOut(Frozen):
    """One trial as the fit of the others predicts it."""

    # (3.24) after the settling time, % (p,); NaN when the simulation does not reach the end
    vaf: Array
    centred_vaf: Array  # The same with the means removed, % (p,)
    gain_change: float  # ||(K_others - K) T|| / ||K T||, T natural coordinates of the full fit


def predict(
    problem: Problem, other: Estimate, fitted: Estimate, index: int, settle: float
) -> HeldOut:
    """Simulate a trial that a controller has not seen."""
    each = left_out_vaf(other, problem.recordings[index], settle)
    T, _ = natural_coordinates(fitted.problem.plant, np.array(fitted.gain))
    change = np.linalg.norm((other.gain - fitted.gain) @ T) / np.linalg.norm(fitted.gain @ T)
    return HeldOut(each[0], each[1], float(change))


def left_out_vaf(other: Estimate, trial: Recording, settle: float) -> tuple[Array, Array]:
    """VAF of a trial under the controller that was found without it.

    Returns (p,).
    """
    gain, metric = np.array(other.gain), np.array(other.metric)
    alone = replace(other.problem.known(), recordings=(trial,))
    first = round(settle / alone.plant.dt)
    started = alone
    if other.problem.unknown_start:
        started = with_fitted_starts(alone, gain, metric, max(first, alone.plant.n))
    run = simulate(controller_for(started, gain, metric), scenarios(started)[0])
    recorded, simulated = trial.outputs[first:], (run.x @ started.plant.C.T)[first:]
    if not run.complete:
        nothing = frozen(np.full(recorded.shape[1], np.nan))
        return nothing, nothing
    return frozen(vaf(recorded, simulated)), frozen(centred_vaf(recorded, simulated))
