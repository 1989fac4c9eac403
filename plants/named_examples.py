"""Small unstable systems from the literature as examples for inverse MPC.

The dissertation takes its example (3.8) from its reference [80]; matrices, bound and initial state
are not available. `yalmip_example` has all properties that the dissertation states of its example.
All systems are discrete with a sample time of 1 s, two states, one input and no direct feedthrough.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import control
import numpy as np

from plants._units import with_units

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = [
    "bbm_example",
    "cannon_example",
    "unstable_integrator_example",
    "yalmip_example",
]


def _two_states(
    name: str, A: ArrayLike, B: ArrayLike, C: ArrayLike | None = None
) -> Any:  # control has no types
    output = np.eye(2) if C is None else np.asarray(C, dtype=float)
    system = control.ss(
        np.asarray(A, dtype=float),
        np.asarray(B, dtype=float),
        output,
        np.zeros((output.shape[0], 1)),
        dt=1.0,
        name=name,
        states=["x1", "x2"],
        inputs=["u"],
        outputs=["x1", "x2"] if C is None else ["y"],
    )
    return with_units(
        system, dict.fromkeys([*system.state_labels, *system.output_labels, "u"], "1")
    )


def yalmip_example() -> Any:
    """Return A = [2 -1; 1 0.2], B = [1; 0], the primary example. Used with abs(u) <= 1.

    Source: the "standard MPC" model of the YALMIP wiki, where Q = I, R = 2, N = 7 and
    x0 = [3; 1]; the dissertation used YALMIP. Confidence in the matrices: certain. That they equal
    those of the dissertation's (3.8), which are not available, is a guess.

    Returns
    -------
    control.StateSpace
        States x1, x2 (dimensionless), input u, outputs the states. Poles 1.1 +- 0.436i.
    """
    return _two_states("yalmip", [[2.0, -1.0], [1.0, 0.2]], [[1.0], [0.0]])


def bbm_example() -> Any:
    """Return A = [2 1; 0 0.5], B = [1; 0]. Used with abs(u) <= 1, abs(x) <= 10.

    Its second state is not controllable: the weight Q22 has no effect on the gain. Source: the
    textbook of Borrelli, Bemporad and Morari on predictive control, "unstable second order system".
    Confidence: from memory, not verified. The matrices of the dissertation's (3.8) are not
    available.

    Returns
    -------
    control.StateSpace
        States x1, x2 (dimensionless), input u, outputs the states. Poles 2 and 0.5.
    """
    return _two_states("bbm", [[2.0, 1.0], [0.0, 0.5]], [[1.0], [0.0]])


def cannon_example() -> Any:
    """Return A = [1.1 2; 0 0.95], B = [0; 0.0787], C = [-1 1]. Used with abs(u) <= 1.

    Source: the Oxford lecture notes and the textbook of Kouvaritakis and Cannon on predictive
    control. Confidence: from memory, not verified. The matrices of the dissertation's (3.8) are
    not available.

    Returns
    -------
    control.StateSpace
        States x1, x2 (dimensionless), input u, one output y = x2 - x1. Poles 1.1 and 0.95.
    """
    return _two_states("cannon", [[1.1, 2.0], [0.0, 0.95]], [[0.0], [0.0787]], [[-1.0, 1.0]])


def unstable_integrator_example() -> Any:
    """Return A = [1.2 1; 0 1], B = [0; 1]. Used with abs(u) <= 1.

    Source: chosen here, a generic unstable mode driven through an integrator. Confidence: certain.
    The matrices of the dissertation's (3.8) are not available.

    Returns
    -------
    control.StateSpace
        States x1, x2 (dimensionless), input u, outputs the states. Poles 1.2 and 1.
    """
    return _two_states("unstable_integrator", [[1.2, 1.0], [0.0, 1.0]], [[0.0], [1.0]])
