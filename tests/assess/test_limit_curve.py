"""The limit curve against separate fits."""

from __future__ import annotations

import numpy as np

from impc.assess.input_limits import limit_curve
from tests.assess.cart_fits import cart_fit


def test_the_true_limit_is_the_best() -> None:
    curve = limit_curve(cart_fit(4), 0)
    assert curve is not None
    assert curve.given == 1.0
    assert curve.limits[np.nanargmin(curve.unexplained[:, 0])] == 1.0
    here = curve.unexplained[curve.limits == 1.5, 0]
    there = 100 - np.array(cart_fit(4, u_max=1.5).vaf)
    np.testing.assert_allclose(here, there, rtol=0.15)


def test_no_limit_has_no_curve() -> None:
    assert limit_curve(cart_fit(4, u_max=None), 0) is None
