"""Transfers that are never ended, for cases about framing, checksum and gaps.

Whether the next packet is acknowledged shows how the device handled the preceding bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.wire import (
    PACKET_BYTES,
    RawFrame,
    Received,
    Reply,
    describe,
    joined,
    packet_count,
)

ACCEPTED: Final = "accepted"
REJECTED: Final = "rejected"
EITHER: Final = "either"
_PACKETS: Final = 48
"""More than any case needs; with smaller images the probe starts a new transfer."""
_REST: Final = bytes(5)
_QUIET_S: Final = 0.05
"""Time after an ACK during which further answers to the same bytes may arrive (R10)."""


def complies(wanted: str, taken: bool) -> bool:  # noqa: FBT001
    """True when the outcome `taken` matches ACCEPTED, REJECTED or EITHER."""
    return wanted == EITHER or taken == (wanted == ACCEPTED)


def _is_nak(one: Received) -> bool:
    return one.kind is Reply.NAK


class PacketTransfer:
    """A transfer of `image`, packet by packet; `stored` counts the packets acknowledged so far."""

    def __init__(self, bench: Bench, image: bytes) -> None:
        self.bench = bench
        self.image = image
        self.total = packet_count(len(image))
        self.stored = 0

    @property
    def number(self) -> int:
        """Number of the next packet."""
        return self.stored + 1

    def packet(self, number: int) -> list[RawFrame]:
        return self.bench.encoder.packet_of(self.image, number)

    def frames(self) -> list[RawFrame]:
        """Frames of the next packet, unchanged."""
        return self.packet(self.number)

    def raw(self) -> bytes:
        """The next packet as bytes, header to tail."""
        return joined(self.frames())

    def is_accepted(self, reply: Received) -> bool:
        """True for the ACK of the next packet."""
        return reply.kind is Reply.ACK and reply.number == self.number

    def answers(
        self, frames: Sequence[RawFrame], *, gap_s: float = 0.0, gaps: int | None = None
    ) -> list[Received]:
        """Send frames that contain the next packet, with `gap_s` after each of the first `gaps`
        frames (None: all). Returns the messages up to its ACK and shortly after.
        """
        bench = self.bench
        bench.forget()
        bench.send(frames, gap_s=gap_s, gaps=gaps)
        # Long enough that no partial message is left when the next packet arrives.
        deadline = bench.now + bench.waits.settle_s
        replies: list[Received] = []
        while (one := bench.next_message(deadline - bench.now)) is not None:
            replies.append(one)
            if self.is_accepted(one):
                return replies + bench.collect(_QUIET_S)
        return replies


class Probe(PacketTransfer):
    """A transfer of random packets (by default) that judges stimuli.

    With ACCEPTED the stimulus has to be acknowledged as the next packet. With REJECTED it must not
    be; NAK and silence are both correct (TX-01 checks which). EITHER allows both. In every case the
    unchanged packet has to be acknowledged afterwards.
    """

    def __init__(self, bench: Bench, image: bytes | None = None) -> None:
        largest = bench.number("largest_image_bytes")
        wanted = bench.filler(_PACKETS) if image is None else image
        # Not a whole number of packets; UP-01 covers that.
        super().__init__(bench, (wanted + _REST)[:largest])

    def begin(self) -> None:
        """Reset the running application and get request transfer."""
        self.bench.start_transfer(len(self.image))

    def enter(self, frames: Sequence[RawFrame], wanted: str, *, reset: bool = True) -> None:
        """Send frames that contain the update command to the announcing bootloader, check whether
        it is accepted as `wanted`, and get request transfer in any case.
        """
        bench = self.bench
        if reset:
            bench.reset_to_window()
        reply = bench.await_request(bench.send(frames))
        taken = reply is not None and reply.kind is Reply.REQUEST
        bench.check(complies(wanted, taken), f"update command {wanted}", reply or "no answer")
        if not taken:
            lasts = bench.choice("up_08") == "starts_over" and not bench.is_pause_near(
                bench.waits.settle_s
            )
            if reply is not None or (lasts and not reset):
                bench.update(len(self.image))
            else:
                bench.update_again(len(self.image), may_be_whole=reset)
        self.stored = 0

    def enter_after_rejected(self, *stimuli: Sequence[RawFrame]) -> None:
        """Once the device listens, send stimuli that have to be rejected: it may answer NAK,
        continues to announce itself, and then accepts the update command.
        """
        bench = self.bench
        is_burst = bench.number("versions") > 1 and bench.choice("up_04_burst") == "accepted"
        bench.reset_to_bootloader()
        if not is_burst:
            bench.wait_for_window()
        for frames in stimuli:
            bench.send(frames)
            bench.judge.note_stimulus()
        if is_burst:
            expected = "boot version, at most NAK before it"
            found = bench.wait_for(*Reply, within_s=bench.waits.next_version_s, unlike=_is_nak)
            is_version = found is not None and found.kind is Reply.BOOT_VERSION
            bench.require(is_version, expected, found or "nothing")
        bench.update(len(self.image))
        bench.judge.note_listening(listens=bench.update_tries == 1)
        self.stored = 0

    def frames(self) -> list[RawFrame]:
        """Frames of the next packet; starts a new transfer when all packets were sent."""
        if self.stored == self.total:
            self.bench.restart_transfer(len(self.image))
            self.stored = 0
        return super().frames()

    # -- stimuli ----------------------------------------------------------------------------------

    def send_next(self) -> None:
        """Send the next packet unchanged; without its ACK the case ends."""
        self.frames()
        self.bench.forget()
        self.bench.packet(self.image, self.number)
        self.stored += 1

    def keep_alive(self, packets: int = 1) -> None:
        """Send the next packet when a pause may end the transfer (TX-12) before `packets` more
        are sent and answered.
        """
        waits = self.bench.waits
        if self.bench.is_pause_near(2 * waits.settle_s + (1 + packets) * waits.packet_s):
            if not self.bench.is_pause_near(waits.settle_s + waits.packet_s):
                self.bench.wait(waits.settle_s)
            self.send_next()

    def offer(
        self,
        frames: Sequence[RawFrame],
        wanted: str,
        *,
        gap_s: float = 0.0,
        gaps: int | None = None,
        ignoring: Sequence[Reply] = (),
    ) -> bool:
        """Send `frames` like `answers` and check whether the next packet is accepted as `wanted`;
        if it is not, send it unchanged. Ignores messages of the kinds `ignoring`. Returns whether
        the packet was accepted.
        """
        bench = self.bench
        replies = self.answers(frames, gap_s=gap_s, gaps=gaps)
        taken = any(map(self.is_accepted, replies))
        allowed = (Reply.NAK, *ignoring)
        others = [one for one in replies if one.kind not in allowed and not self.is_accepted(one)]
        expected = {
            ACCEPTED: f"ACK {self.number}",
            REJECTED: "NAK or no answer",
            EITHER: f"ACK {self.number}, NAK or no answer",
        }
        ok = complies(wanted, taken) and not others
        bench.check(ok, expected[wanted], describe(replies))
        bench.judge.note_stimulus(heard=bool(replies))
        if taken:
            self.stored += 1
            bench.continued_at = bench.tester.left_at
        else:
            self.send_next()
        return taken

    def check_discarded(self, frames: Sequence[RawFrame]) -> None:
        """Send frames that have to be discarded: NAK or no answer, then the next packet is
        accepted. Anything else ends the case, as the device may have stored other data.
        """
        bench = self.bench
        bench.forget()
        bench.send(frames)
        replies = bench.collect(self.bench.waits.settle_s)
        ok = all(one.kind is Reply.NAK for one in replies)
        bench.require(ok, "NAK or no answer", describe(replies))
        bench.judge.note_stimulus(heard=bool(replies))
        self.send_next()

    def check_stored(self) -> None:
        """Check that acknowledged packets are in the flash, except the last one, which may still be
        being written (PW-01), and what the profile allows the device to buffer.
        """
        bench = self.bench
        written = (self.number - 2) * PACKET_BYTES - bench.number("buffer_bytes")
        if written > 0:
            bench.check_stored(self.image[:written])
        else:
            bench.unsupported("the flash holds the image", "all of it may still be buffered")
