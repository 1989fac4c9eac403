"""Cost structures: features by name, their weights, and rejected input."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

from impc.errors import ImpcError, InputError, WeightsError
from impc.model.combinations import linear_combination
from impc.model.plant import Plant
from impc.model.structure import Structure
from tests.support import extrapolated_slope

NAMES = ("a", "a_rate", "b", "x[0]", "1st")


@pytest.fixture(scope="module")
def plant() -> Plant:
    """Three states, of which p and v are unstable; two inputs, one output p - w."""
    A = [[1.1, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.5]]
    system = control.ss(
        A, np.eye(3, 2), [[1, 0, -1]], 0, 1, states=["p", "v", "w"], inputs=["f", "g"],
        outputs=["y"],
    )  # fmt: skip
    return Plant(system, ["f", "g"])


@pytest.mark.parametrize(
    ("text", "row"),
    [
        ("a", [1, 0, 0, 0, 0]),
        ("a_rate", [0, 1, 0, 0, 0]),
        (" - a+ b ", [-1, 0, 1, 0, 0]),
        ("b - 0.5 a - .5*a", [-1, 0, 1, 0, 0]),
        ("2e-1 x[0] + 1st", [0, 0, 0, 0.2, 1]),
        ("3 1st", [0, 0, 0, 0, 3]),
    ],
)
def test_combinations_are_read(text: str, row: list[float]) -> None:
    np.testing.assert_allclose(linear_combination(text, NAMES), row, rtol=1e-15)


@pytest.mark.parametrize(
    "text", ["", "c", "a b", "a +", "2", "a - a", "a*b", "__import__('os')", "a(1)", "a_", "+-a"]
)
def test_what_is_no_combination_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"^feature ") as caught:
        linear_combination(text, NAMES)
    assert "\n" not in str(caught.value)


def test_prices_of_features_one_by_one(plant: Plant) -> None:
    """Against the cost itself, at random states and inputs."""
    shape = Structure(plant, ["p", "v - 2 p"], ["f", "f + g"])
    assert (shape.count, shape.unknowns) == (3, ("p", "v - 2 p", "f + g"))
    found = shape.weights(np.log([3.0, 5.0, 7.0]))
    rng = np.random.default_rng(0)
    for x, u in zip(rng.normal(size=(4, 3)), rng.normal(size=(4, 2)), strict=True):
        cost = 3 * x[0] ** 2 + 5 * (x[1] - 2 * x[0]) ** 2 + u[0] ** 2 + 7 * (u[0] + u[1]) ** 2
        assert x @ found.Q @ x + u @ found.R @ u == pytest.approx(cost, rel=1e-12)
    nothing = shape.weights(np.array([0.0, -np.inf, 0.0]))
    np.testing.assert_allclose(nothing.Q, np.diag([1.0, 0.0, 0.0]))


def test_named_structures(plant: Plant) -> None:
    def shape(*given: Any, **more: Any) -> tuple[str, int, tuple[str, ...]]:
        made = Structure(plant, *given, **more)
        return made.name, made.count, made.labels

    assert shape() == ("diagonal", 4, ("p", "v", "w"))
    assert shape("full", "full") == ("full", 6 + 2, ("p", "v", "w"))
    assert shape("full", over=["p", "v"]) == ("full over p, v", 4, ("p", "v"))
    assert shape("outputs", ["f", "g"])[2] == ("y",)
    assert shape(["p", "v"], name="mine")[0] == "mine"
    full = Structure(plant, "full", "full")
    assert full.unknowns[3:] == ("p with v", "p with w", "v with w", "g", "f with g")
    assert full.is_cost_weight.tolist() == [True, True, True, False, False, False, True, False]


@pytest.mark.parametrize("given", [("full", "full"), ("diagonal", "diagonal"), (["p", "v-p"],)])
def test_changes_are_derivatives(plant: Plant, given: tuple[Any, ...]) -> None:
    shape = Structure(plant, *given)
    z = np.random.default_rng(1).normal(size=shape.count)
    dQ, dR = shape.changes(z)
    values, chain = shape.reported(z)
    weights = shape.weights(z)
    if shape.coupled:  # what is identified, from the weights themselves: all states are features
        d = np.sqrt(np.diag(weights.Q))
        np.testing.assert_allclose(values[:3], 2 * np.log(d), rtol=1e-12)
        pairs = (weights.Q / np.outer(d, d))[np.tril_indices(3, -1)]
        np.testing.assert_allclose(values[3:6], pairs, rtol=1e-12)
    for index in range(shape.count):
        step = np.eye(shape.count)[index]

        def moved(h: float, step: np.ndarray = step) -> np.ndarray:
            found = shape.weights(z + h * step)
            identified = shape.reported(z + h * step)[0]
            return np.concatenate([found.Q.ravel(), found.R.ravel(), identified])

        exact = np.concatenate([dQ[index].ravel(), dR[index].ravel(), chain[:, index]])
        np.testing.assert_allclose(exact, extrapolated_slope(moved), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        ({"Q": "diagonl"}, InputError, "Q: got 'diagonl'"),
        ({"Q": 3}, InputError, "Q: got 3"),
        ({"Q": []}, InputError, "is empty"),
        ({"Q": ["p"], "over": ["v"]}, InputError, "over: needs diagonal or full"),
        ({"Q": "outputs", "over": ["v"]}, InputError, "over: needs diagonal or full"),
        ({"Q": ["p", "v", "p + v", "p - v"]}, InputError, "give the same weights; remove one"),
        ({"Q": "full", "over": ["p", "v", "p + v"]}, InputError, "give the same weights"),
        ({"Q": ["v", "w"]}, WeightsError, "leaves the mode 1.1, which does not decay by itself"),
        ({"R": ["f"]}, WeightsError, "R: leaves a combination of the inputs without a cost weight"),
        ({"R": "outputs"}, InputError, "R: got 'outputs'"),
        ({"Q": ["q"]}, InputError, "feature 'q': expected a name at 'q'"),
    ],
)
def test_what_cannot_be_a_structure_is_refused_in_a_line(
    plant: Plant, given: dict[str, Any], error: type[ImpcError], says: str
) -> None:
    with pytest.raises(error) as caught:
        Structure(plant, **given)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_price_beyond_all_numbers_is_refused(plant: Plant) -> None:
    with pytest.raises(WeightsError, match="overflows"):
        Structure(plant).weights(np.array([800.0, 0.0, 0.0, 0.0]))
