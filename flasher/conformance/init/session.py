"""A device that is asked: the bench of one question, in upgrades to the good image alone. Whatever
is tried in such a transfer, the right packets and the end can follow, so that the device runs again
without a way out of a transfer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.probe import PacketTransfer
from flasher.conformance.judge import Times
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.results import Unsupported
from flasher.conformance.subject import Subject
from flasher.conformance.wire import (
    DeviceDecoder,
    MessageKind,
    RawFrame,
    Received,
    describe,
)

REPEATS: Final = 3
"""How often a question is asked."""
_LIMIT_S: Final = 7200.0
_ASK_S: Final = 0.05
_BURST_GAP_S: Final = 1.5
"""Two boot versions of a burst are not so far apart."""
_VERSIONS_MAX: Final = 100
_QUIET_START_S: Final = 2.0
"""No window is longer, as far as a device is waited for that tells no version."""


class InitSession(PacketTransfer):
    """A device whose good image runs, when the question begins and when it ends."""

    def __init__(
        self, subject: Subject, profile: ConformanceProfile, stopped: Callable[[], bool]
    ) -> None:
        bench = Bench(subject, profile, limit_s=_LIMIT_S, seed="init", stopped=stopped)
        super().__init__(bench, subject.good_image)

    def settle(self) -> None:
        """Wait until a device that tells no version has certainly left its bootloader: it may have
        been reset to see whether its application runs.
        """
        bench = self.bench
        if not bench.encoder.has_version_query:
            quiet_s = max(bench.limit("first_version_s"), _QUIET_START_S)
            while bench.wait_for(MessageKind.BOOT_VERSION, within_s=quiet_s) is not None:
                pass

    # -- the application --------------------------------------------------------------------------

    def await_application(self, name: str = "", since: float = 0.0) -> None:
        """Wait until the application answers; `name` is what the time since then is recorded as."""
        bench = self.bench
        within_s = bench.limit("start_s") + bench.host.burst_s
        if not bench.encoder.has_version_query:
            # A reset would be the only question, and begin all anew.
            self.settle()
            if name:
                runs = bench.application_runs()
                bench.require(runs, "an application that answers", "no answer")
                bench.measure(name, bench.now - since)
                self.settle()
            return
        heard = bench.host.version_answer(within_s, every_s=_ASK_S)
        found = bench.require_received(heard, "an application that answers", within_s)
        if name:
            bench.measure(name, found.at - since)
        bench.forget()

    # -- the bootloader ---------------------------------------------------------------------------

    def enter(self, version: int = 1) -> Received:
        """Reset the application; returns that boot version of the burst."""
        bench = self.bench
        found = bench.reset_measured(bench.limit("first_version_s"))
        for _ in range(version - 1):
            found = bench.await_message(MessageKind.BOOT_VERSION, within_s=_BURST_GAP_S)
        return found

    def more_versions(self) -> list[Received]:
        """The boot versions that follow, until none comes any more."""
        found: list[Received] = []
        while len(found) < _VERSIONS_MAX:
            heard = self.bench.wait_for(MessageKind.BOOT_VERSION, within_s=_BURST_GAP_S)
            if heard is None:
                break
            found.append(heard)
        return found

    def offer_update(self, frames: Sequence[RawFrame]) -> bool:
        """Send what may be an update command for the good image; True when it is taken."""
        bench = self.bench
        sent = bench.send(frames)
        heard = bench.wait_for(MessageKind.REQUEST)
        if heard is not None:
            bench.measure(Times.REQUEST, heard.at - sent.left_at)
            self.stored = 0
        return heard is not None

    def begin(self) -> None:
        """From the running application to request transfer."""
        self.enter()
        self.update()

    def update(self) -> None:
        """From a bootloader that listens to request transfer."""
        self.bench.update(len(self.image))
        self.stored = 0

    # -- the transfer -----------------------------------------------------------------------------

    def packets(self, last: int | None = None) -> None:
        """All packets up to the `last` one of these, or of the image."""
        final = self.total if last is None else last
        self.bench.forget()
        self.bench.packets(self.image, self.stored + 1, final)
        self.stored = max(self.stored, final)

    def finish(self) -> None:
        """The packets that are left, and the end; the application starts."""
        self.packets()
        self.bench.end_transfer()
        self.await_application()

    def reach(self, stored: int, left: int) -> None:
        """So many packets stored at the least and so many left, if need be in a new transfer.

        Raises Unsupported for an image that is too small for that.
        """
        if self.total < stored + left:
            raise Unsupported(f"the good image has less than {stored + left} packets")
        if self.total - self.stored < left:
            self.finish()
            self.begin()
        self.packets(max(stored, self.stored))

    def offer(
        self, frames: Sequence[RawFrame], *, gap_s: float = 0.0, gaps: int | None = None
    ) -> bool:
        """Send frames that hold the next packet; True when it is acknowledged. It is stored
        afterwards, one way or the other.
        """
        taken = any(map(self.is_accepted, self.answers(frames, gap_s=gap_s, gaps=gaps)))
        if taken:
            self.stored += 1
        else:
            self.deliver_packet()
        return taken

    def deliver_packet(self) -> None:
        """The next packet as it should be, more than once if need be."""
        bench = self.bench
        bench.forget()
        trouble = bench.host.deliver_packet(self.image, self.stored + 1, bench.now)
        bench.require(not trouble, f"ACK {self.stored + 1}", trouble or "ACK")
        self.stored += 1

    def feedback_since(self, moment: float) -> int:
        """How many messages of general feedback came after that time, heard or not."""
        bench = self.bench
        decoder, since_s = DeviceDecoder(bench.encoder), moment - bench.tester.began_at
        return sum(
            heard.kind is MessageKind.FEEDBACK
            for entry in bench.tester.trace
            if not entry.sent and entry.at_s > since_s
            for heard in decoder.feed(entry.frame, entry.at_s)
        )


def answer_text(heard: Sequence[Received]) -> str:
    """Some answers in words."""
    return describe(heard) if heard else "silence"
