"""Who signs in, how long that holds, and what guesses cost."""

from __future__ import annotations

import asyncio
import re
from collections import Counter
from typing import Any

import httpx2
import pytest
from argon2 import PasswordHasher
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.testclient import TestClient

from flasher.station.attempts import ALL_MAX, PAUSE_S, PER_ADDRESS_MAX, TRIES_MAX
from flasher.station.operators import Person, Role
from flasher.station.records.model import AuditEvent
from flasher.web.guard import TOKEN_HEADER, application
from flasher.web.login import Badges, Login
from flasher.web.pages import Pages, streamed
from flasher.web.sign_ins import IDLE_S, SHIFT_S, SignIns
from tests.loops import each
from tests.station.factory import FakeClock
from tests.station.line_bench import AtOnce
from tests.web.own_loop import in_own_loop

URL = "http://127.0.0.1:8740"
ALL = "of all of us"
WRONG = "a guess"
PIN = "4711"
SECRET = "of the test"  # noqa: S105
ANOTHER = "another one"
QUICK = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)
"""Who guesses in a test is not to be held up."""
PEOPLE = (
    Person(name="Jo", code="BADGE-1", role=Role.OPERATOR),
    Person(name="Sue", code="BADGE-2", role=Role.SUPERVISOR, pin=QUICK.hash(PIN)),
    Person(name="Al", code="BADGE-3", role=Role.SUPERVISOR),
    Person(name="Rea", code="BADGE-4", role=Role.REWORK, pin=QUICK.hash(PIN)),
)


class Place:
    """Pages where people sign in. `secret` signs its cookies."""

    def __init__(
        self,
        *,
        is_far: bool = False,
        password: str = "",
        has_badges: bool = True,
        secret: str = SECRET,
    ) -> None:
        self.clock = FakeClock()
        self.notes: list[tuple[AuditEvent, dict[str, str]]] = []
        self.checker = AtOnce()
        badges = Badges(
            PEOPLE,
            needs_pin=is_far or bool(password),
            is_supervised=lambda path: path == "/runs",
            are_for_all=is_far and not password,
        )
        self.login = Login(
            Pages(),
            self.clock,
            lambda event, data: self.notes.append((event, dict(data))),
            checker=self.checker,
            password=password,
            badges=badges if has_badges else None,
        )
        self.app = application(
            [
                Route("/", self._page),
                Route("/runs", self._page),
                Route("/line/scan", self._page, methods=["POST"]),
                Route("/line/events", self._events),
            ],
            hosts={"127.0.0.1"},
            secret=secret,
            login=self.login,
        )
        self.reported: asyncio.Queue[str] = asyncio.Queue()
        self.most_waiting = 0

    async def _page(self, request: Request) -> Response:
        return PlainTextResponse(request.session["token"])

    async def _events(self, request: Request) -> Response:
        async def messages() -> Any:
            while True:
                yield {"said": await self.reported.get()}

        return streamed(messages())

    def browser(self, address: str = "192.0.2.1") -> TestClient:
        return TestClient(self.app, base_url=URL, follow_redirects=False, client=(address, 50000))

    def noted(self, event: AuditEvent) -> list[dict[str, str]]:
        """What the audit trail got of a kind."""
        return [data for kind, data in self.notes if kind is event]


def token_of(browser: TestClient) -> str:
    found = re.search(r'name="token" value="(.*?)"', browser.get("/login").text)
    assert found is not None
    return found[1]


def posted(browser: TestClient, path: str, **fields: str) -> tuple[int, str]:
    fields = {"token": token_of(browser), **fields}
    answer = browser.post(path, data=fields, headers={"origin": URL})
    return answer.status_code, answer.headers.get("location", "")


def sign_in(browser: TestClient, **fields: str) -> tuple[int, str]:
    return posted(browser, "/login", **fields)


def as_sue(browser: TestClient) -> TestClient:
    browser.get("/runs")
    assert sign_in(browser, badge="BADGE-2", pin=PIN) == (303, "/runs")
    return browser


def status(browser: TestClient, path: str = "/runs") -> int:
    return browser.get(path).status_code


# -- the password ----------------------------------------------------------------------------------


def by_password() -> Place:
    return Place(password=ALL, has_badges=False)


