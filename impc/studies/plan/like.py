"""Assumed subject of a plan from a fit or a simulated subject: `impc plan --like`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from impc.errors import InputError
from impc.files.configuration import read_configuration
from impc.files.disk import truth_beside
from impc.files.results import read_result

if TYPE_CHECKING:
    from pathlib import Path

    from impc.files.configuration import Configuration


def filled(configuration: Configuration, folder: Path) -> tuple[Configuration, str | None]:
    """Complete a configuration by the subject in a `folder`; also return the name of its plant.

    A fit gives plant, settings, gain, and the RMS of its residuals as noise; a simulated subject
    the gain and its settings.
    """
    where, truth = f"--like {os.fspath(folder)}", truth_beside(folder)
    own: dict[str, Any] = {}
    plant: str | None = None
    try:
        if truth:
            own["gain"], beside = truth["K"], read_configuration(folder / "subject.toml")
            arguments, settings = beside.plant, beside.fit
        else:
            found = read_result(folder).content
            rms = [np.square(trial["rms_residual"]) for trial in found["trials"]]
            noise = np.sqrt(np.mean(rms, axis=0)).tolist()
            own |= {"noise": dict(zip(found["outputs"], noise, strict=True)), "gain": found["K"]}
            settings = {name: one for name, one in found["settings"].items() if one is not None}
            plant, arguments = str(found["plant"]["name"]), dict(found["plant"]["arguments"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        remedy = "pass an output folder of impc fit, or of impc simulate seated-balance"
        raise InputError(where, f"has no subject ({error})", remedy) from None
    changed = msgspec.structs.replace(
        configuration,
        plant=configuration.plant or arguments,
        fit={**settings, **configuration.fit},
        plan={**own, **configuration.plan},
    )
    return changed, plant
