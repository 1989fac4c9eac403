"""Chapter 2: the seated-balance test, on the simulated study of thirty subjects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from experiments.reproduction.evidence import Evidence, table
from impc.studies.reliability.icc import icc
from impc.studies.reliability.measures import band_energy
from plants.ternary import ternary_sequence

__all__ = ["balance_values", "exact_values"]

_EXCELLENT, _SIGNIFICANT = 0.75, 0.05
# Shrout and Fleiss (1979), table 2: six targets, four judges; ICC(2,1) and ICC(2,4) there.
_JUDGED = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]


def balance_values(evidence: Evidence) -> dict[str, Any]:
    """Values of (2.1), tables 2.1 to 2.6, figures 2.1 to 2.6 and the claims of chapter 2."""
    result = evidence.reliability
    rms, band = (_range(table(result, f"icc-{name}")["icc"]) for name in ("rms", "energy"))
    curves = table(result, "cmc")
    within, between = curves["within_visits"], curves["between_visits"]
    iccs = pd.concat([table(result, f"icc-{name}") for name in ("rms", "energy")])
    least, means = float(iccs["icc"].min()), iccs.groupby("output", sort=False)["icc"].mean()
    least_p = min(table(result, f"visits-{name}")["p"].min() for name in ("rms", "energy"))
    return exact_values() | {
        "reliability": result,
        "rms": rms,
        "rms_is_excellent": rms[0] >= _EXCELLENT,
        "band": band,
        "band_is_excellent": band[0] >= _EXCELLENT,
        "within": _range(within),
        "between": _range(between),
        "curves_agree": min(within.min(), between.min()) > _EXCELLENT,
        "p_rms": _p_values(result, "rms"),
        "p_energy": _p_values(result, "energy"),
        "least_icc": least,
        "all_are_excellent": least >= _EXCELLENT,
        "icc_means": means,
        "lower_is_better": means["theta1"] > means["theta2"],
        "cmc_means": (within.mean(), between.mean()),
        "visits_differ": bool((within > between).all()),
        "least_p": least_p,
        "subjects_learn": least_p <= _SIGNIFICANT,
    }


def exact_values() -> dict[str, Any]:
    """Those that need no recordings."""
    energy, sequence = _sine_energy(), np.array(ternary_sequence())
    half = len(sequence) // 2
    return {
        "energy": energy,
        "energy_is_exact": abs(energy - 2) < 1e-9,
        "published": [icc(_JUDGED, form).value for form in ("A,1", "A,k")],
        "steps": len(sequence),
        "second_half_is_opposite": bool(np.all(sequence[:half] == -sequence[half:])),
    }


def _p_values(result: dict[str, Any], measure: str) -> str:
    """p values of the lower and the upper body in the three conditions."""
    p = table(result, f"visits-{measure}").set_index(["output", "condition"])["p"]
    return "; ".join(
        f"{condition} {p['theta1', condition]:.2f} and {p['theta2', condition]:.2f}"
        for condition in ("EO", "EC", "VIB")
    )


def _sine_energy() -> float:
    """Energy of a sine of amplitude 2 in a band around it."""
    sine = 2 * np.sin(2 * np.pi * np.arange(3000) / 100)[:, None]
    return float(band_energy(sine, 100.0, 0.5, 1.5)[0])


def _range(values: pd.Series[Any]) -> tuple[float, float]:
    return float(values.min()), float(values.max())
