"""
Comparing inverse MPC with inverse LQR
======================================

Eight methods on the same recordings: a free gain, five kinds of inverse LQR and inverse KKT, and
inverse MPC. The subject is at the torque limit for an eighth of the time.
"""

from terminal import show, terminal

terminal("impc simulate seated-balance --out compared --formats csv --trials 2 --duration 15")
terminal(
    "impc compare compared/trial_1.csv compared/trial_2.csv --plant seated-balance"
    " --config compared/subject.toml --out compare"
)

# %%
# VAF of the trials left out, method by method. What separates them is not the share explained,
# which is high for all who may exceed the limit, but whether the torque that the explanation
# needs exists.
show("compare/comparison.png")

# %%
# :doc:`/comparing` says where each method breaks; :doc:`/what-may-be-concluded` what its weights
# are worth.
