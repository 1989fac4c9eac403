"""Simulated subjects: reference values, noise, and falls."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import scipy.linalg

import impc
import plants
from experiments.benchmarks.workloads import seat
from impc.arrays import Array
from impc.control.closed_loop import simulate
from impc.studies.simulated_people import simulate_subject
from tests.support import present

STEP = plants.seated_balance_step_for()


def held(torque: Array) -> Array:
    """A torque at 100 Hz, held at 1000 Hz."""
    return np.repeat(torque, 10)


def linear_step(parameters: plants.SeatedBalanceParameters | None = None) -> ca.Function:
    """A thousandth of a second of the linear plant, exactly."""
    plant = plants.continuous_seated_balance_plant(parameters)
    n, m = plant.B.shape
    block = np.block([[plant.A, plant.B], [np.zeros((m, n + m))]])
    moved = scipy.linalg.expm(block * 1e-3)
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
    return ca.Function("step", [x, u], [ca.DM(moved[:n, :n]) @ x + ca.DM(moved[:n, n:]) @ u])


def test_on_the_linear_plant_it_is_the_closed_loop() -> None:
    work = seat(1, 5.0, 6.0)
    torque = work.drives[0].disturbance[:, 0]
    trial = simulate_subject(work.controller, linear_step(), held(torque))
    run = simulate(work.controller, work.drives[0])
    np.testing.assert_allclose(trial.states[::10], run.x[:-1], atol=1e-8)
    np.testing.assert_allclose(trial.commands[::10], run.u, atol=1e-6)


def test_who_hardly_errs_moves_as_who_sees_all() -> None:
    """With almost no noise, the state estimates equal the states of the linear plant."""
    work = seat(1, 5.0, 6.0)
    torque = held(work.drives[0].disturbance[:, 0])
    sensed = ["theta1", "theta2", "theta1_rate", "theta2_rate"]
    person = impc.Observer(work.controller.plant, sensed, motor=1e-9, sensory=1e-9)
    plain = simulate_subject(work.controller, linear_step(), torque)
    found = simulate_subject(work.controller, linear_step(), torque, person=person)
    # Noise of 1e-9, times gains of some hundreds: 1.5e-7 here.
    np.testing.assert_allclose(found.states, plain.states, atol=1e-6)


def test_ranges_and_saturation_of_the_reference() -> None:
    """30 s at 6 N m on the nonlinear plant: 12.3 %, 6.90 and 5.19 degrees; at 4.5 N m 33.9 %."""
    torque = plants.ternary_torque(duration=30.0, rate=1000.0)
    trial = simulate_subject(seat(1, 1.0, 6.0).controller, STEP, torque)
    assert trial.saturated == pytest.approx(0.123, abs=0.005)
    peaks = np.degrees(np.max(np.abs(trial.states[:, :2]), axis=0))
    np.testing.assert_allclose(peaks, [6.90, 5.19], atol=0.05)
    tight = simulate_subject(seat(1, 1.0, 4.5).controller, STEP, torque)
    assert tight.fell is None
    assert tight.saturated == pytest.approx(0.339, abs=0.01)


def test_nonlinear_and_linear_part_as_the_cube_of_the_torque() -> None:
    """Half the torque, an eighth of the difference (sines are odd), to a fifth."""
    controller = seat(1, 1.0, 70.0).controller
    linear = linear_step(plants.seated_parameters_for())
    differences = []
    for amplitude in (2.0, 4.0):
        torque = plants.ternary_torque(amplitude=amplitude, duration=5.0, rate=1000.0)
        one, other = (simulate_subject(controller, step, torque).states for step in (STEP, linear))
        differences.append(float(np.max(np.abs((one - other)[:, :2]))))
    assert differences[1] / differences[0] == pytest.approx(8.0, rel=0.2)


def test_noise_is_as_asked_and_follows_the_seed() -> None:
    """Seed 9: recording noise only on the outputs, motor noise in the motion."""
    controller = seat(1, 1.0, 6.0).controller
    torque = plants.ternary_torque(duration=10.0, rate=1000.0)
    sensor = np.array([0.002, 0.003])
    trial = simulate_subject(controller, STEP, torque, sensor=sensor, seed=9)
    noise = trial.outputs - trial.states[:, :2]
    np.testing.assert_allclose(np.std(noise, axis=0), sensor, rtol=0.05)
    still = simulate_subject(controller, STEP, torque)
    np.testing.assert_array_equal(trial.states, still.states)
    moved = simulate_subject(controller, STEP, torque, motor=0.5, seed=9)
    assert 0 < np.max(np.abs(moved.states - still.states)[:, :2]) < 0.05
    again = simulate_subject(controller, STEP, torque, motor=0.5, seed=9)
    np.testing.assert_array_equal(again.states, moved.states)
    other = simulate_subject(controller, STEP, torque, motor=0.5, seed=10)
    assert not np.array_equal(other.states, moved.states)


def test_a_fall_is_told() -> None:
    controller = seat(1, 1.0, 0.5).controller
    torque = plants.ternary_torque(amplitude=20.0, duration=5.0, rate=1000.0)
    trial = simulate_subject(controller, STEP, torque, largest=np.pi / 2)
    assert 0 < present(trial.fell) < 5
    assert np.all(np.isfinite(trial.outputs))


def test_a_person_by_mass_and_height() -> None:
    usual, known = plants.seated_parameters_for(), plants.seated_parameters_for(60, 1.7, "female")
    assert known.m2 < usual.m2
    assert plants.seated_parameters_for(k_h=33.0).k_h == 33.0
    with pytest.raises(ValueError, match="weight: is not a parameter"):
        plants.seated_parameters_for(weight=3.0)
    assert plants.seated_balance_for(60, 1.7, "female", delay_order=3).nstates == 8
