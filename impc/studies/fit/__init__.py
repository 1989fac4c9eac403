"""Fit of the bounded controller behind the trials of one subject."""
