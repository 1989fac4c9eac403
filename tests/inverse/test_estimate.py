"""Text, table, figure and file of an estimate; intervals that reach over several ends."""

from __future__ import annotations

import ast
import inspect
import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import control
import matplotlib as mpl
import numpy as np
import pytest

import impc
import plants
from experiments.coverage import cart
from impc.arrays import frozen
from impc.assess.printed_gain import GainEstimate, covariance_intervals, gain_estimate
from impc.attached_methods import METHODS, PROPERTIES
from impc.inverse.estimates import SearchEnd
from impc.inverse.minimiser import Ended
from impc.inverse.refit import refit, several_ends
from impc.nonlinear.fit import OptimalControlEstimate
from tests.assess.cart_fits import cart_fit, uncertain_fit
from tests.inverse.test_targets_and_gaps import gapped
from tests.support import posed, regulator

mpl.use("Agg")


@pytest.fixture(scope="module")
def found() -> impc.Estimate:
    return cart_fit(1, 2)


def scalar(a: float = 0.9, **more: Any) -> impc.Plant:
    return impc.Plant(control.ss([[a]], [[1]], [[1]], 0, 1), **more)


def test_trajectories_and_intervals_have_their_names_and_units(found: impc.Estimate) -> None:
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
    y = np.concatenate([item.outputs for item in found.problem.recordings])
    left = y - np.concatenate(found.outputs)
    share = np.sum(left**2, axis=0) / np.sum(y**2, axis=0)
    np.testing.assert_allclose(found.vaf, 100 * (1 - share), rtol=1e-9)
    table = found.intervals()
    assert table.index.tolist() == [f"K.{u}.{x}" for u in plant.controls for x in plant.states]
    assert np.all((table.low < table.value) & (table.value < table.high))
    np.testing.assert_allclose(table.value, found.gain.ravel(), rtol=0.2)


def test_summary_repr_and_html_are_short_and_escaped(found: impc.Estimate) -> None:
    text = found.summary()
    for part in ("horizon 10", "VAF", "K.", "Q =", found.status.sentence):
        assert part in text
    assert len(repr(found)) < 100
    assert len(repr(found.problem)) < 1000
    plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1, states=["<b>"], inputs=["u"]))
    run = impc.Controller(plant, impc.Weights(1, 1), impc.Bounds(plant), 3).simulate([1.0], 20)
    other = impc.fit(impc.Problem(plant, impc.Bounds(plant), 3, [impc.Recording(plant, run.x)]))
    assert "&lt;b&gt;" in other._repr_html_()
    assert "<b>" not in other._repr_html_()


def test_a_plot_has_what_was_recorded_and_simulated(found: impc.Estimate) -> None:
    axes, plant = found.plot(1), found.problem.plant
    assert len(axes) == len(plant.outputs) + plant.m
    recorded, simulated = (line.get_ydata() for line in axes[0].lines)
    np.testing.assert_array_equal(recorded, found.problem.recordings[1].outputs[:, 0])
    np.testing.assert_array_equal(simulated, found.outputs[1][:, 0])
    with pytest.raises(impc.InputError, match="trial"):
        found.plot(2)
    with pytest.raises(impc.InputError, match="axes"):
        found.plot(axes=axes[:1])


def seat_fit() -> impc.Estimate:
    """Of a plant with moments of gravity."""
    plant = impc.Plant(plants.seated_balance_plant(), ["command"])
    law, start = regulator(plant, np.eye(plant.n), np.inf, 3), 0.01 * np.ones(plant.n)
    trial = impc.Recording(plant, law.simulate(start, steps=30).outputs, x0=start)
    found = impc.fit(posed(law, trial), start=impc.Weights(np.eye(plant.n), 1))
    assert dict(found.problem.plant.gravity).keys() == {"theta1", "theta2"}
    return found


