"""Golden results: five runs and the numbers at which they end, in golden.json."""
