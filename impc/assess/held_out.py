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
    from impc.inverse.noisy_fit import FittedController
    from impc.inverse.problem import Problem

__all__ = ["HeldOut", "left_out_vaf", "predict"]


@dataclass(frozen=True)
class HeldOut(Frozen):
    """One trial as the fit of the others predicts it.

    Attributes
    ----------
    vaf : Array
        (3.24) after the settling time, % (p,); NaN when the simulation does not reach the end.
    centred_vaf : Array
        The same with the means removed, % (p,).
    gain_change : float
        ||(K_others - K) T|| / ||K T||, T natural coordinates of the full fit.
    """

    vaf: Array
    centred_vaf: Array
    gain_change: float


def predict(
    problem: Problem,
    controller: FittedController,
    fitted: FittedController,
    index: int,
    settle: float,
) -> HeldOut:
    """Simulate a trial that the controller has not seen.

    Parameters
    ----------
    problem : Problem
        With all trials.
    controller, fitted : FittedController
        Fitted to the others, and to all.
    index : int
        Of the trial.
    settle : float
        Seconds that serve to find where it starts, and do not count.
    """
    K, S = np.array(controller.solution.K), np.array(controller.solution.S)
    alone = replace(controller.problem, recordings=(problem.recordings[index],))
    each = left_out_vaf(alone, K, S, settle)
    full = np.array(fitted.solution.K)
    T, _ = natural_coordinates(fitted.problem.plant, full)
    change = float(np.linalg.norm((K - full) @ T) / np.linalg.norm(full @ T))
    return HeldOut(each[0], each[1], change)


def left_out_vaf(alone: Problem, gain: Array, metric: Array, settle: float) -> tuple[Array, Array]:
    """VAF of the one trial of a problem under a gain found without it.

    Parameters
    ----------
    alone : Problem
        With that trial only.
    gain, metric : Array
        K (m, n) and S (m, m).
    settle : float
        Time at the start that does not count, s; an unknown initial state is fitted to it.

    Returns
    -------
    vaf, centred : Array
        `agreement.vaf` and `agreement.centred_vaf`, % (p,); NaN when the loop ends early.
    """
    trial = alone.recordings[0]
    first = round(settle / alone.plant.dt)
    started = alone
    if alone.unknown_start:
        started = with_fitted_starts(alone, gain, metric, max(first, alone.plant.n))
    run = simulate(controller_for(started, gain, metric), scenarios(started)[0])
    recorded, simulated = trial.outputs[first:], (run.x @ started.plant.C.T)[first:]
    if not run.complete:
        nothing = frozen(np.full(recorded.shape[1], np.nan))
        return nothing, nothing
    return frozen(vaf(recorded, simulated)), frozen(centred_vaf(recorded, simulated))
