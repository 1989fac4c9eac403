"""What is given to public functions: wrong things are told in a line, the same things work."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import control
import numpy as np
import pandas as pd
import pytest

from impc.arrays import Frozen, as_numbers
from impc.checking import checked, replace
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.errors import DataError, ImpcError, InputError
from impc.files.formats import read_table
from impc.files.reading import read_recordings
from impc.files.results import read_result
from impc.files.table import make_table
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.structure import Structure
from impc.model.weights import Weights
from tests.wrong_arguments import calls, values, wrong_values

# Calls of more than half a second: numbers that mean something are left out.
SLOW = (
    *("infer_weights", "inverse_mpc_reduced", "starting_point", "fit_gain", "fit_controller"),
    "fit_optimal_control",
)
PLANT = Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, True))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # overflow of what is 1e308
def test_a_wrong_argument_is_one_line() -> None:
    """Of 12 000 calls 340 mean something and run; all others end in the package's own error."""
    wrong = []
    for function, right in calls():
        for name, given in right.items():
            for label, value in wrong_values().items():
                if function.__name__ in SLOW and (value is given or _is_number(value)):
                    continue
                said = _what_is_said(function, {**right, name: value})
                if said is not None:
                    wrong.append(f"{function.__name__}, {name} = {label}: {said}")
    assert not wrong


def _what_is_said(function: Callable[..., object], given: dict[str, Any]) -> str | None:
    """What is wrong with how a call ends; None when it works, or in a line of the package's."""
    try:
        function(**given)
    except ImpcError as error:
        said = str(error)
        return said if "\n" in said or len(said) > 300 else None
    except Exception as error:  # whatever it is, it is the wrong one
        return repr(error)
    return None


def _is_number(value: object) -> bool:
    scalar = isinstance(value, np.ndarray) and value.ndim == 0
    return scalar or value is None or isinstance(value, (int, float, np.number))


def test_right_arguments_are_right() -> None:
    for function, right in calls():
        if function.__name__ not in SLOW:
            function(**right)


def test_an_error_names_its_argument() -> None:
    box = Bounds(PLANT, u_max=1)
    pair = Weights(np.eye(2), 1)
    for call, words in (
        (lambda: Controller(None, pair, box, 4), "plant: expected a Plant, got None; make it"),  # type: ignore[arg-type]
        (lambda: Controller(PLANT, box, box, 4), "weights: expected a Weights, got Bounds"),  # type: ignore[arg-type]
        (lambda: Controller(PLANT, pair, box, 4.0), "horizon: got 4.0; give a whole number"),  # type: ignore[arg-type]
        (lambda: Controller(PLANT, pair, box, 5001), "horizon: got 5001; give a whole number"),
        (lambda: Controller(PLANT, pair, box, 2**63), "horizon: is beyond 2147483647"),
        (lambda: Controller(PLANT, Weights(np.eye(3), 1), box, 4),
         "weights: has 3 states, what stands before it 2; give values of one plant"),
        (lambda: Weights([[1, 2], [3]], 1), "Q: expected real numbers, got list"),
        (lambda: Weights(np.eye(2) * 1j, 1), "Q: expected real numbers, got an array"),
        (lambda: Bounds(PLANT, u_max=["1"]), "u_max: expected real numbers, got an"),
        (lambda: Bounds(PLANT, x_max={"v": 1.0}), "x_max: there is no 'v'; choose of "),
        (lambda: Bounds(PLANT, x_max={PLANT.states[0]: "1"}), "']: got '1'; give a number"),  # type: ignore[dict-item]
        (lambda: Recording(PLANT, np.r_[np.ones((3, 2)), np.full((2, 2), np.nan)]),
         "outputs: end at sample 3, and NaN follows; a simulation that ended has no more"),
    ):  # fmt: skip
        with pytest.raises(InputError) as caught:
            call()
        assert words in str(caught.value)


def test_what_means_the_same_is_welcome() -> None:
    outputs = np.round(np.random.default_rng(0).normal(size=(20, 2)), 2).astype(np.float32)
    expected = Recording(PLANT, outputs.astype(float)).outputs
    frame = pd.DataFrame(outputs, columns=["x", "y"])
    for given in (outputs, outputs.tolist(), frame, np.ma.masked_array(outputs), tuple(outputs)):
        np.testing.assert_array_equal(Recording(PLANT, given).outputs, expected)
    np.testing.assert_array_equal(Recording(PLANT, frame.astype("Float32")).outputs, expected)
    named = Bounds(PLANT, x_min={PLANT.states[1]: -2}, u_max={PLANT.controls[0]: 1})
    np.testing.assert_array_equal(named.x_min, [-np.inf, -2])
    np.testing.assert_array_equal(named.u_max, [1])
    one = Controller(PLANT, Weights(np.eye(2), 1), Bounds(PLANT, u_max=[1]), 4)
    other = Controller(
        PLANT,
        Weights(pd.DataFrame(np.eye(2, dtype=int)), np.float32(1)),
        Bounds(PLANT, u_max=pd.Series([1], dtype="Int64")),
        np.int8(4),  # type: ignore[arg-type]
        terminal_set=np.bool_(True),  # type: ignore[arg-type]
    )
    np.testing.assert_array_equal(one.K, other.K)
    assert type(other.horizon) is int
    huge = as_numbers("whole", [2**70, 3])
    np.testing.assert_array_equal(huge, [2.0**70, 3.0])


