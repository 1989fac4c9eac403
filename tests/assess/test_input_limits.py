"""The input limit is found where it shows, and said not to show where it does not."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.benchmarks.workloads import seat
from experiments.coverage import cart, noisy_trial, true_controller
from experiments.simulated_subjects import noisy_recordings
from impc.assess.input_limits import LimitEstimate, input_limit, with_limit
from impc.control.closed_loop import simulate
from impc.control.simulation import scenario
from impc.errors import InputError
from impc.inverse.estimates import Estimate
from impc.inverse.noisy_fit import fit_controller
from impc.model.recordings import Recording
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_problem

SEED = 3


def fitted_cart(trial: Recording, limit: float | None) -> Estimate:
    return fit_controller(fit_problem(cart(), [trial], FitSettings(horizon=10, u_max=limit)))


def gentle_trial() -> Recording:
    """Pushed so little that the limit of 1 is never met; noise of a fifth."""
    rng, controller = np.random.default_rng(SEED), true_controller()
    push = np.repeat(rng.choice([-0.1, 0.0, 0.1], 150), 10)
    run = simulate(controller, scenario(controller.plant, np.zeros(2), disturbance=push))
    assert np.max(np.abs(run.u)) < 0.8
    clean = (run.x @ controller.plant.C.T)[:1500]
    noise = rng.standard_normal(clean.shape)
    return Recording(controller.plant, clean + 0.2 * np.std(clean) * noise, push)


@pytest.mark.full
@pytest.mark.parametrize("assumed", [None, 1.4])
def test_a_limit_that_is_met_is_found(assumed: float | None) -> None:
    """Seed 3: within 2 %, the truth inside the interval, whatever was assumed before."""
    found = input_limit(fitted_cart(noisy_trial(SEED, 0.0), assumed))
    assert found.value == pytest.approx(1.0, rel=0.02)
    assert found.low < 1.0 < found.high
    assert found.against_none > found.quantile
    assert np.min(found.distances) >= -1e-6


@pytest.mark.full
def test_a_limit_that_is_never_met_is_not_determined() -> None:
    found = input_limit(fitted_cart(gentle_trial(), None))
    assert found.value is None
    assert found.high == np.inf
    assert found.against_none <= found.quantile
    assert "no limit explains the recordings as well as any" in found.reason


@pytest.mark.slow
def test_limits_of_noisy_subjects() -> None:
    """The seat at 6 Nm, an eighth of its samples saturated, seeds 0 to 4; at 70 Nm: not identified.

    With noise that leaves a VAF of 90 % the limit itself has a deviation of 1 %: of five subjects
    the median must be within 2 % and no interval may miss by more than its own half.
    """
    plant = seat(1, 1.0).problem.plant

    def found(limit: float, seed: int) -> LimitEstimate:
        trials = noisy_recordings(limit, seed, 0.9)
        return input_limit(fit_controller(fit_problem(plant, trials, FitSettings())))

    errors = []
    for seed in range(5):
        at_six, at_seventy = found(6.0, seed), found(70.0, seed)
        assert at_six.value is not None
        assert at_seventy.value is None
        half = (at_six.high - at_six.low) / 2
        errors.append(abs(at_six.value - 6.0) / 6.0)
        assert at_six.low - half < 6.0 < at_six.high + half
    assert np.median(errors) < 0.02, errors


def test_with_limit_changes_one_input_only() -> None:
    fitted = fitted_cart(gentle_trial(), 1.0)
    assert with_limit(fitted.problem, 2.0).bounds.u_max.tolist() == [2.0]
    assert np.isinf(with_limit(fitted.problem, np.inf).bounds.u_min[0])
    with pytest.raises(InputError, match="control"):
        input_limit(fitted, 1)
