"""Two plants for the error of tracking with a cursor (docs/howto/tracking.md).

`cursor_plant`: the command sets the acceleration of the cursor after a delay and a lag,

    c'' = a,    tau_m a' + a = u(t - tau_d),    e = c - target,    e' = c' - target'.

The target's velocity is a disturbance of the error. States: error (px), velocity of the cursor
(px/s), states of the delay (`plants.actuation.pade_delay`), acceleration (px/s^2). Inputs: command
(px/s^2) and target_rate (px/s), held between samples: the increments of the target over the sample
time. Output: error (px). Any unit of length may replace the pixel.

`pursuit_plant`: the command sets the velocity, after an exact delay of N samples,

    c' = v,    tau v' + v = u(t - N T).

States: error (px), velocity of the cursor (px/s), delayed commands, the next one first (px/s).
Inputs: command (px/s) and target_rate (px/s). Noise in the command is drift of the hand.

The default parameters are starting values for a fit, not measurements. Their standard deviations
are 30 ms for the delay (visual delays of tracking hands are 0.1 to 0.2 s) and 40 % for the lag (an
assumption). A bound on the command acts before delay and lag.
"""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import scipy.linalg

from plants._checks import finite_number
from plants._units import with_signals, with_uncertainty
from plants.actuation import delayed_muscle

_ARGUMENTS = {
    "delay": ("visuomotor delay", "s"),
    "lag": ("lag of the hand", "s"),
    "sample_time": ("sample time", "s"),
    "length": ("unit of the recorded error", ""),
}


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
        Visuomotor delay tau_d in s. Assumed; to be fitted.
    lag : float
        First-order lag tau_m of the hand's acceleration in s. Assumed; to be fitted.
    sample_time : float
        Sample time in s; the default is that of a 60-Hz screen.
    delay_order : int
        Order of the Padé approximant of the delay.
    length : str
        Unit of the recorded error.

    Returns
    -------
    control.StateSpace
        Discrete, ``3 + delay_order`` states; order and units as in the module's docstring.

    Raises
    ------
    ValueError
        If an argument is out of range.
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
    # exp([A B; 0 0] T) = [Ad Bd; 0 I]: exact also for singular A.
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, n + 2))]]) * sample_time)
    delays = [f"delay_{k}" for k in range(1, delay_order + 1)]
    stages = {name: f"stage {k} of the delay of the nerves" for k, name in enumerate(delays, 1)}
    stages["acceleration"] = "acceleration of the cursor"
    command = f"{length}/s^2", "acceleration that the person asks for"
    matrices = held[:n, :n], held[:n, n:]
    system = _tracking("cursor", matrices, sample_time, length, stages, command)
    known: dict[str, float | str] = {"delay": 0.03, "lag": "40 %"}
    arguments = {**_ARGUMENTS, "delay_order": ("order of the approximation of the delay", "")}
    return with_uncertainty(system, {"delay": delay, "lag": lag}, known, arguments)


def pursuit_plant(
    delay: int = 11, lag: float = 0.03, sample_time: float = 1 / 60, length: str = "px"
) -> Any:
    """Return the linear plant whose velocity is commanded, sampled with its inputs held.

    Parameters
    ----------
    delay : int
        Delay N from command to velocity, in whole samples, at least 1. Assumed; to be fitted.
    lag : float
        First-order lag tau of the hand's velocity in s. Assumed; to be fitted.
    sample_time : float
        Sample time T in s; the default is that of a 60-Hz screen.
    length : str
        Unit of the recorded error.

    Returns
    -------
    control.StateSpace
        Discrete, ``2 + delay`` states; order and units as in the module's docstring.

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    sample_time = finite_number("sample_time", sample_time, "give it in seconds", above=0.0)
    lag = finite_number("lag", lag, "give it in seconds", above=0.0)
    if isinstance(delay, bool) or not isinstance(delay, int) or delay < 1:
        raise ValueError(f"delay: got {delay!r}; give whole samples, at least 1")
    kept = np.exp(-sample_time / lag)
    # Integral of exp(-t/lag) over a sample: distance per unit of velocity.
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
    arguments = {**_ARGUMENTS, "delay": ("visuomotor delay in samples", "")}
    return with_uncertainty(system, {"lag": lag}, {"lag": "40 %"}, arguments)


def _tracking(
    name: str,
    matrices: tuple[Any, Any],
    sample_time: float,
    length: str,
    stages: dict[str, str],
    command: tuple[str, str],
) -> Any:
    """System of A and B with the states error, velocity and `stages` (name -> words).

    `command` has the unit of the command and of the stages, and its words.
    """
    A, B = matrices
    names: dict[str, Any] = {"inputs": ["command", "target_rate"], "outputs": ["error"]}
    names |= {"states": ["error", "velocity", *stages], "name": name}
    system = control.ss(A, B, np.eye(1, len(A)), np.zeros((1, 2)), dt=sample_time, **names)
    speed, there = f"{length}/s", "if the cursor is on the positive side of the target"
    signals = {
        "error": (length, "distance from the target", there),
        "velocity": (speed, "cursor velocity", "if the cursor moves to the positive side"),
        "command": (*command, "if it drives the cursor to the positive side"),
        "target_rate": (speed, "target velocity", "if the target moves to the positive side"),
        **{stage: (command[0], words) for stage, words in stages.items()},
    }
    return with_signals(system, signals)
