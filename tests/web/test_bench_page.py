"""The bench page in a real browser, over a bench with virtual bikes."""

from __future__ import annotations

import io
import re
import threading
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
from playwright.sync_api import Page, Route, expect

from flasher import events
from flasher.history import Began, Flash, Reached
from flasher.web import feed
from flasher.web.bench import BenchController
from flasher.web.bench_state import Activity
from flasher.web.virtual_bike import BikeFault
from tests.end_to_end.stage import NEW, OLD, image_of
from tests.firmware import VECTORS
from tests.web.barriers import barriers
from tests.web.bench_place import IMAGE, PACKETS, BenchPlace
from tests.web.conftest import Tab

expect.set_options(timeout=20_000)  # the computer may have much else to do


@pytest.fixture
def place(tmp_path: Path) -> BenchPlace:
    return BenchPlace(tmp_path)


@pytest.fixture
def page(tab: Tab, place: BenchPlace) -> Iterator[Page]:
    """The page; it asks for nothing from elsewhere, and its script makes no error."""
    with place.served() as url:
        tab.page.goto(url)
        tab.page.wait_for_selector("#adapter-1:enabled")
        yield tab.page
        root = url.partition("/enter")[0]
        assert all(each.startswith(root) for each in tab.asked)
        assert [each for each in tab.wrong if not re.search("status of (400|415)", each)] == []
        tab.page.goto("about:blank")


def _choose(page: Page, fault: BikeFault = BikeFault.NONE, target: str = "bms") -> None:
    page.click(f"#adapter button:text-is('{fault.value}')")
    page.click(f"#target-{target}:enabled")
    page.click("#image-1")


def _claims(page: Page) -> list[str]:
    page.wait_for_selector("#next-bike:enabled", timeout=20_000)
    return page.locator("#result .claim strong").all_inner_texts()


def _check(page: Page) -> None:
    """Nothing bars anybody, and nothing is wider than the screen."""
    schemes: tuple[Literal["light", "dark"], ...] = ("light", "dark")
    for scheme in schemes:
        page.emulate_media(color_scheme=scheme)
        assert barriers(page, looks_alone=scheme == "dark") == ""
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.scrollingElement.scrollWidth <= innerWidth")
    page.set_viewport_size({"width": 1280, "height": 800})


def test_keyboard_alone_upgrades_a_bike_and_leads_to_its_sheet(page: Page) -> None:
    _check(page)

    def press(name: str) -> None:
        for _ in range(40):
            page.keyboard.press("Tab")
            if page.evaluate("document.activeElement.id") == name:
                break
        page.keyboard.press("Enter")

    press("adapter-1")
    expect(page.locator("#target-bms")).to_be_enabled()
    expect(page.locator("#bike")).to_contain_text(OLD)
    assert page.evaluate("document.activeElement.id") == "now"
    press("target-bms")
    expect(page.locator("#image-1")).to_have_text(IMAGE)
    press("image-1")
    expect(page.locator("#go")).to_be_enabled()
    _check(page)
    press("go")
    assert _claims(page) == ["YES", "YES", "YES"]
    expect(page.locator("#result")).to_contain_text(f"Runs {NEW}")
    _check(page)
    press("sheet")
    row = page.locator("tr.changed")
    expect(row.first).to_contain_text(OLD)
    expect(row.first).to_contain_text(NEW)
    _check(page)
    saved = page.request.get(page.url + "?save")
    assert "attachment" in saved.headers["content-disposition"]
    assert "<style>" in saved.text()
    assert "href=" not in saved.text().partition("<main>")[2]


def test_an_interrupted_upgrade_is_rescued(page: Page) -> None:
    _choose(page, BikeFault.POWER)
    page.click("#go")
    assert _claims(page) == ["NO", "NO", "NOT KNOWN"]
    expect(page.locator("#result")).to_contain_text("erased, half written or not accepted")
    _check(page)
    page.click("#do-rescue-it")
    expect(page.locator("#rescue")).to_contain_text("Do not switch anything off yet")
    page.click("#go")
    assert _claims(page) == ["YES", "YES", "YES"]


