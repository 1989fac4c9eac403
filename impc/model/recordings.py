"""Recorded trials: outputs, commands and disturbance on the plant's clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, as_numbers, finite_array, frozen, require_finite, with_shape
from impc.checking import Value, checked
from impc.errors import DataError
from impc.model.foresight import physical_disturbances, physical_states, with_steps
from impc.model.plant import Plant
from impc.model.signal_errors import KINDS, OFFSET, undistorted
from impc.model.targets import reference


@dataclass(frozen=True)
class Label(Value):
    """Label of a trial; parts that are not known are empty.

    Attributes
    ----------
    subject, visit, condition, trial : str
        Names, as given by the files or the study.

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
        Determines the numbers of outputs, disturbances and states.
    outputs : array_like
        Outputs (samples, p), or (samples,) for one; at least two samples. NaN marks missing values.
    disturbance : array_like, optional
        Disturbance (samples, d), or (samples,) for one; zero by default. The last row is not used
        and may be omitted.
    x0 : array_like, optional
        Initial state (n,). By default the first output if the output is the full state, else zero.
    target : mapping, optional
        Set points of outputs or states by name, in their units: a number, or (samples,). Signals
        without one are regulated to rest.
    commands : array_like, optional
        Recorded commands (samples - 1, m), or (samples, m) with an unused last row; (samples - 1,)
        for one control. NaN marks missing values. They are fitted in addition to the outputs.
    offset : array_like, optional
        Offset (p,) contained in the recorded outputs; zero by default. See `Problem.offsets`.
    finer : array_like, optional
        Disturbance (samples, d) whose jumps lie between samples. `impc.fit` takes it in place of
        `disturbance` if all trials together are predicted better with it.
    timing : mapping of str to float, optional
        Standard deviation in s of the time at which a disturbance acts, or an output is recorded,
        by name; others are on one clock. A shift of it is fitted with this prior.
    label : Label, optional
        Label of the trial.
    findings : tuple of str
        Findings of the file checks, for the report.

    Attributes
    ----------
    outputs : ndarray of shape (samples, p)
        Outputs in the units of the plant; NaN where missing.
    disturbance : ndarray of shape (samples, d)
        Row k acts between samples k and k + 1; the last row is not used.
    x0 : ndarray of shape (n,)
        State at the first sample: known, or the start of its fit.
    target : ndarray of shape (samples, q)
        Set points of the signals named in `signals`.
    signals : tuple of str
        Signals with a target.
    commands : ndarray of shape (samples, m)
        Recorded commands, the last row NaN; shape (0, m) if there are none.
    finer : ndarray of shape (samples, d)
        The same with jumps between samples; shape (0, d) if there is no choice.
    errors : ndarray of shape (kinds, p + d)
        Errors of outputs and disturbances, one row a kind (`impc.model.signal_errors`); zero unless
        they are fitted (`Problem.signal_errors`).
    timing : ndarray of shape (p + d,)
        Standard deviation of the time shift of outputs and disturbances, in s; zero if not stated.
    label : Label
        Label of the trial.
    findings : tuple of str
        Findings of the file checks, one sentence each.

    Raises
    ------
    DataError
        If values are missing, not finite, or of the wrong shape.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.5]], [[1]], [[1]], 0, 1))
    >>> impc.Recording(plant, [1.0, 0.4, 0.2]).samples
    3
    """

    _rules: ClassVar[Mapping[str, Any]] = {
        "outputs": "~* p",
        "disturbance": "* d",
        "x0": "n",
        "target": "* q",
        "commands": "~* m",
        "finer": "* d",
        "errors": "* *",
        "timing": "*",
    }

    outputs: Array
    disturbance: Array
    x0: Array
    target: Array
    signals: tuple[str, ...]
    commands: Array
    finer: Array
    errors: Array
    timing: Array
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
        target: Mapping[str, ArrayLike] | None = None,
        commands: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        finer: ArrayLike | None = None,
        timing: Mapping[str, float] | None = None,
        label: Label | None = None,
        findings: tuple[str, ...] = (),
    ) -> None:
        given, names = _columns(outputs), plant.outputs
        array = np.asarray(given)
        _require_no_end(array)
        if array.ndim == 2 and len(names) not in array.shape:
            expected = f"expected a column for each of {', '.join(names)}"
            problem = f"{expected}, got {array.shape[1]} columns"
            raise DataError("outputs", problem, "select its columns, or change C of the plant")
        y = _with_gaps("outputs", given, (None, len(plant.outputs)))
        if len(y) < 2:
            raise DataError("outputs", f"has {len(y)} samples", "give at least 2")
        if not np.any(np.isfinite(y)):
            raise DataError("outputs", "has missing values only", "pass recorded values")
        width = physical_disturbances(plant)
        d = _pushes(disturbance, len(y), width)
        start = x0
        if start is None:
            full = plant.C.shape == (plant.n, plant.n) and np.array_equal(plant.C, np.eye(plant.n))
            start = np.nan_to_num(y[0]) if full else np.zeros(physical_states(plant))
        values, names = reference(plant, target, len(y))
        begin, driven = with_steps(
            plant, start, finite_array("disturbance", d, (len(y), width)), values, names
        )
        choice: Array = np.zeros((0, driven.shape[1]))
        if finer is not None:
            choice = finite_array("finer", finer, driven.shape)
        self._fill(
            outputs=frozen(y),
            disturbance=frozen(driven),
            x0=frozen(begin),
            target=frozen(values),
            signals=names,
            commands=frozen(_commands(commands, len(y), plant.m)),
            finer=frozen(choice),
            errors=frozen(_errors(offset, y.shape[1], driven.shape[1])),
            timing=frozen(_timing(timing or {}, plant, y.shape[1] + driven.shape[1])),
            label=label or Label(),
            findings=findings,
        )

    @property
    def offset(self) -> Array:
        """Offset (p,) contained in the recorded outputs."""
        return np.asarray(self.errors[OFFSET, : self.outputs.shape[1]])

    @property
    def corrected(self) -> Array:
        """Outputs without their errors (samples, p), for comparison; NaN where not recorded."""
        return undistorted(self.outputs, self.errors[:, : self.outputs.shape[1]])

    @property
    def has_gaps(self) -> bool:
        """Whether an output is missing at some sample."""
        return bool(np.isnan(self.outputs).any())

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.outputs)


def _require_no_end(values: Array) -> None:
    """Reject outputs that are NaN from some sample on, as of a simulation that stopped."""
    if values.ndim != 2:
        return
    finite = np.all(np.isfinite(values), axis=1)
    end = int(np.count_nonzero(finite))
    if 0 < end < len(finite) and np.all(finite[:end]) and np.all(np.isnan(values[end:])):
        raise DataError(
            "outputs",
            f"are NaN from sample {end} on",
            "cut them there; if simulated, use another initial state or wider bounds",
        )


def _errors(offset: ArrayLike | None, outputs: int, disturbances: int) -> Array:
    """Errors (kinds, p + d) with the given `offset` of the outputs."""
    errors = np.zeros((len(KINDS), outputs + disturbances))
    if offset is not None:
        errors[OFFSET, :outputs] = finite_array("offset", offset, (outputs,))
    return errors


def _timing(given: Mapping[str, float], plant: Plant, count: int) -> Array:
    """Standard deviations of the time shifts (count,) of outputs and disturbances."""
    found, known = np.zeros(count), (*plant.outputs, *plant.disturbances)
    for name, deviation in given.items():
        if name not in known:
            raise DataError("timing", f"no signal is named {name!r}", f"use {', '.join(known)}")
        if not 0 <= deviation < np.inf:
            raise DataError(f"timing of {name}", f"got {deviation}", "give seconds, 0 or more")
        found[known.index(name)] = deviation
    return found


def _with_gaps(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Array of float64 of that shape, with NaN for missing values."""
    array = with_shape(name, as_numbers(name, values), shape)
    require_finite(name, np.where(np.isnan(array), 0.0, array))
    return array


def _commands(given: ArrayLike | None, samples: int, width: int) -> Array:
    """Recorded commands with one row per sample (the last unused); (0, m) without any."""
    if given is None:
        return np.zeros((0, width))
    u = _with_gaps("commands", _columns(given), (None, width))
    if len(u) not in (samples - 1, samples):
        raise DataError("commands", f"has {len(u)} rows", f"give {samples - 1} or {samples}")
    return np.vstack([u[: samples - 1], np.full((1, width), np.nan)])


def _pushes(given: ArrayLike | None, samples: int, width: int) -> ArrayLike:
    """Disturbance with one row per sample."""
    if given is None:
        return np.zeros((samples, width))
    d = np.asarray(_columns(given))
    if width == 0 and d.size:
        remedy = (
            "name its controls: Plant(system, controls=[...]); the other inputs are disturbances"
        )
        raise DataError("disturbance", "is given, but the plant has none", remedy)
    short = d.ndim == 2 and len(d) == samples - 1
    return np.vstack([d, np.zeros((1, d.shape[1]))]) if short else d


def _columns(values: ArrayLike) -> ArrayLike:
    array = as_numbers("columns", values)
    return array[:, None] if array.ndim == 1 else array
