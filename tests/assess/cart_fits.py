"""Fits of noisy recordings of a cart, made once and shared by tests."""

from __future__ import annotations

import functools

import impc
from experiments.coverage import cart, noisy_trial
from impc.assess.printed_gain import GainEstimate, gain_estimate
from impc.inverse.noisy_fit import fit_controller


def cart_problem(*seeds: int, root: float = 0.0, u_max: float | None = 1.0) -> impc.Problem:
    """One trial for each seed, with first-order noise of coefficient `root`."""
    trials = [noisy_trial(seed, root) for seed in seeds]
    return impc.fit_problem(cart(), trials, impc.FitSettings(horizon=10, u_max=u_max))


@functools.cache
def cart_fit(*seeds: int, root: float = 0.0, u_max: float | None = 1.0) -> impc.Estimate:
    """Weights of the trials of these seeds."""
    return fit_controller(cart_problem(*seeds, root=root, u_max=u_max))


@functools.cache
def cart_gain(*seeds: int, root: float = 0.0) -> GainEstimate:
    """Identified gain of the trials of these seeds."""
    return gain_estimate(cart_fit(*seeds, root=root))
