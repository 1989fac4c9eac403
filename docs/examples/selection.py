"""
Which parameters of a simulation model can be identified
========================================================

Only some parameters of a model can be identified, and the selection finds them.

.. image:: images/sphx_glr_selection_001.svg
   :alt: estimated parameters with their intervals

The selection works with any function from parameters and an input to outputs. Here the model is a
drug in the blood, from dose to concentration, with time in hours.
"""

from terminal import RESULTS, show, terminal, write

write(
    "dosing.py",
    '''\
"""Absorption, elimination and distribution of a drug; four samples an hour."""

import numpy as np
import scipy.signal


def blood_model():
    """Names, ranges and the simulation."""
    dt = 0.25

    def concentration(theta, dose):
        ka, ke, volume = theta
        a = [1, -(np.exp(-ka * dt) + np.exp(-ke * dt)), np.exp(-(ka + ke) * dt)]
        gain = (1 - np.exp(-ka * dt)) * (1 - np.exp(-ke * dt)) / (ke * volume)
        return scipy.signal.lfilter([0, gain], a, dose, axis=0)

    return {
        "names": ["ka", "ke", "V"],
        "units": ["1/h", "1/h", "l"],
        "low": [0.3, 0.02, 5],
        "high": [3, 0.25, 60],
        "typical": [1, 0.1, 30],
        "pathways": ["absorption", "elimination", "distribution"],
        "inputs": ["dose"],
        "outputs": ["concentration"],
        "rate": 4,
        "simulate": concentration,
    }
''',
)

# %%
# Simulated recordings of five patients at two visits, with a dose every eight hours.
import sys

import numpy as np

sys.path.insert(0, str(RESULTS))
from dosing import blood_model

model, rng = blood_model(), np.random.default_rng(3)
dose = np.zeros((192, 1))
dose[::32] = 400.0
for patient in range(1, 6):
    own = np.array(model["typical"]) * np.exp(0.3 * rng.standard_normal(3))
    for visit in (1, 2):
        level = model["simulate"](own * np.exp(0.02 * rng.standard_normal(3)), dose)
        noisy = level + 0.03 * np.std(level) * rng.standard_normal(level.shape)
        rows = np.column_stack([np.arange(192) * 0.25, dose, noisy])
        name = RESULTS / f"p{patient}_v{visit}.csv"
        np.savetxt(name, rows, delimiter=",", header="time,dose,level", comments="")

# %%
# The study. impc counts time in seconds. This model counts in hours, so its hours are read as
# seconds and its rate is in samples per hour.
write(
    "dosing.toml",
    """\
[study]
model = "dosing:blood_model"
recordings = "p{subject}_v{visit}.csv"

[recording]
time = "time"

[signals.dose]
column = "dose"
unit = "dimensionless"

[signals.concentration]
column = "level"
unit = "dimensionless"

[select]
size = 2
replicates = 40
""",
)
terminal("impc select dosing.toml --model dosing:blood_model --out select")

# %%
# Intervals of the identifiable parameters of each patient:
show("select/figures/parameters.svg")

# %%
# Key parameters explain the outputs, are reliable between visits, and cover several pathways.
terminal("impc key-parameters dosing.toml --model dosing:blood_model --out key-parameters")
terminal("cat key-parameters/candidates.csv")