def test_without_the_password_nothing_but_its_page_is_shown() -> None:
    browser = by_password().browser()
    assert browser.get("/").headers["location"] == "/login"
    assert browser.get("/line/events").status_code == 401
    assert browser.get("/static/line.css").status_code == 200
    assert sign_in(browser, password=WRONG)[0] == 403
    assert browser.get("/").status_code == 303
    assert browser.get("/sign-ins").headers["location"] == "/login"


def test_the_password_opens_the_pages() -> None:
    browser = by_password().browser()
    assert sign_in(browser, password=ALL) == (303, "/")
    assert browser.get("/").status_code == 200
    assert "by the password" in browser.get("/sign-ins").text


def test_guessing_the_password_is_limited_for_who_guesses_alone() -> None:
    place = by_password()
    browser = place.browser()
    assert [sign_in(browser, password=WRONG)[0] for _ in range(6)] == [403] * 5 + [429]
    assert sign_in(browser, password=ALL)[0] == 429
    assert sign_in(place.browser("192.0.2.2"), password=ALL)[0] == 303
    place.clock.go_on(PAUSE_S)
    assert sign_in(browser, password=ALL)[0] == 303
    why = {"name": "", "address": "192.0.2.1", "why": "wrong password"}
    refused = place.noted(AuditEvent.SIGN_IN_REFUSED)
    assert refused == [why] * 4 + [{**why, "pause": "60 s"}]


# -- badges ----------------------------------------------------------------------------------------


def test_the_pages_of_supervisors_are_for_their_badges() -> None:
    browser = Place().browser()
    assert status(browser, "/") == 200  # the line is for everybody
    refused = browser.get("/runs")
    assert (refused.status_code, refused.headers["location"]) == (303, "/login")
    assert "for supervisors" in browser.get("/login").text
    assert sign_in(browser, badge="BADGE-1")[0] == 403  # an operator's
    assert sign_in(browser, badge="BADGE-9")[0] == 403
    assert sign_in(browser, badge="BADGE-2", pin="1111")[0] == 403
    assert sign_in(browser, badge="BADGE-2")[0] == 403
    assert status(browser) == 303
    assert sign_in(browser, badge="BADGE-2", pin=PIN) == (303, "/runs")
    assert status(browser) == 200


def test_a_scanner_that_ends_by_enter_leaves_the_pin_to_be_typed() -> None:
    browser = Place().browser()
    browser.get("/runs")
    scanned = {"token": token_of(browser), "badge": "BADGE-2", "pin": ""}
    page = browser.post("/login", data=scanned, headers={"origin": URL}).text
    assert "Type the PIN of the badge." in page
    assert '<input type="hidden" name="badge" value="BADGE-2">' in page
    assert sign_in(browser, badge="BADGE-2", pin=PIN) == (303, "/runs")


