"""Fit, results and comparison: what the pages show, and the files that they serve."""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response

from impc.app.fits import Fit
from impc.app.page import back, page, subject_of
from impc.app.subject import RESULTS, Subject
from impc.cli.plant import CONFIGURATION
from impc.errors import ImpcError
from impc.files.configuration import toml_content
from impc.reporting.rendering import report_script_hashes
from impc.reporting.writer import written

# A report may come from someone else: it runs the scripts of impc's pages and no others, and is no
# page of this server.
_REPORT = (
    "sandbox allow-scripts allow-popups allow-downloads; default-src 'none'; img-src data:; "
    "style-src 'unsafe-inline'; script-src {}; frame-ancestors 'self'"
)


def show_fit(request: Request) -> Response:
    """What stops a fit, its progress, and its command."""
    subject, fits = subject_of(request), request.app.state.fits
    run: Fit | None = fits.of(subject.folder / RESULTS)
    running = run is not None and not run.over
    words = list(run.words) if run and running else subject.command(subject.out)
    target = request.headers.get("hx-target")
    waits = bool(subject.trials) and not running and target is None  # for the check, with a sign
    problem, answer, takes = "There is nothing to fit yet: add recordings.", "recordings", ""
    if subject.trials:
        problem, answer, takes = _ready(subject) if target == "fit" else ("", "", "")
    last = next(iter(subject.outs), None) if target == "fit" else None
    since = _changes(_used(subject.config), _used(last / CONFIGURATION)) if last else ""
    return page(
        request, "fit", run=run, before=fits.before(run) if run else 0, problem=problem,
        where=answer, takes=takes, words=words, resumes=subject.out.exists(), waits=waits,
        polled=target == "progress", since=since,
    )  # fmt: skip


def _ready(subject: Subject) -> tuple[str, str, str]:
    """What stops a fit before it begins, the page that answers it, and the time that it takes."""
    from impc.cli.plant import asked_subject, read_subject  # noqa: PLC0415  # slow
    from impc.studies.effort import fit_effort  # noqa: PLC0415

    try:
        found = read_subject(asked_subject("fit", (), subject.given, subject.config))
        effort = fit_effort(found.problem, found.settings)
    except ImpcError as error:
        table = error.place[0] if error.place else ""
        page_of = {"plant": "body", "fit": "body", "signals": "signals", "recording": "signals"}
        return str(error).replace(f"{subject.folder}/", ""), page_of.get(table, ""), ""
    minutes = max(1, round(effort.seconds / 60))
    return "", "", f"about {minutes} minute{'s' * (minutes > 1)}"


def start(request: Request, _: dict[str, str]) -> Response:
    """Queue the fit that the page shows."""
    subject = subject_of(request)
    if subject.trials:
        request.app.state.fits.start(subject.command(subject.out), subject.out)
    return back(request, "fit", subject.folder)


def stop(request: Request, _: dict[str, str]) -> Response:
    """Stop the fit of the folder."""
    run = request.app.state.fits.of(subject_of(request).folder / RESULTS)
    if run is not None:
        run.stop()
    return show_fit(request)


def _table(folder: Path) -> Any:
    from impc.files.results import results as table_of  # noqa: PLC0415  # pandas

    return table_of(folder)


def results(request: Request) -> Response:
    """Reports of the folder, one in a frame."""
    subject = subject_of(request)
    folder = subject.folder / RESULTS
    rows = _table(folder).to_dict("records") if subject.outs else []
    used = [_used(folder / row["folder"] / CONFIGURATION) for row in rows]
    changes = [*(_changes(*pair) for pair in pairwise(used)), ""][: len(rows)]
    since = _changes(_used(subject.config), used[0]) if rows else ""
    names = [row["folder"] for row in rows]
    asked = request.query_params.get("r", "")
    chosen = asked if asked in names else next(iter(names), "")
    return page(
        request, "results", rows=rows, changes=changes, since=since, folder=folder, chosen=chosen
    )


def _used(file: Path) -> dict[str, Any]:
    """Settings of a fit by their TOML paths; empty if they cannot be read."""
    try:
        return _flat(toml_content(file.read_text(encoding="utf-8-sig"), file.name))
    except (ImpcError, OSError, ValueError):
        return {}


def _flat(value: Any, place: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {place.removeprefix("."): value}
    parts = [_flat(one, f"{place}.{name}") for name, one in value.items()]
    return {key: one for part in parts for key, one in part.items()}


def _changes(new: Mapping[str, Any], old: Mapping[str, Any]) -> str:
    """Settings that changed, with both values; empty if one of the two is not known."""
    keys = [key for key in {**old, **new} if old.get(key) != new.get(key)] if old and new else []
    return ", ".join(f"{key} {old.get(key, 'none')} → {new.get(key, 'none')}" for key in keys)


def compare(request: Request) -> Response:
    """One row for each subject, or for each fit, below the root."""
    found, every = _table(request.app.state.root), request.query_params.get("all") == "1"
    if not every:
        found = found.drop_duplicates(["subject", "visit", "condition"])
    rows = [_row(row) for row in found.sort_values("folder").to_dict("records")]
    heads = list(dict.fromkeys(head for row in rows for head in row if row[head]))
    return page(request, "compare", heads=heads, rows=rows, every=every)


def _row(fit: dict[str, Any]) -> dict[str, Any]:
    """Cells of a fit by heading: a gain with its interval, or no gain and the reason."""
    known = {name: value for name, value in fit.items() if value is not None and value == value}  # noqa: PLR0124  # NaN
    row = {name: known.get(name, "") for name in ("folder", "subject", "visit", "condition")}
    row |= {"verdict": known.get("verdict", ""), "trials": f"{known.get('trials', 0):.0f}"}
    for name, value in known.items():
        if f"{name}_low" in known:
            low, high = (f"{known[f'{name}_{end}']:.3g}" for end in ("low", "high"))
            row[known[f"{name}_unit"]] = f"{value:.3g} ({low} to {high})"
        elif name.startswith(("vaf.", "limit")):
            words = name.replace("vaf.", "variance explained (%), ").replace("limit.", "limit, ")
            row[words] = f"{value:.4g}"
    return row | {"why no gain": known.get("reason", "") or known.get("note", "")}


def workbook(request: Request) -> Response:
    """The table of results as a workbook."""
    from impc.files.spreadsheet import workbook_bytes  # noqa: PLC0415  # pandas

    content = workbook_bytes({"fits": _table(request.app.state.root)})
    return Response(content, headers=_download("subjects.xlsx"))


def _download(name: str) -> Mapping[str, str]:
    return {"content-disposition": f"attachment; filename*=utf-8''{quote(name, safe='')}"}


def result_file(request: Request) -> Response:
    """A file that impc listed as a result, and no others; reports in their sandbox."""
    root: Path = request.app.state.root
    real = Path(os.path.realpath(root / request.path_params["name"]))
    for folder in real.parents if real.is_relative_to(root) else ():
        name = real.relative_to(folder).as_posix()
        if folder.is_relative_to(root) and name in written(folder) and real.is_file():
            if real.suffix != ".html":
                return FileResponse(real, headers=_download(real.name))
            sealed = " ".join(f"'sha256-{one}'" for one in report_script_hashes())
            policy = {"content-security-policy": _REPORT.format(sealed)}
            return FileResponse(real, headers=policy, media_type="text/html")
    return PlainTextResponse("There is no such result.\n", 404)
