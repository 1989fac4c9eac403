"""Recordings, signals, body and limit: what the pages show, and what their forms write."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.responses import PlainTextResponse, RedirectResponse, Response

from impc.app import body, signals
from impc.app.page import page, subject_of
from impc.app.subject import Subject, may_be_recording, table
from impc.errors import ImpcError
from impc.files.disk import LARGEST, write_whole
from impc.files.draft import drafted
from impc.files.formats import FORMATS

if TYPE_CHECKING:
    from starlette.requests import Request


def recordings(request: Request) -> Response:
    """Files of the folder, and folders of further subjects."""
    subject = subject_of(request)
    trials, rows = {path.name for path in subject.trials}, []
    for path in subject.recordings:
        try:
            found = table(path)
        except ImpcError as error:
            rows.append((path.name, f"{error.problem}; {error.remedy}", False, False))
            continue
        names = ", ".join(found.columns)
        what = f"{found.samples} samples, {len(found.columns)} columns: {names}"
        rows.append((path.name, what, True, path.name in trials))
    lost = "is named in subject.toml and not in the folder: copy it here, or change a tick above"
    rows += [(name, lost, False, False) for name in subject.asked.files if name not in trials]
    folders = [(one.name, _state(Subject(one, subject.plants))) for one in subject.folders]
    return page(request, "recordings", rows=rows, folders=folders)


def _state(subject: Subject) -> str:
    """State of the folder of a subject in words."""
    count = len(subject.recordings)
    if not count:
        return f"{len(subject.folders)} folders" if subject.folders else "empty"
    fits = sum((out / "result.json").exists() for out in subject.outs)
    trials = f"{count} recording{'s' * (count > 1)}"
    begun = "begun" if subject.config.exists() else "not begun"
    return f"{trials}, {f'{fits} fit' + 's' * (fits > 1) if fits else begun}"


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
    inside = folder.relative_to(request.app.state.root).as_posix()
    to = f"{request.scope['root_path']}/recordings?f={quote(inside, safe='')}"
    return RedirectResponse(to, 303)


def show_signals(request: Request, problem: str = "") -> Response:
    """Every column, what it is taken for, and what is open."""
    subject = subject_of(request)
    files = [path.name for path in subject.trials]
    if not files:
        return page(request, "signals", files=[])
    asked = request.query_params.get("file", files[0])
    shown = table(subject.folder / (asked if asked in files else files[0]))
    plant, text = subject.plant(), subject.text
    columns = signals.columns(text, shown, plant)
    asked_there = {("signals", one.role, "unit") for one in columns if one.asked}
    notices = [one for one in subject.notices() if one.place not in asked_there]
    start = drafted(shown, subject.source).start
    answered = {column.role for column in columns}
    known = signals.roles(plant)
    lacking = [known[name].words for name in plant.outputs if name not in answered]
    return page(
        request, "signals", files=files, file=Path(shown.source).name, columns=columns,
        notices=notices, lacking=lacking, roles=known, rate=shown.rate, text=text,
        recording=subject.content.get("recording", {}), problem=problem,
        pulse=start[1] if start else "",
    )  # fmt: skip


def set_signals(request: Request, form: dict[str, str]) -> Response:
    """Write what the columns mean."""
    subject = subject_of(request)
    shown = table(subject.folder / Path(form.get("file", "")).name)
    try:
        subject.change(signals.answers(form, shown, subject.plant(), subject.content))
    except ImpcError as error:
        return show_signals(request, str(error))
    return show_signals(request)


def show_body(request: Request, problem: str = "", saved: bool = False) -> Response:
    """Parameters of the plant and settings of the fit."""
    subject = subject_of(request)
    if not subject.trials:
        return page(request, "body", rows=[])
    plant, fit = subject.plant(), subject.content.get("fit", {})
    return page(
        request, "body", rows=body.rows(subject), settings=fit, text=subject.text, problem=problem,
        saved=saved, unit=plant.unit(plant.controls[0]), dt=plant.dt, plants=subject.plants,
        horizon=fit.get("horizon", body.HORIZON),
    )  # fmt: skip


def set_body(request: Request, form: dict[str, str]) -> Response:
    """Write body and limit; a value that the plant refuses is not kept."""
    subject = subject_of(request)
    before = subject.config.read_bytes() if subject.config.exists() else None
    try:
        if form.get("plant", subject.plant_name) != subject.plant_name:
            if form["plant"] in subject.plants:
                subject.change({("subject", "plant"): form["plant"]})
        else:
            subject.change(body.answers(form, subject))
        subject_of(request).plant()
    except ImpcError as error:
        if before is None:
            subject.config.unlink(missing_ok=True)
        else:
            write_whole(subject.config, before)
        return show_body(request, str(error))
    return show_body(request, saved=True)
