"""Scenarios, simulations and the reports of incomplete ones."""

from __future__ import annotations

import control
import numpy as np
import pytest

from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.feasibility import require_complete
from impc.control.simulation import Simulation, Status, scenario
from impc.errors import DataError, SolverError
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights


def test_a_diverging_loop_is_named(example_plant: Plant) -> None:
    bounds = Bounds(example_plant, u_min=-0.1, u_max=0.1)
    controller = Controller(example_plant, Weights(np.eye(2), 1), bounds, 3, terminal_set=False)
    run = simulate(controller, scenario(example_plant, [5, 5], 400))
    assert not run.complete
    assert np.all(np.isfinite(run.x))
    with pytest.raises(SolverError, match="cannot be determined"):
        require_complete(controller, run)


def ended(plant: Plant, statuses: list[Status]) -> Simulation:
    steps = len(statuses)
    codes = np.array(statuses, dtype=np.int8)
    return Simulation(plant, np.zeros((steps + 1, 2)), np.zeros((steps, 1)), codes, 0, -1)


@pytest.mark.parametrize("status", list(Status))
def test_every_status_is_said_in_words(status: Status, example_plant: Plant) -> None:
    """Statuses with an input are not failures; a failure's description is in the error."""
    assert len(status.sentence) > 10
    controller = Controller(
        example_plant, Weights(np.eye(2), 1), Bounds(example_plant, u_max=1, u_min=-1), 3
    )
    run = ended(example_plant, [Status.FREE, status, Status.NOT_REACHED])
    assert not run.complete
    run = ended(example_plant, [Status.FREE, status])
    assert (run.complete, run.reached) == ((True, 2) if status <= Status.SOFTENED else (False, 1))
    if status <= Status.SOFTENED:
        assert require_complete(controller, run) is run
    elif status is not Status.INFEASIBLE:
        with pytest.raises(SolverError, match=f"sample 1.*{status.sentence}"):
            require_complete(controller, run)


def test_a_start_beyond_feasibility_is_nan_and_no_recording() -> None:
    """Regression: the state was frozen with u = 0, and weights were inferred without a warning."""
    plant = Plant(control.ss([[2.0]], [[1]], [[1]], 0, 1))
    law = Controller(plant, Weights(1, 1), Bounds(plant, u_min=-1, u_max=1), 3)
    with pytest.warns(UserWarning, match="sample 0: .*; later samples are NaN"):
        run = law.simulate([2.0], steps=5)
    assert run.status[0] == Status.INFEASIBLE
    assert run.x[0] == 2.0
    assert np.all(np.isnan(run.x[1:]))
    assert np.all(np.isnan(run.u))
    with pytest.raises(DataError, match="NaN"):
        Recording(plant, run.x)
