"""Run both normalisation protocols of chapter 2 on the simulated seated subject.

The subject uses one controller, learnt at 120 Nm/rad, with a torque limit of 6 Nm and motor noise
of 1 Nm; balance is lost beyond 12 degrees. A subject who adapts fully to every stiffness would
lose balance only near 0 Nm/rad.

    python -m experiments.normalisation
"""

from __future__ import annotations

import functools

import numpy as np

import plants
from experiments.protocols import critical_stiffness, torque_amplitude
from impc.arrays import Array
from impc.cli.seat import seat_controller
from impc.studies.simulated_people import simulate_subject

__all__ = ["subject_balances", "subject_peak"]

_LIMIT, _MOTOR, _STOP, _RATE = 6.0, 1.0, 12.0, 1000.0
# The controller is learnt at 120 Nm/rad.
_controller = functools.cache(lambda: seat_controller({"k_r": 120.0}, _LIMIT))


def subject_balances(stiffness: float, torque: Array, seed: int) -> bool:
    """Whether the seat stays inside its stops during a trial."""
    return subject_peak(stiffness, torque, seed) < _STOP


def subject_peak(stiffness: float, torque: Array, seed: int) -> float:
    """Largest angle of the seat, degrees; infinite after a fall."""
    step = plants.seated_balance_step_for(k_r=stiffness)
    trial = simulate_subject(
        _controller(), step, torque, rate=_RATE, motor=_MOTOR, largest=np.pi, seed=seed
    )
    if trial.fell is not None:
        return np.inf
    return float(np.degrees(np.max(np.abs(trial.states[:, 0]))))


def main() -> None:
    """Run both protocols and print their results."""
    seeds = iter(range(10_000))
    still = np.zeros(round(10 * _RATE))
    stiffness = critical_stiffness(lambda k: subject_balances(k, still, next(seeds)))
    print(
        f"critical stiffness {stiffness.fine:.1f} Nm/rad (coarse {stiffness.coarse:.0f}, levels "
        f"{', '.join(f'{level:.0f}' for level in stiffness.levels)}, {stiffness.trials} trials); "
        f"experimental stiffness {stiffness.experimental:.0f} Nm/rad"
    )
    level = stiffness.experimental

    def pulse(size: float) -> float:
        torque = np.zeros(round(4 * _RATE))
        torque[: round(_RATE)] = size
        return subject_peak(level, torque, next(seeds))

    def trial(size: float) -> bool:
        torque = plants.ternary_torque(amplitude=size, duration=30, rate=_RATE, seed=next(seeds))
        return subject_balances(level, torque, next(seeds))

    found = torque_amplitude(pulse, trial, angle=8.0)
    print(
        f"torque amplitude {found.amplitude:.0f} Nm (a pulse of {found.coarse:.0f} Nm reaches "
        f"8 degrees, {found.trials} trials)"
    )


if __name__ == "__main__":
    main()
