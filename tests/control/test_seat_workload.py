"""The seated subject (W2 of experiments/benchmarks): all solvers agree, and the complete fit."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.benchmarks.workloads import Workload, seat
from impc.assess.weights_test import identifiability
from impc.control.closed_loop import simulate, simulate_and_differentiate
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.simulation import Status
from impc.inverse.table31 import inverse_mpc_reduced


@pytest.fixture(scope="module")
def work() -> Workload:
    return seat()


def test_about_an_eighth_of_the_samples_saturate(work: Workload) -> None:
    """The reference has 12.3 % on the nonlinear plant; this is the linear one."""
    run = simulate(work.controller, work.drives[0])
    share = np.mean(np.abs(np.abs(run.u) - 6) < 1e-9)
    assert 0.10 < share < 0.14
    assert set(run.status) == {Status.FREE, Status.ACTIVE}
    np.testing.assert_allclose(np.degrees(np.abs(run.x[:, :2]).max(axis=0)), [6.9, 5.2], atol=0.1)


def test_jacobian_equals_central_differences(work: Workload) -> None:
    controller, drive = work.controller, work.drives[0]
    n = controller.plant.n
    _, exact = simulate_and_differentiate(
        controller, drive, directions(controller, n, K=np.eye(n)[None])
    )
    for index in range(n):
        errors = []
        for relative in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7):
            # Of 3000 samples some are near a change of the active set: a shorter difference
            # reaches across fewer of them, and has more rounding.
            step = relative * max(float(np.abs(controller.K[0, index])), 1e-2)
            up, down = (_with_gain_entry(work, index, sign * step) for sign in (1, -1))
            difference = (up - down) / (2 * step)
            found = exact.x[..., index]
            errors.append(np.linalg.norm(found - difference) / np.linalg.norm(difference))
        assert min(errors) < 1e-6, errors


def _with_gain_entry(work: Workload, index: int, change: float) -> np.ndarray:
    K = np.array(work.controller.K)
    K[0, index] += change
    bounds, plant = work.controller.bounds, work.controller.plant
    moved = Controller.from_gain(plant, K, bounds, 20, terminal_set=False)
    return np.array(simulate(moved, work.drives[0]).x)


@pytest.mark.full
@pytest.mark.parametrize("limit", [70.0, 6.0, pytest.param(4.5, marks=pytest.mark.full)])
def test_the_whole_fit_reaches_the_true_gain(limit: float) -> None:
    work = seat(limit=limit)
    found = inverse_mpc_reduced(work.problem)
    assert found.explained
    error = np.linalg.norm(found.gain - work.controller.K) / np.linalg.norm(work.controller.K)
    assert error < 1e-8
    size = np.linalg.norm(work.problem.recordings[0].outputs)
    assert found.misfit < 1e-9 * size


def test_the_recording_determines_ten_of_fifty_five_directions(work: Workload) -> None:
    counts = identifiability(work.problem, work.weights)
    assert counts.free == 55
    assert counts.rank == 10
    for item in counts.others:
        assert item.misfit < 1e-6
