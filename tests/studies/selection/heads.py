"""Simulated trials of the head-neck model for the tests."""

from __future__ import annotations

import numpy as np

import plants
from impc.studies.selection.model import ParametricModel, Trial
from impc.studies.selection.model_source import model_source

NAMES_FIM = ("Kvis", "Kccr", "tau", "tau1A", "tauCNS1")


def head_model() -> ParametricModel:
    return model_source("plants:head_neck_model", {}).model


def head_trials(
    model: ParametricModel, theta: np.ndarray, vaf: float, seed: int, count: int = 3
) -> list[Trial]:
    rng = np.random.default_rng(seed)
    trials = []
    for number in range(count):
        reference = plants.step_reference(seed=100 * seed + number)[:, None]
        head = model.simulate(theta, reference)
        noise = np.sqrt((1 / vaf - 1) * np.mean(head**2))
        trials.append(Trial(reference, head + noise * rng.standard_normal(head.shape)))
    return trials