def test_masked_samples_are_missing_not_data() -> None:
    outputs = np.ma.masked_array(np.ones((20, 2)))
    outputs[7, 1] = 1e6
    outputs[7, 1] = np.ma.masked
    with pytest.raises(DataError, match=r"1 of 40 entries are NaN or infinite.*\(7, 1\)"):
        Recording(PLANT, outputs)
    with pytest.raises(DataError, match="NaN or infinite"):
        scenario(PLANT, np.ma.masked_array([1.0, 2.0], mask=[False, True]), 10)
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
    made += [copy.copy(value), copy.deepcopy(value), replace(value)]
    for one in made:
        assert type(one) is type(value)
        for array, same in zip(arrays_of(one), arrays_of(value), strict=True):
            np.testing.assert_array_equal(array, same)
            if name != "simulation":
                assert not array.flags.writeable
    assert arrays_of(value)


def test_columns_of_a_table_are_numbers_and_what_is_masked_is_missing() -> None:
    given = np.ma.masked_array([0.1, 0.2, -999.0, 0.4], mask=[False, False, True, False])
    found = make_table(
        "lab", {"angle": given, "none": np.ma.masked_array(np.ones(4), mask=True)}
    ).columns
    np.testing.assert_array_equal(found["angle"], [0.1, 0.2, np.nan, 0.4])
    assert np.isnan(found["none"]).all()
    frame: Any = pd.DataFrame({"a": [1, 2]})
    assert make_table("lab", frame).columns["a"].tolist() == [1.0, 2.0]
    for wrong in ({"a": "xy"}, [1, 2], {"a": [[1.0]]}, {1: [1.0]}, {"a": [1j, 2]}):
        with pytest.raises(ImpcError):
            make_table("lab", wrong)  # type: ignore[arg-type]


MATRIX: Any = [[1.0]]
WRONG_CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "no square": (lambda: Weights([5, 2], 0.1), r"Q: expected a square .* np.diag\(\[5.0, 2.0\]\)"),
    "empty": (
        lambda: Weights(np.zeros((0, 0)), 1),
        r"Q: expected a square matrix, got shape \(0, 0\)",
    ),
    "matrices": (lambda: Plant([[1]], MATRIX), r"system: .* pass control.ss\(A, B, C, D, dt\)"),
    "turned": (lambda: Recording(PLANT, np.ones((2, 9))), r"transpose it: outputs.T"),
    "too few": (lambda: Weights([[1]]), "Weights: missing a required argument: 'R'"),  # type: ignore[call-arg]
    "too many": (lambda: Weights([[1]], 1, 1), "too many positional arguments"),  # type: ignore[call-arg]
    "unknown": (lambda: Weights([[1]], R=1, S=1), "unexpected keyword argument 'S'"),  # type: ignore[call-arg]
    "NUL": (lambda: read_result("a\0b"), "path: has a zero byte"),
    "long": (lambda: read_result("x" * 5000), "File name too long"),
    "no text": (lambda: read_table("\ud800.csv"), "give a name that is text"),
    "no path": (lambda: read_table(None), "path: got None; give a path"),  # type: ignore[arg-type]
    "no settings": (lambda: read_recordings([], None, PLANT), "configuration: expected a Conf"),  # type: ignore[arg-type]
    "on one side": (lambda: Bounds(PLANT, u_min=0, u_max=1), "leave u.* no room on one side of 0"),
    "tiny": (lambda: Structure(PLANT, ["1e-320 x[0]"]), "has a factor of .*scale it to about 1"),
}


@pytest.mark.parametrize("name", WRONG_CALLS)
def test_a_wrong_call_says_what_to_do(name: str) -> None:
    call, said = WRONG_CALLS[name]
    with pytest.raises(ImpcError, match=said):
        call()


def test_a_value_made_by_hand_is_checked_and_not_the_callers() -> None:
    Q = np.eye(2)
    made = Weights(Q, [[1]])
    Q[0, 0] = 5.0
    assert made.Q[0, 0] == 1.0
    assert made.R.dtype == np.float64
    wrong: Any
    for wrong in ("text", np.eye(3)[:2], np.full((2, 2), np.nan)):
        with pytest.raises(InputError, match="Q: "):
            replace(made, Q=wrong)
    with pytest.raises(InputError, match="B: expected shape"):
        replace(PLANT, B=np.ones((3, 1)))


def test_a_pickled_controller_simulates_the_same() -> None:
    law, drive = values()["controller"], values()["scenario"]
    again = pickle.loads(pickle.dumps(law))
    np.testing.assert_array_equal(simulate(again, drive).x, simulate(law, drive).x)


def test_an_annotation_that_is_not_in_the_table_is_told_at_import() -> None:
    def function(x: bytearray) -> None: ...

    with pytest.raises(TypeError, match="bytearray is not in the table"):
        checked(function)
    assert isinstance(PLANT, Plant)
