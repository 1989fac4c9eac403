"""
A cohort
========

Subjects of two groups, each fitted, and the groups compared. Here four subjects with short trials
and no bootstrap; ``impc simulate cohort`` without options makes thirty with twenty replicates
each.
"""

from terminal import change, terminal

terminal(
    "impc simulate cohort --out cohort-data --subjects 4 --trials 2 --duration 10 --replicates 0"
)

# %%
# The study file says which recordings belong together:
terminal("cat cohort-data/study.toml")

# %%
# The work goes to one worker a core of this machine, or to a scheduler of your own
# (:doc:`/cohorts`). It may be stopped at any time, also by a power cut: the same command goes on.
terminal("impc cohort cohort-data/study.toml --out cohort")

# %%
# A second run finds everything done.
terminal("impc cohort cohort-data/study.toml --out cohort")

# %%
# Differences between the groups are tested with the Holm correction over all measures; with two
# subjects a group nothing can be significant, and the page says so.
terminal("cat cohort/comparisons.csv")

# %%
# A damaged recording stops nothing else: the command names it and ends with status 1.
terminal("cp -r cohort-data damaged-data")
change(
    "damaged-data/sub-01/ses-1/sub-01_ses-1_task-seat_run-1_motion.csv",
    "seat_angle",
    "saddle",
)
terminal("impc cohort damaged-data/study.toml --out damaged", status=1, last=3)
