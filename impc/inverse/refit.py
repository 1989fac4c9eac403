"""Refit everything from an answer, along the directions of the controller that recordings identify.

The gain of fitted weights is biased by the penalty on their condition number, and an unrestricted
gain drifts along hardly identified directions, often to the edge of stability, where standard
errors are too small. Therefore the gain moves by least squares along identified directions only,
jointly with S, initial states, errors of signals and parameters:

    K = K_start + sum over identified directions i of  w_i  direction_i     (whitened coordinates)

Other directions of the gain keep a prior of SD 1 at the start, and S one at the last end. Initial
states, errors and free parameters have a weak one there: the rounds are repeated from it, with
directions of the new gain, until -2 log L stays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.checking import replace
from impc.inverse.laws import GainLaw
from impc.inverse.minimiser import CREASE, PROMISE, Ended
from impc.inverse.problem import explains, require_riccati
from impc.inverse.search import stop_at
from impc.inverse.unknowns import Unknowns

if TYPE_CHECKING:
    from impc.inverse.problem import Problem
    from impc.inverse.unknowns import Fitted

#: Largest standard error, in whitened units, of an identified direction. Beyond it the prior of the
#: search and the curvature of the problem matter.
IDENTIFIED = 0.2
# Prior SD of free parameters, and 1 / SD of initial states and errors, about the last end: states
# that hardly move in the trials have tiny units.
_SPREAD, _OWN = 3.0, 0.0033
# Largest numbers of rounds and of evaluations of each.
_ROUNDS, _EVALUATIONS = 12, 100
# Decrease of the objective in a round below which the prior no longer matters.
_STAYS = 0.1


def refit(
    problem: Problem,
    gain: Array,
    metric: Array,
    promise: float = 0.1 * PROMISE,
    rounds: int = _ROUNDS,
) -> Fitted:
    """Refit from a `gain` (m, n) and `metric` (m, m), at the other values of the problem.

    A round ends where an undamped step promises a decrease of at most `promise` in the objective.
    """
    require_riccati(problem)
    law = GainLaw(problem, gain, metric)
    space = Unknowns(problem, law)
    end, spent = space.ended(space.start), 0
    for _ in range(0 if explains(problem, end.misfit) else rounds):
        rows, errors = space.deviations(space.start, gain.size)
        beside, parameters = len(law.start) - gain.size, len(problem.logarithms)
        centre = space.centre
        centre[space.controller] = law.at_gain(gain)
        there = space.search(
            space.start,
            stop_at(problem, promise, _EVALUATIONS),
            shared=np.repeat(
                [*(errors >= IDENTIFIED), 1.0, 1 / _SPREAD],
                [*np.ones(gain.size, int), beside, parameters],
            ),
            own=_OWN,
            along=scipy.linalg.block_diag(rows.T, np.eye(beside + parameters)),
            centre=centre,
        )
        spent += there.evaluations
        if not there.stabilises:  # no covariance there: keep the last gain
            break
        gained, end = end.objective - there.objective, there
        crease = there.ended is Ended.STUCK and there.promised < CREASE
        if gained < max(_STAYS, promise) or crease:
            break
        law = GainLaw(end.problem, np.array(end.K), np.array(end.S))
        space = Unknowns(end.problem, law)
    return replace(end, evaluations=spent)
