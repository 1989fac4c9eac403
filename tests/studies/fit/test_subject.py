"""Fit of a subject: result, stored steps, and intent."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np
import pytest

from experiments.benchmarks.workloads import seat
from experiments.coverage import cart, noisy_trial, true_controller
from experiments.simulated_subjects import noisy_recordings
from experiments.uncertain_body import cart_person
from impc.assess.intent import dominant_sentence, intent
from impc.assess.variance_accounted_for import predicted, vaf
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.control.simulation import scenario
from impc.errors import DataError, InputError
from impc.inverse.delayed_feedback import preliminary_gain
from impc.inverse.estimates import Estimate
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem
from impc.model.plant import Plant, change_coordinates
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from impc.reporting.document import Quiet
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.first import FitProgress
from impc.studies.fit.memory import FitMemory, open_memory
from impc.studies.fit.movement import movement_section
from impc.studies.fit.result import FitResult
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_recordings, stages
from tests.support import kept_names

FEEDBACK = ["theta1", "theta2", "theta1_rate", "theta2_rate"]
SEED, WHOLE = 4, "With limit, inverse MPC"


@pytest.fixture(scope="module")
def noisy() -> FitResult:
    trials = noisy_recordings(6.0, SEED, 0.9, seconds=15.0)
    settings = FitSettings(u_max=6.0, feedback_states=FEEDBACK, intent_draws=False)
    return fit_recordings(fit_problem(seat().problem.plant, trials, settings), settings)


def test_variance_accounted_for_is_that_of_the_trajectories(noisy: FitResult) -> None:
    plant = noisy.fitted.problem.plant
    runs = noisy.inverse_mpc.runs
    for index, trial in enumerate(noisy.given.recordings):
        expected = vaf(trial.outputs, runs[index].x @ plant.C.T)
        np.testing.assert_allclose(noisy.trials[index].vaf, expected)
        np.testing.assert_allclose(noisy.inverse_mpc.trial_vaf[index], expected)
    together = np.concatenate([run.x @ plant.C.T for run in runs])
    recorded = np.concatenate([trial.outputs for trial in noisy.given.recordings])
    np.testing.assert_allclose(noisy.inverse_mpc.vaf, vaf(recorded, together))


def test_trials_left_out_are_predicted_to_the_ceiling(noisy: FitResult) -> None:
    assert noisy.inverse_mpc.held_out.shape == (3, 2)
    assert np.all(np.abs(noisy.inverse_mpc.held_out - 90) < 1.0)


def test_a_trial_left_out_is_predicted_as_by_a_fit_of_the_others(
    small: tuple[Problem, FitSettings],
) -> None:
    """A few steps from the fit of all trials end where a search from scratch does."""
    problem, settings = small
    found = fit_recordings(problem, settings)
    for index, trial in enumerate(problem.recordings):
        other = fit_controller(problem.leaving_out(index))
        pair = other.gain, np.array(other.metric)
        wanted = predicted(other.problem, *pair, trial, settings.settle)
        np.testing.assert_allclose(found.inverse_mpc.held_out[index], wanted.vaf, atol=0.1)


def test_the_preliminary_estimate_is_shown_beside_the_others(noisy: FitResult) -> None:
    names = [item.name for item in noisy.methods]
    assert names == [
        "preliminary",
        "feedback_gain",
        "inverse_lqr",
        "inverse_lqr_output",
        "clipped_lqr",
        "inverse_mpc",
    ]
    first = noisy.methods[0]
    assert first.estimate.K is not None
    assert np.all(first.estimate.K[0, 4:] == 0)
    assert np.all(first.vaf < noisy.inverse_mpc.vaf - 5)


def test_every_reading_has_the_gain_and_the_angle_is_theirs(noisy: FitResult) -> None:
    plant, K = noisy.fitted.problem.plant, noisy.fitted.gain
    first = noisy.intent.reported
    for reading in noisy.intent.readings:
        np.testing.assert_allclose(
            solve_lqr(plant, reading.weights).K, K, atol=1e-6 * float(np.max(np.abs(K)))
        )
        values, vectors = np.linalg.eigh(reading.weights.Q)
        np.testing.assert_allclose(values, reading.eigenvalues, rtol=1e-12)
        cosine = abs(float(vectors[:, -1] @ first.dominant))
        expected = np.degrees(np.arccos(min(1.0, cosine)))
        assert reading.angle == pytest.approx(expected, abs=1e-3)
        assert reading.condition >= first.condition * (1 - 1e-6)
    assert noisy.intent.widest_angle > 10


def test_intent_of_known_weights() -> None:
    """Double integrator with Q = I: the minimum condition number is 1 for all v."""
    plant = Plant(control.ss([[1, 1], [0, 1]], [[0.5], [1]], np.eye(2), 0, True))
    weights = Weights(np.diag([4.0, 1.0]), 1)
    found = intent(
        plant, np.array(solve_lqr(plant, weights).K), np.ones((1, 1, 1)), np.ones(2), weights
    )
    np.testing.assert_allclose(found.reported.eigenvalues, [1, 4], rtol=1e-5)
    np.testing.assert_allclose(found.reported.dominant, [1, 0], atol=1e-4)
    sentence = dominant_sentence(found.reported, plant, np.array([1.0, 3.0]))
    assert sentence.startswith("The dominant cost is 4 (+1.00 x[0])^2, 80 % of the trace")


def test_change_of_coordinates_keeps_the_regulator() -> None:
    plant = cart()
    T = np.array([[2.0, 1.0], [0.0, 3.0]])
    moved = change_coordinates(plant, T, np.array([[5.0]]))
    Q = np.diag([3.0, 1.0])
    gain = solve_lqr(plant, Weights(Q, 2)).K
    other = solve_lqr(moved, Weights(T.T @ Q @ T, 2 * 25)).K
    np.testing.assert_allclose(5 * other @ np.linalg.inv(T), gain, atol=1e-10)


def test_preliminary_gain_without_noise_finds_gains_of_its_own_form() -> None:
    plant, rng = cart(), np.random.default_rng(SEED)
    K = np.array([[3.0, 1.5]])
    push = np.repeat(rng.choice([-1.0, 0.0, 1.0], 40), 10)
    x = np.zeros((401, 2))
    for k in range(400):
        x[k + 1] = (plant.A - plant.B @ K) @ x[k] + plant.E[:, 0] * push[k]
    trial = Recording(plant, (x @ plant.C.T)[:400], push)
    problem = fit_problem(plant, [trial], FitSettings())
    np.testing.assert_allclose(preliminary_gain(problem, plant.states)[0], K, rtol=1e-6)
    with pytest.raises(InputError, match="feedback_states"):
        preliminary_gain(problem, ["speed"])


@pytest.fixture
def small() -> tuple[Problem, FitSettings]:
    settings = FitSettings(horizon=10, u_max=1.0)
    return fit_problem(cart(), [noisy_trial(seed, 0.0) for seed in (1, 2, 3)], settings), settings


@pytest.mark.full
def test_a_plant_of_ones_own_with_one_output(small: tuple[Problem, FitSettings]) -> None:
    heard: list[str] = []
    result = fit_recordings(*small, FitProgress(heard.append))
    assert tuple(heard) == stages(small[0], small[1])
    # With noise of 20 %, the largest possible VAF is 1 / 1.04.
    assert np.all(np.abs(result.inverse_mpc.vaf - 100 / 1.04) < 1.5)
    assert result.identifiability.rank == 2
    single = replace(small[0], recordings=small[0].recordings[:1])
    assert not len(fit_recordings(single, small[1]).inverse_mpc.held_out)


def test_a_body_without_drawing_and_one_that_fails_after_the_fit(
    small: tuple[Problem, FitSettings],
) -> None:
    result, plant = fit_recordings(*small), small[0].plant
    assert movement_section(result) == []
    system = control.ss(plant.A, np.hstack([plant.B, plant.E]), plant.C, 0, plant.dt)
    system.drawing = lambda x: [[[0.0, 0.0]]] if not any(x) else []
    given = replace(result.given, plant=Plant(system, ["u[0]"]))
    (section,) = movement_section(replace(result, given=given))
    (block,) = section.blocks
    assert isinstance(block, Quiet)
    assert block.text.startswith("Not available: plant.drawing: fails: ")


def test_an_interrupted_fit_goes_on(
    small: tuple[Problem, FitSettings], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = fit_recordings(*small)
    memory = open_memory(tmp_path / "out", *small)

    def interrupt(stage: str) -> None:
        if stage == "No limit, gain only":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_recordings(*small, FitProgress(interrupt, memory.estimate))
    again = open_memory(tmp_path / "out", *small)
    done = kept_names(again)
    assert WHOLE in done

    def fitted_again(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr("impc.inverse.methods.fit_controller", fitted_again)
    result = fit_recordings(*small, FitProgress(lambda _: None, again.estimate))
    np.testing.assert_array_equal(result.fitted.stage_weights.Q, whole.fitted.stage_weights.Q)
    np.testing.assert_array_equal(result.inverse_mpc.held_out, whole.inverse_mpc.held_out)
    again.cache.forget()
    assert list((tmp_path / "out").iterdir()) == []


def test_a_memory_of_another_fit_is_not_used(
    small: tuple[Problem, FitSettings], tmp_path: Path
) -> None:
    problem, settings = small
    found = fit_controller(problem)
    open_memory(tmp_path, problem, settings).estimate(WHOLE, lambda: found)
    assert kept_names(open_memory(tmp_path, problem, settings)) == {WHOLE}
    assert not kept_names(open_memory(tmp_path, problem, replace(settings, settle=2.0)))
    other = replace(problem, recordings=problem.recordings[:2])
    assert not kept_names(open_memory(tmp_path, other, settings))
    path = tmp_path / "fit-in-progress" / "With-limit--inverse-MPC.json"
    whole = path.read_text()
    for text in ("", "{", "[]", json.dumps({"digest": 3}), whole.replace("1", "2", 1)):
        path.write_text(text)
        assert not kept_names(open_memory(tmp_path, problem, settings))


def test_what_cannot_be_fitted_is_said() -> None:
    plant = cart()
    with pytest.raises(DataError, match="the list is empty"):
        fit_problem(plant, [], FitSettings())
    with pytest.raises(DataError, match="zero in every trial"):
        fit_problem(plant, [Recording(plant, np.zeros(100))], FitSettings())
    trial = noisy_trial(1, 0.0)
    short = replace(trial, outputs=trial.outputs[:15], disturbance=trial.disturbance[:15])
    with pytest.raises(DataError, match="the shortest trial has 15 samples"):
        fit_problem(plant, [trial, short], FitSettings())


def test_a_release_without_disturbance_is_fitted() -> None:
    """Trials that are driven only by their unknown initial states."""
    controller = true_controller()
    plant = controller.plant
    runs = [
        simulate(controller, scenario(plant, x0, 100))
        for x0 in ([0.4, 0.0], [-0.2, 0.3], [0.3, 0.1])
    ]
    trials = [Recording(plant, (run.x @ plant.C.T)[:100]) for run in runs]
    settings = FitSettings(horizon=10, u_max=1.0)
    fitted = fit_controller(fit_problem(plant, trials, settings))
    np.testing.assert_allclose(fitted.gain, controller.K, rtol=1e-6)
    np.testing.assert_allclose(fitted.problem.recordings[1].x0, [-0.2, 0.3], atol=1e-7)


@pytest.mark.full
def test_a_recording_in_which_nothing_moves_is_left_unexplained() -> None:
    plant = cart()
    rng = np.random.default_rng(SEED)
    outputs = 1e-3 * rng.standard_normal(200)
    outputs[0] = 0.0
    found = fit_controller(fit_problem(plant, [Recording(plant, outputs)], FitSettings(u_max=1.0)))
    assert "The residual is 100 % of the recordings (2-norm)." in found.doubts


def test_what_is_kept_has_the_body_that_was_found(tmp_path: Path) -> None:
    """All stored stages of a fit with an uncertain body are restored exactly."""
    person = cart_person(1, 99, 0.0)
    assert person is not None
    settings = FitSettings(horizon=10, u_max=0.55, intent_draws=False, methods=["feedback_gain"])

    def stages_of(memory: FitMemory) -> dict[str, Estimate]:
        found: dict[str, Estimate] = {}

        def kept(name: str, compute: Callable[[], Estimate]) -> Estimate:
            found[name] = memory.estimate(name, compute)
            return found[name]

        fit_recordings(person.problem, settings, FitProgress(estimate=kept))
        return found

    first = stages_of(open_memory(tmp_path, person.problem, settings))
    again = stages_of(open_memory(tmp_path, person.problem, settings))
    assert set(first) == {WHOLE, "No limit, gain only"}
    for name, one in first.items():
        assert not np.array_equal(one.problem.plant.A, person.problem.plant.A)
        np.testing.assert_array_equal(again[name].problem.plant.A, one.problem.plant.A)
        np.testing.assert_array_equal(again[name].gain, one.gain)
        np.testing.assert_array_equal(again[name].problem.starts, one.problem.starts)
        kept = again[name]
        assert (kept.misfit, kept.noise, kept.status) == (one.misfit, one.noise, one.status)
