"""Checks a PASS against its own bus trace: what was sent, what was answered, and by which unit.

The trace is written by another process than the records, frame by frame; here it is read again from
its bytes alone, by nothing that took part in the run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from flasher.host.options import firmware_version
from flasher.protocol import catalogue, messages
from flasher.protocol.contents import SerialNumber
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.spec import TARGETS, Node, Target, can_id, packet_count
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Message, Reassembler
from flasher.station.records.model import FLASH, SERIAL_NUMBER, RunDetails, TargetRecord, Verified


@dataclass
class TraceOfTarget:
    """What a trace shows of one target."""

    target: Target
    packets: dict[int, bytes] = field(default_factory=dict)
    size_bytes: int = 0
    sent_sha256: str | None = None
    """Of the last image that was sent to its end."""
    is_complete: bool = False
    """The device said so, after that."""
    version: str | None = None
    """As answered last."""
    serial: str = ""
    """As answered last; empty while it names none."""
    written_serial: str | None = None
    answers: list[bytes] = field(default_factory=list)
    """The data of all other answers: products may have queries of their own."""

    def take(self, message: Message) -> None:
        """One intact message, of the tool or of the device."""
        decoded = catalogue.decode(message)
        if decoded is not None:
            self._take_content(message, decoded.content)
            return
        row = messages.decode(message)
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
            return
        self.serial = str(getattr(content, "serial_number", "")) or self.serial
        if hasattr(content, "firmware_version"):
            self.version = firmware_version(content)

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
    """What a trace shows of these targets."""
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
    for at_s, frame in frames:
        if not frame.is_payload or frame.can_id not in streams:
            continue
        stream, each = streams[frame.can_id]
        found = [*stream.tick(at_s), *stream.feed(frame.data, at_s)]
        for message in found:
            if isinstance(message, Message):
                each.take(message)
    return traces


def contradictions(details: RunDetails, traces: dict[str, TraceOfTarget]) -> Iterator[str]:
    """Where the trace of a PASS contradicts the records."""
    run = details.run
    flashed = {write.target for write in details.writes if write.what == FLASH}
    for target in details.targets:
        said = traces.get(target.target)
        if said is None:
            yield f"there is no device {printable(target.target)}"
            continue
        if target.target in flashed:
            yield from _image(target, said)
        is_read_back = target.reached is not None and target.reached >= Verified.VERSION
        if is_read_back and target.version and not said.names(target.version):
            answered = printable(said.version or "none")
            yield f"the {target.target} answers version {answered}, not {target.version}"
        if said.serial and said.serial != run.serial:
            yield f"it is of the unit {printable(said.serial)}, not of {printable(run.serial)}"
    for write in details.writes:
        said = traces.get(write.target)
        if write.what == SERIAL_NUMBER and said is not None:
            if said.written_serial != run.serial:
                yield f"the serial number {printable(run.serial)} is not written in it"
            if not said.serial:
                yield f"the serial number {printable(run.serial)} is not read back in it"


def _image(target: TargetRecord, said: TraceOfTarget) -> Iterator[str]:
    if said.sent_sha256 is None:
        yield f"it holds no whole transfer to the {target.target}"
    elif said.sent_sha256 != target.image_sha256:
        yield f"it carries another image for the {target.target}, of SHA-256 {said.sent_sha256}"
    elif not (said.is_complete or (target.version and said.names(target.version))):
        yield f"the {target.target} neither says complete nor names its version"
