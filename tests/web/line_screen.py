"""An operator page without a station: a test says what happens, and sees what is made of it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from flasher.station.board import Board
from flasher.station.events import (
    RunEnded,
    SocketChanged,
    SocketState,
    StationEvent,
    StationStarted,
)
from flasher.station.health import HealthWatch
from flasher.station.records.model import RunState
from flasher.station.shift_counts import ShiftCounts
from flasher.station.socket import Source
from flasher.web.guard import application
from flasher.web.operator import CurrentLot, OperatorPage, Screen
from flasher.web.pages import Pages
from flasher.web.server import Server
from tests.station.line_inputs import saved

_KEY = "of the test"
AT = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class LineScreen:
    """A station of which only the events are there. It turns in a thread until `hang`."""

    def __init__(self, *sockets: str) -> None:
        self.board = Board()
        self.scans: list[str] = []
        self.sources: list[Source] = []
        """Where each was scanned."""
        self.screen = Screen(
            ShiftCounts(), HealthWatch(Path("/"), lambda: datetime.now(UTC), lambda: 0.0)
        )
        self.operator = "Jo"
        self.lot = CurrentLot("L17", 500, 12)
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._turn, daemon=True)
        self._sockets = sockets
        self.url = ""
        """Where its page is served."""
        self.begin_anew()
        self._thread.start()

    def begin_anew(self) -> None:
        """As a station that was just started, for the next test on the same page."""
        with self._lock:
            self.board = Board()
            self.screen._passed.clear()
        self.scans.clear()
        self.sources.clear()
        sockets = self._sockets
        self.say(StationStarted("line-2", "Battery 36 V", "7", "BAT-36-10", sockets, (), at=AT))
        for name in sockets:
            self.state(name, SocketState.EMPTY)

    def take(self, text: str, source: Source) -> None:
        self.scans.append(text)
        self.sources.append(source)

    def say(self, event: StationEvent) -> None:
        with self._lock:
            self.board.apply(event)
            self.screen.show(event, self.board)

    def state(self, socket: str, state: SocketState, serial: str = "", text: str = "") -> None:
        """A socket shows a state; PASS and FAIL with the end of their run."""
        if state.is_verdict:
            self.say(
                ended(socket, serial, RunState.PASS if state.value == "PASS" else RunState.FAIL)
            )
        self.say(SocketChanged(socket, state, serial, text, at=AT))

    def hang(self) -> None:
        """The station's loop turns no more."""
        self._ended.set()
        self._thread.join()

    def _turn(self) -> None:
        while not self._ended.wait(0.05):
            with self._lock:
                self.screen.turn(self.board, operator=self.operator, lot=self.lot)


def ended(socket: str, serial: str, outcome: RunState, code: str = "REFUSED") -> RunEnded:
    code = "OK" if outcome is RunState.PASS else code
    at = datetime.fromisoformat(AT)
    return saved(
        socket, outcome, "Take the unit out.", serial=serial, code=code, begun_at=at, ended_at=at
    )


@contextmanager
def served(line: LineScreen, port: int = 0, *, closes_feed: bool = True) -> Iterator[str]:
    """The page of a line while the block runs; gives its address."""
    pages = Pages()
    app = application(
        OperatorPage(pages, line.screen.feed, line.take, sound_volume=0.3).routes,
        hosts={"127.0.0.1"}, secret=_KEY,
    )  # fmt: skip
    with Server(app, "127.0.0.1", port) as server:
        line.url = server.url
        try:
            yield server.url
        finally:
            if closes_feed:
                line.screen.feed.close()


def tile(page: Any, socket: str) -> SimpleNamespace:
    """What the page shows of a socket."""
    shown = page.evaluate(
        """(socket) => {
          const article = [...document.querySelectorAll("article")]
            .find((each) => each.querySelector(".name").textContent === socket);
          const text = (name) => article.querySelector("." + name).textContent;
          return {state: article.dataset.state, word: text("word"), tail: text("tail"),
                  what: text("what")};
        }""",
        socket,
    )
    return SimpleNamespace(**shown)
