"""Assumed subject of a plan from the results of a fit: `impc plan --like`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from impc.errors import InputError
from impc.files.results import read_result

if TYPE_CHECKING:
    from pathlib import Path

    from impc.files.configuration import Configuration


class _Plant(msgspec.Struct):
    name: str
    arguments: dict[str, Any]


class _Trial(msgspec.Struct):
    rms_residual: list[float]


class _CostWeights(msgspec.Struct):
    feature: list[str]
    value: list[float | None]


class _Finding(msgspec.Struct):
    table: _CostWeights


class _Findings(msgspec.Struct):
    structure_cost_weights: _Finding | None = None


class _Fit(msgspec.Struct):
    findings: _Findings
    plant: _Plant
    settings: dict[str, Any]
    outputs: list[str]
    trials: list[_Trial]


def filled(configuration: Configuration, folder: Path) -> tuple[Configuration, str]:
    """Complete a configuration by the fit in a `folder`; also return the name of the plant.

    The noise is the RMS of the residuals; the cost weights are those of the fit's [fit.structure].
    """
    where = f"--like {os.fspath(folder)}"
    try:
        found = msgspec.convert(read_result(folder).content, _Fit)
    except msgspec.ValidationError as error:
        remedy = "pass an output folder of impc fit"
        raise InputError(where, f"is not a result of impc fit ({error})", remedy) from None
    own: dict[str, Any] = {}
    if "noise" not in configuration.plan:
        squares = np.mean([np.square(trial.rms_residual) for trial in found.trials], axis=0)
        own["noise"] = dict(zip(found.outputs, map(float, np.sqrt(squares)), strict=True))
    if "cost_weights" not in configuration.plan:
        named = found.findings.structure_cost_weights
        if named is None:
            remedy = "fit with a diagonal [fit.structure], or set [plan] cost_weights"
            raise InputError(where, "has no cost weights of named features", remedy)
        own["cost_weights"] = dict(zip(named.table.feature, named.table.value, strict=True))
    settings = {name: one for name, one in found.settings.items() if one is not None}
    changed = msgspec.structs.replace(
        configuration,
        plant=configuration.plant or found.plant.arguments,
        fit={**settings, **configuration.fit},
        plan={**own, **configuration.plan},
    )
    return changed, found.plant.name
