"""Upgrade engine of the tool: reset, update command, packets, end of transfer (appendix 3); pure.

A message, an expired timer or a cancellation becomes an event, `table.TABLE` names the action, and
the actions are the methods below, in the order of the states. An action checks the guards and
readings of its event (R2, R6, R10, R11, R16, R18, R26, R27), enters a state that the table allows,
and sends the next message. A timer starts when a message was sent.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

from flasher import events
from flasher.events import Phase
from flasher.host.duplicates import DuplicateDetector
from flasher.host.identity import CheckResult
from flasher.host.options import (
    ERASURES_MAX,
    OTHER_TOOL_QUIET_S,
    UpgradeOptions,
    firmware_version,
    other_unit,
)
from flasher.host.outcome import DeviceLeft, Outcome, Statistics, describe_progress
from flasher.host.runner import Runner, Signal, Stage, StageInput
from flasher.host.table import TABLE, TIMERS, Ending, Reason, UpgradeEvent, UpgradeState
from flasher.i18n import text
from flasher.image.plan import Plan
from flasher.protocol import catalogue
from flasher.protocol.engine import DROP_MARGIN
from flasher.protocol.fields import Content
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Malformed,
    Nak,
    RequestTransfer,
    Unknown,
    UpdateCommand,
    UpgradeMessage,
    decode,
)
from flasher.protocol.spec import Command, Mode
from flasher.protocol.text import boot_version_number, printable
from flasher.protocol.timing import Announcing
from flasher.protocol.wire import Damage, Message, encode, split

ReceivedContent = UpgradeMessage | Malformed | Unknown | Content | None
"""Content of the message of an event; None for a timer or a cancellation."""

_EVENTS: Final[dict[type, UpgradeEvent]] = {
    Ack: UpgradeEvent.ACK,
    Nak: UpgradeEvent.NAK,
    BootVersion: UpgradeEvent.BOOT_VERSION,
    RequestTransfer: UpgradeEvent.REQUEST,
    Complete: UpgradeEvent.COMPLETE,
    GeneralFeedbackMessage: UpgradeEvent.FEEDBACK,
}
"""Event of each message type; other messages are unexpected."""
_PHASES: Final = {
    UpgradeState.RESETTING: Phase.RESET,
    UpgradeState.AWAITING_BOOT: Phase.BOOT,
    UpgradeState.WATCHING: Phase.BOOT,
    UpgradeState.AWAITING_REQUEST: Phase.UPDATE,
    UpgradeState.TRANSFERRING: Phase.TRANSFER,
    UpgradeState.SETTLING: Phase.TRANSFER,
    UpgradeState.ENDING: Phase.END,
    UpgradeState.CONFIRMING: Phase.CONFIRM,
}
"""Phase that each state reports; other states keep the phase."""
_FROM_THE_UPDATE: Final = frozenset({Reason.RESTARTED, Reason.REQUEST_LATE, Reason.BOOT_SILENT})
"""Reasons for an attempt that begins with the update command, not with a reset."""
_APPLICATION_S: Final = 10.0
"""Time after which a message of an application no longer shows that it runs: it was asked before
the reset, whose boot version is then awaited."""
_SILENT: Final = frozenset({Ending.NO_BOOT_VERSION, Ending.NO_ANNOUNCEMENT})
_DEVICE_LEFT: Final = {
    Ending.COMPLETED: DeviceLeft.NEW,
    Ending.CONFIRMED_BY_VERSION: DeviceLeft.NEW,
    Ending.REFUSED: DeviceLeft.NO_APPLICATION,
    Ending.RESTARTED: DeviceLeft.NO_APPLICATION,
}
"""State of the device after endings that determine it."""


class LinkRestored(Exception):  # noqa: N818  not an error
    """The lost adapter was opened again, after `away_s` seconds."""

    def __init__(self, away_s: float) -> None:
        super().__init__(away_s)
        self.away_s = away_s


class SecondToolSeen(Exception):  # noqa: N818  not an error
    """Another tool sent a frame with the tool's CAN id; `description` names it."""

    def __init__(self, description: str) -> None:
        super().__init__(description)
        self.description = description


@dataclass
class _Attempt:
    """State of one attempt; times in seconds on the runner's clock."""

    feedback_came: bool = False
    """The reset was answered, so an application runs."""
    application_at: float = -inf
    """Time of the last message of the device's application."""
    boot: BootVersion | None = None
    """First boot version of the attempt."""
    first_reset_left_at: float = inf
    was_reset_again: bool = False
    watched_since: float = 0.0
    watched_until: float = 0.0
    first_update_left_at: float | None = None
    update_began_at: float = inf
    announced_meanwhile: BootVersion | None = None
    """Boot version that came too early for another update command, and after the last one began."""
    announced_s: float = 0.0
    """Time in which boot versions went on after the first update command; a silence, in which the
    device may have erased or this computer paused, counts as short."""
    announced_at: float = 0.0
    request_at: float = 0.0

    packet: int = 0
    """Current packet number, from 1."""
    tries: int = 0
    """Number of transmissions of the packet that have begun."""
    copies_unanswered: int = 0
    """Number of sent copies of the packet without an answer."""
    accepted: bool = False
    """A copy of the packet was acknowledged."""

    end_tries: int = 0
    end_copies_left: int = 0
    end_naks: int = 0
    announcing: Announcing = field(default_factory=Announcing)
    """Consecutive boot versions since end of transfer."""
    running_version: str | None = None
    unobserved_s: float = 0.0
    """Time since the update command in which the adapter was away."""


