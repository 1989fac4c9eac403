"""
A bilevel program of your own in CasADi
=======================================

IPOPT finds the weights behind a recording through a closed loop that is one CasADi function.

.. image:: images/sphx_glr_loop_in_casadi_001.png
   :alt: error of the states by sample, for the starting weights and for those that are found

``impc.closed_loop_function`` returns a whole closed loop as a ``casadi.Function`` with exact
derivatives. In the loop the controller solves a quadratic program at each bound. The upper level
can be any program in CasADi.
"""

# %%
# The recording: 20 steps of an unstable plant whose input may not exceed one, under Q = I, R = 1.
import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
from terminal import RESULTS, show

import impc
from plants import yalmip_example

plant = impc.Plant(yalmip_example())
bounds = impc.Bounds(plant, u_min=-1, u_max=1)
truth_weights = impc.Weights(np.eye(2), 1)
truth = impc.Controller(plant, truth_weights, bounds, horizon=3)
recorded = truth.simulate(x0=[1, 3], steps=20)
print("steps at the bound:", int(np.sum(np.abs(recorded.u) > 1 - 1e-9)))

# %%
# The closed loop as a function of the weights. Plant, bounds, horizon and solver are those of the
# controller; the terminal set is computed again for every Q and R.
loop = impc.closed_loop_function(truth, steps=20, of="weights")
print(loop)

# %%
# The upper level minimises the sum of absolute errors plus a small multiple of a condition measure.
# The measure only decides what the recording leaves open. Only the ratio of Q to R matters, so
# R = 1. The measure is tr(W) tr(W^-1) for W = blkdiag(Q, R): it is smooth, and like the condition
# number it is smallest when W is a multiple of the identity.
q11, q12, q22 = ca.MX.sym("q11"), ca.MX.sym("q12"), ca.MX.sym("q22")
Q = ca.blockcat([[q11, q12], [q12, q22]])
determinant = q11 * q22 - q12**2
condition = (q11 + q22 + 1) * ((q11 + q22) / determinant + 1)

x, u = loop(Q, 1, recorded.x[0], np.zeros((20, 0)))
above, below = ca.MX.sym("above", x.numel()), ca.MX.sym("below", x.numel())
program = {
    "x": ca.vertcat(q11, q12, q22, above, below),
    "f": ca.sum1(above + below) + 1e-4 * condition,
    "g": ca.vertcat(ca.vec(x - recorded.x) - above + below, determinant),
}

# %%
# IPOPT takes first derivatives from the loop and approximates second ones, which do not exist
# where the active set changes. It starts at Q = diag(2, 0.5).
solver = ca.nlpsol(
    "upper",
    "ipopt",
    program,
    {
        "print_time": False,
        "ipopt": {
            "hessian_approximation": "limited-memory",
            "tol": 1e-9,
            "print_level": 0,
            "sb": "yes",
        },
    },
)
count = x.numel()
first = ca.vec(loop(np.diag([2, 0.5]), 1, recorded.x[0], np.zeros((20, 0)))[0] - recorded.x)
found = solver(
    x0=ca.vertcat(2, 0, 0.5, ca.fmax(first, 0), ca.fmax(-first, 0)),
    lbx=np.r_[1e-3, -np.inf, 1e-3, np.zeros(2 * count)],
    ubx=np.inf,
    lbg=np.r_[np.zeros(count), 1e-6],
    ubg=np.r_[np.zeros(count), np.inf],
)
print(solver.stats()["return_status"], "in fewer than 30 steps:", solver.stats()["iter_count"] < 30)
a, b, c = found["x"].full().ravel()[:3]
weights = impc.Weights([[a, b], [b, c]], 1)
print("Q =", (np.round(weights.Q, 6) + 0.0).tolist())

# %%
# These are the weights that made the recording. The misfit determines the gain, which is two of
# the three numbers; the condition measure determines the third (:doc:`/why/equivalent_weights`).
print("residual (3.10) below 1e-6:", impc.weight_error(weights, truth_weights) < 1e-6)

# %%
# How far the loop is from the recording, at the start of the search and at its end. While the
# command is at its bound in both, the error is zero:
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for Q, label in ((np.diag([2, 0.5]), "start"), (weights.Q, "found")):
    states = loop(Q, 1, recorded.x[0], np.zeros((20, 0)))[0].full()
    error = np.abs(states - recorded.x).max(axis=1)
    axes.semilogy(np.where(error > 0, error, np.nan), "o-", label=label)
axes.set(xlabel="sample (-)", ylabel="largest error of a state (-)")
axes.legend()
RESULTS.mkdir(exist_ok=True)
figure.savefig(RESULTS / "loop-in-casadi.png")
show("loop-in-casadi.png")

# %%
# One step of the controller is a function of the state. It is an ordinary CasADi graph, so it can
# be saved, loaded and turned into C.
step = impc.mpc_function(truth)
print("u(1, 3) =", step([1, 3]), " slope at the origin:", step.jacobian()([0, 0], 0))
