"""Benchmarks: ratios of medians measured side by side in one run.

Run them with `python -m experiments.benchmarks`.
"""