class UpgradeStage:
    """Upgrade of one device as a stage. It begins with a reset, or, if `announcement` has a boot
    version, with the answer to that.
    """

    def __init__(self, run: Runner[Any], plan: Plan, options: UpgradeOptions) -> None:
        self._run = run
        self._tx = run.tx
        self._plan = plan
        self._options = options
        self._timings = options.timings
        request = options.version_request_for(plan.target)
        self._version_item = None if request is None else request.answer_item
        minimum = options.minimum_boot_version
        self._minimum_boot = None if minimum is None else boot_version_number(minimum)
        self._actions = {
            move.action: getattr(self, f"_{move.action}")
            for row in TABLE.values()
            for move in row.values()
        }
        self.announcement: Message | None = None
        """Boot version received before the upgrade."""
        self.serial_before = ""  # the serial number before the upgrade; "" if unknown
        self.in_session = options.in_session
        """An earlier upgrade may have left the device in its transfer (R26): no application was
        detected, and no update command was sent yet."""
        self.unchecked: CheckResult | None = None
        """Rule of the manifest that the silent device could not answer. It refuses the device,
        unless the device turns out to be in its transfer and so to have no application."""
        self.state = UpgradeState.RESETTING
        """Current state in the table."""
        self._state_since = 0.0
        self._phase = Phase.BOOT if options.at_power_up else Phase.RESET
        self._asks_for_power = options.at_power_up
        """The user is asked to switch the device off and on."""
        self._timer_at = self._deadline_at = inf
        self._began_at = 0.0
        self._ending: tuple[Ending, str] | None = None
        self._outcome: Outcome | None = None

        # State that outlives an attempt.
        self._at = _Attempt()
        self._attempt = 1
        self._received_at = -inf
        """Time at which the device last sent something, or may have while the adapter was lost."""
        self._update_left_at = -inf
        """Time at which the last update command was sent."""
        self._silence_was_answered = False
        """An update command was sent to a silent device (R26)."""
        self._attempts = options.planned_attempts
        """Maximum number of attempts, without those for a device left in its transfer."""
        self._last_boot: BootVersion | None = None
        self._erasures = self._whole_transfers = 0
        """Number of request transfers, after each of which the old application is gone, and of
        attempts that sent end of transfer."""
        self._failure: tuple[Ending, ReceivedContent] | None = None
        """Ending of an earlier attempt if it had been the last one."""
        self._failed_packet: int | None = None
        """Packet at which an earlier attempt failed."""
        self._slowest_answer_s = 0.0  # the longest time from a packet, sent once, to its answer
        self._other_answer = ""
        """Describes an answer to a repeated packet that is none by table 9, since the last right
        one."""
        self._second_tool = ""  # description of its frame

        self._acknowledged = self._repetitions = self._naks = self._timeouts = 0
        self._transfer_s: float | None = None

    # -- progress --------------------------------------------------------------------------------

    @property
    def progress(self) -> str:
        """Phase, packet and attempt, as text."""
        return describe_progress(self._phase, self._packet, self._plan.total_packets, self._attempt)

    @property
    def _duplicates(self) -> DuplicateDetector:
        return self._run.duplicates

    @property
    def _packet(self) -> int | None:
        return self._at.packet if self._phase is Phase.TRANSFER else None

    @property
    def _erased(self) -> bool:
        return self._erasures > 0

    @property
    def _update_was_sent(self) -> bool:
        """True once an update command was sent: the device may have erased its application."""
        return self._update_left_at > -inf

    @property
    def has_begun_to_erase(self) -> bool:
        """True once an update command is being sent or was sent."""
        is_leaving = self.state is UpgradeState.AWAITING_REQUEST and self._tx.begun
        return self._update_was_sent or is_leaving

    @property
    def device_left(self) -> DeviceLeft:
        """State of the device if the upgrade ended now."""
        if self._at.end_copies_left:
            return DeviceLeft.UNKNOWN
        if self._erased:
            return DeviceLeft.NO_APPLICATION
        return DeviceLeft.PERHAPS_ERASED if self._update_was_sent else DeviceLeft.UNTOUCHED

    @property
    def may_begin_again(self) -> bool:
        """True if the upgrade can continue after a lost adapter is opened again."""
        return not self._is_last_attempt or self._ending is not None or self._is_updating

    @property
    def _is_updating(self) -> bool:
        """True once this attempt sent its update command; it then survives a lost adapter."""
        return self._at.first_update_left_at is not None

    @property
    def goes_on(self) -> bool:
        """True if only the overall deadline limits the number of attempts: the device has no
        application to lose, as far as is known, and the user set no limit.
        """
        options = self._options
        if options.attempts is not None or self._erasures >= ERASURES_MAX:
            return False
        # A complete transfer that was not accepted counts as a refusal.
        if self._whole_transfers >= options.planned_attempts:
            return False
        # An application that answers the reset is not erased.
        return self._has_begun and (self._erased or not self._at.feedback_came)

    @property
    def is_yielding(self) -> bool:
        """True while waiting for another tool to become silent."""
        return self.state is UpgradeState.YIELDING

    @property
    def _is_last_attempt(self) -> bool:
        if self._options.single_session:
            return True
        return self._attempt >= self._attempts and not self.goes_on

    @property
    def _has_begun(self) -> bool:
        """True if a device that had sent something got an update command."""
        has_answered = self._last_boot is not None or self._erased
        return has_answered and self._update_was_sent

    @property
    def _boot_timeout_s(self) -> float:
        options = self._options
        return (
            options.boot_timeout_s if self._asks_for_power else self._timings.boot_version_timeout_s
        )

    @property
    def _is_last_try(self) -> bool:
        options = self._options
        tries = options.tries_without_application if self.goes_on else options.timings.packet_tries
        return self._at.tries >= tries

    # -- the stage -------------------------------------------------------------------------------

    def stage(self, deadline_at: float) -> Stage[Outcome]:
        """Run the upgrade; `deadline_at` is the overall deadline."""
        self._began_at = self._state_since = self._run.now
        self._deadline_at = deadline_at
        self._run.listen_always(self._plan.target.answer_id)
        self._asks_for_power = self._options.at_power_up and not self.in_session
        is_awaited = self._asks_for_power or self.announcement is not None
        self.state = UpgradeState.AWAITING_BOOT if is_awaited else UpgradeState.RESETTING
        self._phase = _PHASES[self.state]
        self._run.emit(events.PhaseEntered(self._phase, self._attempt))
        if self.state is UpgradeState.RESETTING:
            self._send_reset()
        else:
            self._wait_for_boot()
        if self.announcement is not None:
            self._take(self.announcement)
        if self.state is UpgradeState.WATCHING and not self._options.at_power_up:
            # A bootloader ignores the reset (R18), but another device's application answers it.
            self._send_reset()
        while self._outcome is None:
            is_stopping = self._ending is not None
            try:
                came = yield None if is_stopping else min(self._timer_at, self._deadline_at)
            except LinkRestored as restored:
                self._at.unobserved_s += restored.away_s if self._is_updating else 0.0
                self._tx.abandon(self._run.now + self._timings.inter_frame_timeout_s * DROP_MARGIN)
                self._received_at = self._run.now  # it may have sent something meanwhile
                self._dispatch(UpgradeEvent.LINK_BACK)
            except SecondToolSeen as tool:
                # Send nothing more, not even the rest of a message.
                self._tx.abandon(self._run.now)
                self._second_tool = tool.description
                self._dispatch(UpgradeEvent.SECOND_TOOL)
            else:
                self._take(came)
        return self._outcome

    def note_application(self) -> None:
        """Record a message of the device's application: a bootloader sends only to the tool."""
        self.in_session = False
        self._at.application_at = self._run.now

    def _take(self, came: StageInput) -> None:
        if self._ending is not None:
            if came is Signal.LEFT:
                self._message_left()
                self._finish()
            return
        match came:
            case Signal.LEFT:
                self._message_left()
            case Signal.TIME if self._run.now >= self._deadline_at:
                self._dispatch(UpgradeEvent.OUT_OF_TIME)
            case Signal.TIME:
                self._timer_at = inf
                self._dispatch(TIMERS[self.state])
            case Signal.CANCEL:
                self._dispatch(UpgradeEvent.CANCEL)
            case Damage():
                self._run.emit_damage(came)
            case Message():
                self._message(came)

    def _message(self, message: Message) -> None:
        self._received_at = self._run.now
        if self._duplicates.evidence and not self.is_yielding:
            self._dispatch(UpgradeEvent.TWO_DEVICES)
            return
        item = self._version_item
        if item is not None and message[:3] == (item.can_id, item.mode, item.command):
            self._dispatch(UpgradeEvent.VERSION, item.content.from_data(message.data))
            return
        content = decode(message)
        event = _EVENTS.get(type(content), UpgradeEvent.UNEXPECTED)
        if event is UpgradeEvent.FEEDBACK:
            self._at.feedback_came, self.in_session = True, False
            if not self._update_was_sent:
                self.note_application()
            elif self.state is UpgradeState.TRANSFERRING and self._at.tries > 1:
                feedback = text("the device answered {answer}", answer="general feedback")
                self._other_answer = self._other_answer or feedback
        elif event is UpgradeEvent.NAK:
            self._naks += 1
        self._dispatch(event, content)

    def _dispatch(self, event: UpgradeEvent, content: ReceivedContent = None) -> None:
        if self._ending is not None:
            self._finish()
            return
        before = self.state
        move = TABLE[before].get(event)
        if move is None:
            raise RuntimeError(f"{event} cannot happen in {before}")
        self._actions[move.action](content)
        reached = self._state_or_ending
        if reached is not before and reached not in move.leads_to:
            raise RuntimeError(f"{event} led from {before} to {reached}")

    @property
    def _state_or_ending(self) -> UpgradeState | Ending:
        return self.state if self._ending is None else self._ending[0]

    def _enter(self, state: UpgradeState) -> None:
        """Enter another state, and its phase."""
        if state is self.state:
            return
        self.state, self._state_since = state, self._run.now
        self._timer_at = inf
        phase = _PHASES.get(state, self._phase)
        if phase is not self._phase:
            self._phase = phase
            self._run.emit(events.PhaseEntered(phase, self._attempt))

    # -- what is sent, and the timers that start when it has left ---------------------------------

    def _send(self, content: UpgradeMessage, not_before: float = 0.0) -> None:
        request_id = self._plan.target.request_id
        frames = split(request_id, encode(content.to_message(request_id)))
        self._timer_at = inf
        self._run.send(frames, not_before=not_before, tag=content.COMMAND)

    def _send_reset(self) -> None:
        """Send the reset, the documented one or the product's own."""
        options, request_id = self._options, self._plan.target.request_id
        reset = Message(request_id, Mode.WRITE, options.reset_command, options.reset_data)
        self._timer_at = inf
        self._run.send(split(request_id, encode(reset)), tag=Command.RESET)

    def _send_update(self) -> None:
        size_bytes = self._plan.image.size_bytes
        self.in_session, self._asks_for_power = False, self._options.at_power_up
        self._at.update_began_at, self._at.announced_meanwhile = self._run.now, None
        self._send(UpdateCommand(self._plan.target.update_text, size_bytes))

    def _send_packet(self) -> None:
        at, plan = self._at, self._plan
        at.tries += 1
        self._timer_at = inf
        self._run.send(
            plan.packet_frames(at.packet),
            wire_s=plan.packet_wire_s(at.packet),
            not_before=self._after_packet_gap(),
            tag=Command.PACKET,
        )

    def _after_packet_gap(self) -> float:
        gap_s = self._options.packet_gap_s
        return self._run.now + gap_s if gap_s else 0.0

    def _message_left(self) -> None:
        at, tag, left_at = self._at, self._tx.left_tag, self._tx.left_at
        if tag is Command.READ_VERSION and self._version_item is not None:
            self._duplicates.request_sent(self._version_item.key, self._run.now, self._version_item)
        elif isinstance(tag, Command):
            self._duplicates.upgrade_message_sent(tag, self._run.now, at.packet)
        match tag:
            case Command.RESET:
                at.first_reset_left_at = min(at.first_reset_left_at, left_at)
            case Command.PACKET:
                at.copies_unanswered += 1
            case Command.UPDATE:
                self._update_left_at = left_at
                if at.first_update_left_at is None:
                    at.first_update_left_at = at.announced_at = left_at
            case Command.END_OF_TRANSFER:
                self._whole_transfers += not at.end_copies_left
                at.end_copies_left += 1
        wait_s = self._wait_after(tag)
        if wait_s is not None:
            self._timer_at = left_at + wait_s

    def _wait_after(self, tag: object) -> float | None:
        """Return the time to wait for the answer to a message in this state; None without one."""
        timings = self._timings
        match tag, self.state:
            case _, UpgradeState.WATCHING:
                self._at.watched_until = self._watch_end(self._tx.left_at)
                return self._at.watched_until - self._tx.left_at
            case Command.PACKET, UpgradeState.TRANSFERRING:
                return timings.ack_timeout_s
            case Command.PACKET, UpgradeState.SETTLING:
                return timings.quiet_after_repeat_s
            case Command.UPDATE, UpgradeState.AWAITING_REQUEST:
                if self._at.announced_meanwhile is not None:
                    return timings.update_spacing_s
                return timings.request_transfer_timeout_s
            case Command.END_OF_TRANSFER, UpgradeState.ENDING if not self._at.announcing.has_begun:
                return timings.complete_timeout_s
            case (Command.RESET, UpgradeState.RESETTING) | (
                Command.READ_VERSION,
                UpgradeState.CONFIRMING,
            ):
                return timings.command_repeat_s
        return None

    # -- actions: anywhere -----------------------------------------------------------------------

    def _ignore(self, content: ReceivedContent) -> None:
        pass

    def _report(self, content: ReceivedContent, what: str = UpgradeEvent.UNEXPECTED.value) -> None:
        """Report an unexpected message."""
        match content:
            case Malformed(message, problem):
                what = f"message {message.command:04X} from {message.can_id:03X} ignored: {problem}"
            case Unknown(message):
                what = f"unknown message {message.command:04X} from {message.can_id:03X} ignored"
            case BootVersion(name, version):
                what += f": {printable(name)} {printable(version)}"
            case Ack(number) | Nak(number):
                what += f": {type(content).__name__.upper()} {number}"
        self._run.emit(events.Reported(what))

    def _fail(self, ending: Ending, content: ReceivedContent, reason: Reason) -> None:
        """Begin another attempt, or end the upgrade if none is left."""
        if self._is_last_attempt:
            self._end(ending, content)
            return
        if self._failure is None or ending not in _SILENT:
            self._failure = (ending, content)  # later silence is less informative
        if reason in _FROM_THE_UPDATE:
            self._start_over(content, reason)
        else:
            self._begin_again(content, reason)

    def _begin_again(self, content: ReceivedContent, reason: Reason = Reason.LINK_BACK) -> None:
        """Begin another attempt with the reset."""
        if self.state is UpgradeState.RESETTING and self.goes_on:
            self._send_reset()  # this attempt has not begun
            return
        self._next_attempt(reason)
        self._enter(UpgradeState.RESETTING)
        self._send_reset()

    def _start_over(self, content: ReceivedContent, reason: Reason) -> None:
        """Begin another attempt with the update command: the device is in its bootloader."""
        self._next_attempt(reason)
        if isinstance(content, BootVersion):
            self._note_boot(content)
        if content is None:
            self._enter(UpgradeState.AWAITING_REQUEST)
            self._send_update()
        else:
            self._watch()

    def _next_attempt(self, reason: Reason) -> None:
        if reason is Reason.PACKET_GIVEN_UP:
            self._failed_packet = self._at.packet
        self._at = _Attempt()
        self._attempt += 1
        left_s = self._deadline_at - self._run.now if self.goes_on else 0.0
        self._run.emit(events.AttemptStarted(self._attempt, reason.value, left_s))

    def _repeated(self, what: str, reason: Reason, tries: int) -> None:
        self._repetitions += 1
        self._run.emit(events.MessageRepeated(what, reason.value, tries))

    def _restarted(self, content: BootVersion | RequestTransfer, reason: Reason) -> None:
        """Handle a device that restarted during the transfer."""
        self._fail(Ending.RESTARTED, content, reason)

    # -- actions: up to the update command --------------------------------------------------------

    def _repeat_reset(self, content: ReceivedContent) -> None:
        if self._run.now - self._at.first_reset_left_at >= self._timings.command_timeout_s:
            self._await_boot(content)
        else:
            self._send_reset()

    def _await_boot(self, content: ReceivedContent) -> None:
        self._enter(UpgradeState.AWAITING_BOOT)
        self._wait_for_boot()

    def _wait_for_boot(self) -> None:
        self._tx.drop_unstarted()
        wait_s = self._boot_timeout_s
        self._timer_at = max(self._run.now, self._tx.left_at) + wait_s
        is_silent = self._silence_was_answered and self._received_at < self._update_left_at
        if is_silent and self.goes_on:
            self._run.emit(events.PowerCycleAwaited(self._deadline_at - self._run.now))
        elif self._asks_for_power and self.announcement is None:
            self._run.emit(events.PowerCycleAwaited(wait_s))

    def _wait_or_begin_again(self, content: ReceivedContent) -> None:
        """Send nothing to a device that has not sent a boot version at power-up."""
        if self._asks_for_power and not self._has_begun:
            self._wait_for_boot()
        else:
            self._begin_again(content)

    def _take_boot(self, boot: BootVersion) -> None:
        number = boot_version_number(boot.version)
        minimum = self._minimum_boot
        if self._is_foreign(boot):
            self._end(Ending.WRONG_DEVICE, boot)
        elif minimum is not None and (number is None or number < minimum):
            self._end(Ending.BOOT_TOO_OLD, boot)
        elif self.unchecked is not None:
            self._end(Ending.UNCHECKED, None, self.unchecked.detail)
        else:
            self._note_boot(boot)
            self._watch()

    def _watch(self) -> None:
        """Wait for evidence of a second device: its boot version, its answer to an earlier message
        (`_message_left`), or, if an application next to the bootloader answered the reset, the boot
        versions that follow.
        """
        now, timings, at = self._run.now, self._timings, self._at
        self._enter(UpgradeState.WATCHING)
        self._tx.drop_unstarted()
        at.watched_since = now
        at.watched_until = (
            now + timings.boot_version_timeout_s
            if self._duplicates.application_beside
            else self._watch_end(now)
        )
        if self._tx.idle:
            self._timer_at = min(at.watched_until, now + timings.burst_s)

    def _watch_end(self, now: float) -> float:
        """Time until which to watch for a second device: in a transfer, until the answer of a first
        one that is slow is due, but not beyond the burst, of which one boot version may be lost.
        """
        due_at = self._tx.left_at + 2 * self._slowest_answer_s
        in_burst_s = 2.5 * self._timings.boot_version_spacing_s
        return max(
            now + self._timings.boot_watch_s, min(due_at, self._at.watched_since + in_burst_s)
        )

    def _watch_on(self, content: BootVersion | GeneralFeedbackMessage) -> None:
        now, timings, at = self._run.now, self._timings, self._at
        if isinstance(content, BootVersion) and self._is_foreign(content):
            self._end(Ending.WRONG_DEVICE, content)
            return
        answer_id = self._plan.target.answer_id
        if isinstance(content, GeneralFeedbackMessage) and not (
            self._duplicates.application_beside or self._duplicates.has_announced(answer_id)
        ):
            # Announcements before the reset have ended: an application is present and restarts.
            self._await_boot(content)
            return
        if self._duplicates.application_beside:
            wait_s = timings.boot_version_timeout_s
            at.watched_until = max(at.watched_until, at.watched_since + wait_s)
        elif self._duplicates.overlap(answer_id):
            two_rounds_s = 2 * timings.boot_version_spacing_s
            at.watched_until = max(at.watched_until, at.watched_since + two_rounds_s)
        if self._tx.idle:
            self._timer_at = min(at.watched_until, now + timings.burst_s)

    def _answer_boot(self, content: ReceivedContent) -> None:
        """Send the update command, as there is no evidence of a second device."""
        at = self._at
        has_ended = self._run.now < at.watched_until
        if self._duplicates.application_beside and has_ended and not at.was_reset_again:
            # The announcements have ended, and an application is present: reset it.
            at.was_reset_again, at.first_reset_left_at = True, inf
            self._enter(UpgradeState.RESETTING)
            self._send_reset()
        else:
            self._enter(UpgradeState.AWAITING_REQUEST)
            self._send_update()

    def _is_foreign(self, boot: BootVersion) -> bool:
        if self._options.allow_boot_name:
            return False
        return boot.name != self._plan.target.boot_name or not boot.is_version

    def _note_boot(self, boot: BootVersion) -> None:
        """Report the first boot version of the attempt."""
        if self._at.boot is not None:
            return
        self._at.boot = self._last_boot = boot
        version, minimum = printable(boot.version), self._options.minimum_boot_version
        self._run.emit(events.BootVersionSeen(printable(boot.name), version))
        if minimum is not None:
            what = f"the bootloader {version} is not older than {minimum}, as the manifest asks"
            self._run.emit(events.CheckMade("boot-version", "passed", what))

    def _miss_boot(self, content: ReceivedContent) -> None:
        """Handle a missing boot version; an interrupted transfer gets an update command (R26)."""
        if self.in_session or (self._has_begun and not self._is_last_attempt):
            silent_since = max(self._received_at, self._update_left_at, self._began_at)
            erased_at = silent_since + self._timings.request_transfer_timeout_s
            was_tried = self._at.feedback_came or self._silence_was_answered
            if was_tried and not self.goes_on and not self.in_session:
                self._fail(self._silent_ending, content, Reason.BOOT_GIVEN_UP)
            elif self._run.now < erased_at:
                self._timer_at = erased_at
            else:
                # It may be in a session that never ends and knows no reset: send an update command
                # into the silence, once, or after each erase limit if nothing can be lost.
                self._silence_was_answered = True
                self._attempts += self.in_session
                self._fail(self._silent_ending, content, Reason.BOOT_SILENT)
        elif self._options.at_power_up and self._silent_ending is Ending.NO_BOOT_VERSION:
            self._asks_for_power = True
            self._wait_for_boot()
        elif self._at.was_reset_again:
            # A bootloader may have confirmed that reset, and started its application since.
            self._fail(self._silent_ending, content, Reason.BOOT_GIVEN_UP)
        else:
            self._end(self._silent_ending, content)

    @property
    def _silent_ending(self) -> Ending:
        """Ending for a device that stays silent."""
        if self._failed_packet is not None:
            return Ending.PACKET_FAILED
        return Ending.NO_ANNOUNCEMENT if self._asks_for_power else Ending.NO_BOOT_VERSION

    def _answer_boot_again(self, boot: BootVersion) -> None:
        """Handle a boot version between update command and request transfer (R2)."""
        now, timings, at = self._run.now, self._timings, self._at
        next_at = self._update_left_at + timings.update_spacing_s
        if self._is_updating:
            at.announced_s += min(now - at.announced_at, timings.burst_s)
            at.announced_at = now
        if self._is_foreign(boot):
            self._end(Ending.WRONG_DEVICE, boot)
        elif self.unchecked is not None:
            self._end(Ending.UNCHECKED, None, self.unchecked.detail)
        elif not self._tx.idle or now < next_at:
            # Not one that queued up, if the last command took long to leave.
            if now - at.update_began_at >= self._duplicates.shortest_interval_s:
                at.announced_meanwhile = boot
                if self._tx.idle:
                    self._timer_at = next_at
        else:
            self._send_update_again(boot)

    def _send_update_again(self, boot: BootVersion) -> None:
        if self._at.announced_s > self._timings.request_transfer_timeout_s:
            self._update_ignored(boot)
        else:
            self._note_boot(boot)
            self._send_update()

    def _update_ignored(self, boot: BootVersion) -> None:
        """Handle a device that sends boot versions for the whole erase limit."""
        if self._erased:
            self._fail(Ending.UNHEARING, boot, Reason.REQUEST_GIVEN_UP)
        else:
            self._end(Ending.UNHEARING, boot)

    def _miss_request(self, content: ReceivedContent) -> None:
        announced = self._at.announced_meanwhile
        if announced is not None:
            # It may be the last one of a device that listens after its announcement only.
            self._send_update_again(announced)
        elif not self._has_begun and self._asks_for_power:
            self._attempts += 1
            self._next_attempt(Reason.REQUEST_GIVEN_UP)
            self._await_boot(content)
        elif not self._has_begun:
            self._end(Ending.NO_BOOT_VERSION, content, "nor an answer to the update command")
        else:
            is_silent = self._failed_packet is not None and self._at.boot is None
            ending = Ending.PACKET_FAILED if is_silent else Ending.NO_REQUEST
            self._fail(ending, content, Reason.REQUEST_GIVEN_UP)

    def _await_request_or_begin_again(self, content: ReceivedContent) -> None:
        if self._is_updating:
            timeout_s = self._timings.request_transfer_timeout_s
            self._at.announced_meanwhile = None  # the device may have begun to erase since
            self._timer_at = self._update_left_at + timeout_s
        else:
            self._begin_again(content)

    def _send_first_packet(self, content: ReceivedContent) -> None:
        if self._at.first_update_left_at is None:
            self._report(content)  # late answer to another update command
            return
        self._enter(UpgradeState.TRANSFERRING)
        self._tx.drop_unstarted()
        minimum = self._options.minimum_boot_version
        if minimum is not None and not self._has_begun:
            what = f"no boot version in an open session; the manifest asks for {minimum}"
            self._run.emit(events.CheckMade("boot-version", "unknown", what))
        self.unchecked = None
        self._at.request_at = self._run.now
        self._erasures += 1
        self._next_packet(1)

    # -- actions: the transfer --------------------------------------------------------------------

    def _next_packet(self, number: int) -> None:
        at = self._at
        at.packet, at.tries, self._other_answer = number, 0, ""
        at.copies_unanswered, at.accepted = 0, False
        self._send_packet()

    def _take_answer(self, answer: Ack | Nak) -> None:
        """Find the copy of the packet that an ACK or NAK answers (R10)."""
        at, accepts = self._at, isinstance(answer, Ack)
        if answer.number > at.packet:
            # Some bootloaders answer a repeated n with NAK n+1: "I want n+1".
            is_next = answer.number == at.packet + 1 and not accepts and at.tries > 1
            if not (is_next and self._options.nak_next_is_ack):
                if is_next:
                    self._other_answer = (
                        "it answers NAK n+1 to a repeated n; --nak-next-is-ack takes that for an "
                        "ACK"
                    )
                elif at.tries > 1:
                    shown = f"{'ACK' if accepts else 'NAK'} {answer.number}"
                    self._other_answer = text("the device answered {answer}", answer=shown)
                self._report(answer, "ACK or NAK for another packet")
                return
            accepts = True
        if answer.number == at.packet:
            self._other_answer = ""
        is_sending = self._tx.due_at < inf
        first_copy_is_out = at.tries > 1 or not is_sending
        is_stale = answer.number < at.packet or (
            # It answers a copy that was already answered, or none.
            not at.copies_unanswered and not (accepts and first_copy_is_out)
        )
        if is_stale:
            if self.state is UpgradeState.SETTLING:
                self._await_quiet(answer)
            return
        if at.tries == 1 and not is_sending:
            answer_s = self._run.now - self._tx.left_at
            self._slowest_answer_s = max(self._slowest_answer_s, answer_s)
        at.copies_unanswered = max(0, at.copies_unanswered - 1)
        at.accepted = at.accepted or accepts
        if at.copies_unanswered or is_sending:
            self._await_quiet(answer)
        else:
            self._settle(answer)

    def _settle(self, content: ReceivedContent) -> None:
        """Continue once every copy of the packet was answered, or the wait for answers ended."""
        at, total = self._at, self._plan.total_packets
        if not at.accepted:
            self._repeat_packet(content, Reason.PACKET_REFUSED)
            return
        self._acknowledged = at.packet
        self._tx.limit_left_at(self._run.now)
        self._run.emit(events.PacketAcknowledged(at.packet, total, at.tries))
        if at.packet < total:
            self._enter(UpgradeState.TRANSFERRING)
            self._next_packet(at.packet + 1)
            return
        self._transfer_s = self._run.now - at.request_at
        self._enter(UpgradeState.ENDING)
        at.end_tries += 1
        self._send(EndOfTransfer(), self._after_packet_gap())

    def _miss_answer(self, content: ReceivedContent) -> None:
        self._timeouts += 1
        self._repeat_packet(content, Reason.PACKET_UNANSWERED)

    def _repeat_packet(self, content: ReceivedContent, reason: Reason) -> None:
        """Send the packet again while a try is left."""
        if self._is_last_try:
            self._packet_lost(content)
            return
        self._enter(UpgradeState.TRANSFERRING)
        self._send_packet()
        self._repeated(f"packet {self._at.packet}", reason, self._at.tries)

    def _packet_lost(self, content: ReceivedContent) -> None:
        self._fail(Ending.PACKET_FAILED, content, Reason.PACKET_GIVEN_UP)

    def _resend_packet(self, content: ReceivedContent) -> None:
        self._send_packet()
        self._repeated(f"packet {self._at.packet}", Reason.LINK_BACK, self._at.tries)

    def _await_quiet(self, content: ReceivedContent) -> None:
        self._enter(UpgradeState.SETTLING)
        # While a copy is being sent, the time starts at its end (see _message_left).
        if self._tx.idle:
            quiet_s = self._timings.quiet_after_repeat_s
            self._timer_at = max(self._run.now, self._tx.left_at) + quiet_s

    def _take_late_request(self, content: RequestTransfer) -> None:
        """Handle request transfer during the transfer (R16)."""
        if self._at.packet > 1 or self._at.accepted:
            self._restarted(content, Reason.REQUEST_LATE)
        elif not self._tx.idle:
            self._await_quiet(content)
        elif self._is_last_try:
            self._packet_lost(content)
        elif self.state is UpgradeState.SETTLING:
            self._await_quiet(content)
        else:
            self._repeat_packet(content, Reason.REQUEST_AGAIN)

    def _take_boot_in_transfer(self, boot: BootVersion) -> None:
        """Handle a boot version during the transfer: left over, or from a restart (R11)."""
        if self._run.now - self._at.request_at <= self._timings.leftover_boot_version_s:
            self._report(boot, "leftover boot version")
        elif self._is_foreign(boot):
            self._end(Ending.WRONG_DEVICE, boot)
        else:
            self._restarted(boot, Reason.RESTARTED)

    # -- actions: after the last packet -----------------------------------------------------------

    def _take_end_nak(self, nak: Nak) -> None:
        """Repeat end of transfer after the first NAK; its number does not matter (R6)."""
        at = self._at
        if at.end_copies_left <= at.end_naks:
            return  # answers a packet
        at.end_naks += 1
        at.announcing.forget()  # it still waits in its transfer
        if at.end_naks > 1:
            self._end(Ending.REFUSED, nak)
            return
        self._run.listen()
        self._enter(UpgradeState.ENDING)
        self._repeat_end(Reason.END_REFUSED)

    def _repeat_end(self, reason: Reason) -> None:
        self._at.end_tries += 1
        self._repeated("end of transfer", reason, self._at.end_tries)
        self._send(EndOfTransfer())

    def _resend_end(self, content: ReceivedContent) -> None:
        self._repeat_end(Reason.LINK_BACK)

    def _miss_end(self, content: ReceivedContent) -> None:
        is_announcing = self._at.announcing.has_begun
        self._timeouts += not is_announcing
        if not is_announcing and self._at.end_tries < self._timings.end_tries:
            self._repeat_end(Reason.END_UNANSWERED)
        elif self._version_item is None:
            self._end(Ending.UNCONFIRMED, content)
        else:
            self._enter(UpgradeState.CONFIRMING)
            self._run.listen(self._version_item.can_id)
            self._query_version(content)

    def _complete(self, content: ReceivedContent) -> None:
        has_sent_end = self._at.end_copies_left > 0
        self._end(Ending.COMPLETED if has_sent_end else Ending.BROKEN_PROTOCOL, content)

    def _take_boot_after_end(self, boot: BootVersion) -> None:
        """Handle boot versions after end of transfer: one burst comes from the start of the new
        application; a device that continues to send them did not accept the image.

        The decision is by time, not by count: a doubled frame must not erase a good image.
        """
        at, now = self._at, self._run.now
        if not at.end_copies_left and not self._tx.begun:
            # It announces itself before it can have received the end.
            self._restarted(boot, Reason.RESTARTED)
            return
        if now - at.announcing.last_at > self._timings.burst_s:
            at.announcing.forget()
        at.announcing.note(now)
        if at.announcing.lasted_s >= self._timings.announcing_on_s:
            self._run.listen()
            self._restarted(boot, Reason.RESTARTED)
        elif self.state is UpgradeState.ENDING:
            self._tx.drop_unstarted()
            self._timer_at = now + self._timings.burst_s
            self._report(boot, "boot version after end of transfer")

    def _query_version(self, content: ReceivedContent) -> None:
        request = self._options.version_request_for(self._plan.target)
        if request is None:
            raise RuntimeError("the table asks for a version without a version query")
        query = catalogue.encode(request.item, request.content)
        self._timer_at = inf
        self._run.send(split(query.can_id, encode(query)), tag=Command.READ_VERSION)

    def _miss_version(self, content: ReceivedContent) -> None:
        asked_s = self._tx.left_at - self._state_since
        if asked_s >= self._timings.application_start_timeout_s:
            self._end(Ending.UNCONFIRMED, content)
        else:
            self._query_version(content)

    def _judge_version(self, answer: Content) -> None:
        other = other_unit(answer, self.serial_before)
        if other:
            self._end(Ending.UNCONFIRMED, answer, other)
            return
        running, expected = firmware_version(answer), self._plan.image.version
        self._at.running_version = running
        if expected is None:
            self._end(Ending.UNCONFIRMED, answer)
        elif running == expected:
            self._end(Ending.CONFIRMED_BY_VERSION, answer)
        else:
            self._end(Ending.OTHER_VERSION, answer, f"{running} instead of {expected}")

    # -- actions: beside another tool -------------------------------------------------------------

    def _yield_or_end(self, content: ReceivedContent) -> None:
        """Handle another tool that writes. A device without application is upgraded again when that
        tool is silent; one that may be complete, or untouched, is left to the user.
        """
        is_complete_perhaps = self._at.end_copies_left > 0
        is_erased_perhaps = self._update_was_sent and not is_complete_perhaps
        may_wait = self._options.waits_for_other_tool and not self._is_last_attempt
        if not (is_erased_perhaps and may_wait):
            self._end(Ending.SECOND_TOOL, content, self._second_tool)
            return
        if not self.is_yielding:
            self._run.emit(events.SecondToolAwaited(self._second_tool, OTHER_TOOL_QUIET_S))
        self._enter(UpgradeState.YIELDING)
        self._yield_on(content)

    def _yield_on(self, content: ReceivedContent) -> None:
        self._timer_at = self._run.now + OTHER_TOOL_QUIET_S

    def _take_turn(self, content: ReceivedContent) -> None:
        self._run.duplicates = DuplicateDetector(
            self._timings
        )  # earlier answers were for the other tool
        self._fail(Ending.SECOND_TOOL, content, Reason.SECOND_TOOL)

    # -- the end ---------------------------------------------------------------------------------

    def _end_broken(self, content: ReceivedContent) -> None:
        self._end(Ending.BROKEN_PROTOCOL, content)

    def _end_for_two_devices(self, content: ReceivedContent) -> None:
        self._end(Ending.TWO_DEVICES, content, self._duplicates.evidence)

    def _end_out_of_time(self, content: ReceivedContent) -> None:
        """End like an earlier attempt if only retries without risk followed it."""
        ending = Ending.OUT_OF_TIME
        if self.is_yielding:
            ending = Ending.SECOND_TOOL
        elif self._failure is not None and self._attempt > self._attempts:
            ending, content = self._failure
        if ending is Ending.SECOND_TOOL:
            self._end(ending, content, self._second_tool)
        else:
            self._end(ending, content)

    def _end_cancelled(self, content: ReceivedContent) -> None:
        self._end(Ending.CANCELLED, content)

    def _end(self, ending: Ending, content: ReceivedContent, detail: str = "") -> None:
        """End the upgrade as soon as a partly sent message is complete; device text is escaped."""
        if isinstance(content, BootVersion):
            detail = f"boot version {printable(content.name)!r} {printable(content.version)!r}"
        elif self._was_answered_otherwise(ending):
            detail = self._other_answer
        elif ending is Ending.PACKET_FAILED and self._phase is not Phase.TRANSFER:
            detail = "and no boot version came after it"
        self._ending = (ending, detail)
        self.state = UpgradeState.STOPPING
        self._tx.drop_unstarted()
        self._tx.send_without_gaps()
        if self._tx.idle:
            self._finish()

    def _was_answered_otherwise(self, ending: Ending) -> bool:
        """True if the packet that failed has answers, but none by table 9."""
        is_late = ending is Ending.OUT_OF_TIME and self._phase is Phase.TRANSFER
        return bool(self._other_answer) and (is_late or ending is Ending.PACKET_FAILED)

    def _finish(self) -> None:
        if self._ending is None:
            raise RuntimeError("stopping without an ending")
        ending, detail = self._ending
        self.state = UpgradeState.DONE
        phase, packet, boot = self._phase, self._packet, self._last_boot
        if ending is Ending.PACKET_FAILED and packet is None:
            # It failed in an earlier attempt, and the device was silent in this one.
            phase, packet = Phase.TRANSFER, self._failed_packet
        self._outcome = Outcome(
            ending=ending,
            phase=phase,
            device_left=_DEVICE_LEFT.get(ending, self.device_left),
            target=self._plan.target,
            total_packets=self._plan.total_packets,
            packet=packet,
            boot_version=printable(f"{boot.name} {boot.version}") if boot else None,
            running_version=self._at.running_version,
            statistics=Statistics(
                attempts=self._attempt,
                packets_acknowledged=self._acknowledged,
                repetitions=self._repetitions,
                naks=self._naks,
                timeouts=self._timeouts,
                duration_s=self._run.now - self._began_at,
                transfer_s=self._transfer_s,
            ),
            detail=detail,
            waiver=self.unchecked.waiver if self.unchecked and ending is Ending.UNCHECKED else "",
            sent_into_silence=self._silence_was_answered,
            unobserved_s=self._at.unobserved_s,
            frame_gap_s=self._options.frame_gap_s,
            was_answered_otherwise=self._was_answered_otherwise(ending),
            application_runs=self._run.now - self._at.application_at <= _APPLICATION_S,
        )
