"""Checks a PASS against its own bus trace: requests, answers, and that one unit answered all along.

Another process wrote the trace, frame by frame; this check reads its bytes independently.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import inf
from typing import Final

from flasher.host.options import firmware_version
from flasher.protocol import catalogue, messages
from flasher.protocol.contents import Reset, SerialNumber
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, TARGETS, Mode, Node, Target, can_id, packet_count
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Message, Reassembler
from flasher.settings.profile import Profile
from flasher.station.presence import BLIND_S, TargetWatcher
from flasher.station.records.model import (
    AFTER_RESTART,
    BY_POWER,
    FLASH,
    POWER_CYCLES,
    SERIAL_NUMBER,
    RunDetails,
    StepName,
    TargetRecord,
    Verified,
)

_BURST_QUIET_S: Final = 0.3
"""Silence after which an announcement begins a new burst."""
_LEFTOVER_S: Final = 0.25
"""Time after a transfer request in which delayed announcements may arrive."""
_STALL_S: Final = 3.0
"""Silence of a new burst if the target has not answered since the last one: after a stall of the
computer, frames have the time at which they were read."""
_IDENTITY: Final = ("model", "serial_number", "hardware_version")


@dataclass
class Restarts:
    """Finds bootloader announcements of one target that nothing in the trace caused."""

    uncaused: list[float] = field(default_factory=list)
    is_identified: bool = False
    """True after an answer or an update command: the same unit must remain from then on."""
    _has_acted: bool = False
    """The tool has sent a message that may cause a restart."""
    _is_running: bool = False
    """The application has answered since the last announcement."""
    _is_due: bool = False
    """A message was sent that causes a restart, at any time."""
    _has_update_command: bool = False
    """An update command was sent, and the application has not answered since."""
    _requested_at: float | None = None
    _announced_at: float | None = None
    _is_noted: bool = False
    """The present burst is already in `uncaused`."""

    def sent(self, message: Message, row: object) -> None:
        """Process a message from the tool to the target."""
        self._has_acted = self._has_acted or message.mode == Mode.WRITE
        if isinstance(row, messages.UpdateCommand):
            self.is_identified = self._has_update_command = True
            self._is_due, self._requested_at = False, None
        elif isinstance(row, Reset | messages.EndOfTransfer | messages.Unknown):
            # Products may have a reset of their own.
            self._is_due = self._is_due or message.mode == Mode.WRITE
            self._requested_at = None

    def powered_up(self, at_s: float) -> None:
        """Process a bootloader announcement before the unit was identified: the unit of the label
        should have been there from the beginning.
        """
        if not self._has_acted:
            self.uncaused.append(at_s)

    def answered(self) -> None:
        """Process an answer of the application with its version."""
        self.is_identified = self._is_running = True
        self._is_due = self._has_update_command = False

    def take(self, row: object, at_s: float) -> None:
        """Process a message from the bootloader."""
        if isinstance(row, messages.RequestTransfer) and self._has_update_command:
            self._requested_at = at_s
        if not isinstance(row, messages.BootVersion):
            return
        since_s = inf if self._announced_at is None else at_s - self._announced_at
        self._announced_at = at_s
        burst_gap_s = _BURST_QUIET_S if self._is_running else _STALL_S
        is_new = since_s >= burst_gap_s
        self._is_running = False
        self._is_noted = self._is_noted and not is_new
        if self._requested_at is not None:
            is_uncaused = at_s - self._requested_at > _LEFTOVER_S
        elif not is_new:
            is_uncaused = False
        elif self._is_due:
            is_uncaused = self._is_due = False
        else:
            is_uncaused = self.is_identified
        if is_uncaused and not self._is_noted:
            self._is_noted = True
            self.uncaused.append(at_s)


@dataclass
class TraceOfTarget:
    """Requests and answers of one target in a trace."""

    target: Target
    packets: dict[int, bytes] = field(default_factory=dict)
    size_bytes: int = 0
    sent_sha256: str | None = None
    """SHA-256 of the last image that was sent completely."""
    is_complete: bool = False
    """The device confirmed that image."""
    version: str | None = None
    """Firmware version in the last answer."""
    serial: str = ""
    """Serial number in the last answer; "" without one."""
    written_serial: str | None = None
    answers: list[bytes] = field(default_factory=list)
    """Data of all unknown answers: products may have queries of their own."""
    restarts: Restarts = field(default_factory=Restarts)
    changes: list[str] = field(default_factory=list)
    """Identity fields that changed although the tool did not write them."""
    _identity: dict[str, str] = field(default_factory=dict)
    """Identity fields of the last answer."""
    _written: dict[str, set[str]] = field(default_factory=dict)
    """Values that the tool wrote to identity fields."""

    def __post_init__(self) -> None:
        self._watcher = TargetWatcher(Profile(self.target))  # records store no settings of it

    def watch(self, frame: Frame, at_s: float, gap_s: float) -> None:
        """Process any frame before the unit is identified. `gap_s` is the time since the last
        frame: the computer may have stalled.
        """
        watcher = self._watcher
        if BLIND_S < gap_s < _STALL_S:
            watcher.miss(gap_s)
        was_known, power_ups = watcher.is_known, watcher.power_ups
        watcher(frame, sent=False, now=at_s)
        # The profile has the duration of announcements before an application starts.
        is_power_up = watcher.power_ups > power_ups and watcher.is_in_bootloader
        if was_known and is_power_up:
            self.restarts.powered_up(at_s)

    def take(self, message: Message, at_s: float) -> None:
        """Process a complete message of the tool or the device."""
        decoded = catalogue.decode(message)
        row = messages.decode(message)
        if message.can_id == self.target.request_id:
            self.restarts.sent(message, row if decoded is None else decoded.content)
        if decoded is not None:
            self._take_content(message, decoded.content)
            return
        self.restarts.take(row, at_s)
        match row:
            case messages.UpdateCommand():
                self.packets, self.size_bytes, self.is_complete = {}, row.size_bytes, False
            case messages.Packet():
                self.packets[row.number] = row.payload
            case messages.EndOfTransfer():
                self._end()
            case messages.Complete():
                self.is_complete = self.sent_sha256 is not None
            case messages.Unknown() if message.can_id != self.target.request_id:
                self.answers.append(message.data)
            case _:
                pass

    def _take_content(self, message: Message, content: Content) -> None:
        if message.can_id == self.target.request_id:
            if isinstance(content, SerialNumber):
                self.written_serial = str(content.serial_number)
            for name in _IDENTITY:
                if hasattr(content, name):
                    self._written.setdefault(name, set()).add(str(getattr(content, name)))
            return
        self.serial = str(getattr(content, "serial_number", "")) or self.serial
        if hasattr(content, "firmware_version"):
            self.version = firmware_version(content)
            self.restarts.answered()
            for name in _IDENTITY:
                value = str(getattr(content, name, ""))
                is_new = value != self._identity.setdefault(name, value)
                if is_new and value not in self._written.get(name, ()):
                    self.changes.append(name.replace("_", " "))
                self._identity[name] = value

    def _end(self) -> None:
        total = packet_count(self.size_bytes)
        if set(self.packets) != set(range(1, total + 1)):
            return
        data = b"".join(self.packets[number] for number in range(1, total + 1))
        self.sent_sha256 = hashlib.sha256(data[: self.size_bytes]).hexdigest()
        self.is_complete = False

    def names(self, version: str) -> bool:
        """True if the last answer has this version; without one (a product with queries of its
        own), if any unknown answer contains it.
        """
        if self.version is not None:
            return self.version == version
        return any(version.encode("ascii", "replace") in data for data in self.answers)


def traces_of_targets(
    targets: Iterable[str], frames: Iterable[tuple[float, Frame]]
) -> dict[str, TraceOfTarget]:
    """Collect requests and answers of these targets from the frames of a trace."""
    traces = {name: TraceOfTarget(TARGETS[name]) for name in targets if name in TARGETS}
    # The CAN ids on which a node speaks.
    ids_of = {
        node: [can_id(node, receiver) for receiver in (None, *Node) if receiver is not node]
        for node in Node
    }
    timeout_s = DEFAULT_TIMINGS.inter_frame_timeout_s
    streams = {
        of_id: (Reassembler(of_id, timeout_s), each)
        for each in traces.values()
        for of_id in (each.target.request_id, *ids_of[each.target.node])
    }
    began_s: float | None = None
    before_s = 0.0
    for moment_s, frame in frames:
        began_s = moment_s if began_s is None else began_s
        at_s = moment_s - began_s
        gap_s, before_s = at_s - before_s, at_s
        for each in traces.values():
            if not each.restarts.is_identified:
                each.watch(frame, at_s, gap_s)
        if not frame.is_payload or frame.can_id not in streams:
            continue
        stream, each = streams[frame.can_id]
        found = [*stream.tick(at_s), *stream.feed(frame.data, at_s)]
        for message in found:
            if isinstance(message, Message):
                each.take(message, at_s)
    return traces


def contradictions(details: RunDetails, traces: dict[str, TraceOfTarget]) -> Iterator[str]:
    """Contradictions between the trace of a PASS and the records, as sentences."""
    run = details.run
    flashed = {write.target for write in details.writes if write.what == FLASH}
    for target in details.targets:
        trace = traces.get(target.target)
        if trace is None:
            yield f"there is no device {printable(target.target)}"
            continue
        if target.target in flashed:
            yield from _image(target, trace)
        is_read_back = target.reached is not None and target.reached >= Verified.VERSION
        if is_read_back and target.version and not trace.names(target.version):
            answered = printable(trace.version or "none")
            yield f"the {target.target} answers version {answered}, not {target.version}"
        if trace.serial and trace.serial != run.serial:
            yield f"it is the trace of {printable(trace.serial)}, not of {printable(run.serial)}"
        for name in dict.fromkeys(trace.changes):
            yield f"the {name} of the {target.target} changed: it is the trace of two units"
    yield from _restarts(details, traces)
    for write in details.writes:
        trace = traces.get(write.target)
        if write.what == SERIAL_NUMBER and trace is not None:
            if trace.written_serial != run.serial:
                yield f"the serial number {printable(run.serial)} is not written in the trace"
            if not trace.serial:
                yield f"the serial number {printable(run.serial)} is not read back in the trace"


def _restarts(details: RunDetails, traces: dict[str, TraceOfTarget]) -> Iterator[str]:
    """Announcements of a bootloader without a cause in trace or records."""
    measured = {each.name: each for step in details.steps for each in step.measurements}
    is_switched = any(
        step.name == StepName.RESTART.value and step.text == BY_POWER for step in details.steps
    )
    known = measured.get(POWER_CYCLES)
    if AFTER_RESTART in measured or (is_switched and known is None):
        return  # it was allowed to; records of before this was counted
    cycles = 0 if known is None else int(known.value or 0)
    for name, trace in traces.items():
        # The battery supplies the others, and restarts for causes of its own.
        is_supplied = BMS.name in traces and trace.target is not BMS
        uncaused = [] if is_supplied else trace.restarts.uncaused[cycles:]
        for at_s in uncaused[:1]:
            yield (
                f"the {name} announced its bootloader {at_s:.1f} s after the beginning, and nothing"
                " had restarted it: it lost its supply, or it is another unit"
            )


def _image(target: TargetRecord, trace: TraceOfTarget) -> Iterator[str]:
    if trace.sent_sha256 is None:
        yield f"it holds no complete transfer to the {target.target}"
    elif trace.sent_sha256 != target.image_sha256:
        yield f"it holds another image for the {target.target}, of SHA-256 {trace.sent_sha256}"
    elif not (trace.is_complete or (target.version and trace.names(target.version))):
        yield f"the {target.target} neither confirms the image nor reports its version"
