"""Harnesses of the station's pages: operator page, supervisor pages, sign-in, certificates."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Final

from starlette.types import ASGIApp

from flasher.station.attempts import Attempts
from flasher.station.records.model import RunState
from flasher.station.scans import understand
from flasher.station.shift_counts import DEFAULT_SHIFTS
from flasher.web.feed import Feed
from flasher.web.login import LOGIN, SIGN_INS, SIGN_OUT, Badges, Login
from flasher.web.operator import LINE, OperatorPage
from flasher.web.pages import Pages
from flasher.web.query_processes import RUN
from flasher.web.sign_ins import SignIns
from flasher.web.supervisor import CHECK, PAGES, open_supervisor
from tests.fuzz import browser
from tests.fuzz.harness import Harness, own_folder
from tests.station.factory import Bench, FakeClock
from tests.station.line_bench import AtOnce
from tests.web.answering import app_with
from tests.web.test_login import PEOPLE, PIN

_NOBODY: Final = b"!"
"""Before a request of a browser without a sign-in."""
_FIELDS: Final = (
    "serial", "part", "lot", "recipe", "from", "to", "search", "outcome", "code", "socket", "by",
    "image", "sha256", "event", "before", "after", "token", "badge", "pin", "password", "number",
    "all", "everywhere", "text",
)  # fmt: skip
_PDF: Final = (
    b"%PDF-1.4\n1 0 obj<</Type/Catalog/Pages 2 0 R>>endobj\n"
    b"2 0 obj<</Type/Pages/Kids[3 0 R]/Count 1>>endobj\n"
    b"3 0 obj<</Type/Page/Parent 2 0 R/MediaBox[0 0 300 300]/Contents 4 0 R"
    b"/Resources<</Font<</F1 5 0 R>>>>>>endobj\n"
    b"4 0 obj<</Length 46>>stream\nBT /F1 12 Tf 10 10 Td (flasher record 1) Tj ET\n"
    b"endstream endobj\n5 0 obj<</Type/Font/Subtype/Type1/BaseFont/Helvetica>>endobj\n"
    b"trailer<</Root 1 0 R>>\n"
)


@dataclass
class _Station:
    """Pages of records with a few runs. Who signed in, and how often it was tried, is forgotten
    before each request.
    """

    app: ASGIApp
    login: Login
    clock: FakeClock

    def ask(self, request: bytes) -> browser.Answered:
        is_signed_out = request.startswith(_NOBODY)
        self.login._attempts = Attempts()
        self.login.sign_ins = SignIns(self.clock, lambda _event, _data: None)
        session = {}
        if not is_signed_out:
            supervisor = next(each for each in PEOPLE if each.name == "Sue")
            session["sign_ins"] = self.login.sign_ins.begin(supervisor, "192.0.2.1", [])
        return browser.send(self.app, request.removeprefix(_NOBODY), browser.cookie(session))


@cache
def _station() -> _Station:
    bench = Bench(own_folder())
    for number in (1, 2, 3):
        serial = f"W260500{number}"
        if number == 2:
            bench.make(RunState.FAIL, serial, lot="L1", code="NO_ANSWER")
        bench.make(RunState.PASS, serial, lot="L1")
    pages = Pages()
    badges = Badges(
        PEOPLE,
        needs_pin=True,
        is_supervised=lambda path: path != "/" and not path.startswith(LINE),
        are_for_all=False,
    )
    login = Login(pages, bench.clock, lambda _event, _data: None, checker=AtOnce(), badges=badges)
    scans: deque[object] = deque(maxlen=1)
    operator = OperatorPage(
        pages,
        Feed(time.perf_counter, silence_limit_s=1.0),
        lambda scan, _source: scans.append(understand(scan)),
        sound_volume=0.5,
    )
    folder = bench.path.with_name(f"{bench.path.name}.files")
    supervisor = open_supervisor(str(bench.path), folder, bench.key_locations, DEFAULT_SHIFTS)
    app = app_with(supervisor, login, *operator.routes, secret=browser.SECRET)
    return _Station(app, login, bench.clock)


def take_request(data: bytes) -> None:
    _station().ask(data)


def _requests() -> Iterator[bytes]:
    for path in PAGES:
        yield f"GET {path.replace(RUN, '1')}".encode()
    yield b"GET /units?serial=W2605002&lang=de"
    yield b"GET /units?serial=W2605002&part=BAT-36&before=3\naccept-language: zh, de;q=0.5"
    yield b"GET /units/certificate?serial=W2605001"
    yield b"GET /runs?search=w26&outcome=pass&from=2026-05-01&to=2026-06-01T12:00&code=OK&socket=A"
    yield b"GET /runs.csv?lot=L1&recipe=Battery+36+V&after=1"
    for by in ("socket", "recipe", "lot", "shift"):
        yield f"GET /yield?by={by}&from=2025-01-01".encode()
    yield b"GET /images?image=BMS&sha256=0&before=9"
    yield b"GET /audit?event=run&from=2026-05-17"
    yield b"HEAD /times?lang=zh"
    yield b"GET " + SIGN_INS.encode()
    for path in ("/", LINE, f"{LINE}/events", LOGIN):
        yield f"GET {path}".encode()
        yield f"!GET {path}".encode()
    yield f'POST {LINE}/scan\n\n{{"text": "W2605004"}}'.encode()
    yield f'POST {LINE}/scan\n\n{{"text": "SOCKET A"}}'.encode()
    yield f'POST {LINE}/scan\n\n{{"text": "SOCKET A", "shown_at": 1{"0" * 400}}}'.encode()
    for fields in (f"badge=BADGE-2&pin={PIN}", "badge=BADGE-3", "password=x", "badge=&pin="):
        yield f"!POST {LOGIN}\n\ntoken={browser.TOKEN}&{fields}".encode()
    yield f"POST {SIGN_OUT}\n\ntoken={browser.TOKEN}&everywhere=1".encode()
    yield f"POST {SIGN_INS}/end\n\ntoken={browser.TOKEN}&number=1".encode()
    yield f"POST {SIGN_INS}/end\n\ntoken={browser.TOKEN}&all=1".encode()
    yield f"POST {CHECK}\n\nflasher record 1\n".encode()
    for path in (
        "/runs?search=",
        "/images?image=",
        "/audit?event=",
        "/units?serial=W2605002&lang=",
    ):
        yield f"GET {path}".encode() + browser.MARK + b">"
    # These broke it.
    yield f"POST {LINE}/scan\n\n".encode() + b"[" * 2000
    yield b"GET /yield?to=0001-01-05"
    yield b"GET /yield?from=0001-01-02&by=shift"
    yield b"GET /times?to=9999-12-31T23:59"
    yield b"GET /runs/99999999999999999999"


# -- certificates ----------------------------------------------------------------------------------


def take_certificate(data: bytes) -> None:
    answered = _station().ask(f"POST {CHECK}\n\n".encode() + data)
    assert answered.status == 200, answered.status


def _certificates() -> Iterator[bytes]:
    whole = _station().ask(b"GET /units/certificate.html?serial=W2605002").body
    yield whole
    yield _PDF


HARNESSES: Final = {
    "station-pages": Harness(
        take_request,
        _requests,
        "flasher.web.guard._name_of",
        max_size=2048,
        words=lambda: browser.words([*PAGES, LINE, LOGIN, SIGN_INS, SIGN_OUT], _FIELDS),
    ),
    "certificate": Harness(
        take_certificate, _certificates, "flasher.web.guard._name_of", max_size=65_536
    ),
}
