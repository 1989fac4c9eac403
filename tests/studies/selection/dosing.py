"""A model from another field: concentration of a drug in the blood.

dose rate u -> concentration y: absorption ka, elimination ke, volume V. With ka and ke exchanged
the curve has the same shape and another size: V and the two rates share a direction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
import scipy.signal

from impc.studies.selection.model import ParametricModel
from impc.studies.selection.model_source import Runner

__all__ = ["blood_model", "in_turn"]

T = TypeVar("T")
_DT = 0.25


def blood_model() -> dict[str, Any]:
    """One compartment with absorption; time is in hours, four samples each."""

    def concentration(theta: np.ndarray, dose: np.ndarray) -> np.ndarray:
        ka, ke, volume = theta
        a = [1.0, -(np.exp(-ka * _DT) + np.exp(-ke * _DT)), np.exp(-(ka + ke) * _DT)]
        gain = (1 - np.exp(-ka * _DT)) * (1 - np.exp(-ke * _DT)) / (ke * volume)
        return np.asarray(scipy.signal.lfilter([0.0, gain], a, dose, axis=0))

    return {
        "names": ["ka", "ke", "V"],
        "low": [0.3, 0.02, 5.0],
        "high": [3.0, 0.25, 60.0],
        "typical": [1.0, 0.1, 30.0],
        "units": ["1/h", "1/h", "l"],
        "pathways": ["absorption", "elimination", "distribution"],
        "inputs": ["dose"],
        "outputs": ["concentration"],
        "rate": 1 / _DT,
        "simulate": concentration,
    }


def in_turn(model: ParametricModel) -> Runner:
    """Run subjects one by one in this process without a cache."""

    def run(
        work: Callable[..., T], kind: type[T], arguments: Mapping[str, tuple[Any, ...]]
    ) -> dict[str, T]:
        return {name: work(model, *given) for name, given in arguments.items()}

    return run
