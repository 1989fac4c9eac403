"""How well a simulation agrees with a recording: VAF (3.24), and whether what is left is noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.special

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked, replace
from impc.control.closed_loop import simulate
from impc.errors import InputError
from impc.inverse.initial_states import with_fitted_starts
from impc.inverse.problem import controller_for, scenarios
from impc.inverse.solution_set import natural_coordinates

if TYPE_CHECKING:
    from impc.control.simulation import Simulation
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.model.recordings import Recording

# One second of lags tells a rhythm that was missed; fewer than ten tell nothing.
_LEAST_LAGS = 10


@dataclass(frozen=True)
class TrialAgreement(Frozen):
    """One trial against its simulation."""

    vaf: Array  # (3.24) of each output, % (p,)
    centred_vaf: Array  # The same with the means removed, 1 - var(y - y_sim)/var(y), % (p,)
    # p-value of Ljung and Box's test that the residual is white, one second of lags (p,)
    whiteness: Array
    rms: Array  # Root-mean-square residual in the outputs' units (p,)
    saturated: float  # Share of the samples at which an input bound is reached


@checked(recorded="i j", simulated="i j")
def vaf(recorded: Array, simulated: Array) -> Array:
    """Variance accounted for (3.24): (1 - sum (y - y_sim)^2 / sum y^2) 100 %, one for each column.

    Parameters
    ----------
    recorded, simulated : Array
        y and y_sim (samples, p), in one unit.

    Returns
    -------
    Array
        % (p,); NaN where the recorded output is zero throughout.

    Examples
    --------
    A simulation that is a tenth too small leaves a hundredth of the sum of squares.

    >>> import impc
    >>> recorded = [[1.0], [-2.0], [0.5]]
    >>> impc.vaf(recorded, [[0.9], [-1.8], [0.45]]).round(6)
    array([99.])
    """
    left = np.sum((recorded - simulated) ** 2, axis=0)
    total = np.sum(recorded**2, axis=0)
    share = np.divide(left, total, out=np.full_like(left, np.nan), where=total > 0)
    return np.asarray(100 * (1 - share))


@checked(recorded="i j", simulated="i j")
def centred_vaf(recorded: Array, simulated: Array) -> Array:
    """As `vaf`, with the means removed from what was recorded and from what is left.

    `recorded, simulated` (samples, p); returns (p,).
    """
    left = np.var(recorded - simulated, axis=0)
    total = np.var(recorded, axis=0)
    share = np.divide(left, total, out=np.full_like(left, np.nan), where=total > 0)
    return np.asarray(100 * (1 - share))


@checked(residual="i j", lags=1)
def whiteness(residual: Array, lags: int) -> Array:
    """p-values of Ljung and Box's test that each column is white (Ljung and Box 1978).

    Parameters
    ----------
    residual : Array
        (samples, p).
    lags : int
        How many of the first autocorrelations are tested together.

    Returns
    -------
    Array
        (p,); NaN where nothing is left to test.

    Raises
    ------
    InputError
        When there are not more samples than lags.

    Examples
    --------
    >>> import impc
    >>> import numpy as np
    >>> noise = np.random.default_rng(2).standard_normal((200, 1))
    >>> white, drift = impc.whiteness(noise, 10), impc.whiteness(np.cumsum(noise, axis=0), 10)
    >>> bool(white[0] > 0.05), bool(drift[0] < 0.001)
    (True, True)
    """
    if lags >= len(residual):
        raise InputError("lags", f"got {lags} of {len(residual)} samples", "give fewer")
    values = []
    for column in residual.T:
        if np.ptp(column) == 0:
            values.append(np.nan)
            continue
        values.append(_ljung_box(column - np.mean(column), lags))
    return np.array(values)


def _ljung_box(noise: Array, lags: int) -> float:
    """p of Q = N (N + 2) sum_k rho_k^2 / (N - k); statsmodels' takes half a second to be loaded."""
    count, places = len(noise), np.arange(1, lags + 1)
    rho = np.array([noise[k:] @ noise[: count - k] for k in places]) / (noise @ noise)
    statistic = count * (count + 2) * np.sum(rho**2 / (count - places))
    return float(scipy.special.chdtrc(lags, statistic))


def agreement(
    plant: Plant, trial: Recording, run: Simulation, u_min: Array, u_max: Array
) -> TrialAgreement:
    """Compare a trial with its simulation from the first sample to the last.

    `u_min, u_max` (m,).
    """
    simulated = run.x @ plant.C.T
    residual = trial.outputs - simulated
    lags = min(max(round(1 / plant.dt), _LEAST_LAGS), trial.samples // 5)
    return TrialAgreement(
        frozen(vaf(trial.outputs, simulated)),
        frozen(centred_vaf(trial.outputs, simulated)),
        frozen(whiteness(residual, max(lags, 1))),
        frozen(np.sqrt(np.mean(residual**2, axis=0))),
        saturated_share(run.applied, u_min, u_max),
    )


@checked(u="i m", u_min="~m", u_max="~m")
def saturated_share(u: Array, u_min: Array, u_max: Array) -> float:
    """Share of samples at which any input stands on a bound, to 1e-6 of it.

    `u` (samples, m); `u_min, u_max` (m,).
    """
    near = (u >= u_max * (1 - 1e-6)) | (u <= u_min * (1 - 1e-6))  # the origin is strictly inside
    return float(np.count_nonzero(np.any(near, axis=1)) / max(len(u), 1))


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
