"""What is given to public functions: wrong things are said in a line, the same things work."""

from __future__ import annotations

import copy
import inspect
import pickle
import traceback
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import control
import numpy as np
import pandas as pd
import pytest

import impc
from impc.arrays import Frozen, as_numbers
from impc.checking import checked
from impc.errors import BoundsError, DataError, ImpcError, InputError, PlantError, WeightsError
from tests.wrong_arguments import calls, values, wrong_values

# Classes of results, which impc makes, and of errors.
ERRORS = [getattr(impc, name) for name in impc.__all__ if name.endswith("Error")]
MADE = {impc.Estimate, impc.Simulation, impc.Status, impc.TerminalSet, *ERRORS}
# The object of a method, and keyword arguments, which are called by their own names.
FIRST = {"self", "controller", "estimate", "fitted", "given", "settings", "changes", "more"}
# Functions that take long if they are given what they can use.
SLOW = ("table_3_1", "fit", "fit_optimal_control", "fit_output_feedback")
USABLE = (type(None), bool, int, float, np.float32)
PLANT = impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, True))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("part", [41, pytest.param(1, marks=pytest.mark.full)])
def test_a_wrong_argument_is_one_line(
    part: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every call runs, or ends in the package's own error; `part`: one of so many calls."""
    monkeypatch.chdir(tmp_path)
    odd = wrong_values()
    given = [(*call, name, label) for call in calls() for name in call[1] for label in odd]
    wrong = []
    for function, right, name, label in given[::part]:
        usable = type(odd[label]) in USABLE or odd[label] is right[name]
        if function.__name__ in SLOW and (usable or callable(odd[label])):
            continue
        said = _what_is_said(function, {**right, name: odd[label]})
        if said is not None:
            wrong.append(f"{function.__qualname__}, {name} = {label}: {said}")
    assert len(given) > 36_000
    assert not wrong


def _what_is_said(function: Callable[..., object], given: dict[str, Any]) -> str | None:
    """What is wrong with how a call ends; None when it works, or in a line of the package's."""
    try:
        function(**given)
    except ImpcError as error:
        said = str(error)
        return said if "\n" in said or len(said) > 300 else None
    except Exception as error:  # whatever it is, it is the wrong one
        return f"{type(error).__name__} in {traceback.extract_tb(error.__traceback__)[-1]}"
    return None


def test_the_table_of_calls_has_every_public_function_with_every_argument() -> None:
    called: dict[str, set[str]] = {}
    for function, given in calls():
        called.setdefault(function.__qualname__, set()).update(given)
    for kind in [getattr(impc, name) for name in impc.__all__]:
        own = dir(kind) if isinstance(kind, type) and not issubclass(kind, ImpcError) else []
        methods = [getattr(kind, name) for name in own if not name.startswith("_")]
        for function in [each for each in methods if callable(each)] + [kind] * (kind not in MADE):
            if str(getattr(function, "__module__", "")).startswith("impc"):
                names = set(inspect.signature(function).parameters)
                missing = names - called.get(function.__qualname__, set()) - FIRST
                assert not missing, function


def test_right_arguments_are_right() -> None:
    for function, right in calls():
        if function.__name__ not in SLOW:
            function(**right)


def test_what_means_the_same_is_welcome() -> None:
    outputs = np.round(np.random.default_rng(0).normal(size=(20, 2)), 2).astype(np.float32)
    expected = impc.Recording(PLANT, outputs.astype(float)).outputs
    frame = pd.DataFrame(outputs, columns=["x", "y"])
    for given in (outputs, outputs.tolist(), frame, np.ma.masked_array(outputs), tuple(outputs)):
        np.testing.assert_array_equal(impc.Recording(PLANT, given).outputs, expected)
    np.testing.assert_array_equal(impc.Recording(PLANT, frame.astype("Float32")).outputs, expected)
    named = impc.Bounds(PLANT, x_min={PLANT.states[1]: -2}, u_max={PLANT.controls[0]: 1})
    np.testing.assert_array_equal(named.x_min, [-np.inf, -2])
    np.testing.assert_array_equal(named.u_max, [1])
    one = impc.Controller(PLANT, impc.Weights(np.eye(2), 1), impc.Bounds(PLANT, u_max=[1]), 4)
    other = impc.Controller(
        PLANT,
        impc.Weights(pd.DataFrame(np.eye(2, dtype=int)), np.float32(1)),
        impc.Bounds(PLANT, u_max=pd.Series([1], dtype="Int64")),
        np.int8(4),  # type: ignore[arg-type]
        terminal_set=np.bool_(True),  # type: ignore[arg-type]
    )
    np.testing.assert_array_equal(one.K, other.K)
    assert type(other.horizon) is int
    lists = impc.vaf([[1.0], [np.nan], [2]], [[1.0], [5.0], [2.0]])  # type: ignore[arg-type]
    np.testing.assert_array_equal(lists, [100.0])
    make: Any = len
    family = impc.PlantFamily(make, ["a", "b"], [1, 2])
    assert family.part([True, False], [0, 0]).names == ("a",)  # type: ignore[arg-type]
    huge = as_numbers("whole", [2**70, 3])
    np.testing.assert_array_equal(huge, [2.0**70, 3.0])


def test_masked_samples_are_missing_not_data() -> None:
    outputs = np.ma.masked_array(np.ones((20, 2)))
    outputs[7, 1] = 1e6
    outputs[7, 1] = np.ma.masked
    assert np.argwhere(np.isnan(impc.Recording(PLANT, outputs).outputs)).tolist() == [[7, 1]]
    with pytest.raises(DataError, match="NaN or infinite"):
        impc.scenario(PLANT, np.ma.masked_array([1.0, 2.0], mask=[False, True]), 10)
    np.testing.assert_array_equal(
        as_numbers("x", np.ma.masked_array([1, 2], mask=[False, True])), [1.0, np.nan]
    )


def arrays_of(value: object) -> list[np.ndarray]:
    found = []
    for field in fields(value):  # type: ignore[arg-type]  # a dataclass
        item = getattr(value, field.name)
        if isinstance(item, np.ndarray):
            found.append(item)
        if isinstance(item, Frozen):
            found += arrays_of(item)
        if isinstance(item, tuple):
            found += [
                array for part in item if isinstance(part, Frozen) for array in arrays_of(part)
            ]
    return found


@pytest.mark.parametrize(
    "name",
    ["plant", "bounds", "weights", "controller", "scenario", "simulation", "recording", "problem",
     "solution", "fibre", "set", "terminal"],
)  # fmt: skip
def test_arrays_stay_read_only_in_copies_and_pickles(name: str) -> None:
    value = values()[name]
    if name == "set":
        assert value.cones  # of Clarabel's, which have no pickle: they stay behind
    made = [pickle.loads(pickle.dumps(value, protocol)) for protocol in (2, 4, 5)]
    made += [copy.copy(value), copy.deepcopy(value), impc.replace(value)]
    for one in made:
        assert type(one) is type(value)
        for array, same in zip(arrays_of(one), arrays_of(value), strict=True):
            np.testing.assert_array_equal(array, same)
            if name != "simulation":
                assert not array.flags.writeable
    assert arrays_of(value)


def test_columns_of_a_table_are_numbers_and_what_is_masked_is_missing() -> None:
    given = np.ma.masked_array([0.1, 0.2, -999.0, 0.4], mask=[False, False, True, False])
    found = impc.make_table(
        "lab", {"angle": given, "none": np.ma.masked_array(np.ones(4), mask=True)}
    ).columns
    np.testing.assert_array_equal(found["angle"], [0.1, 0.2, np.nan, 0.4])
    assert np.isnan(found["none"]).all()
    frame: Any = pd.DataFrame({"a": [1, 2]})
    assert impc.make_table("lab", frame).columns["a"].tolist() == [1.0, 2.0]
    for wrong in ({"a": "xy"}, [1, 2], {"a": [[1.0]]}, {1: [1.0]}, {"a": [1j, 2]}):
        with pytest.raises(ImpcError):
            impc.make_table("lab", wrong)  # type: ignore[arg-type]


BOX, PAIR, MATRIX = impc.Bounds(PLANT, u_max=1), impc.Weights(np.eye(2), 1), np.ones((1, 1))
MIXED = np.diag([2.0, 0.5]), [[0], [1]], np.eye(2)
ENDS = np.r_[np.ones((3, 2)), np.full((2, 2), np.nan)]


def law(*given: Any, **more: Any) -> Callable[[], object]:
    """A controller with the first of its arguments exchanged."""
    arguments: Any = [*given, *(PLANT, PAIR, BOX, 4)[len(given) :]]
    return lambda: impc.Controller(*arguments, **more)


def made(kind: Any, *given: Any, **more: Any) -> Callable[[], object]:
    return lambda: kind(*given, **more)


def plant(*matrices: Any, controls: Any = None) -> Callable[[], object]:
    return lambda: impc.Plant(control.ss(*matrices), controls)


#: What is called, with the class of the error and its words.
WRONG: list[tuple[Callable[[], object], type[ImpcError], str]] = [
    (law(None), InputError, "plant: expected a Plant, got None; make it"),
    (law(PLANT, BOX), InputError, "weights: expected a Weights, got Bounds"),
    (law(PLANT, impc.Weights(np.eye(3), 1)), InputError,
     "weights: has 3 states, but an earlier argument has 2; use the same plant for all"),
    (law(PLANT, PAIR, BOX, 4.0), InputError, "horizon: got 4.0; give a whole number"),
    (law(PLANT, PAIR, BOX, 0), InputError, "^horizon: got 0; give a whole number"),
    (law(PLANT, PAIR, BOX, 5001), InputError, "horizon: got 5001; give a whole number"),
    (law(PLANT, PAIR, BOX, 2**63), InputError, "horizon: is beyond 2147483647"),
    (law(softening=-1), InputError, "^softening: got -1"),
    *[(law(solver=name), InputError, f"^solver: got '{name}'; choose one of")
      for name in ("gurobi", "", "DAQ", "OSQP")],
    (made(impc.Problem, PLANT, BOX, 4, [impc.Recording(PLANT, np.ones((3, 2)))], solver="gurobi"),
     InputError, "^solver: got 'gurobi'; choose one of"),
    (made(impc.maximal_invariant_set, PLANT, [[1, 0]], BOX, tolerance=-1.0), InputError,
     "^tolerance"),
    (made(impc.maximal_invariant_set, PLANT, [[1, 0]], BOX, max_steps=0), InputError, "^max_steps"),
    (made(impc.maximal_invariant_set, PLANT, [[1], [0]], BOX), DataError, "^gain: expected shape"),
    (made(impc.scenario, PLANT, [1, 3]), DataError, "^steps: is missing, without a disturbance"),
    (made(impc.scenario, PLANT, [1, np.nan], 5), DataError, "^x0: 1 of 2 entries are NaN"),
    (made(impc.steady_state, PLANT, disturbance=[0.1]), DataError,
     r"^disturbance: expected shape \(0\)"),
    (made(impc.Controller.from_gain, PLANT, [[0, 0]], BOX, 3), InputError,
     "^gain: does not stabilise"),
    (made(impc.Controller.from_gain, PLANT, [1, 1], BOX, 3), DataError, "^gain: expected shape"),
    (made(impc.Weights, [[1, 2], [3]], 1), InputError, "Q: expected real numbers, got list"),
    (made(impc.Weights, np.eye(2) * 1j, 1), InputError, "Q: expected real numbers, got an array"),
    (made(impc.Weights, [5, 2], 0.1), InputError,
     r"Q: expected a square .* np.diag\(\[5.0, 2.0\]\)"),
    (made(impc.Weights, np.zeros((0, 0)), 1), InputError,
     r"Q: expected a square .* shape \(0, 0\)"),
    (made(impc.Weights, -np.eye(2), 1), WeightsError, "^Q: is not positive semidefinite"),
    (made(impc.Weights, np.eye(2), 0), WeightsError, "^R: is not positive definite"),
    (made(impc.Weights, [[1, 2], [0, 1]], 1), InputError, "^Q: is not symmetric"),
    (made(impc.Weights, [[1]]), InputError, "Weights: missing a required argument: 'R'"),
    (made(impc.Weights, [[1]], 1, 1), InputError, "too many positional arguments"),
    (made(impc.Weights, [[1]], R=1, S=1), InputError, "unexpected keyword argument 'S'"),
    (made(impc.Bounds, PLANT, u_max=["1"]), InputError, "u_max: expected real numbers, got an"),
    (made(impc.Bounds, PLANT, x_max={"v": 1.0}), InputError,
     "x_max: there is no signal 'v'; choose"),
    (made(impc.Bounds, PLANT, x_max={PLANT.states[0]: "1"}), InputError,
     "']: got '1'; give a number"),
    (made(impc.Bounds, PLANT, u_min=1, u_max=-1), BoundsError, "cross for u"),
    (made(impc.Bounds, PLANT, u_min=1, u_max=2), BoundsError, "exclude the origin"),
    (made(impc.Bounds, PLANT, u_min=0, u_max=1), ImpcError, "has a bound of u.* at 0"),
    (made(impc.Bounds, PLANT, u_max=np.nan), BoundsError, "has NaN"),
    (made(impc.Bounds, PLANT, x_max=[1, 2, 3]), BoundsError, "^x_max: got"),
    (plant(*MIXED, 0, True), PlantError, "not stabilisable"),
    (plant(0.5, 1, 1, 1, True), PlantError, "D: is not zero"),
    (plant(np.nan, 1, 1, 0, True), PlantError, "NaN or infinite"),
    (plant(0.5, 1, 1, 0, True, controls=["torque"]), PlantError, "controls: .*the inputs are"),
    (made(impc.Plant, np.eye(2)), PlantError, "expected a control.StateSpace"),
    (made(impc.Plant, [[1]], MATRIX), ImpcError, r"system: .* pass control.ss\(A, B, C, D, dt\)"),
    (lambda: impc.Plant(control.ss(-1, 1, 1, 0)).require_discrete(), PlantError, "is continuous"),
    (made(impc.Recording, PLANT, ENDS), InputError,
     "outputs: are NaN from sample 3 on; cut them there"),
    (made(impc.Recording, PLANT, np.ones((2, 9))), ImpcError, r"transpose it: outputs.T"),
    (made(impc.load, "a\0b"), ImpcError, "path: has a zero byte"),
    (made(impc.load, "x" * 5000), ImpcError, "File name too long"),
    (made(impc.read_table, "\ud800.csv"), ImpcError, "give a name that is text"),
    (made(impc.read_table, None), ImpcError, "path: got None; give a path"),
    (made(impc.read_recordings, [], None, PLANT), ImpcError, "configuration: expected a Conf"),
    (made(impc.Structure, PLANT, ["1e-320 x[0]"]), ImpcError,
     "has a factor of .*scale it to about 1"),
]  # fmt: skip


@pytest.mark.parametrize("index", range(len(WRONG)), ids=lambda index: WRONG[index][2][:30])
def test_a_wrong_call_says_what_to_do(index: int) -> None:
    call, error, said = WRONG[index]
    with pytest.raises(error, match=said) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_a_value_made_by_hand_is_checked_and_not_the_callers() -> None:
    Q = np.eye(2)
    made = impc.Weights(Q, [[1]])
    Q[0, 0] = 5.0
    assert made.Q[0, 0] == 1.0
    assert made.R.dtype == np.float64
    wrong: Any
    for wrong in ("text", np.eye(3)[:2], np.full((2, 2), np.nan)):
        with pytest.raises(InputError, match="Q: "):
            impc.replace(made, Q=wrong)
    with pytest.raises(InputError, match="B: expected shape"):
        impc.replace(PLANT, B=np.ones((3, 1)))
    with pytest.raises(DataError, match="B: has shape"):  # unchanged fields no longer agree
        impc.replace(PLANT, A=np.eye(3))


def test_an_annotation_that_is_not_in_the_table_is_told_at_import() -> None:
    def function(x: bytearray) -> None: ...

    with pytest.raises(TypeError, match="bytearray is not known"):
        checked(function)
    assert isinstance(PLANT, impc.Plant)
