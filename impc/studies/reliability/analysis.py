"""Reliability of all measures by output and condition, over subjects and visits.

A score is the mean over the last trials of a visit (three, as in chapter 2). Subjects without all
visits are left out of an analysis, with a note.

Coefficient of multiple correlation (CMC) of transfer functions, after Kadaba et al. (1989), for
complex curves: |.| is the complex modulus. With Y_ijt at visit i of M, trial j of N, frequency t of
T:

    within   1 - [sum |Y_ijt - mean_j|^2 / (M T (N - 1))]
                 / [sum |Y_ijt - mean_jt|^2 / (M (N T - 1))]
    between  1 - [sum |Y_ijt - mean_ij|^2 / (T (M N - 1))]
                 / [sum |Y_ijt - mean_ijt|^2 / (M N T - 1)]

where mean_j is the mean over j, and so on; the CMC is the square root. If the difference is
negative, the CMC is NaN: curves differ more between trials than between frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError
from impc.studies.reliability.icc import (
    Anova,
    Icc,
    MeasurementError,
    Trend,
    icc,
    learning_trend,
    measurement_error,
    visit_anova,
)
from impc.studies.reliability.measures import band_energy, passband, rms, transfer_function

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.arrays import Array
    from impc.studies.reliability.measures import ComplexArray, Passband, TransferFunction

#: Name of a measure -> description.
MEASURES = {"rms": "sway (RMS about upright)", "energy": "energy in the band"}


@dataclass(frozen=True)
class Trials:
    """Recordings of a study."""

    outputs: Mapping[str, str]  # Names of the outputs, in order -> names in words
    unit: str  # Of the outputs
    rate: float  # Samples per second
    # (subject, visit, condition) -> torque (samples,) and outputs (samples, p) of each trial
    cells: Mapping[tuple[str, str, str], Sequence[tuple[Array, Array]]]


@dataclass(frozen=True)
class MeasureResult:
    """One measure of one output in one condition; NaN where a result is missing."""

    measure: str  # One of `MEASURES`
    output: str
    signal: str  # The output in words
    condition: str
    unit: str  # Of the scores: the output's, squared for energy
    scores: Array  # (subjects, visits), NaN if missing
    # ICC(A,k) between visits with the generalised interval, and with that of McGraw and Wong
    icc: Icc = field(default_factory=Icc)
    icc_f: Icc = field(default_factory=Icc)
    # SEM and minimal detectable change (95 %) of the score of one visit
    error: MeasurementError = field(default_factory=MeasurementError)
    anova: Anova = field(default_factory=Anova)
    # Change from visit to visit (learning)
    trend: Trend = field(default_factory=Trend)
    notes: tuple[str, ...] = ()  # Reasons for missing results

    @property
    def name(self) -> str:
        """Name in words; the RMS of a tilt is called sway."""
        if self.measure == "energy":
            return f"band energy of {self.signal}"
        tilt = self.signal.removesuffix(" tilt")
        return f"RMS of {self.signal}" if tilt == self.signal else f"{tilt} sway"


@dataclass(frozen=True)
class CmcResult:
    """Coefficients of multiple correlation of one output in one condition, by subject."""

    output: str
    signal: str  # The output in words
    condition: str
    within: Array  # (subjects,), NaN if undefined
    between: Array
    undefined: int  # Number of undefined coefficients (root of a negative number)


@dataclass(frozen=True)
class Reliability:
    """Results of a reliability study."""

    subjects: tuple[str, ...]  # Names, in the order of the study
    visits: tuple[str, ...]
    conditions: tuple[str, ...]
    band: Passband  # Passband of the input
    measures: tuple[MeasureResult, ...]
    cmc: tuple[CmcResult, ...]
    # (subject, visit, condition) -> transfer function, mean over trials
    responses: Mapping[tuple[str, str, str], TransferFunction]
    notes: tuple[str, ...]  # Notes on the whole study

    @property
    def known(self) -> list[MeasureResult]:
        """Measures with an ICC, RMS first, sorted by signal."""
        signals = [item.output for item in self.measures]
        found = [item for item in self.measures if item.icc.subjects]
        return sorted(found, key=lambda it: (it.measure != "rms", signals.index(it.output)))


def analyse(trials: Trials) -> Reliability:
    """Analyse a study."""
    if not trials.cells:
        raise DataError("study", "has no trial", "check [study] recordings, table or bids")
    # In the order of their first occurrence.
    subjects, visits, conditions = (
        tuple(dict.fromkeys(one)) for one in zip(*trials.cells, strict=True)
    )
    lengths = [len(torque) for cell in trials.cells.values() for torque, _ in cell]
    samples, rate = min(lengths), trials.rate
    notes = []
    if max(lengths) > samples:
        notes.append(f"Trials have {samples} to {max(lengths)} samples; all were cut to {samples}.")
    # Of each cell: inputs (trials, samples) and outputs (trials, samples, p).
    cells = {
        key: [np.stack([signal[:samples] for signal in each]) for each in zip(*cell, strict=True)]
        for key, cell in trials.cells.items()
    }
    band = passband(next(iter(cells.values()))[0][0], rate)
    # Of each trial: scores by measure (trials, p), and transfer function (trials, frequencies, p).
    scores = {
        "rms": {key: rms(y) for key, (_, y) in cells.items()},
        "energy": {key: band_energy(y, rate, band.low, band.high) for key, (_, y) in cells.items()},
    }
    curves = {
        key: np.stack([
            transfer_function(one[None], other[None], rate, band).response
            for one, other in zip(*cell, strict=True)
        ])
        for key, cell in cells.items()
    }  # fmt: skip
    measures, agreement = [], []
    for condition in conditions:
        keys = [[(subject, visit, condition) for visit in visits] for subject in subjects]
        for place, (output, signal) in enumerate(trials.outputs.items()):
            named = output, signal, condition
            for name, found in scores.items():
                table = [
                    [np.mean(found[key][:, place]) if key in found else np.nan for key in row]
                    for row in keys
                ]
                unit = trials.unit if name == "rms" else f"{trials.unit}²"
                measures.append(measured(name, *named, unit, np.array(table)))
            own = [[curves[key][..., place] for key in row if key in curves] for row in keys]
            agreement.append(_cmc(*named, own))
    responses = {key: transfer_function(u, y, rate, band) for key, (u, y) in cells.items()}
    return Reliability(
        subjects, visits, conditions, band, tuple(measures), tuple(agreement), responses,
        tuple(notes),
    )  # fmt: skip


def measured(
    measure: str, output: str, signal: str, condition: str, unit: str, scores: Array
) -> MeasureResult:
    """Analyse the scores (subjects, visits); NaN is a missing visit."""
    found: dict[str, Any] = {}
    notes: list[str] = []
    try:
        found["icc"] = icc(scores, "A,k", method="generalised")
        found["icc_f"], found["error"] = icc(scores, "A,k"), measurement_error(scores)
        if found["icc"].left_out:
            notes.append(f"{found['icc'].left_out} subjects lack a visit and are left out")
        found["anova"], found["trend"] = visit_anova(scores), learning_trend(scores)
    except DataError as error:
        notes.append(str(error))
    named = measure, output, signal, condition, unit, scores
    return MeasureResult(*named, **found, notes=tuple(notes))


def _cmc(output: str, signal: str, condition: str, subjects: list[list[ComplexArray]]) -> CmcResult:
    """CMC of the curves (trials, frequencies), by subject and visit."""
    found, undefined = np.full((2, len(subjects)), np.nan), 0
    for place, visits in enumerate(subjects):
        fewest = min(map(len, visits), default=0)
        for row, over, count in ((0, (1,), fewest), (1, (0, 1), len(visits))):
            if count > 1:
                found[row, place] = cmc(np.array([one[-fewest:] for one in visits]), over)
                undefined += int(np.isnan(found[row, place]))
    return CmcResult(output, signal, condition, found[0], found[1], undefined)


def cmc(curves: ComplexArray, over: tuple[int, ...]) -> float:
    """CMC of curves (visits, trials, frequencies): over (1,) within visits, (0, 1) between."""
    own, everything = (
        np.sum(np.abs(curves - mean) ** 2) / (curves.size - mean.size)
        for mean in (curves.mean(axis=axes, keepdims=True) for axes in (over, (*over, 2)))
    )
    share = 1 - own / everything if everything else -1.0
    return float(np.sqrt(share)) if share >= 0 else np.nan
