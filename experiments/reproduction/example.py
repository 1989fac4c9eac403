"""Chapter 3, first half: the controller, inverse MPC, and the example of section 3.4."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.certificates import (
    cholesky_parameters,
    invariance_violation,
    maximality_violation,
    weights_from_parameters,
)
from experiments.reference_mpc import simulate_mpc
from experiments.reproduction.entry import Entry, Verdict, agrees, kind
from impc.control.casadi_controller import build_mpc
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.control.terminal_set import (
    maximal_invariant_set,
)
from impc.errors import InputError
from impc.inverse.problem import Problem
from impc.inverse.table31 import inverse_mpc, table_3_1
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from impc.studies.example.cases import BOUND, CASES, HORIZON, STEPS
from plants import yalmip_example

if TYPE_CHECKING:
    from experiments.reproduction.evidence import Evidence
    from impc.arrays import Array
    from impc.inverse.estimates import Estimate

__all__ = ["STAND_IN", "controller_entries", "example_entries"]

STAND_IN = (
    "The example's matrices, initial state and bound are lost. In their place: A = [2 -1; 1 0.2],"
    " B = [1; 0], |u| <= 1, which shows all that the text says of its own."
)
_LOST_SYSTEM = "On the stand-in."


def controller_entries() -> list[Entry]:
    """(3.1) to (3.7): computed on the stand-in plant of the example."""
    plant = Plant(yalmip_example())
    bounds = Bounds(plant, u_min=-BOUND, u_max=BOUND)
    weights = Weights(np.eye(2), 1.0)
    lqr = solve_lqr(plant, weights)
    controller = Controller(plant, weights, bounds, HORIZON)
    given = scenario(plant, x0=CASES["B"], steps=STEPS)
    ours = simulate(controller, given)
    gaps = {
        name: float(np.max(np.abs(simulate_mpc(build_mpc(controller, name), given).u - ours.u)))
        for name in ("qpoases", "daqp", "ipopt")
    }
    reference, P = _dynamic_programming(plant.A, plant.B)
    gain_gap = float(np.max(np.abs(lqr.K - reference)))
    riccati_gap = float(np.max(np.abs(lqr.P - P)))
    terminal = maximal_invariant_set(plant, lqr.K, bounds)
    scaled = Controller(plant, Weights(7 * np.eye(2), 7.0), bounds, HORIZON)
    ray = float(np.max(np.abs(simulate(scaled, given).u - ours.u)))
    direct = inverse_mpc(
        Problem(plant, bounds, HORIZON, (Recording(plant, ours.x),)),
        Weights(np.diag([2.0, 0.5]), 1.0),
    )
    off = float(np.max(np.abs(direct.stage_weights.Q - np.eye(2))))
    whole = [_table_3_1(plant, bounds, controller, case) for case in ("A", "B")]
    factor = weights_from_parameters(cholesky_parameters(weights), 2, 1)
    return [
        Entry(
            "(3.1)",
            "MPC: least x_N'Px_N + sum of x'Qx + u'Ru over N steps, inside the bounds, x_N in X_f;"
            " the first input is applied.",
            (
                "impc.control.controller:Controller",
                "impc.control.casadi_controller:build_mpc",
                "impc.control.closed_loop:simulate",
            ),
            "The compiled loop and the program solved at every sample differ, over 20 steps of"
            " case B, by at most "
            + ", ".join(f"{gap:.0e} ({name})" for name, gap in gaps.items())
            + ".",
            agrees(max(gaps.values()) < 1e-6),
        ),
        Entry(
            "(3.2)",
            "It is assumed that ... (the formula is lost; Q >= 0, R > 0, a stabilisable plant, and"
            " detectability fit the discussion).",
            ("impc.model.weights:Weights", "impc.model.riccati:solve_lqr"),
            f"Refused, in one line: {_refusal(np.diag([1.0, -1.0]), 1.0)}",
            Verdict.IN_KIND,
            "The formula is lost; the conditions are those under which (3.3) and (3.4) exist.",
        ),
        Entry(
            "(3.3)",
            "LQR gain K of (Q, R); u = -Kx.",
            ("impc.model.riccati:solve_lqr",),
            f"K = [{lqr.K[0, 0]:.5f} {lqr.K[0, 1]:.5f}]; 200 steps of dynamic programming give"
            f" the same to {gain_gap:.0e}.",
            agrees(gain_gap < 1e-9),
        ),
        Entry(
            "(3.4)",
            "P solves the discrete algebraic Riccati equation, and is the terminal weight.",
            ("impc.model.riccati:solve_lqr",),
            f"200 steps of dynamic programming give the same P to {riccati_gap:.0e}.",
            agrees(riccati_gap < 1e-9),
        ),
        Entry(
            "Claim, 3.2",
            "X_f is the maximal positive invariant set of the closed loop inside the bounds.",
            ("impc.control.terminal_set:maximal_invariant_set",),
            f"{len(terminal.h)} rows, reached after {terminal.determinedness} step; a trajectory"
            f" from inside leaves by at most {invariance_violation(terminal):.0e}; rows computed"
            " afresh, by powers of A - BK, differ by at most"
            f" {maximality_violation(terminal):.0e}.",
            agrees(max(invariance_violation(terminal), maximality_violation(terminal)) < 1e-9),
        ),
        Entry(
            "(3.5)",
            "(Q, R, P) that minimise w1 |vec(Y - Y_ref)| + w2 c kappa, with P from (3.4). Solutions"
            " form a manifold: multiples (aQ, aR, aP) are solutions too.",
            (
                "impc.inverse.proximal_search:conditioned_fit",
                "impc.inverse.table31:inverse_mpc",
            ),
            f"Inputs with (7Q, 7R) differ by {ray:.0e}. The manifold is larger than multiples: with"
            " one input the law depends on the weights through K alone (docs/why/theory.md).",
            agrees(ray < 1e-12),
        ),
        Entry(
            "(3.6)",
            "The same with R = 1, Q = LL', L lower triangular with positive diagonal.",
            ("impc.inverse.table31:inverse_mpc",),
            f"From Q = diag(2, 0.5): Q = I to {off:.0e}; L and back:"
            f" {float(np.max(np.abs(factor.Q - np.eye(2)))):.0e}.",
            agrees(off < 1e-6),
        ),
        Entry(
            "(3.7)",
            "Auxiliary problem: weights with a gain near the estimated one, and a small condition"
            " number; where inverse MPC starts.",
            ("impc.inverse.proximal_search:auxiliary_weights",),
            "Used on the gradient branch; its result in the example is under (3.14).",
            Verdict.IN_KIND,
            "Whether the gain estimated from data or the one of the gradient problem is fitted is"
            " not to be read from the text; here the former.",
        ),
        Entry(
            "Table 3.1",
            "The algorithm: gain, LMI; where infeasible gradient and (3.7); then (3.6).",
            ("impc.inverse.table31:table_3_1",),
            "; ".join(
                f"case {case}: {_branch(lines)} branch,"
                f" Q = I to {np.max(np.abs(_found_Q(lines) - np.eye(2))):.0e}"
                for case, lines in zip("AB", whole, strict=True)
            )
            + ".",
            agrees(
                all(np.allclose(_found_Q(lines), np.eye(2), atol=1e-6) for lines in whole)
                and list(map(_branch, whole)) == ["gradient", "LMI"]
            ),
        ),
        Entry(
            "Figure 3.1",
            "Block diagram of the loop with MPC, and of the two levels.",
            ("impc.inverse.table31",),
            "docs/dev/architecture.md has the drawing of this package.",
            Verdict.IN_KIND,
            "A drawing of structure, not a result.",
        ),
    ]


def example_entries(evidence: Evidence) -> list[Entry]:
    """(3.8) to (3.17), figures 3.2 to 3.4 and the claims, from `impc example`, case A."""
    case = evidence.example["cases"]["A"]
    methods = case["methods"]
    gain, mpc = methods["feedback_gain"], methods["inverse_mpc"]
    gradient, output = methods["inverse_lqr_gradient"], methods["inverse_lqr_output"]
    auxiliary, truth = methods["inverse_lqr_auxiliary"], case["truth"]
    saturated = sum(abs(abs(u[0]) - BOUND) < 1e-9 for u in truth["u"])
    residuals = {name: it["distance"] for name, it in methods.items() if it["distance"] is not None}
    largest = {name: it["largest_input"]["u"] for name, it in methods.items()}
    least_lqr = min(value for name, value in residuals.items() if "lqr" in name)
    return [
        _stand_in("(3.8)", "An unstable discrete plant.", "Spectral radius 1.18."),
        Entry(
            "(3.9)",
            "True weights Q = I, R = 1, so that the condition number is least.",
            ("impc.studies.example.cases:true_weights",),
            f"Condition number {case['truth']['condition_number']:g}.",
            Verdict.REPRODUCED,
        ),
        Entry(
            "(3.10)",
            "Residual between estimated and true matrices.",
            ("impc.model.weights:weight_error",),
            "; ".join(f"{name} {value:.2g}" for name, value in residuals.items()) + ".",
            Verdict.IN_KIND,
            "Which norm is lost; here that of Frobenius of blkdiag(Q, R).",
        ),
        _stand_in("(3.11)", "The input is bounded.", f"|u| <= {BOUND:g}."),
        _stand_in(
            "(3.12)",
            "Feedback gain estimated from the states.",
            f"K = {_row(gain['K'])}.",
        ),
        _stand_in(
            "(3.13)",
            "Weights of the gradient problem, after the LMI was infeasible.",
            f"LMI infeasible; Q = {_matrix(gradient['Q'])}, nearly singular.",
        ),
        _stand_in("(3.14)", "Weights of the auxiliary problem.", f"Q = {_matrix(auxiliary['Q'])}."),
        Entry(
            "(3.15)",
            "Inverse MPC estimated the weights accurately; its residual is below that of inverse"
            " LQR.",
            ("impc.inverse.table31:inverse_mpc",),
            f"Residual {mpc['distance']:.1e}; the least of inverse LQR is {least_lqr:.2g}."
            " The recording determines two of three directions, the condition number chose the"
            " third, which falls on the truth because Q = I has the least there is.",
            agrees(mpc["distance"] < 1e-6 < least_lqr),
        ),
        Entry(
            "(3.16)",
            "Inverse LQR with the penalty on outputs in place of gains.",
            ("impc.inverse.table31:inverse_mpc",),
            f"Misfit of the states {output['misfit']:.3f}.",
            Verdict.IN_KIND,
            "Weights w1, w2 and c are lost.",
        ),
        _stand_in(
            "(3.17)",
            "Its weights and gain, far from (3.12).",
            f"Q = {_matrix(output['Q'])}, K = {_row(output['K'])}.",
        ),
        Entry(
            "Figure 3.2",
            "States and control with the estimated gain against the reference.",
            ("impc.studies.fit.figures:movement_figure",),
            f"Good states (misfit {gain['misfit']:.3f}); largest |u|"
            f" {largest['feedback_gain']:.3f} against {BOUND:g}.",
            kind(largest["feedback_gain"] > BOUND),
            _LOST_SYSTEM,
            "example/figures/feedback_gain-case-A.svg",
        ),
        Entry(
            "Figure 3.3",
            "States and control of inverse MPC: a perfect fit.",
            ("impc.studies.fit.figures:movement_figure",),
            f"Misfit {mpc['misfit']:.0e}.",
            kind(mpc["misfit"] < 1e-9),
            _LOST_SYSTEM,
            "example/figures/inverse_mpc-case-A.svg",
        ),
        Entry(
            "Figure 3.4",
            "States and control of (3.16): worse than figure 3.2.",
            ("impc.studies.fit.figures:movement_figure",),
            f"Misfit {output['misfit']:.3f} against {gain['misfit']:.3f}.",
            kind(output["misfit"] > gain["misfit"]),
            _LOST_SYSTEM,
            "example/figures/inverse_lqr_output-case-A.svg",
        ),
        Entry(
            "Claim, 3.4",
            "The input saturates in the simulation.",
            ("impc.studies.example.cases:run_case",),
            f"{saturated} of {STEPS} samples.",
            kind(saturated > 0),
            _LOST_SYSTEM,
        ),
        Entry(
            "Claim, 3.4",
            "Feedback gain and inverse LQR exceed the bound; inverse MPC does not.",
            ("impc.studies.example.cases:run_case",),
            f"Largest |u|: gain {largest['feedback_gain']:.3f}, (3.16)"
            f" {largest['inverse_lqr_output']:.3f}, inverse MPC {largest['inverse_mpc']:.3f}.",
            kind(
                min(largest["feedback_gain"], largest["inverse_lqr_output"]) > BOUND
                and largest["inverse_mpc"] < BOUND + 1e-9
            ),
            _LOST_SYSTEM,
        ),
        Entry(
            "Claim, 3.4",
            "The LMI is infeasible.",
            ("impc.inverse.inverse_lqr:inverse_lqr_lmi",),
            f"Branch of case A: {case['branch']}; B takes the other one.",
            kind(case["branch"] == "gradient"),
            _LOST_SYSTEM,
        ),
        Entry(
            "Claim, 3.3",
            "Minimising the condition number addresses the uniqueness of the solution.",
            (
                "impc.assess.weights_test:identifiability",
                "impc.inverse.equivalent_weights",
            ),
            f"{case['identifiability']['rank']} of {case['identifiability']['free']} directions"
            " are determined; the condition number chooses the rest, and its choice depends on the"
            " units of the states (docs/why/equivalent_weights.md).",
            Verdict.IN_KIND,
            "A unique answer, but the convention's, not the recording's.",
        ),
    ]


def _stand_in(item: str, says: str, found: str) -> Entry:
    return Entry(item, says, ("impc.studies.example.cases",), found, Verdict.LOST, _LOST_SYSTEM)


def _dynamic_programming(A: Array, B: Array) -> tuple[Array, Array]:
    """Gain and cost to go of Q = I, R = 1 after 200 backward steps: no equation is solved."""
    P = np.eye(len(A))
    for _ in range(200):
        K = np.linalg.solve(np.eye(B.shape[1]) + B.T @ P @ B, B.T @ P @ A)
        P = np.eye(len(A)) + K.T @ K + (A - B @ K).T @ P @ (A - B @ K)
    return np.asarray(K), np.asarray(P)


def _table_3_1(
    plant: Plant, bounds: Bounds, controller: Controller, case: str
) -> dict[str, Estimate]:
    states = simulate(controller, scenario(plant, x0=CASES[case], steps=STEPS)).x
    return table_3_1(Problem(plant, bounds, HORIZON, (Recording(plant, states),)))


def _branch(lines: dict[str, Estimate]) -> str:
    return "gradient" if lines["inverse_lqr_lmi"].weights is None else "LMI"


def _found_Q(lines: dict[str, Estimate]) -> np.ndarray:  # noqa: N802
    return np.array(lines["inverse_mpc"].stage_weights.Q)


def _refusal(Q: Any, R: float) -> str:
    try:
        Weights(Q, R)
    except InputError as error:
        return str(error)
    raise AssertionError("indefinite weights were accepted")


def _row(K: list[list[float]]) -> str:
    return "[" + " ".join(f"{item:.3f}" for item in K[0]) + "]"


def _matrix(Q: list[list[float]]) -> str:
    return "[" + "; ".join(" ".join(f"{item:.3f}" for item in row) for row in Q) + "]"
