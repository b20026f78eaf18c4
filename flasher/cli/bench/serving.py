"""Serves a simulated device on a python-can bus until it is done or the user stops it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

from flasher import events
from flasher.api import Connection
from flasher.cli.documents import to_json
from flasher.cli.output import Output, byte_count
from flasher.driver import drive
from flasher.errors import BusError, FlasherError, UsageError, printable
from flasher.log import BY_DEVICE, log_event
from flasher.mock.table import BootloaderState
from flasher.protocol.engine import Engine, Tap
from flasher.wording import wording_of

_REOPEN_S: Final = 0.25
"""Interval between attempts to reopen a lost adapter, in seconds."""


class DeviceWatcher:
    """Prints the events of a device; calls `on_image` when it has stored an image."""

    def __init__(self, output: Output, on_image: Callable[[], None] = lambda: None) -> None:
        self._output = output
        self._on_image = on_image
        self.images = 0
        self.applications = 0
        """Number of starts of the application."""
        output.shows = lambda event: type(event) in {*BY_DEVICE, events.BytesDamaged}

    def __call__(self, event: object) -> None:
        log_event(event)
        match event:
            case events.DeviceStateEntered(state, detail):
                self.applications += state == BootloaderState.APPLICATION.value
                self._say("state", f"{state}{f': {detail}' if detail else ''}", event)
            case events.PacketStored(number, total) if number == total:
                self._say("packets", f"all {total:,} stored", event)
            case events.PacketStored(number, total) if number == 1:
                self._say("packets", f"first of {total:,} stored", event)
            case events.ImageStored(size_bytes, sha256):
                self._on_image()
                self.images += 1
                self._say("image", f"{byte_count(size_bytes)}, sha256 {sha256}", event)
            case events.DeviceWritten(name, before, after):
                self._say(
                    "written", f"{name}: {after or 'empty'} (before: {before or 'empty'})", event
                )
            case events.ShutdownAnnounced(why):
                self._say("power", f"SHUTDOWN sent: {why}", event)
            case events.ShutdownEnded(ready, silent):
                others = f"; no answer from {', '.join(silent)}" if silent else ""
                self._say("power", f"off; ready: {', '.join(ready) or 'none'}{others}", event)
            case events.DeviceReported(what):
                self._say("note", what, event)
            case events.BytesDamaged(can_id, reason, data):
                why = wording_of("DamageReason", reason)
                self._say("damage", f"0x{can_id:03X}: {why}: {data[:16].hex(' ')} ...", event)

    def _say(self, kind: str, text: str, event: object) -> None:
        self._output.result(f"{kind + ':':<9}{text}")
        self._output.line({**to_json(event), "text": text})


class _OnBus(Protocol):
    def bus_off(self, now: float, off_s: float = ...) -> None:
        """Leave the bus for `off_s` seconds."""


def serve(
    engine: Engine,
    device: _OnBus,
    connection: Connection,
    output: Output,
    *,
    on_event: Callable[[object], None],
    stopped: Callable[[], bool],
    is_over: Callable[[], bool] = lambda: False,
    taps: Sequence[Tap] = (),
    crashes: bool = False,
) -> None:
    """Run a simulated device until the user stops it or `is_over`. It survives a lost adapter, and
    with `crashes` its own FlasherErrors, each reported once.
    """
    clock, reported = connection.clock, ""
    while True:
        try:
            drive(
                engine,
                connection.link,
                clock,
                taps=taps,
                on_event=on_event,
                cancelled=lambda: stopped() or is_over(),
            )
        except BusError as error:
            output.error_line(f"warning: {error.what} Waiting for the adapter; Ctrl-C ends it")
            if not _is_back(connection, stopped, output):
                return
            device.bus_off(clock.now(), off_s=0.0)
        except FlasherError as error:
            if not crashes or isinstance(error, UsageError):
                raise
            cause = f" ({printable(error.cause)})" if error.cause else ""
            text = f"warning: {printable(error.what)}{cause}; the device restarts"
            if text != reported:
                reported = text
                output.error_line(text)
        else:
            return


def _is_back(connection: Connection, stopped: Callable[[], bool], output: Output) -> bool:
    """Wait until the adapter opens again; False if the user stops. Reports each reason once."""
    reported = ""
    while not stopped():
        try:
            connection.link.reopen()
        except BusError as error:
            if str(error) != reported:
                reported = str(error)
                output.progress(f"not yet: {error.what} {error.remedy}".rstrip())
            connection.clock.wait_until(connection.clock.now() + _REOPEN_S)
        else:
            output.progress("the adapter is back")
            return True
    return False
