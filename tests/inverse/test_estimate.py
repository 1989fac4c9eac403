"""Text, table, figure and file of an estimate."""

from __future__ import annotations

import ast
import inspect
import json
import logging
from pathlib import Path

import casadi as ca
import control
import matplotlib as mpl
import numpy as np
import pytest

import impc
from experiments.coverage import cart, noisy_trial
from impc.attached_methods import METHODS, PROPERTIES
from impc.errors import DataError, InputError
from impc.nonlinear.fit import OptimalControlEstimate
from impc.studies.fit.settings import FitSettings

mpl.use("Agg")


@pytest.fixture(scope="module")
def found() -> impc.Estimate:
    trials = [noisy_trial(seed, 0.0) for seed in (1, 2)]
    return impc.fit(impc.fit_problem(cart(), trials, FitSettings(horizon=10, u_max=1.0)))


def test_trajectories_have_their_names_and_units(found: impc.Estimate) -> None:
    plant, trial = found.problem.plant, found.problem.recordings[0]
    run = found.controller().simulate(trial.x0, disturbance=trial.disturbance[:-1])
    np.testing.assert_array_equal(found.states[0], run.x)
    np.testing.assert_array_equal(found.outputs[0], run.x @ plant.C.T)
    np.testing.assert_array_equal(found.inputs[0], run.u)
    np.testing.assert_allclose(np.diff(found.time[1]), plant.dt)
    frame = found.frame()
    assert len(frame) == sum(item.samples for item in found.problem.recordings)
    assert frame.attrs["units"]["time"] == "s"
    np.testing.assert_array_equal(frame[frame.trial == 1][plant.states[0]], found.states[1][:, 0])
    assert set(run.statuses) <= set(impc.Status)


def test_vaf_is_that_of_its_definition(found: impc.Estimate) -> None:
    y = np.concatenate([item.outputs for item in found.problem.recordings])
    left = y - np.concatenate(found.outputs)
    share = np.sum(left**2, axis=0) / np.sum(y**2, axis=0)
    np.testing.assert_allclose(found.vaf, 100 * (1 - share), rtol=1e-9)


def test_intervals_are_around_the_values_and_identified(found: impc.Estimate) -> None:
    table = found.intervals()
    assert table.index.tolist() == [f"K.{u}.{x}" for u in found.problem.plant.controls
                                   for x in found.problem.plant.states]  # fmt: skip
    assert np.all((table.low < table.value) & (table.value < table.high))
    np.testing.assert_allclose(table.value, found.gain.ravel(), rtol=0.2)


def test_summary_repr_and_html_are_short_and_escaped(found: impc.Estimate) -> None:
    text = found.summary()
    for part in ("horizon 10", "VAF", "K.", "Q =", found.status.sentence):
        assert part in text
    for doubt in found.doubts:  # qualifications precede the numbers
        assert text.index(doubt) < text.index("K.")
    assert len(repr(found)) < 100
    assert len(repr(found.problem)) < 1000
    plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1, states=["<b>"], inputs=["u"]))
    run = impc.Controller(plant, impc.Weights(1, 1), impc.Bounds(plant), 3).simulate([1.0], 20)
    other = impc.fit(impc.Problem(plant, impc.Bounds(plant), 3, [impc.Recording(plant, run.x)]))
    assert "&lt;b&gt;" in other._repr_html_()
    assert "<b>" not in other._repr_html_()


def test_a_plot_has_what_was_recorded_and_simulated(found: impc.Estimate) -> None:
    axes = found.plot(1)
    plant = found.problem.plant
    assert len(axes) == len(plant.outputs) + plant.m
    recorded, simulated = (line.get_ydata() for line in axes[0].lines)
    np.testing.assert_array_equal(recorded, found.problem.recordings[1].outputs[:, 0])
    np.testing.assert_array_equal(simulated, found.outputs[1][:, 0])
    with pytest.raises(InputError, match="trial"):
        found.plot(2)
    with pytest.raises(InputError, match="axes"):
        found.plot(axes=axes[:1])


def test_a_saved_estimate_is_the_same(found: impc.Estimate, tmp_path: Path) -> None:
    again = impc.load(found.save(tmp_path / "found.json"))
    assert isinstance(again, impc.Estimate)
    np.testing.assert_array_equal(again.gain, found.gain)
    np.testing.assert_array_equal(again.problem.starts, found.problem.starts)
    for one, other in zip(again.states, found.states, strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.intervals().equals(found.intervals())
    assert str(again) == str(found)
    assert again.problem.plant.units == found.problem.plant.units


def test_a_search_goes_on_from_an_earlier_answer(found: impc.Estimate) -> None:
    again = impc.fit(found.problem, start=found)
    np.testing.assert_allclose(again.gain, found.gain, rtol=1e-3)
    assert again.evaluations < found.evaluations


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda text: text[:-40], "is not a result file"),
        (lambda text: text.replace('"schema": 7', '"schema": 3'), "another version"),
        (lambda text: text.replace('"status": "settled"', '"status": "odd"'), "is damaged"),
        (lambda text: text.replace('"K": [[', '"K": [["x", '), "K: expected real numbers"),
        (lambda text: text.replace('"K": [[', '"K": [[1.0, '), "K: expected shape"),
        (lambda text: text.replace('"recordings": [{', '"recordings": [7, {'), "is damaged"),
        (lambda text: text.replace('"A": [[', '"A": [[1, '), "is damaged"),
    ],
)
def test_a_damaged_file_is_one_line(found: impc.Estimate, tmp_path: Path, damage, said) -> None:  # type: ignore[no-untyped-def]
    file = found.save(tmp_path / "found.json")
    file.write_text(damage(file.read_text()))
    with pytest.raises((DataError, InputError), match=said) as refused:
        impc.load(file)
    assert "\n" not in str(refused.value)


