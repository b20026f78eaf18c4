"""Every state of the bench page as a picture, light and dark, in each language and size:
`python -m tests.bench_pictures FOLDER`. It tells what axe-core finds, and what is wider than the
screen.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from playwright.sync_api import Browser, Page, expect

from flasher import events
from flasher.translation import NAMES
from flasher.web.bench_state import BenchState, SeriesStep
from flasher.web.virtual_bike import BikeFault
from tests.end_to_end.stage import NEW, image_of
from tests.firmware import VECTORS
from tests.web.barriers import barriers
from tests.web.bench_place import IMAGE, BenchPlace
from tests.web.browser import chromium
from tests.web.test_bench_bike import SET, write_set

SIZES: Final = {"laptop": (1280, 800), "tablet": (820, 1180), "phone": (390, 844)}
SCHEMES: Final[tuple[Literal["light", "dark"], ...]] = ("light", "dark")
_QUIET_MS: Final = 150


@dataclass
class Album:
    """The pictures of one language."""

    page: Page
    folder: Path
    language: str
    wrong: list[str] = field(default_factory=list)
    count: int = 0

    def take(self, state: str) -> None:
        """The state as it is now, in each size and scheme."""
        self.page.wait_for_timeout(_QUIET_MS)
        for size, (width, height) in SIZES.items():
            self.page.set_viewport_size({"width": width, "height": height})
            for scheme in SCHEMES:
                self.page.emulate_media(color_scheme=scheme)
                name = f"{state}-{size}-{scheme}-{self.language}"
                self.page.screenshot(path=self.folder / f"{name}.png", full_page=True)
                self.count += 1
                if self.page.evaluate("document.scrollingElement.scrollWidth > innerWidth"):
                    self.wrong.append(f"{name}: wider than the screen")
                if found := barriers(self.page):
                    self.wrong.append(f"{name}: {found}")
        self.page.set_viewport_size({"width": 1280, "height": 800})


class Held:
    """Stops an upgrade where `at` says, until it may go on."""

    def __init__(self, place: BenchPlace, at: Callable[[object], bool]) -> None:
        self._at = at
        self.go_on = threading.Event()
        place.bikes.hold = self._hold

    def _hold(self, event: object) -> None:
        if self._at(event):
            self.go_on.wait(60)


def _use(page: Page, fault: BikeFault) -> None:
    page.click(f"#adapter button:text-is('{fault.value}')")
    expect(page.locator("#target-bms")).to_be_enabled()


def _again(page: Page) -> None:
    page.click("#next-bike, #do-other, #do-next")
    expect(page.locator("#adapter-1")).to_be_enabled()


def before_an_upgrade(page: Page, album: Album) -> None:
    """Lead the page through what comes before an upgrade."""
    odd = image_of(3, NEW).data[len(VECTORS) :]
    album.take("first")
    page.set_input_files("#file", {"name": "odd.bin", "mimeType": "", "buffer": odd})
    expect(page.locator("#image")).to_contain_text("odd.bin")
    album.take("dropped")
    page.click(f"#adapter button:text-is('{BikeFault.OFF.value}')")
    expect(page.locator("#trouble .what")).to_be_visible()
    album.take("no-one")
    _again(page)
    _use(page, BikeFault.HARDWARE)
    page.click("#answers-all")
    album.take("bike")
    page.click("#do-watch")
    expect(page.locator("#watched tbody tr").first).to_be_visible()
    album.take("watching")
    page.click("#stop")
    page.click("#do-areas")
    expect(page.locator("#area-1")).to_be_visible()
    album.take("areas")
    page.click("#area-1")
    expect(page.locator("#download")).to_be_visible()
    album.take("saved")
    page.click("#target-bms")
    page.click("#refused-all")
    page.click("#waive-2")
    album.take("images")
    page.check("#waive-2-risk")
    page.click("#waive-2-go")
    expect(page.locator("#go")).to_be_visible()
    album.take("checks")
    page.click("#do-compare")
    expect(page.locator("#compared")).to_be_visible()
    album.take("compared")
    _again(page)


def one_after_the_other(page: Page, place: BenchPlace, album: Album) -> None:
    """Lead the page through a series: each of its steps is held until its picture is taken."""
    _use(page, BikeFault.EXCHANGED)
    page.click("#target-bms")
    page.click(f"#image button:text-is('{IMAGE}')")
    page.click("#do-settings")
    album.take("settings")
    page.click("#go")
    expect(page.locator("#do-next-bikes")).to_be_enabled()
    album.take("more")
    steps = (SeriesStep.REMOVAL, SeriesStep.UNIT, SeriesStep.SHOWN)
    held = StepsHeld(place, *steps)
    page.click("#do-next-bikes")
    for step in steps:
        expect(page.locator(f"#series [data-step={step.value}]")).to_be_visible()
        album.take(f"series-{step.value}")
        if step is SeriesStep.SHOWN:
            page.click("#stop")
        held.go_on.set()
    expect(page.locator("#do-other")).to_be_enabled()
    page.click("#session-all")
    album.take("session")
    _again(page)


def whole_bike(page: Page, place: BenchPlace, album: Album) -> None:
    """Lead the page through a bike whose second device is stopped, and that is gone on with."""
    write_set(place.shelf.folder)
    _use(page, BikeFault.NONE)
    page.click("#target-bike")
    page.click(f"#image button:text-is('{SET}')")
    album.take("bike-set")
    held = Held(
        place,
        lambda event: (
            isinstance(event, events.PacketAcknowledged) and event.number == 3 and event.total == 5
        ),
    )
    page.click("#go")
    expect(page.locator("#pace .devices progress").nth(1)).to_have_attribute("value", "3")
    album.take("bike-running")
    page.click("#stop")
    held.go_on.set()
    expect(page.locator("#do-upgrade-bike")).to_be_enabled()
    album.take("bike-failed")
    page.click("#do-upgrade-bike")
    expect(page.locator("#do-upgrade-bike")).to_have_count(0)
    expect(page.locator("#next-bike")).to_be_enabled()
    album.take("bike-done")
    page.click("#sheet")
    album.take("bike-sheet")
    page.click("a[href='/']")
    _again(page)


class StepsHeld:
    """Holds a series at these steps, one after the other."""

    def __init__(self, place: BenchPlace, *steps: SeriesStep) -> None:
        self._left = list(steps)
        self.go_on = threading.Event()
        self._put = place.bench.feed.put
        place.bench.feed.put = self._hold  # type: ignore[method-assign]

    def _hold(self, subject: str, state: BenchState, *, word: object) -> None:
        self._put(subject, state, word=word)
        if state.series is not None and self._left[:1] == [state.series.step]:
            del self._left[0]
            self.go_on.wait(60)
            self.go_on.clear()


def from_an_upgrade_on(page: Page, place: BenchPlace, album: Album) -> None:
    """Lead the page through an upgrade that fails, its rescue, and what is left."""
    _use(page, BikeFault.POWER)
    page.click("#target-bms")
    page.click(f"#image button:text-is('{IMAGE}')")
    held = Held(
        place, lambda event: isinstance(event, events.PacketAcknowledged) and event.number == 5
    )
    page.click("#go")
    expect(page.locator("#pace progress")).to_be_visible()
    album.take("running")
    held.go_on.set()
    expect(page.locator("#do-rescue-it")).to_be_enabled()
    album.take("failed")
    page.click("#story")
    album.take("story")
    page.goto(page.url.partition("/kept")[0])
    page.click("#do-rescue-it")
    expect(page.locator("#go")).to_be_visible()
    album.take("rescue")
    held = Held(place, lambda event: isinstance(event, events.PowerCycleAwaited))
    page.click("#go")
    expect(page.locator("#pace progress")).to_be_visible()
    album.take("power")
    held.go_on.set()
    expect(page.locator("#next-bike")).to_be_enabled()
    album.take("good")
    page.click("#sheet")
    album.take("sheet")
    page.click("a[href='/']")
    page.click("#kept")
    album.take("kept")
    page.click("nav a[href='/']")
    expect(page.locator("#next-bike")).to_be_enabled()
    place.bench.feed.close()
    expect(page.locator("#ended")).to_be_visible()
    album.take("ended")


def album_of(browser: Browser, folder: Path, language: str) -> Album:
    """All pictures of a language."""
    with tempfile.TemporaryDirectory() as name:
        place = BenchPlace(Path(name))
        with place.served() as url:
            context = browser.new_context(locale=language)
            page = context.new_page()
            page.goto(url)
            expect(page.locator("#adapter-1")).to_be_enabled()
            album = Album(page, folder, language)
            before_an_upgrade(page, album)
            whole_bike(page, place, album)
            one_after_the_other(page, place, album)
            from_an_upgrade_on(page, place, album)
            context.close()
    return album


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--language", choices=sorted(NAMES), action="append")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    wrong: list[str] = []
    count = 0
    expect.set_options(timeout=60_000)  # many at once keep a computer busy
    with tempfile.TemporaryDirectory() as own, chromium() as browser:
        # Not the history, backups and bundles of this user.
        os.environ |= {f"XDG_{each}_HOME": own for each in ("CONFIG", "DATA", "STATE")}
        for language in options.language or NAMES:
            album = album_of(browser, options.folder, language)
            wrong += album.wrong
            count += album.count
    sys.stdout.writelines(f"{each}\n" for each in wrong)
    sys.stdout.write(f"{count} pictures, {len(wrong)} findings\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
