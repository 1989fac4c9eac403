"""Short scripts, one for each result and each benchmark: they compose the package, no more."""
