"""A server of `impc app` in a process of its own, and a client that knows its address."""

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

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Answer:
    """Answer of the server."""

    status: int
    headers: dict[str, str]
    text: str


@dataclass(frozen=True)
class Client:
    """A browser without scripts."""

    process: subprocess.Popen[str]
    host: str
    base: str
    cookie: str

    def get(self, path: str, **asked: str) -> Answer:
        """Page below the base."""
        query = f"?{urlencode(asked)}" if asked else ""
        return ask(self.host, "GET", f"{self.base}/{path}{query}", cookie=self.cookie)

    def post(self, path: str, body: bytes | dict[str, str], **asked: str) -> Answer:
        """Send a form, or a file."""
        given = body if isinstance(body, bytes) else urlencode(body).encode()
        query = f"?{urlencode(asked)}" if asked else ""
        origin = {"cookie": self.cookie, "origin": f"http://{self.host}"}
        return ask(self.host, "POST", f"{self.base}/{path}{query}", given, **origin)


def ask(host: str, method: str, path: str, body: bytes = b"", **headers: str) -> Answer:
    """One request."""
    connection = http.client.HTTPConnection(host, timeout=120)
    with contextlib.closing(connection):
        connection.request(method, path, body, headers)
        found = connection.getresponse()
        text = found.read().decode("utf-8", "replace")
        return Answer(found.status, {k.lower(): v for k, v in found.getheaders()}, text)


@contextlib.contextmanager
def serving(folder: Path, *more: str, home: Path | None = None) -> Iterator[Client]:
    """Start `impc app FOLDER`, open its address, and end it."""
    cache = {} if home is None else {"XDG_CACHE_HOME": str(home)}
    given = {"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "impc", "app", "--no-open", *more, str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=folder,
        env=os.environ | given | cache,
    )
    try:
        assert process.stdout is not None
        address = process.stdout.readline().split()[1]
        host, path = address.removeprefix("http://").split("/", 1)
        opened = ask(host, "GET", f"/{path}")
        cookie = opened.headers["set-cookie"].partition(";")[0]
        yield Client(process, host, opened.headers["location"].rstrip("/"), cookie)
    finally:
        process.terminate()
        process.wait(30)
        if process.stdout is not None:
            process.stdout.close()