@each(
    "asked, led_to",
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
    browser = Place(is_far=True).browser()
    browser.get(f"{URL}{asked}")
    assert sign_in(browser, badge="BADGE-2", pin=PIN) == (303, led_to)


def test_from_other_computers_a_badge_with_a_pin_lets_in() -> None:
    browser = Place(is_far=True).browser()
    assert browser.get("/").headers["location"] == "/login"
    assert sign_in(browser, badge="BADGE-1")[0] == 403
    assert sign_in(browser, badge="BADGE-3")[0] == 403
    assert sign_in(browser, badge="BADGE-3", pin=PIN)[0] == 403
    assert sign_in(browser, badge="BADGE-4", pin=PIN) == (303, "/")
    assert status(browser, "/") == 200
    assert status(browser) == 303


def test_the_password_of_all_is_not_the_badge_of_a_supervisor() -> None:
    browser = Place(is_far=True, password=ALL).browser()
    browser.get("/runs")
    assert sign_in(browser, password=ALL) == (303, "/runs")
    assert status(browser, "/") == 200
    assert browser.get("/runs").headers["location"] == "/login"
    assert 'name="password"' not in browser.get("/login").text  # it was given
    assert browser.get("/sign-ins").headers["location"] == "/login"
    assert posted(browser, "/sign-ins/end", all="1") == (303, "/login")
    assert sign_in(browser, badge="BADGE-2", pin=PIN)[0] == 303
    assert status(browser) == 200


# -- guesses ---------------------------------------------------------------------------------------


def at_once(place: Place, *tries: tuple[str, str, str]) -> list[int]:
    """Statuses of sign-ins at the same time: address, badge and PIN of each."""
    return [answer.status_code for answer in in_own_loop(_at_once(place, tries))]


async def _at_once(place: Place, tries: tuple[tuple[str, str, str], ...]) -> list[httpx2.Response]:
    browsers = [
        httpx2.AsyncClient(
            transport=httpx2.ASGITransport(place.app, client=(address, 50000)), base_url=URL
        )
        for address, _, _ in tries
    ]
    tokens = []
    for browser in browsers:
        found = re.search(r'name="token" value="(.*?)"', (await browser.get("/login")).text)
        assert found is not None
        tokens.append(found[1])
    sent = [
        asyncio.create_task(
            browser.post(
                "/login",
                data={"token": token, "badge": badge, "pin": pin},
                headers={"origin": URL},
            )
        )
        for browser, token, (_, badge, pin) in zip(browsers, tokens, tries, strict=True)
    ]
    while place.checker.holds and not all(task.done() for task in sent):
        await asyncio.sleep(0)
        waiting = len(place.checker.waiting)
        if waiting and sum(task.done() for task in sent) + waiting == len(sent):
            place.most_waiting = max(place.most_waiting, waiting)
            place.checker.go_on()
    return await asyncio.gather(*sent)


def guesses(count: int, *, address: str = "192.0.2.1") -> list[tuple[str, str, str]]:
    return [(address, "BADGE-2", f"{number:04}") for number in range(count)]


@pytest.mark.slow
def test_of_guesses_at_the_same_time_no_more_than_five_are_checked() -> None:
    place = Place()
    found: Counter[int] = Counter()
    for _ in range(4):
        found.update(at_once(place, *guesses(39), ("192.0.2.1", "BADGE-2", PIN)))
    assert place.checker.done == TRIES_MAX
    assert (found[403], found[303]) == (TRIES_MAX, 0)
    assert found.keys() == {403, 429, 503}


def test_few_requests_wait_and_the_others_are_refused_at_once() -> None:
    place = Place()
    place.checker.holds = True
    clients = [f"192.0.2.{number}" for number in range(1, 11)]
    found = at_once(place, *(each for client in clients for each in guesses(3, address=client)))
    assert place.most_waiting == 4
    assert Counter(found) == {403: 4, 503: 26}


def test_one_client_does_not_take_all_places() -> None:
    place = Place()
    place.checker.holds = True
    found = at_once(place, *guesses(30), ("192.0.2.2", "BADGE-2", PIN))
    assert Counter(found[:-1]) == {403: 2, 503: 28}
    assert found[-1] == 303


def test_a_client_that_is_refused_learns_how_long() -> None:
    place = Place()
    browser = place.browser()
    for _ in range(TRIES_MAX):
        assert sign_in(browser, badge="BADGE-2", pin="0000")[0] == 403
    fields = {"token": token_of(browser), "badge": "BADGE-2", "pin": PIN}
    place.clock.go_on(0.5)
    answer = browser.post("/login", data=fields, headers={"origin": URL})
    assert (answer.status_code, answer.headers["retry-after"]) == (429, "60")
    assert "Too many tries: wait 60 s." in answer.text


@pytest.mark.slow
def test_a_badge_that_is_attacked_signs_in_from_another_address() -> None:
    place = Place()
    for _ in range(3 * TRIES_MAX):
        sign_in(place.browser("192.0.2.1"), badge="BADGE-2", pin="0000")
    assert sign_in(place.browser("192.0.2.1"), badge="BADGE-2", pin=PIN)[0] == 429
    as_sue(place.browser("192.0.2.2"))


@pytest.mark.slow
def test_one_client_does_not_lock_out_everybody() -> None:
    place = Place()
    attacker = place.browser("192.0.2.1")
    for number in range(ALL_MAX):
        sign_in(attacker, badge=f"GUESS-{number}", pin="0000")
    assert place.checker.done == PER_ADDRESS_MAX
    as_sue(place.browser("192.0.2.2"))


@pytest.mark.slow
@each(
    "one, other, is_one",
    [
        ("192.0.2.1", "192.0.2.2", False),
        ("2001:db8::1", "2001:db8::ffff:2", True),
        ("2001:db8:0:1::1", "2001:db8:0:2::1", False),
        ("::ffff:192.0.2.1", "192.0.2.1", True),
        ("fe80::1%eth0", "fe80::2%eth0", True),
        ("::1", "127.0.0.1", True),
        ("127.0.0.9", "127.0.0.1", True),
        ("::ffff:127.0.0.9", "127.0.0.1", True),
    ],
)
def test_a_client_is_known_by_its_address(one: str, other: str, *, is_one: bool) -> None:
    place = Place()
    for _ in range(TRIES_MAX):
        sign_in(place.browser(one), badge="BADGE-2", pin="0000")
    assert sign_in(place.browser(other), badge="BADGE-2", pin=PIN)[0] == (429 if is_one else 303)


def test_who_knows_the_password_does_not_guess_pins_either() -> None:
    browser = Place(is_far=True, password=ALL).browser()
    browser.get("/runs")
    for pin in range(5):
        assert sign_in(browser, password=ALL, badge="BADGE-2", pin=f"000{pin}")[0] == 403
    assert sign_in(browser, password=ALL, badge="BADGE-2", pin=PIN)[0] == 429


@each("badge", ["BADGE-2", "BADGE-3", "BADGE-9"])
def test_a_badge_that_opens_nothing_takes_as_long_as_one_with_a_pin(badge: str) -> None:
    place = Place(is_far=True)
    assert sign_in(place.browser(), badge=badge, pin="0000")[0] == 403
    assert place.checker.done == 1


@pytest.mark.slow
def test_badges_without_a_pin_are_not_guessed_without_end() -> None:
    browser = Place().browser()
    found = [sign_in(browser, badge=f"GUESS-{number}")[0] for number in range(30)]
    assert Counter(found) == {403: PER_ADDRESS_MAX, 429: 30 - PER_ADDRESS_MAX}


def test_what_was_typed_is_in_no_row_of_the_trail() -> None:
    place = Place()
    sign_in(place.browser(), badge="815815", pin="0000")
    sign_in(place.browser(), badge="BADGE-2", pin="815815")
    supervised = place.browser()
    supervised.get("/runs")
    sign_in(supervised, badge="BADGE-1")
    assert place.noted(AuditEvent.SIGN_IN_REFUSED) == [
        {"name": "", "address": "192.0.2.1", "why": "unknown badge"},
        {"name": "Sue", "address": "192.0.2.1", "why": "wrong PIN"},
        {"name": "Jo", "address": "192.0.2.1", "why": "no supervisor"},
    ]


# -- how long it holds -----------------------------------------------------------------------------


def test_a_supervisor_who_left_is_asked_again() -> None:
    place = Place(is_far=True)
    browser = as_sue(place.browser())
    for _ in range(3):  # whoever reads is there
        place.clock.go_on(IDLE_S - 1)
        assert status(browser) == 200
    place.clock.go_on(IDLE_S)
    assert browser.head("/").status_code == 303
    assert status(browser) == 303
    assert status(browser, "/") == 303
    ended = place.noted(AuditEvent.SIGN_IN_ENDED)
    assert [(each["name"], each["why"]) for each in ended] == [("Sue", "15 min without use")]


def test_a_stream_or_a_look_by_a_script_is_no_use() -> None:
    place = Place()
    browser = as_sue(place.browser())
    place.clock.go_on(IDLE_S - 1)
    browser.head("/runs")
    place.clock.go_on(1)
    assert status(browser) == 303


@pytest.mark.slow
@each("fields", [{"badge": "BADGE-4", "pin": PIN}, {"password": ALL}])
def test_every_sign_in_ends_after_a_shift(fields: dict[str, str]) -> None:
    place = Place(is_far=True, password=ALL)
    browser = place.browser()
    sign_in(browser, **fields)
    for _ in range(int(SHIFT_S / 600) - 1):
        place.clock.go_on(600)
        assert status(browser, "/") == 200
    place.clock.go_on(599)
    assert status(browser, "/") == 200
    place.clock.go_on(1)
    assert status(browser, "/") == 303
    assert [each["why"] for each in place.noted(AuditEvent.SIGN_IN_ENDED)] == ["8 h"]


@pytest.mark.slow
def test_a_supervisor_who_is_always_there_signs_in_once_a_shift() -> None:
    place = Place()
    browser = as_sue(place.browser())
    for _ in range(int(SHIFT_S / 600) - 1):
        place.clock.go_on(600)
        assert status(browser) == 200
    place.clock.go_on(600)
    assert status(browser) == 303


def test_the_time_that_a_computer_sleeps_counts() -> None:
    place = Place()
    browser = as_sue(place.browser())
    seconds = place.clock.seconds
    place.clock.go_on(IDLE_S)
    place.clock.seconds = seconds  # a monotonic clock may stand still meanwhile
    assert status(browser) == 303


def test_a_clock_that_is_set_back_makes_no_sign_in_longer() -> None:
    place = Place()
    browser = as_sue(place.browser())
    begun = place.clock.now
    place.clock.go_on(IDLE_S)
    place.clock.now = begun
    assert status(browser) == 303


@each("secret", [SECRET, ANOTHER])
def test_no_sign_in_outlives_the_server_or_its_secret(secret: str) -> None:
    browser = as_sue(Place().browser())
    again = Place(secret=secret).browser()
    again.cookies = browser.cookies
    assert status(again) == 303


def test_another_secret_ends_all() -> None:
    place = Place()
    browser = as_sue(place.browser())
    again = Place(secret=ANOTHER)
    again.login.sign_ins = place.login.sign_ins
    copied = again.browser()
    copied.cookies = browser.cookies
    assert status(copied) == 303


def test_a_page_that_is_open_still_posts_after_a_restart() -> None:
    browser = Place().browser()
    token = browser.get("/").text
    again = Place().browser()
    again.cookies = browser.cookies
    headers = {"origin": URL, TOKEN_HEADER: token}
    assert again.post("/line/scan", content=b"{}", headers=headers).status_code == 200


def test_the_cookie_ends_with_the_browser() -> None:
    cookie = Place().browser().get("/").headers["set-cookie"].lower()
    assert "max-age" not in cookie
    assert "expires" not in cookie


# -- out -------------------------------------------------------------------------------------------


def test_who_signs_out_is_out_with_every_copy_of_the_cookie() -> None:
    place = Place(is_far=True)
    browser, copied = as_sue(place.browser()), place.browser()
    copied.cookies.update(browser.cookies)
    assert posted(browser, "/sign-out") == (303, "/")
    assert status(browser) == status(copied) == status(copied, "/") == 303
    (data,) = place.noted(AuditEvent.SIGN_OUT)
    assert (data["name"], data["address"]) == ("Sue", "192.0.2.1")


def test_only_a_page_of_the_session_signs_out() -> None:
    browser = as_sue(Place().browser())
    for token in ("", "guessed"):
        browser.post("/sign-out", data={"token": token}, headers={"origin": URL})
        assert status(browser) == 200
    assert browser.get("/sign-out").status_code == 405
    assert posted(Place().browser(), "/sign-out") == (303, "/")  # no one was signed in


def test_everywhere_is_all_of_one_person() -> None:
    place = Place(is_far=True)
    first, second = as_sue(place.browser()), as_sue(place.browser("192.0.2.2"))
    rea = place.browser("192.0.2.3")
    sign_in(rea, badge="BADGE-4", pin=PIN)
    posted(first, "/sign-out", everywhere="1")
    assert (status(first), status(second), status(rea, "/")) == (303, 303, 200)
    (ended,) = place.noted(AuditEvent.SIGN_IN_ENDED)
    assert (ended["address"], ended["by"]) == ("192.0.2.2", "Sue")


def test_who_knows_the_password_signs_no_one_else_out() -> None:
    place = Place(is_far=True, password=ALL)
    first, second = place.browser(), place.browser("192.0.2.2")
    sign_in(first, password=ALL)
    sign_in(second, password=ALL)
    posted(first, "/sign-out", everywhere="1")
    assert (status(first, "/"), status(second, "/")) == (303, 200)


def test_a_screen_goes_on_after_the_supervisor_who_used_it() -> None:
    place = Place(is_far=True, password=ALL)
    screen = place.browser()
    sign_in(screen, password=ALL)
    for leaves in (lambda: posted(screen, "/sign-out"), lambda: place.clock.go_on(IDLE_S)):
        as_sue(screen)
        leaves()
        assert (status(screen), status(screen, "/")) == (303, 200)


def test_another_badge_takes_the_place_of_the_one_before() -> None:
    place = Place(is_far=True)
    browser = as_sue(place.browser())
    sign_in(browser, badge="BADGE-4", pin=PIN)
    assert (status(browser), status(browser, "/")) == (303, 200)
    assert [each.name for each in place.login.sign_ins.listed()] == ["Rea"]


def test_a_stream_ends_with_its_sign_in() -> None:
    place = Place(is_far=True)
    browser = as_sue(place.browser())
    sent: list[dict[str, Any]] = []

    async def look() -> None:
        request = browser.build_request("GET", "/line/events")
        scope = {
            "type": "http", "method": "GET", "path": "/line/events", "query_string": b"",
            "scheme": "http", "client": ("192.0.2.1", 50000), "root_path": "",
            "headers": [(name.lower().encode(), value.encode())
                        for name, value in request.headers.items()],
        }  # fmt: skip

        async def receive() -> dict[str, Any]:
            await asyncio.Event().wait()
            raise AssertionError

        async def send(message: Any) -> None:
            sent.append(message)

        looking: asyncio.Future[None] = asyncio.ensure_future(place.app(scope, receive, send))
        place.reported.put_nowait("before")
        while not any(b"before" in each.get("body", b"") for each in sent):
            await asyncio.sleep(0)
        place.login.sign_ins.end_all(place.login.sign_ins.listed()[0])
        place.reported.put_nowait("after")
        for _ in range(20):
            await asyncio.sleep(0)
        assert looking.done()

    in_own_loop(look())
    assert not any(b"after" in each.get("body", b"") for each in sent)
    assert sent[-1] == {"type": "http.response.body", "body": b"", "more_body": False}


# -- who is there ----------------------------------------------------------------------------------


def test_a_supervisor_sees_who_is_there_and_ends_it() -> None:
    place = Place(is_far=True)
    sue, rea = as_sue(place.browser()), place.browser("192.0.2.9")
    place.clock.go_on(60)
    sign_in(rea, badge="BADGE-4", pin=PIN)
    assert rea.get("/sign-ins").headers["location"] == "/login"
    html = sue.get("/sign-ins").text
    for text in ("Sue", "supervisor", "this browser", "Rea", "rework", "192.0.2.9"):
        assert text in html
    assert posted(rea, "/sign-ins/end", number="1") == (303, "/login")
    assert posted(sue, "/sign-ins/end", number="2") == (303, "/sign-ins")
    assert (status(rea, "/"), status(sue)) == (303, 200)
    (ended,) = place.noted(AuditEvent.SIGN_IN_ENDED)
    assert (ended["name"], ended["by"]) == ("Rea", "Sue")
    assert [each["name"] for each in place.noted(AuditEvent.SIGN_IN)] == ["Sue", "Rea"]


@pytest.mark.slow
@each(
    "fields", [{"number": "99"}, {"number": "x"}, {"number": "\u0663"}, {"number": "9" * 5000}, {}]
)
def test_what_is_no_sign_in_ends_nothing(fields: dict[str, str]) -> None:
    place = Place()
    sue = as_sue(place.browser())
    assert posted(sue, "/sign-ins/end", **fields) == (303, "/sign-ins")
    assert status(sue) == 200


def test_all_end_at_once() -> None:
    place = Place(is_far=True)
    browsers = [as_sue(place.browser(f"192.0.2.{number}")) for number in range(3)]
    posted(browsers[0], "/sign-ins/end", all="1")
    assert [status(browser) for browser in browsers] == [303] * 3
    assert place.login.sign_ins.listed() == []


def test_the_keys_are_on_no_page() -> None:
    place = Place()
    sue = as_sue(place.browser())
    (key,) = place.login.sign_ins._known
    assert key not in sue.get("/sign-ins").text


def test_sign_ins_of_one_person_are_limited() -> None:
    notes: list[AuditEvent] = []
    known = SignIns(FakeClock(), lambda event, _data: notes.append(event))
    first, other = known.begin(None, "192.0.2.1"), known.begin(PEOPLE[1], "192.0.2.2")
    for _ in range(100):
        known.begin(None, "192.0.2.1")
    assert len(known.listed()) == 101
    assert known.find(first, is_use=True) is None
    assert known.find(other, is_use=True) is not None
    assert notes.count(AuditEvent.SIGN_IN_ENDED) == 1


@pytest.mark.slow
@each("badge, pin", [("BADGE-2", PIN), ("BADGE-3", "")])
def test_who_signs_in_again_and_again_in_a_shift_is_let_in(badge: str, pin: str) -> None:
    place = Place()
    for _ in range(4 * TRIES_MAX):
        assert sign_in(place.browser(), badge=badge, pin=pin)[0] == 303
        place.clock.go_on(PAUSE_S / 2)


@pytest.mark.slow
@pytest.mark.parametrize("page", ["/login", "/sign-ins"])
def test_pages_of_sign_ins_are_in_every_language(page: str) -> None:
    place = Place(password=ALL)
    sue = as_sue(place.browser())
    texts = {code: sue.get(f"{page}?lang={code}").text for code in ("en", "de", "zh")}
    assert len(set(texts.values())) == 3
