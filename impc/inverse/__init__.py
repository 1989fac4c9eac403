"""From recordings to gains and weights: the inverse problem and every method that solves it."""
