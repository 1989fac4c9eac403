"""Optional: optimal control problems of the user's own, all of them (docs/nonlinear.md)."""

from impc.checking import add_value

add_value("OptimalControlProblem", "OptimalControlProblem(states, inputs, ...)")
add_value("OptimalRecording", "problem.recorded_plan or recorded_loop")
