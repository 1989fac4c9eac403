"""Optional: optimal control problems of the user's own, all of them (docs/nonlinear.md)."""

from impc.checking import register

register(
    "impc.nonlinear.problem",
    "OptimalControlProblem",
    "make it with OptimalControlProblem(states, inputs, ...)",
)
register(
    "impc.nonlinear.recordings",
    "OptimalRecording",
    "make it with problem.recorded_plan or recorded_loop",
)
