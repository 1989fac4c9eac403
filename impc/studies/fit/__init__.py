"""One subject: the constrained controller behind a few trials."""
