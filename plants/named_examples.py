"""A small unstable system from the literature as example for inverse MPC.

The dissertation takes its example (3.8) from its reference [80]; matrices, bound and initial state
are not available. `yalmip_example` has all properties that the dissertation states of its example.
"""

from __future__ import annotations

from typing import Any

import control
import numpy as np

from plants._units import with_signals


def yalmip_example() -> Any:
    """Return A = [2 -1; 1 0.2], B = [1; 0], the primary example. Used with abs(u) <= 1.

    Source: the "standard MPC" model of the YALMIP wiki, where Q = I, R = 2, N = 7 and
    x0 = [3; 1]; the dissertation used YALMIP. Confidence in the matrices: certain. That they equal
    those of the dissertation's (3.8), which are not available, is a guess.

    Returns
    -------
    control.StateSpace
        States x1, x2 (dimensionless), input u, outputs the states; sample time 1 s, no direct
        feedthrough. Poles 1.1 +- 0.436i.
    """
    names: dict[str, Any] = {"states": ["x1", "x2"], "inputs": ["u"], "outputs": ["x1", "x2"]}
    A, B = [[2.0, -1.0], [1.0, 0.2]], [[1.0], [0.0]]
    system = control.ss(A, B, np.eye(2), np.zeros((2, 1)), dt=1.0, name="yalmip", **names)
    return with_signals(system, dict.fromkeys(("x1", "x2", "u"), ("1",)))
