"""Whittle's likelihood: spectra in closed form, and slopes by differences."""

from __future__ import annotations

import control
import numpy as np
import pytest

from impc.arrays import Array
from impc.assess.loop_noise import (
    ORDER,
    Spectrum,
    loop_shapes,
    loops,
    misfit,
    outputs,
    root_of,
    size,
    spectrum,
)
from impc.model.plant import Plant
from tests.support import extrapolated_slope


def identified(seed: int = 0) -> Spectrum:
    rng = np.random.default_rng(seed)
    found = spectrum([rng.standard_normal((400, 2)) * [1.0, 30.0] for _ in range(3)])
    assert found is not None
    return found


def cart() -> tuple[Plant, Array]:
    system = control.ss(
        [[1, 0.05], [0, 0.9]], [[0.001], [0.05]], np.eye(2), 0, 0.05, outputs=["x", "v"]
    )
    return Plant(system), np.array([[3.0, 1.0]])


def drawn(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.concatenate([0.5 * rng.standard_normal(size(2)), rng.standard_normal(2)])


def both(theta: Array, found: Spectrum) -> tuple[float, Array]:
    shapes = loop_shapes(*cart(), found)
    own, along_own = outputs(theta[: size(2)], found)
    more, along_more = loops(theta[size(2) :], shapes, found)
    value, W = misfit(own + more, found)
    return value, np.concatenate([along_own(W), along_more(W)])


@pytest.mark.parametrize("seed", range(4))
def test_slopes_are_those_of_differences(seed: int) -> None:
    found, theta = identified(seed), drawn(seed)
    way = np.random.default_rng(seed + 50).standard_normal(len(theta))

    def along(t: float) -> Array:
        return np.array([both(theta + t * way, found)[0]])

    exact = both(theta, found)[1] @ way
    assert exact == pytest.approx(extrapolated_slope(along, 1e-3)[0], rel=1e-7)


def test_an_unknown_beyond_its_end_does_not_move() -> None:
    found, theta = identified(), drawn(1)
    ends = {0: 9.0, 2 * ORDER: 12.0, size(2) - 1: -40.0, size(2): 20.0, size(2) + 1: 5.0}
    for index, value in ends.items():
        there = theta.copy()
        there[index] = value
        further = there.copy()
        further[index] = 2 * value
        assert both(there, found)[1][index] == 0
        assert both(further, found)[0] == both(there, found)[0]


def test_an_output_of_one_reflection_is_an_autoregression_of_order_one() -> None:
    found, k = identified(), 0.6
    theta = np.zeros(size(2))
    theta[0], theta[size(2) - 2 :] = np.arctanh(k), -60.0  # white variances at their least
    S, _ = outputs(theta, found)
    expected = 1 / np.abs(1 + k * np.exp(-1j * found.angles)) ** 2
    np.testing.assert_allclose(S[:, 0, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(S[:, 1, 1], 1.0, rtol=1e-9)


def test_a_loop_answers_as_its_transfer_function() -> None:
    plant, K = cart()
    found = identified()
    theta = np.array([np.log(2.0), 0.3])
    S, _ = loops(theta, loop_shapes(plant, K, found), found)
    r = root_of(theta)
    assert r == pytest.approx(np.tanh(0.3))
    A = np.array(plant.A) - np.array(plant.B) @ K
    closed = control.ss(A, plant.B, plant.C, 0, plant.dt)
    narrow = np.diff(found.edges) < 0.02  # of wide bins shapes are averages
    for angle, one in zip(found.angles[narrow], S[narrow], strict=True):
        G = closed(np.exp(1j * angle)) / found.size[:, None]
        colour = (1 - r**2) / abs(1 - r * np.exp(-1j * angle)) ** 2
        np.testing.assert_allclose(one, 2.0 * colour * G @ G.conj().T, rtol=0.02, atol=1e-4)


def test_of_all_spectra_the_recorded_one_is_likeliest() -> None:
    found = identified()
    value, W = misfit(found.power - 1e-3 * np.eye(2), found)
    logs = np.linalg.slogdet(found.power)[1]
    assert value == pytest.approx(float(found.counts @ (logs + 2)), rel=1e-5)
    assert np.max(np.abs(W)) < 1e-5 * np.max(found.counts) / np.min(np.abs(found.power))
    assert misfit(1.3 * found.power, found)[0] > value


def test_too_little_has_no_spectrum() -> None:
    assert spectrum([np.zeros((500, 2))]) is None
    assert spectrum([np.random.default_rng(0).standard_normal((20, 2))]) is None
