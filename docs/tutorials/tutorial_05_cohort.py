"""
A cohort
========

Subjects of two groups, each fitted, and the groups compared. Here four subjects with short trials
and no bootstrap; ``impc simulate cohort`` without options makes thirty with twenty replicates
each.
"""

from terminal import change, show, terminal

terminal(
    "impc simulate cohort --out cohort-data --subjects 4 --trials 1 --duration 10 --replicates 0"
)

# %%
# The study file says which recordings belong together:
terminal("cat cohort-data/study.toml")

# %%
# One recording is damaged here, as one always is: its column of the seat has another name.
BROKEN = "cohort-data/sub-01/ses-1/sub-01_ses-1_task-seat_run-1_motion.csv"
change(BROKEN, "seat_angle", "saddle")

# %%
# The work goes to one worker a core of this machine, or to a scheduler of your own
# (:doc:`/cohorts`). What is damaged stops nothing else: the command names it, and ends with
# status 1.
terminal("impc cohort cohort-data/study.toml --out cohort", status=1, last=3)

# %%
# Mended, the same command does what is missing and nothing twice. In the same way it goes on after
# it was stopped, also by a power cut.
change(BROKEN, "saddle", "seat_angle")
terminal("impc cohort cohort-data/study.toml --out cohort")

# %%
# Differences between the groups are tested with the Holm correction over all measures; with two
# subjects a group nothing can be significant, and the page says so.
terminal("cat cohort/comparisons.csv")
show("cohort/figures/people.svg")
