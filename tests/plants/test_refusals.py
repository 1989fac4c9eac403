"""Bad arguments of every plant are refused by name, in one line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import plants

CASES: list[tuple[Callable[..., Any], str, dict[str, Any]]] = [
    (plants.ternary_sequence, "length", {"length": -1}),
    (plants.ternary_sequence, "length", {"length": 2.5}),
    (plants.ternary_sequence, "seed", {"seed": -1}),
    (plants.ternary_torque, "amplitude", {"amplitude": -1.0}),
    (plants.ternary_torque, "dwell", {"dwell": 0.001}),
    (plants.ternary_torque, "duration", {"duration": 0.0}),
    (plants.ternary_torque, "rate", {"rate": float("inf")}),
    (plants.delayed_muscle, "delay", {"delay": 0.0, "time_constant": 0.06, "order": 5}),
    (plants.delayed_muscle, "time_constant", {"delay": 0.08, "time_constant": -1.0, "order": 5}),
    (plants.delayed_muscle, "order", {"delay": 0.08, "time_constant": 0.06, "order": 2.0}),
    (plants.from_anthropometry, "mass", {"mass": 0.0, "height": 1.66}),
    (plants.from_anthropometry, "mass", {"mass": "80", "height": 1.66}),
    (plants.from_anthropometry, "height", {"mass": 79.7, "height": 166}),
    (plants.from_anthropometry, "sex", {"mass": 79.7, "height": 1.66, "sex": "man"}),
    (plants.seated_balance_plant, "sample_time", {"sample_time": 0.0}),
    (plants.seated_balance_plant, "order", {"delay_order": 21}),
    (plants.seated_balance_for, "k_q", {"k_q": 1.0}),
    (plants.seated_balance_for, "k_h", {"k_h": -1.0}),
    (plants.runge_kutta_step, "substeps", {"dynamics": None, "step": 0.01, "substeps": 0}),
    (plants.cursor_plant, "delay", {"delay": 0}),
    (plants.cursor_plant, "lag", {"lag": -1}),
    (plants.cursor_plant, "sample_time", {"sample_time": 0}),
    (plants.cursor_plant, "order", {"delay_order": -1}),
    (plants.pursuit_plant, "delay", {"delay": 0}),
    (plants.pursuit_plant, "delay", {"delay": 1.5}),
    (plants.pursuit_plant, "delay", {"delay": True}),
    (plants.pursuit_plant, "lag", {"lag": 0}),
    (plants.pursuit_plant, "sample_time", {"sample_time": -1}),
    (plants.head_neck_matrices, "axis", {"axis": "roll"}),
    (plants.head_neck_plant, "values", {"values": [1.0]}),
    (plants.head_neck_plant, "Kvis", {"values": np.full(12, np.nan)}),
]


@pytest.mark.parametrize(("make", "name", "arguments"), CASES)
def test_bad_arguments_are_refused_by_name(
    make: Callable[..., Any], name: str, arguments: dict[str, Any]
) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: .+; .+") as error:
        make(**arguments)
    assert "\n" not in str(error.value)
