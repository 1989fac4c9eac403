"""
A nonlinear problem of your own, from file to report
====================================================

A subject swings up a pole that hangs from a cart, and impc finds masses, limit and cost weight.

.. image:: images/sphx_glr_optimal_control_001.svg
   :alt: recorded and fitted movement of cart and pole, with the force

Two masses, the limit of the force and the cost weight of the angle are unknown. The recording holds
position, angle and force, but no speed. The problem is a function in CasADi, and a TOML file says
what the columns mean.
"""

from terminal import RESULTS, show, terminal, write

# %%
# **The problem**: states, inputs and parameters are symbols with names; dynamics, cost and limits
# are expressions. The cost weight of force is 1, which fixes the scale of the others. ``units``
# and ``dt`` let impc check the columns and the clock of a recording.
write(
    "swing.py",
    '''\
"""A pole that is swung up by a cart of unknown mass, with a limited force."""

import casadi as ca

import impc


def swing_up(length=1.0, horizon=30):
    """Return the problem; length of the pole in m, horizon in samples of 0.1 s."""
    place, angle, speed, rate = x = [ca.SX.sym(n) for n in ("place", "angle", "speed", "rate")]
    force = ca.SX.sym("force")
    cart, pole, limit, weight = (ca.SX.sym(n) for n in ("cart", "pole", "limit", "weight"))

    push = force + pole * ca.sin(angle) * (length * rate**2 + 9.81 * ca.cos(angle))
    acceleration = push / (cart + pole * ca.sin(angle) ** 2)
    turning = -(acceleration * ca.cos(angle) + 9.81 * ca.sin(angle)) / length
    derivative = ca.vertcat(speed, rate, acceleration, turning)
    cost = weight * (angle - ca.pi) ** 2 + 0.5 * (place**2 + speed**2 + rate**2)
    return impc.OptimalControlProblem(
        x,
        force,
        {"cart": cart, "pole": pole, "limit": limit, "weight": weight},
        next_state=ca.vertcat(*x) + 0.1 * derivative,
        stage_cost=cost + force**2,
        terminal_cost=cost,
        constraints={"force": ca.vertcat(force - limit, -force - limit)},
        horizon=horizon,
        dt=0.1,
        units={
            "cart": "kg", "pole": "kg", "limit": "N", "place": "m", "angle": "rad",
            "speed": "m/s", "rate": "rad/s", "force": "N",
        },
    )
''',
)

# %%
# **A recording** of one swing, with noise, in centimetres and degrees. Replace this block with
# your data.
import sys

import numpy as np

sys.path.insert(0, str(RESULTS))
from swing import swing_up

truth = {"cart": 0.5, "pole": 0.4, "limit": 4.0, "weight": 20.0}
plan = swing_up().plan(truth, [0, 0, 0, 0])
rng = np.random.default_rng(3)
recorded = np.column_stack(
    [
        0.1 * np.arange(31),
        100 * (plan.x[:, 0] + 0.01 * rng.standard_normal(31)),
        np.degrees(plan.x[:, 1] + 0.02 * rng.standard_normal(31)),
        np.append(plan.u + 0.05 * rng.standard_normal((30, 1)), np.nan),
    ]
)
np.savetxt(
    RESULTS / "swing.csv",
    recorded,
    delimiter=",",
    header="t,cart,pole,motor",
    comments="",
    fmt="%.6g",
)

# %%
# **The configuration** says what the columns mean and where the search starts. With
# ``recorded = "plan"`` the whole recording is one optimum; with ``"loop"`` the subject plans again
# at every sample. A parameter has a ``start``, or it is ``known``. The speeds were not recorded:
# ``x0`` gives their first values, which are estimated too unless ``unknown_start = false``.
write(
    "swing.toml",
    """\
[recording]
time = "t"

[signals.place]
column = "cart"
unit = "cm"

[signals.angle]
column = "pole"
unit = "deg"

[signals.force]
column = "motor"
unit = "N"

[plant]
length = 1.0

[fit]
recorded = "plan"
unknown_start = false
x0 = { place = 0.0, angle = 0.0, speed = 0.0, rate = 0.0 }

[fit.parameters]
cart = { start = 600.0, unit = "gram" }
pole = { start = 0.35 }
limit = { start = 5.0 }
weight = { start = 15.0 }
""",
)

# %%
# **The fit.** ``--plant`` names the module to import and the function to call. Files cannot do
# that.
terminal("impc fit swing.csv --plant swing:swing_up --config swing.toml --out swing-fit")
show("swing-fit/figures/movement.svg")

# %%
# Estimate, interval, and true value of each parameter:
import impc

for one in impc.load(RESULTS / "swing-fit").table("parameters").itertuples():
    print(
        f"{one.parameter:6} {one.value:8.4f}  {one.low:8.4f} to {one.high:8.4f}  "
        f"{truth[one.parameter]:6}"
    )

# %%
# If a recording identifies only combinations of parameters, the report names them
# (:doc:`/howto/nonlinear`). A fault in a file ends in one line:
(RESULTS / "far.toml").write_text(
    (RESULTS / "swing.toml").read_text().replace("angle = 0.0", "angel = 0.0")
)
terminal("impc fit swing.csv --plant swing:swing_up --config far.toml --out far", status=2)
