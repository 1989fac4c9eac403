"""Golden results: ten runs and the numbers at which they end, in golden.json."""
