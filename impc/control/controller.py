"""The constrained controller as a value: what it stays near, and what keeps it away.

With P from the Riccati equation, the cost of (3.1) along any input sequence is

    x_0'P x_0 + sum_k v_k' S v_k,      v_k = u_k + K x_k,   S = R + B'PB

(docs/theory.md, section 2, has the proof), so a controller is its gain K, its metric S up to
scale, its bounds, its horizon and its terminal set. The weights are one way to name K and S.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from impc.arrays import Array, finite_array, frozen, symmetric_matrix
from impc.checking import Value, checked
from impc.control.terminal_set import maximal_invariant_set
from impc.errors import InputError
from impc.model.riccati import is_stable, solve_lqr

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from impc.control.terminal_set import TerminalSet
    from impc.model.bounds import Bounds
    from impc.model.plant import Plant
    from impc.model.weights import Weights

__all__ = ["LONGEST_HORIZON", "Controller", "gain_controller", "mpc_controller"]

#: Samples; the rows of a horizon take memory in its square, 0.4 GB of these for two bounds.
LONGEST_HORIZON = 5000


@dataclass(frozen=True)
class Controller(Value):
    """minimise sum_{k<N} v_k'S v_k  subject to the bounds, x_N in the terminal set.

    Attributes
    ----------
    plant : Plant
        Discrete.
    K : Array
        Gain (m, n); u_k = -K x_k + v_k.
    S : Array
        Metric (m, m), scaled to a mean diagonal of 1: its scale has no effect.
    bounds : Bounds
    horizon : int
        N >= 1, in samples.
    terminal : TerminalSet or None
        Set that x_N must reach; None for no such constraint.
    softening : float or None
        None: state bounds and terminal set are hard. A number: exceeding one of their rows
        E x <= b by s costs ``softening * U^2 * s / b`` with U the least finite input bound (1
        where there is none). The penalty is exact: while it is larger than the multipliers the
        answer is that of the hard problem whenever there is one. Input bounds are always hard.
    """

    _rules: ClassVar[Mapping[str, Any]] = {
        "K": "m n",
        "S": "m m",
        "horizon": (1, LONGEST_HORIZON),
    }

    plant: Plant
    K: Array
    S: Array
    bounds: Bounds
    horizon: int
    terminal: TerminalSet | None
    softening: float | None

    @property
    def penalty(self) -> float:
        """Cost of a relative excess of 1, infinite when the rows are hard."""
        if self.softening is None:
            return float("inf")
        sides = np.abs(np.concatenate([self.bounds.u_min, self.bounds.u_max]))
        finite = sides[np.isfinite(sides)]
        unit = float(finite.min()) if len(finite) else 1.0
        return self.softening * unit**2


@checked(horizon=(1, LONGEST_HORIZON))
def mpc_controller(
    plant: Plant,
    weights: Weights,
    bounds: Bounds,
    horizon: int,
    *,
    terminal_set: bool = True,
    softening: float | None = None,
) -> Controller:
    """Controller (3.1) with terminal weight (3.4) from stage weights.

    Parameters
    ----------
    plant : Plant
        Discrete, stabilisable.
    weights : Weights
    bounds : Bounds
    horizon : int
        N >= 1, in samples.
    terminal_set : bool
        Whether x_N must lie in the maximal invariant set of the regulator under the bounds.
    softening : float, optional
        See `Controller`.

    Raises
    ------
    PlantError, WeightsError, InputError
        When the plant is continuous, no stabilising Riccati solution exists, or the horizon is
        not a positive whole number.
    """
    solution = solve_lqr(plant.require_discrete(), weights)
    return gain_controller(
        plant,
        solution.K,
        bounds,
        horizon,
        metric=solution.S,
        terminal_set=terminal_set,
        softening=softening,
    )


@checked(gain="m n", metric="m m", horizon=(1, LONGEST_HORIZON))
def gain_controller(
    plant: Plant,
    gain: ArrayLike,
    bounds: Bounds,
    horizon: int,
    *,
    metric: ArrayLike | None = None,
    terminal_set: bool = True,
    softening: float | None = None,
    near: TerminalSet | None = None,
) -> Controller:
    """Controller that stays near u = -Kx; the gain must stabilise the plant.

    Parameters
    ----------
    gain : array_like
        K (m, n).
    metric : array_like, optional
        S (m, m), positive definite; the identity by default, which is no choice for one input.
    near : TerminalSet, optional
        Set of a gain nearby: the same answer in less time, see `maximal_invariant_set`.
    bounds, horizon, terminal_set, softening
        As in `mpc_controller`.

    Raises
    ------
    InputError
        When the gain does not stabilise the plant or the metric is not positive definite.
    """
    plant.require_discrete()
    K = finite_array("gain", gain, (plant.m, plant.n))
    if terminal_set and not is_stable(plant.A - plant.B @ K, discrete=True):
        raise InputError("gain", "does not stabilise the plant", "give one with |eig(A - BK)| < 1")
    S = np.eye(plant.m) if metric is None else symmetric_matrix("metric", metric, plant.m)
    if np.linalg.eigvalsh(S)[0] <= 0:
        raise InputError("metric", "is not positive definite", "give R + B'PB")
    if softening is not None and not 0 < softening < np.inf:
        raise InputError("softening", f"got {softening!r}", "give a positive number, or None")
    terminal = maximal_invariant_set(plant, K, bounds, near=near) if terminal_set else None
    scaled = S * (plant.m / np.trace(S))
    return Controller(plant, frozen(K), frozen(scaled), bounds, horizon, terminal, softening)
