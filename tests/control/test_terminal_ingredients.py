"""User-supplied terminal weight and terminal set, against a program written out in u."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import impc
from impc.control.closed_loop import simulate
from impc.control.simulation import Scenario, Simulation, Status
from tests.independent_mpc import first_input
from tests.support import random_plant, random_weights

HORIZON = 4
KINDS = ("weight", "none", "set", "weight and set", "none and set")


def own_loop(
    seed: int, kind: str, softening: float | None
) -> tuple[impc.Controller, Scenario, Simulation, dict[str, Any]]:
    """A random loop with active and inactive samples, and its parts for the program in u."""
    n, m = 2 + seed % 2, 1 + seed // 2 % 2
    for attempt in range(40):
        rng = np.random.default_rng([seed, KINDS.index(kind), attempt])
        plant = random_plant(rng, n, m, 1.1, d=1)
        weights = impc.Weights(random_weights(rng, n), random_weights(rng, m))
        P = 0 * weights.Q if kind.startswith("none") else 3 * random_weights(rng, n)
        normals = rng.normal(size=(3, n))
        terminal = (np.vstack([normals, -normals]), rng.uniform(0.3, 0.6, size=6))
        law = impc.Controller(
            plant,
            weights,
            impc.Bounds(plant, u_min=-0.5, u_max=0.5, x_min=-1.5, x_max=1.5),
            HORIZON,
            terminal_weight=None if kind == "set" else P if np.any(P) else 0,
            terminal_set=terminal if "set" in kind else False,
            softening=softening,
        )
        parts: dict[str, Any] = {"A": plant.A, "B": plant.B, "Q": weights.Q, "R": weights.R}
        parts |= {"horizon": HORIZON, "u_max": 0.5, "x_max": 1.5, "softening": softening}
        parts |= {
            "P": None if kind == "set" else P,
            "terminal": terminal if "set" in kind else None,
        }
        direction = rng.normal(size=n)
        for size in 4 * 0.9 ** np.arange(40):
            start = np.clip(size * direction, -1.5, 1.5)
            drive = impc.scenario(plant, start, disturbance=0.05 * rng.normal(size=12))
            run = simulate(law, drive)
            busy = np.count_nonzero(run.status[: run.reached] > Status.FREE)
            if run.complete and 1 < busy < len(run.u) and run.weakly_active == 0:
                return law, drive, run, parts
    raise AssertionError(f"seed {seed} has no active bound")


@pytest.mark.parametrize("softening", [None, 20.0])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_inputs_are_those_of_the_program_written_out(
    seed: int, kind: str, softening: float | None
) -> None:
    _, _, run, parts = own_loop(seed, kind, softening)
    for x, u in zip(run.x[:-1], run.u, strict=True):
        assert u == pytest.approx(first_input(x=x, **parts), abs=1e-8)


def moved(law: impc.Controller, name: str, change: np.ndarray) -> impc.Controller:
    """The controller made again with one weight changed."""
    stages = law.stages
    assert stages is not None
    given = {"Q": stages.weights.Q, "R": stages.weights.R, "P": stages.P[-1]}
    given[name] = given[name] + change
    weights, ends = impc.Weights(given["Q"], given["R"]), law.terminal or False
    own: dict[str, Any] = {"terminal_weight": given["P"], "terminal_set": ends}
    return impc.Controller(law.plant, weights, law.bounds, HORIZON, softening=law.softening, **own)


@pytest.mark.parametrize("softening", [None, 20.0])
@pytest.mark.parametrize("kind", ["weight", "none", "weight and set"])
@pytest.mark.parametrize("seed", range(4))
def test_derivatives_along_the_weights(seed: int, kind: str, softening: float | None) -> None:
    law, drive, _, _ = own_loop(seed, kind, softening)
    n, m = law.plant.n, law.plant.m
    rng = np.random.default_rng(seed)
    changes = {name: random_weights(rng, size) for name, size in (("Q", n), ("R", m), ("P", n))}
    for name, change in changes.items():
        along = impc.directions(law, 1, **{name: change})
        _, slopes = impc.simulate_and_differentiate(law, drive, along)

        def loop(step: float, name: str = name, change: np.ndarray = change) -> np.ndarray:
            run = simulate(moved(law, name, step * change), drive)
            return np.hstack([run.x[:-1], run.u])

        found = np.hstack([slopes.x[:-1, :, 0], slopes.u[:, :, 0]])
        step = 1e-5
        if kind == "none" and name == "P":  # there is no P below zero
            expected = (4 * loop(step) - loop(2 * step) - 3 * loop(0.0)) / (2 * step)
        else:
            expected = (loop(step) - loop(-step)) / (2 * step)
        assert found == pytest.approx(expected, abs=1e-6 * max(1.0, np.max(np.abs(expected))))


@pytest.mark.parametrize("seed", range(4))
def test_weights_behind_a_finite_horizon(seed: int, tmp_path: Path) -> None:
    """From noise-free recordings; the rank is that of central differences."""
    rng = np.random.default_rng(seed)
    plant, P = random_plant(rng, 2, 1, 1.05, d=1), 3 * random_weights(rng, 2) * (seed % 2)
    structure = impc.Structure(plant, "diagonal") if seed > 1 else None
    truth = structure.weights(rng.normal(size=2)) if structure else impc.Weights(np.eye(2), 1)
    bounds, push = impc.Bounds(plant, u_min=-0.5, u_max=0.5), np.append(rng.normal(size=60), 0)
    given: dict[str, Any] = {"terminal_weight": P if seed % 2 else 0}

    def outputs(weights: impc.Weights) -> list[np.ndarray]:
        law = impc.Controller(plant, weights, bounds, 4, terminal_set=False, **given)
        return [law.simulate(x0, disturbance=push[:-1]).x for x0 in ([1, -1], [0, 1])]

    trials = [impc.Recording(plant, x, push) for x in outputs(truth)]
    problem = impc.Problem(
        plant, bounds, 4, trials, structure=structure, unknown_start=seed == 1, **given
    )
    found = impc.fit(problem)
    assert found.explained
    changes = 1e-5 * np.array([[[1, 0], [0, 0]], [[0, 0], [0, 1]], [[0, 1], [1, 0]]])
    changes = changes[:2] if structure else changes
    ends = [[outputs(impc.Weights(truth.Q + dQ, truth.R)) for dQ in (dX, -dX)] for dX in changes]
    values = np.linalg.svd(np.reshape(np.diff(ends, axis=1), (len(ends), -1)), compute_uv=False)
    assert found.fit.rank == np.count_nonzero(values > 1e-5 * values[0])
    if seed != 1:  # there one direction stays unidentified
        assert impc.weight_error(found.stage_weights, truth) < 1e-6
    assert "terminal weight is fixed" in found.summary()
    again: Any = impc.load(found.save(tmp_path / "found.json"))
    assert np.array_equal(again.controller().gains, found.controller().gains)
    for refused in (
        found.intervals,
        found.identifiability,
        lambda: impc.table_3_1(problem),
        lambda: impc.fit(problem, "inverse_lqr_lmi"),
        lambda: impc.fit_output_feedback(found, impc.Observer(plant, motor=0.1, sensory=0.1)),
    ):
        with pytest.raises(impc.InputError, match="terminal_weight: gives every stage its own"):
            refused()
    with pytest.raises(impc.InputError, match="start: cannot be combined with terminal_weight"):
        impc.fit(problem, start=found)
    with pytest.raises(impc.InputError, match="cannot be combined with terminal_set"):
        impc.Problem(plant, bounds, 4, trials, terminal_set=True, **given)


def test_what_cannot_be_is_refused_in_one_line() -> None:
    law, _, _, parts = own_loop(0, "weight", None)
    weights = impc.Weights(parts["Q"], parts["R"])

    def make(**given: Any) -> impc.Controller:
        return impc.Controller(law.plant, weights, law.bounds, 4, **given)

    for call, message in (
        (lambda: make(terminal_weight=0), "terminal_set: True is the invariant set of the Riccati"),
        (lambda: make(terminal_weight=-np.eye(2), terminal_set=False), "not positive semidefinite"),
        (lambda: make(terminal_set=(np.eye(3), np.ones(3))), r"terminal_set: H: expected shape"),
        (lambda: make(terminal_set=(np.eye(2), np.zeros(2))), "give H x <= h with h > 0"),
        (lambda: impc.directions(law, 1, K=np.ones(2)), "K: is no part of a direction"),
        (lambda: impc.replace(law, horizon=5), "its stage gains belong to another plant"),
        (lambda: impc.closed_loop_function(law, 3), "has a terminal weight of its own"),
    ):
        with pytest.raises(impc.ImpcError, match=message):
            call()
    loose, near = impc.Bounds(law.plant, u_min=-0.5, u_max=0.5), (np.eye(2), 1e-9 * np.ones(2))
    far = impc.Controller(law.plant, weights, loose, 4, terminal_set=near)
    with pytest.warns(UserWarning, match=r"H\[\d\] x <= 1e-09 in the terminal set, at sample 4"):
        far.simulate([50, 50], steps=1)