def test_files_that_do_not_fit_state_why_and_dropped_ones_are_looked_at(page: Page) -> None:
    page.click("#adapter-1")
    page.click("#target-bms:enabled")
    expect(page.locator("#image-1")).to_be_visible()
    page.click("#refused-all")
    expect(page.locator("#refused")).to_contain_text("broken.hex")
    _check(page)
    image = image_of(3, NEW).data
    page.set_input_files("#file", {"name": "own <b>.bin", "mimeType": "", "buffer": image})
    expect(page.locator("#image strong")).to_have_text("own <b>.bin")
    page.set_input_files("#file", {"name": "run.sh", "mimeType": "", "buffer": image})
    expect(page.locator("#message")).to_contain_text("neither an image")


def test_files_are_taken_before_anything_is_chosen_and_a_trace_reports_its_story(
    page: Page, place: BenchPlace
) -> None:
    image = image_of(3, NEW).data
    page.set_input_files("#file", {"name": "own.bin", "mimeType": "", "buffer": image})
    expect(page.locator("#image")).to_contain_text("Dropped: own.bin.")
    assert place.bench.state.trouble is None
    page.set_input_files("#file", {"name": "no.blf", "mimeType": "", "buffer": b"no trace"})
    expect(page.locator("h1")).to_have_text("That did not work")
    expect(page.get_by_role("alert")).to_contain_text("no.blf is not a trace")
    page.click("nav a[href='/']")
    page.click("#adapter-1")
    page.click("#target-bms:enabled")
    page.click("#image button:text-is('own.bin')")
    page.click("#go")
    assert _claims(page) == ["YES", "YES", "YES"]


def test_a_failure_is_explained_and_its_bundle_downloaded_in_one_click(page: Page) -> None:
    _choose(page, BikeFault.POWER)
    page.click("#go")
    page.click("#story")
    expect(page.locator("h1")).to_contain_text("What flasher-bms-")
    _check(page)
    trace = page.request.get(page.url.replace("story?bundle", "bundle?name"))
    with zipfile.ZipFile(io.BytesIO(trace.body())) as archive:
        (name,) = (each for each in archive.namelist() if each.endswith(".blf"))
        recorded = archive.read(name)
    page.click("nav a[href='/kept']")
    expect(page.locator("h3").first).to_contain_text("flash BMS W2605001")
    expect(page.locator("main")).to_contain_text("not transferred, not completed, running not")
    _check(page)
    page.click("nav a[href='/']")
    expect(page.locator("#story")).to_be_visible()
    page.set_input_files("#file", {"name": "a.blf", "mimeType": "", "buffer": recorded})
    expect(page.locator("h1")).to_have_text("What a.blf tells")


def test_the_bus_is_watched_and_the_battery_saved(page: Page) -> None:
    page.click(f"#adapter button:text-is('{BikeFault.HARDWARE.value}')")
    page.click("#answers-all")
    expect(page.locator("#answers")).to_contain_text("over discharge protection")
    expect(page.locator("#answers")).to_contain_text("most recent charge interval")
    page.click("#do-watch")
    expect(page.locator("#watched tbody")).to_contain_text("voltage 40153 mV")
    page.click("#stop")
    expect(page.locator("#watched")).to_contain_text("stopped")
    page.click("#do-areas")
    page.focus("#area-1")
    _check(page)
    page.click("#area-1")
    expect(page.locator("#saved")).to_contain_text("It contains the running version.")
    with page.expect_download() as download:
        page.click("#download")
    with zipfile.ZipFile(download.value.path()) as archive:
        assert "memory.hex" in archive.namelist()


