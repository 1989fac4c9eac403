"""Expected intervals against finite differences and dense covariances."""

from __future__ import annotations

import functools

import control
import numpy as np
import pytest
import scipy.linalg

import impc
from experiments.printed_intervals import carts
from impc.arrays import Array
from impc.assess.expected import Expectation
from impc.control.closed_loop import simulate
from tests.support import differences

COST_WEIGHTS = np.log([4.0, 1.5])
NOISE = 0.03
SAMPLES = 160


def cart() -> tuple[impc.Plant, impc.Structure, Array]:
    """Cart with cost weights of position and speed, and a push up to its limit."""
    plant = carts(1)
    push = np.repeat(np.random.default_rng(3).choice([-0.8, 0.0, 0.8], (16, 1)), 10, axis=0)
    return plant, impc.Structure(plant, "diagonal"), push


def outputs(cost_weights: Array, x0: Array, limit: float) -> Array:
    """Simulated positions (samples,)."""
    plant, structure, push = cart()
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    law = impc.Controller(plant, structure.weights(cost_weights), bounds, 8, terminal_set=False)
    run = simulate(law, impc.scenario(plant, x0, disturbance=push))
    return np.asarray((run.x @ plant.C.T)[:SAMPLES, 0])


@functools.cache
def cart_problem(family: impc.PlantFamily | None = None) -> impc.Problem:
    plant, structure, push = cart()
    trial = impc.Recording(plant, outputs(COST_WEIGHTS, np.zeros(2), 1.0)[:, None], push)
    return impc.Problem(
        plant, impc.Bounds(plant, u_min=-1, u_max=1), 8, [trial],
        terminal_set=False, unknown_start=True, structure=structure, family=family,
    )  # fmt: skip


@functools.cache
def expected(root: float = 0.0) -> Expectation:
    return impc.expected_intervals(cart_problem(), COST_WEIGHTS, NOISE, root=root)


@functools.cache
def columns() -> tuple[Array, Array, Array]:
    """Derivatives by log weights, initial state and log limit, by five-point differences."""

    def moved(z: Array) -> Array:
        return outputs(COST_WEIGHTS + z[:2], z[2:4], float(np.exp(z[4])))

    # At steps of 1e-4 a sample reaches its limit in between.
    one, two = (differences(moved, np.zeros(5), step) for step in (1e-5, 2e-5))
    found = (4 * one - two) / 3
    return found[:, :2], found[:, 2:4], found[:, 4]


@pytest.mark.parametrize("root", [0.0, 0.6])
def test_deviations_are_those_of_least_squares(root: float) -> None:
    """Against the covariance matrix of first-order noise."""
    found, noise = expected(root), NOISE**2 * scipy.linalg.toeplitz(root ** np.arange(SAMPLES))
    back = np.linalg.pinv(np.hstack(columns()[:2]))
    block = (back @ noise @ back.T)[:2, :2]
    # The package's noise model reaches 250 samples back; differences are accurate to 1e-7.
    np.testing.assert_allclose(found.deviations, np.sqrt(np.diag(block)), rtol=2e-5)
    assert found.mean_variance == pytest.approx(np.mean(np.diag(block)), rel=1e-4)
    if root == 0:
        assert found.log_determinant == pytest.approx(np.linalg.slogdet(block)[1], abs=1e-4)


def test_the_limit_is_known_as_least_squares_with_a_free_gain_says() -> None:
    on_cost_weights, on_start, on_limit = columns()
    # Two cost weights move this gain in both of its directions: the same span.
    others = np.hstack([on_cost_weights, on_start])
    rest = on_limit - others @ np.linalg.lstsq(others, on_limit)[0]
    assert expected().limits[0] == pytest.approx(NOISE / np.linalg.norm(rest), rel=2e-5)
    plant, _, push = cart()
    wide = impc.Bounds(plant, u_min=-9, u_max=9)  # never met
    trial = impc.Recording(plant, outputs(COST_WEIGHTS, np.zeros(2), 9.0)[:, None], push)
    problem = impc.replace(cart_problem(), bounds=wide, recordings=[trial])
    assert np.isinf(impc.expected_intervals(problem, COST_WEIGHTS, NOISE).limits[0])


