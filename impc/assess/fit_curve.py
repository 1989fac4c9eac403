"""Fits with one number fixed: the least loss F as a function of it, its minimum and its rise.

F(v) is the loss of the fit with the number fixed at v. Each fit starts from that at the nearest v.
Profiles of gains and parameters (`profiles`) and of limits (`input_limits`) are such curves.
"""

from __future__ import annotations

import contextlib
import itertools
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.errors import SolverError, WeightsError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.inverse.unknowns import Fitted

# Accuracy of an end relative to the last step towards it; rounds until the minimum stays.
_END, _ROUNDS = 1e-3, 6
# Loss of a value that no gain can be simulated with; value that stands for an infinite one.
_FAILED, _FAR = 1e12, 1e9


class FitCurve:
    """Cached fits at values of one number."""

    def __init__(
        self,
        fit: Callable[[float, float, Fitted], Fitted],
        start: tuple[float, Fitted],
        loss: Callable[[Fitted], float],
    ) -> None:
        #: Fit at a value, given another value with its fit.
        self.fit, self.start, self.of = fit, start, loss
        self.tried: dict[float, Fitted | None] = {}

    @property
    def finite(self) -> list[float]:
        """Finite values tried, ascending."""
        return sorted(value for value in self.tried if np.isfinite(value))

    @property
    def best(self) -> float:
        """Finite value with the least loss."""
        return min(self.finite, key=self.loss)

    def at(self, value: float) -> Fitted:
        """Fit at a value; raises SolverError if it cannot be simulated."""
        found = self._at(value)
        if found is None:
            said = f"no stabilising gain can be simulated at {value:g}"
            raise SolverError("fit with a fixed number", said, "check the plant and the bounds")
        return found

    def loss(self, value: float) -> float:
        """F at a value."""
        found = self._at(value)
        return _FAILED if found is None else self.of(found)

    def rise(self, value: float) -> float:
        """F at a value above the least F."""
        return self.loss(value) - self.loss(self.best)

    def refine(self, accuracy: float, reach: float = 0.0) -> None:
        """Refine the minimum between the neighbours of the best value, or to `reach` beyond it."""
        values, best = self.finite, self.best
        below = max([value for value in values if value < best], default=best - reach)
        above = min([value for value in values if value > best], default=best + reach)
        if above - below > 3 * accuracy:
            scipy.optimize.minimize_scalar(
                self.loss, bounds=(below, above), method="bounded", options={"xatol": accuracy}
            )

    def ends(
        self,
        rise: float,
        sides: Callable[[float], Sequence[Sequence[float]]],
        accuracy: float,
        reach: float = 0.0,
    ) -> list[float]:
        """Values on each side of the minimum at which F has risen by `rise`.

        `sides` maps the minimum to the values to try on each side, outwards; without a rise the end
        is the last one, which may be infinite. A better minimum found on the way restarts this.
        """
        for _ in range(_ROUNDS):
            self.refine(accuracy, reach)
            origin = self.best
            found = [self._end(rise, [origin, *values]) for values in sides(origin)]
            if self.best == origin:
                break
        return found

    def _end(self, rise: float, values: Sequence[float]) -> float:
        def excess(value: float) -> float:
            return self.rise(value) - rise

        for inside, outside in itertools.pairwise(values):
            if np.isfinite(outside) and excess(outside) > 0:
                accuracy = _END * abs(outside - inside)
                return float(scipy.optimize.brentq(excess, inside, outside, xtol=accuracy))
        return values[-1]

    def _at(self, value: float) -> Fitted | None:
        if value not in self.tried:
            known = [(other, fit) for other, fit in self.tried.items() if fit is not None]
            near = min(
                known, key=lambda one: abs(min(one[0], _FAR) - min(value, _FAR)), default=self.start
            )
            self.tried[value] = self._fit(value, near) or self._fit(value, self.start)
        return self.tried[value]

    def _fit(self, value: float, near: tuple[float, Fitted]) -> Fitted | None:
        with contextlib.suppress(SolverError, WeightsError):  # it diverges from there
            return self.fit(value, *near)
        return None
