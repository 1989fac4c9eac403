"""Only the browser that was given the address is let in; each row is a request that is not."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.app.serving import Client, ask, serving


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with serving(tmp_path_factory.mktemp("study")) as found:
        yield found


def test_an_address_works_once_and_pages_forbid_the_rest(client: Client) -> None:
    assert client.opened.status == 303
    for part in ("HttpOnly", "SameSite=Strict", f"Path={client.base}/"):
        assert part in client.opened.headers["set-cookie"]
    for path in (client.token, f"{client.token}x", "/open/"):
        assert ask(client.host, "GET", path).status == 403
    page = client.get("fit")
    assert page.status == 200
    policy = page.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    assert "frame-ancestors 'self'" in policy
    assert page.headers["referrer-policy"] == "same-origin"
    for name in ("x-content-type-options", "cross-origin-opener-policy", "cache-control"):
        assert name in page.headers


@pytest.mark.parametrize(
    ("method", "changed"),
    [
        *(("GET", {"cookie": one}) for one in ("", "impc=", "impc=x", "impc=\xe9", "other=1")),
        # localhost is not the printed address; a foreign name was rebound to 127.0.0.1
        *(("GET", {"host": f"{one}:{{port}}"}) for one in ("localhost", "evil.example")),
        *(("GET", {"host": one}) for one in ("127.0.0.1", "127.0.0.1:80", "x")),
        *(("GET", {"sec_fetch_site": one}) for one in ("cross-site", "same-site")),
        *(("POST", {"origin": one}) for one in ("", "null", "http://evil.example")),
        *(("POST", {"origin": one}) for one in ("http://127.0.0.1:9", "https://127.0.0.1:{port}")),
        *((one, {"origin": "http://evil.example"}) for one in ("PUT", "DELETE", "OPTIONS")),
    ],
)
def test_others_are_refused(method: str, changed: dict[str, str], client: Client) -> None:
    port = client.host.partition(":")[2]
    own = {"cookie": client.cookie, "origin": f"http://{client.host}"}
    given = own | {name: value.format(port=port) for name, value in changed.items()}
    page = ask(client.host, method, f"{client.base}/fit", **given)
    assert page.status == 403
    assert client.base not in page.text + str(page.headers)


@pytest.mark.parametrize("path", ["/", "/fit", "/x/fit", "//fit", "/../fit", "{base}"])
def test_the_cookie_alone_is_not_enough(path: str, client: Client) -> None:
    asked = path.format(base=client.base)
    assert ask(client.host, "GET", asked, cookie=client.cookie).status == 403


def test_websockets_are_not_answered(client: Client) -> None:
    upgrade = {"connection": "Upgrade", "upgrade": "websocket", "sec_websocket_version": "13",
               "sec_websocket_key": "AAAAAAAAAAAAAAAAAAAAAA=="}  # fmt: skip
    page = ask(client.host, "GET", f"{client.base}/fit", cookie=client.cookie, **upgrade)
    assert page.status != 101
