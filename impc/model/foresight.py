"""Plants that say what their controller knows of the world: lasting disturbances, targets to come.

    dh_{t+1} = dh_t + (1 - exp(-rate dt)) (d_t - dh_t)          what is believed to last

With targets known p samples ahead the deviation e = x - x_s moves by the coming changes D of the
targets, which are states of their own, known one sample later than the one before:

    e+ = A e + B (u - u_s) - M D_0,    D_j+ = D_{j+1},    x_s = M r

so that the gain on them is the feedforward of the linear quadratic regulator (docs/theory.md,
section 7).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, as_numbers, finite_array, frozen
from impc.checking import checked, replace
from impc.errors import PlantError
from impc.model.bounds import Bounds
from impc.model.targets import SteadyStates, signal_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from impc.model.plant import Plant


@checked
def with_observer(plant: Plant, rate: ArrayLike) -> Plant:
    """The same plant, whose controller counters disturbances that last.

    The controller learns each disturbance d at a `rate`, dh' = rate (d - dh), as an observer does
    that sees the state, and regulates to where the plant rests under dh: without an offset of the
    signals that have a target; where none has, to the rest that is nearest to 0. In a
    `PlantFamily` the rate is a parameter like any other, which a fit finds.

    Parameters
    ----------
    plant : Plant
        Discrete, with disturbances.
    rate : array_like
        1/s, for all disturbances or each (d,): 0 where it is not countered, infinite where the
        controller knows it from the first sample on.

    Raises
    ------
    PlantError
        When the plant has no disturbance, or a rate is negative.

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
            f"has shape {given.shape}, a negative value, or {count} disturbances to be for",
            "give 1/s, of at least 0; the plant's inputs that are no controls are disturbances",
        )
    given = np.broadcast_to(given, count)
    return replace(plant.require_discrete(), observer=frozen(given))


@checked(samples=(1, 1000))
def with_preview(plant: Plant, signals: Sequence[str], samples: int) -> Plant:
    """The plant for a controller that knows targets of some signals ahead.

    Its first states are those of the plant; then follow the changes of the targets that are to
    come, the next first. Recordings and scenarios of it take the same outputs, disturbances and
    `x0` as those of the plant, and targets of these signals.

    Parameters
    ----------
    plant : Plant
        Discrete and linear.
    signals : sequence of str
        Outputs or states by name.
    samples : int
        How far ahead their targets are known.

    Raises
    ------
    PlantError
        When the plant has a nonlinear body or a preview, or is continuous.

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
        kind = "has a nonlinear body" if plant.body is not None else "knows targets ahead already"
        raise PlantError("plant", kind, "give plant.linear(), without a preview")
    names, n, q = tuple(signals), plant.n, len(signals)
    if not q:
        raise PlantError("signals", "names none", "name the outputs or states with targets")
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
    """How many states are no changes of targets to come: the first ones."""
    return plant.n - plant.ahead * len(plant.previewed)


def physical_disturbances(plant: Plant) -> int:
    """How many disturbances are no changes of targets: the first ones."""
    return plant.E.shape[1] - 2 * len(plant.previewed)


def with_steps(
    plant: Plant, x0: ArrayLike, pushes: Array, values: Array, names: tuple[str, ...]
) -> tuple[Array, Array]:
    """Initial state (n,) and disturbance (steps, d) of a plant that may know its targets ahead.

    From those of its physical part, (n - ahead q,) and (steps, .), and targets (steps or one more,
    targets); after the last of these nothing changes.
    """
    start, size = as_numbers("x0", x0), physical_states(plant)
    start = finite_array("x0", start, (plant.n if start.shape == (plant.n,) else size,))
    if not plant.ahead:
        return start, pushes
    missing = [name for name in plant.previewed if name not in names]
    if missing:
        raise PlantError(
            "target", f"has none of {', '.join(missing)}", "give target={name: values}"
        )
    known = values[:, [names.index(name) for name in plant.previewed]]
    steps, p = len(pushes), plant.ahead
    places = np.minimum(np.arange(steps + p + 2), len(known) - 1)
    changes = np.diff(known[places], axis=0)
    driven = np.hstack([pushes, changes[p : p + steps], changes[:steps]])
    return np.concatenate([start[:size], changes[:p].ravel()]), driven
