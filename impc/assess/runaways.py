"""Whether a person at a limit would run away now and then, with the noise that was found.

A likelihood is that of all that might have been recorded. Who falls now and then is recorded where
that did not happen, with noise calmer than it is, and gain and levels answer for it
(docs/noisy-people.md). So the fitted person is simulated under the recorded perturbations, with
fresh noise, and trials are counted in which an output leaves all that was recorded far behind.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.control.noisy_person import simulate_person
from impc.control.simulation import Status
from impc.inverse.problem import controller_for
from impc.inverse.simulated_score import left_behind

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.arrays import Array
    from impc.control.controller import Controller
    from impc.inverse.likelihood_fit import PersonFit
    from impc.model.observer import Observer

#: Trials that are simulated.
SIMULATED = 60


def runaways(fit: PersonFit) -> int:
    """In how many of sixty trials like the recorded ones the person runs away.

    None does where no bound was met in the recordings.
    """
    if all(np.all(trial.status == Status.FREE) for trial in fit.told.trials):
        return 0
    trials = fit.problem.recordings
    law = controller_for(fit.problem, np.array(fit.K), np.array(fit.S))
    driven = [(np.array(trial.disturbance), np.array(trial.x0)) for trial in trials]
    return running_away(law, fit.observer, driven, left_behind(trials), SIMULATED)


def running_away(
    law: Controller,
    person: Observer,
    trials: Sequence[tuple[Array, Array]],
    beyond: Array | float,
    seed: int,
    first: int = 0,
) -> int:
    """In how many of sixty simulated trials an output goes beyond some size.

    `beyond` (p,).
    """
    found = 0
    for number in range(SIMULATED):
        disturbance, x0 = trials[number % len(trials)]
        drawn = [seed, first + number]
        outputs = simulate_person(law, person, disturbance, x0=x0, seed=drawn).outputs
        found += bool(np.any(np.abs(np.array(outputs)) > beyond))
    return found
