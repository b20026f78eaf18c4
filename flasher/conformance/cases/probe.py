"""A transfer that is never ended, for the cases about framing, checksum and gaps. Whether its next
packet is acknowledged shows how the device took the bytes before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.wire import (
    PACKET_BYTES,
    MessageKind,
    RawFrame,
    Received,
    describe,
    joined,
    packet_count,
)

ACCEPTED: Final = "accepted"
REJECTED: Final = "rejected"
EITHER: Final = "either"
_PACKETS: Final = 48
"""More than any case here needs; a device that takes smaller images begins again."""
_REST: Final = bytes(5)
_QUIET_S: Final = 0.05
"""Behind an ACK, for what else is said to the same bytes (R10)."""


def complies(wanted: str, taken: bool) -> bool:  # noqa: FBT001
    """True when a message that was taken, or not, complies with one of the three words above."""
    return wanted == EITHER or taken == (wanted == ACCEPTED)


class PacketTransfer:
    """A transfer of `image` that goes on packet by packet; so many of them are `stored`."""

    def __init__(self, bench: Bench, image: bytes) -> None:
        self.bench = bench
        self.image = image
        self.total = packet_count(len(image))
        self.stored = 0

    @property
    def number(self) -> int:
        """Of the packet that is next."""
        return self.stored + 1

    def packet(self, number: int) -> list[RawFrame]:
        """A packet of the image."""
        return self.bench.encoder.packet_of(self.image, number)

    def frames(self) -> list[RawFrame]:
        """The next packet as it should be."""
        return self.packet(self.number)

    def raw(self) -> bytes:
        """The next packet, header to tail."""
        return joined(self.frames())

    def settle_s(self) -> float:
        """Longer than a bootloader waits for the rest of a message."""
        return 2 * self.bench.limit("inter_frame_s")

    def is_accepted(self, heard: Received) -> bool:
        """True for the ACK of the next packet."""
        return heard.kind is MessageKind.ACK and heard.number == self.number

    def answers(
        self, frames: Sequence[RawFrame], *, gap_s: float = 0.0, gaps: int | None = None
    ) -> list[Received]:
        """Send frames that hold the next packet, `gap_s` behind each of the first `gaps` of them
        (None: between all); the messages up to its ACK, and shortly after it.
        """
        bench = self.bench
        bench.forget()
        bench.send(frames, gap_s=gap_s, gaps=gaps)
        # Long enough, too, that nothing of it is left when the next packet comes.
        deadline = bench.now + max(bench.limit("ack_s"), self.settle_s())
        heard: list[Received] = []
        while (one := bench.next_message(deadline - bench.now)) is not None:
            heard.append(one)
            if self.is_accepted(one):
                return heard + bench.collect(_QUIET_S)
        return heard


class Probe(PacketTransfer):
    """A transfer (of some packets of chance by default) for stimuli that are judged.

    With "accepted" the stimulus has to be acknowledged as the next packet. With "rejected" it must
    not be, and NAK or silence are both right: which of them, with which number, is TX-01. With
    "either" both will do. In every case the next packet as it should be has to be taken then.
    """

    def __init__(self, bench: Bench, image: bytes | None = None) -> None:
        largest = bench.number("largest_image_bytes")
        wanted = bench.filler(_PACKETS) if image is None else image
        # Some bytes more, as a whole number of packets is a matter of its own (UP-01).
        super().__init__(bench, (wanted + _REST)[:largest])
        self._taken_at = bench.now

    def begin(self) -> None:
        """From the running application to request transfer."""
        self.bench.start_transfer(len(self.image))
        self._taken_at = self.bench.now

    def enter(self, frames: Sequence[RawFrame], wanted: str, *, reset: bool = True) -> None:
        """Send what holds the update command to the announcing bootloader, judge whether it is
        taken as `wanted`, and get request transfer in any case.
        """
        bench = self.bench
        if reset:
            bench.reset_to_bootloader()
            bench.wait_until_listening()
        sent = bench.send(frames)
        heard = bench.host.request_or_version(sent.left_at, bench.limit("erase_s"))
        taken = heard is not None and heard.kind is MessageKind.REQUEST
        bench.check(complies(wanted, taken), f"update command {wanted}", heard or "no answer")
        if not taken:
            if reset and heard is None:  # by now the application was started
                bench.reset_to_bootloader()
            bench.update(len(self.image))
        self.stored, self._taken_at = 0, bench.now

    def enter_after_rejected(self, *stimuli: Sequence[RawFrame]) -> None:
        """At the first boot version, send what has to be rejected: it announces itself on, with NAK
        at the most in between, and takes the update command then.
        """
        bench = self.bench
        bench.reset_to_bootloader()
        for frames in stimuli:
            bench.send(frames)
        is_burst = bench.number("versions") > 1
        half_s = bench.limit("window_s") / 2
        deadline = bench.now + (4 * bench.limit("version_spacing_s") if is_burst else half_s)
        heard: list[Received] = []
        while (one := bench.next_message(deadline - bench.now)) is not None:
            heard.append(one)
            if one.kind is not MessageKind.NAK:
                break
        ok = all(one.kind in (MessageKind.NAK, MessageKind.BOOT_VERSION) for one in heard)
        goes_on = not is_burst or (bool(heard) and heard[-1].kind is MessageKind.BOOT_VERSION)
        bench.require(ok and goes_on, "boot version, NAK at the most before it", describe(heard))
        bench.update(len(self.image))
        self.stored, self._taken_at = 0, bench.now

    def frames(self) -> list[RawFrame]:
        """The next packet as it should be; begins a new transfer when all were sent."""
        if self.stored == self.total:
            self.bench.restart_transfer(len(self.image))
            self.stored = 0
        return super().frames()

    # -- stimuli ----------------------------------------------------------------------------------

    def send_next(self) -> None:
        """The next packet as it should be; its ACK has to come, else the case ends."""
        self.frames()
        self.bench.forget()
        self.bench.packet(self.image, self.number)
        self._note_stored()

    def keep_alive(self) -> None:
        """Send the next packet when none was taken for so long that the device may soon give the
        transfer up (TX-12).
        """
        if self.bench.now - self._taken_at > self.bench.limit("pause_s") / 2:
            self.bench.wait(self.settle_s())
            self.send_next()

    def offer(
        self,
        frames: Sequence[RawFrame],
        wanted: str,
        *,
        gap_s: float = 0.0,
        gaps: int | None = None,
        ignoring: Sequence[MessageKind] = (),
    ) -> bool:
        """Send `frames`, as `answers` does, and judge whether the next packet is taken as `wanted`;
        sends it as it should be when it was not. Messages of the kinds `ignoring` do not count.
        Returns whether it was taken.
        """
        heard = self.answers(frames, gap_s=gap_s, gaps=gaps)
        taken = any(map(self.is_accepted, heard))
        allowed = (MessageKind.NAK, *ignoring)
        others = [one for one in heard if one.kind not in allowed and not self.is_accepted(one)]
        expected = {
            ACCEPTED: f"ACK {self.number}",
            REJECTED: "NAK or no answer",
            EITHER: f"ACK {self.number}, NAK or no answer",
        }
        ok = complies(wanted, taken) and not others
        self.bench.check(ok, expected[wanted], describe(heard))
        if taken:
            self._note_stored()
        else:
            self.send_next()
        return taken

    def check_discarded(self, frames: Sequence[RawFrame]) -> None:
        """Send what has to be discarded: NAK or no answer, and after a pause the next packet is
        taken. A device that takes it ends the case, as it may have stored anything.
        """
        bench = self.bench
        bench.forget()
        bench.send(frames)
        heard = bench.collect(self.settle_s())
        ok = all(one.kind is MessageKind.NAK for one in heard)
        bench.require(ok, "NAK or no answer", describe(heard))
        self.send_next()

    def check_stored(self) -> None:
        """What was acknowledged is in the flash, and is right; the last packet of it may be on its
        way (PW-01), and what the profile lets the device keep in memory.
        """
        bench = self.bench
        written = (self.number - 2) * PACKET_BYTES - bench.number("buffer_bytes")
        if written > 0:
            bench.check_stored(self.image[:written])
        else:
            bench.unsupported("the flash holds the image", "all of it may be in a buffer still")

    def _note_stored(self) -> None:
        self.stored += 1
        self._taken_at = self.bench.now
