"""Plant with stated uncertainty: prior in the fit and in the intervals."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

import impc
from experiments.uncertain_body import HORIZON, cart
from impc.arrays import Array
from impc.assess.printed_gain import GainEstimate, gain_estimate
from impc.files.plant_sources import PlantSource, plant_family_of, plant_source
from impc.inverse.laws import GainLaw
from impc.inverse.residuals import residual_only
from impc.inverse.unknowns import Unknowns
from impc.model.plant_family import plant_differential
from tests.assess.cart_fits import joint_covariance, uncertain_cart, uncertain_fit
from tests.support import posed, present, regulator

KNOWN: dict[str, float | str] = {"fall": "3 %", "damp": "3 %", "extra_delay": 0.02, "u_max": "5 %"}
SEAT = "plants:seated_balance_for"


def family(**uncertainty: Any) -> impc.PlantFamily:
    stated = uncertainty or KNOWN
    return impc.PlantFamily(lambda values: cart(values.tolist()), ["fall", "damp"], [1, 1], stated)


def seat_family(**stated: Any) -> impc.PlantFamily | None:
    source = plant_source(SEAT, {"uncertainty": stated} if stated else {})
    return plant_family_of(source, ["perturbation"], [])


def pushes(rng: np.random.Generator, size: float, count: int = 25, held: int = 16) -> Array:
    return np.asarray(size * np.repeat(rng.choice([-1.0, 0, 1], count), held))


@pytest.fixture(scope="module")
def fitted() -> GainEstimate:
    return gain_estimate(uncertain_fit())


def test_values_of_delay_and_limit_are_in_their_units() -> None:
    made = family()
    plant = made.make(made.nominal)
    law = regulator(plant, np.eye(3), 0.42, HORIZON)
    problem = posed(law, impc.Recording(plant, np.ones((9, 1))), family=made)
    assert problem.parameter_names == ("fall", "damp", "extra_delay", "u_max.u")
    values = present(problem.family).values(np.log([1.0, 1.0, 1.5, 1.1]))
    np.testing.assert_allclose(values, [1.0, 1.0, 0.5 * 0.05, 1.1 * 0.42])
    moved = problem.at(problem.starts, np.log([1.0, 1.0, 1.0, 1.1]))
    np.testing.assert_allclose(moved.bounds.u_max, [1.1 * 0.42])


def test_the_covariance_is_that_of_the_joint_curvature(fitted: GainEstimate) -> None:
    linear, cov = joint_covariance(fitted, {2: 0.03, 3: 0.03})
    expected = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(linear.entries.ravel(), expected[:2], rtol=1e-6)
    np.testing.assert_allclose(linear.parameters, expected[2:4], rtol=1e-6)
    shares = cov[:2, 2:4] ** 2 / np.outer(np.diag(cov)[:2], np.diag(cov)[2:4])
    np.testing.assert_allclose(linear.shares.reshape(2, 2), shares, rtol=1e-6)


def test_the_fit_is_the_mode_of_the_posterior(fitted: GainEstimate) -> None:
    """N log |r|^2 + |q / d|^2 is no smaller nearby (20 directions of gain and body)."""
    problem, K = fitted.problem, np.array(fitted.K)
    logs, count = np.array(problem.logarithms), problem.recorded_numbers

    def objective(gain: Array, q: Array) -> float:
        r = residual_only(problem.at(problem.starts, q), gain, np.eye(1))
        return count * float(np.log(r @ r)) + float(np.sum((q / 0.03) ** 2))

    best, rng = objective(K, logs), np.random.default_rng(0)
    deviations = np.array(fitted.covariance.entries)
    for _ in range(20):
        step = rng.standard_normal((2, 2))
        there = objective(K + 0.3 * deviations * step[:1], logs + 0.3 * 0.03 * step[1])
        assert there > best - 0.05


def test_intervals_hold_where_they_do_not_for_an_exact_body() -> None:
    """Both coefficients 3 % off, four carts: 8 of 8 entries covered, 2 of 8 if taken as exact."""
    held = {"stated": 0, "exact": 0}
    for seed in (0, 4, 5, 6):
        problem, truth, _ = uncertain_cart(seed, "plant")
        for name, one in (("stated", problem), ("exact", problem.with_body_fixed())):
            found = impc.fit(one).intervals().iloc[:2]
            held[name] += int(((found.low <= truth[0]) & (truth[0] <= found.high)).sum())
    assert held["stated"] == 8
    assert held["exact"] <= 4


def test_a_search_stays_where_the_plant_can_be_stabilised() -> None:
    """A free parameter whose plants no input stabilises from twice its nominal value."""

    def made(values: Array) -> impc.Plant:
        reach = max(0.0, 1 - values[0] / 2)
        return impc.Plant(control.ss([[1.1]], [[reach]], [[1]], 0, 1))

    known = impc.PlantFamily(made, ["loss"], [1.0])
    plant = known.make(known.nominal)
    law = regulator(plant, np.eye(1), 1.0, HORIZON)
    trial = impc.Recording(plant, law.simulate([1.0], steps=30).x)
    problem = posed(law, trial, family=known)
    space = Unknowns(problem, GainLaw(problem, np.array(law.K), np.array(law.S)))
    far = space.start.copy()
    far[space.parameters] = np.log(3.0) / space.units
    assert space.residual(far) is None
    table = impc.fit(space.problem).intervals()
    assert not table.loc["K.u[0].x[0]", "determined"]


def test_an_uncertainty_of_zero_is_none() -> None:
    """Identical to the fit without the family."""
    nothing, free, given = family(fall=0, damp="0 %"), family(extra_delay=0), uncertain_cart()[0]
    assert nothing.names == ()
    assert free.names == ("fall", "damp")
    assert free.make(free.nominal).n == 2
    asked = given.plant, given.bounds, HORIZON, given.recordings
    one, other = (
        impc.fit(impc.Problem(*asked, unknown_start=True, family=made)) for made in (None, nothing)
    )
    np.testing.assert_array_equal(one.gain, other.gain)


def test_what_a_file_states_replaces_the_plants_own() -> None:
    def deviations(**stated: Any) -> dict[str, float]:
        made = seat_family(**stated)
        return {} if made is None else dict(zip(made.names, made.deviations, strict=True))

    usual = deviations()
    assert len(usual) == 13
    assert usual["J2"] == pytest.approx(0.12)
    assert usual["tau_d"] == pytest.approx(0.01 / 0.08)
    assert deviations(all=0) == {}
    assert deviations(all=0, J2="7 %") == {"J2": pytest.approx(0.07)}
    assert deviations(tau_d=0.02)["tau_d"] == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"wing": "3 %"}, "wing"),
        ({"J2": "much"}, "J2"),
        ({"J2": -1}, "J2"),
        ({"J2": True}, "J2"),
        ({"u_max": 3.0}, "a percentage of the limit"),
        ("no table", "is not a table"),
    ],
)
def test_what_cannot_be_stated(stated: Any, said: str) -> None:
    with pytest.raises(impc.InputError, match=said):
        plant_family_of(plant_source(SEAT, {"uncertainty": stated}), ["perturbation"], [])


def offering(offered: Any) -> PlantSource:
    """Pushed mass on a spring, which offers its derivatives by the mass."""

    def make(mass: float = 2.0) -> Any:
        system = control.ss([[1.0, 0.1], [-0.1 / mass, 1.0]], [[0.0], [0.1 / mass]], np.eye(2), 0,
                            0.1)  # fmt: skip
        system.slopes = lambda: offered(mass)
        return system

    return PlantSource("offering", make, {"uncertainty": {"mass": "5 %"}})


def test_derivatives_that_a_plant_offers_are_compared_with_its_matrices() -> None:
    def right(mass: float) -> Any:
        pull = 0.1 / mass**2
        return {"mass": ([[0.0, 0.0], [pull, 0.0]], [[0.0], [-pull]])}

    made = present(plant_family_of(offering(right), [], []))
    found = plant_differential(made, np.array([0.1]))
    np.testing.assert_allclose(found.B[1, 0, 0], -0.1 / (2 * np.exp(0.1)))
    wrong: list[tuple[Any, str]] = [
        (lambda mass: {"mass": (right(mass)["mass"][0], [[0.0], [0.2]])}, "is not the derivative"),
        (lambda _: {"mass": (np.zeros((3, 3)), np.zeros((2, 1)))}, "expected shape"),
        (lambda _: {"mass": (np.full((2, 2), np.nan), np.zeros((2, 1)))}, "mass"),
        (lambda _: {"mass": 1.0}, "TypeError"),
        (lambda _: 1 / 0, "ZeroDivisionError"),
        (lambda _: [], "AttributeError"),
    ]
    for offered, said in wrong:
        with pytest.raises(impc.ImpcError, match=said) as caught:
            plant_family_of(offering(offered), [], [])
        assert "slopes" in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_delay_needs_a_plant_that_can_have_one() -> None:
    with pytest.raises(impc.InputError, match="more than 2 samples"):
        family(extra_delay=1.0)
    bounds, trial = impc.Bounds(cart(), u_min=-1, u_max=1), impc.Recording(cart(), np.ones((9, 1)))
    with pytest.raises(impc.InputError, match=r"family.make\(family.nominal\)"):
        impc.Problem(cart(), bounds, 5, [trial], family=family(extra_delay=0.02))
    late = present(seat_family(extra_delay=0.01))
    with pytest.raises(impc.PlantError, match="model the delay in the body"):
        late.make(late.nominal)
