"""The upgrade of appendix 3 as the tool sees it: a pure machine (see `flasher.protocol.engine`).

How to read it: frames become messages (`receive`), messages and expired timers become an event
(`classify`), `table.TABLE` says which action follows, and the actions are the short methods below.
The classification holds the readings, the table the flow; here is only what is sent, and when a
timer starts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import ClassVar, Final

from flasher.events import Phase
from flasher.host.classify import Classifier, Situation
from flasher.host.journal import Journal, Received
from flasher.host.options import UpgradeOptions, default_timeout_s
from flasher.host.outcome import DeviceLeft, Outcome, standing
from flasher.host.table import TABLE, Action, Ending, Event, State
from flasher.image.plan import Plan
from flasher.protocol import catalogue
from flasher.protocol.engine import Transmitter
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.messages import (
    BootVersion,
    EndOfTransfer,
    Malformed,
    Row,
    Unknown,
    UpdateCommand,
    decode,
)
from flasher.protocol.spec import BOOT_VERSION_BURST, Command, Mode
from flasher.protocol.text import printable
from flasher.protocol.wire import Damage, Message, Reassembler, encode, split

NOBODY: Final = -1
"""A CAN id that no frame has."""
_PHASES: Final = {
    State.RESETTING: Phase.RESET,
    State.AWAITING_BOOT: Phase.BOOT,
    State.AWAITING_REQUEST: Phase.UPDATE,
    State.TRANSFERRING: Phase.TRANSFER,
    State.SETTLING: Phase.TRANSFER,
    State.ENDING: Phase.END,
    State.CONFIRMING: Phase.CONFIRM,
}


_SETTLED: Final = {
    Ending.COMPLETED: DeviceLeft.NEW,
    Ending.CONFIRMED_BY_VERSION: DeviceLeft.NEW,
    Ending.REFUSED: DeviceLeft.NO_APPLICATION,
    Ending.RESTARTED: DeviceLeft.NO_APPLICATION,
}
"""Endings that by themselves say what the device has."""
_ACKNOWLEDGED: Final = frozenset({Event.PACKET_DONE, Event.LAST_PACKET_DONE})
_BEGINNINGS: Final = frozenset({Action.SEND_UPDATE, Action.START_OVER})


class Upgrade:
    """One upgrade of one device with one plan. Begins with the first `tick`."""

    def __init__(self, plan: Plan, options: UpgradeOptions | None = None) -> None:
        self._plan = plan
        self._options = options or UpgradeOptions()
        self._timings = self._options.timings
        self._classifier = Classifier(plan, self._options)
        inter_frame_s = self._timings.inter_frame_timeout_s
        self._answers = Reassembler(plan.target.answer_id, inter_frame_s)
        self._version_request = self._options.version_request_for(plan.target)
        request = self._version_request
        self._version_answer = None if request is None else request.answer_item
        version_id = self._version_answer.can_id if self._version_answer else NOBODY
        self._broadcasts = Reassembler(version_id, inter_frame_s)
        self._tx = Transmitter(plan.bitrate_bps, self._options.frame_gap_s)
        self._at = Situation(self._tx)
        self._phase = Phase.RESET
        self._journal = Journal()

        self._began_at: float | None = None
        self._deadline_at = 0.0
        self._timer_at: float | None = None
        self._ending: tuple[Ending, str] | None = None
        self._outcome: Outcome | None = None

    # -- the engine interface -------------------------------------------------------------------

    @property
    def done(self) -> bool:
        """True when the outcome is known and the last message begun has left."""
        return self._outcome is not None

    @property
    def outcome(self) -> Outcome:
        """How it ended. Raises RuntimeError while it has not."""
        if self._outcome is None:
            raise RuntimeError("the upgrade has not ended yet")
        return self._outcome

    @property
    def state(self) -> State:
        """The row of the table that is in force."""
        return self._at.state

    @property
    def device_left(self) -> DeviceLeft:
        """The state that the device would be left in if nothing more were sent."""
        if self._at.end_copies_left:
            return DeviceLeft.UNKNOWN
        if self._journal.erased:
            return DeviceLeft.NO_APPLICATION
        return DeviceLeft.PERHAPS_ERASED if self._at.update_left else DeviceLeft.UNTOUCHED

    @property
    def standing(self) -> str:
        """Phase, packet and attempt in words."""
        return standing(self._phase, self._packet, self._plan.total_packets, self._at.attempt)

    @property
    def _packet(self) -> int | None:
        return self._at.number if self._phase is Phase.TRANSFER else None

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        can_id = frame[0]
        if can_id == self._answers.can_id:
            reassembler = self._answers
        elif can_id == self._broadcasts.can_id and self._at.state is State.CONFIRMING:
            reassembler = self._broadcasts
        else:
            return
        if frame.is_payload:
            for found in reassembler.feed(frame[1], now):
                self._take(found, now)

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        if self._began_at is None:
            self._begin(now)
            return
        for found in (*self._answers.tick(now), *self._broadcasts.tick(now)):
            self._take(found, now)
        if self._ending is not None:
            return
        if now >= self._deadline_at:
            self._dispatch(Event.OUT_OF_TIME, now)
        elif self._timer_at is not None and now >= self._timer_at:
            self._timer_at = None
            event = self._classifier.timer(self._at, now)
            self._journal.expired(event)
            self._dispatch(event, now)

    def deadline(self) -> float | None:
        """When `tick` or `next_frame` is wanted next; at once before the beginning."""
        if self._began_at is None:
            return 0.0
        if self.done:
            return None
        earliest = inf if self._ending is not None else self._deadline_at
        for time in (
            self._timer_at,
            self._tx.deadline(),
            self._answers.deadline(),
            self._broadcasts.deadline(),
        ):
            if time is not None and time < earliest:
                earliest = time
        return None if earliest == inf else earliest

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send."""
        return self._tx.next_frame(now)

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted the frame."""
        if self._tx.frame_sent(now):
            self._message_left(now)

    def cancel(self, now: float) -> None:
        """End at the next message boundary."""
        if self._began_at is None:
            self._began_at = now
        if self._ending is None:
            self._dispatch(Event.CANCEL, now)

    def take_events(self) -> Sequence[object]:
        """What happened since the last call."""
        return self._journal.take()

    # -- the table ------------------------------------------------------------------------------

    def _take(self, found: Message | Damage, now: float) -> None:
        if self._ending is not None:
            return
        if isinstance(found, Damage):
            self._journal.damaged(found)
            return
        row = self._decode(found)
        self._journal.received(row)
        self._dispatch(self._classifier.message(row, self._at, now), now, row)

    def _decode(self, message: Message) -> Row | Malformed | Unknown | Content:
        answer = self._version_answer
        if answer is not None and message[:3] == (answer.can_id, answer.mode, answer.command):
            return answer.content.from_data(message.data)
        return decode(message)

    def _dispatch(self, event: Event, now: float, row: Received = None) -> None:
        action, state = TABLE[self._at.state][event]
        if action is Action.START_OVER:
            self._at = self._at.next_attempt()
            self._journal.attempt(self._at.attempt, event)
        if isinstance(row, BootVersion) and action in _BEGINNINGS and self._at.boot is None:
            self._at.boot = row
            self._journal.boot_seen(row)
        if event in _ACKNOWLEDGED:
            self._journal.packet_done(self._at, self._plan.total_packets, now)
        if state is not self._at.state:
            self._enter(state, now)
        if isinstance(action, Ending):
            self._end(action, self._detail(action, row), now)
        elif action is Action.IMPOSSIBLE:
            raise RuntimeError(f"{event} cannot happen in {self._at.state}")
        else:
            self._ACTIONS[action](self, now, event, row)

    def _enter(self, state: State, now: float) -> None:
        self._at.state = state
        self._at.state_since = now
        self._timer_at = None
        phase = _PHASES.get(state, self._phase)
        if phase is not self._phase:
            self._phase = phase
            self._journal.phase(phase, self._at.attempt)

    # -- timers that start when a message has left -----------------------------------------------

    def _message_left(self, now: float) -> None:
        at, left_at = self._at, self._tx.left_at
        match self._tx.left_tag:
            case Command.UPDATE:
                at.update_left_at = left_at
                if at.first_update_left_at is None:
                    at.first_update_left_at = left_at
            case Command.PACKET:
                at.copies_unanswered += 1
            case Command.END_OF_TRANSFER:
                at.end_copies_left += 1
        if at.state is State.STOPPING:
            self._finish(now)
            return
        wait_s = self._wait_s()
        if wait_s is not None:
            self._timer_at = left_at + wait_s

    def _wait_s(self) -> float | None:
        """How long the state waits for an answer to the message that has just left; None when the
        message belongs to an earlier state.
        """
        timings = self._timings
        match self._tx.left_tag, self._at.state:
            case (Command.RESET, State.RESETTING) | (Command.READ_VERSION, State.CONFIRMING):
                return timings.command_repeat_s
            case Command.RESET, State.AWAITING_BOOT:
                return timings.boot_version_timeout_s
            case Command.UPDATE, State.AWAITING_REQUEST:
                return timings.request_transfer_timeout_s
            case Command.PACKET, State.TRANSFERRING:
                return timings.ack_timeout_s
            case Command.PACKET, State.SETTLING:
                return timings.quiet_after_repeat_s
            case Command.END_OF_TRANSFER, State.ENDING if self._at.announced_at is None:
                return timings.complete_timeout_s
            case _:
                return None

    # -- actions ----------------------------------------------------------------------------------

    def _begin(self, now: float) -> None:
        self._began_at = self._at.state_since = now
        timeout_s = self._options.timeout_s
        if timeout_s is None:
            timeout_s = default_timeout_s(self._plan, self._options)
        self._deadline_at = now + timeout_s
        self._journal.phase(self._phase, self._at.attempt)
        self._send_reset(now, Event.RESET_DUE, None)

    def _nothing(self, now: float, event: Event, row: Received) -> None:
        """Ignored by the table."""

    def _report(self, now: float, event: Event, row: Received) -> None:
        self._journal.reported(event, row)

    def _send_reset(self, now: float, event: Event, row: Received) -> None:
        options, request_id = self._options, self._plan.target.request_id
        reset = Message(request_id, Mode.WRITE, options.reset_command, options.reset_data)
        self._queue(split(request_id, encode(reset)), Command.RESET)

    def _await_boot(self, now: float, event: Event, row: Received) -> None:
        self._tx.drop_unstarted()
        self._timer_at = max(now, self._tx.left_at) + self._timings.boot_version_timeout_s

    def _send_update(self, now: float, event: Event, row: Received) -> None:
        self._tx.drop_unstarted()
        target = self._plan.target
        self._send(
            UpdateCommand(target.update_text, self._plan.image.size_bytes),
            not_before=self._at.update_left_at + self._timings.update_spacing_s,
        )

    def _send_first_packet(self, now: float, event: Event, row: Received) -> None:
        self._tx.drop_unstarted()
        self._at.request_at = now
        self._journal.requested(now)
        self._at.next_packet(1)
        self._send_packet(now)

    def _send_next_packet(self, now: float, event: Event, row: Received) -> None:
        self._at.next_packet(self._at.number + 1)
        self._send_packet(now)

    def _repeat_packet(self, now: float, event: Event, row: Received) -> None:
        self._send_packet(now)
        self._journal.repeated(f"packet {self._at.number}", event, self._at.tries)

    def _send_packet(self, now: float) -> None:
        number = self._at.number
        self._at.tries += 1
        self._queue(
            self._plan.packet_frames(number),
            Command.PACKET,
            wire_s=self._plan.packet_wire_s(number),
            not_before=self._after_packet_gap(now),
        )

    def _await_quiet(self, now: float, event: Event, row: Received) -> None:
        # While a copy is still leaving, the time starts when it has (see _message_left).
        if self._tx.idle:
            self._timer_at = max(now, self._tx.left_at) + self._timings.quiet_after_repeat_s

    def _send_end(self, now: float, event: Event, row: Received) -> None:
        self._at.end_tries += 1
        self._send(EndOfTransfer(), not_before=self._after_packet_gap(now))

    def _repeat_end(self, now: float, event: Event, row: Received) -> None:
        self._at.end_tries += 1
        self._journal.repeated("end of transfer", event, self._at.end_tries)
        self._send(EndOfTransfer())

    def _await_burst_end(self, now: float, event: Event, row: Received) -> None:
        self._tx.drop_unstarted()
        self._timer_at = now + BOOT_VERSION_BURST * self._timings.boot_version_spacing_s
        self._report(now, event, row)

    def _query_version(self, now: float, event: Event, row: Received) -> None:
        request = self._version_request
        if request is None:
            raise RuntimeError("the table asks for a version that nobody can be asked for")
        query = catalogue.encode(request.item, request.content)
        self._queue(split(query.can_id, encode(query)), Command.READ_VERSION)

    def _send(self, row: Row, *, not_before: float = 0.0) -> None:
        request_id = self._plan.target.request_id
        frames = split(request_id, encode(row.to_message(request_id)))
        self._queue(frames, row.COMMAND, not_before=not_before)

    def _queue(
        self,
        frames: Sequence[Frame],
        command: Command,
        *,
        wire_s: float | None = None,
        not_before: float = 0.0,
    ) -> None:
        self._timer_at = None  # it starts when the message has left
        self._tx.queue(frames, wire_s=wire_s, not_before=not_before, tag=command)

    def _after_packet_gap(self, now: float) -> float:
        gap_s = self._options.packet_gap_s
        return now + gap_s if gap_s else 0.0

    # -- the end ----------------------------------------------------------------------------------

    def _end(self, ending: Ending, detail: str, now: float) -> None:
        self._ending = (ending, detail)
        self._timer_at = None
        self._tx.drop_unstarted()
        if self._tx.idle:
            self._finish(now)

    def _finish(self, now: float) -> None:
        if self._ending is None:
            raise RuntimeError("stopping without an ending")
        ending, detail = self._ending
        at = self._at
        at.state = State.DONE
        self._outcome = Outcome(
            ending=ending,
            phase=self._phase,
            device_left=_SETTLED.get(ending, self.device_left),
            target=self._plan.target,
            total_packets=self._plan.total_packets,
            packet=self._packet,
            boot_version=printable(f"{at.boot.name} {at.boot.version}") if at.boot else None,
            running_version=at.running_version,
            statistics=self._journal.statistics(at.attempt, now - (self._began_at or 0.0)),
            detail=detail,
        )

    def _detail(self, ending: Ending, row: Received) -> str:
        """What was seen, where the ending alone does not say it."""
        if isinstance(row, BootVersion):
            return f"boot version {printable(row.name)!r} {printable(row.version)!r}"
        if ending is Ending.OTHER_VERSION:
            return f"{self._at.running_version} instead of {self._plan.image.version}"
        if ending is Ending.PACKET_FAILED and self._at.nak_next_seen:
            return "it answers NAK n+1 to a repeated n; --nak-next-is-ack takes that for an ACK"
        return ""

    _ACTIONS: ClassVar[Mapping[Action, Callable[[Upgrade, float, Event, Received], None]]] = {
        Action.NOTHING: _nothing,
        Action.REPORT: _report,
        Action.SEND_RESET: _send_reset,
        Action.AWAIT_BOOT: _await_boot,
        Action.SEND_UPDATE: _send_update,
        Action.START_OVER: _send_update,
        Action.SEND_FIRST_PACKET: _send_first_packet,
        Action.SEND_NEXT_PACKET: _send_next_packet,
        Action.REPEAT_PACKET: _repeat_packet,
        Action.AWAIT_QUIET: _await_quiet,
        Action.SEND_END: _send_end,
        Action.REPEAT_END: _repeat_end,
        Action.AWAIT_BURST_END: _await_burst_end,
        Action.QUERY_VERSION: _query_version,
    }
