"""Questions of people who see the site for the first time, and the way to each answer.

    python -m tests.site

checks that the answer is at most two clicks from the front page, by links in the text alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from tests.site.pages import Site

CLICKS_MAX: Final = 2


class Question(NamedTuple):
    """Who asks what, where the answer is, and words of the answer."""

    who: str
    asks: str
    page: str
    answer: str


QUESTIONS: Final = (
    Question(
        "service",
        "My adapter is a CANable, on Windows: what does it need, and which arguments use it?",
        "how-to/adapters.html#windows",
        "-i gs_usb -c 0",
    ),
    Question(
        "service",
        "The laptop died in the middle of an upgrade, and the bike does not start. What now?",
        "how-to/rescue.html",
        "power-cycle the device now",
    ),
    Question(
        "service",
        "It ends with exit code 5, no answer. What is it mostly, and what do I try?",
        "how-to/symptoms.html#the-device-does-not-answer",
        "asleep, switched off, another target",
    ),
    Question(
        "service",
        "Which versions and which serial number has this battery?",
        "how-to/read.html",
        "firmware version",
    ),
    Question(
        "service",
        "Does a flash keep odometer and settings?",
        "how-to/questions.html#does-a-flash-keep-odometer-and-settings",
        "flasher writes no setting in it",
    ),
    Question(
        "service",
        "Can all three devices be upgraded in one go?",
        "how-to/questions.html#can-all-three-devices-be-upgraded-in-one-go",
        "flasher flash --bike SET",
    ),
    Question(
        "service",
        "Can it be installed without Python?",
        "how-to/questions.html#can-it-be-installed-without-python",
        "a folder with a Python of its own",
    ),
    Question(
        "service",
        "How do I update flasher?",
        "how-to/questions.html#how-is-flasher-updated",
        "git pull",
    ),
    Question(
        "line",
        "How many sockets can a PC run?",
        "how-to/questions.html#how-many-sockets-can-a-pc-run",
        "flasher sets no limit",
    ),
    Question(
        "line",
        "How does a socket find its own adapter after the PC was started anew?",
        "how-to/station_pc.html",
        "by its serial number or by its place on the USB",
    ),
    Question(
        "line",
        "The screen says FAIL, LIMIT. Is the unit bad, and where does it go?",
        "reference/station_codes.html",
        "a measurement is out of its limits",
    ),
    Question(
        "line",
        "The power failed during the shift. Which units are scanned again?",
        "how-to/station_run.html#when-something-is-wrong",
        "the runs that were open are INTERRUPTED",
    ),
    Question(
        "line",
        "How does an auditor see that the records are unchanged?",
        "how-to/station_records.html#detect-changed-records",
        "compares the trail with its hashes",
    ),
    Question(
        "bootloader",
        "A packet comes a second time. May my bootloader answer NAK with the next number?",
        "explanation/readings.html#r10",
        "NAK n+1",
    ),
    Question(
        "bootloader",
        "How does my build fail when the bootloader got worse or slower?",
        "how-to/conformance_ci.html",
        "either exit code fails the job",
    ),
)


def ways(site: Site) -> dict[Path, list[Path]]:
    """The shortest way from the front page to each page, without the front page itself."""
    front = site.folder / "index.html"
    found: dict[Path, list[Path]] = {front: []}
    waiting = [front]
    for path in waiting:
        for link in site.pages[path].noted:
            target = site.target(site.pages[path], link) if "://" not in link else None
            if target in site.pages and target not in found:
                found[target] = [*found[path], target]
                waiting.append(target)
    return found


def unanswered(site: Site) -> Iterator[str]:
    """The questions whose answer is not there, or too far away."""
    known = ways(site)
    for question in QUESTIONS:
        name, _, anchor = question.page.partition("#")
        path = site.folder / name
        page = site.pages.get(path)
        if page is None or anchor not in page.anchors or question.answer not in _plain(page.text):
            yield f"{question.page} does not answer: {question.asks}"
        elif path not in known or len(known[path]) > CLICKS_MAX:
            yield f"{question.page} is more than {CLICKS_MAX} clicks from the front page"


def noted(site: Site) -> Iterator[str]:
    """Each question with its way."""
    known = ways(site)
    for question in QUESTIONS:
        path = site.folder / question.page.partition("#")[0]
        way = " > ".join(step.relative_to(site.folder).as_posix() for step in known[path])
        yield f"{question.who}: {question.asks}\n    {way}"


def _plain(text: str) -> str:
    return " ".join(text.split())
