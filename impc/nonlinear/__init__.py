"""Optional: fit optimal control problems that the user defines (docs/howto/nonlinear.md)."""

from impc.checking import add_value

add_value("OptimalControlProblem", "OptimalControlProblem(states, inputs, ...)")
add_value("OptimalRecording", "problem.recorded_plan or recorded_loop")
