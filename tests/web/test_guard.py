"""Who gets in, and what a foreign page can do: nothing."""

from __future__ import annotations

import re
from functools import partial
from typing import Any

import pytest
from argon2 import PasswordHasher
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.testclient import TestClient

from flasher.station.people import Person, Role, role_of
from flasher.web.guard import BODY_MAX, TOKEN_HEADER, Badges, Entry, application
from flasher.web.pages import Pages

_URL = "http://127.0.0.1:8740"
_KEY = "of the test"


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


async def _page(request: Request) -> Response:
    return PlainTextResponse(request.session["token"])


async def _write(request: Request) -> Response:
    return PlainTextResponse(str(len(await request.body())))


def _client(
    password: str = "", clock: Clock | None = None, entry: Entry | None = None
) -> TestClient:
    app = application(
        [Route("/", _page), Route("/do", _write, methods=["POST"]), Route("/x/events", _page)],
        pages=Pages(),
        hosts={"127.0.0.1"},
        secret=_KEY,
        now=clock or Clock(),
        password=password,
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
def test_nobody_else_may(client: TestClient, headers: dict[str, str], status: int) -> None:
    assert _post(client, **headers).status_code == status


def test_a_foreign_name_does_not_lead_here(client: TestClient) -> None:
    """DNS rebinding: a name of a foreign page that was made to mean this computer."""
    assert client.get("/", headers={"host": "evil.example:8740"}).status_code == 421


@pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
def test_other_methods_are_refused(client: TestClient, method: str) -> None:
    assert client.request(method, "/do").status_code == 405


def test_nothing_is_changed_by_get(client: TestClient) -> None:
    assert client.get("/do").status_code == 405


def test_a_body_is_limited_whatever_its_header_says(client: TestClient) -> None:
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


# -- the password ---------------------------------------------------------------------------------


def _log_in(client: TestClient, password: str) -> Any:
    found = re.search(r'name="token" value="([^"]+)"', client.get("/login").text)
    assert found
    fields = {"token": found[1], "password": password}
    return client.post("/login", data=fields, headers={"origin": _URL})


def test_without_the_password_nothing_but_its_page_is_shown() -> None:
    client = _client("long enough")
    assert client.get("/").headers["location"] == "/login"
    assert client.get("/x/events").status_code == 401
    assert client.get("/static/line.css").status_code == 200
    assert _log_in(client, "wrong").status_code == 403
    assert client.get("/").status_code == 303


def test_the_password_opens_the_pages() -> None:
    client = _client("long enough")
    assert _log_in(client, "long enough").headers["location"] == "/"
    assert client.get("/").status_code == 200


def test_guessing_is_limited() -> None:
    clock = Clock()
    client = _client("long enough", clock)
    assert [_log_in(client, "wrong").status_code for _ in range(6)] == [403] * 5 + [429]
    assert _log_in(client, "long enough").status_code == 429
    clock.now = 61.0
    assert _log_in(client, "long enough").status_code == 303


# -- the address that works once -------------------------------------------------------------------


def test_the_address_lets_one_browser_in_and_is_void_then() -> None:
    entry = Entry(Pages())
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
def test_a_guessed_key_lets_nobody_in_and_does_not_void_the_address(key: str) -> None:
    entry = Entry(Pages())
    client = _client(entry=entry)
    assert client.get(f"/enter{key}").headers["location"] == "/closed"
    assert client.get("/").headers["location"] == "/closed"
    assert client.get(entry.path).status_code == 200


def _post_status(client: TestClient) -> int:
    return client.post("/do", content=b"", headers={"origin": _URL, TOKEN_HEADER: ""}).status_code


# -- badges ----------------------------------------------------------------------------------------

ALL = "of all of us"
QUICK = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)
"""Who guesses in a test is not to be held up."""
PEOPLE = (
    Person(name="Jo", code="BADGE-1", role=Role.OPERATOR),
    Person(name="Sue", code="BADGE-2", role=Role.SUPERVISOR, pin=QUICK.hash("4711")),
    Person(name="Al", code="BADGE-3", role=Role.SUPERVISOR),
)


def _with_badges(
    clock: Clock, *, is_far: bool = False, password: str = "", signed: str = "these"
) -> TestClient:
    badges = Badges(
        partial(role_of, PEOPLE, needs_pin=is_far),
        is_supervised=lambda path: path == "/runs",
        are_for_all=is_far and not password,
    )
    app = application(
        [Route("/", _page), Route("/runs", _page)],
        pages=Pages(),
        hosts={"127.0.0.1"},
        secret=_KEY,
        now=clock,
        password=password,
        badges=badges,
        signed=signed,
    )
    return TestClient(app, base_url=_URL, follow_redirects=False)


def _sign_in(client: TestClient, **said: str) -> tuple[int, str]:
    found = re.search(r'name="token" value="(.*?)"', client.get("/login").text)
    assert found is not None
    fields = {"token": found[1], **said}
    answer = client.post("/login", data=fields, headers={"origin": _URL})
    return answer.status_code, answer.headers.get("location", "")


