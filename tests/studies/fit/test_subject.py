"""Fit of a subject: result, stored steps, and intent."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np
import pytest

import impc
from experiments.benchmarks.workloads import seat
from experiments.coverage import cart, noisy_trial
from experiments.simulated_subjects import noisy_recordings
from impc.assess.intent import dominant_sentence, intent
from impc.assess.variance_accounted_for import predicted
from impc.inverse.delayed_feedback import preliminary_gain
from impc.inverse.noisy_fit import fit_controller
from impc.reporting.document import Quiet
from impc.studies.fit.first import FitProgress
from impc.studies.fit.memory import open_memory
from impc.studies.fit.movement import movement_section
from impc.studies.fit.result import FitResult
from impc.studies.fit.subject import fit_recordings, stages
from tests.assess.cart_fits import cart_problem, uncertain_cart
from tests.support import kept_names, present

FEEDBACK = ["theta1", "theta2", "theta1_rate", "theta2_rate"]
SMALL = impc.FitSettings(horizon=10, u_max=1.0)
SEED, WHOLE = 4, "With limit, inverse MPC"


@pytest.fixture(scope="module")
def noisy() -> FitResult:
    trials = noisy_recordings(6.0, SEED, 0.9, seconds=15.0)
    settings = impc.FitSettings(u_max=6.0, feedback_states=FEEDBACK, intent_draws=False)
    return fit_recordings(impc.fit_problem(seat().problem.plant, trials, settings), settings)


@pytest.fixture(scope="module")
def small() -> FitResult:
    """Three trials of a cart, with noise of 20 %."""
    heard: list[str] = []
    problem = cart_problem(1, 2, 3)
    found = fit_recordings(problem, SMALL, FitProgress(heard.append))
    assert tuple(heard) == stages(problem, SMALL)
    return found


def test_variance_accounted_for_is_that_of_the_trajectories(noisy: FitResult) -> None:
    plant, trials, method = noisy.given.plant, noisy.given.recordings, noisy.inverse_mpc
    simulated = [run.x @ plant.C.T for run in method.runs]
    for index, trial in enumerate(trials):
        expected = impc.vaf(trial.outputs, simulated[index])
        np.testing.assert_allclose(noisy.trials[index].vaf, expected)
        np.testing.assert_allclose(method.trial_vaf[index], expected)
    recorded = np.concatenate([trial.outputs for trial in trials])
    np.testing.assert_allclose(method.vaf, impc.vaf(recorded, np.concatenate(simulated)))
    # Left-out trials are predicted to the ceiling of the noise.
    assert method.held_out.shape == (3, 2)
    assert np.all(np.abs(method.held_out - 90) < 1.0)


def test_a_trial_left_out_is_predicted_as_by_a_fit_of_the_others(small: FitResult) -> None:
    """A few steps from the fit of all trials end where a search from scratch does."""
    for index, trial in enumerate(small.given.recordings):
        other = fit_controller(small.given.leaving_out(index))
        pair = other.gain, np.array(other.metric)
        wanted = predicted(other.problem, *pair, trial, SMALL.settle)
        np.testing.assert_allclose(small.inverse_mpc.held_out[index], wanted.vaf, atol=0.1)
    # With noise of 20 %, the largest possible VAF is 1 / 1.04.
    assert np.all(np.abs(small.inverse_mpc.vaf - 100 / 1.04) < 1.5)
    assert small.identifiability.rank == 2


def test_the_preliminary_estimate_is_shown_beside_the_others(noisy: FitResult) -> None:
    assert [item.name for item in noisy.methods] == [
        "preliminary", "feedback_gain", "inverse_lqr", "inverse_lqr_output", "clipped_lqr",
        "inverse_mpc",
    ]  # fmt: skip
    first = noisy.methods[0]
    assert np.all(present(first.estimate.K)[0, 4:] == 0)
    assert np.all(first.vaf < noisy.inverse_mpc.vaf - 5)


def test_every_reading_has_the_gain_and_the_angle_is_theirs(noisy: FitResult) -> None:
    plant, K, first = noisy.given.plant, noisy.fitted.gain, noisy.intent.reported
    for reading in noisy.intent.readings:
        size = float(np.max(np.abs(K)))
        np.testing.assert_allclose(impc.solve_lqr(plant, reading.weights).K, K, atol=1e-6 * size)
        values, vectors = np.linalg.eigh(reading.weights.Q)
        np.testing.assert_allclose(values, reading.eigenvalues, rtol=1e-12)
        cosine = abs(float(vectors[:, -1] @ first.dominant))
        assert reading.angle == pytest.approx(np.degrees(np.arccos(min(1.0, cosine))), abs=1e-3)
        assert reading.condition >= first.condition * (1 - 1e-6)
    assert noisy.intent.widest_angle > 10


def test_intent_of_known_weights() -> None:
    """Double integrator with Q = I: the minimum condition number is 1 for all v."""
    plant = impc.Plant(control.ss([[1, 1], [0, 1]], [[0.5], [1]], np.eye(2), 0, True))
    weights = impc.Weights(np.diag([4.0, 1.0]), 1)
    K = np.array(impc.solve_lqr(plant, weights).K)
    found = intent(plant, K, np.ones((1, 1, 1)), np.ones(2), weights)
    np.testing.assert_allclose(found.reported.eigenvalues, [1, 4], rtol=1e-5)
    np.testing.assert_allclose(found.reported.dominant, [1, 0], atol=1e-4)
    sentence = dominant_sentence(found.reported, plant, np.array([1.0, 3.0]))
    assert sentence.startswith("The dominant cost is 4 (+1.00 x[0])^2, 80 % of the trace")


def test_preliminary_gain_without_noise_finds_gains_of_its_own_form() -> None:
    plant, rng, K = cart(), np.random.default_rng(SEED), np.array([[3.0, 1.5]])
    push = np.repeat(rng.choice([-1.0, 0.0, 1.0], 40), 10)
    x = np.zeros((401, 2))
    for k in range(400):
        x[k + 1] = (plant.A - plant.B @ K) @ x[k] + plant.E[:, 0] * push[k]
    trial = impc.Recording(plant, (x @ plant.C.T)[:400], push)
    problem = impc.fit_problem(plant, [trial], impc.FitSettings())
    np.testing.assert_allclose(preliminary_gain(problem, plant.states)[0], K, rtol=1e-6)
    with pytest.raises(impc.InputError, match="feedback_states"):
        preliminary_gain(problem, ["speed"])


def test_a_body_without_drawing_and_one_that_fails_after_the_fit(small: FitResult) -> None:
    plant = small.given.plant
    assert movement_section(small) == []
    system = control.ss(plant.A, np.hstack([plant.B, plant.E]), plant.C, 0, plant.dt)
    system.drawing = lambda x: [[[0.0, 0.0]]] if not any(x) else []
    given = impc.replace(small.given, plant=impc.Plant(system, ["u[0]"]))
    (section,) = movement_section(impc.replace(small, given=given))
    (block,) = section.blocks
    assert isinstance(block, Quiet)
    assert block.text.startswith("Not available: plant.drawing: fails: ")


def test_an_interrupted_fit_goes_on(
    small: FitResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = open_memory(tmp_path / "out", small.given, SMALL)

    def interrupt(stage: str) -> None:
        if stage == "No limit, gain only":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_recordings(small.given, SMALL, FitProgress(interrupt, memory.estimate))
    again = open_memory(tmp_path / "out", small.given, SMALL)
    assert WHOLE in kept_names(again)

    def fitted_again(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr("impc.inverse.methods.fit_controller", fitted_again)
    result = fit_recordings(small.given, SMALL, FitProgress(lambda _: None, again.estimate))
    np.testing.assert_array_equal(result.fitted.stage_weights.Q, small.fitted.stage_weights.Q)
    np.testing.assert_array_equal(result.inverse_mpc.held_out, small.inverse_mpc.held_out)
    again.cache.forget()
    assert list((tmp_path / "out").iterdir()) == []


def test_a_memory_of_another_fit_is_not_used(small: FitResult, tmp_path: Path) -> None:
    problem = small.given
    open_memory(tmp_path, problem, SMALL).estimate(WHOLE, lambda: small.fitted)
    assert kept_names(open_memory(tmp_path, problem, SMALL)) == {WHOLE}
    assert not kept_names(open_memory(tmp_path, problem, impc.replace(SMALL, settle=2.0)))
    other = impc.replace(problem, recordings=problem.recordings[:2])
    assert not kept_names(open_memory(tmp_path, other, SMALL))
    path = tmp_path / "fit-in-progress" / "With-limit--inverse-MPC.json"
    whole = path.read_text()
    for text in ("", "{", "[]", json.dumps({"digest": 3}), whole.replace("1", "2", 1)):
        path.write_text(text)
        assert not kept_names(open_memory(tmp_path, problem, SMALL))


def test_what_cannot_be_fitted_is_said() -> None:
    plant, trial = cart(), noisy_trial(1, 0.0)
    short = impc.replace(trial, outputs=trial.outputs[:15], disturbance=trial.disturbance[:15])
    for trials, said in (
        ([], "the list is empty"),
        ([impc.Recording(plant, np.zeros(100))], "zero in every trial"),
        ([trial, short], "the shortest trial has 15 samples"),
    ):
        with pytest.raises(impc.DataError, match=said):
            impc.fit_problem(plant, trials, impc.FitSettings())


@pytest.mark.full
def test_a_recording_in_which_nothing_moves_is_left_unexplained() -> None:
    outputs = 1e-3 * np.random.default_rng(SEED).standard_normal(200)
    outputs[0] = 0.0
    trial = impc.Recording(cart(), outputs)
    found = fit_controller(impc.fit_problem(cart(), [trial], impc.FitSettings(u_max=1.0)))
    assert "The residual is 100 % of the recordings (2-norm)." in found.doubts


def test_what_is_kept_has_the_body_that_was_found(tmp_path: Path) -> None:
    """All stored stages of a fit with an uncertain body are restored exactly."""
    problem = uncertain_cart().problem
    settings = impc.FitSettings(
        horizon=10, u_max=0.55, intent_draws=False, methods=["feedback_gain"]
    )

    def stages_found() -> dict[str, impc.Estimate]:
        memory, found = open_memory(tmp_path, problem, settings), dict[str, impc.Estimate]()

        def kept(name: str, compute: Callable[[], impc.Estimate]) -> impc.Estimate:
            found[name] = memory.estimate(name, compute)
            return found[name]

        fit_recordings(problem, settings, FitProgress(estimate=kept))
        return found

    first, again = stages_found(), stages_found()
    assert set(first) == {WHOLE, "No limit, gain only"}
    for name, one in first.items():
        kept = again[name]
        assert not np.array_equal(one.problem.plant.A, problem.plant.A)
        np.testing.assert_array_equal(kept.problem.plant.A, one.problem.plant.A)
        np.testing.assert_array_equal(kept.gain, one.gain)
        np.testing.assert_array_equal(kept.problem.starts, one.problem.starts)
        assert (kept.misfit, kept.noise, kept.status) == (one.misfit, one.noise, one.status)
