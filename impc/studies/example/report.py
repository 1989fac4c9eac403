"""All files of a run of the example, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from impc.studies.example.figures import example_figures
from impc.studies.example.page import render_page
from impc.studies.example.result import result_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.reporting.provenance import Provenance
    from impc.studies.example.cases import CaseResult

__all__ = ["example_files"]


def example_files(cases: Sequence[CaseResult], provenance: Provenance) -> dict[str, bytes]:
    """Build the page, result.json and the figures of every case; nothing is written."""
    figures: dict[str, bytes] = {}
    for case in cases:
        figures |= example_figures(case)
    page = render_page(cases, figures, provenance)
    return {
        "report.html": page.encode(),
        "result.json": result_json(cases, provenance),
        **figures,
    }
