"""Following a target with a cursor: the tracking error as a plant, in two ways.

In `cursor_plant` the hand moves the cursor with an acceleration that answers the command after a
delay and a lag,

    c'' = a,    tau_m a' + a = u(t - tau_d),    e = c - target,    e' = c' - target',

so that the target's velocity disturbs the error as the torque on a seat disturbs the angles.
States: error (px), velocity of the cursor (px/s), the states of the delay
(`plants.actuation.pade_delay`), acceleration (px/s^2). Inputs: command (px/s^2) and target_rate
(px/s), which is held between samples: give it the increments of the target over the sample time.
Output: error (px). Any unit of length may stand for the pixel.

In `pursuit_plant` the hand's velocity answers, and the delay is one of whole samples, exactly:

    c' = v,    tau v' + v = u(t - N T).

States: error (px), velocity of the cursor (px/s), the commands that are on their way, the next one
first (px/s). Input: command (px/s). There noise in the command is drift of the hand, which fades as
a movement does.

Their parameters were not measured by anybody: delay and lag are fitted, the defaults are where a
fit starts. They are known to 30 ms (visual delays of tracking hands are .1 to .2 s) and 40 %
(judgement). A bound on the command is one before delay and lag. The recordings that they were made
for are described in docs/cursor-tracking.md.
"""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import scipy.linalg

from plants._checks import finite_number
from plants._units import with_uncertainty, with_units
from plants.actuation import delayed_muscle

__all__ = ["cursor_plant", "pursuit_plant"]


def cursor_plant(
    delay: float = 0.15,
    lag: float = 0.08,
    sample_time: float = 1 / 60,
    delay_order: int = 4,
    length: str = "px",
) -> Any:
    """Return the linear plant, sampled with its inputs held.

    Parameters
    ----------
    delay : float
        tau_d in s: from what is seen to what the hand does. Chosen; to be fitted.
    lag : float
        tau_m in s: first-order lag of the hand's acceleration. Chosen; to be fitted.
    sample_time : float
        s; a screen of 60 Hz by default.
    delay_order : int
        Order of the Padé approximant of the delay.
    length : str
        The unit in which the recordings have the error.

    Returns
    -------
    control.StateSpace
        Discrete, ``3 + delay_order`` states; order and units in the module's text.

    Raises
    ------
    ValueError
        When an argument is out of range.
    """
    sample_time = finite_number("sample_time", sample_time, "give it in seconds", above=0.0)
    lag = finite_number("lag", lag, "give it in seconds", above=0.0)
    chain = delayed_muscle(delay, lag, delay_order)
    n = 2 + len(chain.B)
    A, B = np.zeros((n, n)), np.zeros((n, 2))
    A[0, 1] = A[1, -1] = 1.0
    A[2:, 2:] = chain.A
    B[2:, 0] = chain.B
    B[0, 1] = -1.0
    # exp([A B; 0 0] T) = [Ad Bd; 0 I]: exact also where A is singular, as here.
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, n + 2))]]) * sample_time)
    delays = [f"delay_{k}" for k in range(1, delay_order + 1)]
    stages = {name: f"stage {k} of the delay of the nerves" for k, name in enumerate(delays, 1)}
    stages["acceleration"] = "acceleration of the cursor"
    command = f"{length}/s^2", "acceleration that the person asks for"
    matrices = held[:n, :n], held[:n, n:]
    system = _tracking("cursor", matrices, sample_time, length, stages, command)
    return with_uncertainty(system, {"delay": delay, "lag": lag}, {"delay": 0.03, "lag": "40 %"})


def pursuit_plant(
    delay: int = 11, lag: float = 0.03, sample_time: float = 1 / 60, length: str = "px"
) -> Any:
    """Return the linear plant whose velocity is commanded, sampled with its inputs held.

    Parameters
    ----------
    delay : int
        N: whole samples from a command to what the hand does, at least 1. Chosen; to be fitted.
    lag : float
        tau in s: first-order lag of the hand's velocity. Chosen; to be fitted.
    sample_time : float
        T in s; a screen of 60 Hz by default.
    length : str
        The unit in which the recordings have the error.

    Returns
    -------
    control.StateSpace
        Discrete, ``2 + delay`` states; order and units in the module's text.

    Raises
    ------
    ValueError
        When an argument is out of range.
    """
    sample_time = finite_number("sample_time", sample_time, "give it in seconds", above=0.0)
    lag = finite_number("lag", lag, "give it in seconds", above=0.0)
    if isinstance(delay, bool) or not isinstance(delay, int) or delay < 1:
        raise ValueError(f"delay: got {delay!r}; give whole samples, at least 1")
    kept = np.exp(-sample_time / lag)
    # The integral of an answer exp(-t/lag) over a sample: from a velocity to a distance.
    moved = lag * (1 - kept)
    n = 2 + delay
    A, B = np.zeros((n, n)), np.zeros((n, 2))
    A[0, :3] = 1.0, moved, sample_time - moved
    A[1, 1:3] = kept, 1 - kept
    A[2:-1, 3:] = np.eye(delay - 1)
    B[-1, 0] = 1.0
    B[0, 1] = -sample_time
    commands = [f"command_{k}" for k in range(1, delay + 1)]
    stages = {name: f"command of the hand in {k} samples" for k, name in enumerate(commands)}
    command = f"{length}/s", "velocity that the person asks for"
    system = _tracking("pursuit", (A, B), sample_time, length, stages, command)
    return with_uncertainty(system, {"lag": lag}, {"lag": "40 %"})


def _tracking(
    name: str,
    matrices: tuple[Any, Any],
    sample_time: float,
    length: str,
    stages: dict[str, str],
    command: tuple[str, str],
) -> Any:
    """The system of A and B whose states are error, velocity and stages, with their words.

    The stages are in the unit of the command, which comes with its words.
    """
    A, B = matrices
    unit, asked = command
    speed = f"{length}/s"
    system = control.ss(
        A,
        B,
        np.eye(1, len(A)),
        np.zeros((1, 2)),
        dt=sample_time,
        name=name,
        states=["error", "velocity", *stages],
        inputs=["command", "target_rate"],
        outputs=["error"],
    )
    units = {"error": length, "velocity": speed, "target_rate": speed, "command": unit}
    words = {
        "error": "distance from the target",
        "velocity": "cursor velocity",
        "command": asked,
        "target_rate": "target velocity",
    }
    return with_units(system, {**units, **dict.fromkeys(stages, unit)}, {**words, **stages})
