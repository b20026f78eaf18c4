"""Recording of a command's frames: into a trace file if requested, into a bundle if it fails.

    with recording(options, bus, output, target=target) as record:
        with connect(...) as connection:
            record.opened(connection)
            connection.device(target).identify(taps=record.taps)

An error that leaves the `with` block, or is passed to `failed`, makes a bundle. A failure to record
changes neither the output of the command nor its exit code.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from platformdirs import user_state_path

from flasher.api import CallOptions, Connection, Device
from flasher.cli.adapters import choose_adapter
from flasher.cli.files import check_writable
from flasher.cli.framework import command_line, option, option_set, typed_values
from flasher.cli.options import Bus
from flasher.cli.output import Output
from flasher.cli.stop import Stop, stop_on_signal
from flasher.cli.values import TRACE_SUFFIXES, FilePath, FolderPath
from flasher.errors import (
    ErrorCode,
    ExitCode,
    FlasherError,
    InterruptedByUserError,
    UsageError,
    is_secret,
)
from flasher.events import TwoDevicesSeen
from flasher.host.event_text import warning_text
from flasher.protocol.engine import Tap
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.settings.profile import Profile
from flasher.trace.figures import LinkMeter, LinkReport
from flasher.trace.taps import EchoFilter, FlightRecorder

if TYPE_CHECKING:
    from flasher.trace.recorder import Recorder

BUNDLE_FOLDER: Final = "FLASHER_BUNDLE_DIR"
"""Environment variable that names the folder for bundles."""
_WITHOUT_BUNDLE: Final = (
    ExitCode.USAGE, ExitCode.IMAGE, ExitCode.NOTHING_TO_DO, ExitCode.PARTIAL,
)  # fmt: skip
"""Errors that frames do not help to explain."""
_BUNDLES_KEPT: Final = 50
"""Maximum number of bundles in the default folder; older ones are deleted."""


@dataclass(frozen=True)
class RecordingOptions:
    """Options of a command on a bus: trace file and bundle."""

    trace_file: Annotated[str | None, option(
        "--trace-file", metavar="FILE", type=FilePath(*TRACE_SUFFIXES), panel="recording",
        brief=True, help="record all frames; format by suffix (.asc .blf ...)",
    )] = None  # fmt: skip
    bundle_dir: Annotated[Path | None, option(
        "--bundle-dir", metavar="DIR", type=FolderPath(), panel="recording",
        help="where a failure leaves its bundle: last frames, transcript, report "
        f"(default: ${BUNDLE_FOLDER}, else the user's own state folder, the last {_BUNDLES_KEPT}; "
        "flasher explain --last reads the latest)",
    )] = None  # fmt: skip
    no_bundle: Annotated[bool, option(
        "--no-bundle", is_flag=True, panel="recording", help="leave none",
    )] = False  # fmt: skip
    overwrites: Annotated[bool, option(
        "--overwrite-trace", "overwrites", is_flag=True, panel="recording",
        help="overwrite an older trace file",
    )] = False  # fmt: skip


recording_options: Final = option_set("recorded", RecordingOptions)


def bundle_folder(chosen: Path | None = None) -> Path:
    """Folder for bundles: of the option, of the environment, or the user's own."""
    named = chosen or os.environ.get(BUNDLE_FOLDER)
    return Path(named) if named else user_state_path("flasher", appauthor=False) / "bundles"


class Recording:
    """Frames and facts of one command."""

    def __init__(self, target: Target | None, bitrate_bps: int) -> None:
        self.flight = FlightRecorder()
        self.facts: dict[str, Any] = {}
        """Contents of the bundle's report, as JSON values."""
        self._connection: Connection | None = None
        self._meter = None if target is None else LinkMeter(target, bitrate_bps)
        self.recorders: list[Tap] = [self.flight]
        if self._meter is not None:
            self.recorders.append(self._meter)
        self.file: Recorder | None = None
        """Trace file, if requested."""
        self.taps: tuple[Tap, ...] = (EchoFilter(lambda: self.recorders),)
        """Taps for the driver."""
        self.failure: BaseException | None = None
        self.only_asks = False
        """The command sends queries only, or single writes that it reports."""
        self.bundle: Path | None = None
        """Path of the bundle, if any."""
        self.two_devices: str | None = None
        """Evidence of a second device of the kind."""
        self.is_alone = False
        """The terminal is lost: a bundle stores the result, even of a success."""

    def warn(self, output: Output, event: object) -> None:
        """Print and record a warning."""
        if isinstance(event, TwoDevicesSeen):
            self.two_devices = event.what
            output.error_line(f"warning: {warning_text(event)}")

    def opened(self, connection: Connection) -> None:
        """Begin to record this bus."""
        self._connection = connection
        self.facts["connection"] = connection.name
        if self.file is not None:
            self.file.channel = connection.channel

    def failed(self, error: BaseException) -> None:
        """Record an error that the command reports without raising it."""
        self.failure = error

    def hung_up(self, stop: Stop, output: Output) -> bool:
        """True if the terminal is lost, which is recorded."""
        if stop.has_hung_up and not self.is_alone:
            self.is_alone = True
            output.leave_terminal("the terminal is gone")
        return stop.has_hung_up

    def link_report(self) -> LinkReport | None:
        """Bus usage of the transfer so far; None before the first packet."""
        report = None if self._meter is None else self._meter.report()
        if report is None or self._connection is None:
            return report
        health = self._connection.link.health()
        return replace(report, unreadable=health.unreadable, refused=health.refused)


