"""The table of methods and what the recording determined, as text for terminal and page alike."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.inverse.methods import METHODS as REGISTRY
from impc.model.weights import normalised
from impc.reporting.document import TextTable
from impc.studies.example.cases import EXAMPLE, true_weights

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.assess.identified_directions import Identifiability
    from impc.model.weights import Weights
    from impc.studies.example.cases import CaseResult, MethodResult


@dataclass(frozen=True)
class MethodText:
    """A method in words."""

    label: str  # For tables
    sentence: str  # For readers who do not know it


#: The true controller and the methods in words, by their names.
METHODS: dict[str, MethodText] = {
    "truth": MethodText("true controller", "The MPC that made the recording."),
    **{name: MethodText(REGISTRY[name].label, REGISTRY[name].sentence) for name in EXAMPLE},
}

#: Heads of the table.
COLUMNS = ("method", "Q11 Q12 Q22 / R", "gain K", "misfit", "max |u|", "kept", "(3.10)", "seconds")
_NONE = "-"


@dataclass(frozen=True)
class Row:
    """One line of the table, every cell as text."""

    name: str  # Of the method: the key in result.json
    weights: str  # Entries; a dash or "infeasible" where there are none
    gain: str
    # 2-norm of the state misfit, largest magnitude of the input, whether the bound is kept
    misfit: str
    largest: str
    kept: str
    residual: str  # (3.10)
    seconds: str  # Time of the method, s

    @property
    def cells(self) -> tuple[str, ...]:
        """The cells in the order of `COLUMNS`."""
        return astuple(self)


def table_rows(case: CaseResult) -> tuple[Row, ...]:
    """Return the true controller, then every method, in the order of the table."""
    truth = Row(
        name="truth",
        weights=compact_weights(true_weights(case.controller.plant)),
        gain=_vector(case.controller.K),
        misfit=_NONE,
        largest=_fixed(float(np.max(np.abs(case.truth.u)))),
        kept="yes",
        residual=_NONE,
        seconds=_NONE,
    )
    return (truth, *(_method_row(method) for method in case.methods))


def methods_table(case: CaseResult) -> TextTable:
    """The table for a terminal."""
    caption = f"Case {case.name}: every method on the same recording"
    return TextTable(caption, COLUMNS, [row.cells for row in table_rows(case)])


def determined_sentences(found: Identifiability) -> tuple[str, ...]:
    """Say what the recording determined, what the condition number chose, and what else fits."""
    values = ", ".join(significant(value) for value in found.singular_values)
    first = (
        f"The recording determined {found.rank} of the {found.free} free directions of (Q, R); "
        f"the condition number chose {found.chosen}. (Singular values, with scale: {values}.)"
    )
    others = (
        f"Other weights that explain it as well: {compact_weights(item.weights)}, "
        f"condition number {significant(item.condition)}, misfit {significant(item.misfit)}."
        for item in found.others
    )
    return (first, *others)


def compact_weights(weights: Weights) -> str:
    """Upper triangles of Q and R, scaled to R[0, 0] = 1: ``Q11 Q12 Q22 / R``."""
    scaled = normalised(weights)
    q, r = (" ".join(_upper(matrix)) for matrix in (scaled.Q, scaled.R))
    return f"{q} / {r}"


def significant(value: float) -> str:
    """Three digits of a `value`; whole numbers that are exact to nine digits without a point."""
    return str(round(value)) if 1 <= abs(value) < 1e6 and _whole(value) else f"{value:.3g}"


def _method_row(method: MethodResult) -> Row:
    if method.feasible is False:
        weights = "infeasible"
    else:
        weights = _NONE if method.weights is None else compact_weights(method.weights)
    return Row(
        name=method.name,
        weights=weights,
        gain=_NONE if method.K is None else _vector(method.K),
        misfit=_optional(method.state_misfit),
        largest=_NONE if method.max_abs_u is None else _fixed(method.max_abs_u),
        kept={None: _NONE, True: "yes", False: "no"}[method.bound_kept],
        residual=_optional(method.residual),
        seconds=_fixed(method.seconds),
    )


def _upper(matrix: Array) -> list[str]:
    entries = matrix[np.triu_indices(len(matrix))]
    return [_fixed(float(entry)) for entry in entries] if len(matrix) > 1 else [f"{entries[0]:.4g}"]


def _vector(matrix: Array) -> str:
    return " ".join(_fixed(float(entry)) for entry in matrix.ravel())


def _fixed(value: float) -> str:
    # Adding zero after rounding: -0.0004 is printed as 0.000, not as -0.000.
    return f"{round(value, 3) + 0.0:.3f}"


def _optional(value: float | None) -> str:
    return _NONE if value is None else f"{value:.3g}"


def _whole(value: float) -> bool:
    return abs(value - round(value)) < 1e-9 * abs(value)
