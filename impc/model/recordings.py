"""A recorded trial as the fits take it: outputs and disturbance on the plant's clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from impc.arrays import Array, as_numbers, finite_array, frozen
from impc.checking import Value, checked
from impc.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from impc.model.plant import Plant


@dataclass(frozen=True)
class Label(Value):
    """Whose trial it is; empty where the recording does not say.

    Attributes
    ----------
    subject, visit, condition, trial : str
        Names, as the files or the study give them.

    Examples
    --------
    >>> import impc
    >>> label = impc.Label(subject="S01", condition="eyes closed", trial="2")
    >>> str(label)
    'S01 eyes closed 2'
    """

    subject: str = ""
    visit: str = ""
    condition: str = ""
    trial: str = ""

    def __str__(self) -> str:
        parts = (self.subject, self.visit, self.condition, self.trial)
        return " ".join(part for part in parts if part)


@dataclass(frozen=True, init=False)
class Recording(Value):
    """One recorded trial, checked against its plant.

    Parameters
    ----------
    plant : Plant
        Gives the number of outputs, disturbances and states.
    outputs : array_like
        (samples, p), or (samples,) for one output; at least two samples.
    disturbance : array_like, optional
        (samples, d), or (samples,) for one; zero by default. The last row is not used and may be
        left out, as of what drove a simulation.
    x0 : array_like, optional
        (n,). By default the first output, which must then be the full state; a plant with other
        outputs starts at rest.
    label : Label, optional
    findings : tuple of str
        What the checks of the file found, for the report.

    Attributes
    ----------
    outputs : Array
        (samples, p), in the units of the plant's outputs.
    disturbance : Array
        (samples, d); row k acts between samples k and k + 1, so that the last is not used.
    x0 : Array
        State at the first sample (n,): known, or where a fit of it starts.
    label : Label
    findings : tuple of str
        What the checks of its file found and let pass, one sentence each.

    Raises
    ------
    DataError
        When something is missing, not finite, or of the wrong shape.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.5]], [[1]], [[1]], 0, 1))
    >>> impc.Recording(plant, [1.0, 0.4, 0.2]).samples
    3
    """

    _rules: ClassVar[Mapping[str, Any]] = {
        "outputs": "* p",
        "disturbance": "* d",
        "x0": "n",
    }

    outputs: Array
    disturbance: Array
    x0: Array
    label: Label
    findings: tuple[str, ...]

    @checked
    def __init__(
        self,
        plant: Plant,
        outputs: ArrayLike,
        disturbance: ArrayLike | None = None,
        x0: ArrayLike | None = None,
        *,
        label: Label | None = None,
        findings: tuple[str, ...] = (),
    ) -> None:
        given = _columns(outputs)
        _require_no_end(np.asarray(given))
        y = finite_array("outputs", given, (None, len(plant.outputs)))
        if len(y) < 2:
            raise DataError("outputs", f"has {len(y)} samples", "give at least 2")
        width = plant.E.shape[1]
        d = _pushes(disturbance, len(y), width)
        start = x0
        if start is None:
            full = plant.C.shape == (plant.n, plant.n) and np.array_equal(plant.C, np.eye(plant.n))
            start = y[0] if full else np.zeros(plant.n)
        self._fill(
            outputs=frozen(y),
            disturbance=frozen(finite_array("disturbance", d, (len(y), width))),
            x0=frozen(finite_array("x0", start, (plant.n,))),
            label=label or Label(),
            findings=findings,
        )

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.outputs)


def _require_no_end(values: Array) -> None:
    """A simulation that no input could continue is NaN from there on, and is no recording."""
    if values.ndim != 2:
        return
    finite = np.all(np.isfinite(values), axis=1)
    end = int(np.count_nonzero(finite))
    if 0 < end < len(finite) and np.all(finite[:end]) and np.all(np.isnan(values[end:])):
        raise DataError(
            "outputs",
            f"end at sample {end}, and NaN follows",
            "a simulation that ended has no more: start it elsewhere or widen its bounds",
        )


def _pushes(given: ArrayLike | None, samples: int, width: int) -> ArrayLike:
    """The disturbance with a row a sample."""
    if given is None:
        return np.zeros((samples, width))
    d = np.asarray(_columns(given))
    if width == 0 and d.size:
        remedy = (
            "name its controls: Plant(system, controls=[...]); the other inputs are disturbances"
        )
        raise DataError("disturbance", "is given, and the plant has none", remedy)
    short = d.ndim == 2 and len(d) == samples - 1
    return np.vstack([d, np.zeros((1, d.shape[1]))]) if short else d


def _columns(values: ArrayLike) -> ArrayLike:
    array = as_numbers("columns", values)
    return array[:, None] if array.ndim == 1 else array