@contextmanager
def recording(
    options: RecordingOptions, bus: Bus, output: Output, *, target: Target | None = None
) -> Iterator[Recording]:
    """Record the bus traffic while the block runs. Raises UsageError for a trace file that cannot
    be written.
    """
    record = Recording(target, bus.bit_rate.bps)
    record.facts |= {
        "command_line": ["flasher", *map(printable, command_line())],
        "target": None if target is None else target.name,
        "dialect": bus.dialect_name,
        "bus": {} if bus.mock else _without_passwords(bus.config),
        "bitrate_bps": bus.bit_rate.bps,
        "bitrate_source": bus.bit_rate.source,
    }
    try:
        with _trace_file(options, record, output):
            output.has_opened = True
            yield record
    except KeyboardInterrupt:
        record.failed(InterruptedByUserError("Interrupted at once."))
        raise
    except Exception as error:
        record.failed(error)
        raise
    finally:
        if (record.is_alone or record.failure is not None) and not options.no_bundle:
            _leave_bundle(options, output, record, record.failure)


def _without_passwords(config: Mapping[str, Any]) -> dict[str, Any]:
    return {key: "***" if is_secret(key) else value for key, value in config.items()}


@contextmanager
def recorded_connection(
    options: RecordingOptions, bus: Bus, output: Output, target: Target
) -> Iterator[tuple[Connection, Recording]]:
    """Open and record the bus of the options, else the only adapter detected, for commands with one
    query.
    """
    bus = choose_adapter(bus, output)
    with (
        recording(options, bus, output, target=target) as record,
        bus.connect(target) as connection,
    ):
        record.opened(connection)
        record.only_asks = True
        yield connection, record


@contextmanager
def recorded_device(
    options: RecordingOptions,
    bus: Bus,
    output: Output,
    target: Target,
    profile: Profile | None = None,
) -> Iterator[tuple[Device, Recording]]:
    """Open a device, with its calls recorded and stopped on request."""
    with (
        recorded_connection(options, bus, output, target) as (connection, record),
        stop_on_signal() as stopped,
    ):
        watch: CallOptions = {
            "taps": record.taps, "cancelled": stopped, "on_event": partial(record.warn, output),
        }  # fmt: skip
        device = connection.device(target, dialect=bus.dialect, profile=profile, **watch)
        yield device, record


@contextmanager
def _trace_file(options: RecordingOptions, record: Recording, output: Output) -> Iterator[None]:
    """Record to the trace file, if any."""
    path = options.trace_file
    if path is None:
        yield
        return
    check_writable(Path(path), "--trace-file", typed_values(but="trace_file"))
    if not options.overwrites and Path(path).is_file() and Path(path).stat().st_size:
        raise UsageError(
            f"{printable(path)} exists already.",
            where="--trace-file",
            remedy="Name another file, or add --overwrite-trace.",
            code=ErrorCode.FILE_NOT_WRITTEN,
        )
    from flasher.trace.recorder import Recorder  # noqa: PLC0415  loads python-can

    with Recorder(path) as recorder:
        record.file = recorder
        record.recorders.append(recorder)
        yield
    if recorder.failure is not None:
        reason = printable(f"{path} is incomplete: {recorder.failure}")
        output.error_line(f"warning: the trace {reason}")


def _leave_bundle(
    options: RecordingOptions, output: Output, record: Recording, error: BaseException | None
) -> None:
    is_explained = isinstance(error, FlasherError) and error.exit_code in _WITHOUT_BUNDLE
    # It would take the place of the last failure, which `explain --last` is asked for.
    is_explained |= record.only_asks and isinstance(error, InterruptedByUserError)
    if (is_explained and not record.is_alone) or not record.flight.frames:
        return
    from flasher.trace.bundle import keep_last, write_bundle  # noqa: PLC0415  loads python-can

    folder = bundle_folder(options.bundle_dir)
    facts = {**record.facts, "error": error and _error(error), "link": record.link_report()}
    is_own = options.bundle_dir is None and not os.environ.get(BUNDLE_FOLDER)
    try:
        if is_own:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        record.bundle = path = write_bundle(folder, record.flight, facts)
        if is_own:
            keep_last(folder, _BUNDLES_KEPT)
    except Exception as problem:  # noqa: BLE001  the command's own failure is what matters
        reason = getattr(problem, "strerror", None) or str(problem) or type(problem).__name__
        output.error_line(printable(f"warning: no bundle in {folder}: {reason}"))
    else:
        output.error_line(f"bundle: {printable(str(path))}")
        if is_own:
            output.error_line(
                "        flasher explain --last explains it, flasher bundle --last packs it to send"
            )


def _error(error: BaseException) -> dict[str, Any]:
    if isinstance(error, FlasherError):
        names = ("what", "where", "cause", "remedy", "command")
        return {
            "kind": type(error).__name__,
            "exit_code": int(error.exit_code),
            **{name: getattr(error, name) for name in names},
        }
    lines = traceback.format_exception(error)
    return {
        "kind": type(error).__name__,
        "exit_code": int(ExitCode.INTERNAL),
        "what": printable(str(error)),
        "where": "",
        "cause": "a bug in flasher",
        "remedy": "",
        "traceback": [printable(line) for part in lines for line in part.splitlines()],
    }
