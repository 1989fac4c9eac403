"""Particle likelihood of the sensorimotor model at a limit, compared with the filter."""
