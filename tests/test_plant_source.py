"""Plants by import path and from files, and what is said of those that cannot be used."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.io

import plants
from impc.errors import ImpcError, InputError, PlantError
from impc.plant_source import make_plant, plant_family_of, plant_source

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


def test_a_free_parameter_of_the_seat() -> None:
    def make(J2: float = 1.0) -> object:
        return plants.seated_balance_plant(plants.SeatedBalanceParameters(J2=J2))

    source = plant_source("plants:seated_balance_plant", {})
    moving = type(source)("seat", make, {"J2": 1.3})
    family = plant_family_of(moving, ("perturbation",), ["J2"])
    assert family is not None
    assert family.nominal.tolist() == [1.3]


@pytest.mark.parametrize(
    ("name", "arguments", "says"),
    [
        ("seat", {}, "neither a known name, a file, nor module:function"),
        ("plants:no_such", {}, "cannot be imported"),
        ("no_such_module:f", {}, "cannot be imported"),
        ("plants:seated_balance_plant", {"weight": 3}, "refuses its arguments"),
        ("nowhere.mat", {}, "cannot be read"),
        ("nowhere.json", {}, "cannot be read"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_line(
    name: str, arguments: dict[str, object], says: str
) -> None:
    with pytest.raises(InputError, match=says) as caught:
        make_plant(plant_source(name, arguments), ())
    assert "\n" not in str(caught.value)


def test_files_that_hold_no_plant(tmp_path: Path) -> None:
    path = tmp_path / "plant.json"
    for text, says in (
        ('{"A": [[1]], "B": [[1]], "C": [[1]]}', "lacks dt"),
        ("[1, 2]", "holds no names"),
        ("{", "cannot be read"),
        ('{"A": [["x"]], "B": [[1]], "C": [[1]], "dt": 1}', "not made of numbers"),
        ('{"A": [[1]], "B": [[1, 2]], "C": [[1, 2]], "dt": 1}', "plant"),
    ):
        path.write_text(text)
        with pytest.raises(ImpcError, match=says) as caught:
            make_plant(plant_source(str(path), {}), ())
        assert "\n" not in str(caught.value)
    np.savez(tmp_path / "objects.npz", A=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="cannot be read"):
        plant_source(str(tmp_path / "objects.npz"), {})


def test_a_plant_without_a_command() -> None:
    source = plant_source("plants:seated_balance_plant", {})
    with pytest.raises(PlantError, match="all its inputs are recorded"):
        make_plant(source, ("command", "perturbation"))


def test_a_free_parameter_without_a_value() -> None:
    source = plant_source("plants:seated_balance_plant", {})
    with pytest.raises(InputError, match="no nominal value"):
        plant_family_of(source, (), ["mass"])


def test_what_a_function_returns_must_be_a_state_space() -> None:
    source = plant_source("builtins:dict", {})
    with pytest.raises(PlantError, match=r"expected a control\.StateSpace"):
        make_plant(source, ())
