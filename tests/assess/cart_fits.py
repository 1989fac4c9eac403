"""Fits of noisy recordings of a cart, made once and shared by tests."""

from __future__ import annotations

import functools

import numpy as np
import scipy.linalg

import impc
from experiments.coverage import cart, noisy_trial
from experiments.uncertain_body import Person, cart_person
from impc.arrays import Array
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.long_run_covariance import ResidualNoise
from impc.assess.printed_gain import GainEstimate, gain_estimate
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import noise_of_residual
from tests.support import present, slopes


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


def joint_covariance(at: GainEstimate, stated: dict[int, float]) -> tuple[GainCovariance, Array]:
    """The covariance of white residuals, and the inverse of J'J / s^2 + prior of all columns.

    Columns are gain, parameters and the unknowns of each trial; `stated` are the standard
    deviations of some of them.
    """
    problem, K, S = at.problem, np.array(at.K), np.array(at.S)
    residual, on_gain, on_parameters, own = slopes(problem, K, S)
    parts = np.split(own, np.cumsum(problem.trial_sizes)[:-1])
    J = np.hstack([on_gain, on_parameters, scipy.linalg.block_diag(*parts)])
    s = noise_of_residual(problem, residual)
    H = J.T @ J / s**2
    for place, deviation in stated.items():
        H[place, place] += 1 / deviation**2
    white = ResidualNoise(np.zeros(2), s**2 * np.eye(2)[None])
    return gain_covariance(problem, K, S, lambda _residuals, _fitted: white), np.linalg.inv(H)


def uncertain_cart(seed: int = 1, error: str = "none", root: float = 0.0) -> Person:
    """A subject on a cart with stated uncertainty, recorded at a VAF of 99 %."""
    found = present(cart_person(seed, 99, root, error))
    return found


@functools.cache
def uncertain_fit(seed: int = 1, error: str = "none", root: float = 0.0) -> impc.Estimate:
    """Weights and body of such a subject."""
    return impc.fit(uncertain_cart(seed, error, root).problem)
