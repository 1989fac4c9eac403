"""Normalise the seat to a subject: the two protocols of chapter 2.

A protocol requests trials and depends on their outcome, so the subject is a function.

Stiffness: without perturbation, from a stiff seat downwards in coarse steps until balance is lost,
twice, the lower level kept; then in fine steps from above it, three times, averaged. The level is
the first at which balance is lost. The experiment uses twice this critical stiffness.

Torque: one-second pulses of increasing size until the seat reaches a given angle; then trials of
the experiment at that amplitude, reduced by a step after each loss, until two in a row succeed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from impc.errors import InputError, SolverError


@dataclass(frozen=True)
class CriticalStiffness:
    """Result of the stiffness protocol, all in Nm/rad."""

    coarse: float  # Lower of the two coarse searches
    fine: float  # Mean of the fine searches: the critical stiffness
    levels: tuple[float, ...]  # First failing level of every search, coarse ones first
    trials: int  # Number of trials

    @property
    def experimental(self) -> float:
        """Stiffness of the seat in the experiment: twice the critical one."""
        return 2 * self.fine


@dataclass(frozen=True)
class TorqueAmplitude:
    """Result of the torque protocol, in Nm."""

    coarse: float  # Smallest pulse at which the seat reached the angle
    amplitude: float  # Largest amplitude without a loss of balance
    trials: int  # Number of trials, including pulses


def critical_stiffness(
    balances: Callable[[float], bool],
    *,
    start: float = 250.0,
    coarse_step: float = 10.0,
    fine_step: float = 5.0,
    margin: float = 50.0,
    coarse_searches: int = 2,
    fine_searches: int = 3,
) -> CriticalStiffness:
    """Run the stiffness protocol."""
    if coarse_step <= 0 or fine_step <= 0:
        raise InputError("step", f"got {min(coarse_step, fine_step):g}", "give positive ones")
    levels, trials = [], 0
    for _ in range(coarse_searches):
        level, count = _descend(balances, start, coarse_step)
        levels.append(level)
        trials += count
    coarse = min(levels)
    for _ in range(fine_searches):
        level, count = _descend(balances, coarse + margin, fine_step)
        levels.append(level)
        trials += count
    fine = sum(levels[coarse_searches:]) / fine_searches
    return CriticalStiffness(coarse, fine, tuple(levels), trials)


def torque_amplitude(
    pulse_angle: Callable[[float], float],
    keeps_balance: Callable[[float], bool],
    *,
    angle: float,
    step: float = 1.0,
    largest: float = 100.0,
) -> TorqueAmplitude:
    """Run the torque protocol; `angle` in degrees."""
    coarse, trials = step, 1
    while pulse_angle(coarse) < angle:
        coarse += step
        trials += 1
        if coarse > largest:
            raise SolverError("pulses", f"none up to {largest:g} Nm reaches the angle", "raise it")
    amplitude, passed = coarse, 0
    while passed < 2:
        trials += 1
        if keeps_balance(amplitude):
            passed += 1
            continue
        amplitude, passed = amplitude - step, 0
        if amplitude <= 0:
            raise SolverError("trials", "no amplitude is passed twice", "check the subject")
    return TorqueAmplitude(coarse, amplitude, trials)


def _descend(balances: Callable[[float], bool], start: float, step: float) -> tuple[float, int]:
    """First failing level and the number of trials."""
    level, trials = start, 1
    while balances(level):
        level -= step
        trials += 1
        if level < 0:
            raise SolverError("stiffness", "balance is never lost", "begin with a harder task")
    if trials == 1:
        raise SolverError(
            "stiffness", f"balance is lost at {start:g} already", "begin with a stiffer seat"
        )
    return level, trials
