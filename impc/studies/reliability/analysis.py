"""The reliability of a study: every measure by output and condition, over subjects and visits.

A score is the mean over the last trials of a visit (three, as in chapter 2). A subject who lacks a
visit is left out of that analysis, and the result says so.

Coefficient of multiple correlation of transfer functions, within and between visits.

Kadaba et al. (1989) for curves that are complex: |.| is the complex modulus, so that real and
imaginary parts are two coordinates of each frequency. Y_ijt at visit i of M, trial j of N,
frequency t of T:

    within   1 - [sum |Y_ijt - mean_j|^2 / (M T (N - 1))]
                 / [sum |Y_ijt - mean_jt|^2 / (M (N T - 1))]
    between  1 - [sum |Y_ijt - mean_ij|^2 / (T (M N - 1))]
                 / [sum |Y_ijt - mean_ijt|^2 / (M N T - 1)]

(the mean over the named indices) and the square root. Where the difference is negative there is no
root: NaN, which says that curves differ more than frequencies do.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError
from impc.studies.reliability.anova import (
    learning_trend,
    paired_tests,
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
    from impc.studies.reliability.anova import Anova, PairedTest, Trend, VarianceComponent
    from impc.studies.reliability.icc import Icc, MeasurementError
    from impc.studies.reliability.measures import ComplexArray, Passband, TransferFunction

#: Name of a measure -> what it is.
MEASURES = {"rms": "sway (RMS about upright)", "energy": "energy in the band"}


@dataclass(frozen=True)
class Trials:
    """Recordings of a study."""

    outputs: tuple[str, ...]  # Names, in the order of the recordings' columns
    rate: float  # Samples per second
    # (subject, visit, condition) -> the trials analysed, in order
    cells: Mapping[tuple[str, str, str], tuple[Recording, ...]]
    words: Mapping[str, str] = field(default_factory=dict)  # What outputs are called for readers


@dataclass(frozen=True)
class MeasureResult:
    """One measure of one output in one condition."""

    measure: str  # One of `MEASURES`
    output: str
    condition: str
    # (subjects, visits), NaN where a cell is missing, in the output's unit (squared for energy)
    scores: Array
    icc: Icc | None = None  # (A,k), between visits, with the generalised interval
    # Of the score of one visit, with the minimal detectable change (95 %), in the score's unit
    error: MeasurementError | None = None
    anova: Anova | None = None
    pairs: tuple[PairedTest, ...] = ()
    trend: Trend | None = None  # Learning: change from visit to visit
    # Of subjects, visits and trials; empty when trials are too few
    components: tuple[VarianceComponent, ...] = ()
    notes: tuple[str, ...] = ()  # Why something is missing


@dataclass(frozen=True)
class CmcResult:
    """Coefficients of multiple correlation of one output in one condition, by subject."""

    output: str
    condition: str
    within: Array  # (subjects,), NaN where there is none
    between: Array
    undefined: int  # How many are the root of a negative number


@dataclass(frozen=True)
class Reliability:
    """Everything that is found of a study."""

    subjects: tuple[str, ...]  # Names, in the order of the study
    visits: tuple[str, ...]
    conditions: tuple[str, ...]
    outputs: tuple[str, ...]
    band: Passband  # Of the input
    measures: tuple[MeasureResult, ...]
    cmc: tuple[CmcResult, ...]
    # (subject, visit, condition) -> transfer function, average over trials
    responses: Mapping[tuple[str, str, str], TransferFunction]
    notes: tuple[str, ...]  # On the study as a whole


def analyse(trials: Trials) -> Reliability:
    """Analyse a study."""
    if not trials.cells:
        raise DataError("study", "has no trial", "check where it looks for recordings")
    # In the order in which they come.
    subjects, visits, conditions = (
        tuple(dict.fromkeys(one)) for one in zip(*trials.cells, strict=True)
    )
    lengths = [item.samples for cell in trials.cells.values() for item in cell]
    samples, rate = min(lengths), trials.rate
    notes = []
    if max(lengths) > samples:
        notes.append(f"Trials have {samples} to {max(lengths)} samples: all were cut to {samples}.")
    inputs = {
        key: [item.disturbance[:samples, 0] for item in cell] for key, cell in trials.cells.items()
    }
    outputs = {key: [item.outputs[:samples] for item in cell] for key, cell in trials.cells.items()}
    band = passband(next(iter(inputs.values()))[0], rate)
    responses = {
        key: transfer_function(inputs[key], outputs[key], rate, band) for key in trials.cells
    }
    # Of each trial: scores by measure (p,), and its own transfer function (frequencies, p).
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
                measures.append(_measure(name, output, condition, table, visits))
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
    visits: tuple[str, ...],
) -> MeasureResult:
    """Scores of every trial, by subject and visit, analysed; an empty list is a missing cell."""
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
        found["pairs"] = paired_tests(scores, visits)
        found["trend"] = learning_trend(scores)
    except DataError as error:
        notes.append(str(error))
    complete = [row for row in table if all(row)]
    try:
        if not complete:
            raise DataError("scores", "are complete for no subject", "record every visit")
        fewest = min(len(cell) for row in complete for cell in row)
        even = np.array([[cell[-fewest:] for cell in row] for row in complete])
        found["components"] = variance_components(even)
    except DataError as error:
        notes.append(f"variance components: {error}")
    return MeasureResult(measure, output, condition, scores, **found, notes=tuple(notes))


def _cmc(output: str, condition: str, subjects: list[list[list[ComplexArray]]]) -> CmcResult:
    """Of the curves (frequencies,) of every trial, by subject and visit."""
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
    """Within visits; curves (visits, trials, frequencies)."""
    M, N, T = curves.shape
    if N < 2 or T < 2:
        raise DataError("curves", f"are of {N} trials, {T} frequencies", "a CMC needs 2 or more")
    own = np.sum(np.abs(curves - curves.mean(axis=1, keepdims=True)) ** 2)
    all_of_visit = np.sum(np.abs(curves - curves.mean(axis=(1, 2), keepdims=True)) ** 2)
    return _root(own / (M * T * (N - 1)), all_of_visit, M * (N * T - 1))


def cmc_between(curves: ComplexArray) -> float:
    """Between visits; curves (visits, trials, frequencies)."""
    M, N, T = curves.shape
    if M < 2 or T < 2:
        raise DataError("curves", f"are of {M} visits, {T} frequencies", "a CMC needs 2 or more")
    own = np.sum(np.abs(curves - curves.mean(axis=(0, 1), keepdims=True)) ** 2)
    everything = np.sum(np.abs(curves - curves.mean()) ** 2)
    return _root(own / (T * (M * N - 1)), everything, M * N * T - 1)


def _root(own: float, squares: float, freedom: int) -> float:
    """Of one less the share of `own` in the mean square; NaN where there is none."""
    share = 1 - own * freedom / squares if squares else -1.0
    return float(np.sqrt(share)) if share >= 0 else float("nan")
