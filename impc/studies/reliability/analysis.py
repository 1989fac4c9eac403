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

from dataclasses import dataclass
from typing import TYPE_CHECKING

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
    ComplexArray,
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
    from impc.studies.reliability.icc import Form, Icc, MeasurementError
    from impc.studies.reliability.measures import Passband, TransferFunction

#: Name of a measure -> what it is.
MEASURES = {"rms": "root-mean-square about upright", "energy": "mean bandpass signal energy (2.1)"}
_FORM: Form = "A,k"


@dataclass(frozen=True)
class Trials:
    """Recordings of a study."""

    outputs: tuple[str, ...]  # Names, in the order of the recordings' columns
    rate: float  # Samples per second
    # (subject, visit, condition) -> the trials analysed, in order
    cells: Mapping[tuple[str, str, str], tuple[Recording, ...]]

    def labels(self, index: int) -> tuple[str, ...]:
        """Subjects (`index` 0), visits (1) or conditions (2) in the order in which they come."""
        return tuple(dict.fromkeys(key[index] for key in self.cells))


@dataclass(frozen=True)
class MeasureResult:
    """One measure of one output in one condition."""

    measure: str  # Of which, by name; the measure is one of `MEASURES`
    output: str
    condition: str
    # (subjects, visits), NaN where a cell is missing, in the output's unit (squared for energy)
    scores: Array
    icc: Icc | None  # (A,k), between visits, with the generalised interval
    # Of the score of one visit, with the minimal detectable change (95 %), in the score's unit
    error: MeasurementError | None
    anova: Anova | None
    pairs: tuple[PairedTest, ...]
    trend: Trend | None  # Learning: change from visit to visit
    # Of subjects, visits and trials; empty when trials are too few
    components: tuple[VarianceComponent, ...]
    notes: tuple[str, ...]  # Why something is missing


@dataclass(frozen=True)
class CmcResult:
    """Coefficients of multiple correlation of one output in one condition, by subject."""

    output: str  # Of which, by name
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
    subjects, visits, conditions = (trials.labels(index) for index in range(3))
    samples = min(item.samples for cell in trials.cells.values() for item in cell)
    longest = max(item.samples for cell in trials.cells.values() for item in cell)
    notes = []
    if longest > samples:
        notes.append(f"Trials have {samples} to {longest} samples: all were cut to {samples}.")
    first = next(iter(trials.cells.values()))[0]
    band = passband(first.disturbance[:samples, 0], trials.rate)
    measures, cmc = [], []
    for condition in conditions:
        for output in range(len(trials.outputs)):
            for name in MEASURES:
                table = _trial_scores(trials, name, output, condition, band, samples)
                measures.append(_measure(name, trials.outputs[output], condition, table, visits))
            cmc.append(_cmc(trials, output, condition, band, samples))
    responses = {
        key: transfer_function(
            [item.disturbance[:samples, 0] for item in cell],
            [item.outputs[:samples] for item in cell],
            trials.rate,
            band,
        )
        for key, cell in trials.cells.items()
    }
    return Reliability(
        subjects,
        visits,
        conditions,
        trials.outputs,
        band,
        tuple(measures),
        tuple(cmc),
        responses,
        tuple(notes),
    )


def _trial_scores(
    trials: Trials, measure: str, output: int, condition: str, band: Passband, samples: int
) -> list[list[list[float]]]:
    """Scores of every trial, by subject and visit; an empty list where a cell is missing."""

    def score(trial: Recording) -> float:
        values = trial.outputs[:samples, output : output + 1]
        if measure == "rms":
            return float(rms(values)[0])
        return float(band_energy(values, trials.rate, band.low, band.high)[0])

    return [
        [
            [score(item) for item in trials.cells.get((subject, visit, condition), ())]
            for visit in trials.labels(1)
        ]
        for subject in trials.labels(0)
    ]


