"""Chapter 3, first half: the controller, inverse MPC, and the example of section 3.4."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.certificates import (
    cholesky_parameters,
    invariance_violation,
    maximality_violation,
    weights_from_parameters,
)
from experiments.reference_mpc import simulate_mpc
from experiments.reproduction.evidence import Evidence
from impc.arrays import Array
from impc.control.casadi_controller import build_mpc
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.control.terminal_set import maximal_invariant_set
from impc.errors import InputError
from impc.inverse.estimates import Estimate
from impc.inverse.problem import Problem
from impc.inverse.table31 import inverse_mpc, table_3_1
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from impc.studies.example.cases import BOUND, CASES, HORIZON, STEPS
from plants import yalmip_example

__all__ = ["controller_values", "example_values"]


def controller_values() -> dict[str, Any]:
    """Values of (3.1) to (3.7) and table 3.1, on the stand-in plant of the example."""
    plant = Plant(yalmip_example())
    bounds, weights = Bounds(plant, u_min=-BOUND, u_max=BOUND), Weights(np.eye(2), 1.0)
    lqr = solve_lqr(plant, weights)
    controller = Controller(plant, weights, bounds, HORIZON)
    given = scenario(plant, x0=CASES["B"], steps=STEPS)
    ours = simulate(controller, given)
    gaps = {
        name: float(np.max(np.abs(simulate_mpc(build_mpc(controller, name), given).u - ours.u)))
        for name in ("qpoases", "daqp", "ipopt")
    }
    reference, P = _dynamic_programming(plant.A, plant.B)
    gain_gap, riccati_gap = np.max(np.abs(lqr.K - reference)), np.max(np.abs(lqr.P - P))
    terminal = maximal_invariant_set(plant, lqr.K, bounds)
    left, missed = invariance_violation(terminal), maximality_violation(terminal)
    scaled = Controller(plant, Weights(7 * np.eye(2), 7.0), bounds, HORIZON)
    ray = np.max(np.abs(simulate(scaled, given).u - ours.u))
    recorded = Problem(plant, bounds, HORIZON, (Recording(plant, ours.x),))
    direct = _off(inverse_mpc(recorded, Weights(np.diag([2.0, 0.5]), 1.0)))
    whole = {case: _table_3_1(controller, case) for case in "AB"}
    missed_Q = {case: _off(lines["inverse_mpc"]) for case, lines in whole.items()}
    branches = {
        case: "gradient" if lines["inverse_lqr_lmi"].weights is None else "LMI"
        for case, lines in whole.items()
    }
    factor = weights_from_parameters(cholesky_parameters(weights), 2, 1)
    return {
        "loop_gaps": ", ".join(f"{gap:.0e} ({name})" for name, gap in gaps.items()),
        "loops_agree": max(gaps.values()) < 1e-6,
        "refusal": _refusal(),
        "lqr_gain": f"[{lqr.K[0, 0]:.5f} {lqr.K[0, 1]:.5f}]",
        "gain_gap": gain_gap,
        "gain_agrees": gain_gap < 1e-9,
        "riccati_gap": riccati_gap,
        "riccati_agrees": riccati_gap < 1e-9,
        "set_rows": len(terminal.h),
        "set_steps": terminal.determinedness,
        "set_left": left,
        "set_missed": missed,
        "set_is_maximal": max(left, missed) < 1e-9,
        "ray": ray,
        "scale_is_free": ray < 1e-12,
        "direct_gap": direct,
        "factor_gap": np.max(np.abs(factor.Q - np.eye(2))),
        "direct_finds_it": direct < 1e-6,
        "table_31": "; ".join(
            f"case {case}: {branches[case]} branch, Q = I to {missed_Q[case]:.0e}" for case in "AB"
        ),
        "table_31_holds": max(missed_Q.values()) < 1e-6
        and branches == {"A": "gradient", "B": "LMI"},
    }


def example_values(evidence: Evidence) -> dict[str, Any]:
    """Values of (3.8) to (3.17), figures 3.2 to 3.4 and the claims: `impc example`, case A."""
    case = evidence.example["cases"]["A"]
    methods, truth = case["methods"], case["truth"]
    gain, mpc = methods["feedback_gain"], methods["inverse_mpc"]
    output = methods["inverse_lqr_output"]
    saturated = sum(abs(abs(u[0]) - BOUND) < 1e-9 for u in truth["u"])
    residuals = {name: it["distance"] for name, it in methods.items() if it["distance"] is not None}
    largest = {name: it["largest_input"]["u"] for name, it in methods.items()}
    least_lqr = min(value for name, value in residuals.items() if "lqr" in name)
    unbounded = min(largest["feedback_gain"], largest["inverse_lqr_output"])
    return {
        "truth": truth,
        "bound": BOUND,
        "residuals": "; ".join(f"{name} {value:.2g}" for name, value in residuals.items()),
        "K_3_12": _matrix(gain["K"]),
        "Q_3_13": _matrix(methods["inverse_lqr_gradient"]["Q"]),
        "Q_3_14": _matrix(methods["inverse_lqr_auxiliary"]["Q"]),
        "Q_3_17": _matrix(output["Q"]),
        "K_3_17": _matrix(output["K"]),
        "mpc": mpc,
        "gain": gain,
        "output": output,
        "least_lqr": least_lqr,
        "mpc_is_closest": mpc["distance"] < 1e-6 < least_lqr,
        "largest": largest,
        "gain_exceeds": largest["feedback_gain"] > BOUND,
        "mpc_is_perfect": mpc["misfit"] < 1e-9,
        "output_is_worse": output["misfit"] > gain["misfit"],
        "saturated": saturated,
        "example_steps": STEPS,
        "input_saturates": saturated > 0,
        "only_mpc_keeps_it": unbounded > BOUND and largest["inverse_mpc"] < BOUND + 1e-9,
        "branch": case["branch"],
        "lmi_fails_in_a": case["branch"] == "gradient",
        "identified": case["identifiability"],
    }


def _dynamic_programming(A: Array, B: Array) -> tuple[Array, Array]:
    """Gain and cost to go of Q = I, R = 1 after 200 backward steps: no equation is solved."""
    P = np.eye(len(A))
    for _ in range(200):
        K = np.linalg.solve(np.eye(B.shape[1]) + B.T @ P @ B, B.T @ P @ A)
        P = np.eye(len(A)) + K.T @ K + (A - B @ K).T @ P @ (A - B @ K)
    return np.asarray(K), np.asarray(P)


def _table_3_1(controller: Controller, case: str) -> dict[str, Estimate]:
    """The algorithm on the states of a case."""
    plant = controller.plant
    states = simulate(controller, scenario(plant, x0=CASES[case], steps=STEPS)).x
    return table_3_1(Problem(plant, controller.bounds, HORIZON, (Recording(plant, states),)))


def _off(found: Estimate) -> float:
    """Largest difference of an estimated Q to the true one, I."""
    return float(np.max(np.abs(np.array(found.stage_weights.Q) - np.eye(2))))


def _refusal() -> str:
    try:
        Weights(np.diag([1.0, -1.0]), 1.0)
    except InputError as error:
        return str(error)
    raise AssertionError("indefinite weights were accepted")


def _matrix(rows: list[list[float]]) -> str:
    return "[" + "; ".join(" ".join(f"{item:.3f}" for item in row) for row in rows) + "]"
