"""What the pages have in common: the folder of a request, links, forms, and the template."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response

from impc.app.subject import Subject, folder_below, near
from impc.errors import InputError
from impc.files.formats import FORMATS
from impc.levels import Level

STEPS = {"recordings": "Recordings", "signals": "Signals", "body": "Body and limit", "fit": "Fit",
         "results": "Results", "compare": "Compare"}  # fmt: skip
_LARGEST_FORM, _FIELDS = 1_000_000, 5000


@functools.cache
def _templates() -> Environment:
    found = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    words = {one.value: one.words for one in Level}
    found.globals |= {"shell": shlex.join, "near": near, "steps": STEPS, "verdicts": words,
                      "endings": ", ".join(FORMATS)}  # fmt: skip
    return found


def posted(handler: Callable[[Request, dict[str, str]], Response]) -> Callable[..., Any]:
    """Read a form, and call the handler in a thread."""

    async def endpoint(request: Request) -> Response:
        given = b""
        async for part in request.stream():
            given += part
            if len(given) > _LARGEST_FORM:
                raise HTTPException(413)
        try:
            pairs = parse_qsl(given.decode(), keep_blank_values=True, max_num_fields=_FIELDS)
        except ValueError:
            raise HTTPException(400) from None
        return await run_in_threadpool(handler, request, dict(pairs))

    return endpoint


def subject_of(request: Request) -> Subject:
    """The folder that a request is about."""
    state = request.app.state
    return Subject(folder_below(state.root, request.query_params.get("f", "")), state.plants)


def inside(request: Request, folder: Path) -> str:
    """A folder in addresses; empty for the root."""
    found = folder.relative_to(request.app.state.root).as_posix()
    return "" if found == "." else found


def link(request: Request, to: str, folder: Path, **query: str) -> str:
    """Address of a page of a folder."""
    known = inside(request, folder)
    asked = urlencode(({"f": known} if known else {}) | query)
    return f"{request.scope['root_path']}/{to}" + (f"?{asked}" if asked else "")


def back(request: Request, to: str, folder: Path) -> Response:
    """Go to a page of a folder."""
    return RedirectResponse(link(request, to, folder), 303)


def page(request: Request, step: str, **more: Any) -> Response:
    """One of the pages `STEPS`, or the part of it that is asked for."""
    return _page(request, subject_of(request), step, 200, **more)


def refused(request: Request, fault: str) -> Response:
    """A page that only says what is wrong; of the first folder if that of the request is wrong."""
    state = request.app.state
    try:
        subject = subject_of(request)
    except InputError:
        subject = Subject(state.root, state.plants)
    return _page(request, subject, "", 400, fault=fault.replace(f"{subject.folder}/", ""))


def _page(request: Request, subject: Subject, step: str, status: int, **more: Any) -> Response:
    def linked(to: str, folder: Path = subject.folder, **query: str) -> str:
        return link(request, to, folder, **query)

    return HTMLResponse(_templates().get_template("page.html").render(
        step=step, subject=subject, root=request.app.state.root, link=linked,
        inside=inside(request, subject.folder), part=request.headers.get("hx-request", ""),
        base=request.scope["root_path"], **more,
    ), status)  # fmt: skip
