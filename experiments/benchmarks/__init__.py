"""Benchmarks: ratios of median times measured in turn in one run.

Run them with `python -m experiments.benchmarks`.
"""
