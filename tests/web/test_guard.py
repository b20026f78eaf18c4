"""Who gets in, and what a foreign page can do: nothing."""

from __future__ import annotations

from typing import Any

import pytest
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.testclient import TestClient

from flasher.web.guard import BODY_MAX, TOKEN_HEADER, BrowserEntry, application
from flasher.web.pages import Pages

_URL = "http://127.0.0.1:8740"
_KEY = "of the test"


async def _page(request: Request) -> Response:
    return PlainTextResponse(request.session["token"])


async def _write(request: Request) -> Response:
    return PlainTextResponse(str(len(await request.body())))


def _client(entry: BrowserEntry | None = None) -> TestClient:
    app = application(
        [Route("/", _page), Route("/do", _write, methods=["POST"]), Route("/x/events", _page)],
        hosts={"127.0.0.1"},
        secret=_KEY,
        entry=entry,
    )
    return TestClient(app, base_url=_URL, follow_redirects=False)


@pytest.fixture
def client() -> TestClient:
    return _client()


def _post(client: TestClient, **headers: str) -> Any:
    token = client.get("/").text
    sent = {"origin": _URL, TOKEN_HEADER: token} | headers
    return client.post("/do", content=b"abc", headers=sent)


def test_a_page_of_this_server_may_post(client: TestClient) -> None:
    assert _post(client).text == "3"


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"origin": "https://127.0.0.1:8740"}, 403),
        ({"origin": "http://127.0.0.1:9999"}, 403),
        ({"origin": ""}, 403),
        ({TOKEN_HEADER: ""}, 403),
        ({TOKEN_HEADER: "guessed"}, 403),
        ({"host": "evil.example"}, 421),
        ({"host": "127.0.0.1.evil.example:8740"}, 421),
    ],
)
def test_no_one_else_may(client: TestClient, headers: dict[str, str], status: int) -> None:
    assert _post(client, **headers).status_code == status


def test_a_foreign_name_does_not_lead_here(client: TestClient) -> None:
    """DNS rebinding: a name of a foreign page that was made to mean this computer."""
    assert client.get("/", headers={"host": "evil.example:8740"}).status_code == 421


@pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
def test_other_methods_are_refused(client: TestClient, method: str) -> None:
    assert client.request(method, "/do").status_code == 405


def test_nothing_is_changed_by_get(client: TestClient) -> None:
    assert client.get("/do").status_code == 405


def test_a_body_is_limited_whatever_its_header_states(client: TestClient) -> None:
    token = client.get("/").text
    headers = {"origin": _URL, TOKEN_HEADER: token}
    large = b"x" * (BODY_MAX + 1)
    assert client.post("/do", content=large, headers=headers).status_code == 413
    with pytest.raises(Exception, match=r".*"):  # a body in chunks has no length beforehand
        client.post("/do", content=iter([large]), headers=headers).raise_for_status()


def test_every_answer_forbids_foreign_content(client: TestClient) -> None:
    for path in ("/", "/nowhere", "/static/line.js", "/static/page.css"):
        headers = client.get(path).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"


def test_the_cookie_is_out_of_reach_of_scripts_and_other_sites(client: TestClient) -> None:
    cookie = client.get("/").headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie


def test_a_cookie_that_was_forged_is_worth_nothing(client: TestClient) -> None:
    token = client.get("/").text
    client.cookies.clear()
    client.cookies.set("flasher", "eyJ0b2tlbiI6ICJ4In0=.aaaa.bbbb")
    headers = {"origin": _URL, TOKEN_HEADER: "x"}
    assert client.post("/do", content=b"", headers=headers).status_code == 403
    assert client.get("/").text != token


@pytest.mark.parametrize(
    "path", ["/static/../guard.py", "/static/%2e%2e/guard.py", "/static//etc/passwd"]
)
def test_only_the_files_of_the_pages_are_served(client: TestClient, path: str) -> None:
    assert client.get(f"/static/{path}").status_code == 404


# -- the address that works once -------------------------------------------------------------------


def test_the_address_lets_one_browser_in_and_is_void_then() -> None:
    entry = BrowserEntry(Pages())
    first = _client(entry=entry)
    assert first.get("/").headers["location"] == "/closed"
    assert first.get("/x/events").status_code == 401
    assert _post_status(first) == 303
    assert first.get(entry.path).status_code == 200
    assert first.get("/").status_code == 200
    assert first.get(entry.path).headers["location"] == "/"  # the same browser again
    second = TestClient(first.app, base_url=_URL, follow_redirects=False)
    assert second.get(entry.path).headers["location"] == "/closed"
    assert second.get("/").headers["location"] == "/closed"
    assert second.get("/closed").status_code == 403


@pytest.mark.parametrize("key", ["", "?key=", "?key=guessed", "?key=%00"])
def test_a_guessed_key_lets_no_one_in_and_does_not_void_the_address(key: str) -> None:
    entry = BrowserEntry(Pages())
    client = _client(entry=entry)
    assert client.get(f"/enter{key}").headers["location"] == "/closed"
    assert client.get("/").headers["location"] == "/closed"
    assert client.get(entry.path).status_code == 200


def _post_status(client: TestClient) -> int:
    return client.post("/do", content=b"", headers={"origin": _URL, TOKEN_HEADER: ""}).status_code
