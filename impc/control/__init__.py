"""The constrained controller: its rows, its closed loop and the derivatives of both."""
