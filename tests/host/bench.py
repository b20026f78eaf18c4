"""An `Upgrade` on a virtual clock, with the test in the place of the device.

`expect` lets time pass until the host has sent its next message, `say` lets the device speak now,
`wait` lets time pass in silence. Frames take their exact time on a 250 kbit/s bus.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import TypeVar

from flasher.host.options import UpgradeOptions
from flasher.host.outcome import Outcome
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.protocol.bittime import frame_bits
from flasher.protocol.frame import Frame
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Malformed,
    Packet,
    RequestTransfer,
    ResetCommand,
    Unknown,
    UpdateCommand,
    UpgradeMessage,
    decode,
)
from flasher.protocol.spec import BMS, WELLING, Target
from flasher.protocol.wire import Message, Reassembler, encode, split
from tests.firmware import VECTORS
from tests.host.upgrade import Upgrade

BOOT = BootVersion("BMS", "V1.2.3")
SentRow = TypeVar("SentRow", bound=UpgradeMessage | Message)
"""What the host sends: rows of the upgrade, and queries of chapter 3 as they are on the wire."""


def image_of(size_bytes: int, seed: int = 1) -> Image:
    """An image of random bytes after a vector table, without a version inside."""
    data = VECTORS + random.Random(seed).randbytes(size_bytes)
    return Image.from_bytes(data[:size_bytes])


def answer_frames(row: UpgradeMessage, target: Target = BMS) -> list[Frame]:
    """A message of the device as CAN frames."""
    return split(target.answer_id, encode(row.to_message(target.answer_id)))


class Bench:
    """The host under test, its time, and what it has sent."""

    def __init__(
        self,
        size_bytes: int = 300,
        *,
        target: Target = BMS,
        image: Image | None = None,
        options: UpgradeOptions | None = None,
    ) -> None:
        self.image = image or image_of(size_bytes)
        self.target = target
        self.now = 100.0
        self.engine = Upgrade(plan(self.image, target, WELLING.bitrate_bps), options)
        self.events: list[object] = []
        self.sent: list[tuple[float, UpgradeMessage | Message]] = []
        """Every message that has left the host, with the time at which its last frame had."""
        self.on_frame: Callable[[int], None] | None = None
        """Called with the number of frames sent so far, before the engine gets each."""
        self._frames = 0
        self._read = 0
        self._wire = Reassembler(target.request_id, 1.0)
        self._step()

    # -- time ------------------------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        """Let time pass; the device is silent."""
        end = self.now + seconds
        while not self.engine.done:
            wanted = self.engine.deadline()
            if wanted is None or wanted > end:
                break
            self.now = max(self.now, wanted)
            self._step()
        self.now = max(self.now, end)

    def expect(self, kind: type[SentRow], within_s: float = 60.0) -> SentRow:
        """The host's next message, which must be of this kind; time passes until it has left."""
        end = self.now + within_s
        while self._read >= len(self.sent):
            wanted = self.engine.deadline()
            assert wanted is not None, f"the host ended instead of sending {kind.__name__}"
            assert wanted <= end, f"no {kind.__name__} within {within_s} s"
            self.now = max(self.now, wanted)
            self._step()
        _, row = self.sent[self._read]
        self._read += 1
        assert isinstance(row, kind), f"sent {row}, expected {kind.__name__}"
        return row

    @property
    def unread(self) -> list[UpgradeMessage | Message]:
        """What the host has sent and no `expect` has taken."""
        return [row for _, row in self.sent[self._read :]]

    def _step(self) -> None:
        self.engine.tick(self.now)
        self._flush()

    def _flush(self) -> None:
        while (frame := self.engine.next_frame(self.now)) is not None:
            self._frames += 1
            if self.on_frame is not None:
                self.on_frame(self._frames)
            self.now += frame_bits(frame) / WELLING.bitrate_bps
            self.engine.frame_sent(self.now - frame_bits(frame) / WELLING.bitrate_bps)
            for found in self._wire.feed(frame.data, self.now):
                assert isinstance(found, Message), found
                row = decode(found)
                assert not isinstance(row, Malformed), row
                self.sent.append((self.now, found if isinstance(row, Unknown) else row))
        self.events += self.engine.take_events()

    # -- the device ------------------------------------------------------------------------------

    def say(self, *rows: UpgradeMessage | Message) -> None:
        """The device sends messages now, in no time."""
        for row in rows:
            message = row if isinstance(row, Message) else row.to_message(self.target.answer_id)
            for frame in split(message.can_id, encode(message)):
                self.engine.receive(frame, self.now)
        self.events += self.engine.take_events()
        self._flush()

    def to_boot(self) -> None:
        """Up to the boot version, which is not announced yet."""
        self.expect(ResetCommand)
        self.say(GeneralFeedbackMessage())

    def to_request(self) -> None:
        """Up to the update command, which is not answered yet."""
        self.to_boot()
        self.say(BOOT)
        self.expect(UpdateCommand)

    def to_packet(self, number: int) -> Packet:
        """Up to packet `number`, which has left and is not answered yet."""
        self.to_request()
        self.say(RequestTransfer())
        return self.on_to_packet(number, first=1)

    def to_transfer(self) -> None:
        """Up to packet 1, which is not answered yet."""
        self.to_packet(1)

    def on_to_packet(self, number: int, *, first: int) -> Packet:
        """From packet `first`, which is on its way, to `number`."""
        for current in range(first, number):
            assert self.expect(Packet).number == current
            self.say(Ack(current))
        packet = self.expect(Packet)
        assert packet.number == number
        return packet

    def to_end(self) -> None:
        """Up to end of transfer, which has left and is not answered yet."""
        self.to_request()
        self.say(RequestTransfer())
        self.on_to_end(first=1)

    def on_to_end(self, *, first: int) -> None:
        """From packet `first`, which is expected next, up to end of transfer."""
        total = -(-self.image.size_bytes // 128)
        self.on_to_packet(total, first=first)
        self.say(Ack(total))
        self.expect(EndOfTransfer)

    def complete(self) -> Outcome:
        """The device confirms; the outcome."""
        self.say(Complete())
        return self.outcome

    @property
    def outcome(self) -> Outcome:
        assert self.engine.done, self.engine.state
        return self.engine.outcome

    def seen(self, kind: type) -> list[object]:
        """The events of a kind so far."""
        return [event for event in self.events if isinstance(event, kind)]
