"""Models for the tests: the head and neck with simulated trials, and a linear model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import plants
from impc.studies.selection.model import ParametricModel, Trial, parametric_model
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


def line_model(
    width: float = 5.0, names: Sequence[str] = ("a", "b", "c"), **said: Any
) -> ParametricModel:
    """y = u1 a + u2 b + u3 c: closed-form least squares, posterior and LASSO."""
    ends = [-width] * 3, [width] * 3, [0.0] * 3
    return parametric_model(names, *ends, lambda p, u: np.asarray(u @ p)[:, None], **said)
