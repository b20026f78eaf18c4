"""The operator page in a real browser: what it shows, when it shows nothing, and scans."""

from __future__ import annotations

import io
import itertools
import random
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Literal

import pytest
from PIL import Image, ImageChops, ImageStat
from playwright.sync_api import Browser, Page, Route, expect

from flasher.i18n import text
from flasher.station.events import (
    LineResumed,
    LineStopped,
    OfferedRecipe,
    PinAwaited,
    PinEnded,
    RecipesOffered,
    ScanAccepted,
    ScanRefused,
    SocketChanged,
    SocketState,
)
from flasher.station.records.model import RunState
from flasher.web import feed
from tests.web.barriers import barriers
from tests.web.conftest import Tab
from tests.web.line_screen import AT, LineScreen, ended, served, tile

STATES = tuple(SocketState)
SIZES = {
    "screen": (1920, 1080),
    "laptop": (1280, 800),
    "tablet": (820, 1180),
    "phone": (390, 844),
}
LONGEST = "Take BAT2620-0005 out, then connect BAT2620-0006. Or scan CANCEL."
_MM_PER_PX = 531.0 / 1920
"""On a screen of 24 inches."""


@pytest.fixture(scope="module")
def served_line() -> Iterator[LineScreen]:
    """A line whose page is served, for one test after the other."""
    made = LineScreen("A", "B", "C", "D")
    with served(made):
        yield made
    made.hang()


@pytest.fixture
def line(served_line: LineScreen) -> LineScreen:
    served_line.begin_anew()
    return served_line


@pytest.fixture
def own_line() -> Iterator[LineScreen]:
    """A line that may hang, and that no page shows yet."""
    made = LineScreen("A", "B", "C", "D")
    yield made
    made.hang()


@pytest.fixture
def page(tab: Tab, line: LineScreen) -> Iterator[Page]:
    """The page of `line`; it asks for nothing from elsewhere, and its script makes no error."""
    tab.page.set_viewport_size({"width": 1920, "height": 1080})
    tab.page.goto(f"{line.url}line")
    tab.page.wait_for_function("() => document.querySelectorAll('article').length === 4")
    yield tab.page
    assert all(each.startswith(line.url) for each in tab.asked)
    assert [each for each in tab.wrong if "ERR_" not in each] == []


def _rounds(page: Page, line: LineScreen, names: Sequence[str]) -> Iterator[None]:
    """All states with their longest text, as many at a time as there are sockets; each time when
    the page shows them.
    """
    for first in range(0, len(STATES), len(names)):
        states = STATES[first : first + len(names)]
        for state, name in zip(states, names, strict=False):
            line.state(name, state, "BAT2620-0005", LONGEST)
        page.wait_for_function(
            "([at, s]) => document.querySelectorAll('article')[at].dataset.state === s",
            arg=[len(states) - 1, states[-1].value.lower()],
        )
        yield


def _shows(page: Page, socket: int, word: str) -> None:
    # Looked at with every frame: what `expect` waits between two looks adds up.
    page.wait_for_function(
        "([at, w]) => document.querySelectorAll('article .word')[at]?.textContent === w",
        arg=[socket, word],
    )


# -- verdicts --------------------------------------------------------------------------------------


def test_pass_is_shown_when_it_is_committed_and_not_before(page: Page, line: LineScreen) -> None:
    line.say(SocketChanged("A", SocketState.PASS, "BAT2620-0005", "Take the unit out.", at=AT))
    _shows(page, 0, "SAVING")
    line.say(ended("A", "BAT2620-0005", RunState.PASS))
    _shows(page, 0, "PASS")
    assert tile(page, "A").tail == "0-0005"


def test_the_pass_of_another_unit_is_not_this_ones(page: Page, line: LineScreen) -> None:
    line.state("A", SocketState.PASS, "BAT2620-0005")
    _shows(page, 0, "PASS")
    line.say(SocketChanged("A", SocketState.PASS, "BAT2620-0006", "", at=AT))
    _shows(page, 0, "SAVING")


def test_every_page_shows_the_same_after_it_was_loaded(page: Page, line: LineScreen) -> None:
    line.state("B", SocketState.FAIL, "BAT2620-0007", "Put the unit aside as bad.")
    _shows(page, 1, "FAIL")
    page.reload()
    _shows(page, 1, "FAIL")
    assert tile(page, "B").what == "Put the unit aside as bad."


