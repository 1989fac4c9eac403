"""Only the browser that was given the address is let in; each row is a request that is not."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from impc.app.guard import Guard

HOST = "127.0.0.1:4321"


async def inside(scope: Any, _receive: Any, send: Any) -> None:
    """The application behind the guard."""
    await send(
        {
            "type": "http.response.start",
            "status": 200,
            "headers": [(b"x-base", scope["root_path"].encode())],
        }
    )
    await send({"type": "http.response.body", "body": b"inside"})


def ask(
    guard: Guard, path: str, method: str = "GET", kind: str = "http", **headers: str
) -> tuple[int, dict[str, str], str]:
    """Status, headers and body of an answer; 0 if there is none."""
    sent: list[dict[str, Any]] = []

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    given = {"host": HOST} | {name.replace("_", "-"): value for name, value in headers.items()}
    pairs = [(name.encode("latin1"), value.encode("latin1")) for name, value in given.items()]
    scope = {"type": kind, "method": method, "path": path, "headers": pairs, "root_path": ""}
    asyncio.run(guard(scope, None, send))  # type: ignore[arg-type]
    if not sent:
        return 0, {}, ""
    found = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], found, sent[1]["body"].decode()


@pytest.fixture
def opened() -> tuple[Guard, str]:
    """A guard whose address was opened, and the browser's cookie."""
    guard = Guard(inside, 4321)
    status, headers, _ = ask(guard, guard.address.removeprefix(f"http://{HOST}"))
    assert status == 303
    assert headers["location"] == f"{guard.base}/"
    cookie = headers["set-cookie"]
    for part in ("HttpOnly", "SameSite=Strict", f"Path={guard.base}/"):
        assert part in cookie
    return guard, cookie.partition(";")[0]


def test_the_browser_is_let_in_with_headers_that_forbid_the_rest(opened: tuple[Guard, str]) -> None:
    guard, cookie = opened
    status, headers, text = ask(guard, f"{guard.base}/fit", cookie=cookie)
    assert (status, text, headers["x-base"]) == (200, "inside", guard.base)
    policy = headers["content-security-policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    assert "frame-ancestors 'self'" in policy
    assert headers["referrer-policy"] == "same-origin"
    for name in ("x-content-type-options", "cross-origin-opener-policy", "cache-control"):
        assert name in headers
    origin = f"http://{HOST}"
    assert ask(guard, f"{guard.base}/fit", "POST", cookie=cookie, origin=origin)[0] == 200


def test_an_address_works_once() -> None:
    guard = Guard(inside, 4321)
    path = guard.address.removeprefix(f"http://{HOST}")
    assert ask(guard, path, "HEAD")[0] == 403
    assert ask(guard, f"{path}x")[0] == 403
    assert ask(guard, path)[0] == 303
    assert ask(guard, path)[0] == 403
    assert ask(guard, "/open/")[0] == 403  # the token is empty now


@pytest.mark.parametrize(
    ("method", "changed"),
    [
        ("GET", {"cookie": ""}),
        ("GET", {"cookie": "impc="}),
        ("GET", {"cookie": "impc=x"}),
        ("GET", {"cookie": "impc=\xe9"}),
        ("GET", {"cookie": "other=1"}),
        ("GET", {"host": "localhost:4321"}),  # only the address that was printed
        ("GET", {"host": "evil.example:4321"}),  # a name that was rebound to 127.0.0.1
        ("GET", {"host": "127.0.0.1"}),
        ("GET", {"host": "127.0.0.1:80"}),
        ("GET", {"host": ""}),
        ("GET", {"sec_fetch_site": "cross-site"}),
        ("GET", {"sec_fetch_site": "same-site"}),
        ("POST", {"origin": ""}),
        ("POST", {"origin": "null"}),
        ("POST", {"origin": "http://evil.example"}),
        ("POST", {"origin": "http://127.0.0.1:9999"}),
        ("POST", {"origin": "https://127.0.0.1:4321"}),
        ("PUT", {"origin": "null"}),
        ("DELETE", {"origin": ""}),
        ("OPTIONS", {"origin": "http://evil.example"}),
    ],
)
def test_others_are_refused(
    method: str, changed: dict[str, str], opened: tuple[Guard, str]
) -> None:
    guard, cookie = opened
    given = {"cookie": cookie, "origin": f"http://{HOST}"} | changed
    status, headers, text = ask(guard, f"{guard.base}/fit", method, **given)
    assert status == 403
    assert text != "inside"
    assert guard.base not in text + str(headers)


@pytest.mark.parametrize("path", ["/", "/fit", "/x/fit", "", "//fit", "/../fit"])
def test_the_cookie_alone_is_not_enough(path: str, opened: tuple[Guard, str]) -> None:
    guard, cookie = opened
    assert ask(guard, path, cookie=cookie)[0] == 403
    assert ask(guard, guard.base, cookie=cookie)[0] == 403


def test_websockets_are_not_answered(opened: tuple[Guard, str]) -> None:
    guard, cookie = opened
    assert ask(guard, f"{guard.base}/fit", kind="websocket", cookie=cookie) == (0, {}, "")
