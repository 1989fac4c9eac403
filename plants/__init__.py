"""Plants as `control.StateSpace` with named signals and units; independent of impc."""

from plants.actuation import delayed_muscle, pade_delay
from plants.anthropometry import from_anthropometry
from plants.cursor import cursor_plant, pursuit_plant
from plants.head_neck import (
    HEAD_NECK_FIXED,
    HEAD_NECK_PARAMETERS,
    TABLE_4_3,
    HeadNeckParameter,
    head_neck_matrices,
    head_neck_model,
    head_neck_plant,
    step_reference,
    table_4_3_column,
)
from plants.integration import runge_kutta_step
from plants.named_examples import yalmip_example
from plants.seated_balance import (
    body_dynamics,
    continuous_seated_balance_plant,
    nonlinear_dynamics,
    seated_balance_plant,
)
from plants.seated_parameters import SeatedBalanceParameters
from plants.seated_subject import seated_balance_for, seated_balance_step_for, seated_parameters_for
from plants.ternary import ternary_sequence, ternary_torque

__all__ = [
    "HEAD_NECK_FIXED",
    "HEAD_NECK_PARAMETERS",
    "TABLE_4_3",
    "HeadNeckParameter",
    "SeatedBalanceParameters",
    "body_dynamics",
    "continuous_seated_balance_plant",
    "cursor_plant",
    "delayed_muscle",
    "from_anthropometry",
    "head_neck_matrices",
    "head_neck_model",
    "head_neck_plant",
    "nonlinear_dynamics",
    "pade_delay",
    "pursuit_plant",
    "runge_kutta_step",
    "seated_balance_for",
    "seated_balance_plant",
    "seated_balance_step_for",
    "seated_parameters_for",
    "step_reference",
    "table_4_3_column",
    "ternary_sequence",
    "ternary_torque",
    "yalmip_example",
]