# -- the page dies honestly ------------------------------------------------------------------------


def test_a_station_that_is_gone_covers_the_page_and_it_comes_back_by_itself(
    tab: Tab, own_line: LineScreen
) -> None:
    page = tab.page
    with served(own_line) as url:
        page.goto(f"{url}line")
        own_line.state("A", SocketState.PASS, "BAT2620-0005")
        expect(page.locator("#cover")).to_be_hidden()
        _shows(page, 0, "PASS")
    expect(page.locator("#cover")).to_be_visible(timeout=3000)
    again = LineScreen("A", "B", "C", "D")
    with served(again, port=int(url.rstrip("/").rpartition(":")[2])):
        expect(page.locator("#cover")).to_be_hidden(timeout=10_000)
        _shows(page, 0, "EMPTY")
    again.hang()


def test_the_server_ends_within_two_seconds_though_a_stream_is_open(
    tab: Tab, own_line: LineScreen
) -> None:
    with served(own_line, closes_feed=False) as url:
        tab.page.goto(f"{url}line")
        expect(tab.page.locator("article")).to_have_count(4)
        began = time.perf_counter()
    assert time.perf_counter() - began < 2.0


def test_a_station_that_hangs_and_a_script_that_died_cover_their_pages(
    browser: Browser, page: Page, own_line: LineScreen
) -> None:
    """The cover comes down by the style sheet alone."""
    other = browser.new_page()
    with served(own_line) as url:
        other.goto(f"{url}line")
        for each in (page, other):
            expect(each.locator("#cover")).to_be_hidden()
        page.evaluate("() => void setTimeout(() => { JSON.parse = () => { throw 'ERR_TEST' } })")
        own_line.hang()
        for each in (page, other):
            expect(each.locator("#cover")).to_be_visible(timeout=6000)
    other.close()


def test_a_stopped_line_covers_everything(page: Page, line: LineScreen) -> None:
    line.say(LineStopped("RECORD_NOT_SAVED", "The disk is full.", "Make room.", at=AT))
    expect(page.locator("#stopped")).to_be_visible()
    expect(page.locator("#stopped")).to_contain_text("RESUME")
    expect(page.locator("#stopped")).to_contain_text("The disk is full.")
    line.say(LineResumed(at=AT))
    expect(page.locator("#stopped")).to_be_hidden()


# -- scans -----------------------------------------------------------------------------------------


def test_no_scan_is_lost_or_split_while_tiles_change(page: Page, line: LineScreen) -> None:
    chance = random.Random(3)
    scans = [f"BAT2620-{number:04}" for number in range(16)]
    page.locator("#sounds").focus()
    for at, scan in enumerate(scans):
        page.keyboard.type(scan)
        page.keyboard.press("Enter")
        if at % 2 == 0:  # tiles change under the hands
            name = chance.choice("ABCD")
            line.state(name, chance.choice(STATES), scan)
    page.wait_for_function("() => waiting.length === 0 && !isSending")
    assert line.scans == scans


def test_a_scan_that_did_not_reach_the_station_is_reported_and_forgotten(
    page: Page, line: LineScreen
) -> None:
    page.route("**/line/scan", lambda route: route.abort())
    page.keyboard.type("BAT2620-0001")
    page.keyboard.press("Enter")
    expect(page.locator("#spoken")).to_contain_text("did not reach the station")
    page.unroute("**/line/scan")
    page.keyboard.type("BAT2620-0002")
    page.keyboard.press("Enter")
    page.wait_for_function("() => waiting.length === 0 && !isSending")
    assert line.scans == ["BAT2620-0002"]


@pytest.mark.parametrize("later_s", [60.0, -60.0])
def test_a_scan_that_was_held_up_on_its_way_is_refused(
    page: Page, tab: Tab, line: LineScreen, monkeypatch: pytest.MonkeyPatch, later_s: float
) -> None:
    """A cable was unplugged for a minute, or the station's computer started anew: other units may
    be in the sockets when it arrives.
    """

    def hold(route: Route) -> None:
        monkeypatch.setattr(feed, "page_time", lambda: time.perf_counter() + later_s)
        route.continue_()

    page.route("**/line/scan", hold)
    page.keyboard.type("BAT2620-0001")
    page.keyboard.press("Enter")
    expect(page.locator("#spoken")).to_contain_text("did not reach the station")
    assert line.scans == []
    assert ["409" in each for each in tab.wrong] == [True]
    tab.wrong.clear()


