"""
A plant of your own
===================

Whoever moves something else than a seat describes it in one Python function. Here a hand holds a
stick upright: the outputs are the stick's angle and the hand's position, the control is the
hand's acceleration, and somebody pushes the stick.
"""

from terminal import show, terminal, write

# %%
# **The plant**: a discrete ``control.StateSpace`` with names for its states, inputs and outputs.
# Inputs that are recorded are disturbances, the others are the person's control. Arguments have
# defaults.
write(
    "stick.py",
    '''\
"""A stick of a given length on a hand that moves sideways, sampled 50 times a second."""

import control
import numpy as np


def stick(length=1.0, sample_time=0.02):
    """Return the plant; length in m. Inputs: acceleration of the hand, push on the stick."""
    g = 9.81
    A = [[0, 1, 0, 0], [1.5 * g / length, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]]
    B = [[0, 0], [-1.5 / length, 1], [0, 0], [1, 0]]
    C = [[1, 0, 0, 0], [0, 0, 1, 0]]
    continuous = control.ss(
        A, B, C, np.zeros((2, 2)),
        states=["angle", "angle_rate", "position", "speed"],
        inputs=["acceleration", "push"],
        outputs=["angle", "position"],
    )
    system = control.c2d(continuous, sample_time)
    system.units = {
        "angle": "rad", "angle_rate": "rad/s", "position": "m", "speed": "m/s",
        "acceleration": "m/s^2", "push": "rad/s^2",
    }
    return system
''',
)

# %%
# **Recordings** of somebody who holds the stick with at most 3 m/s2, in the columns of some other
# program. (Your own come from your laboratory; this block only stands in for them.)
import sys

import numpy as np
from terminal import RESULTS

sys.path.insert(0, str(RESULTS))
from stick import stick

import impc

plant = impc.Plant(stick(), controls=["acceleration"])
bounds = impc.Bounds(plant, u_min=-3, u_max=3)
weights = impc.Weights(np.diag([40, 1, 10, 1]), 0.1)
person = impc.Controller(plant, weights, bounds, horizon=15, terminal_set=False)
rng = np.random.default_rng(1)
for trial in (1, 2):
    push = np.repeat(rng.choice([-1.5, 0, 1.5], size=60), 10)
    moved = person.simulate(x0=np.zeros(4), disturbance=push)
    angle = np.degrees(moved.x[:-1, 0]) + 0.05 * rng.standard_normal(len(push))
    hand = 100 * moved.x[:-1, 2] + 0.05 * rng.standard_normal(len(push))
    rows = np.column_stack([np.arange(len(push)) * 0.02, angle, hand, push])
    header = "t,stick angle,hand,push"
    np.savetxt(RESULTS / f"stick_{trial}.csv", rows, delimiter=",", header=header, comments="")
    print(f"trial {trial}: {100 * np.mean(np.abs(moved.u) > 2.999):.0f} % of the time at the bound")

# %%
# **What the columns mean.** The file says no units, so they are ours to say. ``impc inspect``
# writes a first version of this, with a ``?`` for what it cannot know:
terminal("impc inspect stick_1.csv --plant stick:stick")

# %%
# Filled in:
write(
    "stick.toml",
    """\
[recording]
time = "t"
time_unit = "s"
subject = "juggler"

[signals.angle]
column = "stick angle"
unit = "deg"

[signals.position]
column = "hand"
unit = "cm"

[signals.push]
column = "push"
unit = "rad/s^2"

[plant]
length = 1.0

[fit]
horizon = 15
u_max = 3.0
""",
)

# %%
# **The fit**, of both trials at once:
terminal("impc fit stick_1.csv stick_2.csv --plant stick:stick --config stick.toml --out stick-fit")
show("stick-fit/figures/movement.svg")

# %%
# The gain that was found, beside the person's:
import json

found = json.loads((RESULTS / "stick-fit" / "result.json").read_text())
print("found ", np.round(found["K"], 1).tolist())
print("person", np.round(person.K, 1).tolist())