def test_a_body_and_a_family_are_given_again(tmp_path: Path) -> None:
    def plant_of(values: np.ndarray) -> impc.Plant:
        return impc.Plant(control.ss([[float(values[0])]], [[1]], [[1]], 0, 1))

    family = impc.PlantFamily(plant_of, ["a"], [0.9])
    plant = plant_of(np.array([0.9]))
    bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
    run = impc.Controller(plant, impc.Weights(1, 1), bounds, 3).simulate([1.0], 20)
    trial = impc.Recording(plant, run.x)
    found = impc.fit(impc.Problem(plant, bounds, 3, [trial], family=family))
    file = found.save(tmp_path / "family.json")
    with pytest.raises(InputError, match="family"):
        impc.load(file)
    other_family = impc.PlantFamily(lambda v: plant_of(v * 1.1), ["a"], [0.9])
    with pytest.raises(InputError, match="plant: has a different A than saved"):
        impc.load(file, family=other_family)
    again = impc.load(file, family=family)
    assert isinstance(again, impc.Estimate)
    assert again.problem.family is family
    x, u = ca.SX.sym("x"), ca.SX.sym("u")

    def moving_plant(values: np.ndarray) -> impc.Plant:
        step = ca.Function("step", [x, u], [float(values[0]) * ca.sin(x) + u])
        return impc.Plant(control.ss([[float(values[0])]], [[1]], [[1]], 0, 1), body=step)

    bodies = impc.PlantFamily(moving_plant, ["a"], [0.9])
    first = moving_plant(np.array([0.9]))
    found = impc.fit(impc.Problem(first, impc.Bounds(first), 3, [trial], family=bodies))
    again = impc.load(found.save(tmp_path / "bodies.json"), family=bodies)
    assert isinstance(again, impc.Estimate)
    assert again.problem.plant.body is not None
    np.testing.assert_array_equal(again.outputs[0], found.outputs[0])
    body = ca.Function("body", [x, u], [0.9 * ca.sin(x) + u])
    moving = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1), body=body)
    law = impc.Controller(moving, impc.Weights(1, 1), impc.Bounds(moving), 3)
    trial = impc.Recording(moving, law.simulate([0.3], 20).x)
    other = impc.fit(impc.Problem(moving, impc.Bounds(moving), 3, [trial]))
    file = other.save(tmp_path / "body.json")
    with pytest.raises(InputError, match="body"):
        impc.load(file)
    wrong = {"A": [[0.8]], "body": [[0.9]]}
    for what, A in wrong.items():
        with pytest.raises(InputError, match=f"a different {what} than saved"):
            impc.load(file, plant=impc.Plant(control.ss(A, [[1]], [[1]], 0, 1)))
    assert np.array_equal(impc.load(file, plant=moving).gain, other.gain)  # type: ignore[union-attr]


def test_a_forgotten_disturbance_is_named() -> None:
    trial = noisy_trial(1, 0.0)
    still = impc.Recording(cart(), trial.outputs)
    found = impc.fit(impc.fit_problem(cart(), [still], FitSettings(horizon=10, u_max=1.0)))
    assert any("No recording has a disturbance, although the plant has" in one
               for one in found.doubts)  # fmt: skip


def test_the_log_is_silent_unless_asked(
    found: impc.Estimate, capsys: pytest.CaptureFixture[str]
) -> None:
    impc.fit(found.problem, start=found)
    assert capsys.readouterr() == ("", "")
    assert logging.getLogger("impc").level == logging.NOTSET
    assert json.dumps(found.status.value) == '"settled"'


def test_what_drove_a_simulation_drives_its_recording() -> None:
    """The last disturbance is unused: n steps have n + 1 states and n disturbances."""
    push = np.ones(20)
    x = impc.Controller(cart(), impc.Weights(np.eye(cart().n), 1), impc.Bounds(cart()), 3)
    run = x.simulate(np.zeros(cart().n), disturbance=push)
    one = impc.Recording(cart(), run.outputs, push)
    np.testing.assert_array_equal(one.disturbance[:, 0], [*push, 0.0])
    bare = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    with pytest.raises(DataError, match="the plant has none; name its controls"):
        impc.Recording(bare, np.ones(5), np.ones(5))


@pytest.mark.parametrize("owner", [impc.Controller, impc.Estimate, OptimalControlEstimate])
def test_the_declared_methods_are_those_that_are_attached(owner: type) -> None:
    """A type checker reads the declarations in the class; a program calls the functions."""
    (kind,) = ast.parse(inspect.getsource(owner)).body
    (block,) = [node for node in ast.walk(kind) if isinstance(node, ast.If)
                and ast.unparse(node.test) == "TYPE_CHECKING"]  # fmt: skip
    declared = {node.name: node for node in block.body if isinstance(node, ast.FunctionDef)}
    assert list(declared) == list(METHODS[owner.__name__])
    for name, node in declared.items():
        found = getattr(owner, name)
        assert isinstance(found, property) == (name in PROPERTIES)
        (function,) = ast.parse(
            inspect.getsource(inspect.unwrap(getattr(found, "fget", found)))
        ).body
        assert isinstance(function, ast.FunctionDef)
        given = [ast.unparse(one.args).split(", ")[1:] for one in (node, function)]
        assert given[0] == given[1]
        assert node.returns
        assert function.returns
        assert ast.dump(node.returns) == ast.dump(function.returns)
