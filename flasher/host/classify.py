"""From received messages and expired timers to events of the table.

Here stand the readings that tell one ACK from another: R2 (boot versions before the transfer), R6
(NAK after the end), R10 (copies, stale answers), R11 (restart or leftover), R16 (request transfer
again). What they rest on is the `Situation`; noting an answer in it is part of classifying it.
"""

from __future__ import annotations

from flasher.host.options import UpgradeOptions, firmware_version
from flasher.host.situation import Situation
from flasher.host.table import Event, State
from flasher.image.plan import Plan
from flasher.protocol.fields import Content
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    GeneralFeedback,
    Malformed,
    Nak,
    RequestTransfer,
    Row,
    Unknown,
)
from flasher.protocol.spec import BOOT_VERSION_BURST
from flasher.protocol.text import boot_version_number
from flasher.protocol.timing import Timings

_IN_TRANSFER = frozenset({State.TRANSFERRING, State.SETTLING})
_AFTER_END = frozenset({State.ENDING, State.CONFIRMING})


class Classifier:
    """Gives every message and every expired timer its event."""

    def __init__(self, plan: Plan, options: UpgradeOptions) -> None:
        self._plan = plan
        self._options = options
        self._timings: Timings = options.timings
        self._burst_gap_s = BOOT_VERSION_BURST * self._timings.boot_version_spacing_s
        """Announcements further apart than a whole burst takes are not of one burst."""
        minimum = options.minimum_boot_version
        self._minimum_boot = None if minimum is None else boot_version_number(minimum)

    def message(self, row: Row | Malformed | Unknown | Content, at: Situation, now: float) -> Event:
        """The event that a received message is."""
        match row:
            case Ack() | Nak():
                if at.state in _IN_TRANSFER:
                    return self._answer(row, at)
                if at.state in _AFTER_END:
                    return self._end_answer(row, at)
                return Event.UNEXPECTED
            case BootVersion():
                return self._boot_version(row, at, now)
            case RequestTransfer():
                return self._request(at)
            case Complete():
                return self._complete(at)
            case GeneralFeedback():
                at.feedback_came = True
                return Event.FEEDBACK
            case Content():
                return self._version(row, at)
            case _:
                return Event.UNEXPECTED

    def timer(self, at: Situation, now: float) -> Event:
        """The event that the expired timer of the state is."""
        timings = self._timings
        in_state_s = now - at.state_since
        match at.state:
            case State.RESETTING:
                given_up = in_state_s >= timings.command_timeout_s
                return Event.RESET_UNANSWERED if given_up else Event.RESET_DUE
            case State.AWAITING_BOOT:
                return self._no_boot(at, now)
            case State.AWAITING_REQUEST:
                return self._no_request(at)
            case State.TRANSFERRING:
                return self._packet_lost(at) if self._last_try(at) else Event.PACKET_UNANSWERED
            case State.SETTLING:
                return self._settled(at)
            case State.ENDING:
                return self._end_timer(at)
            case _:
                given_up = in_state_s >= timings.application_start_timeout_s
                return Event.QUERY_UNANSWERED if given_up else Event.QUERY_DUE

    # -- ACK and NAK ------------------------------------------------------------------------------

    def _answer(self, answer: Ack | Nak, at: Situation) -> Event:
        """During the transfer (R10)."""
        accepts = isinstance(answer, Ack)
        if answer.number == at.number + 1 and not accepts and at.tries > 1:
            # "I want n+1": some bootloaders answer a repeated n so.
            if not self._options.nak_next_is_ack:
                at.nak_next_seen = True
                return Event.ANSWER_UNEXPECTED
            accepts = True
        elif answer.number > at.number:
            return Event.ANSWER_UNEXPECTED
        elif answer.number < at.number:
            return Event.ANSWER_STALE
        still_sending = not at.tx.idle
        first_copy_out = at.tries > 1 or not still_sending
        if not at.copies_unanswered and not (accepts and first_copy_out):
            # It answers a copy that is answered already, or none at all.
            return Event.ANSWER_STALE
        at.copies_unanswered = max(0, at.copies_unanswered - 1)
        at.accepted = at.accepted or accepts
        if at.copies_unanswered or still_sending:
            return Event.COPY_OUTSTANDING
        return self._settled(at)

    def _settled(self, at: Situation) -> Event:
        """Every copy of the packet is answered, or will not be any more."""
        if not at.accepted:
            return self._packet_lost(at) if self._last_try(at) else Event.PACKET_REFUSED
        last = at.number == self._plan.total_packets
        return Event.LAST_PACKET_DONE if last else Event.PACKET_DONE

    def _packet_lost(self, at: Situation) -> Event:
        return Event.PACKET_LOST if self._last_attempt(at) else Event.PACKET_GIVEN_UP

    def _end_answer(self, answer: Ack | Nak, at: Situation) -> Event:
        """After end of transfer; the number of a NAK does not matter (R6)."""
        if isinstance(answer, Ack) or at.end_copies_left <= at.end_naks:
            return Event.ANSWER_STALE
        at.end_naks += 1
        return Event.END_NAK if at.end_naks == 1 else Event.END_REFUSED

    # -- boot version -----------------------------------------------------------------------------

    def _boot_version(self, boot: BootVersion, at: Situation, now: float) -> Event:
        if at.state in _AFTER_END:
            # A device that announces itself before it can have heard of the end has restarted.
            heard_of_end = at.end_copies_left or at.tx.begun
            return self._boot_after_end(at, now) if heard_of_end else self._restarted(at)
        if at.state in _IN_TRANSFER:
            if now - at.request_at <= self._timings.leftover_boot_version_s:
                return Event.BOOT_LEFTOVER
            return Event.BOOT_WRONG if self._is_foreign(boot) else self._restarted(at)
        if self._is_foreign(boot):
            return Event.BOOT_WRONG
        if at.state is State.AWAITING_REQUEST:
            return self._boot_again(boot, at, now)
        return Event.BOOT_TOO_OLD if self._is_too_old(boot) else Event.BOOT_VERSION

    def link_back(self, at: Situation) -> Event:
        """The event that the return of a lost adapter is."""
        is_updating = at.state is State.AWAITING_REQUEST and at.first_update_left_at is not None
        return Event.LINK_BACK_UPDATING if is_updating else Event.LINK_BACK

    def _no_boot(self, at: Situation, now: float) -> Event:
        """No boot version came; a device that was told to update is not left alone (R26)."""
        if at.update_left and not self._last_attempt(at):
            if at.feedback_came or at.silence_was_answered:
                return Event.BOOT_GIVEN_UP
            if now < at.silent_since + self._timings.request_transfer_timeout_s:
                return Event.BOOT_AWAITED
            at.silence_was_answered = True
            return Event.BOOT_SILENT
        if at.failed_packet is not None:
            return Event.BOOT_LOST
        return Event.POWER_UP_MISSING if self._options.at_power_up else Event.BOOT_MISSING

    def _no_request(self, at: Situation) -> Event:
        if not self._last_attempt(at):
            return Event.REQUEST_GIVEN_UP
        was_lost = at.failed_packet is not None and at.boot is None
        return Event.BOOT_LOST if was_lost else Event.REQUEST_MISSING

    def _boot_again(self, boot: BootVersion, at: Situation, now: float) -> Event:
        """After an update command was sent, before request transfer (R2)."""
        timings = self._timings
        if at.boot is not None and boot != at.boot:
            return Event.BOOT_CHANGED
        if not at.tx.idle or now - at.update_left_at < timings.update_spacing_s:
            return Event.BOOT_TOO_SOON
        first_at = at.first_update_left_at
        if first_at is not None and now - first_at > timings.request_transfer_timeout_s:
            return Event.BOOT_UNHEARING
        return Event.BOOT_VERSION

    def _boot_after_end(self, at: Situation, now: float) -> Event:
        """A burst is the new application starting; a device that announces on did not accept.

        Judged by time, not by count: a doubled frame must not erase a good image.
        """
        if at.announced_at is None or now - at.announced_last_at > self._burst_gap_s:
            at.announced_at = now
        at.announced_last_at = now
        goes_on = now - at.announced_at >= self._timings.announcing_on_s
        return self._restarted(at) if goes_on else Event.BOOT_AFTER_END

    def _is_foreign(self, boot: BootVersion) -> bool:
        if self._options.allow_boot_name:
            return False
        return boot.name != self._plan.target.boot_name or not boot.is_version

    def _is_too_old(self, boot: BootVersion) -> bool:
        wanted, got = self._minimum_boot, boot_version_number(boot.version)
        return wanted is not None and (got is None or got < wanted)

    def _restarted(self, at: Situation) -> Event:
        return Event.RESTARTS_EXHAUSTED if self._last_attempt(at) else Event.BOOT_RESTARTED

    def _last_attempt(self, at: Situation) -> bool:
        return at.attempt >= self._options.attempts

    def _last_try(self, at: Situation) -> bool:
        return at.tries >= self._timings.packet_tries

    # -- the other messages -----------------------------------------------------------------------

    def _request(self, at: Situation) -> Event:
        if at.state is State.AWAITING_REQUEST:
            # Before the update command has left it answers another one: a late copy.
            return Event.UNEXPECTED if at.first_update_left_at is None else Event.REQUEST
        if at.state not in _IN_TRANSFER:
            return Event.UNEXPECTED
        if at.number > 1 or at.accepted:
            return Event.RESTARTS_EXHAUSTED if self._last_attempt(at) else Event.REQUEST_LATE
        if not at.tx.idle:
            return Event.COPY_OUTSTANDING
        return self._packet_lost(at) if self._last_try(at) else Event.REQUEST_AGAIN

    def _complete(self, at: Situation) -> Event:
        if at.state in _AFTER_END and at.end_copies_left:
            return Event.COMPLETE
        return Event.COMPLETE_EARLY if at.state in _IN_TRANSFER | _AFTER_END else Event.UNEXPECTED

    def _version(self, answer: Content, at: Situation) -> Event:
        if at.state is not State.CONFIRMING:
            return Event.UNEXPECTED
        at.running_version = firmware_version(answer)
        expected = self._plan.image.version
        if expected is None:
            return Event.VERSION_UNJUDGED
        return Event.VERSION_RIGHT if at.running_version == expected else Event.VERSION_OTHER

    def _end_timer(self, at: Situation) -> Event:
        announced = at.announced_at is not None
        if not announced and at.end_tries < self._timings.end_tries:
            return Event.END_UNANSWERED
        if self._options.version_request_for(self._plan.target) is None:
            return Event.END_UNCONFIRMABLE
        return Event.BURST_ENDED if announced else Event.END_LOST
