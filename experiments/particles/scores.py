"""Bias of the score at the true gain at a limit, by the filter and by particles.

Subjects on the seat of `noisy_people` plan one sample ahead here, so the command is a clipped gain
times the estimate, and the particle likelihood has no model error. The script prints the mean
difference of the log-likelihoods at a gain 5 % above and 5 % below the true one, over new trials
without a fall. It should be zero. Results: experiments/output_feedback.md.

    python -m experiments.particles.scores --noise sensory --vaf 70 --seeds 3 6 --trials 30
"""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from experiments.noisy_people import NOISES, subject
from experiments.noisy_people_score import FALLEN, LIMITS
from experiments.particles.clipped_regulator import clipped_regulator, first_state
from experiments.particles.likelihood import particle_likelihood
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.model.recordings import Recording
from impc.output_feedback.likelihood import NoiseDirections, joint_likelihoods, prepare_filter
from impc.output_feedback.simulation import simulate_person

if TYPE_CHECKING:
    from experiments.noisy_people import Subject
    from impc.arrays import Array
    from impc.output_feedback.likelihood import PreparedFilter

__all__ = ["differences"]

_APART, _PARTICLES = 0.05, 300


def differences(who: Subject, trials: int) -> tuple[Array, int]:
    """Differences of trials without a fall (kept, 2), filter and particles, nats; and falls.

    Parameters
    ----------
    who : Subject
        Source of gain, noise SDs and limit.
    trials : int
    """
    plant, K = who.controller.plant, np.array(who.controller.K)
    true, *ends = (_law(who, K * factor) for factor in (1, 1 + _APART, 1 - _APART))
    filters = [_filter(law, who) for law in ends]
    rest = who.controller.bounds, who.person, who.recorder
    regulators = [clipped_regulator(plant, np.array(law.K), *rest) for law in ends]
    start = first_state(plant, regulators[0], np.zeros(plant.n))

    def one(number: int) -> list[float] | None:
        push = who.pushes[number % len(who.pushes)]
        made = simulate_person(true, who.person, push, recorder=who.recorder, seed=number)
        outputs = np.array(made.outputs)
        if np.max(np.abs(outputs)) > FALLEN:
            return None
        trial = outputs, np.array(push, dtype=np.float64).reshape(len(push), -1)
        recording = Recording(plant, *trial, np.zeros(plant.n))
        likelihoods = [joint_likelihoods(each, [recording])[0].value for each in filters]
        exact = [
            particle_likelihood(each, *trial, start, _PARTICLES, number) for each in regulators
        ]
        return [up - down for up, down in (likelihoods, exact)]

    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(one, range(trials)))
    kept = [each for each in found if each is not None]
    return np.array(kept), trials - len(kept)


def _law(who: Subject, K: Array) -> Controller:
    law = who.controller
    return Controller.from_gain(law.plant, K, law.bounds, 1, terminal_set=False)


def _filter(law: Controller, who: Subject) -> PreparedFilter:
    levels = len(who.person.levels) + len(who.recorder)
    none = NoiseDirections(np.zeros((levels, 0)), 0)
    return prepare_filter(law, who.person, who.recorder, directions(law, 0), none)


def main() -> None:
    """Print a line for each subject."""
    parser = argparse.ArgumentParser(description="Bias of the score at the true gain, at a limit.")
    parser.add_argument("--noise", choices=tuple(NOISES), default="sensory")
    parser.add_argument("--vaf", type=float, default=70.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 6])
    parser.add_argument("--trials", type=int, default=30)
    given = parser.parse_args()
    for seed in given.seeds:
        who = subject("seat", seed, given.noise, given.vaf, LIMITS["seat", given.vaf][1])
        found, falls = differences(who, given.trials)
        mean, error = found.mean(axis=0), found.std(axis=0, ddof=1) / np.sqrt(len(found))
        print(
            f"{seed}: {falls} of {given.trials} trials end in a fall; the others: filter "
            f"{mean[0]:.2f} ± {error[0]:.2f} nats, particles {mean[1]:.2f} ± {error[1]:.2f}"
        )


if __name__ == "__main__":
    main()
