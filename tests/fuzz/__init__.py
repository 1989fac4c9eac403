"""Mutated files, configurations and plants: whatever comes, it ends in one line.

``python -m tests.fuzz`` goes on for hours; ``test_fuzz.py`` runs a few hundred with a fixed seed.
"""
