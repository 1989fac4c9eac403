"""Compare offset-free inverse MPC with delayed PI feedback on people who steer a cursor.

    python -m experiments.steering folder [trials]

`folder` contains trials of Yamagami, Howell, Roth and Burden (CPHS 2018) as <person>_<plant>_
<trial>.csv, with columns time (s), y, slider, push at 60 Hz. The recordings are public and not part
of the project. The plant is y' = u + d (fo) or y'' = u + d - y' (so), without model error, and the
slider is recorded exactly. The hand follows its command after a delay and a lag. Both are fitted,
together with the rate at which the person learns the push. Both methods are fitted to the trials
with phases `p` and simulated on those with phases `m`, without the first second.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np
import scipy.linalg
import scipy.optimize

import impc
from impc.arrays import Array
from impc.assess.variance_accounted_for import left_out_vaf
from plants.actuation import pade_delay

RATE, SETTLE, HORIZON, FAR = 60.0, 1.0, 20, 1e3


def hand_and_cursor(values: Array, order: int) -> impc.Plant:
    """Plant of cursor, hand and Padé delay, from delay (s), lag (s) and learning rate (1/s)."""
    delay, lag, learning = values
    late = pade_delay(delay, 2)
    a, b, c, d = (np.asarray(late.A), np.asarray(late.B), np.asarray(late.C), np.asarray(late.D))
    n = order + 3
    A, B = np.zeros((n, n)), np.zeros((n, 2))
    A[0, 1] = 1.0  # y' = hand + push, or y' = v with v' = hand + push - v
    B[order - 1, 1] = 1.0
    if order == 2:
        A[1, 1], A[1, 2] = -1.0, 1.0
    A[order, order], A[order, order + 1 :] = -1 / lag, np.ravel(c) / lag
    B[order, 0], A[order + 1 :, order + 1 :] = d.item() / lag, a
    B[order + 1 :, 0] = np.ravel(b)
    whole = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, n + 2))]]) / RATE)
    C = np.eye(n)[[0, order]]
    system = control.ss(
        *(whole[:n, :n], whole[:n, n:], C, 0, 1 / RATE),
        states=[*["y", "rate"][:order], "hand", "late 1", "late 2"],
        inputs=["command", "push"],
        outputs=["y", "slider"],
    )
    return impc.with_observer(impc.Plant(system, controls=["command"]), learning)


def trials_of(folder: Path, person: str, kind: str, phase: str, most: int) -> Array:
    """Read time, y, slider, and push of every trial, shape (samples, trials, 4)."""
    files = sorted(folder.glob(f"{person}_{kind}_*{phase}.csv"))[:most]
    read = [np.loadtxt(file, delimiter=",", skiprows=1) for file in files]
    return np.stack([one[: min(map(len, read))] for one in read], axis=1)


def vaf(recorded: Array, simulated: Array) -> float:
    """Variance accounted for after the settling time, %."""
    first = round(SETTLE * RATE)
    return float(impc.vaf(recorded[first:, None], simulated[first:, None])[0])


def delayed_feedback(gains: Array, delay: int, trials: Array, order: int) -> Array:
    """Simulate u = -kp y - ki (integral of y), `delay` samples late: cursors (samples, k)."""
    e, h = np.exp(-1 / RATE), 1 / RATE
    y = np.zeros(trials.shape[:2])
    v, total = np.zeros(y.shape[1]), np.zeros(y.shape[1])
    y[0] = trials[0, :, 1]
    for t in range(len(y) - 1):
        seen = y[t - delay] if t >= delay else 0 * v
        total = total + seen * h
        push = -gains[0] * seen - gains[1] * total + trials[t, :, 3]
        if order == 1:
            y[t + 1] = y[t] + h * push
        else:
            y[t + 1] = y[t] + (1 - e) * v + (h - (1 - e)) * push
            v = e * v + (1 - e) * push
        y[t + 1] = np.clip(y[t + 1], -FAR, FAR)  # Diverging simulations stay finite
    return y


def fit_delayed(train: Array, order: int) -> tuple[Array, int]:
    """Least-squares gains and delay of the delayed PI feedback."""
    best: tuple[float, Array, int] = (np.inf, np.zeros(2), 0)
    for delay in range(2, 31, 2):

        def missed(gains: Array, delay: int = delay) -> float:
            return float(
                np.sum((delayed_feedback(gains, delay, train, order) - train[..., 1]) ** 2)
            )

        found = scipy.optimize.minimize(
            missed, [1.0, 0.3], method="Nelder-Mead", options={"maxfev": 60}
        )
        if found.fun < best[0]:
            best = (float(found.fun), found.x, delay)
    return best[1], best[2]


def compare(
    folder: Path, person: str, kind: str, most: int, report: Callable[[str], None] = print
) -> None:
    """Print the held-out VAF of both methods and the fitted parameters."""
    order = 1 if kind == "fo" else 2
    train, test = (trials_of(folder, person, kind, phase, most) for phase in "pm")
    gains, delay = fit_delayed(train, order)
    simulated = delayed_feedback(gains, delay, test, order)
    plain = np.mean([vaf(y, own) for y, own in zip(test[..., 1].T, simulated.T, strict=True)])
    nominal = [0.25, 0.08, 1.0]
    family = impc.PlantFamily(
        lambda values: hand_and_cursor(values, order), ["delay", "lag", "learning"], nominal
    )
    plant = hand_and_cursor(np.array(nominal), order)
    bounds = impc.Bounds(plant)

    def recording(one: Array) -> impc.Recording:
        return impc.Recording(plant, one[:, 1:3], one[:, 3])

    problem = impc.Problem(
        plant,
        bounds,
        HORIZON,
        [recording(one) for one in np.swapaxes(train, 0, 1)],
        family=family,
        terminal_set=False,
    )
    found = impc.fit(problem)
    held_out = np.array(
        [left_out_vaf(found, recording(one), SETTLE).vaf for one in np.swapaxes(test, 0, 1)]
    )
    rows = found.intervals().loc[list(family.names), ["value", "low", "high"]].to_numpy()
    fitted = ", ".join(
        f"{name} {value:.3g} ({low:.3g} to {high:.3g})"
        for name, (value, low, high) in zip(family.names, rows, strict=True)
    )
    report(
        f"{person} {kind}: cursor, held out: inverse MPC {np.nanmean(held_out[:, 0]):.1f} %, "
        f"delayed PI {plain:.1f} %; slider {np.nanmean(held_out[:, 1]):.1f} %; "
        f"fitted to: {found.vaf.round(1)}; {found.status.value}; {fitted}"
    )
    report(
        f"    K {np.round(found.gain, 2).tolist()}, PI {gains.round(2)}, {delay / RATE:.2f} s late"
    )
    report(f"    {' '.join(found.doubts)}")


def main(folder: Path, most: int) -> None:
    """Compare the methods for every person and both plants."""
    for person in sorted({file.name.split("_")[0] for file in folder.glob("*_fo_*.csv")}):
        for kind in ("fo", "so"):
            compare(folder, person, kind, most)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 5)
