"""Planning of experiments: expected intervals for an assumed subject."""
