"""
Reliability of a test
=====================

Transfer functions of the same subject differ between visits: how repeatable is the test?

.. image:: images/sphx_glr_reliability_001.svg
   :alt: transfer functions from the push to the angles, one line for each visit

The data are four simulated subjects, three visits, three conditions and three trials of 29 s.
"""

from terminal import show, terminal

terminal("impc simulate reliability-study --subjects 4 --out reliability-data")
terminal("impc reliability reliability-data/study.toml --out reliability")

# %%
# Transfer functions from the push to the angles, one line for each visit of each subject:
show("reliability/figures/transfer-visits.svg")

# %%
# :doc:`/howto/reliability_selection` explains the commands for your own study.