@pytest.mark.parametrize(
    "made",
    [lambda: cart_fit(1, 2), lambda: gapped(0.6)[1], uncertain_fit, seat_fit],
    ids=["plain", "gaps, targets, offsets and commands", "uncertain body and other ends", "seat"],
)
def test_a_saved_estimate_is_the_same(made: Callable[[], impc.Estimate], tmp_path: Path) -> None:
    found = made()
    again = impc.load(found.save(tmp_path / "found.json"), family=found.problem.family)
    assert isinstance(again, impc.Estimate)
    assert again.misfit == found.misfit
    assert found.rivals or made is not uncertain_fit
    for end, saved in zip(found.rivals, again.rivals, strict=True):
        np.testing.assert_array_equal(saved.K, end.K)
        assert saved.objective == end.objective
    np.testing.assert_array_equal(again.gain, found.gain)
    np.testing.assert_array_equal(again.problem.starts, found.problem.starts)
    np.testing.assert_array_equal(again.problem.errors, found.problem.errors)
    for one, other in zip(again.states, found.states, strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.intervals().equals(found.intervals())
    assert str(again) == str(found)
    assert again.problem.plant.units == found.problem.plant.units
    assert again.problem.plant.gravity == found.problem.plant.gravity


def test_a_search_goes_on_from_an_earlier_answer_and_is_silent(
    found: impc.Estimate, capsys: pytest.CaptureFixture[str]
) -> None:
    again = impc.fit(found.problem, start=found)
    np.testing.assert_allclose(again.gain, found.gain, rtol=1e-3)
    assert again.evaluations < found.evaluations
    assert capsys.readouterr() == ("", "")
    assert logging.getLogger("impc").level == logging.NOTSET
    assert json.dumps(found.status.value) == '"settled"'


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda text: text[:-40], "is not a result file"),
        (lambda text: text.replace('"schema": 10', '"schema": 3'), "another version"),
        (lambda text: text.replace('"status": "settled"', '"status": "odd"'), "is damaged"),
        (lambda text: text.replace('"K": [[', '"K": [["x", '), "K: expected real numbers"),
        (lambda text: text.replace('"K": [[', '"K": [[1.0, '), "K: expected shape"),
        (lambda text: text.replace('"recordings": [{', '"recordings": [7, {'), "is damaged"),
        (lambda text: text.replace('"A": [[', '"A": [[1, '), "is damaged"),
        (lambda text: text.replace('"gravity": []', '"gravity": [["x", 1.0]]'), "is damaged"),
        (lambda text: text.replace('"gravity": []', '"gravity": "abc"'), "gravity.*give 2 values"),
    ],
)
def test_a_damaged_file_is_one_line(found: impc.Estimate, tmp_path: Path, damage, said) -> None:  # type: ignore[no-untyped-def]
    file = found.save(tmp_path / "found.json")
    file.write_text(damage(file.read_text()))
    with pytest.raises((impc.DataError, impc.InputError), match=said) as refused:
        impc.load(file)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("kind", ["family", "family of bodies", "body"])
def test_a_body_and_a_family_are_given_again(kind: str, tmp_path: Path) -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")

    def bent(values: Any) -> impc.Plant:
        a = float(values[0])
        return scalar(a, body=ca.Function("step", [x, u], [a * ca.sin(x) + u]))

    made = bent if kind == "family of bodies" else lambda values: scalar(float(values[0]))
    plant, family = bent([0.9]), impc.PlantFamily(made, ["a"], [0.9])
    stronger = impc.PlantFamily(lambda values: scalar(float(values[0]) * 1.1), ["a"], [0.9])
    if kind == "body":
        right: Any = {"plant": plant}
        wrong: Any = [({}, "body"), ({"plant": scalar(0.8)}, "a different A than saved"),
                      ({"plant": scalar()}, "a different body than saved")]  # fmt: skip
    else:
        plant, right = family.make(family.nominal), {"family": family}
        wrong = [({}, "family"), ({"family": stronger}, "plant: has a different A than saved")]
    law = regulator(plant, 1, 0.3, 3)
    trial = impc.Recording(plant, law.simulate([0.3], 20).x)
    given = {} if kind == "body" else right
    found = impc.fit(posed(law, trial, terminal_set=False, **given))
    file = found.save(tmp_path / "found.json")
    for other, said in wrong:
        with pytest.raises(impc.InputError, match=said):
            impc.load(file, **other)
    again = impc.load(file, **right)
    assert isinstance(again, impc.Estimate)
    assert again.problem.family is right.get("family")
    assert (again.problem.plant.body is None) == (kind == "family")
    np.testing.assert_array_equal(again.gain, found.gain)
    np.testing.assert_array_equal(again.outputs[0], found.outputs[0])


