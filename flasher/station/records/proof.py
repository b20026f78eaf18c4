"""Checks a PASS against its own bus trace: requests, answers, and the identity of one unit from
first answer to last.

Another process than the records' writes the trace, frame by frame; this check reads its bytes with
code that took no part in the run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import inf
from typing import Final, NamedTuple

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
"""Silence after which an announcement begins another burst."""
_LEFTOVER_S: Final = 0.25
"""Time after a transfer request in which announcements may still arrive."""
_STALL_S: Final = 3.0
"""The same where nothing came between, as frames that waited in a stalled computer bear the time at
which they were read."""
_IDENTITY: Final = ("model", "serial_number", "hardware_version")


@dataclass
class Restarts:
    """Finds announcements of one target's bootloader that nothing in the trace has caused. Times
    are seconds on the trace's clock.
    """

    uncaused: list[float] = field(default_factory=list)
    is_identified: bool = False
    """It has answered, or got an update command: from now on it has to stay."""
    _has_acted: bool = False
    """The tool has sent something after which it may restart."""
    _is_running: bool = False
    """It has answered since the last announcement."""
    _is_due: bool = False
    """A burst follows what was sent, at any time."""
    _has_update_command: bool = False
    """An update command was sent, and no application has answered since."""
    _requested_at: float | None = None
    _announced_at: float | None = None
    _is_noted: bool = False
    """The burst that goes on is among them."""

    def sent(self, message: Message, row: object) -> None:
        """The tool sent something to it."""
        self._has_acted = self._has_acted or message.mode == Mode.WRITE
        if isinstance(row, messages.UpdateCommand):
            self.is_identified = self._has_update_command = True
            self._is_due, self._requested_at = False, None
        elif isinstance(row, Reset | messages.EndOfTransfer | messages.Unknown):
            # Products may have a reset of their own.
            self._is_due = self._is_due or message.mode == Mode.WRITE
            self._requested_at = None

    def powered_up(self, at_s: float) -> None:
        """It was heard before it is identified, and its bootloader announces itself: it has to be
        the unit of the label from the beginning on.
        """
        if not self._has_acted:
            self.uncaused.append(at_s)

    def answered(self) -> None:
        """Its application named its version."""
        self.is_identified = self._is_running = True
        self._is_due = self._has_update_command = False

    def take(self, row: object, at_s: float) -> None:
        """Its bootloader sent something."""
        if isinstance(row, messages.RequestTransfer) and self._has_update_command:
            self._requested_at = at_s
        if not isinstance(row, messages.BootVersion):
            return
        since_s = inf if self._announced_at is None else at_s - self._announced_at
        self._announced_at = at_s
        goes_on_s = _BURST_QUIET_S if self._is_running else _STALL_S
        is_new = since_s >= goes_on_s
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


class _Usual(NamedTuple):
    """A target without settings of a product: the records hold none."""

    target: Target
    profile: Profile


@dataclass
class TraceOfTarget:
    """The events of one target in a trace."""

    target: Target
    packets: dict[int, bytes] = field(default_factory=dict)
    size_bytes: int = 0
    sent_sha256: str | None = None
    """SHA-256 of the last image that was sent completely."""
    is_complete: bool = False
    """The device confirmed that image."""
    version: str | None = None
    """Version in its last answer."""
    serial: str = ""
    """Serial number in its last answer; empty without one."""
    written_serial: str | None = None
    answers: list[bytes] = field(default_factory=list)
    """Data of all unknown answers: products may have queries of their own."""
    restarts: Restarts = field(default_factory=Restarts)
    changes: list[str] = field(default_factory=list)
    """Identity fields that changed to a value that the tool had not written."""
    _identity: dict[str, str] = field(default_factory=dict)
    """Identity fields of its last answer."""
    _written: dict[str, set[str]] = field(default_factory=dict)
    """Values that the tool has written to these fields."""

    def __post_init__(self) -> None:
        self._watcher = TargetWatcher(_Usual(self.target, Profile(self.target)))

    def watch(self, frame: Frame, at_s: float, gap_s: float) -> None:
        """Any frame before it is identified, `gap_s` after the last one; the computer may have
        stood still meanwhile.
        """
        watcher = self._watcher
        if BLIND_S < gap_s < _STALL_S:
            watcher.miss(gap_s)
        was_known, power_ups = watcher.is_known, watcher.power_ups
        watcher(frame, sent=False, now=at_s)
        # How long a bootloader announces itself before its application starts, the profile says.
        is_power_up = watcher.power_ups > power_ups and watcher.is_in_bootloader
        if was_known and is_power_up:
            self.restarts.powered_up(at_s)

    def take(self, message: Message, at_s: float) -> None:
        """One intact message, of the tool or of the device."""
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
        """True when the device answered this version last; or at all, where no row of the
        documents says how it answers.
        """
        if self.version is not None:
            return self.version == version
        return any(version.encode("ascii", "replace") in data for data in self.answers)


def traces_of_targets(
    targets: Iterable[str], frames: Iterable[tuple[float, Frame]]
) -> dict[str, TraceOfTarget]:
    """Read the events of these targets from the frames of a trace."""
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
    """Where the trace of a PASS contradicts the records."""
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
            yield f"it is of the unit {printable(trace.serial)}, not of {printable(run.serial)}"
        for name in dict.fromkeys(trace.changes):
            yield f"the {name} of the {target.target} changed: it is of two units"
    yield from _restarts(details, traces)
    for write in details.writes:
        trace = traces.get(write.target)
        if write.what == SERIAL_NUMBER and trace is not None:
            if trace.written_serial != run.serial:
                yield f"the serial number {printable(run.serial)} is not written in it"
            if not trace.serial:
                yield f"the serial number {printable(run.serial)} is not read back in it"


def _restarts(details: RunDetails, traces: dict[str, TraceOfTarget]) -> Iterator[str]:
    """Where a bootloader announced itself without a cause that trace or records hold."""
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
        yield f"it holds no whole transfer to the {target.target}"
    elif trace.sent_sha256 != target.image_sha256:
        yield f"it carries another image for the {target.target}, of SHA-256 {trace.sent_sha256}"
    elif not (trace.is_complete or (target.version and trace.names(target.version))):
        yield f"the {target.target} neither says complete nor names its version"
