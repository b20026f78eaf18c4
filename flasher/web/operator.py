"""Operator page: tiles of the sockets, header, footer, overlay of a stopped or silent station.

`Screen` receives the station's events in the station's thread; the page follows its `Feed`.
"""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route

from flasher.files import parse_json
from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.report.scale import share_text
from flasher.station.board import Board, Replies, Row, shown
from flasher.station.events import (
    LineStopped,
    OfferedRecipe,
    RecipesOffered,
    RunEnded,
    SocketState,
    StationEvent,
)
from flasher.station.health import HealthCheck, HealthWatch
from flasher.station.records.model import RunState
from flasher.station.shift_counts import ShiftCounts, ShiftFigures
from flasher.station.socket import PAGE, Source
from flasher.translation import Translator
from flasher.web.feed import Feed, is_late, page_time
from flasher.web.pages import Pages, streamed

TAIL_DIGITS: Final = 6
"""Digits of a serial number in large type, enough to distinguish the units of a bench."""
_PAGE_DIGITS: Final = 8
"""Digits of a page's id."""
SCAN_MAX: Final = 300
"""Maximum length of a scan from a page."""
HEAD_EVERY_S: Final = 0.1
SILENCE_LIMIT_S: Final = 1.5
"""Time without a turn of the station's loop after which the page shows the station as silent."""
_HEAD: Final = "head"
LINE: Final = "/line"
"""Path of the page, and prefix of its requests."""

WORDS: Final = {
    SocketState.STARTING: text("STARTING"),
    SocketState.EMPTY: text("EMPTY"),
    SocketState.SILENT: text("NO UNIT?"),
    SocketState.SCAN: text("SCAN"),
    SocketState.RUNNING: text("RUNNING"),
    SocketState.SAVING: text("SAVING"),
    SocketState.PASS: text("PASS"),
    SocketState.FAIL: text("FAIL"),
    SocketState.RECHECK: text("RECHECK"),
    SocketState.ERROR: text("ERROR"),
    SocketState.STOPPED: text("STOPPED"),
}
"""State in large letters on a tile."""


@dataclass(frozen=True)
class CurrentLot:
    """The current lot; `size` is its number of units, 0 if unknown."""

    name: str
    size: int = 0
    good: int = 0


@dataclass(frozen=True)
class ScreenHeader:
    """Content of the page apart from the sockets."""

    station: str
    recipe: str
    part: str
    operator: str
    lot: CurrentLot
    virtual: str
    output: ShiftFigures
    health: tuple[HealthCheck, ...]
    stopped: LineStopped | None
    replies: Replies
    is_secret: bool
    """Typed characters must be hidden."""
    offered: RecipesOffered | None = None

    def to_json(self, translate: Translator, source: Source) -> dict[str, Any]:
        """The header in a language, for the page of the session `source`."""
        stopped, lot, reply = self.stopped, self.lot, self.replies.to(source.name)
        name = lot.name or translate(text("no lot"))
        left = max(lot.size - lot.good, 0)
        return {
            "station": self.station,
            "recipe": self.recipe,
            "part": self.part,
            "operator": translate(self.operator),
            "lot": translate(text("{name}, {left} left"), name=name, left=left)
            if lot.size
            else name,
            "virtual": translate(self.virtual),
            "spoken": translate(reply.text),
            "is_refusal": reply.is_refusal,
            "is_secret": self.is_secret,
            "stopped": None
            if stopped is None
            else {
                "code": stopped.code,
                "reason": translate(stopped.reason),
                "remedy": translate(stopped.remedy),
            },
            "hour": _counted(self.output.hour, translate),
            "shift": _counted(self.output.shift, translate),
            "first": translate.numbers(share_text(self.output.first_pass_share)),
            "causes": [f"{code} {count}" for code, count in self.output.causes],
            "health": [
                {
                    "name": translate(check.name),
                    "is_good": check.is_good,
                    "text": translate(check.text),
                }
                for check in self.health
            ],
            "offered": [
                _offer(each, translate) for each in (self.offered.offered if self.offered else ())
            ],
            "withdrawn": translate(
                text("withdrawn by the plant: no unit begins in {sockets}"),
                sockets=", ".join(map(printable, self.offered.withdrawn)),
            )
            if self.offered and self.offered.withdrawn
            else "",
        }


def _offer(offer: OfferedRecipe, translate: Translator) -> dict[str, Any]:
    """A recipe that waits for its approval."""
    published = text(
        "published {at} by {name}",
        at=f"{datetime.fromisoformat(offer.published_at).astimezone():%Y-%m-%d %H:%M}",
        name=printable(offer.published_by),
    )
    return {
        "recipe": printable(offer.recipe),
        "digest": offer.digest,
        "sockets": ", ".join(map(printable, offer.sockets)),
        "published": translate(published),
        "changes": [translate(each) for each in offer.changes]
        or [translate(text("no difference in what it does"))],
        "scan": offer.scan,
        "problem": translate(shown(offer.problem)),
    }


def _counted(count: tuple[int, int], translate: Translator) -> str:
    return translate(text("{good} good, {bad} bad"), good=count[0], bad=count[1])


def _left(left_s: float, translate: Translator) -> str:
    whole = round(max(left_s, 0.0))
    sentence = f"{whole} s" if whole < 100 else f"{whole // 60}:{whole % 60:02d} min"
    return translate(text("{time} left"), time=sentence)


