"""Chapter 2: the seated-balance test, on the simulated study of thirty subjects."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from experiments.reproduction.entry import Entry, Verdict, agrees, drawing, kind
from experiments.reproduction.evidence import table
from impc.studies.reliability.icc import icc
from impc.studies.reliability.measures import band_energy
from plants.ternary import ternary_sequence

if TYPE_CHECKING:
    from experiments.reproduction.evidence import Evidence

__all__ = ["STAND_IN", "balance_entries"]

STAND_IN = (
    "The dissertation's recordings are not public, and its numbers are lost. In their place: thirty"
    " simulated subjects, three visits, three conditions, three trials (`impc simulate"
    " reliability-study`, seed 0)."
)
_STUDY = "On simulated subjects."
_EXCELLENT = 0.75
_SIGNIFICANT = 0.05
# Shrout and Fleiss (1979), table 2: six targets, four judges; ICC(2,1) and ICC(2,4) there.
_JUDGED = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]


def balance_entries(evidence: Evidence) -> list[Entry]:
    """(2.1), tables 2.1 to 2.6, figures 2.1 to 2.6 and the claims of chapter 2."""
    result = evidence.reliability
    return [*_tables(result), *_figures(result), *_claims(result)]


def _tables(result: dict[str, Any]) -> list[Entry]:
    energy = _sine_energy()
    published = [icc(_JUDGED, form).value for form in ("A,1", "A,k")]
    rms, band = (_range(table(result, f"icc-{name}")["icc"]) for name in ("rms", "energy"))
    correlations = table(result, "cmc")
    within, between = (_range(correlations[f"{name}_visits"]) for name in ("within", "between"))
    return [
        Entry(
            "(2.1)",
            "Mean bandpass signal energy: frequency resolution times the sum of the power spectral"
            " density over the passband, the area under the curve.",
            ("impc.studies.reliability.measures:band_energy",),
            f"A sine of 2 deg has {energy:.4f} deg^2 (2 by Parseval: half the square).",
            agrees(abs(energy - 2) < 1e-9),
            "Whether `mean` carries another factor is lost.",
        ),
        Entry(
            "Table 2.1",
            "Height, weight and age of 19 females and 11 males.",
            ("impc.cli.simulate_studies",),
            "The simulated study draws subjects about 79.7 kg and 1.66 m.",
            Verdict.LOST,
            "The table's numbers are lost.",
        ),
        Entry(
            "Table 2.2",
            "ICC between visits of the RMS: excellent.",
            ("impc.studies.reliability.icc:icc", "impc.studies.reliability.report"),
            f"{rms[0]:.2f} to {rms[1]:.2f}. On the data of Shrout and Fleiss (1979): "
            f"{published[0]:.2f} and {published[1]:.2f} (.29 and .62 there).",
            kind(rms[0] >= _EXCELLENT),
            _STUDY,
        ),
        Entry(
            "Table 2.3",
            "ICC between visits of the bandpass energy: excellent.",
            ("impc.studies.reliability.icc:icc", "impc.studies.reliability.report"),
            f"{band[0]:.2f} to {band[1]:.2f}.",
            kind(band[0] >= _EXCELLENT),
            _STUDY,
        ),
        Entry(
            "Table 2.4",
            "CMC of the transfer functions within and between visits.",
            ("impc.studies.reliability.analysis:cmc",),
            f"Within {within[0]:.3f} to {within[1]:.3f}, between {between[0]:.3f} to"
            f" {between[1]:.3f}.",
            kind(min(within[0], between[0]) > _EXCELLENT),
            _STUDY,
        ),
        _p_values(result, "Table 2.5", "rms", "EO .05 and .29, EC .14 and .66, VIB .02 and .71"),
        _p_values(result, "Table 2.6", "energy", "EO .06 and .37, EC .44 and .57, VIB .05 and .70"),
    ]


def _figures(result: dict[str, Any]) -> list[Entry]:
    sequence = np.array(ternary_sequence())
    half = len(sequence) // 2
    opposite = bool(np.all(sequence[:half] == -sequence[half:]))
    band = result["passband"]
    return [
        drawing("Figure 2.1", "Seat and subject, upright and tilted."),
        drawing("Figure 2.2", "Physical model and block diagram."),
        Entry(
            "Figure 2.3",
            "Ternary torque of 5 N m and both angles of a trial.",
            (
                "impc.studies.reliability.figures:reliability_figures",
                "plants.ternary:ternary_torque",
            ),
            f"Sequence of {len(sequence)} steps; its second half is the negative of the first:"
            f" {'yes' if opposite else 'no'}.",
            kind(opposite),
            "Clock and order of the sequence are lost. " + _STUDY,
            "reliability/figures/trial.svg",
        ),
        Entry(
            "Figure 2.4",
            "Power spectral densities of torque and angles; the passband has more than 3 % of the"
            " torque's greatest power.",
            ("impc.studies.reliability.measures:passband", "impc.studies.reliability.figures"),
            f"Passband {band['low']:.2f} to {band['high']:.2f} Hz. Among excited frequencies: the"
            " sequence has no power at even harmonics, so no raw range is contiguous.",
            Verdict.IN_KIND,
            "The dissertation's passband is lost. " + _STUDY,
            "reliability/figures/trial.svg",
        ),
        Entry(
            "Figure 2.5",
            "Transfer functions of one subject over three visits.",
            ("impc.studies.reliability.measures:transfer_function",),
            "Amplitude and phase, from the torque to each angle, over the passband.",
            Verdict.IN_KIND,
            _STUDY,
            "reliability/figures/transfer-visits.svg",
        ),
        Entry(
            "Figure 2.6",
            "Transfer functions of three subjects.",
            ("impc.studies.reliability.measures:transfer_function",),
            "The same for three subjects: they differ more than visits do.",
            Verdict.IN_KIND,
            _STUDY,
            "reliability/figures/transfer-subjects.svg",
        ),
    ]


def _claims(result: dict[str, Any]) -> list[Entry]:
    parts = [
        Entry(
            "Claim, 2.3",
            statement,
            ("impc.studies.reliability.report",),
            numbers + ".",
            kind(found),
            _STUDY
            if found
            else "Nothing in the simulated study makes it so: the same noise acts on both bodies,"
            " and a visit changes the subject by less than its trials differ. " + _STUDY,
        )
        for statement, found, numbers in _looked_for(result)
    ]
    least = min(table(result, f"visits-{name}")["p"].min() for name in ("rms", "energy"))
    learnt = Entry(
        "Claim, 2.3",
        "Learning: RMS fell over visits with eyes open and with vibration, energy with vibration.",
        (
            "impc.studies.reliability.icc:visit_anova",
            "impc.studies.reliability.icc:learning_trend",
        ),
        f"Least of the twelve p values {least:.2f}.",
        kind(least <= _SIGNIFICANT),
        "The simulated subjects do not learn. " + _STUDY,
    )
    protocol = Entry(
        "Claim, 2.2.2",
        "Normalisation: twice the critical stiffness, and the greatest torque that is survived.",
        ("experiments.protocols", "experiments.normalisation"),
        "`python -m experiments.normalisation` runs both on the simulated subject.",
        Verdict.IN_KIND,
        "The text does not say whether the last success or the first failure is the critical"
        " stiffness; here the first failure.",
    )
    encoder = Entry(
        "Claim, 2.2.2",
        "Encoder and motion capture differ by 0.62 deg RMS.",
        ("impc.studies.reliability.measures:rms",),
        "A property of the apparatus.",
        Verdict.LOST,
        "It takes the apparatus.",
    )
    return [protocol, encoder, *parts, learnt]


def _looked_for(result: dict[str, Any]) -> list[tuple[str, bool, str]]:
    """Statements of chapter 2, whether each holds here, and the numbers."""
    iccs = pd.concat([table(result, f"icc-{name}") for name in ("rms", "energy")])
    least, means = float(iccs["icc"].min()), iccs.groupby("output", sort=False)["icc"].mean()
    lower, upper = (float(means[name]) for name in ("theta1", "theta2"))
    curves = table(result, "cmc")
    within, between = curves["within_visits"], curves["between_visits"]
    return [
        (
            "Between-visit reliability is excellent (ICC of 0.75 or more) for every measure.",
            least >= _EXCELLENT,
            f"least ICC {least:.2f}",
        ),
        (
            "The lower body is more reliable than the upper body.",
            lower > upper,
            f"mean ICC {lower:.2f} (theta1) and {upper:.2f} (theta2)",
        ),
        (
            "Transfer functions agree better within a visit than between visits (CMC).",
            bool((within > between).all()),
            f"mean CMC {within.mean():.3f} within, {between.mean():.3f} between",
        ),
    ]


def _p_values(result: dict[str, Any], item: str, measure: str, quoted: str) -> Entry:
    p = table(result, f"visits-{measure}").set_index(["output", "condition"])["p"]
    found = "; ".join(
        f"{condition} "
        + " and ".join(f"{p[output, condition]:.2f}" for output in ("theta1", "theta2"))
        for condition in ("EO", "EC", "VIB")
    )
    return Entry(
        item,
        f"Means over visits, and p values of the analysis of variance (lower and upper body):"
        f" {quoted}.",
        ("impc.studies.reliability.icc:visit_anova",),
        f"p: {found}.",
        Verdict.LOST,
        "The means are lost; p values belong to the thirty subjects. The simulated ones do not"
        " change between visits on average.",
    )


def _sine_energy() -> float:
    seconds = np.arange(3000) / 100
    sine = 2 * np.sin(2 * np.pi * seconds)[:, None]
    return float(band_energy(sine, 100.0, 0.5, 1.5)[0])


def _range(values: pd.Series[Any]) -> tuple[float, float]:
    return float(values.min()), float(values.max())
