"""A tool in literal frames, at the pace of a real bus, for devices that may be wrong.

Messages are built and taken apart without flasher's own code; nothing is asserted about them here.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame
from tests.peers.wording import READ, WRITE, build, intact, payloads

REQUEST_ID, ANSWER_ID = 0x752, 0x725
FRAME_S = 0.0005
_NAMES = {
    0x5503: "feedback",
    0xC109: "version",
    0xC402: "request",
    0xC202: "ack",
    0xC302: "nak",
    0xC502: "complete",
}


class Tool:
    """Talks to one BMS; names what it received: `ack 3`, `version`, `720 1540`."""

    def __init__(self, device: MockDevice) -> None:
        self.device = device
        self.now = 1000.0
        self.version_texts: list[str] = []
        self._heard: list[tuple[float, str]] = []
        self._partial: dict[int, bytes] = {}

    # -- time and frames --------------------------------------------------------------------------

    def run(self, duration_s: float) -> None:
        """Let time pass."""
        until_s = self.now + duration_s
        self._collect()
        while (wanted := self.device.deadline()) is not None and wanted <= until_s:
            self.now = max(self.now, wanted)
            self.device.tick(self.now)
            self._collect()
        self.now = until_s

    def put(self, *frames: Frame, gap_s: float = 0.0) -> None:
        """Frames one after the other, each taking its time on the wire."""
        for frame in frames:
            self.run(FRAME_S + gap_s)
            self.device.receive(frame, self.now)
            self._collect()

    def put_payloads(self, parts: Iterable[bytes], gap_s: float = 0.0) -> None:
        self.put(*(Frame(REQUEST_ID, part) for part in parts), gap_s=gap_s)

    def put_wire(self, wire: bytes, can_id: int = REQUEST_ID) -> None:
        self.put(*(Frame(can_id, part) for part in payloads(wire)))

    def say(
        self, command: int, data: bytes = b"", *, mode: int = WRITE, can_id: int = REQUEST_ID
    ) -> None:
        """One message."""
        self.put_wire(build(can_id, mode, command, data), can_id)

    # -- the dialogue -----------------------------------------------------------------------------

    def reset(self) -> None:
        self.say(0x4205, b"RESET")

    def boot(self) -> None:
        """Reset, and wait for the first boot version."""
        self.reset()
        self.run(0.055)
        self.heard()

    def update(self, size_bytes: int) -> None:
        self.put_wire(update_wire(size_bytes))

    def packet(self, number: int, image: bytes, can_id: int = REQUEST_ID) -> None:
        """A packet of the image, and time to store it."""
        self.put_wire(packet_wire(number, image, can_id), can_id)
        self.run(0.005)

    def end(self) -> None:
        self.say(0xA401, b"\x04")
        self.run(0.005)

    def transfer(self, image: bytes, stored: int = 0) -> None:
        """From the application to where packet `stored` + 1 is awaited."""
        self.boot()
        self.update(len(image))
        self.run(0.03)
        for number in range(1, stored + 1):
            self.packet(number, image)
        self.heard()

    def upgrade(self, image: bytes) -> list[str]:
        """A whole upgrade; the answers to the end of transfer."""
        self.transfer(image, -(-len(image) // 128))
        self.end()
        answers = self.heard()
        self.run(0.2)
        return answers

    def cycle_power(self) -> None:
        self.device.power_cut(self.now)
        self.run(0.5)
        self.device.power_on(self.now)

    def asks_version(self) -> list[str]:
        """What is answered when the application is asked for its version."""
        self.heard()
        self.say(0x3300, mode=READ)
        self.run(0.005)
        return self.heard()

    # -- received messages ------------------------------------------------------------------------

    def heard(self, kind: str = "") -> list[str]:
        """Messages since the last call; those of one kind, or all."""
        return [name for _, name in self.heard_at(kind)]

    def heard_at(self, kind: str = "") -> list[tuple[float, str]]:
        self._collect()
        heard, self._heard = self._heard, []
        return [(at_s, name) for at_s, name in heard if name.startswith(kind)]

    def _collect(self) -> None:
        while (frame := self.device.next_frame(self.now)) is not None:
            self.device.frame_sent(self.now)
            wire = self._partial.pop(frame.can_id, b"") + frame.data
            if len(wire) < 4 or len(wire) < wire[3] + 9:
                self._partial[frame.can_id] = wire
            else:
                self._heard.append((self.now, self._name(frame.can_id, wire)))
        self.device.take_events()

    def _name(self, can_id: int, wire: bytes) -> str:
        if not intact(can_id, wire):
            return "damaged"
        command = int.from_bytes(wire[4:6], "big")
        if command == 0x1540:
            self.version_texts.append(wire[54:69].decode("latin-1"))
        name = _NAMES.get(command, f"{command:04X}")
        if name in {"ack", "nak"}:
            name = f"{name} {int.from_bytes(wire[6:8], 'little')}"
        return name if can_id == ANSWER_ID else f"{can_id:03X} {name}"


def update_wire(size_bytes: int, text: bytes = b"BMS_UPD") -> bytes:
    return build(REQUEST_ID, WRITE, 0xA10B, text + struct.pack("<I", size_bytes))


def packet_wire(
    number: int,
    image: bytes,
    can_id: int = REQUEST_ID,
    *,
    start: int = 1,
    total: int | None = None,
    filler: bytes = b"\xff",
) -> bytes:
    """A packet, with a head that may be wrong."""
    part = image[(number - 1) * 128 : number * 128].ljust(128, filler)
    count = -(-len(image) // 128) if total is None else total
    return build(can_id, WRITE, 0xA385, struct.pack("<BHH", start, number, count) + part)
