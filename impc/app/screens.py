"""Recordings, signals, body and limit: what the pages show, and what their forms write."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from impc.app import answers
from impc.app.page import back, page, subject_of
from impc.app.subject import RESULTS, Subject, may_be_recording, table
from impc.errors import ImpcError
from impc.files.clock import rejected_clocks
from impc.files.disk import LARGEST, write_whole
from impc.files.draft import draft
from impc.files.formats import FORMATS
from impc.files.table import OTHER_SHEET
from impc.reporting.shown_units import signal_name


def recordings(request: Request) -> Response:
    """Files of the folder, and folders of further subjects."""
    subject, rows = subject_of(request), []
    named = subject.asked.files
    for path in subject.recordings:
        try:
            found = table(path, subject.sheet)
        except ImpcError as error:
            rows.append((path.name, f"{error.problem}; {error.remedy}", False, False))
            continue
        names = ", ".join(found.columns)
        what = f"{found.samples} samples, {len(found.columns)} columns: {names}"
        rows.append((path.name, what, True, path.name in named))
    lost = "is named in subject.toml and not in the folder: copy it here, or change a tick above"
    there = {path.name for path in subject.recordings}
    rows += [(name, lost, False, False) for name in named if name not in there]
    folders = [(one, _state(Subject(one, subject.plants)))
               for one in sorted(subject.folder.iterdir())
               if one.is_dir() and one.name[0] not in "._" and one.name != RESULTS]  # fmt: skip
    return page(request, "recordings", rows=rows, folders=folders)


def _state(subject: Subject) -> str:
    """State of the folder of a subject in words."""
    count = len(subject.recordings)
    if not count:
        return "no recordings"
    fits = sum((out / "result.json").exists() for out in subject.outs)
    begun = "begun" if subject.config.exists() else "not begun"
    done = f"{fits} fit{'s' * (fits > 1)}" if fits else begun
    return f"{count} recording{'s' * (count > 1)}, {done}"


def use(request: Request, form: dict[str, str]) -> Response:
    """Choose the recordings that are fitted."""
    subject = subject_of(request)
    names = [path.name for path in subject.recordings if f"use.{path.name}" in form]
    subject.change({("subject", "files"): names})
    return Response(status_code=204)


async def drop(request: Request) -> Response:
    """Write one dropped file into the folder; it never replaces one."""
    subject, name = subject_of(request), Path(request.query_params.get("name", "")).name
    if not name.isprintable() or not may_be_recording(name) or Path(name).is_reserved():
        said = f"{name}: is not a recording; give one of {', '.join(FORMATS)}"
        return PlainTextResponse(said, 415)
    new, size = subject.folder / f".impc-{secrets.token_hex(8)}", 0
    begun = subject.config.exists()
    try:
        with new.open("xb") as stream:
            async for part in request.stream():
                size += len(part)
                if size > LARGEST:
                    return PlainTextResponse(f"{name}: is larger than 1 GB", 413)
                stream.write(part)
        os.link(new, subject.folder / name)  # fails if there is one
    except FileExistsError:
        return PlainTextResponse(f"{name}: is in the folder already; rename one of the two", 409)
    except OSError as error:
        return PlainTextResponse(f"{name}: cannot be written ({error.strerror})", 507)
    finally:
        new.unlink(missing_ok=True)
    if begun:
        names = [path.name for path in subject.trials] + [name]
        await run_in_threadpool(subject.change, {("subject", "files"): names})
    return Response(status_code=204)


def practise(request: Request, _: dict[str, str]) -> Response:
    """Write the recordings of a simulated person into a folder of their own."""
    folder = subject_of(request).folder / "practice"
    words = [sys.executable, "-P", "-m", "impc", "simulate", "seated-balance", "--formats", "csv",
             "--out", str(folder)]  # fmt: skip
    done = subprocess.run(
        words, stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", check=False
    )
    if done.returncode:
        return PlainTextResponse(done.stderr, 400)
    return back(request, "recordings", folder)


def show_signals(request: Request, problem: str = "", file: str = "") -> Response:
    """Every column, what it is taken for, and what is open."""
    subject = subject_of(request)
    files = {path.name: path for path in subject.trials}
    if not files:
        return page(request, "signals", files=[])
    path = files.get(file or request.query_params.get("file", ""), subject.trials[0])
    shown, plant = table(path, subject.sheet), subject.plant()
    columns, known = answers.columns(subject.text, shown, plant), answers.roles(plant)
    taken = {column.role for column in columns}
    absent = [name for name in known if name not in {answers.CLOCK, *taken}]
    asked: set[tuple[str, ...]] = set()
    asked |= {("signals", one.role, "unit") for one in columns if one.question}
    asked |= {("signals", one.role, mark.key) for one in columns for mark in one.marks}
    asked |= {("signals", name, *key) for name in absent for key in ((), ("column",), ("unit",))}
    clocks = {} if answers.CLOCK in taken else rejected_clocks(shown)
    asked |= {("recording", "time")} if clocks else set()
    start = draft(shown, plant).start
    sheets = [name.removeprefix("sheet ") for name, why in shown.skipped.items()
              if why == OTHER_SHEET]  # fmt: skip
    return page(
        request, "signals", files=list(files), path=path, columns=columns, roles=known,
        notices=[one for one in subject.notices() if one.place not in asked], rate=shown.rate,
        lacking=[known[name].words for name in absent if known[name].kind == "output"],
        pushes=[known[name].words for name in absent if name in plant.controls[1:]],
        clocks=[f"{name} {fault}; {remedy}" for name, (fault, remedy) in clocks.items()],
        recording=subject.content.get("recording", {}), problem=problem,
        pulse=start[1] if start else "", sheets=sheets,
    )  # fmt: skip


def set_signals(request: Request, form: dict[str, str]) -> Response:
    """Write what the columns mean."""
    subject = subject_of(request)
    path = subject.folder / Path(form.get("file", "")).name
    try:
        shown = table(path, subject.sheet)
        subject.change(answers.signal_changes(form, shown, subject))
    except ImpcError as error:
        return show_signals(request, str(error), path.name)
    answer = show_signals(request, "", path.name)
    if form.get("sheet", "") != subject.sheet:  # other columns
        answer.headers["hx-refresh"] = "true"
    return answer


def show_body(request: Request, problem: str = "", saved: bool = False) -> Response:
    """Parameters of the plant and settings of the fit."""
    subject = subject_of(request)
    if not subject.trials:
        return page(request, "body", rows=[])
    plant, content = subject.plant(), subject.content
    settings = {"horizon": answers.HORIZON} | content.get("fit", {})
    return page(
        request, "body", rows=subject.source.parameters(), given=content.get("plant", {}),
        settings=settings, problem=problem, saved=saved, unit=plant.unit(plant.controls[0]),
        dt=plant.dt, command=signal_name(plant, plant.controls[0]),
    )  # fmt: skip


def set_body(request: Request, form: dict[str, str]) -> Response:
    """Write body and limit; a value that the plant refuses is not kept."""
    subject = subject_of(request)
    before = subject.config.read_bytes() if subject.config.exists() else None
    other = form.get("plant", "") in {*subject.plants} - {subject.plant_name}
    try:
        if other:
            subject.change({("subject", "plant"): form["plant"]})
        else:
            subject.change(answers.body_changes(form, subject))
        subject_of(request).plant()
    except ImpcError as error:
        if before is None:
            subject.config.unlink(missing_ok=True)
        else:
            write_whole(subject.config, before)
        return show_body(request, str(error))
    answer = show_body(request, saved=True)
    if other:  # other quantities
        answer.headers["hx-refresh"] = "true"
    return answer
