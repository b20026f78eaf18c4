"""Reference host of the suite, independent of flasher's own.

Upgrades the device from any state, repeats lost messages and reports the result without judging it.
Also detects whether an application runs.
"""

from __future__ import annotations

from math import inf
from typing import Final, NamedTuple

from flasher.conformance.profile_time import limits_of
from flasher.conformance.results import Unsupported
from flasher.conformance.tester import BusTester, Sent
from flasher.conformance.wire import MEMORY_BYTES, Received, Reply, packet_count, reported_version

PACKET_TRIES: Final = 5
END_TRIES: Final = 3
ATTEMPTS: Final = 3
_QUERY_PERIOD_S: Final = 0.2
"""Interval at which the tool repeats a query (4.3)."""
_QUERY_TRIES: Final = 5
"""Tries of a query within 1 s (4.3)."""
UPDATE_SPACING_S: Final = 0.03
"""Minimum gap between update commands; a boot version that arrives sooner was sent before the
command (R2).
"""
_QUIET_S: Final = 0.05
"""Required silence on the bus after a repetition (R10)."""
_SETTLE_S: Final = 0.3
"""Extra time after burst and window, where no application is started."""
_BLIND_S: Final = 1.0
"""A device that announces nothing for this long after a reset may be in a transfer."""
UPDATES_MAX: Final = 50
LEFTOVER_S: Final = 0.06
"""A boot version this soon after request transfer was sent before it (R11)."""
_PACKET_ANSWERS: Final = (Reply.ACK, Reply.NAK, Reply.BOOT_VERSION, Reply.COMPLETE)


def is_leftover(one: Received, requested_at: float) -> bool:
    """True for a boot version that was sent before request transfer, or a restart (R11)."""
    return one.kind is Reply.BOOT_VERSION and one.at < requested_at + LEFTOVER_S


class UpgradeResult(NamedTuple):
    """Result of an upgrade; `reason` is "" on success."""

    ok: bool
    reason: str = ""


