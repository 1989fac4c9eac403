"""Residuals: derivatives by every kind of unknown, and one-step-ahead predictions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import control
import numpy as np
import pytest

import impc
from experiments.driver import first_order_noise, with_noise
from experiments.printed_intervals import carts
from experiments.uncertain_body import HORIZON
from impc.arrays import Array
from impc.inverse.laws import GainLaw, WeightLaw
from impc.inverse.unknowns import Unknowns
from impc.model.signal_errors import KINDS
from tests.inverse import test_signal_errors as signals
from tests.inverse import test_targets_and_gaps as targets
from tests.inverse.test_structured_fit import pushed
from tests.inverse.test_uncertain_body import family, pushes, seat_family
from tests.support import extrapolated_jacobian, posed, present, random_problem, regulator

Case = tuple[Unknowns, Array]


def of_gain(
    law: impc.Controller, problem: impc.Problem, logarithms: Any = None, errors: Any = None
) -> Case:
    """Gain, metric and all that is unknown, somewhere near the truth."""
    space = Unknowns(problem, GainLaw(problem, np.array(law.K), np.array(law.S)))
    logarithms = problem.logarithms if logarithms is None else np.array(logarithms)
    z = space.placed(problem.at(problem.starts, logarithms, errors))
    return space, z + 0.01 * np.random.default_rng(3).standard_normal(len(z))


def delay_and_limit() -> Case:
    """Two stated coefficients, a delay, and the limit, which is met at times."""
    made = family()
    plant, rng, trials = made.make(made.nominal), np.random.default_rng(3), []
    law = regulator(plant, np.diag([4.0, 1.0, 0.01]), 0.42, HORIZON)
    for _ in range(2):
        push = pushes(rng, 0.3)
        y = law.simulate([0, 0, 0], disturbance=push).x[:-1, :1]
        noise = 0.1 * y.std() * first_order_noise(rng, y.shape, 0.0, 200)
        trials.append(impc.Recording(plant, y + noise, push))
    problem = posed(law, *trials, family=made, unknown_start=True)
    return of_gain(law, problem, [0.02, -0.01, 0.1, 0.03])


def nonlinear_body() -> Case:
    """The seat with its 13 stated parameters, at 4 Nm."""
    made = present(seat_family())
    plant = made.make(made.nominal)
    assert plant.body is not None
    v, Q = np.array([0.70, 0.65, 0.22, 0.20]), 1e-2 * np.eye(10)
    Q[:4, :4] += 6e5 * np.outer(v, v) + np.diag([2e4, 2e4, 500, 500])
    law = regulator(plant, Q, 6, 10)
    push = pushes(np.random.default_rng(0), 3.0, 20, 25)
    trial = impc.Recording(plant, law.simulate(np.zeros(10), disturbance=push).outputs[:-1], push)
    return of_gain(law, posed(law, trial, family=made, unknown_start=True), [0.01] * 13)


def cost_weights(*, parameters: bool) -> Case:
    """Features with cross terms, two inputs at their limits; parameters change the gain too."""
    plant = carts(2)
    structure = impc.Structure(plant, ["x[0]", "x[1] - x[0]", "x[2]", "x[3]"], "full")
    weights = np.concatenate([np.log([4.0, 5.0, 1.0, 1.0]), [0.1, 0.2]])
    truth, push = pushed(structure, plant, weights)
    trial = with_noise(truth, push, np.random.default_rng(0), 90.0, 0.0)

    def changed(values: Array) -> impc.Plant:
        B = np.hstack([values[0] * plant.B, plant.E])
        made = control.ss(
            plant.A, B, values[1] * plant.C, 0, plant.dt,
            inputs=[*plant.controls, *plant.disturbances], outputs=list(plant.outputs),
        )  # fmt: skip
        return impc.Plant(made, list(plant.controls))

    free = impc.PlantFamily(changed, ["strength", "gauge"], [1.0, 1.0]) if parameters else None
    problem = posed(truth, trial, terminal_set=False, unknown_start=True, family=free)
    space = Unknowns(problem, WeightLaw(structure, weights + 0.3))
    return space, space.start + 0.05


def gaps_and_commands() -> Case:
    """Observer, target, missing samples, recorded commands, and an offset."""
    plant, rng = impc.with_observer(targets.cart(), 2.0), np.random.default_rng(3)
    law, run = targets.recorded(plant, 0.6)
    y = run.x + 0.05 * rng.normal(size=run.x.shape)
    y[5:9] = np.nan
    trial = impc.Recording(plant, y, targets.WIND, target=targets.TARGET, commands=run.u)
    return of_gain(law, posed(law, trial, offsets=["v"], unknown_start=True, terminal_set=False))


def signal_errors(*, bent: bool) -> Case:
    """Every error of an output and of the push."""
    law = signals.controller(bent=bent)
    problem, truth = signals.recorded(law, {kind: ["angle", "push"] for kind in KINDS})
    return of_gain(law, problem, errors=np.array([0.5 * truth]))


CASES: dict[str, tuple[Callable[[], Case], float]] = {
    "two inputs": (lambda: of_gain(*random_problem(1, 2)), 1e-7),
    "three inputs": (lambda: of_gain(*random_problem(4, 3)), 1e-7),
    "delay and limit": (delay_and_limit, 1e-7),
    "nonlinear body": (nonlinear_body, 1e-6),  # limit of the differences of the body itself
    "cost weights": (lambda: cost_weights(parameters=False), 1e-7),
    "cost weights and parameters": (lambda: cost_weights(parameters=True), 1e-7),
    "gaps and commands": (gaps_and_commands, 1e-7),
    "signal errors": (lambda: signal_errors(bent=False), 1e-7),
    "signal errors, nonlinear body": (lambda: signal_errors(bent=True), 1e-7),
}


@pytest.mark.parametrize("name", CASES)
def test_every_column_of_the_search_is_a_difference(name: str) -> None:
    """Residual, gain and metric by all unknowns, to `size` of the largest entry of a column."""
    made, size = CASES[name]
    space, z = made()
    residual = space.evaluated(z)[0].residual

    def point(z: Array) -> Array:
        found = space.unpack(z)
        return np.concatenate([found.K.ravel(), len(found.S) * found.S.ravel() / np.trace(found.S)])

    def simulated(z: Array) -> Array:
        found = present(space.residual(z))
        return found

    found = np.array([space.pulled(z, one) for one in np.eye(len(residual))])
    wanted = extrapolated_jacobian(simulated, z, 1e-3)
    assert np.max(np.abs(found - wanted) / np.max(np.abs(wanted), axis=0)) < size
    np.testing.assert_allclose(simulated(z), residual, atol=1e-12)
    # Compression rotates the residual of each trial: the gradient of its square stays.
    here = space.at(z)
    assert here.jacobian.T @ here.residual == pytest.approx(residual @ found, rel=1e-10, abs=1e-12)
    changes = np.hstack([part.reshape(len(z), -1) for part in space.changes(z)]).T
    np.testing.assert_allclose(changes, extrapolated_jacobian(point, z), rtol=1e-7, atol=1e-9)
