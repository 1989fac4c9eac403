"""Whether a person at a limit would run away now and then, with the noise that was found.

A likelihood is that of all that might have been recorded. Who falls now and then is recorded where
that did not happen, with noise calmer than it is, and gain and levels answer for it
(docs/noisy-people.md). So the fitted person is simulated under the recorded perturbations, with
fresh noise, and trials are counted in which an output leaves all that was recorded far behind.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.control.closed_loop import Status
from impc.control.noisy_person import simulate_person
from impc.inverse.problem import controller_for

if TYPE_CHECKING:
    from impc.inverse.likelihood_fit import PersonFit

__all__ = ["SIMULATED", "runaways"]

#: Trials that are simulated.
SIMULATED = 60
# Times the largest recorded output: who falls from a seat at .16 rad is at 1.6 rad soon after.
_FAR = 10.0


def runaways(fit: PersonFit) -> int:
    """In how many of sixty trials like the recorded ones the person runs away.

    None does where no bound was met in the recordings.

    Parameters
    ----------
    fit : PersonFit
        Of `fit_person`.

    Returns
    -------
    int
        Trials in which an output goes beyond ten times its largest recorded value.
    """
    if all(np.all(trial.status == Status.FREE) for trial in fit.told.trials):
        return 0
    trials = fit.problem.recordings
    law = controller_for(fit.problem, np.array(fit.K), np.array(fit.S))
    largest = np.max([np.max(np.abs(trial.outputs), axis=0) for trial in trials], axis=0)
    found = 0
    for number in range(SIMULATED):
        trial = trials[number % len(trials)]
        made = simulate_person(
            law, fit.observer, trial.disturbance, x0=trial.x0, seed=[SIMULATED, number]
        )
        far = np.abs(np.array(made.outputs)) > _FAR * largest
        found += bool(np.any(far)) or made.reached < trial.samples
    return found
