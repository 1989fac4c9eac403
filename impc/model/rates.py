"""Plants whose controls are changes of their commands, which can be bounded or penalised.

    x+ = A x + B (c + w) + E d,    c+ = c + w,    u = c + w

where c is the last command, w its change and u the applied command. The cost c'Rc + w'Vw of last
commands and changes equals u'Ru + w'Vw one sample later. Over an infinite horizon both differ only
by the first c'Rc, which is constant: with the terminal weight of the Riccati equation both give the
same controller.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import frozen
from impc.checking import checked, replace
from impc.errors import PlantError
from impc.model.plant import Plant


@checked
def with_rates(plant: Plant) -> Plant:
    """Return the plant whose controls are the changes of its commands per sample.

    The cost weight of the change is the one of its control (R); the cost weight of the command is
    that of the state of the same name (Q). A bound on that state applies to the command at every
    sample of the horizon and is always hard, like bounds on controls.

    Parameters
    ----------
    plant : Plant
        Discrete-time plant. A control "torque" becomes the state "torque", the command of the
        previous sample, and the control "change of torque", in the same unit. For a family use
        ``PlantFamily(lambda values: with_rates(make(values)), names, nominal)``.

    Returns
    -------
    Plant
        Plant with the m last commands as further states. The `x0` of a recording contains the
        command before its first sample; the command applied at a sample is the state of the next.

    Raises
    ------
    PlantError
        If the plant is continuous, has a nonlinear body, or another signal has the name of a
        control.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> system = control.ss([[0.98]], [[0.1]], [[1]], 0, 0.1, inputs=["torque"], states=["angle"])
    >>> rates = impc.with_rates(impc.Plant(system))
    >>> rates.states, rates.controls
    (('angle', 'torque'), ('change of torque',))
    >>> bounds = impc.Bounds(rates, x_max={"torque": 1}, u_max={"change of torque": 0.4})
    >>> law = impc.Controller(rates, impc.Weights([[10, 0], [0, 0.5]], 1), bounds, horizon=10)
    >>> law.simulate([-1, 0], steps=4).x[:, 1]
    array([0. , 0.4, 0.8, 1. , 1. ])
    """
    plant.require_discrete()
    if plant.body is not None:
        raise PlantError("plant", "has a nonlinear body", "pass plant.linear()")
    if plant.ahead:
        raise PlantError("plant", "has a preview", "use with_preview(with_rates(plant), ...)")
    taken = {*plant.states, *plant.outputs, *plant.disturbances}.intersection(plant.controls)
    if taken:
        raise PlantError("plant", f"has two signals {taken.pop()!r}", "give each its own name")
    n, m = plant.B.shape
    changes = {name: f"change of {name}" for name in plant.controls}
    units = [(changes[name], unit) for name, unit in plant.units if name in changes]
    words = [
        (changes[name], f"change of {word} per sample")
        for name, word in plant.words
        if name in changes
    ]
    return replace(
        plant,
        A=frozen(np.block([[plant.A, plant.B], [np.zeros((m, n)), np.eye(m)]])),
        B=frozen(np.vstack([plant.B, np.eye(m)])),
        E=frozen(np.vstack([plant.E, np.zeros((m, plant.E.shape[1]))])),
        C=frozen(np.hstack([plant.C, np.zeros((len(plant.C), m))])),
        states=(*plant.states, *plant.controls),
        controls=tuple(changes.values()),
        units=(*plant.units, *units),
        words=(*plant.words, *words),
        commands=(*plant.commands, *plant.controls),
    )