def test_a_check_is_waived_in_a_second_step_that_names_the_risk(page: Page) -> None:
    page.click(f"#adapter button:text-is('{BikeFault.NONE.value}')")
    page.click("#target-bms:enabled")
    wrong = image_of(3, NEW).data[len(VECTORS) :]
    page.set_input_files("#file", {"name": "odd.bin", "mimeType": "", "buffer": wrong})
    expect(page.locator("#refused-all")).to_contain_text("fit: 2")
    page.click("#refused-all")
    page.click("text=Check again which images fit")  # the list is gone meanwhile
    page.click("#refused summary:text('Use it anyway')")
    # Its piece comes anew while it is read.
    page.evaluate(
        "() => apply({parts: {"
        "refused: byId('refused').innerHTML.replaceAll(' open=', ' data-was=')}})"
    )
    assert page.locator("#refused details[data-was]").count() > 0
    expect(page.locator("#refused details.waive[open]")).to_have_count(1)
    # The next one is about another file, which was not examined.
    page.evaluate(
        "() => apply({parts: {"
        "refused: byId('refused').innerHTML.replaceAll(' open=', ' data-was=')"
        ".replaceAll('odd.bin', 'another.bin')}})"
    )
    expect(page.locator("#refused details.waive[open]")).to_have_count(0)
    expect(page.locator("#refused-all")).to_be_visible()
    page.evaluate(
        "() => apply({parts: {"
        "refused: byId('refused').innerHTML.replaceAll('another.bin', 'odd.bin')}})"
    )
    page.click("#refused summary:text('Use it anyway')")
    expect(page.locator("#refused")).to_contain_text("do not look like a program for the device")
    page.click("#waive-2-go")  # not without the tick
    expect(page.locator("#waive-2-risk:invalid")).to_be_visible()
    _check(page)
    page.check("#waive-2-risk")
    page.click("#waive-2-go")
    expect(page.locator("#start")).to_contain_text("Waived for this upgrade")


