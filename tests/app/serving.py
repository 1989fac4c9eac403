"""A server of `impc app` in a process of its own, a client that knows its address, and files."""

from __future__ import annotations

import contextlib
import http.client
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

import numpy as np

from impc.files.table import Table

ROOT = Path(__file__).parents[2]
# Seconds after which an answer counts as none; a first one on a busy machine compiles for minutes.
PATIENCE = 600


@dataclass(frozen=True)
class Answer:
    """Answer of the server."""

    status: int
    headers: dict[str, str]
    text: str


@dataclass(frozen=True)
class Client:
    """A browser without scripts; `opened` is what the address answered."""

    process: subprocess.Popen[str]
    host: str
    token: str  # Path that the address has
    opened: Answer

    @property
    def base(self) -> str:
        """Path of the pages."""
        return self.opened.headers["location"].rstrip("/")

    @property
    def cookie(self) -> str:
        """Cookie of the browser."""
        return self.opened.headers["set-cookie"].partition(";")[0]

    def get(self, path: str, **asked: str) -> Answer:
        """Page below the base."""
        query = f"?{urlencode(asked)}" if asked else ""
        return ask(self.host, "GET", f"{self.base}/{path}{query}", cookie=self.cookie)

    def part(self, path: str, target: str, **asked: str) -> str:
        """What a script fetches for the element `target`."""
        query = f"?{urlencode(asked)}" if asked else ""
        given = {"cookie": self.cookie, "hx_request": "true", "hx_target": target}
        return ask(self.host, "GET", f"{self.base}/{path}{query}", **given).text

    def post(self, path: str, body: bytes | dict[str, str], **asked: str) -> Answer:
        """Send a form, or a file."""
        given = body if isinstance(body, bytes) else urlencode(body).encode()
        query = f"?{urlencode(asked)}" if asked else ""
        origin = {"cookie": self.cookie, "origin": f"http://{self.host}"}
        return ask(self.host, "POST", f"{self.base}/{path}{query}", given, **origin)


def ask(host: str, method: str, path: str, body: bytes = b"", /, **headers: str) -> Answer:
    """One request; _ is - in names of headers."""
    connection = http.client.HTTPConnection(host, timeout=PATIENCE)
    with contextlib.closing(connection):
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, body, given)
        found = connection.getresponse()
        text = found.read().decode("utf-8", "replace")
        return Answer(found.status, {k.lower(): v for k, v in found.getheaders()}, text)


@contextlib.contextmanager
def serving(folder: Path, *before: str) -> Iterator[Client]:
    """Start `impc app FOLDER` by the words `before`, open its address, and end it."""
    given = {"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1",
             "XDG_CACHE_HOME": str(folder.parent / "home")}  # fmt: skip
    process = subprocess.Popen(
        [*before, sys.executable, "-m", "impc", "app", "--no-open", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=folder,
        env=os.environ | given,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        address = process.stdout.readline().split()[1]
        host, token = address.removeprefix("http://").split("/", 1)
        yield Client(process, host, f"/{token}", ask(host, "GET", f"/{token}"))
    finally:
        process.terminate()
        process.wait(30)
        if process.stdout is not None:
            process.stdout.close()


def german(path: Path, seed: int = 1) -> None:
    """A recording as a German export: semicolons, decimal commas, umlauts, cp1252."""
    rng = np.random.default_rng(seed)
    push = np.repeat(rng.choice([-5.0, 0.0, 5.0], 60), 10)
    angle = np.cumsum(push) / 300
    lines = ["Zeit [s];Sitzwinkel [Grad];Rumpfwinkel;Störmoment [Nm]"]
    rows = zip(np.arange(600) / 100, angle, 0.5 * np.roll(angle, 7), push, strict=True)
    lines += [";".join(f"{value:.5f}".replace(".", ",") for value in row) for row in rows]
    path.write_bytes("\r\n".join(lines).encode("cp1252"))


def sheet(table: Table) -> list[tuple[object, ...]]:
    """Headings with their units and rows of a table, as in a sheet."""
    heads = (f"{name} [{table.units[name]}]" if name in table.units else name
             for name in table.columns)  # fmt: skip
    values = (column.tolist() for column in table.columns.values())
    return [tuple(heads), *zip(*values, strict=True)]
