"""Chapters 4 and 5 and the appendices: sensitive and key parameters of head tracking, simulated."""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np
import scipy.linalg

import plants
from experiments.reproduction.evidence import Evidence, table
from experiments.selection_claims import (
    FIM_SUBSET,
    exhaustive,
    mean_subject,
    nominal_information,
    search_times,
)
from impc.arrays import Array, frozen
from impc.checking import replace
from impc.studies.selection.estimation import estimate, free_indices, pooled_vaf
from impc.studies.selection.fisher import Information, fisher_information, largest_subsets
from impc.studies.selection.lasso import lasso_of_size
from impc.studies.selection.model import ParametricModel, Trial, normalised, physical, sensitivity

__all__ = ["appendix_values", "key_values", "kronecker_sensitivity", "sensitive_values"]

_DRAWS = 200


def sensitive_values(evidence: Evidence) -> dict[str, Any]:
    """Values of (4.1) to (4.5), tables 4.1 to 4.3, figures 4.1 to 4.5 and the claims."""
    select, (model, information) = evidence.select, nominal_information()
    selection = exhaustive(information.F, 0.05)
    subsets = largest_subsets([information.F], 0.05).subsets
    sizes = [len(item["subsets"][0]) if item["subsets"] else 0 for item in select["subsets"]]
    found = table(select, "intervals")
    first = found[found["subject"] == found["subject"][0]]
    ratio, _ = search_times(nelder_mead=True)["Table C.1"]
    vafs = {
        which: float(np.mean([np.mean(values) for values in select["vaf"][which].values()]))
        for which in ("nominal", "fim", "lasso")
    }
    poles = {
        name: np.linalg.eigvals(plants.head_neck_plant(plants.table_4_3_column(name)).A).real.max()
        for name in plants.TABLE_4_3
    }
    chosen = {**select["selected"], "common": select["common"]}
    return {
        **_estimation_values(),
        **_width_values(evidence.claims),
        "vaf4": vafs,
        "fim_is_lasso": abs(vafs["fim"] - vafs["lasso"]) < 1,
        "twelve_gain_nothing": vafs["nominal"] - vafs["fim"] < 1,
        "poles": ", ".join(f"{name} {pole:.3f}" for name, pole in poles.items()),
        "sizes": (min(sizes), max(sizes)),
        "least_is_three": min(sizes) == 3,
        "first_subset": ", ".join(model.names[index] for index in subsets[0]),
        "place": selection.subsets.index(free_indices(model, FIM_SUBSET)) + 1,
        "subset_count": len(selection.subsets),
        "subset_size": selection.size,
        "selects_five": selection.size == 5,
        "chosen": {name: ", ".join(chosen[name]) for name in ("fim", "lasso", "common")},
        "times_faster": ratio,
        "fim_is_faster": ratio > 10,
        "rank": information.rank,
        "rank_is_low": information.rank < 12,
        "bootstrap": "; ".join(
            f"{row.parameter} {row.others_exact_low:.3g} to {row.others_exact_high:.3g}"
            for row in first.itertuples()
        ),
    }


def _estimation_values() -> dict[str, Any]:
    """Values of (4.1) to (4.5), at the mean subject of table 4.3."""
    model, theta, trials = mean_subject()
    back = np.max(np.abs(physical(model, normalised(model, theta)) / theta - 1))
    refitted = estimate(model, trials, free_indices(model, FIM_SUBSET), theta).vaf[0]
    closed = pooled_vaf(model, theta, trials)[0]
    return {
        "parameters": ", ".join(model.names),
        "has_twelve": model.size == 12,
        "ends": [normalised(model, np.array(one))[0] for one in (model.low, model.high)],
        "back": back,
        "normalises": back < 1e-12,
        "refitted": refitted,
        "closed": closed,
        "fit_beats_truth": refitted >= closed,
        "vaf_is_near": abs(closed - 82.65) < 1,
    }