def test_a_forgotten_disturbance_is_named(found: impc.Estimate) -> None:
    still = tuple(impc.Recording(cart(), trial.outputs) for trial in found.problem.recordings)
    problem = impc.replace(found.problem, recordings=still)
    other, said = impc.replace(found, problem=problem, misfit=1e3), "the plant has push"
    assert said not in " ".join(found.doubts)
    assert said in " ".join(other.doubts)
    for doubt in other.doubts:  # qualifications precede the numbers
        assert other.summary().index(doubt) < other.summary().index("K.")


def test_what_drove_a_simulation_drives_its_recording() -> None:
    """The last disturbance is unused: n steps have n + 1 states and n disturbances."""
    push = np.ones(20)
    law = impc.Controller(cart(), impc.Weights(np.eye(2), 1), impc.Bounds(cart()), 3)
    one = impc.Recording(cart(), law.simulate(np.zeros(2), disturbance=push).outputs, push)
    np.testing.assert_array_equal(one.disturbance[:, 0], [*push, 0.0])
    bare = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    with pytest.raises(impc.DataError, match="the plant has none; name its controls"):
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
        source = inspect.getsource(inspect.unwrap(getattr(found, "fget", found)))
        (function,) = ast.parse(source).body
        assert isinstance(function, ast.FunctionDef)
        given = [(ast.unparse(one.args).split(", ")[1:], ast.unparse(one.returns or one))
                 for one in (node, function)]  # fmt: skip
        assert given[0] == given[1]


def with_rivals(*rises: tuple[float, float]) -> GainEstimate:
    """The estimate with ends at multiples of the gain, so much higher."""
    found = uncertain_fit()
    at = found.problem
    lowest = refit(at, found.gain, found.metric).objective
    rivals = tuple(
        SearchEnd(frozen(scale * found.gain), frozen(found.metric), at.starts, at.logarithms,
                  at.errors, lowest + rise, Ended.CONVERGED)
        for scale, rise in rises
    )  # fmt: skip
    return gain_estimate(impc.replace(found, rivals=rivals))


def test_the_lowest_end_is_first_and_starts_only_add() -> None:
    found = uncertain_fit()
    first = refit(found.problem, 1.1 * found.gain, found.metric)
    ends = several_ends(found.problem, [first])
    values = [end.objective for end in ends]
    assert values == sorted(values)
    assert len(ends) > 1
    assert any(end is first for end in ends)


def test_intervals_reach_over_ends_within_noise_and_no_further() -> None:
    found = uncertain_fit()
    alone, joined = with_rivals(), with_rivals((1.3, 2.0), (2.0, 60.0))
    assert len(joined.rivals) == 1
    single = covariance_intervals(alone, alone.covariance, "sandwich")
    both = covariance_intervals(joined, joined.covariance, "sandwich")
    for one, other in zip(single[: found.gain.size], both, strict=False):
        assert one.value is not None
        assert one.value == other.value
        assert other.low <= one.low
        assert other.high >= one.high
        assert other.low < 1.3 * one.value < other.high
        assert not other.low < 2.0 * one.value < other.high
    far = with_rivals((2.2, 1.0))
    over_far = covariance_intervals(far, far.covariance, "sandwich")[0]
    assert over_far.identified
    assert (single[0].determined, over_far.determined) == (True, False)
