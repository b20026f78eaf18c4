"""Bench page of `flasher ui`: adapters, virtual bikes, recordings, history, and the server."""

from __future__ import annotations

import contextlib
import json
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Unpack

import click
from platformdirs import user_state_path

from flasher.api import CallOptions, Connection
from flasher.bus.opening import bus_config
from flasher.bus.physical import is_physical
from flasher.cli.adapters import describe_adapter, detect_until, slcan_ports, with_adapter
from flasher.cli.files import write_whole
from flasher.cli.look.backup import DEVICE_MODEL, backup_folder, backup_of, own_backup_path
from flasher.cli.options import Bus
from flasher.cli.output import Output
from flasher.cli.recording import Recording, RecordingOptions, bundle_folder, recording
from flasher.cli.stop import Stop, stop_on_signal
from flasher.cli.upgrade.settings import page_restore_command
from flasher.cli.upgrade.upgrade_run import UpgradeRun
from flasher.cli.values import IMAGE_SUFFIXES, TRACE_SUFFIXES
from flasher.errors import FlasherError, UsageError
from flasher.files import parse_json, read
from flasher.history import Flash, FlashHistory, latest_left_open
from flasher.host.options import DEFAULT_ATTEMPTS
from flasher.i18n import text
from flasher.jobs import Job
from flasher.protocol.spec import BMS, Target
from flasher.protocol.text import printable
from flasher.settings.area import Area
from flasher.settings.profile import Profile, load_profile
from flasher.web.archive import PAGES as KEPT
from flasher.web.archive import Archive
from flasher.web.bench import BenchController
from flasher.web.bench_compare import watch_compared
from flasher.web.bench_page import UPLOADS, BenchPage, Shelf
from flasher.web.bench_state import Activity, Adapter, Saved, UpgradeEnding
from flasher.web.guard import BrowserEntry, application
from flasher.web.pages import Pages
from flasher.web.query_processes import QueryProcesses, answer_routes
from flasher.web.server import LOOPBACK, Server
from flasher.web.virtual_bike import NOTES, BikeFault, VirtualBike

_TURN_S: Final = 0.2
_MEMORY_MAX: Final = 4096
"""Maximum size in bytes of the file with the last choices."""


class LastChoices:
    """Adapter and image folder that were last chosen on the page."""

    def __init__(self) -> None:
        self._path = user_state_path("flasher", appauthor=False) / "ui.json"

    def _all(self) -> dict[str, str]:
        try:
            kept = parse_json(read(self._path, _MEMORY_MAX, what="memory of the page"))
            return {str(name): str(value) for name, value in kept.items()}
        except (FlasherError, ValueError, AttributeError):
            return {}

    def kept(self, name: str) -> str:
        """Return the last choice; empty without one."""
        return self._all().get(name, "")

    def keep(self, **choices: str) -> None:
        """Store choices. They are a convenience only: a failed write is ignored."""
        with contextlib.suppress(OSError):
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._path.write_text(json.dumps({**self._all(), **choices}), "utf-8")


