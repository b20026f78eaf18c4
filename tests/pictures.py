"""Pictures of the operator page: `python -m tests.pictures` makes the six of the guide,
`python -m tests.pictures --all FOLDER` every state of 1, 4, 8 and 16 sockets, light and dark, in
each language and size, and tells what does not fit.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal

from playwright.sync_api import Browser, Page, expect

from flasher.i18n import text
from flasher.station.codes import Code
from flasher.station.events import LineStopped, Progressed, ScanAccepted, ScanRefused, SocketState
from flasher.station.records.model import StepName
from flasher.translation import NAMES
from tests.web.browser import chromium
from tests.web.line_screen import AT, LineScreen, served
from tests.web.test_operator_page import LONGEST, SIZES, STATES, TOO_LARGE

GUIDE: Final = Path(__file__).parent.parent / "docs" / "pictures"
COUNTS: Final = (1, 4, 8, 16)
Scheme = Literal["light", "dark"]
_QUIET_MS: Final = 400


# -- what happens on the line ----------------------------------------------------------------------


def _at_work(line: LineScreen) -> None:
    """Four sockets in the middle of a shift."""
    serial = "BAT2620-{:04}".format
    line.state("1", SocketState.PASS, serial(11), Code.OK.action)
    line.state("2", SocketState.RUNNING, serial(12))
    line.say(Progressed("2", serial(12), StepName.FLASH, 0.62, 9.0, "bms", at=AT))
    line.state("3", SocketState.FAIL, serial(13), Code.REFUSED.action)
    line.state("4", SocketState.SCAN, "", text("Scan the label of the unit{card}.", card=""))
    line.say(ScanAccepted(serial(12), "label", "2", at=AT))


def _every_state(line: LineScreen) -> None:
    """The states over the sockets, again and again."""
    names = list(line.board.rows)
    for state, name in zip(itertools.cycle(STATES), names, strict=False):
        serial = "" if state in (SocketState.EMPTY, SocketState.SILENT) else "BAT2620-0005"
        line.state(name, state, serial, LONGEST)
        if state is SocketState.RUNNING:
            line.say(Progressed(name, serial, StepName.FLASH, 0.4, 75.0, "bms", at=AT))


def _refused(line: LineScreen) -> None:
    _at_work(line)
    reason = text("It was scanned already.")
    wanted = text("Connect {label}.", label="BAT2620-0014")
    remedy = text("{wanted} Or scan {way}.", wanted=wanted, way="CANCEL")
    line.say(ScanRefused("BAT2620-0014", "DOUBLE_SCAN", reason, remedy, at=AT))


def _stopped(line: LineScreen) -> None:
    _at_work(line)
    line.say(LineStopped("RECORD_NOT_SAVED", "The disk is full.", "Make room on the disk.", at=AT))


def _gone(line: LineScreen) -> None:
    _at_work(line)


# -- the pictures ----------------------------------------------------------------------------------


def take(
    browser: Browser,
    path: Path,
    happens: Callable[[LineScreen], None],
    *,
    count: int = 4,
    size: str = "laptop",
    scheme: Scheme = "light",
    language: str = "en",
    covered: bool = False,
) -> list[str]:
    """One picture; returns what does not fit on it."""
    line = LineScreen(*(str(number + 1) for number in range(count)))
    width, height = SIZES[size]
    page: Page = browser.new_page(
        viewport={"width": width, "height": height}, color_scheme=scheme, locale=language
    )
    with served(line) as url:
        page.goto(f"{url}line?lang={language}")
        expect(page.locator("article")).to_have_count(count)
        happens(line)
        page.wait_for_timeout(_QUIET_MS)
        found: list[str] = page.evaluate(TOO_LARGE)
        if not covered:
            page.screenshot(path=path)
    if covered:  # its server is gone
        expect(page.locator("#cover")).to_be_visible(timeout=3000)
        page.screenshot(path=path)
    page.close()
    line.hang()
    return found


def guide(browser: Browser) -> None:
    """The six pictures of docs/how-to/station.md."""
    GUIDE.mkdir(exist_ok=True)
    take(browser, GUIDE / "line-4.png", _at_work)
    take(browser, GUIDE / "line-16-dark.png", _every_state, count=16, scheme="dark")
    take(browser, GUIDE / "line-refused-de.png", _refused, language="de")
    take(browser, GUIDE / "line-stopped.png", _stopped)
    take(browser, GUIDE / "line-not-connected.png", _gone, covered=True)
    take(browser, GUIDE / "line-phone-zh.png", _at_work, size="phone", language="zh")


def everything(browser: Browser, folder: Path) -> int:
    """All of them; returns how many do not fit."""
    folder.mkdir(parents=True, exist_ok=True)
    bad = 0
    schemes: tuple[Scheme, ...] = ("light", "dark")
    for count, size, scheme, language in itertools.product(COUNTS, SIZES, schemes, NAMES):
        for shift in range(0, len(STATES), count) if count < len(STATES) else (0,):

            def happens(line: LineScreen, shift: int = shift) -> None:
                for state, name in zip(
                    itertools.cycle(STATES[shift:] + STATES[:shift]), line.board.rows, strict=False
                ):
                    line.state(name, state, "BAT2620-0005", LONGEST)

            name = f"{count:02}-{size}-{scheme}-{language}-{shift}.png"
            found = take(
                browser, folder / name, happens,
                count=count, size=size, scheme=scheme, language=language,
            )  # fmt: skip
            bad += bool(found)
            if found:
                sys.stdout.write(f"{name}: {found}\n")
    sys.stdout.write(f"{len(list(folder.glob('*.png')))} pictures, {bad} do not fit\n")
    return bad


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--all", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    with chromium() as browser:
        if options.all is None:
            guide(browser)
            return 0
        return 1 if everything(browser, options.all) else 0


if __name__ == "__main__":
    sys.exit(main())
