"""The limit curve against separate fits."""

from __future__ import annotations

import numpy as np

from experiments.coverage import cart, noisy_trial
from impc.assess.limit_curve import limit_curve
from impc.inverse.noisy_fit import fit_controller
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_problem


def test_the_true_limit_is_the_best() -> None:
    trial = noisy_trial(4, 0.0)
    fitted = fit_controller(fit_problem(cart(), [trial], FitSettings(horizon=10, u_max=1.0)))
    curve = limit_curve(fitted, 0)
    assert curve is not None
    assert curve.given == 1.0
    assert curve.limits[np.nanargmin(curve.unexplained[:, 0])] == 1.0
    wide = fit_controller(fit_problem(cart(), [trial], FitSettings(horizon=10, u_max=1.5)))
    here = curve.unexplained[curve.limits == 1.5, 0]
    there = 100 - np.array(wide.vaf)
    np.testing.assert_allclose(here, there, rtol=0.15)


def test_no_limit_has_no_curve() -> None:
    trial = noisy_trial(4, 0.0)
    fitted = fit_controller(fit_problem(cart(), [trial], FitSettings(horizon=10)))
    assert limit_curve(fitted, 0) is None
