"""A bench with virtual bikes that take no time, and its page."""

from __future__ import annotations

import asyncio
import hashlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Concatenate, ParamSpec

from flasher.cli.look.backup import backup_folder
from flasher.cli.options import Bus
from flasher.cli.output import Output
from flasher.cli.recording import bundle_folder
from flasher.cli.stop import Stop
from flasher.cli.upgrade.bench_page import LastChoices, VirtualBikes
from flasher.cli.values import IMAGE_SUFFIXES, TRACE_SUFFIXES
from flasher.image.release import Release
from flasher.jobs import Job
from flasher.protocol.spec import BMS
from flasher.settings.manifest import manifest_path, to_toml
from flasher.web.archive import PAGES as KEPT
from flasher.web.archive import Archive
from flasher.web.bench import BenchController, Order
from flasher.web.bench_compare import watch_compared
from flasher.web.bench_page import UPLOADS, BenchPage, Shelf
from flasher.web.bench_state import Adapter, BenchState, UpgradeEnding
from flasher.web.guard import BrowserEntry, application
from flasher.web.pages import Pages
from flasher.web.query_processes import Answer, Question, answer_routes
from flasher.web.server import Server
from tests.end_to_end.stage import NEW, image_of

PACKETS = 20
IMAGE = "new.bin"
_KEY = "of the test"
P = ParamSpec("P")


def folder_of_images(folder: Path) -> Path:
    """With one image for every device, and one for none."""
    (folder / IMAGE).write_bytes(image_of(PACKETS, NEW).data)
    (folder / "broken.hex").write_text(":00")
    return folder


def write_manifest(image: Path, hardware: str) -> None:
    """The manifest of an image that is for this hardware of the battery only."""
    data = image.read_bytes()
    release = Release(
        target=BMS, size_bytes=len(data), sha256=hashlib.sha256(data).hexdigest(),
        hardware_versions=(hardware,), source="",
    )  # fmt: skip
    manifest_path(image).write_text(to_toml(release))


class HeldBikes(VirtualBikes):
    """`hold` is called with each event of an upgrade, in the bench's thread."""

    hold: Callable[[object], None] = staticmethod(lambda _event: None)

    def upgrade(
        self,
        adapter: Adapter,
        job: Job,
        *args: Any,
        **more: Any,
    ) -> UpgradeEnding:
        on_event = more.pop("on_event")

        def held(event: object) -> None:
            on_event(event)
            self.hold(event)

        return super().upgrade(adapter, job, *args, on_event=held, **more)


def order(
    step: Callable[Concatenate[BenchController, P], None], *args: P.args, **named: P.kwargs
) -> Order:
    """An order of this step, with its arguments."""
    return lambda bench: step(bench, *args, **named)


class BenchPlace:
    """A bench, without its thread."""

    def __init__(self, folder: Path, now: Callable[[], float] = lambda: 0.0) -> None:
        dropped = folder / "dropped"
        dropped.mkdir()
        self.shelf = Shelf(folder_of_images(folder), dropped, IMAGE_SUFFIXES, TRACE_SUFFIXES)
        bus = Bus(mock=True, mock_speed=0.0)
        output = Output(verbosity=-1)
        self.bikes = HeldBikes(bus, output, self.shelf, Stop(None), LastChoices())
        self.bench = BenchController(self.bikes, now)
        self.do(BenchController.find_adapters)

    def do(self, *orders: Order) -> BenchState:
        """Carry out orders; the state then."""
        for order in orders:
            self.bench.execute(order)
        return self.bench.state

    @contextmanager
    def served(self) -> Iterator[str]:
        """Its page, with its thread; gives the address that lets a browser in."""
        pages = Pages(remembers_language=True)
        kept = Archive(bundle_folder(), backup_folder(), self.shelf.traces)

        async def ask(question: Question) -> Answer:
            return await asyncio.to_thread(kept.answer, question)

        entry = BrowserEntry(pages)
        page = BenchPage(pages, self.bench, self.shelf, is_mock=True)
        app = application(
            [*page.routes, *answer_routes(pages, ask, KEPT)], hosts={"127.0.0.1"},
            secret=_KEY, entry=entry, uploads=UPLOADS,
        )  # fmt: skip
        worker = threading.Thread(target=self.bench.run, args=(watch_compared,), daemon=True)
        with Server(app, "127.0.0.1", 0) as server:
            worker.start()
            yield server.url.rstrip("/") + entry.path
            self.bench.close()
            worker.join()
            self.bench.feed.close()
