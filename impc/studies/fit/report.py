"""All files of a fit, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from impc.studies.fit.figures import fit_figures
from impc.studies.fit.page import fit_page
from impc.studies.fit.schema import fit_json

if TYPE_CHECKING:
    from impc.reporting.provenance import FitProvenance
    from impc.studies.fit.result import FitResult

__all__ = ["fit_files"]


def fit_files(result: FitResult, provenance: FitProvenance) -> dict[str, bytes]:
    """Build the page, result.json and the figures; nothing is written."""
    figures = fit_figures(result)
    return {
        "report.html": fit_page(result, figures, provenance).encode(),
        "result.json": fit_json(result, provenance),
        **figures,
    }