def test_an_order_that_was_held_up_on_its_way_is_refused_and_a_stop_is_not(
    page: Page, place: BenchPlace, tab: Tab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A minute later another unit may be connected."""
    _choose(page)

    def hold(route: Route) -> None:
        monkeypatch.setattr(feed, "page_time", lambda: time.perf_counter() + 60.0)
        route.continue_()

    page.route("**/bench/order", hold)
    page.click("#go:enabled")
    expect(page.locator("#message")).to_contain_text("did not receive that")
    assert place.bench.state.done is None
    assert place.bench.state.doing is Activity.NOTHING
    assert ["412" in each for each in tab.wrong] == [True]
    tab.wrong.clear()
    answer = page.evaluate('post("/bench/order", {order: "stop"})')
    assert answer == {}


def test_the_page_states_when_its_program_has_ended(page: Page, place: BenchPlace) -> None:
    page.click(f"#adapter button:text-is('{BikeFault.NONE.value}')")
    expect(page.locator("#target-bms")).to_be_visible()
    place.bench.feed.close()
    expect(page.locator("#ended")).to_be_visible()
    expect(page.locator("#target-bms")).to_be_hidden()
    expect(page.locator("#bike")).to_contain_text(OLD)
    name = page.locator("#cover").evaluate("each => getComputedStyle(each).animationName")
    assert name == "none"


def test_an_image_that_the_device_refuses_is_not_reported_to_be_completed(page: Page) -> None:
    _choose(page, BikeFault.REFUSES)
    page.click("#go")
    assert _claims(page) == ["YES", "NO", "NOT KNOWN"]
    expect(page.locator("#result")).to_contain_text("the device refused the image at the end")


def test_reloading_disturbs_nothing_and_a_second_tab_shows_the_same(
    page: Page, place: BenchPlace
) -> None:
    reached, go_on = threading.Event(), threading.Event()

    def hold(event: object) -> None:
        if isinstance(event, events.PacketAcknowledged) and event.number == PACKETS // 2:
            reached.set()
            go_on.wait(10)

    place.bikes.hold = hold
    _choose(page)
    page.click("#go")
    assert reached.wait(10)
    half = re.compile(f"{PACKETS // 2} of {PACKETS} packets")
    expect(page.locator("#pace")).to_contain_text(half)
    page.reload()
    expect(page.locator("#pace")).to_contain_text(half)
    second = page.context.new_page()
    second.goto(page.url)
    expect(second.locator("#pace")).to_contain_text(half)
    _check(second)
    page.goto("about:blank")
    go_on.set()
    assert _claims(second) == ["YES", "YES", "YES"]
    second.close()
    page.go_back()
    assert _claims(page) == ["YES", "YES", "YES"]


def test_a_file_that_is_chosen_while_an_image_is_selected_is_the_one_to_be_flashed(
    page: Page,
) -> None:
    _choose(page)
    expect(page.locator("#go")).to_be_visible()
    newer = image_of(PACKETS + 1, NEW).data
    page.set_input_files("#file", {"name": "newer.bin", "mimeType": "", "buffer": newer})
    expect(page.locator("#image strong")).to_have_text("newer.bin")
    expect(page.locator("#start")).to_contain_text("newer.bin into the BMS")
    page.set_input_files("#file", {"name": "tiny.bin", "mimeType": "", "buffer": bytes(range(16))})
    expect(page.locator("#trouble")).to_contain_text("not plausible as firmware")
    expect(page.locator("#trouble h2")).to_be_in_viewport()
    expect(page.locator("#go")).to_have_count(0)


def test_a_page_that_lost_its_server_in_an_upgrade_states_what_is_known_and_what_to_do(
    tab: Tab, place: BenchPlace
) -> None:
    reached, go_on = threading.Event(), threading.Event()

    def hold(event: object) -> None:
        if isinstance(event, events.PacketAcknowledged) and event.number == 7:
            reached.set()
            go_on.wait(30)

    place.bikes.hold = hold
    with place.served() as url:
        tab.page.goto(url)
        _choose(tab.page)
        tab.page.click("#go")
        assert reached.wait(20)
        expect(tab.page.locator("#pace")).to_contain_text("7 of 20 packets")
        tab.page.evaluate("document.body.classList.add('lost')")
        cover = tab.page.locator("#cover")
        expect(cover).to_be_visible()
        expect(cover).to_contain_text("Last reported of the upgrade: 7 of 20 packets")
        expect(cover.get_by_text("If it was ended")).to_be_visible()
        expect(cover.get_by_text("No upgrade was running")).to_be_hidden()
        go_on.set()
        tab.page.wait_for_selector("#next-bike:enabled")
        tab.page.evaluate("document.body.classList.add('lost')")
        expect(cover.get_by_text("No upgrade was running")).to_be_visible()
        tab.page.goto("about:blank")


def test_the_focus_is_back_on_the_control_that_was_used_by_enter(page: Page) -> None:
    page.focus("#do-adapters")
    page.keyboard.press("Enter")
    expect(page.locator("#do-adapters")).to_be_focused()
    _choose(page)
    page.click("#do-image")
    page.focus("#folder")
    page.keyboard.press("Enter")
    expect(page.locator("#image-1")).to_be_visible()
    expect(page.locator("#folder")).to_be_focused()


def test_an_unfinished_upgrade_is_the_first_thing_on_the_page(tab: Tab, place: BenchPlace) -> None:
    began = Began(
        at="2026-05-17T10:31:02+02:00", command="flash", target="bms", is_virtual=False,
        adapter=BikeFault.NONE.value, image=IMAGE,
        image_sha256=image_of(PACKETS, NEW).sha256, image_size_bytes=1, image_version=NEW,
    )  # fmt: skip
    place.bikes.unfinished = lambda: Flash(began, None, reached=Reached("transfer", 12))  # type: ignore[method-assign]
    place.do(BenchController.find_adapters)
    with place.served() as url:
        tab.page.goto(url)
        expect(tab.page.locator("#rescue h2")).to_have_text(
            "An upgrade has no end: rescue the device"
        )
        expect(tab.page.locator("#rescue")).to_contain_text("its application is erased")
        _check(tab.page)
        tab.page.click("#do-rescue-unfinished")
        expect(tab.page.locator("#go")).to_have_text("Rescue the BMS now")
        tab.page.goto("about:blank")
