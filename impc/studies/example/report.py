"""The report of the example: what was done, how it came out, what the numbers mean.

Sentences that compare methods are made from the numbers of the run, never written beforehand.

result.json: the numbers of a run for other programs.

    solver                              what solved the quadratic programs
    cases.<A|B|C>.x0
    cases.<A|B|C>.truth                 x, u, Q, R, K of the controller that made the recording
    cases.<A|B|C>.methods.<name>        Q, R, K, state_misfit, max_abs_u, residual, seconds,
                                        simulations; `feasible` for the LMI
    cases.<A|B|C>.identifiability       what the recording determined

A key that does not apply is left out: a gain has no Q, an infeasible LMI nothing but `feasible`
and `seconds`. Matrices are lists of rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.control.named_solver import described
from impc.inverse.methods import METHODS
from impc.model.weights import condition_number, normalised
from impc.reporting.document import Block, Heading, Lines, Note, Report, Section, Terms, Verdict
from impc.reporting.finding import Finding, Picture
from impc.studies.example.cases import EXAMPLE, LOST, SETTINGS, true_weights
from impc.studies.example.figures import FIGURES, example_figures

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from impc.arrays import Array
    from impc.model.weights import Weights
    from impc.reporting.provenance import Provenance
    from impc.studies.example.cases import CaseResult, MethodResult

# Distance (3.10) to the true weights of those that are found; measured 1e-14.
_FOUND = 1e-6
# Behind the point: what is below is rounding of a search.
_DIGITS = 9
_ABOUT = (
    "A model predictive controller (MPC) drives an unstable system to rest without ever exceeding "
    "a bound on its control. Its weights Q and R say what it cares about: how much a deviation of "
    "each state costs, against effort. Here only the states that it left behind are known, as in "
    "a recorded movement, and seven methods look for the weights. This is section 3.4 of the "
    "dissertation of A. Ramadan (Michigan State University, 2018), done again."
)
_ONE_THING = (
    "With the terminal weight used here (that of the Riccati equation), the controller stays as "
    "near to the fixed law u = -Kx as its bounds allow. It depends on Q and R through the gain K "
    "alone, so no recording, saturated or not, can determine two pairs of weights with the same "
    "gain apart. Which pair is reported is a choice: that of the least condition number. Read the "
    "gain and the bounds as a finding about the recording; read Q as one of many descriptions of "
    "it. Here the choice happens to fall on the true weights, because Q = I, R = 1 has the least "
    "condition number of all."
)
_COLUMNS = {
    "Q, R": "Scaled so that R = 1: a common factor of Q and R changes nothing.",
    "K": "Of the law u = -Kx that the method's controller follows where no bound interferes.",
    "misfit": "Distance between recorded and simulated states: the square root of the sum of all "
    "squared differences. Values near 1e-15 are rounding.",
    "largest u, kept": "The largest control that the method's explanation needs, and whether the "
    "recorded system could have given it. A good fit with a control beyond the bound is not an "
    "explanation.",
    "residual": "Distance (3.10) of the weights found from the true ones. Known only because this "
    "recording was simulated.",
    "seconds": "Of that method alone, given what it starts from.",
}
_DETERMINED = (
    "Singular values say how strongly the recorded states respond to a change of the weights in "
    "each direction. Those above 1e-8 of the largest count as determined; the others are zero but "
    "for rounding. One of them is always the common factor of Q and R, which is no free direction."
)
_WORDS = (
    "In this field iLQR also means iterative LQR. Here the inverse problem is meant, written "
    "“inverse LQR”; the dissertation writes iLQR and iMPC. Numbers in parentheses, such as (3.6), "
    "are its equations. All quantities are without unit, and time counts samples."
)


def example_report(cases: Sequence[CaseResult], provenance: Provenance) -> Report:
    """Page, result.json and the figures of every case."""
    figures: dict[str, bytes] = {}
    for case in cases:
        figures |= example_figures(case)
    read: list[Block] = [
        _ONE_THING,
        Heading("The columns"),
        Terms([(term, (meaning,)) for term, meaning in _COLUMNS.items()]),
        Heading("The methods"),
        Terms([(_label(name), (METHODS[name].sentence,)) for name in EXAMPLE]),
        Heading("What was determined"),
        _DETERMINED,
        _WORDS,
    ]
    plant = cases[0].controller.plant
    made = [
        ("Made", (provenance.made,)),
        ("Plant", (f"{provenance.plant_name}: A = {plant.A.tolist()}, B = {plant.B.tolist()}",)),
        *((name.replace("_", " "), (f"{value}",)) for name, value in SETTINGS.items()),
        ("Quadratic programs", (f"Solved by {described(cases[0].controller.solver)}.",)),
        ("Versions", (provenance.all_versions,)),
    ]
    return Report(
        "impc example: the weights behind a recorded closed loop",
        "The weights behind a recorded closed loop",
        (Verdict(_verdict(cases)), _ABOUT, Note("A stand-in.", LOST)),
        [
            *map(_case_section, cases),
            Section("How to read this page", read, "How to read this page"),
            Section("Versions and settings", (Terms(made),), "Versions and settings"),
        ],
        figures=figures,
        data=example_data(cases, provenance, SETTINGS),
        provenance=provenance,
    )


def _case_section(case: CaseResult) -> Section:
    start = ", ".join(f"{value:g}" for value in case.x0)
    branch = f"The search for weights took the {case.branch} branch of Table 3.1."
    blocks: list[Block] = [
        Lines((*_findings(case), branch)),
        methods_finding(case),
        *_pictures(case),
        Heading("What the recording determined"),
        others_finding(case),
    ]
    return Section(f"Case {case.name}: start at ({start})", blocks, f"Case {case.name}")


def methods_finding(case: CaseResult) -> Finding:
    """The true controller, then every method."""
    truth, K = true_weights(case.controller.plant), case.controller.K
    largest = float(np.max(np.abs(case.truth.u)))
    rows: list[dict[str, Any]] = [
        {"method": "truth", **_entries(truth, K), "largest_u": largest, "kept": "yes"}
    ]
    for item in case.methods:
        kept = {None: "", True: "yes", False: "no"}[item.bound_kept]
        rows.append(
            {
                "method": item.name,
                **_entries(item.weights, item.K),
                "misfit": item.state_misfit,
                "largest_u": item.max_abs_u,
                "kept": "infeasible" if item.feasible is False else kept,
                "residual": item.residual,
                "seconds": item.seconds,
            }
        )
    heads = [*_entries(truth, K), "misfit", "largest_u", "kept", "residual", "seconds"]
    table = pd.DataFrame(rows, columns=["method", *heads])
    numeric = [name for name in heads if name != "kept"]
    # Adding zero: what is rounded to -0 is printed as 0.
    table[numeric] = table[numeric].astype(float) + 0.0
    caption = f"Case {case.name}: every method on the same recording."
    return Finding(f"methods-{case.name}", table, caption, digits=3)


def _entries(weights: Weights | None, gain: Array | None) -> dict[str, float]:
    """Q11, Q12, Q22 at R = 1, then the gain."""
    found: dict[str, float] = {}
    if weights is not None:
        Q = normalised(weights).Q
        places = np.transpose(np.triu_indices(len(Q)))
        found |= {f"Q{i + 1}{j + 1}": round(float(Q[i, j]), _DIGITS) for i, j in places}
    if gain is not None:
        found |= {f"K{k + 1}": round(float(value), _DIGITS) for k, value in enumerate(gain.ravel())}
    return found


def others_finding(case: CaseResult) -> Finding:
    """What the recording determined, what the condition number chose, and what else fits."""
    found = case.identifiability
    values = ", ".join(f"{value:.3g}" for value in found.singular_values)
    rows = [
        _entries(item.weights, None) | {"condition_number": item.condition, "misfit": item.misfit}
        for item in found.others
    ]
    return Finding(
        f"other-weights-{case.name}",
        pd.DataFrame(rows),
        "These weights have the same gain as those found by inverse MPC, and so explain the "
        "recording as well.",
        [
            f"The recording determined {found.rank} of the {found.free} free directions of (Q, R); "
            f"the condition number chose {found.chosen}. (Singular values, with scale: {values}.)"
        ],
        digits=3,
    )


def _verdict(cases: Sequence[CaseResult]) -> str:
    """Who finds the weights inside the bound, over all cases."""
    inside = [
        sum(case.method(name).bound_kept is True for case in cases)
        for name in ("inverse_mpc", "inverse_lqr_output")
    ]
    residuals = [case.method("inverse_mpc").residual for case in cases]
    right = sum(value is not None and value <= _FOUND for value in residuals)
    return (
        f"Of {len(cases)} recordings inverse MPC explains {inside[0]} inside the bound and finds "
        f"the true weights behind {right}; inverse LQR on the outputs explains {inside[1]} inside "
        "the bound."
    )


def _findings(case: CaseResult) -> tuple[str, ...]:
    """What the table shows, in sentences."""
    kept = [METHODS[item.name].label for item in case.methods if item.bound_kept]
    broken = [METHODS[item.name].label for item in case.methods if item.bound_kept is False]
    lines = [f"Keeps the input bound: {'; '.join(kept) or 'no method'}."]
    lines += [f"Exceeds the input bound: {'; '.join(broken)}."] if broken else []
    lines += [
        f"{_label(item.name)} finds the true weights to {item.residual:.3g}."
        for item in case.methods
        if item.residual is not None and item.residual <= _FOUND
    ]
    gain, output = case.method("feedback_gain"), case.method("inverse_lqr_output")
    if gain.state_misfit is not None and output.state_misfit is not None:
        worse = output.state_misfit > gain.state_misfit
        lines.append(
            f"{_label(output.name)} fits {'worse' if worse else 'no worse'} than the gain it "
            f"starts from: misfit {output.state_misfit:.6f} against {gain.state_misfit:.6f}."
        )
    return tuple(lines)


def _label(name: str) -> str:
    label = METHODS[name].label
    return label[0].upper() + label[1:]


def _pictures(case: CaseResult) -> Iterator[Picture]:
    for number, name, label in FIGURES:
        method = case.method(name)
        control = (
            "The control stays inside its bound (white)."
            if method.bound_kept
            else f"The control reaches {method.max_abs_u:.3f}, beyond its bound (grey)."
        )
        yield Picture(
            f"figure-{number}-case-{case.name}",
            f"States and control over time: recorded, and as the {label} explains them",
            f"Counterpart of figure {number}, {label}. (A) The two states and (B) the control. "
            f"Open markers: recorded. Lines: as this method explains them. {control}",
        )
    yield Picture(
        f"terminal-set-case-{case.name}",
        "The terminal set in the plane of the two states, with the trajectories",
        "The terminal set: from any state inside it the true gain alone never exceeds the "
        "bound. At every sample the controller plans so that it arrives there within its "
        "horizon. Lines: the trajectory of each method from the same start.",
    )


def example_data(
    cases: Sequence[CaseResult], provenance: Provenance, settings: Mapping[str, float]
) -> dict[str, Any]:
    """Content of result.json, with the `settings` of the example."""
    plant = cases[0].controller.plant
    return {
        "plant": {"name": provenance.plant_name, "A": plant.A, "B": plant.B, "dt": plant.dt},
        "settings": settings,
        "solver": cases[0].controller.solver,
        "cases": {case.name: _case(case) for case in cases},
    }


def _case(case: CaseResult) -> dict[str, Any]:
    truth = {
        **_weights(true_weights(case.controller.plant)),
        "K": case.controller.K,
        "max_abs_u": float(np.max(np.abs(case.truth.u))),
        "x": case.truth.x,
        "u": case.truth.u,
    }
    found = case.identifiability
    named = ("free", "rank", "chosen", "singular_values", "tolerance")
    others = [{**_weights(item.weights), "state_misfit": item.misfit} for item in found.others]
    return {
        "x0": case.x0,
        "branch": case.branch,
        "truth": truth,
        # The truth stands among the methods too, so that a reader can compare them in one loop.
        "methods": {"truth": truth} | {item.name: _method(item) for item in case.methods},
        "identifiability": {name: getattr(found, name) for name in named} | {"others": others},
    }


def _method(method: MethodResult) -> dict[str, Any]:
    run = method.simulation
    named = ("K", "state_misfit", "max_abs_u", "bound_kept", "residual", "feasible")
    found = {name: getattr(method, name) for name in named}
    found |= {} if run is None else {"x": run.x, "u": run.u}
    return {
        **({} if method.weights is None else _weights(method.weights)),
        **{name: value for name, value in found.items() if value is not None},
        "seconds": method.seconds,
        "simulations": method.simulations,
    }


def _weights(weights: Weights) -> dict[str, Any]:
    return {"Q": weights.Q, "R": weights.R, "condition_number": condition_number(weights)}