@dataclass
class _Place:
    """Base of both bench back ends: recording of an upgrade, backups, and profiles."""

    _bus: Bus
    _output: Output
    _shelf: Shelf
    _stop: Stop
    _memory: LastChoices

    def __post_init__(self) -> None:
        self.dialect = self._bus.dialect
        self.images = self._shelf.files
        self.sets = self._shelf.sets
        self.dropped = self._shelf.dropped

    def use_folder(self, path: str) -> None:
        self._shelf.use(path)
        self._memory.keep(images=str(self._shelf.folder))

    def profile(self, target: Target) -> Profile:
        return load_profile(None, target, self.dialect)

    def bitrate_bps(self, adapter: Adapter) -> int:
        return self.bus(adapter).bit_rate.bps

    def is_physical(self, _adapter: Adapter) -> bool:
        return False

    def bus(self, _adapter: Adapter) -> Bus:
        return self._bus

    def connect(self, adapter: Adapter, *, asks: bool = True) -> AbstractContextManager[Connection]:
        raise NotImplementedError

    def model_area(self) -> Area | None:
        return DEVICE_MODEL if self._bus.mock else None

    def back_up(self, adapter: Adapter, area: Area | None, **watch: Unpack[CallOptions]) -> Saved:
        with (
            recording(RecordingOptions(), self.bus(adapter), self._output, target=BMS) as record,
            self.connect(adapter) as connection,
        ):
            record.opened(connection)
            watch["taps"] = record.taps
            device = connection.device(BMS, dialect=self.dialect, **watch)
            found = device.identify()
            data = b""
            if area is not None and found.is_there:
                data = device.read_memory(area.start, area.end)
            path = own_backup_path(found)
            made = backup_of(found, area, data, connection.name, path)
        write_whole(path, made.archive, "", is_private=True)
        document = made.document
        return Saved(
            path,
            document.size_bytes,
            area,
            made.running_version,
            None if document.memory is None else document.memory.names_running_version,
            tuple(document.items),
            document.not_in_it,
        )

    def upgrade(
        self,
        adapter: Adapter,
        job: Job,
        connect: Callable[[], AbstractContextManager[Connection]],
        *,
        keeps_settings: bool,
        **watch: Unpack[CallOptions],
    ) -> UpgradeEnding:
        output = self._output

        @contextmanager
        def watching(connection: Connection, record: Recording) -> Iterator[CallOptions]:
            output.progress(f"{job.plan.target.node.name} on {connection.name} ...")
            yield {**watch, "hung_up": partial(record.hung_up, self._stop, output)}

        upgrade_run = UpgradeRun(job, self.bus(adapter), RecordingOptions(), output)
        upgrade_run.keeps_settings = keeps_settings
        upgrade_run.restore_command = page_restore_command
        result = None
        try:
            result = upgrade_run.write_planned(connect, watching)
        except FlasherError as error:
            upgrade_run.error = error
        bundle = None if upgrade_run.record is None else upgrade_run.record.bundle
        return UpgradeEnding(result, upgrade_run.error, bundle, upgrade_run.warning)


@dataclass
class Adapters(_Place):
    """Bench back end with the adapters of this computer."""

    _buses: dict[str, Bus] = field(default_factory=dict)

    def adapters(self, cancelled: Callable[[], bool]) -> Sequence[Adapter]:
        self._buses = {}
        notes: dict[str, str] = {}
        if self._bus.is_named:
            merged = bus_config(self._bus.config, self._bus.fallback)
            name = printable(f"{merged['interface']} {merged.get('channel') or ''}".strip())
            self._buses[name] = self._bus
            notes[name] = text("named on the command line or in the settings")
        found = [each for each in detect_until(cancelled).found if each.channel]
        maybe = {each.channel for each in slcan_ports() or ()}
        for each in (*found, *(slcan_ports() or ())):
            name = printable(f"{each.interface} {each.channel}")
            if name not in self._buses:
                self._buses[name] = with_adapter(each, self._bus)
                is_port = each.channel in maybe and each not in found
                note = describe_adapter(each, self.dialect)
                notes[name] = (
                    text("a serial port: perhaps an slcan adapter. {note}", note=note)
                    if is_port
                    else note
                )
        last = self._memory.kept("adapter")
        listed = [Adapter(name, notes[name], was_last=name == last) for name in self._buses]
        return sorted(listed, key=lambda adapter: not adapter.was_last)

    def unfinished(self) -> Flash | None:
        with suppress(FlasherError, OSError):  # a flash reports what is wrong with the history
            return latest_left_open(FlashHistory().flashes()[0])
        return None

    def use(self, adapter: Adapter) -> None:
        self._memory.keep(adapter=adapter.name)

    def is_physical(self, adapter: Adapter) -> bool:
        bus = self.bus(adapter)
        merged = bus_config(bus.config, bus.fallback)
        return is_physical(str(merged["interface"]), str(merged.get("channel") or ""))

    def bus(self, adapter: Adapter) -> Bus:
        return self._buses[adapter.name]

    def connect(self, adapter: Adapter, *, asks: bool = True) -> AbstractContextManager[Connection]:
        return self.bus(adapter).connect(BMS, asks=asks)


