"""The simulation example of section 3.4."""