def test_a_refused_scan_is_reported(page: Page, line: LineScreen) -> None:
    line.say(ScanRefused("X1", "WRONG_SERIAL", "No serial number.", "Scan the label.", at=AT))
    expect(page.locator("#spoken")).to_have_text("X1: No serial number. Scan the label.")


def test_a_page_shows_what_came_of_its_own_scans_and_of_scanners(
    browser: Browser, page: Page, line: LineScreen
) -> None:
    """A second browser is another source, and its operator is not disturbed."""
    other = browser.new_page()
    other.goto(f"{line.url}line")
    for each, sentence in ((page, "SOCKET A"), (other, "SOCKET B"), (page, "W1")):
        each.keyboard.type(sentence)
        each.keyboard.press("Enter")
        each.wait_for_function("() => waiting.length === 0 && !isSending")
    one, two, again = line.sources
    assert one == again != two
    reason = text("The unit was exchanged, or had no power.")
    remedy = text("Check which unit it is, then scan again.")
    line.say(ScanRefused("SOCKET A", "UNIT_CHANGED", reason, remedy, "A", one.name, at=AT))
    line.say(ScanAccepted("SOCKET B", "socket", "B", two.name, at=AT))
    expect(page.locator("#spoken")).to_have_text(f"SOCKET A: {reason} {remedy}")
    expect(other.locator("#spoken")).to_have_text("SOCKET B: socket")
    other.reload()
    expect(other.locator("#spoken")).to_have_text("SOCKET B: socket")
    for name in ("left", "right"):
        line.say(ScanAccepted("W1", "label", "A", f"scanner {name}", at=AT))
    for each in (page, other):
        expect(each.locator("#spoken")).to_have_text("scanner right: W1: label for socket A")
    other.close()


def test_a_pin_is_hidden_while_it_is_typed(page: Page, line: LineScreen) -> None:
    field = page.locator("#scan")
    page.keyboard.type("47")
    line.say(PinAwaited("Sue", "RESUME", 30.0, at=AT))
    expect(page.locator("#spoken")).to_have_text("RESUME: type the PIN of Sue, or scan CANCEL.")
    expect(field).to_have_attribute("type", "password")
    page.keyboard.type("11")
    assert barriers(page) == ""
    page.keyboard.press("Enter")
    page.wait_for_function("() => waiting.length === 0 && !isSending")
    assert line.scans == ["4711"]
    assert "4711" not in page.content()
    line.say(PinEnded("Sue", is_right=True, at=AT))
    expect(field).to_have_attribute("type", "text")


def test_a_page_that_comes_while_a_pin_is_awaited_hides_it(page: Page, line: LineScreen) -> None:
    line.say(PinAwaited("Sue", "RESUME", 30.0, at=AT))
    expect(page.locator("#scan")).to_have_attribute("type", "password")
    page.reload()
    expect(page.locator("#scan")).to_have_attribute("type", "password")


# -- to be read from afar, by everybody ------------------------------------------------------------


def test_words_can_be_read_from_three_metres(page: Page, line: LineScreen) -> None:
    """26 mm high on a screen of 24 inches with four sockets."""
    for state in STATES:
        line.state("A", state, "BAT2620-0005")
        page.wait_for_function(
            "s => document.querySelector('article').dataset.state === s", arg=state.value.lower()
        )
        height_px = page.evaluate(
            """() => {
              const word = document.querySelector("article .word");
              const context = new OffscreenCanvas(1, 1).getContext("2d");
              const style = getComputedStyle(word);
              context.font = `${style.fontWeight} ${style.fontSize} ${style.fontFamily}`;
              return context.measureText(word.textContent).actualBoundingBoxAscent;
            }"""
        )
        assert height_px * _MM_PER_PX >= 26, state


def _grey_shapes(page: Page, line: LineScreen) -> dict[SocketState, Image.Image]:
    shapes = {}
    for state in STATES:
        line.state("A", state, "BAT2620-0005")
        page.wait_for_function(
            "s => document.querySelector('article').dataset.state === s", arg=state.value.lower()
        )
        picture = Image.open(io.BytesIO(page.locator("article .shape").first.screenshot()))
        shapes[state] = picture.convert("L").resize((48, 48))
    return shapes