def _width_values(claims: dict[str, Any]) -> dict[str, Any]:
    """Values of table 4.3 and figure 4.5: widths of bootstrap intervals."""
    widths = claims["widths"]
    inside = sum(abs(item["mean"] - item["quoted"]) <= item["deviation"] for item in widths)
    reduced = {name: np.array(item) for name, item in claims["reduced"].items()}
    shares = {name: 100 * reduced[name] / reduced["all twelve"] for name in ("FIM", "LASSO")}
    fim, lasso = shares.values()
    return {
        "widths": ", ".join(f"{item['name']} {item['mean']:.3g}" for item in widths),
        "widths_inside": inside,
        "widths_agree": inside >= 4,
        "reduced": {
            name: f"{one[0]:.0f}, {one[1]:.0f} and {one[2]:.0f}" for name, one in shares.items()
        },
        "fim_reduces": bool(np.all(fim[:2] < lasso[:2]) and np.max(fim[:2]) < 20),
    }


def key_values(evidence: Evidence) -> dict[str, Any]:
    """Values of (5.1) to (5.7), tables 5.1 to 5.5, figures 5.1 to 5.3 and the claims."""
    yaw, both = evidence.yaw, {"Yaw": evidence.yaw, "Pitch": evidence.pitch}
    candidates, kept, least = table(yaw, "candidates"), {}, {}
    for name, axis in both.items():
        kept[name] = table(axis, "candidates").query("kept").to_dict("records")
        iccs = table(axis, "estimates").groupby("free")["icc"].min()
        least[name] = iccs["chosen"], iccs["all"]
    vafs = {name: [item["mean_vaf_percent"] for item in items] for name, items in kept.items()}
    worst, doubled = candidates["largest_variance"].max(), _doubled()
    subsets = {name: _subsets(axis) for name, axis in both.items()}
    pathways = {name: _pathways(one) for name, one in subsets.items()}
    sizes = {name: sorted(map(len, one)) for name, one in subsets.items()}

    def listed(texts: dict[str, str]) -> str:
        return "; ".join(f"{name}: {text}" for name, text in texts.items())

    return {
        "yaw": yaw,
        "yaw_candidates": len(candidates),
        "worst_variance": worst,
        "variance_is_bounded": worst <= 0.35,
        "least_candidate": candidates["least_icc"].min(),
        "iccs": {name: _iccs(axis) for name, axis in both.items()},
        "subset_counts": {name: _counts(axis) for name, axis in both.items()},
        "subset_sizes": {name: f"{one[0]} to {one[-1]}" for name, one in sizes.items()},
        "key_names": listed({name: ", ".join(axis["chosen"]) for name, axis in both.items()}),
        "three_are_chosen": all(len(axis["chosen"]) == 3 for axis in both.values()),
        "feasible": listed({
            name: f"{len(items)} (diversity {', '.join(str(i['pathways']) for i in items)})"
            for name, items in kept.items()
        }),
        "key_vafs": listed({n: f"{min(one):.1f} to {max(one):.1f} %" for n, one in vafs.items()}),
        "vaf_is_high": min(map(min, vafs.values())) > 69,
        "least_iccs": listed({
            name: f"least ICC {chosen:.2f} of the chosen, {every:.2f} of all twelve"
            for name, (chosen, every) in least.items()
        }),
        "fewer_are_reliable": all(chosen > every for chosen, every in least.values()),
        "pathways": listed({name: text for name, (text, _) in pathways.items()}),
        "none_is_intrinsic": not any(intrinsic for _, intrinsic in pathways.values()),
        "doubled": doubled,
        "width_counts": abs(doubled - 4) < 1e-9,
    }  # fmt: skip


def _doubled() -> float:
    """Information with doubled ranges of all parameters, relative to that with their own."""
    model, theta, trials = mean_subject()
    middle = (model.high + model.low) / 2
    ends = frozen(middle - 2 * model.gain), frozen(middle + 2 * model.gain)
    wide = fisher_information(replace(model, low=ends[0], high=ends[1]), theta, trials).F
    return float(np.mean(np.diag(wide) / np.diag(fisher_information(model, theta, trials).F)))


