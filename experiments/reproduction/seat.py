"""Chapter 3, second half: the seated-balance experiment, on a simulated subject."""

from __future__ import annotations

import json
from typing import Any

import control
import numpy as np

from experiments.reproduction.evidence import Evidence
from impc.assess.variance_accounted_for import vaf
from impc.inverse.inverse_lqr import inverse_lqr_lmi
from impc.model.plant import Plant
from plants.actuation import delayed_muscle
from plants.seated_balance import continuous_seated_balance_plant
from plants.seated_parameters import SeatedBalanceParameters

__all__ = ["seat_values"]


def seat_values(evidence: Evidence) -> dict[str, Any]:
    """Values of (3.18) to (3.26), table 3.2, figures 3.5 to 3.7 and the claims: `impc fit`."""
    truth = json.loads((evidence.folder / "subject" / "truth.json").read_text("utf-8"))
    return _body_values() | _fit_values(evidence.fit, truth) | _intent_values(evidence.fit, truth)


def _body_values() -> dict[str, Any]:
    parameters, plant = SeatedBalanceParameters(), continuous_seated_balance_plant()
    body_gap, recorded = _linearisation_gap(parameters), np.sin(np.arange(100.0))[:, None]
    ten_per_cent = float(vaf(recorded, 0.9 * recorded)[0])
    return {
        "body_gap": body_gap,
        "body_agrees": body_gap < 1e-8,
        "seat_states": plant.nstates,
        "has_ten_states": plant.nstates == 10,
        "delay_gap": _delay_gap(parameters),
        "seat_values": ", ".join(
            f"{name} {getattr(parameters, name):g}" for name in parameters.__annotations__
        ),
        "ten_per_cent": ten_per_cent,
        "vaf_is_exact": abs(ten_per_cent - 99) < 1e-9,
    }


def _fit_values(fit: dict[str, Any], truth: dict[str, Any]) -> dict[str, Any]:
    start = fit["methods"]["feedback_gain"]
    A, B = np.array(fit["plant"]["A"]), np.array(fit["plant"]["B"])
    plant = Plant(control.ss(A, B, np.eye(len(A)), np.zeros(B.shape), fit["plant"]["dt"]))
    lmi = inverse_lqr_lmi(plant, start["K"])

    def shares(method: str) -> str:
        return " and ".join(f"{value:.1f}" for value in fit["methods"][method]["vaf"].values())

    return {
        "fit": fit,
        "vaf_lqr": shares("inverse_lqr"),
        "vaf_gain": shares("feedback_gain"),
        "fit_is_close": min(fit["vaf"].values()) > 90,
        "lmi_status": lmi.status,
        "lmi_fails": not lmi.feasible,
        "unbounded_input": max(start["largest_input"].values()),
        "gain_ratio": start["K"][0][0] / truth["K"][0][0],
    }


def _intent_values(fit: dict[str, Any], truth: dict[str, Any]) -> dict[str, Any]:
    Q, dominant = np.array(fit["Q"]), np.array(fit["intent"]["dominant"])
    values, T = np.linalg.eigh(Q)
    off = float(np.max(np.abs(T.T @ Q @ T - np.diag(values))) / values[-1])
    readings = fit["intent"]["readings"]
    return {
        "eigenvalues": values[[0, -2, -1]],
        "off_diagonal": off,
        "eigenvectors_agree": off < 1e-9,
        "signs_agree": bool(np.all(np.sign(dominant[:4]) == np.sign(dominant[0]))),
        "widest_angle": max(item["angle"] for item in readings),
        "rules": len(readings),
        "true_eigenvalues": np.linalg.eigvalsh(np.array(truth["Q"]))[-2:],
        "cost_is_positive": values[0] > 0,
    }


def _linearisation_gap(p: SeatedBalanceParameters) -> float:
    """The plant against M q'' + C q' + G q = [1; 0] d + [-1; 1] u, written out by hand."""
    coupling = p.m2 * p.l12 * p.l2
    M = [[p.J1 + p.m1 * p.l1**2 + p.m2 * p.l12**2, coupling], [coupling, p.J2 + p.m2 * p.l2**2]]
    C = [[p.c_r + p.c_h, -p.c_h], [-p.c_h, p.c_h]]
    lower, upper = (p.m1 * p.l1 + p.m2 * p.l12) * p.gravity, p.m2 * p.l2 * p.gravity
    G = [[p.k_r + p.k_h - lower, -p.k_h], [-p.k_h, p.k_h - upper]]
    by_hand = np.linalg.solve(M, -np.hstack([G, C]))
    return float(np.max(np.abs(continuous_seated_balance_plant(p).A[2:4, :4] - by_hand)))


def _delay_gap(parameters: SeatedBalanceParameters) -> float:
    """Delay and muscle against their exact frequency response."""
    chain = delayed_muscle(parameters.tau_d, parameters.tau_m, 5)
    gaps = []
    for omega in np.linspace(0.1, 20, 200):
        s = 1j * omega
        inner = np.linalg.solve(s * np.eye(len(chain.A)) - chain.A, chain.B)
        found = (chain.C @ inner + chain.D).item()
        gaps.append(abs(found - np.exp(-s * parameters.tau_d) / (parameters.tau_m * s + 1)))
    return float(max(gaps))
