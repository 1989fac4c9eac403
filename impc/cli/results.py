"""`impc results`: a table of the fits in a folder."""

from __future__ import annotations

from pathlib import Path

import click

from impc.errors import InputError, OutputError, one_line
from impc.files.formats import write_file
from impc.files.results import results_and_origins
from impc.files.spreadsheet import as_data, workbook_bytes
from impc.reporting.finding import Finding, csv_bytes


def run_results(folder: Path, out: Path | None) -> None:
    """Print the fits in a folder and below, and write them to a table."""
    if out is not None and out.suffix not in (".xlsx", ".csv"):
        raise InputError("--out", f"got {out.name}", "end it in .xlsx or .csv")
    if out is not None and out.exists():
        raise OutputError(str(out), "already exists", "choose another name, or remove it")
    table, origins = results_and_origins(folder)
    if not len(table):
        raise InputError(
            str(folder), "has no result.json below it", "run impc fit, or name another"
        )
    if out is not None:
        sheets = {"fits": table, "provenance": origins}
        write_file(out, workbook_bytes(sheets) if out.suffix == ".xlsx" else csv_bytes(table))
    fits, others = (table[one] for one in (table["note"] == "", table["note"] != ""))
    # A terminal has room for the first output and the first gain.
    names = list(map(str, table))
    vaf = [name for name in names if name.startswith("vaf.")][:1]
    gain = [name for name in names if f"{name}_unit" in names][:1]
    ends = {f"{name}_{end}": end for name in gain for end in ("low", "high")}
    heads = {name: f"VAF {one_line(name[4:], 20)} (%)" for name in vaf} | ends
    heads |= {name: one_line(fits[f"{name}_unit"].iloc[0], 30) for name in gain}
    shown = fits.reindex(columns=["folder", "subject", "verdict", *vaf, *gain, *ends])
    click.echo(Finding("fits", as_data(shown), labels=heads).text())
    for place, note in zip(others["folder"], others["note"], strict=True):
        click.echo(f"{one_line(place)}: {one_line(note)}", err=True)