class PatientHost:
    """Upgrades the device and queries its application through the tester of a case."""

    def __init__(self, tester: BusTester) -> None:
        self._tester = tester
        self._encoder = tester.encoder
        self._profile = tester.profile

    # -- application ------------------------------------------------------------------------------

    def application_version(self, within_s: float = 1.0) -> str | None:
        """Firmware version reported by the application; None when it does not answer.

        Raises Unsupported for a target without a version query.
        """
        reply = self.version_answer(within_s)
        return None if reply is None else reply.firmware

    def version_answer(
        self, within_s: float, *, every_s: float = _QUERY_PERIOD_S
    ) -> Received | None:
        """Query the version every `every_s` and return the first answer. Raises Unsupported."""
        if not self._encoder.has_version_query:
            raise Unsupported("the document has no version query for this target")
        tester, kind = self._tester, Reply.VERSION_INFORMATION
        deadline, unanswered, is_last = tester.now + within_s, 0, False
        while not is_last:
            # One that starts at the end of its limit answers the last query.
            is_last = tester.now >= deadline
            tester.send(self._encoder.query_version())
            left_s = every_s if is_last else min(every_s, deadline - tester.now)
            reply = tester.wait_for(kind, within_s=left_s)
            if reply is None:
                unanswered += 1
                continue
            # Collect the answers to earlier queries, so that none of them arrives later.
            late_s = _QUERY_PERIOD_S + _QUIET_S
            while unanswered and tester.wait_for(kind, within_s=late_s) is not None:
                unanswered -= 1
            return reply
        tester.expired = limits_of(within_s)
        return None

    def application_runs(self, within_s: float | None = None) -> bool:
        """True when an application answers `within_s` (default: `limits.start_s`).

        Without a version query, general feedback to a reset shows it; the device then runs through
        its bootloader, which is awaited.
        """
        limit_s = self._profile.limit("start_s") if within_s is None else within_s
        if self._encoder.has_version_query:
            return self.application_version(limit_s) is not None
        tester, limit = self._tester, self._profile.limit
        kinds = (Reply.FEEDBACK, Reply.BOOT_VERSION)
        deadline, start_s = tester.now + limit_s, tester.waits.burst_s + limit_s
        announced_at = inf  # first boot version after a reset: it may have restarted (RS-02)
        while True:
            # One that starts at the end of its limit answers the last reset.
            is_last = tester.now >= deadline and (
                announced_at == inf or tester.now >= announced_at + start_s
            )
            with tester.collecting_feedback():
                sent_at = tester.send(self._encoder.reset()).left_at
                ends_at = tester.now + limit("feedback_s")
                while reply := tester.wait_for(*kinds, within_s=ends_at - tester.now):
                    if reply.kind is Reply.FEEDBACK:
                        break
                    if not is_leftover(reply, sent_at):
                        announced_at = min(announced_at, reply.at)
            runs = reply is not None
            if runs or is_last:
                # A message sent before the application listens again would be lost.
                reply = tester.wait_for(Reply.BOOT_VERSION)
                if reply is not None and announced_at == inf and not runs:
                    # Each reset restarted the bootloader before it announced itself.
                    announced_at = reply.at
                    tester.wait_until(announced_at + start_s)
                    continue
                # A bootloader may send general feedback, too (R15): it does not restart, or goes on
                # announcing itself.
                if reply is None and not is_last:
                    continue
                runs = runs and reply is not None
                if reply is not None:
                    after_s = limit("start_s") if runs else _SETTLE_S
                    later = tester.collect(tester.waits.burst_s + after_s)
                    ends_at = reply.at + tester.waits.burst_s
                    runs = runs and all(one.at < ends_at for one in later)
                tester.expired = {} if runs else limits_of(limit_s)
                return runs
            # The reset may have started a burst, which another reset would restart.
            quiet_s = tester.waits.burst_s + _SETTLE_S
            while reply := tester.wait_for(Reply.BOOT_VERSION, within_s=quiet_s):
                announced_at = min(announced_at, reply.at)
                if tester.now >= max(deadline, announced_at + start_s):
                    break

    def read_memory(self, start: int, size_bytes: int) -> bytes | None:
        """Read memory of the application from `start` on; None when it does not answer."""
        tester, found = self._tester, b""
        end = start + size_bytes
        while len(found) < size_bytes:
            at = start + len(found)
            piece = min(MEMORY_BYTES, end - at)
            wanted = at.to_bytes(4, "little") + (at + piece).to_bytes(4, "little")
            for _ in range(_QUERY_TRIES):
                tester.send(self._encoder.query_memory(at, at + piece))
                reply = tester.wait_for(
                    Reply.MEMORY,
                    within_s=_QUERY_PERIOD_S,
                    unlike=lambda one, wanted=wanted: not one.data.startswith(wanted),  # type: ignore[misc]
                )
                if reply is not None:
                    break
            else:
                return None
            found += reply.data[len(wanted) :][:piece]
        return found

    def send_packet(self, image: bytes, number: int) -> Sent:
        """Send a packet of `image` without waiting for an answer."""
        return self._tester.send(self._encoder.packet_of(image, number))

    # -- upgrade ----------------------------------------------------------------------------------

    def upgrade(self, image: bytes, *, reset: bool = True, blind: bool = False) -> UpgradeResult:
        """Upgrade the device from any state.

        Without `reset` it waits for a device that announces itself. With `blind` a silent device
        gets an update command too, as it may be in a transfer.
        """
        ended = UpgradeResult(ok=False, reason="no boot version")
        self._tester.forget()
        for attempt in range(ATTEMPTS):
            if reset and not attempt:
                self._tester.send(self._encoder.reset())
            if not self._request_transfer(len(image), blind=blind and not attempt):
                return ended
            ended = self.transfer(image)
            if ended.ok or not ended.reason.startswith(Reply.BOOT_VERSION.value):
                return ended
        return ended

    def _request_transfer(self, size_bytes: int, *, blind: bool) -> bool:
        """Answer boot versions with the update command until request transfer (R2)."""
        limit = self._profile.limit
        limit_s = limit("first_version_s")
        first_s = min(_BLIND_S, limit_s) if blind else limit_s
        if blind and self._profile.choice("up_08") == "starts_over":
            first_s = 0.0  # in a transfer it starts over; otherwise a boot version follows
        reply = self._tester.wait_for(Reply.BOOT_VERSION, within_s=first_s)
        for _ in range(UPDATES_MAX):
            if reply is None and not blind:
                return False
            is_alone = reply is None and self._profile.number("versions") == 1
            sent = self._tester.send(self._encoder.update(size_bytes))
            # A boot version may have been the last one before a restart (RS-02).
            within_s = max(limit("erase_s"), limit("pause_s") + limit_s if blind else limit_s)
            # A boot version after an update command into silence may be the only one.
            reply = self.request_or_version(-inf if is_alone else sent.left_at, within_s)
            if reply is None or reply.kind is Reply.REQUEST:
                return reply is not None
            if is_alone:
                self._tester.wait_until(sent.left_at + UPDATE_SPACING_S)
            blind = False
        return False

    def request_or_version(self, asked_at: float, within_s: float) -> Received | None:
        """Wait for request transfer, or for a boot version sent after the update command (R2)."""
        not_before = asked_at + UPDATE_SPACING_S
        return self._tester.wait_for(
            Reply.REQUEST,
            Reply.BOOT_VERSION,
            within_s=within_s,
            unlike=lambda one: one.kind is Reply.BOOT_VERSION and one.at < not_before,
        )

    def transfer(self, image: bytes) -> UpgradeResult:
        """Send all packets and end of transfer, repeating lost messages."""
        began_at = self._tester.now
        for number in range(1, packet_count(len(image)) + 1):
            trouble = self.deliver_packet(image, number, began_at)
            if trouble:
                return UpgradeResult(ok=False, reason=f"{trouble} (packet {number})")
        return self.deliver_end(image)

    def deliver_end(self, image: bytes) -> UpgradeResult:
        """Send end of transfer until a final answer, or until the application reports the version
        of `image`.
        """
        refusals = 0
        for _ in range(END_TRIES):
            self._tester.send(self._encoder.end())
            reply = self._tester.wait_for(Reply.COMPLETE, Reply.NAK)
            if reply is not None and reply.kind is Reply.COMPLETE:
                return UpgradeResult(ok=True)
            refusals += reply is not None
            if refusals == 2:
                return UpgradeResult(ok=False, reason="the image was rejected")
        wanted = reported_version(self._encoder.target, image)
        if wanted is None or self.application_version(self._profile.limit("start_s")) != wanted:
            return UpgradeResult(ok=False, reason="no final answer")
        return UpgradeResult(ok=True)

    def deliver_packet(self, image: bytes, number: int, began_at: float) -> str:
        """Send a packet until it is acknowledged; returns what went wrong, or "". `began_at` is the
        time of request transfer.
        """

        def is_stale(one: Received) -> bool:
            is_other = one.kind is Reply.ACK and one.number != number
            return is_other or is_leftover(one, began_at)

        last, tries, requests = "no answer", 0, 0
        unanswered = 0
        while tries < PACKET_TRIES and requests < UPDATES_MAX:
            tries += 1
            unanswered += 1
            sent = self.send_packet(image, number)
            # A repeated update command may cause a second erase (R25, R16).
            kinds = (*_PACKET_ANSWERS, Reply.REQUEST) if number == 1 else _PACKET_ANSWERS
            reply = self._tester.wait_for(*kinds, unlike=is_stale)
            if reply is None and number == 1 and tries == PACKET_TRIES - 1:
                erase_s = self._profile.limit("erase_s")
                reply = self._tester.wait_for(Reply.REQUEST, within_s=erase_s)
            if reply is not None and reply.kind is Reply.REQUEST:
                requests += 1
                tries = 0  # the device erased instead of receiving
                continue
            if reply is None:
                continue
            last = str(reply)
            unanswered -= 1
            if reply.kind is Reply.BOOT_VERSION:
                return last
            is_next = reply.kind is Reply.NAK and reply.number == number + 1
            by_profile = is_next and tries + requests > 1 and self._profile.choice("tx_02") != "ack"
            if not by_profile and reply.kind is not Reply.ACK:
                continue
            # An answer to another copy may come as late as any.
            answers_until = sent.left_at + self._profile.limit("ack_s")
            while unanswered > 0 and self._tester.next_message(answers_until - self._tester.now):
                unanswered -= 1
            if tries + requests > 1:  # one copy may be answered twice, or by a stray message
                self._tester.collect(_QUIET_S)
            return ""
        return f"{last} after {PACKET_TRIES} tries"
