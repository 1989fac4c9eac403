"""Expected intervals against finite differences and dense covariances."""

from __future__ import annotations

import functools

import control
import numpy as np
import pytest
import scipy.linalg

from experiments.printed_intervals import carts
from impc.arrays import Array
from impc.assess.expected import Expectation, expected_intervals
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.errors import InputError
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily
from impc.model.recordings import Recording
from impc.model.structure import Structure

COST_WEIGHTS = np.log([4.0, 1.5])
NOISE = 0.03
SAMPLES = 160


def cart() -> tuple[Plant, Structure, Array]:
    """Cart with cost weights of position and speed, and a push up to its limit."""
    plant = carts(1)
    push = np.repeat(np.random.default_rng(3).choice([-0.8, 0.0, 0.8], (16, 1)), 10, axis=0)
    return plant, Structure(plant, "diagonal"), push


def outputs(cost_weights: Array, x0: Array, limit: float) -> Array:
    """Simulated positions (samples,)."""
    plant, structure, push = cart()
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    law = Controller(plant, structure.weights(cost_weights), bounds, 8, terminal_set=False)
    run = simulate(law, scenario(plant, x0, disturbance=push))
    return np.asarray((run.x @ plant.C.T)[:SAMPLES, 0])


@functools.cache
def cart_problem() -> Problem:
    plant, structure, push = cart()
    trial = Recording(plant, outputs(COST_WEIGHTS, np.zeros(2), 1.0)[:, None], push)
    return Problem(
        plant, Bounds(plant, u_min=-1, u_max=1), 8, [trial],
        terminal_set=False, unknown_start=True, structure=structure,
    )  # fmt: skip


@functools.cache
def expected(root: float = 0.0) -> Expectation:
    return expected_intervals(cart_problem(), COST_WEIGHTS, NOISE, root=root)


def differences(points: list[tuple[Array, Array, float]], step: float) -> Array:
    """Derivative (samples,) from values at +h, -h, +2h, -2h."""
    one, two, three, four = (outputs(*point) for point in points)
    return np.asarray((8 * (one - two) - (three - four)) / (12 * step))


def columns() -> tuple[Array, Array, Array]:
    """Derivatives by log weights, initial state and log limit."""
    # At steps of 1e-4 a sample reaches its limit in between.
    h, still = 1e-5, np.zeros(2)
    ways = (1.0, -1.0, 2.0, -2.0)
    on_cost_weights = [
        differences([(COST_WEIGHTS + way * h * row, still, 1.0) for way in ways], h)
        for row in np.eye(2)
    ]
    on_start = [
        differences([(COST_WEIGHTS, way * h * row, 1.0) for way in ways], h) for row in np.eye(2)
    ]
    on_limit = differences([(COST_WEIGHTS, still, float(np.exp(way * h))) for way in ways], h)
    return np.array(on_cost_weights).T, np.array(on_start).T, on_limit


def dense(root: float) -> Array:
    """Covariance of first-order noise (samples, samples)."""
    return np.asarray(NOISE**2 * scipy.linalg.toeplitz(root ** np.arange(SAMPLES)))


@pytest.mark.parametrize("root", [0.0, 0.6])
def test_deviations_are_those_of_least_squares(root: float) -> None:
    found = expected(root)
    on_cost_weights, on_start, _ = columns()
    both = np.hstack([on_cost_weights, on_start])
    back = np.linalg.pinv(both)
    truth = np.sqrt(np.diag(back @ dense(root) @ back.T))[:2]
    # The package's noise model reaches 250 samples back; differences are accurate to 1e-7.
    np.testing.assert_allclose(found.deviations, truth, rtol=2e-5)
    assert found.mean_variance == pytest.approx(np.mean(truth**2), rel=1e-4)
    block = (back @ dense(root) @ back.T)[:2, :2]
    if root == 0:
        determinant = np.linalg.slogdet(block)[1]
        assert found.log_determinant == pytest.approx(determinant, abs=1e-4)


def test_the_limit_is_told_as_least_squares_with_a_free_gain_tells_it() -> None:
    found = expected()
    on_cost_weights, on_start, on_limit = columns()
    # Two cost weights move this gain in both of its directions: the same span.
    others = np.hstack([on_cost_weights, on_start])
    rest = on_limit - others @ np.linalg.lstsq(others, on_limit)[0]
    assert found.limits[0] == pytest.approx(NOISE / np.linalg.norm(rest), rel=2e-5)


