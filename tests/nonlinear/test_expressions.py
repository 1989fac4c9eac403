"""Expressions of CasADi as functions: values, names, and what is refused."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from impc.errors import InputError
from impc.nonlinear.expressions import (
    function_of,
    names_of,
    require_influence,
    scalar,
    stacked,
    symbols_of,
    with_values,
)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_a_function_has_the_value_of_its_expression(kind: Any) -> None:
    x, u, d, p = kind.sym("x", 2), kind.sym("u"), kind.sym("d"), kind.sym("p")
    symbols = [symbols_of("x", x), symbols_of("u", u), symbols_of("d", d), [p]]
    made = function_of("next", ca.vertcat(x[1], p * x[0] + u * d), symbols, (2,))
    np.testing.assert_allclose(made([2, 3], 4, 5, 7).full().ravel(), [3, 7 * 2 + 4 * 5])


def test_values_take_the_place_of_parameters() -> None:
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p", 3)
    made = function_of(
        "f", x + p[0] * u + p[1] + 10 * p[2], [[x], [u], [], symbols_of("p", p)], (1,)
    )
    left = with_values(made, [1], np.array([2.0, np.nan, 3.0]))
    assert float(left(1, 5, [], 0.5)) == pytest.approx(1 + 2 * 5 + 0.5 + 30)


def test_names_of_scalars_and_of_the_entries_of_a_vector() -> None:
    assert names_of(symbols_of("x", ca.SX.sym("x", 2))) == ("x_0", "x_1")
    assert names_of([ca.MX.sym("x", 2), ca.MX.sym("v")]) == ("x[0]", "x[1]", "v")
    whole, rows = stacked({"cliff": ca.SX.sym("a", 2), "end": 1.0})
    assert whole.shape == (3, 1)
    assert rows == ("cliff[0]", "cliff[1]", "end")
    assert stacked({})[0].shape == (0, 1)


def test_what_is_no_function_is_refused() -> None:
    x, u, p, other = (ca.SX.sym(name) for name in "xupo")
    symbols = [[x], [u], [], [p]]
    for expression, words in (
        (x + other, "has the symbol o"),
        (ca.vertcat(x, u), r"has shape \(2, 1\); give \(1, 1\)"),
        (ca.MX.sym("y"), "give an expression of SX"),
    ):
        with pytest.raises(InputError, match=words):
            function_of("cost", expression, symbols, (1,))
    with pytest.raises(InputError, match="depends on an input"):
        function_of("end", x + u, symbols, (1,), alone=True)
    with pytest.raises(InputError, match="of SX and of MX"):
        function_of("cost", x, [[x], [ca.MX.sym("u")], [], [p]], (1,))
    with pytest.raises(InputError, match="not a scalar"):
        scalar("p", ca.SX.sym("p", 2))
    with pytest.raises(InputError, match="float, not symbols"):
        symbols_of("states", [1.0])


def test_a_parameter_that_is_in_no_expression_is_named() -> None:
    x, p, q = (ca.SX.sym(name) for name in "xpq")
    made = [function_of(name, p * x, [[x], [], [], [p, q]], (1,)) for name in ("f", "g")]
    require_influence(["p"], [function_of("f", p * x, [[x], [], [], [p]], (1,))])
    with pytest.raises(InputError, match="parameter q: is in no expression"):
        require_influence(["p", "q"], made)