def _tile(row: Row, translate: Translator) -> dict[str, Any]:
    """The tile of a socket in a language, for the page's script."""
    serial = row.serial or row.virtual_label
    return {
        "socket": row.socket,
        "state": row.state.value.lower(),
        "word": translate(WORDS[row.state]),
        "serial": serial,
        "tail": serial[-TAIL_DIGITS:],
        "is_label": bool(row.serial),
        "share": row.share,
        "left": "" if row.left_s is None else _left(row.left_s, translate),
        "step": translate(row.step),
        "code": row.code,
        "line": translate(row.note),
        "virtual": translate(text("virtual unit: no product")) if row.is_virtual else "",
    }


class Screen:
    """State of the page, from a station's events. Methods are called in the station's thread."""

    def __init__(self, tally: ShiftCounts, watch: HealthWatch) -> None:
        self.feed = Feed(time.perf_counter, silence_limit_s=SILENCE_LIMIT_S)
        self._tally = tally
        self._watch = watch
        self._turned_at = float("-inf")
        self._passed: dict[str, RunEnded] = {}
        """Runs that ended with PASS whose units are still in their sockets."""

    def show(self, event: StationEvent, board: Board) -> None:
        """Update after the board has applied an event."""
        if isinstance(event, RunEnded):
            self._tally.add(event.run)
            self._passed.pop(event.socket, None)
            if event.run.state is RunState.PASS:
                self._passed[event.socket] = event
        socket = getattr(event, "socket", "")
        for name in (socket,) if socket in board.rows else tuple(board.rows):
            row = board.rows[name]
            state, passed = row.state, self._passed.get(name)
            # Show PASS only after `RunEnded`, which is published when the run is on disk.
            if state is SocketState.PASS and (passed is None or passed.serial != row.serial):
                state = SocketState.SAVING
            word = (state, row.serial, row.code, row.note, row.step)
            self.feed.put(f"socket {name}", replace(row, state=state), word=word)

    def turn(self, board: Board, *, operator: str, lot: CurrentLot) -> None:
        """Update figures and health; called in each turn of the station's loop."""
        self.feed.beat()
        now = time.perf_counter()
        if now - self._turned_at < HEAD_EVERY_S:
            return
        self._turned_at = now
        head = ScreenHeader(
            board.station,
            board.recipe,
            board.part,
            operator,
            lot,
            board.virtual_words,
            self._tally.output(datetime.now().astimezone()),
            self._watch.look(board),
            board.stopped,
            board.replies,
            bool(board.pin_of),
            board.offered,
        )
        word = (head.stopped, head.replies, head.is_secret, head.offered)
        self.feed.put(_HEAD, head, word=word)


class OperatorPage:
    """Routes of the page. `submit` passes a scan to the station; its source is the session."""

    def __init__(
        self,
        pages: Pages,
        feed: Feed,
        submit: Callable[[str, Source], None],
        *,
        sound_volume: float,
    ) -> None:
        self._pages = pages
        self._sound_volume = sound_volume
        self._feed = feed
        self._submit = submit

    @property
    def routes(self) -> list[BaseRoute]:
        return [
            Route("/", self._start),
            Route(LINE, self._page),
            Route(f"{LINE}/events", self._events),
            Route(f"{LINE}/scan", self._scan, methods=["POST"]),
        ]

    async def _start(self, request: Request) -> Response:
        query = f"?{request.url.query}" if request.url.query else ""
        return RedirectResponse(f"{LINE}{query}", 303)

    async def _page(self, request: Request) -> Response:
        return self._pages.show(request, "line.html", sound_volume=self._sound_volume)

    async def _events(self, request: Request) -> Response:
        translate = self._pages.translator_of(request)
        return streamed(_messages(self._feed, translate, _source_of(request)))

    async def _scan(self, request: Request) -> Response:
        try:
            scan = parse_json(await request.body())
            text, shown_at = scan["text"], scan["shown_at"]
        except (ValueError, TypeError, KeyError):
            return JSONResponse({"error": "no scan"}, 400)
        if not isinstance(text, str) or not text.strip() or len(text) > SCAN_MAX:
            return JSONResponse({"error": "no scan"}, 400)
        if is_late(shown_at):
            return JSONResponse({"error": "late"}, 409)
        # The station answers it by an event, which every page shows.
        await asyncio.to_thread(self._submit, text, _source_of(request))
        return JSONResponse({})


def _source_of(request: Request) -> Source:
    """Public id of a browser's session, without its secret token."""
    token = str(request.session["token"]).encode()
    return Source(PAGE + hashlib.sha256(token).hexdigest()[:_PAGE_DIGITS])


async def _messages(
    feed: Feed, translate: Translator, source: Source
) -> AsyncIterator[dict[str, Any]]:
    async for batch in feed.follow():
        message: dict[str, Any] = {"at": page_time()}
        if batch.is_all:
            message["all"] = True
        tiles = [_tile(state, translate) for _, state in batch.changes if isinstance(state, Row)]
        heads = [state for _, state in batch.changes if isinstance(state, ScreenHeader)]
        if tiles:
            message["tiles"] = tiles
        if heads:
            message["head"] = heads[-1].to_json(translate, source)
        yield message
