"""The report of the example: what was done, how it came out, what the numbers mean.

Sentences that compare methods are made from the numbers of the run, never written beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from impc.control.named_solver import described
from impc.reporting.document import Picture, Report
from impc.studies.example.cases import LOST, SETTINGS
from impc.studies.example.figures import FIGURES, example_figures
from impc.studies.example.result import example_data
from impc.studies.example.table import (
    METHODS,
    Row,
    compact_weights,
    determined_sentences,
    significant,
    table_rows,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.reporting.provenance import Provenance
    from impc.studies.example.cases import CaseResult, MethodResult

__all__ = ["example_report"]


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
