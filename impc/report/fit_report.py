"""All files of a fit, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from impc.report.fit_figures import fit_figures
from impc.report.fit_page import fit_page
from impc.report.fit_result_json import fit_json

if TYPE_CHECKING:
    from impc.fit_result import FitResult
    from impc.report.provenance import FitProvenance

__all__ = ["fit_files"]


def fit_files(result: FitResult, provenance: FitProvenance) -> dict[str, bytes]:
    """Build the page, result.json and the figures; nothing is written."""
    figures = fit_figures(result)
    return {
        "report.html": fit_page(result, figures, provenance).encode(),
        "result.json": fit_json(result, provenance),
        **figures,
    }
