"""The input limit is found if it is active, and reported as unidentified if not."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.coverage import cart, true_controller
from impc.assess import input_limits
from impc.assess.input_limits import input_limit, with_limit
from impc.assess.profiles import QUANTILE
from impc.control.closed_loop import simulate
from impc.inverse.noisy_fit import fit_controller
from tests.assess.cart_fits import cart_fit

SEED = 3


def fitted_cart(trial: impc.Recording, limit: float | None) -> impc.Estimate:
    settings = impc.FitSettings(horizon=10, u_max=limit)
    return fit_controller(impc.fit_problem(cart(), [trial], settings))


def gentle_trial() -> impc.Recording:
    """Pushes too small to reach the limit of 1; noise 20 %."""
    rng, controller = np.random.default_rng(SEED), true_controller()
    push = np.repeat(rng.choice([-0.1, 0.0, 0.1], 150), 10)
    run = simulate(controller, impc.scenario(controller.plant, np.zeros(2), disturbance=push))
    assert np.max(np.abs(run.u)) < 0.8
    clean = (run.x @ controller.plant.C.T)[:1500]
    noise = rng.standard_normal(clean.shape)
    return impc.Recording(controller.plant, clean + 0.2 * np.std(clean) * noise, push)


@pytest.mark.full
@pytest.mark.parametrize("assumed", [None, 1.4])
def test_a_limit_that_is_met_is_found(assumed: float | None) -> None:
    """Seed 3: within 2 % and covered by the interval, from any assumed limit."""
    found = input_limit(cart_fit(SEED, u_max=assumed))
    assert found.value == pytest.approx(1.0, rel=0.02)
    assert found.low < 1.0 < found.high
    assert found.against_none > QUANTILE


@pytest.mark.full
def test_a_limit_that_is_never_met_is_not_determined() -> None:
    found = input_limit(fitted_cart(gentle_trial(), None))
    assert found.value is None
    assert found.high == np.inf
    assert found.against_none <= QUANTILE


def test_the_search_starts_at_the_given_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The unlimited regulator of a seat commands 20 times the limit: a grid below it misses it."""
    monkeypatch.setattr(input_limits, "_typical_peak", lambda *_: 1e3)
    found = input_limit(cart_fit(SEED, u_max=1.2))
    assert found.value == pytest.approx(1.0, rel=0.02)


def test_with_limit_changes_one_input_only() -> None:
    fitted = fitted_cart(gentle_trial(), 1.0)
    assert with_limit(fitted.problem, 2.0).bounds.u_max.tolist() == [2.0]
    assert np.isinf(with_limit(fitted.problem, np.inf).bounds.u_min[0])
    with pytest.raises(impc.InputError, match="control"):
        input_limit(fitted, 1)
