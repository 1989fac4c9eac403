"""
Comparing inverse MPC with inverse LQR
======================================

Eight methods on the same recordings: a free gain, five kinds of inverse LQR, and two of
inverse MPC. They are those of the stick (:doc:`tutorial_03_own_plant`), whose holder is at the
limit for a tenth of the time or more.
"""

from terminal import show, terminal

terminal(
    "impc compare stick_1.csv stick_2.csv --plant stick:stick --config stick.toml --out compare"
)

# %%
# The columns **left out** are VAF of trials that a method has not seen; **beyond bound** is the
# share of samples at which its explanation needs more than the person had. Only inverse MPC
# explains the angle and keeps the limit; with the limit cut off afterwards, the gains of the
# others let the stick fall (**falls**).
show("compare/figures/comparison.svg")

# %%
# :doc:`/comparing` says where each method breaks; :doc:`/what-may-be-concluded` what its weights
# are worth.
