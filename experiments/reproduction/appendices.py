"""Appendices A to C: information, LASSO, selection."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import scipy.linalg

import plants
from experiments.reproduction.entry import Entry, Verdict, agrees
from experiments.selection_claims import FIM_SUBSET, exhaustive, mean_subject
from impc.checking import replace
from impc.studies.selection.estimation import estimate, free_indices
from impc.studies.selection.fisher import fisher_information, largest_subsets
from impc.studies.selection.lasso import lasso_of_size
from impc.studies.selection.model import Trial, normalised, sensitivity

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.studies.selection.fisher import Information
    from impc.studies.selection.model import ParametricModel

__all__ = ["appendix_entries", "kronecker_sensitivity"]

_DRAWS = 200


def appendix_entries() -> list[Entry]:
    """(A.1) to (A.6), (B.1), (C.1) to (C.5) and table C.1, on the mean subject of table 4.3."""
    subject = mean_subject()
    information = fisher_information(*subject)
    return [*_information(*subject, information), *_lasso(*subject), *_selection(information)]


def kronecker_sensitivity(matrices: ca.Function, theta: Array, dt: float, given: Array) -> Array:
    """(A.3) with Kronecker products: derivative of the outputs (samples, p, k); slow.

    `theta` (k,), `dt` in s, `given` (samples, d).
    """
    symbol = ca.SX.sym("theta", len(theta))
    slopes = ca.Function(
        "slopes", [symbol], [ca.jacobian(part, symbol) for part in matrices(symbol)]
    )
    A, B, C = (item.full() for item in matrices(theta))
    n, d = B.shape
    M = np.zeros((n + d, n + d))
    M[:n] = np.hstack([A, B]) * dt
    Ad, Bd = np.split(scipy.linalg.expm(M)[:n], [n], axis=1)
    found: list[list[Array]] = [[], [], []]
    for columns in zip(*(item.full().T for item in slopes(theta)), strict=True):
        parts = [
            one.reshape(of.shape, order="F") for one, of in zip(columns, (A, B, C), strict=True)
        ]
        L = np.zeros_like(M)
        L[:n] = np.hstack(parts[:2]) * dt
        change = np.real(scipy.linalg.expm_frechet(M, L)[1])
        for item, one in zip(found, (change[:n, :n], change[:n, n:], parts[2]), strict=True):
            item.append(one)
    dA, dB, dC = map(np.hstack, found)
    x, X = np.zeros((n, 1)), np.zeros((n, len(theta)))
    eye = np.eye(len(theta))
    rows = np.empty((len(given), len(C), len(theta)))
    for sample, r in enumerate(np.asarray(given).reshape(len(given), d, 1)):
        rows[sample] = dC @ np.kron(eye, x) + C @ X
        X = dA @ np.kron(eye, x) + Ad @ X + dB @ np.kron(eye, r)
        x = Ad @ x + Bd @ r
    return rows


def _information(
    model: ParametricModel, theta: Array, trials: list[Trial], information: Information
) -> list[Entry]:
    outputs, exact = sensitivity(model, theta, trials[0].input)
    matrices = plants.head_neck_matrices()
    recursion = kronecker_sensitivity(matrices, theta, 1 / 60, trials[0].input) * model.gain
    kronecker = float(np.max(np.abs(recursion - exact)) / np.max(np.abs(exact)))
    _, differences = sensitivity(replace(model, jacobian=None), theta, trials[0].input)
    difference = float(np.max(np.abs(differences - exact)) / np.max(np.abs(exact)))
    spread = _spread_over_bound(model, theta, trials, information)
    diagonal = np.diag(information.F)
    return [
        Entry(
            "(A.1)",
            "Discrete state space with white measurement noise.",
            ("impc.studies.selection.model:linear_functions",),
            f"{matrices.size1_out(0)} states, sampled exactly; {len(outputs)} samples a trial.",
            Verdict.REPRODUCED,
        ),
        Entry(
            "(A.2)",
            "FIM: sum over samples of the outer products of the output's gradient, over sigma^2.",
            ("impc.studies.selection.fisher:fisher_information",),
            f"Gradients against central differences: {difference:.0e}.",
            agrees(difference < 1e-6),
        ),
        Entry(
            "(A.3)",
            "The gradient as a recursion with Kronecker products.",
            ("experiments.reproduction.appendices:kronecker_sensitivity",),
            f"Against the exact derivative: {kronecker:.0e}.",
            agrees(kronecker < 1e-8),
        ),
        Entry(
            "(A.4), (A.5)",
            "Estimates are asymptotically normal; the inverse of the FIM bounds their covariance.",
            (
                "impc.studies.selection.fisher:fisher_information",
                "impc.studies.selection.estimation:estimate",
            ),
            f"{_DRAWS} simulated recordings (seed 0): SD of the five estimates over the bound "
            + ", ".join(f"{item:.2f}" for item in spread)
            + " (sampling error 5 %).",
            agrees(bool(np.all(np.abs(spread - 1) < 0.15))),
        ),
        Entry(
            "(A.6)",
            "FIM of normalised parameters.",
            ("impc.studies.selection.fisher:Information",),
            f"Diagonal from {diagonal.min():.1e} to {diagonal.max():.1e}.",
            Verdict.REPRODUCED,
        ),
    ]


def _lasso(model: ParametricModel, _: Array, trials: list[Trial]) -> list[Entry]:
    found = lasso_of_size(model, trials, 5)
    fixed = [index for index in range(model.size) if index not in found.selected]
    typical = normalised(model, np.array(model.typical))
    distance = float(np.max(np.abs(found.t[fixed] - typical[fixed])))
    names = ", ".join(model.names[index] for index in found.selected)
    return [
        Entry(
            "(B.1), (C.5)",
            "LASSO: squared error plus lambda times the distance to typical values, norm 1.",
            ("impc.studies.selection.lasso:proximal_lasso",),
            f"With five free ({names}) the others are at their typical values to {distance:.0e}.",
            agrees(distance == 0),
        ),
        Entry(
            "Table C.1",
            "Change lambda until the wanted number of parameters is farther than .005 from its"
            " typical value; bounded Nelder and Mead.",
            ("experiments.selection_claims:table_c1",),
            "Run by `python -m experiments.selection_claims --nelder-mead`:"
            " experiments/reliability_selection.md.",
            Verdict.IN_KIND,
            "The rule by which lambda changes is lost.",
        ),
    ]


def _selection(information: Information) -> list[Entry]:
    F = information.F
    started = time.perf_counter()
    all_of_them = exhaustive(F, 0.05)
    seconds = time.perf_counter() - started
    grown = largest_subsets([F], 0.05)
    same = set(all_of_them.subsets) == set(grown.subsets)
    worst = max(grown.variances)
    return [
        Entry(
            "(C.1) to (C.3)",
            "Selection matrices; the FIM of a subset is a submatrix.",
            ("impc.studies.selection.fisher:subset_variances",),
            "Indices in place of matrices of zeros and ones.",
            Verdict.REPRODUCED,
        ),
        Entry(
            "(C.4)",
            "Most parameters such that the reciprocal condition number is above machine epsilon and"
            " the largest variance at most v; all 4083 subsets are tried.",
            (
                "experiments.selection_claims:exhaustive",
                "impc.studies.selection.fisher:largest_subsets",
            ),
            f"All subsets in {1000 * seconds:.0f} ms: {len(all_of_them.subsets)} of size"
            f" {all_of_them.size} at v = .05, largest variance {worst:.3f}. Growing feasible sets"
            f" one by one finds {'the same' if same else 'others'}.",
            agrees(same and worst <= 0.05),
        ),
    ]


def _spread_over_bound(
    model: ParametricModel, theta: Array, trials: list[Trial], information: Information
) -> Array:
    free = list(free_indices(model, FIM_SUBSET))
    bound = np.sqrt(np.diag(np.linalg.inv(information.F[np.ix_(free, free)])))
    rng = np.random.default_rng(0)
    clean = [model.simulate(theta, item.input) for item in trials]
    found = []
    for _ in range(_DRAWS):
        noisy = [
            Trial(item.input, y + np.sqrt(information.variance) * rng.standard_normal(y.shape))
            for item, y in zip(trials, clean, strict=True)
        ]
        fit = estimate(model, noisy, free, theta)
        found.append(normalised(model, np.array(fit.theta))[free])
    return np.asarray(np.std(found, axis=0, ddof=1) / bound)
