"""Admit only the browser that was given the address: token, cookie, Host and Origin.

The address that `impc app` prints contains a token that works once. It is exchanged for a cookie
that is sent only below a secret path: cookies know no ports, so another server on 127.0.0.1 would
receive one of the path /, and the path alone is not enough.
"""

from __future__ import annotations

import hmac
import secrets
from http.cookies import SimpleCookie

from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; frame-src 'self'; form-action 'self'; "
    "base-uri 'none'; frame-ancestors 'self'",
    "x-content-type-options": "nosniff",
    # With no-referrer, Chromium sends "Origin: null" for the forms of this server.
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
_USED = "This address was already used, or is incomplete: end impc app and start it again.\n"
_FOREIGN = "Another page asked for this.\n"


class Guard:
    """ASGI application that passes admitted requests to another one, below the path `base`."""

    def __init__(self, app: ASGIApp, port: int) -> None:
        self._app, self._host = app, f"127.0.0.1:{port}"
        self.base = f"/{secrets.token_urlsafe(12)}"
        self._token, self._cookie = secrets.token_urlsafe(24), secrets.token_urlsafe(32)

    @property
    def address(self) -> str:
        """Address that opens the application, once."""
        return f"http://{self._host}/open/{self._token}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":  # no websockets
            return
        headers = {key.decode("latin1"): value.decode("latin1") for key, value in scope["headers"]}

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {key for key, _ in message["headers"]}
                ours = ((key.encode(), value.encode()) for key, value in _HEADERS.items())
                more = [pair for pair in ours if pair[0] not in given]
                message = {**message, "headers": [*message["headers"], *more]}
            await send(message)

        answer: ASGIApp = PlainTextResponse(_USED, 403)
        if refused := self._foreign(scope["method"], headers):
            answer = PlainTextResponse(refused, 403)
        elif self._opens(scope):
            self._token = ""
            cookie = f"impc={self._cookie}; Path={self.base}/; HttpOnly; SameSite=Strict"
            answer = RedirectResponse(f"{self.base}/", 303, {"set-cookie": cookie})
        elif self._admits(scope["path"], headers):
            answer, scope = self._app, {**scope, "root_path": self.base}
        await answer(scope, receive, guarded)

    def _foreign(self, method: str, headers: dict[str, str]) -> str:
        """Reason to refuse a request that no page of this server made."""
        if headers.get("host") != self._host:  # also a name that was rebound to 127.0.0.1
            return "This is not the address that impc printed.\n"
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return _FOREIGN
        reads = method in ("GET", "HEAD")
        return "" if reads or headers.get("origin") == f"http://{self._host}" else _FOREIGN

    def _opens(self, scope: Scope) -> bool:
        given = scope["path"].removeprefix("/open/").encode()
        whole = bool(self._token) and hmac.compare_digest(given, self._token.encode())
        return whole and scope["method"] == "GET"

    def _admits(self, path: str, headers: dict[str, str]) -> bool:
        given = SimpleCookie(headers.get("cookie", "")).get("impc")
        known = given is not None and hmac.compare_digest(
            given.value.encode(), self._cookie.encode()
        )
        return known and path.startswith(f"{self.base}/")
