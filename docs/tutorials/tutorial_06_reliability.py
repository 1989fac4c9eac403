"""
Reliability of a test
=====================

How repeatable are the measures of the seated-balance test between visits? Six simulated subjects,
three visits, three conditions, three trials of 29 s.
"""

from terminal import show, terminal

terminal("impc simulate reliability-study --subjects 4 --out reliability-data")
terminal("impc reliability reliability-data/study.toml --out reliability")

# %%
# Transfer functions from the push to the angles, one line a visit, for every subject:
show("reliability/figures/transfer-visits.svg")

# %%
# :doc:`/reliability` has the definitions, and the findings of chapter 2 beside those of the
# simulated study.
