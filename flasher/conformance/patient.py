"""A patient host, written for the suite and not taken from flasher's own: it repeats what is lost,
judges nothing, and says how it ended. And the question whether an application runs.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from flasher.conformance.hearing import Heard, Kind
from flasher.conformance.judge import Judge
from flasher.conformance.line import Sent
from flasher.conformance.model import Unsupported
from flasher.conformance.wire import packet_count, packet_payload, version_in

PACKET_TRIES: Final = 5
END_TRIES: Final = 3
ATTEMPTS: Final = 3
_QUERY_PERIOD_S: Final = 0.2
"""The tool repeats a query at this interval (4.3)."""
_UPDATE_SPACING_S: Final = 0.03
"""Update commands are at least this far apart (R2)."""
_QUIET_S: Final = 0.05
"""After a repetition the bus is quiet for so long before the next message (R10)."""
_SETTLE_S: Final = 0.3
"""Beyond window and burst, until a started application listens."""
_BLIND_S: Final = 1.0
"""A device that was reset and announces nothing for so long may be in the midst of a transfer."""
UPDATES_MAX: Final = 50
_UPGRADE_KINDS: Final = (Kind.BOOT_VERSION, Kind.REQUEST, Kind.ACK, Kind.NAK, Kind.COMPLETE)


class Upgraded(NamedTuple):
    """How an upgrade ended; `reason` is empty for a good end."""

    ok: bool
    reason: str = ""


class PatientHost(Judge):
    """A judge that can upgrade the device and ask its application."""

    @property
    def burst_s(self) -> float:
        """How long announcements and the window last together at the most."""
        limit, count = self.profile.limit, self.profile.number("versions")
        spacing_s = limit("version_spacing_s") + limit("version_spacing_tolerance_s")
        return (count - 1) * spacing_s + limit("window_s") + limit("window_tolerance_s")

    @property
    def good_image(self) -> bytes:
        """The image that the device runs before and after every case."""
        return self.subject.good_image

    # -- application ------------------------------------------------------------------------------

    def application_version(self, within_s: float = 1.0) -> str | None:
        """The firmware version that the application tells; None when it does not answer.

        Raises Unsupported for a target without such a query.
        """
        if not self.words.has_version_query:
            raise Unsupported("the document has no version query for this target")
        deadline, asked = self.now + within_s, 0
        while self.now < deadline:
            self.send(self.words.query_version())
            asked += 1
            heard = self.wait_for(
                Kind.VERSION_INFORMATION, within_s=min(_QUERY_PERIOD_S, deadline - self.now)
            )
            if heard is not None:
                self._take_late_answers(asked - 1)
                return heard.firmware
        return None

    def _take_late_answers(self, count: int) -> None:
        """Of an application that is slower than the queries: what follows is no matter of them."""
        within_s = _QUERY_PERIOD_S + _QUIET_S
        for _ in range(count):
            if self.wait_for(Kind.VERSION_INFORMATION, within_s=within_s) is None:
                return

    def application_runs(self, within_s: float | None = None) -> bool:
        """True when an application answers `within_s` (`limits.start_s`).

        Without a version query, general feedback to a reset is the sign; the device then passes
        through its bootloader, which is waited for.
        """
        limit_s = self.profile.limit("start_s") if within_s is None else within_s
        if self.words.has_version_query:
            return self.application_version(limit_s) is not None
        deadline = self.now + limit_s
        while True:
            self.send(self.words.reset())
            feedback = self.wait_for(Kind.FEEDBACK, within_s=self.profile.limit("feedback_s"))
            if feedback is not None:
                self.wait_for(Kind.BOOT_VERSION, within_s=self.profile.limit("first_version_s"))
                self.wait(self.burst_s + _SETTLE_S)
                self.forget()
                return True
            if self.now >= deadline:
                return False
            self.wait(self.burst_s)

    def check_application(self, image: bytes | None = None) -> None:
        """The application of `image` (the good one) runs, and tells its version where it can."""
        wanted = version_in(self.good_image if image is None else image)
        if self.words.has_version_query and wanted is not None:
            found = self.application_version(self.profile.limit("start_s"))
            self.check(found == wanted, f"application {wanted} runs", f"{found!a}")
        else:
            runs = self.application_runs()
            self.check(runs, "the application runs", "it answers" if runs else "no answer")

    def send_packet(self, image: bytes, number: int) -> Sent:
        """Send a packet of `image` and wait for nothing."""
        payload = packet_payload(image, number)
        return self.send(self.words.packet(number, packet_count(len(image)), payload))

    # -- upgrade ----------------------------------------------------------------------------------

    def upgrade(self, image: bytes, *, reset: bool = True, blind: bool = False) -> Upgraded:
        """Upgrade the device as a patient tool does, from whatever state it is in.

        Without `reset` it waits for a device that announces itself. With `blind` a silent device
        gets the update command all the same: it may be in the midst of a transfer.
        """
        ended = Upgraded(ok=False, reason="no boot version")
        self.forget()
        for attempt in range(ATTEMPTS):
            if reset and not attempt:
                self.send(self.words.reset())
            if not self._ask_for_transfer(len(image), blind=blind and not attempt):
                return ended
            ended = self.transfer(image)
            if ended.ok or not ended.reason.startswith(Kind.BOOT_VERSION.value):
                return ended
        return ended

    def _ask_for_transfer(self, size_bytes: int, *, blind: bool) -> bool:
        """Answer boot versions with the update command until request transfer (R2)."""
        limit = self.profile.limit
        limit_s = limit("first_version_s")
        heard = self.wait_for(
            Kind.BOOT_VERSION, within_s=min(_BLIND_S, limit_s) if blind else limit_s
        )
        for _ in range(UPDATES_MAX):
            if heard is None and not blind:
                return False
            sent = self.send(self.words.update(size_bytes))
            within_s = max(limit("erase_s"), limit("pause_s") + limit_s if blind else 0.0)
            heard = self.request_or_version(sent.left_at, within_s)
            if heard is None or heard.kind is Kind.REQUEST:
                return heard is not None
            blind = False
        return False

    def request_or_version(self, asked_at: float, within_s: float) -> Heard | None:
        """What follows an update command: request transfer, or a boot version that is far enough
        behind it (R2); None after `within_s`.
        """
        not_before = asked_at + _UPDATE_SPACING_S
        return self.wait_for(
            Kind.REQUEST,
            Kind.BOOT_VERSION,
            within_s=within_s,
            unlike=lambda one: one.kind is Kind.BOOT_VERSION and one.at < not_before,
        )

    def transfer(self, image: bytes) -> Upgraded:
        """All packets and the end, after request transfer; repeats what is lost."""
        began_at = self.now
        for number in range(1, packet_count(len(image)) + 1):
            trouble = self.insist_on_packet(image, number, began_at)
            if trouble:
                return Upgraded(ok=False, reason=f"{trouble} (packet {number})")
        return self.insist_on_end(image)

    def insist_on_end(self, image: bytes) -> Upgraded:
        """End of transfer until there is a final answer, or the version of `image` is told."""
        refusals = 0
        for _ in range(END_TRIES):
            self.send(self.words.end())
            heard = self.wait_for(
                Kind.COMPLETE, Kind.NAK, within_s=self.profile.limit("complete_s")
            )
            if heard is not None and heard.kind is Kind.COMPLETE:
                return Upgraded(ok=True)
            refusals += heard is not None
            if refusals == 2:
                return Upgraded(ok=False, reason="the image was refused")
        wanted = version_in(image)
        if (
            self.words.has_version_query
            and wanted is not None
            and self.application_version(self.profile.limit("start_s")) == wanted
        ):
            return Upgraded(ok=True)
        return Upgraded(ok=False, reason="no final answer")

    def insist_on_packet(self, image: bytes, number: int, began_at: float) -> str:
        """Send a packet until it is acknowledged; returns what went wrong in the end, or "". The
        transfer began at `began_at`, with request transfer.
        """
        limit_s = self.profile.limit("ack_s")
        leftover_until = began_at + 0.06  # R11
        last = "no answer"
        for tries in range(1, PACKET_TRIES + 1):
            self.send_packet(image, number)
            heard = self.wait_for(
                *_UPGRADE_KINDS,
                within_s=limit_s,
                unlike=lambda one: (
                    one.at < leftover_until
                    if one.kind is Kind.BOOT_VERSION
                    else one.kind is Kind.REQUEST or (one.kind is Kind.ACK and one.number != number)
                ),
            )
            if heard is not None:
                last = str(heard)
            if heard is not None and heard.kind is Kind.BOOT_VERSION:
                return last
            is_next = heard is not None and heard.kind is Kind.NAK and heard.number == number + 1
            by_profile = is_next and tries > 1 and self.profile.choice("tx_02") == "nak_next"
            if by_profile or (heard is not None and heard.kind is Kind.ACK):
                if tries > 1:
                    self._wait_for_quiet()
                return ""
        return f"{last} after {PACKET_TRIES} tries"

    def _wait_for_quiet(self) -> None:
        for _ in range(PACKET_TRIES):
            if self.next_message(_QUIET_S) is None:
                return
