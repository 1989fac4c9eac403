"""Plants whose controller knows lasting disturbances or future targets.

Estimate of a lasting disturbance:

    dh_{t+1} = dh_t + (1 - exp(-rate dt)) (d_t - dh_t)

With targets known p samples ahead, the deviation e = x - x_s also depends on the coming changes D
of the targets, which are states that shift by one place per sample:

    e+ = A e + B (u - u_s) - M D_0,    D_j+ = D_{j+1},    x_s = M r

so that the gain on them is the feedforward of the LQR (docs/why/theory.md, section 7).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, as_numbers, finite_array, frozen
from impc.checking import checked, replace
from impc.errors import PlantError
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.targets import SteadyStates, signal_rows


@checked
def with_observer(plant: Plant, rate: ArrayLike) -> Plant:
    """Return the plant with a controller that compensates lasting disturbances.

    The controller estimates each disturbance d by dh' = rate (d - dh), like an observer that
    measures the state, and regulates to the equilibrium under dh: without offset of the signals
    that have a target; without targets, to the equilibrium nearest to 0. In a `PlantFamily` the
    rate is a parameter like any other, which a fit can estimate.

    Parameters
    ----------
    plant : Plant
        Discrete-time plant with disturbances.
    rate : array_like
        Rate in 1/s for all disturbances, or for each (d,): 0 if it is not compensated, infinite if
        the controller knows it from the first sample on.

    Returns
    -------
    Plant
        Same plant with `observer` set.

    Raises
    ------
    PlantError
        If the plant has no disturbance, or a rate is negative.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> cart = control.ss([[1, 0.1], [0, 1]], [[0, 0], [0.1, 0.1]], [[1, 0]], 0, 0.1)
    >>> cart.input_labels = ["push", "wind"]
    >>> plant = impc.with_observer(impc.Plant(cart, controls=["push"]), rate=2.0)
    >>> law = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), impc.Bounds(plant), 5)
    >>> run = law.simulate([0, 0], disturbance=[1.0] * 200)
    >>> run.x[-1].round(6) + 0.0, run.u[-1].round(6)
    (array([0., 0.]), array([-1.]))
    """
    given, count = as_numbers("rate", rate), len(plant.disturbances)
    if given.shape not in ((), (1,), (count,)) or not count or not np.all(given >= 0):
        raise PlantError(
            "rate",
            f"has shape {given.shape} or a negative value, for {count} disturbances",
            "give one rate >= 0 in 1/s, or one for each disturbance (input that is no control)",
        )
    given = np.broadcast_to(given, count)
    return replace(plant.require_discrete(), observer=frozen(given))


@checked(samples=(1, 1000))
def with_preview(plant: Plant, signals: Sequence[str], samples: int) -> Plant:
    """Return the plant for a controller that knows targets of some signals in advance.

    Its first states are those of the plant, followed by the coming changes of the targets, the next
    one first. Its recordings and scenarios take the same outputs, disturbances and `x0` as those of
    the plant, and targets of these signals.

    Parameters
    ----------
    plant : Plant
        Discrete-time, linear plant.
    signals : sequence of str
        Outputs or states by name.
    samples : int
        Number of samples by which their targets are known in advance.

    Returns
    -------
    Plant
        Plant with `samples` further states for each signal.

    Raises
    ------
    PlantError
        If the plant has a nonlinear body or a preview, or is continuous.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[1.0]], [[1.0]], [[1.0]], 0, 0.1, outputs="y"))
    >>> known = impc.with_preview(plant, ["y"], 2)
    >>> known.states
    ('x[0]', 'y step 1', 'y step 2')
    >>> law = impc.Controller(known, impc.Weights([[1, 0, 0], [0, 1e-9, 0], [0, 0, 1e-9]], 1),
    ...                       impc.Bounds(known), 5)
    >>> run = law.simulate([0.0], steps=6, target={"y": [0, 0, 0, 1, 1, 1, 1]})
    >>> bool(run.u[0] == 0), bool(run.u[1] > 0)
    (True, True)
    """
    plant.require_discrete()
    if plant.body is not None or plant.ahead:
        kind = "has a nonlinear body" if plant.body is not None else "has a preview already"
        raise PlantError("plant", kind, "pass plant.linear(), without a preview")
    names, n, q = tuple(signals), plant.n, len(signals)
    if not q:
        raise PlantError("signals", "is empty", "name the outputs or states with targets")
    rest = SteadyStates(plant, signal_rows(plant, names), Bounds(plant))
    M = rest.at(np.eye(q), np.zeros((q, plant.E.shape[1])))[0][:, :n].T
    width = n + q * samples
    A, E = np.zeros((width, width)), np.zeros((width, plant.E.shape[1] + 2 * q))
    A[:n, :n], A[:n, n : n + q], A[n:-q, n + q :] = plant.A, -M, np.eye(width - n - q)
    E[:n, : plant.E.shape[1]] = plant.E
    E[width - q :, -2 * q : -q], E[:n, -q:] = np.eye(q), M
    later = [f"{name} step {k + 1}" for k in range(samples) for name in names]
    entering = [f"{name} step {when}" for when in ("ahead", "now") for name in names]
    unit = {f"{name} step {k}": plant.unit(name) for name in names
            for k in (*range(1, samples + 1), "ahead", "now")}  # fmt: skip
    word = {name: f"change of a target, {name.rsplit(' ', 1)[1]} samples ahead" for name in later}
    return replace(
        plant,
        A=frozen(A),
        B=frozen(np.vstack([plant.B, np.zeros((width - n, plant.m))])),
        E=frozen(E),
        C=frozen(np.hstack([plant.C, np.zeros((len(plant.C), width - n))])),
        states=(*plant.states, *later),
        disturbances=(*plant.disturbances, *entering),
        units=(*plant.units, *unit.items()),
        words=(*plant.words, *word.items()),
        observer=frozen(np.r_[plant.observer, np.zeros(2 * q)]),
        ahead=samples,
        previewed=names,
    )


def physical_states(plant: Plant) -> int:
    """Number of states (the first ones) that are not coming changes of targets."""
    return plant.n - plant.ahead * len(plant.previewed)


def physical_disturbances(plant: Plant) -> int:
    """Number of disturbances (the first ones) that are not changes of targets."""
    return plant.E.shape[1] - 2 * len(plant.previewed)


def with_steps(
    plant: Plant, x0: ArrayLike, pushes: Array, values: Array, names: tuple[str, ...]
) -> tuple[Array, Array]:
    """Initial state (n,) and disturbance (steps, d) of a plant, extended by previewed targets.

    `x0` and `pushes` are those of the physical part; `values` the targets (steps or one more, q),
    constant after the last.
    """
    start, size = as_numbers("x0", x0), physical_states(plant)
    start = finite_array("x0", start, (plant.n if start.shape == (plant.n,) else size,))
    if not plant.ahead:
        return start, pushes
    missing = [name for name in plant.previewed if name not in names]
    if missing:
        raise PlantError("target", f"lacks {', '.join(missing)}", "pass target={name: values}")
    known = values[:, [names.index(name) for name in plant.previewed]]
    steps, p = len(pushes), plant.ahead
    places = np.minimum(np.arange(steps + p + 2), len(known) - 1)
    changes = np.diff(known[places], axis=0)
    driven = np.hstack([pushes, changes[p : p + steps], changes[:steps]])
    return np.concatenate([start[:size], changes[:p].ravel()]), driven
