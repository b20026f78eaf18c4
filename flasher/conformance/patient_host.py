"""A patient host, written for the suite and not taken from flasher's own: it upgrades the device
from any state, repeats what is lost, judges nothing, and says how it ended. It also finds out
whether an application runs.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from flasher.conformance.results import Unsupported
from flasher.conformance.tester import BusTester, Sent
from flasher.conformance.wire import (
    MEMORY_BYTES,
    MessageKind,
    Received,
    packet_count,
    reported_version,
)

PACKET_TRIES: Final = 5
END_TRIES: Final = 3
ATTEMPTS: Final = 3
_QUERY_PERIOD_S: Final = 0.2
"""The tool repeats a query at this interval (4.3)."""
_QUERY_TRIES: Final = 5
"""A query stops after 1 s (4.3)."""
UPDATE_SPACING_S: Final = 0.03
"""Update commands are at least this far apart; a boot version that comes sooner after one was sent
before it (R2).
"""
_QUIET_S: Final = 0.05
"""After a repetition the bus is quiet for so long before the next message (R10)."""
_SETTLE_S: Final = 0.3
"""Beyond window and burst, until a started application listens."""
_BLIND_S: Final = 1.0
"""A device that was reset and announces nothing for so long may be in the midst of a transfer."""
UPDATES_MAX: Final = 50
_WINDOW_MAX_S: Final = 1.0
"""How long the window lasts at the most where the profile does not know it (up_04)."""
LEFTOVER_S: Final = 0.06
"""A boot version so soon after request transfer was sent before it (R11)."""
_PACKET_ANSWERS: Final = (
    MessageKind.ACK,
    MessageKind.NAK,
    MessageKind.BOOT_VERSION,
    MessageKind.COMPLETE,
)


class UpgradeResult(NamedTuple):
    """How an upgrade ended; `reason` is empty for a good end."""

    ok: bool
    reason: str = ""


class PatientHost:
    """Upgrades the device, and asks its application, through the tester of a case."""

    def __init__(self, tester: BusTester) -> None:
        self._tester = tester
        self._encoder = tester.encoder
        self._profile = tester.profile

    @property
    def burst_s(self) -> float:
        """How long announcements and the window last together at the most."""
        limit, count = self._profile.limit, self._profile.number("versions")
        spacing_s = limit("version_spacing_s") + limit("version_spacing_tolerance_s")
        window_s = limit("window_s") + limit("window_tolerance_s")
        if self._profile.choice("up_04") == "either":
            window_s = max(window_s, _WINDOW_MAX_S)
        return (count - 1) * spacing_s + window_s

    # -- application ------------------------------------------------------------------------------

    def application_version(self, within_s: float = 1.0) -> str | None:
        """The firmware version that the application tells; None when it does not answer.

        Raises Unsupported for a target without such a query.
        """
        heard = self.version_answer(within_s)
        return None if heard is None else heard.firmware

    def version_answer(
        self, within_s: float, *, every_s: float = _QUERY_PERIOD_S
    ) -> Received | None:
        """The first answer to the version query, which is sent `every_s`. Raises as above."""
        if not self._encoder.has_version_query:
            raise Unsupported("the document has no version query for this target")
        tester, kind = self._tester, MessageKind.VERSION_INFORMATION
        deadline, unanswered = tester.now + within_s, 0
        while tester.now < deadline:
            tester.send(self._encoder.query_version())
            heard = tester.wait_for(kind, within_s=min(every_s, deadline - tester.now))
            if heard is None:
                unanswered += 1
                continue
            # An application slower than the queries: none of its answers may come later on.
            late_s = _QUERY_PERIOD_S + _QUIET_S
            while unanswered and tester.wait_for(kind, within_s=late_s) is not None:
                unanswered -= 1
            return heard
        return None

    def application_runs(self, within_s: float | None = None) -> bool:
        """True when an application answers `within_s` (`limits.start_s`).

        Without a version query, general feedback to a reset is the sign; the device then passes
        through its bootloader, which is waited for.
        """
        limit_s = self._profile.limit("start_s") if within_s is None else within_s
        if self._encoder.has_version_query:
            return self.application_version(limit_s) is not None
        tester = self._tester
        deadline = tester.now + limit_s
        while True:
            with tester.collecting_feedback():
                tester.send(self._encoder.reset())
                runs = tester.wait_for(MessageKind.FEEDBACK) is not None
            if runs or tester.now >= deadline:
                # What is sent before the burst that the reset may have begun is over would be lost.
                if tester.wait_for(MessageKind.BOOT_VERSION) is not None:
                    tester.wait(self.burst_s + _SETTLE_S)
                    tester.forget()
                return runs
            # The reset may have begun a burst (RS-02): another one in it would do so again.
            quiet_s = self.burst_s + _SETTLE_S
            while (
                tester.wait_for(MessageKind.BOOT_VERSION, within_s=quiet_s)
                and tester.now < deadline
            ):
                pass

    def read_memory(self, start: int, size_bytes: int) -> bytes | None:
        """The memory from `start` on, as the application tells it; None when it does not."""
        tester, found = self._tester, b""
        end = start + size_bytes
        while len(found) < size_bytes:
            at = start + len(found)
            piece = min(MEMORY_BYTES, end - at)
            wanted = at.to_bytes(4, "little") + (at + piece).to_bytes(4, "little")
            for _ in range(_QUERY_TRIES):
                tester.send(self._encoder.query_memory(at, at + piece))
                heard = tester.wait_for(
                    MessageKind.MEMORY,
                    within_s=_QUERY_PERIOD_S,
                    unlike=lambda one, wanted=wanted: not one.data.startswith(wanted),  # type: ignore[misc]
                )
                if heard is not None:
                    break
            else:
                return None
            found += heard.data[len(wanted) :][:piece]
        return found

    def send_packet(self, image: bytes, number: int) -> Sent:
        """Send a packet of `image` and wait for nothing."""
        return self._tester.send(self._encoder.packet_of(image, number))

    # -- upgrade ----------------------------------------------------------------------------------

    def upgrade(self, image: bytes, *, reset: bool = True, blind: bool = False) -> UpgradeResult:
        """Upgrade the device as a patient tool does, from whatever state it is in.

        Without `reset` it waits for a device that announces itself. With `blind` a silent device
        gets the update command all the same: it may be in the midst of a transfer.
        """
        ended = UpgradeResult(ok=False, reason="no boot version")
        self._tester.forget()
        for attempt in range(ATTEMPTS):
            if reset and not attempt:
                self._tester.send(self._encoder.reset())
            if not self._request_transfer(len(image), blind=blind and not attempt):
                return ended
            ended = self.transfer(image)
            if ended.ok or not ended.reason.startswith(MessageKind.BOOT_VERSION.value):
                return ended
        return ended

    def _request_transfer(self, size_bytes: int, *, blind: bool) -> bool:
        """Answer boot versions with the update command until request transfer (R2)."""
        limit = self._profile.limit
        limit_s = limit("first_version_s")
        first_s = min(_BLIND_S, limit_s) if blind else limit_s
        heard = self._tester.wait_for(MessageKind.BOOT_VERSION, within_s=first_s)
        for _ in range(UPDATES_MAX):
            if heard is None and not blind:
                return False
            sent = self._tester.send(self._encoder.update(size_bytes))
            # A boot version may have been the last one before a restart (RS-02).
            within_s = max(limit("erase_s"), limit("pause_s") + limit_s if blind else limit_s)
            heard = self.request_or_version(sent.left_at, within_s)
            if heard is None or heard.kind is MessageKind.REQUEST:
                return heard is not None
            blind = False
        return False

    def request_or_version(self, asked_at: float, within_s: float) -> Received | None:
        """What follows an update command: request transfer, or a boot version that is far enough
        behind it (R2); None after `within_s`.
        """
        not_before = asked_at + UPDATE_SPACING_S
        return self._tester.wait_for(
            MessageKind.REQUEST,
            MessageKind.BOOT_VERSION,
            within_s=within_s,
            unlike=lambda one: one.kind is MessageKind.BOOT_VERSION and one.at < not_before,
        )

    def transfer(self, image: bytes) -> UpgradeResult:
        """All packets and the end, after request transfer; repeats what is lost."""
        began_at = self._tester.now
        for number in range(1, packet_count(len(image)) + 1):
            trouble = self.deliver_packet(image, number, began_at)
            if trouble:
                return UpgradeResult(ok=False, reason=f"{trouble} (packet {number})")
        return self.deliver_end(image)

    def deliver_end(self, image: bytes) -> UpgradeResult:
        """End of transfer until there is a final answer, or the version of `image` is told."""
        refusals = 0
        for _ in range(END_TRIES):
            self._tester.send(self._encoder.end())
            heard = self._tester.wait_for(MessageKind.COMPLETE, MessageKind.NAK)
            if heard is not None and heard.kind is MessageKind.COMPLETE:
                return UpgradeResult(ok=True)
            refusals += heard is not None
            if refusals == 2:
                return UpgradeResult(ok=False, reason="the image was refused")
        wanted = reported_version(self._encoder.target, image)
        if wanted is None or self.application_version(self._profile.limit("start_s")) != wanted:
            return UpgradeResult(ok=False, reason="no final answer")
        return UpgradeResult(ok=True)

    def deliver_packet(self, image: bytes, number: int, began_at: float) -> str:
        """Send a packet until it is acknowledged; returns what went wrong in the end, or "". The
        transfer began at `began_at`, with request transfer.
        """

        def is_stale(one: Received) -> bool:
            if one.kind is MessageKind.BOOT_VERSION:
                return one.at < began_at + LEFTOVER_S
            return one.kind is MessageKind.ACK and one.number != number

        last = "no answer"
        for tries in range(1, PACKET_TRIES + 1):
            self.send_packet(image, number)
            # It may erase once more, for an update command that was sent twice (R25, R16).
            kinds = (*_PACKET_ANSWERS, MessageKind.REQUEST) if number == 1 else _PACKET_ANSWERS
            heard = self._tester.wait_for(*kinds, unlike=is_stale)
            if heard is None and number == 1 and tries == PACKET_TRIES - 1:
                erase_s = self._profile.limit("erase_s")
                self._tester.wait_for(MessageKind.REQUEST, within_s=erase_s)
            if heard is None or heard.kind is MessageKind.REQUEST:
                continue
            last = str(heard)
            if heard.kind is MessageKind.BOOT_VERSION:
                return last
            is_next = heard.kind is MessageKind.NAK and heard.number == number + 1
            by_profile = is_next and tries > 1 and self._profile.choice("tx_02") != "ack"
            if not by_profile and heard.kind is not MessageKind.ACK:
                continue
            # The other copies are answered too; the next message waits until that is over.
            quiet_after = PACKET_TRIES if tries > 1 else 0
            while quiet_after and self._tester.next_message(_QUIET_S) is not None:
                quiet_after -= 1
            return ""
        return f"{last} after {PACKET_TRIES} tries"
