"""The pages of who signs in, in a real browser: no barrier, nothing too wide, by the keyboard."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from flasher.station.operators import Person, Role
from flasher.station.pins import checker
from flasher.station.records.keys import KeyLocations
from flasher.station.records.store import SystemClock
from flasher.station.shift_counts import DEFAULT_SHIFTS
from flasher.web.login import Badges, Login
from flasher.web.operator import LINE, OperatorPage
from flasher.web.pages import Pages
from flasher.web.server import Server
from flasher.web.supervisor import open_supervisor
from tests.station.factory import Bench
from tests.web.answering import app_with
from tests.web.barriers import barriers
from tests.web.conftest import Tab
from tests.web.line_screen import LineScreen
from tests.web.test_login import PIN, QUICK

LONG = "Sue-Ellen von und zu Aufderhöhe-Untermann"
BADGE = "BADGE-2"
_SCREENS = ((390, "dark"), (1280, "light"))


@pytest.fixture(scope="module")
def place() -> Iterator[tuple[str, Login]]:
    """The pages of a station that asks for badges; some people are signed in elsewhere."""
    with _served(are_for_all=False) as served:
        yield served


@pytest.fixture(scope="module")
def url(place: tuple[str, Login]) -> str:
    return place[0]


@contextmanager
def _served(*, are_for_all: bool) -> Iterator[tuple[str, Login]]:
    sue = Person(name=LONG, code=BADGE, role=Role.SUPERVISOR, pin=QUICK.hash(PIN))
    badges = Badges(
        (sue,),
        needs_pin=False,
        is_supervised=lambda path: not path.startswith(LINE),
        are_for_all=are_for_all,
    )
    pages, line = Pages(), LineScreen("1", "2")
    operator = OperatorPage(pages, line.screen.feed, line.take, sound_volume=0.3)
    login = Login(
        pages, SystemClock(), lambda _event, _data: None, checker=checker(), badges=badges
    )
    login.sign_ins.begin(None, "192.0.2.17")
    login.sign_ins.begin(Person(name="Rea", code="B", role=Role.REWORK), "2001:db8:1:2::/64")
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        bench.make()
        supervisor = open_supervisor(
            str(bench.path), bench.store.files.folder, KeyLocations(bench.keys), DEFAULT_SHIFTS
        )
        app = app_with(supervisor, login, *operator.routes)
        with Server(app, "127.0.0.1", 0) as server:
            yield server.url, login
            line.screen.feed.close()
        line.hang()
        bench.store.close()


def _sign_in(page: Page, url: str) -> None:
    """As a person with a scanner, which ends what it types by Enter."""
    page.goto(f"{url}runs")
    expect(page.locator("input[name=badge]")).to_be_focused()
    page.keyboard.type(BADGE)
    page.keyboard.press("Enter")
    expect(page.locator("input[type=hidden][name=badge]")).to_have_count(1)
    expect(page.locator("input[name=pin]")).to_be_focused()
    page.keyboard.type(PIN)
    page.keyboard.press("Enter")
    expect(page).to_have_url(f"{url}runs")


def _check(page: Page, language: str) -> None:
    for width, scheme in _SCREENS:
        page.set_viewport_size({"width": width, "height": 844})
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        # The languages differ in widths alone.
        assert language != "en" or barriers(page, looks_alone=width > 390) == ""
        assert page.evaluate("document.scrollingElement.scrollWidth - innerWidth") <= 0, width


@pytest.mark.parametrize("language", ["en", "de", "zh"])
def test_who_is_signed_in_is_shown_to_everybody(tab: Tab, url: str, language: str) -> None:
    page = tab.page
    page.goto(f"{url}login?lang={language}")
    _check(page, language)
    _sign_in(page, url)
    for path in ("runs", "sign-ins", "line"):
        page.goto(f"{url}{path}?lang={language}")
        expect(page.locator(".who")).to_contain_text(LONG[:20])
        _check(page, language)
    assert [each for each in tab.wrong if "403" not in each] == []


def test_the_keyboard_alone_ends_a_sign_in_and_signs_out(tab: Tab, url: str) -> None:
    page = tab.page
    _sign_in(page, url)
    page.goto(f"{url}sign-ins")
    rows = page.locator("tbody tr")
    count = rows.count()
    page.get_by_role("button", name="End the sign-in of Rea").focus()
    page.keyboard.press("Enter")
    expect(rows).to_have_count(count - 1)
    expect(page.locator("tbody")).not_to_contain_text("Rea")
    page.goto(f"{url}line")
    page.get_by_role("button", name="Sign out", exact=True).focus()
    page.keyboard.press("Enter")  # no scan, which Enter is else
    expect(page.locator(".who")).to_have_count(0)
    page.goto(f"{url}sign-ins")
    expect(page).to_have_url(f"{url}login")


def test_a_screen_whose_sign_in_was_ended_asks_who_is_there(tab: Tab) -> None:
    page = tab.page
    with _served(are_for_all=True) as (url, login):
        _sign_in(page, url)
        page.goto(f"{url}line")
        expect(page.locator("article")).to_have_count(2)
        login.sign_ins.end_all(login.sign_ins.listed()[0])
        expect(page).to_have_url(f"{url}login", timeout=10_000)