def test_small_noise_makes_intervals_of_deviations() -> None:
    """Normal intervals of 1.96 standard errors; ten times the noise, ten times as wide."""

    def ends(found: Expectation) -> Array:
        return np.array(
            [[item.low - item.value, item.high - item.value] for item in found.intervals]
        )

    small, large = (impc.expected_intervals(cart_problem(), COST_WEIGHTS, x) for x in (1e-4, 1e-3))
    assert large.deviations == pytest.approx(10 * small.deviations, rel=1e-9)
    wanted = 1.959964 * np.outer(small.deviations, [-1.0, 1.0])
    np.testing.assert_allclose(ends(small), wanted, rtol=0.02)


def test_a_product_of_commands_makes_intervals_normal() -> None:
    """Two carts with a cross weight of their forces: the unknowns are factors, not logarithms."""
    plant = carts(2)
    structure, bounds = (
        impc.Structure(plant, "diagonal", "full"),
        impc.Bounds(plant, u_min=-1, u_max=1),
    )
    unknowns = np.append(np.zeros(structure.count - 1), 0.3)
    push = np.repeat(np.random.default_rng(3).choice([-0.8, 0.0, 0.8], (16, 2)), 10, axis=0)
    law = impc.Controller(plant, structure.weights(unknowns), bounds, 8, terminal_set=False)
    trial = impc.Recording(plant, law.simulate(np.zeros(4), disturbance=push).outputs[:-1], push)
    problem = impc.Problem(plant, bounds, 8, [trial], terminal_set=False, structure=structure)
    found = impc.expected_intervals(problem, unknowns, NOISE)
    assert np.all(np.isfinite(found.deviations))
    ends = np.array([[item.value, item.low, item.high] for item in found.intervals])
    values = structure.reported(unknowns)[0][:, None]
    wanted = values + 1.959964 * np.outer(found.deviations, [0.0, -1.0, 1.0])
    np.testing.assert_allclose(ends, wanted, atol=1e-6)


def known_to(uncertainty: dict[str, float | str]) -> Expectation:
    """Cart with stated uncertainties of force per command and rate of falling."""

    def made(values: Array) -> impc.Plant:
        force, fall = values
        system = control.ss(
            [[0, 1], [fall, -0.3]], [[0, 0], [force, 1]], [[1, 0]], 0,
            inputs=["force1", "push1"], outputs=["position1"],
        )  # fmt: skip
        return impc.Plant(control.c2d(system, 0.1), ["force1"])

    family = impc.PlantFamily(made, ["force", "fall"], [1.0, 0.3], uncertainty)
    return impc.expected_intervals(cart_problem(family), COST_WEIGHTS, NOISE)


STATED: dict[str, float | str] = {"force": "5 %", "fall": 0.06, "u_max": "5 %"}


def test_an_exact_body_and_one_that_is_measured_are_those_of_their_own_problems() -> None:
    found, exact = known_to(STATED), expected()
    assert exact.body is None
    assert found.body is not None
    assert found.body.names == ("force", "fall", "u_max.force1")
    assert found.body.exact == pytest.approx(exact.deviations, rel=1e-6)
    for name, measured in zip(STATED, found.body.measured, strict=True):
        other = known_to(STATED | {name: 0.0})
        assert measured == pytest.approx(other.deviations, rel=1e-6)
        fall = 1 - other.deviations / found.deviations
        assert found.narrower(found.body.measured)[list(STATED).index(name)] == pytest.approx(fall)
    # The stated uncertainty of the limit is excluded from its expected precision.
    assert found.limits == pytest.approx(known_to(STATED | {"u_max": 0.0}).limits, rel=1e-6)


def test_no_number_of_trials_tells_a_weak_force_from_a_weak_person() -> None:
    """Scaling force, commands, limits and cost weights together leaves the outputs unchanged."""
    # The best known precision is therefore 2 sqrt(1 / (1 / .05^2 + 1 / .05^2)).
    body = known_to(STATED).body
    assert body is not None
    assert body.floor == pytest.approx(np.full(2, 2 * 0.05 / np.sqrt(2)), rel=0.01)
    # The known limit identifies the force.
    other = known_to({"force": "5 %"})
    assert other.body is not None
    assert np.all(other.body.floor < 0.05 * other.deviations)


def test_what_cannot_be_meant_is_refused() -> None:
    problem = cart_problem()
    with pytest.raises(impc.InputError, match="structure"):
        impc.expected_intervals(impc.replace(problem, structure=None), COST_WEIGHTS, NOISE)
    with pytest.raises(impc.InputError, match="deviation"):
        impc.expected_intervals(problem, COST_WEIGHTS, 0.0)
    with pytest.raises(impc.InputError, match="root"):
        impc.expected_intervals(problem, COST_WEIGHTS, NOISE, root=1.0)
