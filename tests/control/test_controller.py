"""The controller as a value: what `simulate` says of a start that no input can bring back."""

from __future__ import annotations

import control
import numpy as np
import pytest

from impc.control.controller import Controller
from impc.control.simulation import Status
from impc.errors import DataError
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights


def test_a_start_beyond_feasibility_is_nan_and_no_recording() -> None:
    """It was a frozen state with u = 0, from which weights were inferred without a word."""
    plant = Plant(control.ss([[2.0]], [[1]], [[1]], 0, 1))
    law = Controller(plant, Weights(1, 1), Bounds(plant, u_min=-1, u_max=1), 3)
    with pytest.warns(UserWarning, match="sample 0: .*; what follows is NaN"):
        run = law.simulate([2.0], steps=5)
    assert run.status[0] == Status.INFEASIBLE
    assert run.x[0] == 2.0
    assert np.all(np.isnan(run.x[1:]))
    assert np.all(np.isnan(run.u))
    with pytest.raises(DataError, match="NaN"):
        Recording(plant, run.x)
