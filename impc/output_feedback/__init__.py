"""Subjects with sensory and motor noise: model, likelihood, fit and report. Optional."""
