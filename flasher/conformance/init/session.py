"""Session of one question of `init`: a transfer of the good image that can always be completed.

So the device runs again without leaving the transfer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.probe import PacketTransfer
from flasher.conformance.judge import TimeName
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.restore import needs_power
from flasher.conformance.results import CaseStopped, Unsupported
from flasher.conformance.subject import Subject
from flasher.conformance.waits import Waits
from flasher.conformance.wire import DeviceDecoder, RawFrame, Received, Reply, describe

REPEATS: Final = 3
"""How often to repeat a trial."""
ANSWER_S: Final = 5.0
"""How long to wait for the answer to a packet before its limit is known."""
_UPGRADES_MAX: Final = 200
"""More than any question takes, at the limits of the profile."""
_ASK_S: Final = 0.05
_BURST_GAP_S: Final = 1.5
"""Longer than the gap between two boot versions of a burst."""
_VERSIONS_MAX: Final = 100
_QUIET_START_S: Final = 2.0
"""Longest assumed window of a device that reports no version."""


class InitSession(PacketTransfer):
    """Bench and transfer for one question; the good image runs before and after it."""

    def __init__(
        self, subject: Subject, profile: ConformanceProfile, stopped: Callable[[], bool]
    ) -> None:
        waits = Waits(profile, subject.port.bitrate_bps)
        limit_s = _UPGRADES_MAX * waits.upgrade_s(len(subject.good_image))
        bench = Bench(subject, profile, limit_s=limit_s, seed="init", stopped=stopped)
        super().__init__(bench, subject.good_image)

    def settle(self) -> None:
        """Wait until a device without a version query has left its bootloader, which a reset to
        test its application may have entered.
        """
        bench = self.bench
        if not bench.encoder.has_version_query:
            quiet_s = max(bench.limit("first_version_s"), _QUIET_START_S)
            while bench.wait_for(Reply.BOOT_VERSION, within_s=quiet_s) is not None:
                pass

    # -- the application --------------------------------------------------------------------------

    def await_application(self, name: str = "", since: float = 0.0) -> None:
        """Wait until the application answers; records the time since `since` under `name`."""
        bench = self.bench
        within_s = bench.limit("start_s") + bench.waits.burst_s
        if not bench.encoder.has_version_query:
            # The only query would be a reset, which restarts the bootloader.
            if name:
                bench.measure(name, self._reset_answered(within_s) - since)
            self.settle()
            return
        reply = bench.host.version_answer(within_s, every_s=_ASK_S)
        found = bench.require_received(reply, "an application that answers", within_s)
        if name:
            bench.measure(name, found.at - since)
        bench.forget()

    def _reset_answered(self, within_s: float) -> float:
        """Reset until the application answers by general feedback; returns when that was sent."""
        bench = self.bench
        deadline = bench.now + within_s
        while True:
            # In its announcements, a reset may restart the bootloader.
            while bench.wait_for(Reply.BOOT_VERSION, within_s=_BURST_GAP_S) is not None:
                pass
            with bench.tester.collecting_feedback():
                sent = bench.send(bench.encoder.reset())
                reply = bench.wait_for(Reply.FEEDBACK)
            if reply is not None or bench.now >= deadline:
                bench.require_received(reply, "an application that answers", within_s)
                return sent.at

    # -- the bootloader ---------------------------------------------------------------------------

    def enter(self, version: int = 1) -> Received:
        """Reset the application and return boot version number `version` of the burst. Where there
        is no version query, the application may still be starting, and the reset is repeated.
        """
        bench, within_s = self.bench, self.bench.limit("first_version_s")
        give_up_at = bench.now + bench.limit("start_s")
        found: Received | None = None
        while found is None:
            try:
                found = bench.reset_measured(within_s)
            except CaseStopped:
                if bench.encoder.has_version_query or bench.now > give_up_at:
                    raise
        for _ in range(version - 1):
            found = bench.await_message(Reply.BOOT_VERSION, within_s=_BURST_GAP_S)
        return found

    def more_versions(self) -> list[Received]:
        """Collect boot versions until no more arrive."""
        found: list[Received] = []
        while len(found) < _VERSIONS_MAX:
            reply = self.bench.wait_for(Reply.BOOT_VERSION, within_s=_BURST_GAP_S)
            if reply is None:
                break
            found.append(reply)
        return found

    def offer_update(self, frames: Sequence[RawFrame]) -> bool:
        """Send a possible update command for the good image; True when it is accepted. A device may
        process one that arrives in its burst only after it.
        """
        bench = self.bench
        sent = bench.send(frames)
        within_s = bench.limit("erase_s") + bench.waits.burst_s
        reply = bench.wait_for(Reply.REQUEST, within_s=within_s)
        if reply is not None:
            bench.measure(TimeName.REQUEST, reply.at - sent.left_at)
            self.stored = 0
        return reply is not None

    def begin(self) -> None:
        """Reset the running application and get request transfer."""
        self.enter()
        self.update()

    def update(self) -> None:
        """Get request transfer from a listening bootloader."""
        self.bench.update(len(self.image))
        self.stored = 0

    def why_no_exit(self) -> str:
        """Why no transfer of this device can be ended early; "" when one can."""
        bench = self.bench
        if bench.subject.has_power:
            return ""
        if needs_power(bench.profile):
            return "only a power cycle ends a transfer, and the bench cannot switch power"
        if bench.choice("tx_13") != "restarts" and bench.choice("tx_12") != "announces":
            return "neither reset nor pause ends a transfer, and the bench cannot switch power"
        return ""

    # -- the transfer -----------------------------------------------------------------------------

    def packets(self, last: int | None = None) -> None:
        """Send the packets up to `last` (default: the last of the image)."""
        final = self.total if last is None else last
        self.bench.forget()
        self.bench.packets(self.image, self.stored + 1, final)
        self.stored = max(self.stored, final)

    def finish(self) -> None:
        """Send the remaining packets and end of transfer; wait for the application."""
        self.packets()
        self.bench.end_transfer()
        self.await_application()

    def reach(self, stored: int, left: int) -> None:
        """Send packets until at least `stored` are stored and `left` remain, in a new transfer if
        necessary.

        Raises Unsupported when the image is too small.
        """
        if self.total < stored + left:
            raise Unsupported(f"the good image has fewer than {stored + left} packets")
        if self.total - self.stored < left:
            self.finish()
            self.begin()
        self.packets(max(stored, self.stored))

    def offer(
        self, frames: Sequence[RawFrame], *, gap_s: float = 0.0, gaps: int | None = None
    ) -> bool:
        """Send frames that contain the next packet; True when it is acknowledged. Otherwise sends
        it unchanged, so that it is stored afterwards in any case.
        """
        taken = any(map(self.is_accepted, self.answers(frames, gap_s=gap_s, gaps=gaps)))
        if taken:
            self.stored += 1
        else:
            self.deliver_packet()
        return taken

    def deliver_packet(self) -> None:
        """Send the next packet unchanged until it is acknowledged."""
        bench = self.bench
        bench.forget()
        number = self.stored + 1
        trouble = bench.host.deliver_packet(self.image, number, bench.now)
        if trouble.startswith(Reply.BOOT_VERSION.value):
            self.begin_again(number)
            return
        bench.require(not trouble, f"ACK {number}", trouble or "ACK")
        self.stored = number

    def begin_again(self, number: int) -> None:
        """Send the packets up to `number` in a new transfer: a wait became a pause (tx_12)."""
        self.update()
        self.packets(number)

    def feedback_since(self, moment: float) -> int:
        """Count general feedback since `moment`, including messages that were not collected."""
        bench = self.bench
        decoder, since_s = DeviceDecoder(bench.encoder), moment - bench.tester.began_at
        return sum(
            reply.kind is Reply.FEEDBACK
            for entry in bench.tester.trace
            if not entry.sent and entry.at_s > since_s
            for reply in decoder.feed(entry.frame, entry.at_s)
        )


def answer_text(replies: Sequence[Received]) -> str:
    """Answers as text, "silence" without any."""
    return describe(replies) if replies else "silence"
