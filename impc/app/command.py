"""`impc app`: serve the pages on this machine and open them."""

from __future__ import annotations

import os
import socket
import tempfile
import threading
from pathlib import Path

import click

from impc.cli.plant import KNOWN
from impc.extras import optional

# Seconds after which the file that opens the browser is removed.
_OPENED = 30.0


@click.command("app")
@click.argument("folder", default=".", type=click.Path(path_type=Path))
@click.option("--plant", "more", multiple=True,
              help="A further plant to choose: module:function, or a file.")  # fmt: skip
@click.option("--no-open", is_flag=True, help="Print the address; open no browser.")
def command(folder: Path, more: tuple[str, ...], no_open: bool) -> None:
    """Import, fit and read recordings in the browser; nothing leaves this machine.

    FOLDER has a folder for each subject. The pages write subject.toml and folders of results there,
    and show the command for all that they do. Ctrl-C ends the server and its fits.
    """
    from impc.errors import InputError  # noqa: PLC0415

    uvicorn = optional("uvicorn", "impc app")
    for library in ("starlette", "tomlkit"):
        optional(library, "impc app")
    if not folder.is_dir():
        raise InputError(str(folder), "is not a folder", "create it, or name another one")
    from impc.app.guard import Guard  # noqa: PLC0415
    from impc.app.web import application  # noqa: PLC0415

    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))  # this machine only, on a free port
        listening.listen()  # before the address is shown: a quick browser waits
        app = application(Path(os.path.realpath(folder)), (*KNOWN, *more))
        guard = Guard(app, listening.getsockname()[1])
        click.echo(f"Open {guard.address}\n(it works once; Ctrl-C here ends impc app and its fits)")
        if not no_open:
            _open(guard.address)
        settings = {"log_level": "warning", "access_log": False, "lifespan": "off", "ws": "none",
                    "server_header": False, "proxy_headers": False,
                    "timeout_graceful_shutdown": 2}  # fmt: skip
        try:
            uvicorn.Server(uvicorn.Config(guard, **settings)).run(sockets=[listening])
        finally:
            app.state.fits.stop()


def _open(address: str) -> None:
    """Open the browser by a file that only the user can read: others see programs' arguments."""
    handle, path = tempfile.mkstemp(prefix="impc-", suffix=".html")
    with open(handle, "w", encoding="utf-8") as page:
        page.write(f'<meta http-equiv="refresh" content="0;url={address}">')
    click.launch(Path(path).as_uri())
    timer = threading.Timer(_OPENED, Path(path).unlink, kwargs={"missing_ok": True})
    timer.daemon = True
    timer.start()
