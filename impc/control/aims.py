"""Set points of the controller, sample by sample, from targets and estimated disturbances.

    u_t = u_s - K (x_t - x_s) + v_0

where (x_s, u_s) is the steady state of the sample. The controller plans as if it stayed, or with
the coming targets if the plant knows them (`with_preview`). Bounds apply to the deviations
(docs/why/theory.md, section 7).
"""

from __future__ import annotations

import functools

import numpy as np

from impc.control.compiled_values import Aim
from impc.control.constraint_rows import Directions, families
from impc.control.controller import Controller
from impc.control.simulation import Scenario
from impc.errors import InputError
from impc.model.targets import PlantChange, SteadyStates, expected_disturbance, signal_rows

# Share of its bound up to which a target counts as using none of it.
_NOTHING = 1e-9


def window(aim: Aim, first: int, steps: int) -> Aim:
    """Targets of some samples of a scenario, without their derivatives."""
    ahead = len(aim.taken) - len(aim.x)
    parts = [part[first : first + steps] for part in aim]
    return Aim(*parts)._replace(taken=aim.taken[first : first + steps + ahead])


@functools.lru_cache(maxsize=64)  # thousands of short simulations use it
def _rest(n: int, m: int, p: int) -> Aim:
    """Aim of a controller that regulates to rest."""
    slopes = [np.zeros((0, size, p)) for size in (n, m, 0, 0)]
    return Aim(*(np.zeros(part.shape[:2]) for part in slopes), *slopes)


def aim_of(controller: Controller, given: Scenario, along: Directions) -> Aim:
    """Targets of a scenario, with derivatives along the directions that move them."""
    plant, p = controller.plant, along.count
    if not given.signals and not np.any(plant.observer):
        return _rest(plant.n, plant.m, p)
    whole = families(controller)
    n, m, steps, count = plant.n, plant.m, given.steps, len(whole.b)
    # After the last sample the last target stays.
    places = np.minimum(np.arange(steps + plant.ahead), len(given.target) - 1)
    values = given.target[places] if given.signals else np.zeros((len(places), 0))
    width = plant.E.shape[1]  # predictions have recorded outputs as further disturbances
    pushes = given.disturbance[:, :width]
    expected, dexpected = expected_disturbance(plant, pushes, along.observer)
    last = np.minimum(np.arange(len(values)), steps - 1)
    expected, dexpected = expected[last], dexpected[last]
    states = SteadyStates(plant, signal_rows(plant, given.signals), controller.bounds)
    z, groups = states.at(values, expected)
    # Coming targets are computed without the lasting disturbance.
    lasting = bool(count and np.any(expected))
    alone = states.at(values, 0 * expected) if lasting else (z, groups)
    # A terminal set that the user supplies is centred at the target and needs no correction.
    table = np.zeros((count, n + m))
    table[: len(states.G)] = states.G
    taken, held = alone[0] @ table.T, (z - alone[0])[:steps] @ table.T
    invariant = controller.terminal is not None and not controller.terminal.own
    if invariant and np.any(np.abs(z @ table.T) > _NOTHING * whole.b):
        raise InputError(
            "terminal set",
            "is computed for rest at 0, but a target uses part of the bounds",
            "set terminal_set=False",
        )
    aim = [np.ascontiguousarray(part) for part in (z[:steps, :n], z[:steps, n:], taken, held)]
    moving = (along.A, along.B, along.E[:, :width], along.C, along.observer, along.bounds)
    # Targets are differentiated only along the few directions that move the plant.
    moved = sum(np.any(part, axis=tuple(range(part.ndim - 1))) for part in moving)
    columns = np.flatnonzero(moved)
    if not len(columns):
        return Aim(*aim, *list(_rest(n, m, p))[4:])
    A, B, E, C, _, limits = (part[..., columns] for part in moving)
    dH = [C[plant.outputs.index(name)] if name in plant.outputs else np.zeros((n, len(columns)))
          for name in given.signals]  # fmt: skip
    change = PlantChange(A, B, E, np.array(dH).reshape(-1, n, len(columns)), limits)
    dexpected = dexpected[..., columns]
    slopes = states.slopes(values, expected, dexpected, groups, change)
    ahead = slopes
    if lasting:
        ahead = states.slopes(values, 0 * expected, 0 * dexpected, alone[1], change)
    dtaken, dheld = (
        np.tensordot(part, table, (1, 1)).transpose(0, 2, 1)
        for part in (ahead, (slopes - ahead)[:steps])
    )
    found = []
    for part in (slopes[:steps, :n], slopes[:steps, n:], dtaken, dheld):
        found.append(np.zeros((*part.shape[:2], p)))
        found[-1][..., columns] = part
    return Aim(*aim, *found)
