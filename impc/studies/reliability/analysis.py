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
from impc.studies.reliability.anova import (
    learning_trend,
    variance_components,
    visit_anova,
)
from impc.studies.reliability.icc import icc, measurement_error
from impc.studies.reliability.measures import (
    band_energy,
    passband,
    rms,
    transfer_function,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.arrays import Array
    from impc.model.recordings import Recording
    from impc.studies.reliability.anova import Anova, Trend, VarianceComponent
    from impc.studies.reliability.icc import Icc, MeasurementError
    from impc.studies.reliability.measures import ComplexArray, Passband, TransferFunction

#: Name of a measure -> description.
MEASURES = {"rms": "sway (RMS about upright)", "energy": "energy in the band"}


@dataclass(frozen=True)
class Trials:
    """Recordings of a study."""

    outputs: tuple[str, ...]  # Names, in the order of the recordings' columns
    rate: float  # Samples per second
    # (subject, visit, condition) -> the trials analysed, in order
    cells: Mapping[tuple[str, str, str], tuple[Recording, ...]]
    words: Mapping[str, str] = field(default_factory=dict)  # Names of the outputs in words


@dataclass(frozen=True)
class MeasureResult:
    """One measure of one output in one condition."""

    measure: str  # One of `MEASURES`
    output: str
    condition: str
    # (subjects, visits), NaN if missing, in the output's unit (squared for energy)
    scores: Array
    icc: Icc | None = None  # ICC(A,k) between visits with the generalised interval
    # SEM and minimal detectable change (95 %) of the score of one visit, in its unit
    error: MeasurementError | None = None
    anova: Anova | None = None
    trend: Trend | None = None  # Change from visit to visit (learning)
    # Variance of subjects, visits and trials; empty if there are too few trials
    components: tuple[VarianceComponent, ...] = ()
    notes: tuple[str, ...] = ()  # Reasons for missing results


@dataclass(frozen=True)
class CmcResult:
    """Coefficients of multiple correlation of one output in one condition, by subject."""

    output: str
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
    outputs: tuple[str, ...]
    band: Passband  # Passband of the input
    measures: tuple[MeasureResult, ...]
    cmc: tuple[CmcResult, ...]
    # (subject, visit, condition) -> transfer function, mean over trials
    responses: Mapping[tuple[str, str, str], TransferFunction]
    notes: tuple[str, ...]  # Notes on the whole study


def analyse(trials: Trials) -> Reliability:
    """Analyse a study."""
    if not trials.cells:
        raise DataError("study", "has no trial", "check [study] recordings, table or bids")
    # In the order of their first occurrence.
    subjects, visits, conditions = (
        tuple(dict.fromkeys(one)) for one in zip(*trials.cells, strict=True)
    )
    lengths = [item.samples for cell in trials.cells.values() for item in cell]
    samples, rate = min(lengths), trials.rate
    notes = []
    if max(lengths) > samples:
        notes.append(f"Trials have {samples} to {max(lengths)} samples; all were cut to {samples}.")
    inputs = {
        key: [item.disturbance[:samples, 0] for item in cell] for key, cell in trials.cells.items()
    }
    outputs = {key: [item.outputs[:samples] for item in cell] for key, cell in trials.cells.items()}
    band = passband(next(iter(inputs.values()))[0], rate)
    responses = {
        key: transfer_function(inputs[key], outputs[key], rate, band) for key in trials.cells
    }
    # For each trial: scores by measure (p,), and its transfer function (frequencies, p).
    scores: dict[str, dict[tuple[str, str, str], list[Array]]] = {
        "rms": {key: [rms(item) for item in cell] for key, cell in outputs.items()},
        "energy": {
            key: [band_energy(item, rate, band.low, band.high) for item in cell]
            for key, cell in outputs.items()
        },
    }
    curves = {
        key: [
            transfer_function([one], [other], rate, band).response
            for one, other in zip(inputs[key], outputs[key], strict=True)
        ]
        for key in trials.cells
    }
    measures, cmc = [], []
    for condition in conditions:
        keys = [[(subject, visit, condition) for visit in visits] for subject in subjects]
        for place, output in enumerate(trials.outputs):
            for name, found in scores.items():
                table = [
                    [[float(one[place]) for one in found.get(key, ())] for key in row]
                    for row in keys
                ]
                measures.append(_measure(name, output, condition, table))
            own = [
                [[one[:, place] for one in curves[key]] for key in row if key in curves]
                for row in keys
            ]
            cmc.append(_cmc(output, condition, own))
    return Reliability(
        subjects, visits, conditions, trials.outputs, band, tuple(measures), tuple(cmc), responses,
        tuple(notes),
    )  # fmt: skip


def _measure(
    measure: str,
    output: str,
    condition: str,
    table: list[list[list[float]]],
) -> MeasureResult:
    """Analyse the scores of all trials, by subject and visit; an empty list is a missing cell."""
    scores = np.array([[np.mean(cell) if cell else np.nan for cell in row] for row in table])
    found: dict[str, Any] = {}
    notes: list[str] = []
    try:
        found |= {
            "icc": icc(scores, "A,k", method="generalised"),
            "error": measurement_error(scores),
        }
        if found["icc"].left_out:
            notes.append(f"{found['icc'].left_out} subjects lack a visit and are left out")
        found["anova"] = visit_anova(scores)
        found["trend"] = learning_trend(scores)
    except DataError as error:
        notes.append(str(error))
    complete = [row for row in table if all(row)]
    try:
        if not complete:
            raise DataError("scores", "no subject has all visits", "record all visits")
        fewest = min(len(cell) for row in complete for cell in row)
        even = np.array([[cell[-fewest:] for cell in row] for row in complete])
        found["components"] = variance_components(even)
    except DataError as error:
        notes.append(f"variance components: {error}")
    return MeasureResult(measure, output, condition, scores, **found, notes=tuple(notes))


def _cmc(output: str, condition: str, subjects: list[list[list[ComplexArray]]]) -> CmcResult:
    """CMC of the curves (frequencies,) of all trials, by subject and visit."""
    found, undefined = np.full((2, len(subjects)), np.nan), 0
    for place, visits in enumerate(subjects):
        fewest = min((len(trials) for trials in visits), default=0)
        if not fewest:
            continue
        curves = np.array([trials[-fewest:] for trials in visits])
        for row, make, count in ((0, cmc_within, fewest), (1, cmc_between, len(visits))):
            if count > 1:
                found[row, place] = make(curves)
                undefined += int(np.isnan(found[row, place]))
    return CmcResult(output, condition, found[0], found[1], undefined)


def cmc_within(curves: ComplexArray) -> float:
    """CMC within visits; curves (visits, trials, frequencies)."""
    M, N, T = curves.shape
    if N < 2 or T < 2:
        raise DataError("curves", f"got {N} trials, {T} frequencies", "give at least 2 of each")
    own = np.sum(np.abs(curves - curves.mean(axis=1, keepdims=True)) ** 2)
    all_of_visit = np.sum(np.abs(curves - curves.mean(axis=(1, 2), keepdims=True)) ** 2)
    return _root(own / (M * T * (N - 1)), all_of_visit, M * (N * T - 1))


def cmc_between(curves: ComplexArray) -> float:
    """CMC between visits; curves (visits, trials, frequencies)."""
    M, N, T = curves.shape
    if M < 2 or T < 2:
        raise DataError("curves", f"got {M} visits, {T} frequencies", "give at least 2 of each")
    own = np.sum(np.abs(curves - curves.mean(axis=(0, 1), keepdims=True)) ** 2)
    everything = np.sum(np.abs(curves - curves.mean()) ** 2)
    return _root(own / (T * (M * N - 1)), everything, M * N * T - 1)


def _root(own: float, squares: float, freedom: int) -> float:
    """Root of 1 minus the share of `own` in the mean square; NaN if negative."""
    share = 1 - own * freedom / squares if squares else -1.0
    return float(np.sqrt(share)) if share >= 0 else float("nan")
