"""What the pages have in common: the folder of a request, forms, and the template."""

from __future__ import annotations

import functools
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, RedirectResponse

from impc.app.subject import Subject, folder_below, near
from impc.files.formats import FORMATS

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.requests import Request
    from starlette.responses import Response

STEPS = {
    "recordings": "Recordings",
    "signals": "Signals",
    "body": "Body and limit",
    "fit": "Fit",
    "results": "Results",
    "compare": "Compare",
}
_LARGEST_FORM, _FIELDS = 1_000_000, 5000


@functools.cache
def templates() -> Environment:
    """The template of all pages."""
    found = Environment(
        loader=FileSystemLoader([Path(__file__).parent]), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    found.globals |= {
        "shell": shlex.join,
        "near": near,
        "steps": STEPS,
        "endings": ", ".join(FORMATS),
    }
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


def page(request: Request, step: str, status: int = 200, **more: Any) -> HTMLResponse:
    """One of the pages `STEPS`, or the part of it that is asked for."""
    state, subject = request.app.state, subject_of(request)
    inside = subject.folder.relative_to(state.root).as_posix().removeprefix(".")

    def link(to: str, **query: str) -> str:
        pairs = ({"f": inside} if inside else {}) | query
        asked = "&".join(f"{key}={quote(value, safe='')}" for key, value in pairs.items())
        return f"{request.scope['root_path']}/{to}" + (f"?{asked}" if asked else "")

    part = request.headers.get("hx-request", "")
    text = templates().get_template("page.html").render(
        step=step, subject=subject, root=state.root, inside=inside, link=link, part=part,
        base=request.scope["root_path"], **more,
    )  # fmt: skip
    return HTMLResponse(text, status)


def back(request: Request, to: str) -> Response:
    """Go to another page of the folder."""
    folder = quote(request.query_params.get("f", ""), safe="")
    return RedirectResponse(f"{request.scope['root_path']}/{to}?f={folder}", 303)
