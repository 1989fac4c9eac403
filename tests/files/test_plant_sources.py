"""Plants by import path and from files, and the errors of invalid ones."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
import scipy.io

from impc.errors import ImpcError, InputError, PlantError
from impc.files.plant_sources import (
    Parameter,
    PlantSource,
    import_function,
    make_plant,
    plant_family_of,
    plant_source,
)
from plants import seated_balance_for
from tests.files.samples import mat5_array, mat5_element, mat5_file

A, B, C = [[1.0, 0.1], [0.0, 1.0]], [[0.005, 0.0], [0.1, 0.1]], [[1.0, 0.0]]


def test_an_import_path_with_arguments() -> None:
    source = plant_source("plants:seated_balance_plant", {"delay_order": 3})
    plant = make_plant(source, ("theta1", "theta2", "perturbation"))
    assert plant.n == 8
    assert plant.controls == ("command",)
    assert plant.disturbances == ("perturbation",)
    assert make_plant(source, ("perturbation",), delay_order=2).n == 7


def test_a_module_beside_the_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "import control\ndef cart(mass=2.0):\n    return control.ss(1, 1 / mass, 1, 0, 0.1)\n"
    (tmp_path / "mine_for_the_test.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    source = plant_source("mine_for_the_test:cart", {})
    assert make_plant(source, ()).B[0, 0] == 0.5
    family = plant_family_of(source, (), ["mass"])
    assert family is not None
    assert family.nominal.tolist() == [2.0]
    assert family.make(np.array([4.0])).B[0, 0] == 0.25


def test_the_working_folder_is_last_and_not_left_on_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user's module finds its neighbours, and replaces no installed module."""
    (tmp_path / "mine_of_two.py").write_text(
        "import neighbour_of_mine, statsmodels\nmake = neighbour_of_mine.make\n"
    )
    (tmp_path / "neighbour_of_mine.py").write_text(
        "import sys\nwhere = sys.path[-1]\ndef make(): return None\n"
    )
    for name in ("plants", "statsmodels"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "statsmodels", raising=False)
    path = list(sys.path)
    found = import_function("mine_of_two:make")
    assert sys.modules[found.__module__].where == str(tmp_path)
    assert sys.path == path
    assert import_function("plants:cursor_plant").__module__ == "plants.cursor"
    with pytest.raises(InputError, match="rename yours: an installed module has its name"):
        import_function("plants:mine")


class OwnInterrupt(KeyboardInterrupt):
    """A KeyboardInterrupt that does not come from the keyboard."""


@pytest.mark.parametrize(
    "error",
    [
        SystemExit(0), MemoryError(), RecursionError("too deep"), OwnInterrupt("a\nb"),
        GeneratorExit(), StopIteration(), ZeroDivisionError("division by zero"),
        UserWarning("look"), OverflowError("too large"), AttributeError("none"),
    ],
    ids=lambda error: type(error).__name__,
)  # fmt: skip
def test_whatever_a_plant_raises_is_one_line_that_names_it(error: BaseException) -> None:
    def make() -> object:
        raise error

    with pytest.raises(InputError, match=rf"^plant mine:make: raised {type(error).__name__}") as e:
        make_plant(PlantSource("mine:make", make, {}), ())
    assert str(e.value).isprintable()


def test_the_keyboard_interrupts_a_plant() -> None:
    def make() -> object:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_plant(PlantSource("mine:make", make, {}), ())


