"""All files of the example: figures in two formats, the page, result.json."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from impc.report.example_figures import example_figures
from impc.report.page import example_page
from impc.report.result import example_json
from impc.report.style import styled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from impc.example import CaseResult

__all__ = ["example_files"]


def example_files(cases: Sequence[CaseResult]) -> dict[str, bytes]:
    """File name -> content, the page and result.json first."""
    with styled():
        figures = {name: figure for case in cases for name, figure in example_figures(case).items()}
        pictures = {name: _render(figure, "png") for name, figure in figures.items()}
        vectors = {f"{name}.pdf": _render(figure, "pdf") for name, figure in figures.items()}
    return {
        "report.html": example_page(cases, pictures).encode(),
        "result.json": example_json(cases).encode(),
        **{f"{name}.png": picture for name, picture in pictures.items()},
        **vectors,
    }


def _render(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    # No date inside, so that the same result makes the same file.
    metadata = {"CreationDate": None} if kind == "pdf" else {}
    figure.savefig(buffer, format=kind, dpi=160, metadata=metadata)
    return buffer.getvalue()
