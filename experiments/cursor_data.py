"""Recordings of human target tracking (Bonnen et al., Journal of Vision 15(3):14, 2015).

The file is not part of the project; IMPC_CURSOR_DATA gives its path.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io

from impc.arrays import Array
from impc.errors import DataError

__all__ = ["ARCMIN_A_PIXEL", "RATE", "Condition", "data_file", "read_conditions"]

RATE = 60.0
ARCMIN_A_PIXEL = 1.32


@dataclass(frozen=True)
class Condition:
    """All trials with one blur of the target.

    Attributes
    ----------
    blur : float
        Blur of the target, px.
    target, response : Array
        Positions of target and cursor, px, (trials, samples) at 60 Hz.
    """

    blur: float
    target: Array
    response: Array


def data_file() -> Path:
    """Path of the recordings, which may not exist."""
    beside = Path(__file__).resolve().parents[2] / "shared/data/cursor-tracking/bonnen2015.mat"
    return Path(os.environ.get("IMPC_CURSOR_DATA", beside))


def read_conditions(path: Path) -> list[Condition]:
    """Read the conditions from the sharpest target to the most blurred.

    Raises
    ------
    DataError
        If the file is absent or does not contain the recordings.
    """
    if not path.is_file():
        raise DataError(f"recordings {path.name}", "is not there", "name it in IMPC_CURSOR_DATA")
    try:
        found = scipy.io.loadmat(path, variable_names=["sigma", "target", "response"])
        blur = np.ravel(found["sigma"]).astype(float)
        target, response = (found[name].astype(float) for name in ("target", "response"))
    except (OSError, ValueError, KeyError, NotImplementedError) as error:
        raise DataError(
            f"recordings {path.name}", f"cannot be read ({error})", "name another file"
        ) from None
    return [
        Condition(float(width), target[blur == width], response[blur == width])
        for width in np.unique(blur)
    ]