def test_a_limit_that_is_never_met_is_not_told() -> None:
    problem = cart_problem()
    plant = problem.plant
    wide = Bounds(plant, u_min=-9, u_max=9)
    law = Controller(plant, cart()[1].weights(COST_WEIGHTS), wide, 8, terminal_set=False)
    run = simulate(law, scenario(plant, np.zeros(2), disturbance=cart()[2]))
    trial = Recording(plant, (run.x @ plant.C.T)[:SAMPLES], cart()[2])
    found = expected_intervals(
        replace(problem, bounds=wide, recordings=[trial]), COST_WEIGHTS, NOISE
    )
    assert np.isinf(found.limits[0])


def test_small_noise_makes_intervals_of_deviations() -> None:
    """Normal intervals of 1.96 standard errors; ten times the noise, ten times as wide."""

    def ends(found: Expectation) -> Array:
        return np.array(
            [[item.low - item.value, item.high - item.value] for item in found.intervals]
        )

    small, large = (expected_intervals(cart_problem(), COST_WEIGHTS, x) for x in (1e-4, 1e-3))
    assert large.deviations == pytest.approx(10 * small.deviations, rel=1e-9)
    wanted = 1.959964 * np.outer(small.deviations, [-1.0, 1.0])
    np.testing.assert_allclose(ends(small), wanted, rtol=0.02)


def test_a_product_of_commands_makes_intervals_normal() -> None:
    """Two carts with a cross weight of their forces: the unknowns are factors, not logarithms."""
    plant = carts(2)
    structure, bounds = Structure(plant, "diagonal", "full"), Bounds(plant, u_min=-1, u_max=1)
    unknowns = np.append(np.zeros(structure.count - 1), 0.3)
    push = np.repeat(np.random.default_rng(3).choice([-0.8, 0.0, 0.8], (16, 2)), 10, axis=0)
    law = Controller(plant, structure.weights(unknowns), bounds, 8, terminal_set=False)
    trial = Recording(plant, law.simulate(np.zeros(4), disturbance=push).outputs[:-1], push)
    problem = Problem(plant, bounds, 8, [trial], terminal_set=False, structure=structure)
    found = expected_intervals(problem, unknowns, NOISE)
    assert np.all(np.isfinite(found.deviations))
    ends = np.array([[item.value, item.low, item.high] for item in found.intervals])
    values = structure.reported(unknowns)[0][:, None]
    wanted = values + 1.959964 * np.outer(found.deviations, [0.0, -1.0, 1.0])
    np.testing.assert_allclose(ends, wanted, atol=1e-6)


def known_to(uncertainty: dict[str, float | str]) -> Expectation:
    """Cart with stated uncertainties of force per command and rate of falling."""

    def made(values: Array) -> Plant:
        force, fall = values
        system = control.ss(
            [[0, 1], [fall, -0.3]], [[0, 0], [force, 1]], [[1, 0]], 0,
            inputs=["force1", "push1"], outputs=["position1"],
        )  # fmt: skip
        return Plant(control.c2d(system, 0.1), ["force1"])

    family = PlantFamily(made, ["force", "fall"], [1.0, 0.3], uncertainty)
    problem = replace(cart_problem(), family=None)
    bounds, trials = problem.bounds, problem.recordings
    return expected_intervals(
        Problem(
            problem.plant, bounds, 8, trials,
            terminal_set=False, unknown_start=True, structure=problem.structure, family=family,
        ),
        COST_WEIGHTS,
        NOISE,
    )  # fmt: skip


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
    """Scaling force, commands, limits and cost weights together leaves the outputs unchanged.

    The best known precision is therefore 2 sqrt(1 / (1 / .05^2 + 1 / .05^2)).
    """
    body = known_to(STATED).body
    assert body is not None
    assert body.floor == pytest.approx(np.full(2, 2 * 0.05 / np.sqrt(2)), rel=0.01)
    # The known limit identifies the force.
    other = known_to({"force": "5 %"})
    assert other.body is not None
    assert np.all(other.body.floor < 0.05 * other.deviations)


def test_what_cannot_be_meant_is_refused() -> None:
    problem = cart_problem()
    with pytest.raises(InputError, match="structure"):
        expected_intervals(replace(problem, structure=None), COST_WEIGHTS, NOISE)
    with pytest.raises(InputError, match="deviation"):
        expected_intervals(problem, COST_WEIGHTS, 0.0)
    with pytest.raises(InputError, match="root"):
        expected_intervals(problem, COST_WEIGHTS, NOISE, root=1.0)
