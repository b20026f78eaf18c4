"""The upgrade of appendix 3 as the tool sees it: a pure machine (see `flasher.protocol.engine`).

How to read it: frames become messages (`incoming`), messages and expired timers become an event
(`classify`), `table.TABLE` says which action follows, and the actions are the short methods below.
The classification holds the readings, the table the flow, `outgoing` what is sent, `situation` what
is known; here is only how they go together, and when a timer starts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import ClassVar, Final

from flasher.events import Phase
from flasher.host.classify import Classifier
from flasher.host.conclude import conclude, detail_of
from flasher.host.incoming import IncomingMessages
from flasher.host.journal import Journal, Received
from flasher.host.options import UpgradeOptions, overall_timeout_s
from flasher.host.outcome import DeviceLeft, Outcome, standing
from flasher.host.outgoing import Outgoing, OutgoingMessages, answer_wait_s
from flasher.host.situation import Situation
from flasher.host.table import TABLE, Action, Ending, Event, State
from flasher.image.plan import Plan
from flasher.protocol.engine import Transmitter
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import BOOT_VERSION_BURST
from flasher.protocol.wire import Damage, Message

_ACKNOWLEDGED: Final = frozenset({Event.PACKET_DONE, Event.LAST_PACKET_DONE})
_BEGINNINGS: Final = frozenset({Action.SEND_UPDATE, Action.START_OVER})
_WELL_BEYOND: Final = 1.5
"""Silence after a message that was cut short, as a multiple of the time after which its receiver
drops it (R12)."""
_NEW_ATTEMPTS: Final = frozenset({Action.START_OVER, Action.BEGIN_AGAIN})
_RESUMED: Final = frozenset({State.TRANSFERRING, State.SETTLING, State.ENDING, State.CONFIRMING})
"""States that go on where they stood when a lost adapter is back."""


class Upgrade:
    """One upgrade of one device with one plan. Begins with the first `tick`: with a reset, or, when
    the device was `heard` to announce its boot version already, with the answer to that.
    """

    def __init__(self, plan: Plan, options: UpgradeOptions | None = None) -> None:
        self._plan = plan
        self._options = options or UpgradeOptions()
        self._timings = self._options.timings
        self._classifier = Classifier(plan, self._options)
        self._incoming = IncomingMessages(plan, self._options)
        self._outgoing = OutgoingMessages(plan, self._options)
        self._tx = Transmitter(plan.bitrate_bps, self._options.frame_gap_s)
        self.heard: Message | None = None
        """A boot version that was received before the beginning."""
        self.deadline_at: float | None = None
        """The overall deadline; None until it begins, which computes it from the options."""
        self._at = Situation(self._tx)
        if self._options.at_power_up:
            self._at.phase = Phase.BOOT
        self._journal = Journal()
        self._began_at: float | None = None
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
    def may_begin_again(self) -> bool:
        """True when an attempt is left, or none is needed to go on after the adapter was lost."""
        return (
            self._at.attempt < self._options.attempts
            or self._ending is not None
            or self._at.state in _RESUMED
            or self._classifier.link_back(self._at) is Event.LINK_BACK_UPDATING
        )

    @property
    def has_begun_to_erase(self) -> bool:
        """True once an update command is sent, or being sent."""
        at = self._at
        is_leaving = at.state is State.AWAITING_REQUEST and self._tx.begun
        return at.update_left or is_leaving

    @property
    def device_left(self) -> DeviceLeft:
        """The state that the device would be left in if nothing more were sent."""
        return self._at.device_left

    @property
    def standing(self) -> str:
        """Phase, packet and attempt in words."""
        at = self._at
        return standing(at.phase, at.packet, self._plan.total_packets, at.attempt)

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        for found in self._incoming.feed(frame, self._at.state, now):
            self._take(found, now)

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        if self._began_at is None:
            self._begin(now)
            return
        for found in self._incoming.tick(now):
            self._take(found, now)
        if self._ending is not None:
            return
        if self.deadline_at is not None and now >= self.deadline_at:
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
        earliest = inf
        for time in (
            None if self._ending is not None else self.deadline_at,
            self._timer_at,
            self._tx.deadline(),
            *self._incoming.deadlines(),
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

    def link_back(self, now: float) -> None:
        """The adapter was lost and works again. What was half sent is abandoned."""
        if self._began_at is None:
            return
        self._tx.abandon(now + self._timings.inter_frame_timeout_s * _WELL_BEYOND)
        self._at.heard_at = now  # nobody knows what it said meanwhile
        if self._ending is not None:
            self._finish(now)
        elif self._waits_for_power_up:
            self._await_boot(now, Event.LINK_BACK, None)
        else:
            self._dispatch(self._classifier.link_back(self._at), now)

    @property
    def _waits_for_power_up(self) -> bool:
        """True while nothing may be sent: the device has not announced itself yet."""
        at = self._at
        waits = self._options.at_power_up and at.state is State.AWAITING_BOOT
        return waits and not at.update_left

    def second_tool(self, seen: str, now: float) -> None:
        """Somebody else sends what only the tool may send: end at once, and send nothing more, not
        even the rest of a message. `seen` says what was seen.
        """
        if self.done:
            return
        self._tx.abandon(now)
        if self._ending is not None:
            self._finish(now)
            return
        self._at.second_tool = seen
        self._dispatch(Event.SECOND_TOOL, now)

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
        row = self._incoming.decode(found)
        self._at.heard_at = now
        self._journal.received(row)
        self._dispatch(self._classifier.message(row, self._at, now), now, row)

    def _dispatch(self, event: Event, now: float, row: Received = None) -> None:
        action, state = TABLE[self._at.state][event]
        if action in _NEW_ATTEMPTS:
            failed = self._at.number if event is Event.PACKET_GIVEN_UP else None
            self._at = self._at.next_attempt(failed)
            self._journal.attempt(self._at.attempt, event)
        if isinstance(row, BootVersion) and action in _BEGINNINGS and self._at.boot is None:
            self._at.boot = self._at.last_boot = row
            self._journal.boot_seen(row, self._options.minimum_boot_version)
        if event in _ACKNOWLEDGED:
            self._journal.packet_done(self._at, self._plan.total_packets, now)
        if state is not self._at.state:
            self._enter(state, now)
        if isinstance(action, Ending):
            self._end(action, detail_of(action, row, self._plan, self._at), now)
        elif action is Action.IMPOSSIBLE:
            raise RuntimeError(f"{event} cannot happen in {self._at.state}")
        else:
            self._ACTIONS[action](self, now, event, row)

    def _enter(self, state: State, now: float) -> None:
        self._timer_at = None
        if self._at.enter(state, now):
            self._journal.phase(self._at.phase, self._at.attempt)

    # -- timers that start when a message has left -----------------------------------------------

    def _message_left(self, now: float) -> None:
        command, left_at = self._tx.left_tag, self._tx.left_at
        self._at.message_left(command, left_at)
        if self._at.state is State.STOPPING:
            self._finish(now)
            return
        wait_s = answer_wait_s(command, self._at, self._options)
        if wait_s is not None:
            self._timer_at = left_at + wait_s

    # -- actions ----------------------------------------------------------------------------------

    def _begin(self, now: float) -> None:
        self._began_at = self._at.state_since = now
        if self.deadline_at is None:
            self.deadline_at = now + overall_timeout_s(self._plan, self._options)
        if self._options.at_power_up or self.heard is not None:
            self._at.enter(State.AWAITING_BOOT, now)
        self._journal.phase(self._at.phase, self._at.attempt)
        if self._at.state is State.RESETTING:
            self._send_reset(now, Event.RESET_DUE, None)
            return
        self._await_boot(now, Event.RESET_UNANSWERED, None)
        if self.heard is not None:
            self._take(self.heard, now)

    def _nothing(self, now: float, event: Event, row: Received) -> None:
        """Ignored by the table."""

    def _report(self, now: float, event: Event, row: Received) -> None:
        self._journal.reported(event, row)

    def _send_reset(self, now: float, event: Event, row: Received) -> None:
        self._send(self._outgoing.reset())

    def _await_boot(self, now: float, event: Event, row: Received) -> None:
        self._tx.drop_unstarted()
        self._timer_at = max(now, self._tx.left_at) + self._options.boot_timeout_s
        if self._options.at_power_up and self.heard is None:
            self._journal.power_cycle(self._options.boot_timeout_s)

    def _await_erase(self, now: float, event: Event, row: Received) -> None:
        self._timer_at = self._at.silent_since + self._timings.request_transfer_timeout_s

    def _await_request(self, now: float, event: Event, row: Received) -> None:
        self._timer_at = self._at.update_left_at + self._timings.request_transfer_timeout_s

    def _send_update(self, now: float, event: Event, row: Received) -> None:
        self._tx.drop_unstarted()
        not_before = self._at.update_left_at + self._timings.update_spacing_s
        self._send(self._outgoing.update(), not_before)

    def _send_first_packet(self, now: float, event: Event, row: Received) -> None:
        self._tx.drop_unstarted()
        self._at.requested(now)
        self._at.next_packet(1)
        self._send_packet(now)

    def _send_next_packet(self, now: float, event: Event, row: Received) -> None:
        self._at.next_packet(self._at.number + 1)
        self._send_packet(now)

    def _repeat_packet(self, now: float, event: Event, row: Received) -> None:
        self._send_packet(now)
        self._journal.repeated(f"packet {self._at.number}", event, self._at.tries)

    def _send_packet(self, now: float) -> None:
        self._at.tries += 1
        self._send(self._outgoing.packet(self._at.number), self._after_packet_gap(now))

    def _await_quiet(self, now: float, event: Event, row: Received) -> None:
        # While a copy is still leaving, the time starts when it has (see _message_left).
        if self._tx.idle:
            self._timer_at = max(now, self._tx.left_at) + self._timings.quiet_after_repeat_s

    def _send_end(self, now: float, event: Event, row: Received) -> None:
        self._at.end_tries += 1
        self._send(self._outgoing.end(), self._after_packet_gap(now))

    def _repeat_end(self, now: float, event: Event, row: Received) -> None:
        self._at.end_tries += 1
        self._journal.repeated("end of transfer", event, self._at.end_tries)
        self._send(self._outgoing.end())

    def _await_burst_end(self, now: float, event: Event, row: Received) -> None:
        self._tx.drop_unstarted()
        self._timer_at = now + BOOT_VERSION_BURST * self._timings.boot_version_spacing_s
        self._report(now, event, row)

    def _query_version(self, now: float, event: Event, row: Received) -> None:
        self._send(self._outgoing.version_query())

    def _send(self, message: Outgoing, not_before: float = 0.0) -> None:
        self._timer_at = None  # it starts when the message has left
        frames, command, wire_s = message
        self._tx.queue(frames, wire_s=wire_s, not_before=not_before, tag=command)

    def _after_packet_gap(self, now: float) -> float:
        gap_s = self._options.packet_gap_s
        return now + gap_s if gap_s else 0.0

    # -- the end ----------------------------------------------------------------------------------

    def _end(self, ending: Ending, detail: str, now: float) -> None:
        self._ending = (ending, detail)
        self._timer_at = None
        self._tx.drop_unstarted()
        self._tx.hurry()
        if self._tx.idle:
            self._finish(now)

    def _finish(self, now: float) -> None:
        if self._ending is None:
            raise RuntimeError("stopping without an ending")
        ending, detail = self._ending
        self._at.state = State.DONE
        duration_s = now - (self._began_at or 0.0)
        statistics = self._journal.statistics(self._at.attempt, duration_s)
        self._outcome = conclude(ending, detail, self._plan, self._at, statistics)

    _ACTIONS: ClassVar[Mapping[Action, Callable[[Upgrade, float, Event, Received], None]]] = {
        Action.NOTHING: _nothing,
        Action.REPORT: _report,
        Action.SEND_RESET: _send_reset,
        Action.AWAIT_BOOT: _await_boot,
        Action.AWAIT_ERASE: _await_erase,
        Action.AWAIT_REQUEST: _await_request,
        Action.SEND_UPDATE: _send_update,
        Action.START_OVER: _send_update,
        Action.BEGIN_AGAIN: _send_reset,
        Action.SEND_FIRST_PACKET: _send_first_packet,
        Action.SEND_NEXT_PACKET: _send_next_packet,
        Action.REPEAT_PACKET: _repeat_packet,
        Action.AWAIT_QUIET: _await_quiet,
        Action.SEND_END: _send_end,
        Action.REPEAT_END: _repeat_end,
        Action.AWAIT_BURST_END: _await_burst_end,
        Action.QUERY_VERSION: _query_version,
    }
