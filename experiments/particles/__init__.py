"""The likelihood of a person at a limit by particles, and a fit that they correct."""
