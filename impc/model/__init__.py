"""What a controller acts on: plants, bounds, weights, recordings, and the Riccati equation."""
