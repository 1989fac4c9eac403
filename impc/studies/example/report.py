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

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.control.named_solver import described
from impc.model.weights import condition_number
from impc.reporting.document import Picture, Report
from impc.studies.example.cases import LOST, SETTINGS, true_weights
from impc.studies.example.figures import FIGURES, example_figures
from impc.studies.example.table import (
    METHODS,
    Row,
    compact_weights,
    determined_sentences,
    significant,
    table_rows,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.assess.identified_directions import Identifiability
    from impc.model.weights import Weights
    from impc.reporting.provenance import Provenance
    from impc.studies.example.cases import CaseResult, MethodResult

# Distance (3.10) to the true weights of those that are found; measured 1e-14.
_FOUND = 1e-6


@dataclass(frozen=True)
class _CaseView:
    """A case as the template shows it."""

    name: str
    start: str
    branch: str
    rows: tuple[Row, ...]
    findings: tuple[str, ...]
    pictures: tuple[Picture, ...]
    determined: tuple[str, ...]
    others: tuple[tuple[str, str, str], ...]


def example_report(cases: Sequence[CaseResult], provenance: Provenance) -> Report:
    """Page, result.json and the figures of every case."""
    plant = cases[0].controller.plant
    figures: dict[str, bytes] = {}
    for case in cases:
        figures |= example_figures(case)
    return Report(
        "impc example: the weights behind a recorded closed loop",
        "The weights behind a recorded closed loop",
        (),
        (),
        figures=figures,
        data=example_data(cases, provenance, SETTINGS),
        provenance=provenance,
        template="studies/example/example_page.html",
        values={
            "cases": [_view(case) for case in cases],
            "verdict": _verdict(cases),
            "lost": LOST,
            "methods": METHODS,
            "plant": plant,
            "settings": SETTINGS,
            "solver": described(cases[0].controller.solver),
            "provenance": provenance,
        },
    )


def _view(case: CaseResult) -> _CaseView:
    found = case.identifiability
    return _CaseView(
        name=case.name,
        start=", ".join(f"{value:g}" for value in case.x0),
        branch=case.branch,
        rows=table_rows(case),
        findings=_findings(case),
        pictures=_pictures(case),
        determined=determined_sentences(found)[:1],
        others=tuple(
            (compact_weights(item.weights), significant(item.condition), significant(item.misfit))
            for item in found.others
        ),
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
        f"{_label(item)} finds the true weights to {significant(item.residual)}."
        for item in case.methods
        if item.residual is not None and item.residual <= _FOUND
    ]
    gain, output = case.method("feedback_gain"), case.method("inverse_lqr_output")
    if gain.state_misfit is not None and output.state_misfit is not None:
        worse = output.state_misfit > gain.state_misfit
        lines.append(
            f"{_label(output)} fits {'worse' if worse else 'no worse'} than the gain it starts "
            f"from: misfit {output.state_misfit:.6f} against {gain.state_misfit:.6f}."
        )
    return tuple(lines)


def _label(method: MethodResult) -> str:
    label = METHODS[method.name].label
    return label[0].upper() + label[1:]


def _pictures(case: CaseResult) -> tuple[Picture, ...]:
    pictures = [
        Picture(
            f"figure-{number}-case-{case.name}",
            f"States and control over time: recorded, and as the {label} explains them",
            f"Counterpart of figure {number}, {label}. (A) The two states and (B) the control. "
            "Open markers: recorded. Lines: as this method explains them. "
            f"{_control_sentence(case.method(method))}",
        )
        for number, method, label in FIGURES
    ]
    terminal = Picture(
        f"terminal-set-case-{case.name}",
        "The terminal set in the plane of the two states, with the trajectories",
        "The terminal set: from any state inside it the true gain alone never exceeds the "
        "bound. At every sample the controller plans so that it arrives there within its "
        "horizon. Lines: the trajectory of each method from the same start.",
    )
    return (*pictures, terminal)


def _control_sentence(method: MethodResult) -> str:
    if method.bound_kept:
        return "The control stays inside its bound (white)."
    return f"The control reaches {method.max_abs_u:.3f}, beyond its bound (grey)."


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
    truth = _truth(case)
    return {
        "x0": case.x0,
        "branch": case.branch,
        "truth": truth,
        # The truth stands among the methods too, so that a reader can compare them in one loop.
        "methods": {"truth": truth} | {item.name: _method(item) for item in case.methods},
        "identifiability": _identifiability(case.identifiability),
    }


def _truth(case: CaseResult) -> dict[str, Any]:
    return {
        **_weights(true_weights(case.controller.plant)),
        "K": case.controller.K,
        "max_abs_u": float(np.max(np.abs(case.truth.u))),
        "x": case.truth.x,
        "u": case.truth.u,
    }


def _method(method: MethodResult) -> dict[str, Any]:
    found: dict[str, Any] = {} if method.weights is None else _weights(method.weights)
    optional = {
        "K": method.K,
        "state_misfit": method.state_misfit,
        "max_abs_u": method.max_abs_u,
        "bound_kept": method.bound_kept,
        "residual": method.residual,
        "feasible": method.feasible,
        "x": None if method.simulation is None else method.simulation.x,
        "u": None if method.simulation is None else method.simulation.u,
    }
    found |= {key: value for key, value in optional.items() if value is not None}
    return found | {"seconds": method.seconds, "simulations": method.simulations}


def _weights(weights: Weights) -> dict[str, Any]:
    return {"Q": weights.Q, "R": weights.R, "condition_number": condition_number(weights)}


def _identifiability(found: Identifiability) -> dict[str, Any]:
    return {
        "free": found.free,
        "rank": found.rank,
        "chosen": found.chosen,
        "singular_values": found.singular_values,
        "tolerance": found.tolerance,
        "others": [
            {**_weights(item.weights), "state_misfit": item.misfit} for item in found.others
        ],
    }
