"""Optional: fit optimal control problems that the user defines (docs/howto/nonlinear.md)."""
