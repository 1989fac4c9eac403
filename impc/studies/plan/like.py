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


def filled(configuration: Configuration, folder: Path) -> tuple[Configuration, str]:
    """Complete a configuration by the fit in a `folder`; also return the name of the plant.

    The noise is the RMS of the residuals; the cost weights are those of the fit's [fit.structure].
    """
    where, plan = f"--like {os.fspath(folder)}", configuration.plan
    found = read_result(folder).content
    own: dict[str, Any] = {}
    try:
        named = found["findings"].get("structure_cost_weights")
        rms = [np.square(trial["rms_residual"]) for trial in found["trials"]]
        own["noise"] = dict(
            zip(found["outputs"], np.sqrt(np.mean(rms, axis=0)).tolist(), strict=True)
        )
        if named is not None:
            table = named["table"]
            own["cost_weights"] = dict(zip(table["feature"], table["value"], strict=True))
        settings = {name: one for name, one in found["settings"].items() if one is not None}
        plant, arguments = str(found["plant"]["name"]), dict(found["plant"]["arguments"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        remedy = "pass an output folder of impc fit"
        raise InputError(where, f"is not a result of impc fit ({error})", remedy) from None
    if "cost_weights" not in own | plan:
        remedy = "fit with a diagonal [fit.structure], or set [plan] cost_weights"
        raise InputError(where, "has no cost weights of named features", remedy)
    changed = msgspec.structs.replace(
        configuration,
        plant=configuration.plant or arguments,
        fit={**settings, **configuration.fit},
        plan={**own, **plan},
    )
    return changed, plant