def test_the_pages_of_supervisors_are_for_their_badges() -> None:
    client = _with_badges(Clock())
    assert client.get("/").status_code == 200  # the line is for everybody
    refused = client.get("/runs")
    assert (refused.status_code, refused.headers["location"]) == (303, "/login")
    assert "for supervisors" in client.get("/login").text
    assert _sign_in(client, badge="BADGE-1")[0] == 403  # an operator's
    assert _sign_in(client, badge="BADGE-9")[0] == 403
    assert _sign_in(client, badge="BADGE-2", pin="1111")[0] == 403
    assert _sign_in(client, badge="BADGE-2")[0] == 403
    assert client.get("/runs").status_code == 303
    assert _sign_in(client, badge="BADGE-2", pin="4711") == (303, "/runs")
    assert client.get("/runs").status_code == 200


def test_a_scanner_that_ends_by_enter_leaves_the_pin_to_be_typed() -> None:
    client = _with_badges(Clock())
    client.get("/runs")
    token = re.search(r'name="token" value="(.*?)"', client.get("/login").text)
    assert token is not None
    scanned = {"token": token[1], "badge": "BADGE-2", "pin": ""}
    page = client.post("/login", data=scanned, headers={"origin": _URL}).text
    assert "Type the PIN of the badge." in page
    assert '<input type="hidden" name="badge" value="BADGE-2">' in page
    assert _sign_in(client, badge="BADGE-2", pin="4711") == (303, "/runs")


@pytest.mark.parametrize(
    ("asked", "led_to"),
    [
        ("/runs?search=W26&state=fail", "/runs?search=W26&state=fail"),
        ("//evil.example", "/evil.example"),
        ("/\\evil.example", "/evil.example"),
        ("/%5Cevil.example", "/evil.example"),
    ],
)
def test_who_signed_in_is_led_to_the_page_that_was_asked_for_and_nowhere_else(
    asked: str, led_to: str
) -> None:
    client = _with_badges(Clock(), is_far=True)
    client.get(f"{_URL}{asked}")
    assert _sign_in(client, badge="BADGE-2", pin="4711") == (303, led_to)


@pytest.mark.parametrize("is_far", [False, True])
def test_who_signed_in_goes_on_after_a_restart_unless_the_badges_are_others(
    *, is_far: bool
) -> None:
    client = _with_badges(Clock(), is_far=is_far)
    client.get("/runs")
    assert _sign_in(client, badge="BADGE-2", pin="4711") == (303, "/runs")
    for signed, status in (("these", 200), ("others", 303)):
        again = _with_badges(Clock(), is_far=is_far, signed=signed)
        again.cookies = client.cookies
        assert again.get("/runs").status_code == status
    assert _sign_in(again, badge="BADGE-2", pin="4711")[0] == 303


def test_who_was_a_supervisor_is_none_by_another_badge() -> None:
    client = _with_badges(Clock(), is_far=True)
    client.get("/runs")
    _sign_in(client, badge="BADGE-2", pin="4711")
    again = _with_badges(Clock(), is_far=True, signed="others", password=ALL)
    again.cookies = client.cookies
    again.get("/")
    assert _sign_in(again, password=ALL) == (303, "/")
    assert again.get("/runs").headers["location"] == "/login"


def test_a_supervisor_who_left_is_asked_again() -> None:
    clock = Clock()
    client = _with_badges(clock)
    clock.now = 5000.0
    client.get("/runs")
    assert _sign_in(client, badge="BADGE-3") == (303, "/runs")
    for clock.now in (5800.0, 6600.0):  # whoever reads is not
        assert client.get("/runs").status_code == 200
    clock.now = 7600.0
    assert client.get("/runs").status_code == 303
    _sign_in(client, badge="BADGE-3")
    clock.now = 10.0  # the computer was restarted
    assert client.get("/runs").status_code == 303


def test_from_other_computers_a_badge_with_a_pin_lets_in() -> None:
    client = _with_badges(Clock(), is_far=True)
    assert client.get("/").headers["location"] == "/login"
    assert _sign_in(client, badge="BADGE-1")[0] == 403
    assert _sign_in(client, badge="BADGE-3")[0] == 403
    assert _sign_in(client, badge="BADGE-2", pin="4711") == (303, "/")
    assert client.get("/").status_code == 200


def test_the_password_of_all_is_not_the_badge_of_a_supervisor() -> None:
    client = _with_badges(Clock(), is_far=True, password=ALL)
    client.get("/runs")
    assert _sign_in(client, password=ALL) == (303, "/runs")
    assert client.get("/").status_code == 200
    assert client.get("/runs").headers["location"] == "/login"
    assert 'name="password"' not in client.get("/login").text  # it was said
    assert _sign_in(client, badge="BADGE-2", pin="4711") == (303, "/runs")


def test_pins_are_not_guessed() -> None:
    clock = Clock()
    client = _with_badges(clock)
    client.get("/runs")
    for pin in range(5):
        assert _sign_in(client, badge="BADGE-2", pin=f"000{pin}")[0] == 403
    assert _sign_in(client, badge="BADGE-2", pin="4711")[0] == 429
    clock.now += 61.0
    assert _sign_in(client, badge="BADGE-2", pin="4711")[0] == 303


def test_who_knows_the_password_does_not_guess_pins_either() -> None:
    client = _with_badges(Clock(), is_far=True, password=ALL)
    client.get("/runs")
    for pin in range(5):
        assert _sign_in(client, password=ALL, badge="BADGE-2", pin=f"000{pin}")[0] == 403
    assert _sign_in(client, password=ALL, badge="BADGE-2", pin="4711")[0] == 429
