"""The largest likelihood, by Fisher's scoring in a box.

With g the gradient of the log-likelihood and I the expected information, a step is that of

    maximise  g's - s'I s / 2    over  |s_i| <= radius

and the radius follows from what the step brings. A box, because a level that is all but none may
slide as far as it likes while all else takes its step: a step that is scaled as a whole is held
back by what slides, and crept for hundreds of rounds on the seat (docs/noisy-people.md).

Noisy recordings leave some directions of the gain all but free. A weak normal prior in natural
coordinates keeps those where the first fit was, as in `gain_search`, and a barrier keeps gains that
stabilise from the border of those that do not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from impc.errors import ImpcError

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.inverse.person_coordinates import PersonCoordinates, Told

__all__ = ["Prior", "boxed_step", "climb", "reach"]

# A search ends when a step promises less: a hundredth of a deviation along any direction.
_SETTLED = 1e-4
# The likelihood jumps by hundredths where a later stage of a plan meets a bound, so that a search
# may stand before a cliff. It may fall by so many nats in all, and it stops where a step that did
# not climb promised less than the second: settled, if the whole step promises less than the first.
_JUMPS, _UNSEEN = 0.25, 1e-2
# A level that slides to zero, or a sense to one that is not used, has no end: along what is so flat
# a step of ten is as far as a promise is believed.
_FLAT = 1e-2
# A level is held within a factor of e^9, some thousands, of where its search begins: there it is
# none, or the sense is not used, and beyond it a filter is not told from rounding.
_REACH = 9.0
# Longest step of any coordinate.
_STEP = 1.0
# Nats for each factor of e by which a gain near the border of those that stabilise lets noise
# grow: on the seat the largest likelihood without it is on that border, and a search creeps there.
_BARRIER = 0.5


class Prior:
    """What holds directions of the gain that nothing tells, as a share of a log-likelihood.

    A normal number about the start for each coordinate but the levels, and a barrier before gains
    that do not stabilise.

    Parameters
    ----------
    space : PersonCoordinates
    spread : float
        Standard deviation; infinite for no prior, and no barrier either.
    """

    def __init__(self, space: PersonCoordinates, spread: float) -> None:
        self.space = space
        self.weights = np.where(np.arange(len(space.start)) < space.own, spread**-2.0, 0.0)
        self.barrier = _BARRIER if np.isfinite(spread) else 0.0

    def value(self, theta: Array) -> float:
        """At theta (q,), nats; minus infinity where a gain does not stabilise."""
        away = float(self.weights @ (theta - self.space.start) ** 2) / 2
        return -away - (self.barrier * self.space.wandering(theta)[0] if self.barrier else 0.0)

    def slopes(self, theta: Array) -> tuple[Array, Array]:
        """Derivatives at theta; the barrier is taken to bend as the logarithm of a distance does.

        Parameters
        ----------
        theta : Array
            (q,).

        Returns
        -------
        gradient, bend : Array
            (q,), and what is taken for minus the second derivatives (q, q).
        """
        gradient, bend = -self.weights * (theta - self.space.start), np.diag(self.weights)
        if not self.barrier:
            return gradient, bend
        slope = self.space.wandering(theta)[1]
        return gradient - self.barrier * slope, bend + self.barrier * np.outer(slope, slope)


def reach(space: PersonCoordinates, theta: Array) -> tuple[Array, Array]:
    """Between which values a search is held: levels within a factor of e^9.

    Parameters
    ----------
    space : PersonCoordinates
    theta : Array
        Where it begins (q,).

    Returns
    -------
    low, high : Array
        (q,) each.
    """
    far = np.where(np.arange(len(theta)) < space.own, np.inf, _REACH)
    return theta - far, theta + far


def climb(
    prior: Prior, theta: Array, box: tuple[Array, Array], budget: int
) -> tuple[Array, Told, int, bool]:
    """The largest likelihood near theta, times the prior.

    Parameters
    ----------
    prior : Prior
    theta : Array
        Where it begins (q,).
    box : pair of Array
        Least and largest values (q,).
    budget : int
        Likelihoods with derivatives, at most.

    Returns
    -------
    theta, told, spent, settled : Array, Told, int, bool
        Where it ends (q,), what the recordings say there, likelihoods with derivatives, and
        whether it ended by itself.

    Raises
    ------
    ImpcError
        When there is no likelihood at theta.
    """
    space = prior.space
    told, radius, spent, slack = space.told(theta), _STEP, 1, _JUMPS
    while True:
        slope, bend = prior.slopes(theta)
        gradient = told.gradient + slope
        curvature = told.information + bend + _FLAT * np.eye(len(theta))
        step, promised = boxed_step(gradient, curvature, box[0] - theta, box[1] - theta)
        if promised < _SETTLED:
            return theta, told, spent, True
        gain, within = -np.inf, np.inf
        while not gain > -slack / 4:
            if within < _UNSEEN or spent >= budget:
                return theta, told, spent, within < _UNSEEN and promised < _JUMPS
            low, high = np.maximum(box[0] - theta, -radius), np.minimum(box[1] - theta, radius)
            step, within = boxed_step(gradient, curvature, low, high)
            there, length = theta + step, float(np.max(np.abs(step)))
            try:
                gain = space.value(there) + prior.value(there) - told.value - prior.value(theta)
            except ImpcError:  # no filter there: a shorter step
                gain = -np.inf
            if gain < (within - slack) / 4:
                radius = length / 4
            elif gain > within * 0.75 - slack / 4:
                radius = min(max(radius, 2 * length), _STEP)
        slack += min(gain, 0.0)
        theta, told, spent = there, space.told(there), spent + 1


def boxed_step(gradient: Array, curvature: Array, low: Array, high: Array) -> tuple[Array, float]:
    """The step within a box that promises most, g's - s'C s / 2.

    Parameters
    ----------
    gradient, curvature : Array
        g (q,) and C (q, q), positive definite.
    low, high : Array
        The box (q,); a coordinate with low = high = 0 is held.

    Returns
    -------
    step, promised : Array, float
        (q,), and what it promises.
    """
    step, free = np.zeros(len(gradient)), low < high
    root = np.linalg.cholesky(curvature[np.ix_(free, free)])
    goal = solve_triangular(root, gradient[free], lower=True)
    step[free] = lsq_linear(root.T, goal, (low[free], high[free]), method="bvls").x
    return step, float(gradient @ step - step @ curvature @ step / 2)
