"""
A subject from CSV files
========================

Three trials of a person on a seat that tilts sideways, recorded by another program at 1000
samples a second. Whoever has no recordings makes a subject first:
"""

from terminal import change, show, terminal

terminal("impc simulate seated-balance --out subject --formats csv")

# %%
# **Look at a file.** ``impc inspect`` says what the file holds, and writes a first configuration.
# What it cannot know it marks with ``?``.
terminal("impc inspect subject/trial_1.csv --plant seated-balance --out my-subject.toml")

# %%
# **Fit.** The configuration that came with the subject has those places filled in. Its
# ``u_max`` says what we know of this person: more than 6 Nm is not in the muscles.
terminal("cat subject/subject.toml")

# %%
# A fit of three trials takes some twenty seconds. It may be interrupted: the same command goes
# on.
terminal(
    "impc fit subject/trial_1.csv subject/trial_2.csv subject/trial_3.csv"
    " --plant seated-balance --config subject/subject.toml --out fit"
)

# %%
# ``fit/report.html`` has everything on one page; its figures are files as well. Recorded and
# explained angles of the first trial, and the torque with its limit:
show("fit/figures/movement.svg")

# %%
# **Mistakes are reported in one line**, and nothing is written. Angles in degrees that are said
# to be radians:
terminal("cp subject/subject.toml wrong.toml")
change("wrong.toml", 'unit = "deg"', 'unit = "rad"')
terminal(
    "impc fit subject/trial_1.csv --plant seated-balance --config wrong.toml --out wrong", status=2
)
