"""Selection of sensitive and key parameters of a simulation model (chapters 4 and 5)."""
