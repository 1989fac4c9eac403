"""Continuous and held gains, against integration of the continuous loop."""

from __future__ import annotations

import control
import numpy as np
import pytest
import scipy.integrate

import impc
import plants
from experiments.benchmarks.workloads import seat
from impc.model.continuous_gain import continuous_gain, held_gain


def missed(
    system: control.StateSpace, plant: impc.Plant, gain: np.ndarray, start: list[float]
) -> list[float]:
    """Relative error of the motion with the held gain, and with the continuous gain held."""
    m, n = gain.shape

    def loop(_: float, z: np.ndarray) -> np.ndarray:  # state, and integral of the command
        command = -gain @ z[:n]
        return np.concatenate([system.A @ z[:n] + system.B[:, :m] @ command, command])

    time = np.arange(0, 4, plant.dt)
    exact = scipy.integrate.solve_ivp(
        loop, (0, 4), [*start, *np.zeros(m)], "DOP853", time, rtol=1e-12, atol=1e-13
    ).y.T
    law = impc.Controller.from_continuous_gain(plant, gain, impc.Bounds(plant), 5)
    np.testing.assert_allclose(law.K @ start, -exact[1, n:] / plant.dt, rtol=1e-9)
    back, _ = continuous_gain(plant, np.array(law.K))
    np.testing.assert_allclose(back, gain, rtol=0, atol=1e-9 * np.max(np.abs(gain)))
    laws = law, impc.Controller.from_gain(plant, gain, law.bounds, 5)
    left = [each.simulate(start, len(time) - 1).x - exact[:, :n] for each in laws]
    return [float(np.linalg.norm(x[:, :2]) / np.linalg.norm(exact[:, :2])) for x in left]


def test_the_held_command_is_the_average_of_the_continuous_one() -> None:
    rng = np.random.default_rng(4)
    system = control.ss(rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), np.eye(4), 0, 0)
    gain = impc.solve_lqr(impc.Plant(system), impc.Weights(10 * np.eye(4), np.eye(2))).K
    coarse, fine = (
        missed(system, impc.Plant(control.c2d(system, dt)), np.array(gain), [1, -1, 1, 1])
        for dt in (0.02, 0.01)
    )
    assert fine[0] < 0.05 * fine[1]
    np.testing.assert_allclose(np.divide(coarse, fine), [4, 2], rtol=0.1)  # dt squared, and dt


def test_the_held_gain_of_the_seat_at_50_hz_is_18_percent_less() -> None:
    fast, system = seat(1, 1.0).controller, plants.continuous_seated_balance_plant()
    gain, _ = continuous_gain(fast.plant, np.array(fast.K))
    slow = impc.Plant(plants.seated_balance_plant(sample_time=0.02), ["command"])
    off = 1 - held_gain(slow, gain)[0, :4] / gain[0, :4]
    np.testing.assert_allclose(off, [0.192, 0.179, 0.192, 0.184], atol=0.001)
    left = missed(system, slow, gain, [0.02, 0.02, *np.zeros(8)])
    np.testing.assert_allclose(left, [0.0067, 0.073], rtol=0.02)


def test_an_estimate_has_its_continuous_gain_with_intervals() -> None:
    """One state: K = G (1 - exp(F dt)) / (-F dt), and the interval is that of K mapped by it."""
    system = control.ss([[0.5]], [[2]], [[1]], 0, 0)
    plant = impc.Plant(control.c2d(system, 0.1))
    law = impc.Controller.from_continuous_gain(plant, [[1.5]], impc.Bounds(plant), 5)
    F = 0.5 - 2 * 1.5
    assert law.K[0, 0] == pytest.approx(1.5 * np.expm1(F * 0.1) / (F * 0.1), rel=1e-12)
    noise = 0.01 * np.random.default_rng(0).normal(size=(31, 1))
    trials = [impc.Recording(plant, law.simulate([1.0], 30).x + part) for part in (0, noise)]
    exact, found = (impc.fit(impc.Problem(plant, law.bounds, 5, [trial])) for trial in trials)
    assert exact.continuous_gain().value.iloc[0] == pytest.approx(1.5, rel=1e-6)
    held, there = found.intervals().iloc[0], found.continuous_gain().iloc[0]
    assert there.name == held.name
    near = [continuous_gain(plant, np.array([[held.value + by]]))[0][0, 0] for by in (1e-5, -1e-5)]
    width = (held.high - held.low) * (near[0] - near[1]) / 2e-5
    assert there.high - there.low == pytest.approx(width, rel=1e-6)
    assert there.low < 1.5 < there.high


@pytest.mark.parametrize(
    ("A", "said"),
    [
        ([[0, 1], [0, 0]], "singular A, for example because of a delay in samples; model"),
        ([[0.5, 0], [0, -0.5]], "changes sign at every sample, which no continuous plant has"),
    ],
)
def test_a_plant_that_is_sampled_from_none_is_refused(A: list[list[float]], said: str) -> None:
    plant = impc.Plant(control.ss(A, [[1], [1]], np.eye(2), 0, 0.1))
    with pytest.raises(impc.PlantError, match=said):
        impc.Controller.from_continuous_gain(plant, [[0, 0]], impc.Bounds(plant), 5)
    rates = impc.with_rates(plant)
    with pytest.raises(impc.PlantError, match="pass the plant before with_rates"):
        impc.Controller.from_continuous_gain(rates, [[0, 0, 0]], impc.Bounds(rates), 5)


def test_a_held_gain_of_no_continuous_one_is_refused() -> None:
    plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 0.1))
    with pytest.raises(impc.InputError, match="has no continuous-time gain near it; sample"):
        continuous_gain(plant, np.array([[1.2]]))  # a loop that changes sign at every sample
