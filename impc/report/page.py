"""One self-contained HTML page: no script, no outside resource, figures inside it."""

from __future__ import annotations

import base64
from importlib.resources import files
from typing import TYPE_CHECKING

import jinja2

from impc.example import BOUND, HORIZON, STEPS
from impc.report.result import settings, versions
from impc.report.table import HEADINGS, determined, say_weights, table_rows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.example import CaseResult

__all__ = ["example_page"]

_CAPTIONS = {
    "figure-3-2": "Counterpart of figure 3.2. A plain feedback gain u = -Kx, fitted to the "
    "recorded states. The states are near; the input it needs passes the bound where it is "
    "marked.",
    "figure-3-3": "Counterpart of figure 3.3. Inverse MPC: recorded and explained curves lie on "
    "each other, and the input keeps the bound.",
    "figure-3-4": "Counterpart of figure 3.4. Inverse LQR fitted to the states (3.16): a regulator "
    "that knows no bound.",
    "terminal-set": "The grey area is the terminal set: the states from which the plain gain keeps "
    "the bound for ever. The controller plans to be inside it at the end of its horizon.",
}


def example_page(cases: Sequence[CaseResult], pictures: Mapping[str, bytes]) -> str:
    """The page of the example.

    Parameters
    ----------
    cases : sequence of CaseResult
    pictures : mapping
        File name without extension -> PNG; drawn in this order under their case.
    """
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(
        files("impc.report").joinpath("page.html").read_text(encoding="utf-8")
    )
    return template.render(
        headings=HEADINGS,
        cases=[_case(case, pictures) for case in cases],
        settings=settings(),
        versions=versions(),
        bound=BOUND,
        horizon=HORIZON,
        steps=STEPS,
    )


def _case(case: CaseResult, pictures: Mapping[str, bytes]) -> dict[str, object]:
    ending = f"-case-{case.name}"
    return {
        "name": case.name,
        "x0": ", ".join(f"{value:g}" for value in case.x0),
        "branch": case.branch,
        "rows": table_rows(case),
        "determined": determined(case),
        "others": [
            (say_weights(item.weights), f"{item.condition:.3g}", f"{item.misfit:.1e}")
            for item in case.identifiability.others
        ],
        "figures": [
            (base64.b64encode(picture).decode("ascii"), _CAPTIONS[name.removesuffix(ending)])
            for name, picture in pictures.items()
            if name.endswith(ending)
        ],
    }
