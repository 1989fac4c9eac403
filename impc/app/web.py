"""The application: addresses, and the functions that answer them."""

from __future__ import annotations

from pathlib import Path

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route

import impc.reporting
from impc.app import reports, screens
from impc.app.fits import Fits
from impc.app.page import posted, refused
from impc.errors import ImpcError

_REPORTING = Path(impc.reporting.__file__).parent
_STATIC = {path.name: path for path in (
    *(Path(__file__).parent / "static").iterdir(), _REPORTING / "style.css",
    *(_REPORTING / "vendor").glob("uPlot*"))}  # fmt: skip
_GETS = {
    "": screens.recordings, "recordings": screens.recordings, "signals": screens.show_signals,
    "body": screens.show_body, "fit": reports.show_fit, "results": reports.results,
    "compare": reports.compare, "subjects.xlsx": reports.workbook,
    "file/{name:path}": reports.result_file,
}  # fmt: skip
_POSTS = {
    "use": screens.use, "practise": screens.practise, "signals": screens.set_signals,
    "body": screens.set_body, "fit": reports.start, "stop": reports.stop,
}  # fmt: skip


def application(root: Path, plants: tuple[str, ...]) -> Starlette:
    """The application for the folder `root`, with the plants to choose from."""
    routes = [Route(f"/{name}", handler) for name, handler in _GETS.items()]
    routes += [Route(f"/{name}", posted(one), methods=["POST"]) for name, one in _POSTS.items()]
    routes += [Route("/drop", screens.drop, methods=["POST"]), Route("/static/{name}", _static)]
    found = Starlette(routes=routes, exception_handlers={ImpcError: _refused})
    found.state.root, found.state.plants, found.state.fits = root, plants, Fits()
    return found


def _refused(request: Request, error: Exception) -> Response:
    if request.method == "GET" and "hx-request" not in request.headers:
        return refused(request, str(error))
    return PlainTextResponse(f"{error}\n", 400)


def _static(request: Request) -> Response:
    found = _STATIC.get(request.path_params["name"])
    if found is None:
        raise HTTPException(404)
    return FileResponse(found, headers={"cache-control": "max-age=3600"})