def _measure(
    measure: str,
    output: str,
    condition: str,
    table: list[list[list[float]]],
    visits: tuple[str, ...],
) -> MeasureResult:
    scores = np.array([[np.mean(cell) if cell else np.nan for cell in row] for row in table])
    notes: list[str] = []
    found, measured, anova, trend = None, None, None, None
    pairs: tuple[PairedTest, ...] = ()
    try:
        found = icc(scores, _FORM, method="generalised")
        measured = measurement_error(scores)
        if found.left_out:
            notes.append(f"{found.left_out} subjects lack a visit and are left out")
        anova = visit_anova(scores)
        pairs = paired_tests(scores, visits)
        trend = learning_trend(scores)
    except DataError as error:
        notes.append(str(error))
    components: tuple[VarianceComponent, ...] = ()
    try:
        components = variance_components(_even(table))
    except DataError as error:
        notes.append(f"variance components: {error}")
    return MeasureResult(
        measure,
        output,
        condition,
        scores,
        found,
        measured,
        anova,
        pairs,
        trend,
        components,
        tuple(notes),
    )


def _even(table: list[list[list[float]]]) -> Array:
    """Scores (subjects, visits, trials) of the subjects with all visits, trials cut alike."""
    complete = [row for row in table if all(row)]
    if not complete:
        raise DataError("scores", "are complete for no subject", "record every visit")
    fewest = min(len(cell) for row in complete for cell in row)
    return np.array([[cell[-fewest:] for cell in row] for row in complete])


def _cmc(trials: Trials, output: int, condition: str, band: Passband, samples: int) -> CmcResult:
    within, between, undefined = [], [], 0
    for subject in trials.labels(0):
        cells = [trials.cells.get((subject, visit, condition), ()) for visit in trials.labels(1)]
        present = [cell for cell in cells if cell]
        fewest = min((len(cell) for cell in present), default=0)
        pair = [float("nan"), float("nan")]
        if fewest:
            curves = np.array(
                [
                    [_curve(item, trials.rate, band, samples, output) for item in cell[-fewest:]]
                    for cell in present
                ]
            )
            for place, (make, count) in enumerate(
                ((cmc_within, curves.shape[1]), (cmc_between, curves.shape[0]))
            ):
                if count > 1:
                    pair[place] = make(curves)
                    undefined += np.isnan(pair[place])
        within.append(pair[0])
        between.append(pair[1])
    return CmcResult(
        trials.outputs[output], condition, np.array(within), np.array(between), int(undefined)
    )


def _curve(trial: Recording, rate: float, band: Passband, samples: int, output: int) -> Array:
    found = transfer_function(
        [trial.disturbance[:samples, 0]], [trial.outputs[:samples]], rate, band
    )
    return np.asarray(found.response[:, output])


def cmc_within(curves: ComplexArray) -> float:
    """Within visits; curves (visits, trials, frequencies)."""
    M, N, T = _shape(curves, trials=2)
    own = np.sum(np.abs(curves - curves.mean(axis=1, keepdims=True)) ** 2)
    all_of_visit = np.sum(np.abs(curves - curves.mean(axis=(1, 2), keepdims=True)) ** 2)
    return _root(own / (M * T * (N - 1)), all_of_visit / (M * (N * T - 1)))


def cmc_between(curves: ComplexArray) -> float:
    """Between visits; curves (visits, trials, frequencies)."""
    M, N, T = _shape(curves, visits=2)
    own = np.sum(np.abs(curves - curves.mean(axis=(0, 1), keepdims=True)) ** 2)
    everything = np.sum(np.abs(curves - curves.mean()) ** 2)
    return _root(own / (T * (M * N - 1)), everything / (M * N * T - 1))


def _shape(curves: ComplexArray, visits: int = 1, trials: int = 1) -> tuple[int, int, int]:
    if curves.ndim != 3:
        raise DataError(
            "curves", f"have {curves.ndim} dimensions", "give visits, trials, frequencies"
        )
    M, N, T = curves.shape
    for count, least, name in ((M, visits, "visits"), (N, trials, "trials"), (T, 2, "frequencies")):
        if count < least:
            raise DataError("curves", f"are of {count} {name}", f"a CMC needs {least} or more")
    return M, N, T


def _root(own: float, total: float) -> float:
    if total == 0:
        return float("nan")
    share = 1 - own / total
    return float(np.sqrt(share)) if share >= 0 else float("nan")