@dataclass
class VirtualBikes(_Place):
    """Bench back end with virtual bikes, without hardware."""

    _bikes: dict[str, VirtualBike] = field(default_factory=dict)

    def adapters(self, _cancelled: Callable[[], bool]) -> Sequence[Adapter]:
        return [Adapter(fault.value, NOTES[fault]) for fault in BikeFault]

    def unfinished(self) -> Flash | None:
        return None  # a virtual bike is gone with the program

    def use(self, adapter: Adapter) -> None:
        """Select a bike, which keeps its state, so that it can be rescued."""
        if adapter.name not in self._bikes:
            speed = self._bus.mock_speed
            self._bikes[adapter.name] = VirtualBike(
                BikeFault(adapter.name), self.dialect, speed=speed
            )

    def connect(self, adapter: Adapter, *, asks: bool = True) -> AbstractContextManager[Connection]:
        return self._bikes[adapter.name].connect()

    def upgrade(
        self,
        adapter: Adapter,
        job: Job,
        connect: Callable[[], AbstractContextManager[Connection]],
        *,
        keeps_settings: bool,
        **watch: Unpack[CallOptions],
    ) -> UpgradeEnding:
        """Upgrade with few attempts, to show a bike's fault before the overall deadline."""
        bike = self._bikes[adapter.name]
        job = replace(job, options=replace(job.options, attempts=DEFAULT_ATTEMPTS))
        bike.begin(job)
        handle = watch.get("on_event")

        def listener(event: object) -> None:
            if handle is not None:
                handle(event)
            bike.happened(event)

        watch["on_event"] = listener
        ending = super().upgrade(adapter, job, connect, keeps_settings=keeps_settings, **watch)
        bike.ended()
        return ending


def serve(
    output: Output, bus: Bus, images: Path | None, *, port: int, opened: Callable[[str], None]
) -> FlasherError | None:
    """Serve the page until Ctrl-C; calls `opened` with its address. Returns the error of an upgrade
    that was interrupted by Ctrl-C and failed.
    """
    ctx = click.get_current_context()
    pages = Pages(remembers_language=True)
    entry = BrowserEntry(pages)
    with (
        ExitStack() as stack,
        TemporaryDirectory(prefix="flasher-images-") as dropped,
        stop_on_signal(lambda: output.error_line("stopping ...")) as stop,
    ):
        memory = LastChoices()
        shelf = Shelf(_folder(images, memory), Path(dropped), IMAGE_SUFFIXES, TRACE_SUFFIXES)
        answering = QueryProcesses(partial(Archive, bundle_folder(), backup_folder(), shelf.traces))
        stack.callback(answering.close)
        kind = VirtualBikes if bus.mock else Adapters
        machine = BenchController(kind(bus, output, shelf, stop, memory), time.perf_counter)
        page = BenchPage(pages, machine, shelf, is_mock=bus.mock)
        app = application(
            [*page.routes, *answer_routes(pages, answering.ask, KEPT)],
            hosts=LOOPBACK,
            secret=secrets.token_urlsafe(32),
            entry=entry,
            uploads=UPLOADS,
        )

        def work() -> None:
            with ctx.scope(cleanup=False):
                machine.run(watch_compared)

        worker = threading.Thread(target=work, name="bench", daemon=True)
        with Server(app, "127.0.0.1", port) as server:
            machine.order(BenchController.find_adapters)
            worker.start()
            opened(server.url.rstrip("/") + entry.path)
            was_upgrading = _wait(machine, worker, stop)
            machine.feed.close()
    done = machine.state.done
    return done.error if was_upgrading and done is not None else None


def _folder(images: Path | None, memory: LastChoices) -> Path:
    """Return the image folder: the given one, else the last one used, else the working directory.
    Raises UsageError if it is not a folder.
    """
    if images is not None and not images.expanduser().is_dir():
        raise UsageError(
            f"{printable(str(images))} is not a folder of this computer.",
            where="--images",
            remedy="Name the folder that has the images, or choose it on the page.",
        )
    last = Path(memory.kept("images") or ".")
    return (images or (last if last.is_dir() else Path())).expanduser().resolve()


def _wait(machine: BenchController, worker: threading.Thread, stop: Stop) -> bool:
    """Wait until the user ends the server; True during an upgrade. A lost terminal ends it too, but
    an upgrade then finishes by itself.
    """
    was_upgrading = False
    while worker.is_alive():
        if stop():
            was_upgrading |= machine.state.doing is Activity.UPGRADING
            machine.close(ends_upgrade=stop.asked())
        worker.join(_TURN_S)
    return was_upgrading
