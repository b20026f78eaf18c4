"""Harness of the bench page: its requests, the orders in them, the files that are dropped on it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from queue import Empty
from typing import Final

from starlette.types import ASGIApp

from flasher.translation import ENGLISH
from flasher.web.archive import PAGES as KEPT
from flasher.web.archive import Archive
from flasher.web.bench import BenchController
from flasher.web.bench_page import _ORDERS, UPLOAD, UPLOADS, BenchPage
from flasher.web.guard import application
from flasher.web.pages import Pages
from flasher.web.query_processes import Answer, Question, answer_routes
from tests.fuzz import browser
from tests.fuzz.harness import Harness, own_folder
from tests.hostile import good
from tests.web.bench_place import IMAGE, BenchPlace

_DEVICE_ORDERS: Final = ("adapter", "look", "watch", "areas", "backup", "upgrade", "rescue-it")
"""Orders that talk to a virtual bike if nothing is wrong with them. They are stopped at once: what
they do then is not for a browser to choose.
"""
_FIELDS: Final = (
    "order", "name", "source", "waiver", "path", "target", "selection", "risk", "bundle", "trace",
    "serial", "save",
)  # fmt: skip


class _Bench:
    """A bench where an image is chosen. Each request finds it so."""

    def __init__(self) -> None:
        self.place = BenchPlace(own_folder())
        bench = self.bench = self.place.bench
        adapter = bench.state.adapters[0].name
        self.place.do(
            lambda bench: bench.use_adapter(adapter),
            lambda bench: bench.choose_target("bms"),
            lambda bench: bench.choose_image(IMAGE),
        )
        assert bench.state.offer is not None
        self.ready = bench.state
        kept = Archive(own_folder(), own_folder(), self.place.shelf.traces)

        async def ask(question: Question) -> Answer:
            return kept.answer(question)

        pages = Pages()
        self.page = BenchPage(pages, bench, self.place.shelf, is_mock=True)
        self.app: ASGIApp = application(
            [*self.page.routes, *answer_routes(pages, ask, KEPT)],
            hosts={"127.0.0.1"},
            secret=browser.SECRET,
            uploads=UPLOADS,
        )
        self.folder = self.place.shelf.folder
        self.files = self._files()

    def _files(self) -> set[Path]:
        return set(self.folder.rglob("*"))

    def ask(self, request: bytes) -> browser.Answered:
        bench, shelf = self.bench, self.place.shelf
        bench.state, shelf.folder = self.ready, self.folder
        answered = browser.send(self.app, request, browser.cookie({}))
        with suppress(Empty):
            self._carry_out(request)
        if bench._has_new_files.is_set():
            bench.execute(BenchController.take_files)
        if bench.state is not self.ready:
            self.page._parts(ENGLISH, bench.state)
        trouble = bench.state.trouble
        assert trouble is None or not trouble.what.startswith("Internal error"), trouble
        return answered

    def _carry_out(self, request: bytes) -> None:
        order = self.bench._orders.get_nowait()
        if json.loads(request.partition(b"\n\n")[2])["order"] in _DEVICE_ORDERS:
            self.bench.stop()
        self.bench.execute(order)

    def clear(self) -> None:
        """Remove what was dropped. Raises AssertionError if a file is elsewhere."""
        for path in self._files() - self.files:
            assert path.parent in (self.folder / "dropped", self.place.shelf.traces), path
            path.unlink()


@cache
def _bench() -> _Bench:
    return _Bench()


def take_request(data: bytes) -> None:
    bench = _bench()
    try:
        answered = bench.ask(data)
        if answered.status == 200 and b'"page"' in answered.body:
            page = json.loads(answered.body)["page"]
            bench.ask(f"GET {page}".encode())
    finally:
        bench.clear()


def _requests() -> Iterator[bytes]:
    upload = f"POST {UPLOAD}?name=".encode()
    for path in ("/", "/bench/events", "/bench/sheet", "/bench/sheet?save", *KEPT):
        yield f"GET {path}".encode()
    yield b"GET /kept?serial=W1&lang=de"
    yield b"GET /kept/story?trace=x.log"
    for word, (_, fields) in _ORDERS.items():
        values = {"order": word, **dict.fromkeys(fields, "x")}
        if word == "waive":
            values["risk"] = "known"
        yield b"POST /bench/order\n\n" + json.dumps(values).encode()
    for word, name in (("target", "wmc"), ("target", ""), ("image", IMAGE), ("folder", "/nowhere")):
        field = "path" if word == "folder" else "name"
        yield b"POST /bench/order\n\n" + json.dumps({"order": word, field: name}).encode()
    yield b'POST /bench/order\n\n{"order": "stop"}'
    yield b'POST /bench/order\n\n{"order": "agree", "question": "x"}'
    yield b"GET /kept/story?trace=" + browser.MARK + b">"
    yield upload + browser.MARK + b">.hex\n\n:00"
    # These broke it.
    yield b"POST /bench/order\n\n" + b"[" * 2000
    yield b'POST /bench/order\n\n{"order": "adapter", "name": []}'
    yield b'POST /bench/order\n\n{"order": "adapter", "shown_at": 1' + b"0" * 400 + b"}"
    yield b'POST /bench/order\n\n{"order": "image", "name": 3}'
    yield b'POST /bench/order\n\n{"order": "folder", "path": "~no_such_user"}'
    yield b'POST /bench/order\n\n{"order": "folder", "path": "' + b"a" * 1000 + b'"}'
    yield upload + b"x.hex\n\n:00000001FF\n"
    yield upload + b"x.bin\n\n" + bytes(range(64))
    yield upload + b"x.bin.toml\n\n" + b"format = 1\n"
    yield upload + b"x.log\n\n" + good.trace(own_folder() / "trace.log")
    yield upload + b"..%2Fx.exe\n\nMZ"


HARNESSES: Final = {
    "bench-pages": Harness(
        take_request,
        _requests,
        "flasher.web.guard._name_of",
        max_size=2048,
        words=lambda: [
            *browser.words(["/bench/order", UPLOAD, "/bench/sheet", *KEPT], _FIELDS),
            *(f'"{word}"' for word in _ORDERS),
            *(".hex", ".s19", ".elf", ".toml", ".log", ".asc", ".blf", ".csv", ".trc"),
        ],
    ),
}
