"""Inverse model predictive control: the weights behind a recorded closed loop."""