def test_a_module_that_ends_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ending_plant.py").write_text("import sys\nsys.exit(0)\n")
    (tmp_path / "broken_plant.py").write_text("def cart(:\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="plant ending_plant:x: raised SystemExit"):
        plant_source("ending_plant:x", {})
    with pytest.raises(InputError, match="plant broken_plant:x: raised SyntaxError"):
        plant_source("broken_plant:x", {})


@pytest.mark.parametrize("suffix", ["mat", "npz", "json"])
def test_a_saved_state_space(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"plant.{suffix}"
    matrices = {"A": A, "B": B, "C": C, "D": [[0.0, 0.0]], "dt": 0.1}
    if suffix == "mat":
        names = np.array(["force", "push"], dtype=object)
        scipy.io.savemat(path, {**matrices, "inputs": names})
    elif suffix == "npz":
        np.savez(path, A=A, B=B, C=C, D=[[0.0, 0.0]], dt=0.1)
    else:
        path.write_text(json.dumps(matrices))
    given = {} if suffix == "mat" else {"inputs": ["force", "push"]}
    plant = make_plant(plant_source(str(path), given), ("push",))
    np.testing.assert_array_equal(plant.A, A)
    np.testing.assert_array_equal(plant.E[:, 0], np.array(B)[:, 1])
    assert plant.controls == ("force",)
    assert plant.dt == 0.1


def saved(**changed: object) -> Callable[[Path], str]:
    """A JSON file with these entries changed."""
    content = json.dumps({"A": A, "B": B, "C": C, "dt": 0.1, **changed}).encode()
    return written("plant.json", content)


def written(name: str, content: bytes) -> Callable[[Path], str]:
    def write(folder: Path) -> str:
        (folder / name).write_bytes(content)
        return str(folder / name)

    return write


def arrays(name: str, **changed: object) -> Callable[[Path], str]:
    """A file of matrices, .mat or .npz."""

    def write(folder: Path) -> str:
        save: Any = scipy.io.savemat if name.endswith("mat") else np.savez_compressed
        given = {"A": A, "B": B, "C": C, "dt": 0.1, **changed}
        content = io.BytesIO()
        save(content, given) if name.endswith("mat") else save(content, **given)
        return written(name, content.getvalue())(folder)

    return write


def pipe(folder: Path) -> str:
    os.mkfifo(folder / "pipe.json")
    return str(folder / "pipe.json")


# A type that does not exist.
CRASH = mat5_file(mat5_array(6, (3, 3), "A", mat5_element(200, bytes(72))))
NO_PLANT: list[tuple[str | Callable[[Path], str], str]] = [
    ("seat", "neither a known name, a file, nor module:function"),
    (".here:f", "neither a known name, a file, nor module:function"),
    ("plants:no_such", "cannot be imported"),
    ("no_such_module:f", "cannot be imported"),
    ("builtins:dict", r"expected a control\.StateSpace"),
    ("nowhere.mat", "does not exist"),
    ("nowhere.json", "does not exist"),
    (written("plant.json", b'{"A": [[1]], "B": [[1]], "C": [[1]]}'), "lacks dt"),
    (written("plant.json", b"[1, 2]"), "has no named entries"),
    (written("plant.json", b"{"), "cannot be read"),
    (written("deep.json", b"[" * 100_000), "nested too deep"),
    (written("digits.json", b'{"A": ' + b"1" * 5000 + b"}"), "cannot be read"),
    (written("bytes.json", b"\xff"), "cannot be read"),
    (written("none.json", b""), "is empty"),
    (written("cut.npz", b"PK\x03\x04" + bytes(200)), "cannot be read"),
    (written("crash.mat", CRASH), "ends the process"),
    (arrays("bomb.npz", A=np.zeros(10_000_000)), "too large once it is unpacked"),
    (pipe, "is not a regular file"),
    (arrays("objects.npz", A=np.array([{"a": 1}], dtype=object)), "cannot be read"),
    (saved(A=[["x"]]), "not a matrix of numbers"),
    (saved(B=[[1, 2]], C=[[1, 2]]), "plant"),
    (saved(states=["x", "v", "a"]), "names 3 states, but has 2"),
    (saved(states=["x"]), "names 1 states, but has 2"),
    (saved(inputs=["force"]), "names 1 inputs, but has 2"),
    (saved(outputs=["x", "y"]), "names 2 outputs, but has 1"),
    (saved(states=["x", "x"]), "names two states 'x'"),
    (saved(states={"x": 1}), "that are not names"),
    (saved(states=[["x"], []]), "names 1 states"),
    (saved(states=["x", None]), "that are not names"),
    (saved(**{"state\x1bs": ["x", "v"]}), r"has an unknown entry state\\x1bs"),
    *(
        (arrays(f"plant.{ending}", **changed), says)
        for ending in ("mat", "npz")
        for changed, says in (
            ({"A": np.array(A) + 1j}, "complex"),
            ({"D": np.array([[1j, 0]])}, "complex"),
            ({"dt": 0.1 + 1j}, "complex"),
            ({"dt": np.inf}, r"beyond 1e\+70 in dt"),
            ({"A": 1e200 * np.array(A)}, r"beyond 1e\+70 in A"),
            ({"dt": [0.1, 0.2]}, "dt that is not one number"),
            ({"C": np.array([["1", "0"]])}, "not a matrix of numbers"),
            ({"A": np.array([A, A])}, "not a matrix of numbers"),
        )
    ),
]


@pytest.mark.parametrize(("name", "says"), NO_PLANT)
def test_what_is_no_plant_is_one_line(
    name: str | Callable[[Path], str], says: str, tmp_path: Path
) -> None:
    with pytest.raises(ImpcError, match=says) as caught:
        make_plant(plant_source(name if isinstance(name, str) else name(tmp_path), {}), ())
    assert "\n" not in str(caught.value)


def test_what_does_not_go_with_a_plant() -> None:
    source = plant_source("plants:seated_balance_plant", {})
    with pytest.raises(PlantError, match="all its inputs are recorded"):
        make_plant(source, ("command", "perturbation"))
    with pytest.raises(InputError, match="no nominal value"):
        plant_family_of(source, (), ["mass"])
    with pytest.raises(InputError, match="refuses its arguments"):
        make_plant(plant_source("plants:seated_balance_plant", {"weight": 3}), ())

    def complex_plant() -> object:
        return control.ss(np.array([[0.5 + 1j]]), 1, 1, 0, 0.1)

    with pytest.raises(PlantError, match="has complex matrices"):
        make_plant(PlantSource("mine", complex_plant, {}), ())


def test_a_plant_describes_its_arguments_and_parameters() -> None:
    source = plant_source("plants:seated_balance_for", {"mass": "?"})
    found = {one.name: one for one in source.parameters()}
    assert [*found] == [*source.defaults(), *seated_balance_for().parameters]
    assert found["mass"] == Parameter("mass", "body mass", "kg", 79.7, None, (), True)
    assert found["sex"].choices == ("male", "female")
    assert [name for name, one in found.items() if one.own] == ["mass", "height"]
    assert (found["k_h"].unit, found["k_h"].deviation) == ("N m/rad", "35 %")
    for one in (*found.values(), *plant_source("plants:cursor_plant", {}).parameters()):
        assert one.words != one.name
        assert one.unit or one.name in ("sex", "delay_order", "length")


def stating(**stated: Any) -> PlantSource:
    def rod(length: float = 0.7) -> Any:
        system = control.ss(0.5, 1, 1, 0, 0.1)
        vars(system).update(stated)
        return system

    return PlantSource("mine:rod", rod, {})


def test_a_plant_that_describes_nothing_or_a_part() -> None:
    assert stating().parameters() == (Parameter("length", "length", "", 0.7, None, (), False),)
    numpy = {"uncertainty": {"length": np.float64(0.1)}, "parameters": {"drag": np.float32(2)}}
    length, drag = stating(**numpy, arguments={"length": ("rod",)}).parameters()
    assert (length.words, length.unit, length.deviation) == ("rod", "", 0.1)
    assert (drag.name, drag.value) == ("drag", 2.0)


@pytest.mark.parametrize(
    ("kind", "given"),
    [
        *(("arguments", one) for one in (["length"], {"length": "rod"}, {"length": ("rod", 3)},
          {3: ("rod", "m")}, {"length": ("x" * 1000, "m")}, dict.fromkeys(map(str, range(10**6))))),
        *(("uncertainty", {"length": one}) for one in (True, [0.1])),
        ("parameters", {"drag": object()}),
    ],
)  # fmt: skip
def test_what_a_plant_cannot_state_is_one_line(kind: str, given: Any) -> None:
    with pytest.raises(InputError, match=f"^plant mine:rod {kind}: .*; correct ") as caught:
        stating(**{kind: given}).parameters()
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)