def test_states_are_distinguished_without_colour(page: Page, line: LineScreen) -> None:
    """By their shapes alone, in grey; the verdicts besides by their brightness to the others."""
    shapes = _grey_shapes(page, line)
    for one, other in itertools.combinations(shapes, 2):
        inks = []
        for state in (one, other):
            grey = shapes[state]
            paper = grey.getpixel((0, 0))
            inks.append(
                ImageChops.difference(grey, Image.new("L", grey.size, paper)).point(
                    lambda value: 255 if value > 40 else 0
                )
            )
        differing = ImageStat.Stat(ImageChops.difference(*inks)).mean[0] / 255
        assert differing > 0.08, (one, other)


def test_no_barrier_is_found_by_axe(page: Page, line: LineScreen) -> None:
    schemes: tuple[Literal["light", "dark"], ...] = ("light", "dark")
    for _ in _rounds(page, line, "ABCD"):
        for scheme in schemes:
            page.emulate_media(color_scheme=scheme)
            assert barriers(page, looks_alone=scheme == "dark") == "", scheme


# -- room ------------------------------------------------------------------------------------------

TOO_LARGE = """() => {
  const bad = [];
  if (document.scrollingElement.scrollHeight > innerHeight) bad.push("the page scrolls");
  if (document.scrollingElement.scrollWidth > innerWidth) bad.push("the page is too wide");
  for (const article of document.querySelectorAll("article")) {
    const box = article.getBoundingClientRect();
    for (const part of article.querySelectorAll(".word, .tail, .what, .shape, .name")) {
      const own = part.getBoundingClientRect();
      if (own.right > box.right + 1 || own.bottom > box.bottom + 1)
        bad.push(`${article.dataset.state} ${part.className.baseVal ?? part.className}`);
      if (part.matches(".what, .word") && part.scrollWidth > part.clientWidth + 1)
        bad.push(`${article.dataset.state} ${part.className} is cut`);
      if (part.matches(".what") && part.scrollHeight > part.clientHeight + 2)
        bad.push(`${article.dataset.state} ${part.className} is cut`);
    }
  }
  return bad;
}"""


@pytest.mark.parametrize(
    ("count", "sizes"),
    [(1, ["screen"]), (4, ["screen", "phone"]), (8, ["laptop"]), (16, ["tablet", "phone"])],
)
def test_everything_fits(tab: Tab, count: int, sizes: list[str]) -> None:
    page = tab.page
    names = [f"{number + 1}" for number in range(count)]
    line = LineScreen(*names)
    with served(line) as url:
        for language in ("en", "de", "zh"):
            page.goto(f"{url}line?lang={language}")
            expect(page.locator("article")).to_have_count(count)
            for _ in _rounds(page, line, names):
                for size in sizes:
                    width, height = SIZES[size]
                    page.set_viewport_size({"width": width, "height": height})
                    assert page.evaluate(TOO_LARGE) == [], (language, size)
    line.hang()


# -- recipes from the plant ------------------------------------------------------------------------


def _offer(revision: str) -> RecipesOffered:
    offer = OfferedRecipe(
        f"Battery 36 V, {revision}",
        revision * 64,
        ("A", "B"),
        "2026-05-17T10:00:00+02:00",
        "anna",
        (f"revision: {revision}, was 4",),
        f"RECIPE {revision * 12}",
    )
    return RecipesOffered((offer,), at=AT)


def test_a_recipe_that_comes_while_another_one_is_read_is_not_approved_for_it(
    page: Page, line: LineScreen
) -> None:
    line.say(_offer("5"))
    page.click("#show-offers")
    offers = page.locator("#offers")
    expect(offers.locator("h3")).to_have_text("Battery 36 V, 5")
    at = datetime(2026, 5, 17, 8, tzinfo=UTC).astimezone()
    expect(offers.locator(".published")).to_have_text(f"published {at:%Y-%m-%d %H:%M} by anna")
    line.say(_offer("6"))
    expect(offers).to_be_hidden()
    page.click("#show-offers")
    expect(offers.locator("h3")).to_have_text("Battery 36 V, 6")
    page.click("#offers .approve button")
    page.wait_for_function("() => waiting.length === 0 && !isSending")
    assert line.scans == ["RECIPE 666666666666"]
    line.say(RecipesOffered((), at=AT))
    expect(offers).to_be_hidden()
