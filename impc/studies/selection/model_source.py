"""A model by import path, and the recordings of a study for it.

The function named returns a mapping (or a `ParametricModel`):

    names, low, high, typical       of the parameters
    pathways, units, meanings       optional
    inputs, outputs, rate           signals of a recording by name, samples per second
    simulate                        (theta, input (samples, d)) -> outputs (samples, p), or
    matrices                        a CasADi function theta -> A, B, C, continuous: its
                                    sensitivities are exact
    jacobian                        optional, beside simulate: (theta, input) -> outputs, derivative
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import control
import numpy as np

from impc.errors import InputError
from impc.files.plant_sources import import_function, users_code
from impc.files.reading import read_recordings
from impc.model.plant import Plant
from impc.studies.selection.linear import linear_functions
from impc.studies.selection.model import ParametricModel, Trial, parametric_model

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.studies.cohort.study import Study

_NEEDED = ("names", "low", "high", "typical", "inputs", "outputs", "rate")


@dataclass(frozen=True)
class ModelSource:
    """A model, and how its signals are called in a recording."""

    name: str  # Import path of the function
    arguments: Mapping[str, Any]  # What it was called with
    model: ParametricModel
    inputs: tuple[str, ...]  # Signals of a recording
    outputs: tuple[str, ...]
    rate: float  # Samples per second of the model


def model_source(name: str, arguments: Mapping[str, Any]) -> ModelSource:
    """Call the function of an import path `name`, ``module:function``, with arguments."""
    make = import_function(name)
    try:
        with users_code(f"model {name}", TypeError, ValueError):
            told = make(**arguments)
    except (TypeError, ValueError) as error:
        raise InputError(f"model {name}", str(error), "correct the [model] table") from None
    lacking = [key for key in _NEEDED if not isinstance(told, dict) or key not in told]
    if lacking or not ("matrices" in told or "simulate" in told):
        missing = lacking[0] if lacking else "simulate or matrices"
        raise InputError(f"model {name}", f"lacks {missing}", "see docs/selection.md")
    rate = float(told["rate"])
    simulate, jacobian = told.get("simulate"), told.get("jacobian")
    if "matrices" in told:
        simulate, jacobian = linear_functions(told["matrices"], 1 / rate)
    model = parametric_model(
        told["names"],
        told["low"],
        told["high"],
        told["typical"],
        simulate,
        pathways=told.get("pathways"),
        units=told.get("units"),
        meanings=told.get("meanings"),
        jacobian=jacobian,
    )
    return ModelSource(
        name, dict(arguments), model, tuple(told["inputs"]), tuple(told["outputs"]), rate
    )


def read_trials(study: Study, source: ModelSource) -> dict[tuple[str, str], tuple[Trial, ...]]:
    """Trials of every subject and visit, all conditions together."""
    # A plant of that many signals: the reader takes names and the rate from it.
    d, p = len(source.inputs), len(source.outputs)
    names: dict[str, Any] = {"inputs": ["nothing", *source.inputs], "outputs": source.outputs}
    system = control.ss([[0.5]], np.ones((1, 1 + d)), np.ones((p, 1)), 0, 1 / source.rate, **names)
    plant = Plant(system, ["nothing"])
    found: dict[tuple[str, str], tuple[Trial, ...]] = {}
    for unit in study.units:
        trials = read_recordings(unit.files, study.configuration, plant)
        key = (unit.subject, unit.visit)
        found[key] = found.get(key, ()) + tuple(
            Trial(item.disturbance, item.outputs) for item in trials
        )
    return found
