"""Page of `impc inspect`: every signal of a recording, what it is taken for, and what is open."""

from __future__ import annotations

import numpy as np
import pandas as pd

from impc.files.configuration import FILL_IN
from impc.files.draft import Draft, Guess
from impc.files.units import si_unit
from impc.levels import Level
from impc.reporting.document import Report, Section
from impc.reporting.finding import Chart, Finding
from impc.reporting.provenance import Provenance
from impc.reporting.verdict import Verdict
from impc.studies.charts import short

# Largest number of values of a curve.
_MOST = 3000


def inspection_report(found: Draft, source: str, line: str) -> Report:
    """Report of a recording with the plant `source`; `line` is the command."""
    rows = [("time", found.clock)] if found.clock else []
    rows += list(found.signals.items())
    cells = [_cells(name, guess) for name, guess in rows]
    if found.start is not None:
        time, question = found.start
        cells.append(("", "start of the trial", "s", question, f"[recording] start = {time:.6g}"))
    cells += [(column, "not used", found.table.units.get(column, ""), "", "")
              for column in found.unused]  # fmt: skip
    heads = ("column", "taken_for", "unit", "question", "line_of_its_answer")
    table = pd.DataFrame(cells, columns=heads)
    asked = int(sum(bool(one[3]) for one in cells))
    level = Level.AMBER if asked else Level.GREEN
    said = f"{asked} question{'s' * (asked != 1)} about the columns." if asked else (
        "Names and units tell what every column is.")  # fmt: skip
    how = "Answer in the configuration, which --out writes; then run impc fit with it."
    signals = Finding("signals", table, figure=Chart("The signals", _curves(found)), level=level)
    return Report(
        f"{found.table.source}: signals", "inspection", Verdict(level, said, how, badge="Draft"),
        (Section("Columns", (signals,)),), provenance=Provenance(source, line),
    )  # fmt: skip


def _cells(name: str, guess: Guess) -> tuple[str, str, str, str, str]:
    """Column, meaning, unit, question, and line of its answer."""
    clock = name == "time"
    place = "[recording]" if clock else f"[signals.{name}]"
    column, unit = ("time", "time_unit") if clock else ("column", "unit")
    asked = [f"{column}: {guess.why}"] if guess.why else []
    lines = [f'{column} = "{guess.column}"'] if guess.why else []
    if guess.unit == FILL_IN or "guess" in guess.origin:
        asked.append(f"unit: {guess.origin}")
        lines.append(f'{unit} = "{guess.unit}"')
    lines += [line for line, _ in guess.asked]
    asked += [question for _, question in guess.asked]
    answer = f"{place} {', '.join(lines)}" if lines else ""
    return guess.column, name, guess.unit, "; ".join(asked), answer


def _curves(found: Draft) -> dict[str, object]:
    """Curves of all columns but the clock, thinned."""
    table, clock = found.table, found.clock
    stride = -(-table.samples // _MOST)
    step = 1.0 / (table.rate or 1.0)
    if clock is not None:
        step = float(np.median(np.diff(table.columns[clock.column]))) * si_unit(clock.unit).factor
    taken = {one.column: name for name, one in found.signals.items()}
    panels = [
        {
            "label": f"{taken.get(name, 'not used')}: {name} {table.units.get(name, '')}".strip(),
            "limits": [],
            "curves": [short(values[::stride])],
        }
        for name, values in table.columns.items()
        if clock is None or name != clock.column
    ]
    curve = {"label": "recorded", "color": "--rec", "dash": []}
    trial = {"label": "recording", "step": step * stride, "panels": panels}
    return {"curves": [curve], "trials": [trial]}
