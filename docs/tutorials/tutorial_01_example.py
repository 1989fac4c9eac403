"""
The example: weights behind a controller that meets its bound
=============================================================

An unstable plant with two states is held by a model predictive controller whose input may not
exceed one. Only the states of 20 steps are recorded. Which weights (Q, R) has the controller?
"""

# %%
# One command does it with every method, for the initial state of case A:
from terminal import show, terminal

terminal("impc example --case A --out example")

# %%
# Markers are the recording, lines what each method says. Inverse LQR knows no bound: it explains
# the saturated steps by a weaker gain, and asks for more than the input can do (grey).
show("example/figures/comparison-case-A.svg")

# %%
# The same in Python, one step at a time. The plant is any discrete ``control.StateSpace``.
import numpy as np

import impc
from plants import yalmip_example

plant = impc.Plant(yalmip_example())
bounds = impc.Bounds(plant, u_min=-1, u_max=1)
truth = impc.Controller(plant, impc.Weights(np.eye(2), 1), bounds, horizon=3)
recorded = truth.simulate(x0=[1, 3], steps=20)
print("steps at the bound:", int(np.sum(np.abs(recorded.u) > 1 - 1e-9)))

# %%
# Inverse MPC: the gain that explains the recording, then weights that have it.
problem = impc.Problem(plant, bounds, 3, [impc.Recording(plant, recorded.x)])
found = impc.fit(problem)
weights = found.weights
print("Q =", np.round(weights.Q, 6).tolist(), " R =", np.round(weights.R, 6).tolist())

# %%
# And what of that came from the recording. The gain did; that Q is the identity is the choice of
# the least condition number among all weights with this gain, see :doc:`/equivalent-weights`.
identified = found.identifiability()
print(f"determined: {identified.rank} of {identified.free} directions; chosen: {identified.chosen}")