def _iccs(axis: dict[str, Any]) -> str:
    rows = table(axis, "estimates").query("free == 'chosen'").itertuples()
    return "; ".join(f"{r.parameter} {r.icc:.2f} [{r.icc_low:.2f}, {r.icc_high:.2f}]" for r in rows)


def _subsets(axis: dict[str, Any]) -> set[tuple[str, ...]]:
    """All sensitive subsets at any bound."""
    return {tuple(subset) for item in axis["sweep"] for subset in item["subsets"]}


def _counts(axis: dict[str, Any]) -> str:
    at = next(item for item in axis["sweep"] if abs(item["bound"] - 0.35) < 1e-9)
    return f"{len(_subsets(axis))} in all, {len(at['subsets'])} of size {at['size']} at .35"


def _pathways(subsets: set[tuple[str, ...]]) -> tuple[str, int]:
    """How many subsets have a parameter of each pathway, in words; the count of "intrinsic"."""
    own = {item.name: item.pathway for item in plants.HEAD_NECK_PARAMETERS}
    counts = {
        path: sum(path in {own[name] for name in subset} for subset in subsets)
        for path in dict.fromkeys(own.values())
    }
    delays = sum("tau" in subset for subset in subsets)
    listed = ", ".join(f"{path} {count}" for path, count in counts.items())
    return f"{listed} of {len(subsets)}; the visual delay in {delays}", counts["intrinsic"]


def appendix_values() -> dict[str, Any]:
    """Values of (A.1) to (A.6), (B.1), (C.1) to (C.5), on the mean subject of table 4.3."""
    model, theta, trials = mean_subject()
    information = fisher_information(model, theta, trials)
    outputs, exact = sensitivity(model, theta, trials[0].input)
    matrices, F = plants.head_neck_matrices(), information.F
    recursion = kronecker_sensitivity(matrices, theta, 1 / 60, trials[0].input) * model.gain
    _, differences = sensitivity(replace(model, jacobian=None), theta, trials[0].input)
    kronecker, difference = (
        np.max(np.abs(one - exact)) / np.max(np.abs(exact)) for one in (recursion, differences)
    )
    spread = _spread_over_bound(model, theta, trials, information)
    lasso = lasso_of_size(model, trials, 5)
    fixed = [index for index in range(model.size) if index not in lasso.selected]
    gap = np.max(np.abs(lasso.t[fixed] - normalised(model, np.array(model.typical))[fixed]))
    started = time.perf_counter()
    every = exhaustive(F, 0.05)
    milliseconds, grown = 1000 * (time.perf_counter() - started), largest_subsets([F], 0.05)
    same, worst = set(every.subsets) == set(grown.subsets), max(grown.variances)
    return {
        "head_states": matrices.size1_out(0),
        "samples": len(outputs),
        "difference": difference,
        "gradients_agree": difference < 1e-6,
        "kronecker": kronecker,
        "recursion_agrees": kronecker < 1e-8,
        "draws": _DRAWS,
        "spread": ", ".join(f"{item:.2f}" for item in spread),
        "bound_is_reached": bool(np.all(np.abs(spread - 1) < 0.15)),
        "diagonal": (np.diag(F).min(), np.diag(F).max()),
        "lasso_five": ", ".join(model.names[index] for index in lasso.selected),
        "typical_gap": gap,
        "rest_is_typical": gap == 0,
        "milliseconds": milliseconds,
        "all_count": len(every.subsets),
        "all_size": every.size,
        "all_variance": worst,
        "the_same": "the same" if same else "others",
        "growing_agrees": same and worst <= 0.05,
    }


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


def _spread_over_bound(
    model: ParametricModel, theta: Array, trials: list[Trial], information: Information
) -> Array:
    """SD of estimates from simulated recordings over their bound by the information (k,)."""
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
