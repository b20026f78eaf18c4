"""The supervisor pages in a real browser: no barrier, nothing too wide, nothing from elsewhere."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from flasher.station.certificate_check import check_certificate
from flasher.station.records.model import Measurement, RunState, StepState
from flasher.translation import NAMES
from flasher.web.server import Server
from tests.loops import each
from tests.station.factory import Bench
from tests.web.answering import app_of
from tests.web.barriers import barriers
from tests.web.conftest import Tab

LONG = "W" * 90
PAGES = (
    "/runs", "/runs?from=yesterday", "/units", "/units?serial=W2605009", "/runs/2/trace",
    "/units/certificate?serial=W2605001", "/yield?by=lot", "/times", "/images", "/audit",
    "/certificate",
)  # fmt: skip
_SCREENS: tuple[tuple[int, Any], ...] = ((390, "dark"), (1280, "light"))
_BROKEN = """(which) => [...document.querySelectorAll(which)].filter((each) => {
  const range = document.createRange();
  range.selectNodeContents(each);
  const lines = new Set([...range.getClientRects()].map((rect) => Math.round(rect.top)));
  return !/\\s/.test(each.textContent.trim()) && lines.size > 1;
}).map((each) => each.textContent)"""
"""Words that are on more than one line."""


@pytest.fixture(scope="module")
def plant() -> Iterator[Bench]:
    """Records with good and bad units, and texts as long as they may be."""
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        for number in range(1, 9):
            serial = f"W26050{number:02}"
            if number % 3 == 0:
                bench.make(RunState.FAIL, serial, lot=LONG, code="TRANSFER_FAILED")
            bench.make(RunState.PASS, serial, lot=f"L{number}")
        run_id = bench.claim("W2605009", lot=LONG, reason=LONG).run_id
        bench.work(run_id)
        bench.store.intent(run_id, "bms", "flash", LONG)
        found = [Measurement("voltage", 29.0, "V", 30.0, 42.0)]
        found += (Measurement("bms model", text="W" * size) for size in range(1, 41, 3))
        bench.store.step(
            run_id, "check", StepState.FAIL, duration_s=0.5, text=LONG, measurements=found
        )
        bench.store.finish(run_id, bench.ending(RunState.FAIL, "LIMIT"))
        yield bench
        bench.store.close()


@pytest.fixture(scope="module")
def url(plant: Bench) -> Iterator[str]:
    """Their pages."""
    with Server(app_of(plant.path, plant.keys), "127.0.0.1", 0) as server:
        yield server.url


@pytest.mark.parametrize("path", PAGES)
def test_every_page_is_for_everybody(tab: Tab, url: str, path: str) -> None:
    """On a phone in the dark; on a desk by day."""
    page = tab.page
    page.goto(url + path.removeprefix("/"))
    for width, scheme in _SCREENS:
        page.set_viewport_size({"width": width, "height": 844})
        page.emulate_media(color_scheme=scheme)
        assert barriers(page, looks_alone=width > 390) == ""
        assert page.evaluate("document.scrollingElement.scrollWidth - innerWidth") <= 0, width
    assert page.locator("main").inner_text().strip()
    assert all(each.startswith(url) for each in tab.asked)
    assert [each for each in tab.wrong if "400" not in each] == []


def test_the_keyboard_alone_finds_a_unit(tab: Tab, url: str) -> None:
    page = tab.page
    page.goto(f"{url}runs")
    page.keyboard.press("Tab")  # over the menu
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.type("05003")
    page.keyboard.press("Enter")
    page.wait_for_url("**search=05003**")
    assert page.locator("tbody tr").count() == 2


def test_a_certificate_is_one_sheet_with_an_annex(tab: Tab, url: str) -> None:
    page = tab.page
    page.goto(f"{url}units/certificate?serial=W2605001")
    assert page.locator(".qr svg path").count() == 1
    page.emulate_media(media="print")
    assert not page.locator("nav").first.is_visible()
    heights = page.evaluate(
        """() => {
          const annex = document.querySelector(".annex").getBoundingClientRect();
          return annex.top * 25.4 / 96;
        }"""
    )
    assert heights < 297 - 28  # mm of A4 between its margins
    pages = page.pdf(format="A4", prefer_css_page_size=True).count(b"/Type /Page\n")
    assert pages == 2


@pytest.mark.parametrize("language", ["en", "de", "zh"])
def test_a_certificate_is_checked_by_a_page(
    tab: Tab, url: str, tmp_path: Path, language: str
) -> None:
    page = tab.page
    page.goto(f"{url}units?serial=W2605003&lang={language}")
    with page.expect_download() as download:
        page.locator("a[href*='certificate.html']").click()
    file = tmp_path / "W2605003.html"
    download.value.save_as(file)
    page.goto(f"{url}certificate?lang={language}")
    for text, verdict in (("", "good"), ("bms.bin", "bad"), ("BEGIN FLASHER", "bad")):
        if text:
            file.write_text(file.read_text("utf-8").replace(text, "x"), encoding="utf-8")
        page.set_input_files("input[type=file]", file)
        page.locator("#check button").click()
        page.wait_for_selector(f"#found .verdict.{verdict}")
        # The languages differ in words alone.
        assert language != "en" or barriers(page) == ""
    assert tab.wrong == []


@pytest.mark.parametrize(
    ("language", "has_edges"), [("en", False), ("en", True), ("de", True), ("zh", False)]
)
def test_a_printed_certificate_is_checked(
    tab: Tab, url: str, plant: Bench, language: str, *, has_edges: bool
) -> None:
    page = tab.page
    page.goto(f"{url}units/certificate?serial=W2605009&lang={language}")
    page.emulate_media(media="print")
    whole = page.pdf(format="A4", prefer_css_page_size=True, display_header_footer=has_edges)
    found = check_certificate(plant.store, whole)
    assert found.problems == ()
    assert found.serial == "W2605009"
    page.evaluate(
        """() => {
          const walker = document.createTreeWalker(document.querySelector("main"), 4);
          while (!walker.nextNode().data.includes("Battery 36"));
          walker.currentNode.data = walker.currentNode.data.replace("Battery", "Batterz");
        }"""
    )
    changed = page.pdf(format="A4", prefer_css_page_size=True, display_header_footer=has_edges)
    (problem,) = check_certificate(plant.store, changed).problems
    assert "Batterz36" in problem


@each("language", NAMES)
def test_no_word_of_a_measurement_that_fits_a_line_breaks_on_a_phone(
    tab: Tab, url: str, language: str
) -> None:
    page = tab.page
    page.set_viewport_size({"width": 390, "height": 844})
    page.goto(f"{url}units?serial=W2605009&lang={language}")
    assert page.locator("tr.measured").count()
    assert min(map(len, page.evaluate(_BROKEN, "tr.measured td"))) > 22


@each("language", NAMES)
def test_no_word_of_a_link_beside_a_button_breaks(tab: Tab, url: str, language: str) -> None:
    page = tab.page
    page.set_viewport_size({"width": 1280, "height": 844})
    page.goto(f"{url}audit?lang={language}")
    assert page.locator(".buttons a").count()
    assert page.evaluate(_BROKEN, ".buttons a") == []
