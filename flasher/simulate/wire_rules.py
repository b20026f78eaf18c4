"""Rules for what a host sends, checked on the frames of the bus.

Times are those at which frames end. A rule is not checked in plans whose faults break it without
the host's doing, as a bus that is full.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Final, NamedTuple

from flasher.protocol.frame import Frame
from flasher.protocol.spec import COMMAND_SIZE, FRAMES_PER_PACKET, OVERHEAD_SIZE, TARGETS
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.simulate import plan as plans
from flasher.simulate.independent import (
    ACK,
    BOOT_VERSION,
    END,
    FEEDBACK,
    NAK,
    PACKET,
    REQUEST,
    RESET,
    UPDATE,
    VERSION,
    WRITE,
)

REPEAT_MARGIN_S: Final = 0.05
"""A repetition that was queued before an answer came begins at most so much later."""
_TOLERANCE_S: Final = 0.005
"""Frames before it on the bus make a frame later than the host sends it."""
_COMMANDS: Final = {
    command.to_bytes(2, "big"): name
    for command, name in ((RESET, "reset"), (UPDATE, "update"), (PACKET, "packet"), (END, "end"))
}
_CAUSES_REPETITION: Final = (
    plans.OnFrames, plans.Noise, plans.Unsolicited, plans.Answer, plans.Tool, plans.Load,
    plans.Kill, plans.Restart, plans.Power, plans.Hang, plans.Unplug, plans.BusOff,
)  # fmt: skip
_DELAYS_FRAMES: Final = (plans.Load, plans.Unplug, plans.BusOff, plans.Tool)
_PACKET_WIRE_S: Final = 0.008
"""Shortest time of a packet on the bus."""
_ERASURES_MAX: Final = 20
"""Erasures after which an upgrade ends (docs/explanation/upgrade.md)."""
_TOOL_QUIET_S: Final = 2.0
"""Silence of another tool before anything is sent again (docs/explanation/safety.md)."""
_ECHOED_S: Final = 0.45
"""Time after which the echo of a frame has come."""
_BURST_OVER_S: Final = 0.25
"""Silence after which announcements have ended: longer than the host's."""
_ANNOUNCING_ON_S: Final = DEFAULT_TIMINGS.announcing_on_s - REPEAT_MARGIN_S
_BESIDE_S: Final = DEFAULT_TIMINGS.boot_version_spacing_s
"""An application that confirms so soon after a boot version is that of another device."""


class Begun(NamedTuple):
    """Message of the host that begins."""

    what: str
    """ "reset", "update", "packet" or "end"."""
    number: int
    """Low byte of the packet's number."""


class WireRules:
    """Checks the frames of one run of the host after another."""

    def __init__(self, plan: plans.Plan) -> None:
        clauses = plan.clauses
        is_alone = len(plan.devices) == 1
        self._checks_acks = is_alone and not _has(clauses, _CAUSES_REPETITION)
        # A pause may come between a decision and a short queue's room for it.
        if plan.adapter.queue < FRAMES_PER_PACKET and _has(clauses, (plans.Stall,)):
            self._checks_acks = False
        has_gaps = not plan.job.others or _has(clauses, _DELAYS_FRAMES)
        self._checks_gaps = not has_gaps
        # Frames that wait in a controller that cannot send come out when it can.
        is_stuck = not plan.job.others or any(
            isinstance(each, plans.Unplug) and each.wrong_rate for each in clauses
        )
        self._checks_messages = not (is_stuck or _has(clauses, (plans.Tool, plans.BusOff)))
        self._checks_times = not _has(clauses, (plans.Load, plans.Unplug, plans.BusOff))
        self._checks_ends = self._checks_messages and self._checks_times
        self._checks_ends &= not _has(clauses, (plans.Stall,))
        # The bus shows when announcements reached the host unless they were disturbed.
        self._checks_announcements = not _has(clauses, (plans.OnFrames, plans.Noise, plans.Stall))
        self._checks_beside = self._checks_times and not _has(clauses, _CAUSES_REPETITION)
        self._checks_naks = is_alone and _names_packets_wanted(plan)
        adapter = plan.adapter
        self._has_all_echoes = adapter.echoes and not (adapter.lost or adapter.doubled)
        self._request_id = TARGETS[plan.job.target].request_id
        self._packets = plan.job.packets
        self._acked: set[int] = set()
        """Low bytes of the numbers of all ACKs, also of those that come late."""
        self._wanted = 1
        """Packet that the device waits for."""
        self.has_version_answer = False
        """The device answered a version request after the end of transfer."""
        self._broken: dict[str, int] = {}
        self.begin_run()

    def begin_run(self) -> None:
        """Begin with another process of the host, without the state of the one before."""
        self._left = self._update_left = 0
        self.has_update = False
        """A whole update command was sent."""
        self.ends = 0
        """Whole ends of transfer since the last update command."""
        self._erasures = 0
        self._is_erasing = False
        """No packet was sent since the last update command."""
        self._requests = 0
        """Requests for the transfer since then."""
        self._in_adapter: deque[tuple[bytes, float]] = deque()
        """Frames that the host's adapter has not sent yet, with the times at which it took them."""
        self._heads: dict[bytes, float] = {}
        """First frames of the host's messages, with their times."""
        self._sent_twice: set[bytes] = set()
        """Those that were sent again before the echo of the first had come for sure."""
        self._tool_at = self._beside_at = self._announced_at = float("-inf")
        self._announcing_since = 0.0
        self._has_reset = False
        self._had_gap = False
        self._kind = ""
        self._ended_at = float("-inf")
        self._acknowledged: dict[int, float] = {}
        self._packet: tuple[int, float] | None = None
        """Low byte of the number of the packet sent last, and when it left for the host."""
        self._packet_begun_at = self._heard_at = float("-inf")
        self._updated_at = self._head_taken_at = float("-inf")
        self._number = 0

    @property
    def has_half_message(self) -> bool:
        """The device waits for the rest of a message that nothing has disturbed."""
        return self._left > 0 and self._checks_ends

    def broken(self) -> Iterator[str]:
        """Yield the rules that were broken, with their numbers."""
        for text, count in self._broken.items():
            yield text if count == 1 else f"{text} ({count} times)"

    def host_sends(self, frame: Frame, now: float) -> Begun | None:
        """Check a frame of the host; return the message that begins with it."""
        data = frame.data
        gap_s, self._ended_at = now - self._ended_at, now
        taken_at = self._leaves_adapter(data, now)
        # As a reassembler knows it: an image may contain the first two bytes (2.2.1).
        is_head = len(data) == 8 and data[:2] == b"\x55\xaa" and data[3] == data[5] + COMMAND_SIZE
        name = _COMMANDS.get(data[4:6]) if is_head and data[2] == WRITE else None
        # Unlike `_left` also beside a device that restarts: another one may take the command.
        if is_head:
            self._update_left = data[3] + OVERHEAD_SIZE if name == "update" else 0
        if self._update_left:
            self._update_left = max(0, self._update_left - len(data))
            self.has_update |= not self._update_left
        if not is_head:
            if self._left > 0:
                limit_s = DEFAULT_TIMINGS.inter_frame_timeout_s + _TOLERANCE_S
                # One frame may have been on its way to the adapter when the host paused.
                if self._had_gap and self._checks_gaps:
                    self._break("a message goes on after a gap in which the device dropped it")
                self._had_gap = gap_s > limit_s
                self._left -= len(data)
                if self._left <= 0:
                    self._end_message(now, taken_at)
            return None
        is_short = gap_s < DEFAULT_TIMINGS.inter_frame_timeout_s - _TOLERANCE_S
        # The device dropped a message whose rest came after a gap.
        if self._left > 0 and is_short and self._checks_messages and not self._had_gap:
            self._break("a message begins while the device waits for the rest of another one")
        number = data[7] if name == "packet" else 0
        # A pause cut it: what came meanwhile answers it as well.
        is_begun_again = self._left > 0 and (name, number) == (self._kind, self._number)
        self._kind, self._number, self._had_gap = name or "", number, False
        self._left, self._head_taken_at = data[3] + OVERHEAD_SIZE - len(data), taken_at
        if name is None:
            return None
        if now - self._heads.get(data, float("-inf")) <= _ECHOED_S:
            self._sent_twice.add(data)
        self._heads[data] = now
        self._check_begin(name, number, now, is_begun_again=is_begun_again)
        if self._left <= 0:
            self._end_message(now, taken_at)
        return Begun(name, number)

    def _check_begin(self, name: str, number: int, now: float, *, is_begun_again: bool) -> None:
        is_beside_tool = REPEAT_MARGIN_S < now - self._tool_at < _TOOL_QUIET_S - REPEAT_MARGIN_S
        if is_beside_tool and self._checks_times:
            self._break("a message begins while another tool writes")
        if name == "reset":
            self._has_reset, self._beside_at = True, float("-inf")
        elif name == "update":
            self._check_update(now)
        elif name == "end":
            self._check_acknowledged(self._packets % 256)
        else:
            if self._is_erasing:
                self._is_erasing = False
                self._erasures += 1
                if self._erasures > _ERASURES_MAX:
                    self._break(f"the device is erased more than {_ERASURES_MAX} times")
            if number != 1:
                self._check_acknowledged((number - 1) % 256)
            self._check_repetition(number, now)
            if not is_begun_again:
                self._packet_begun_at = now

    def _check_update(self, now: float) -> None:
        announcing_s = self._announced_at - self._announcing_since
        if self.ends and announcing_s < _ANNOUNCING_ON_S and self._checks_announcements:
            self._break("an update command to a device that may have the new image (R11)")
        is_beside = now - self._beside_at < 3 * _BESIDE_S and not self.has_update
        if is_beside and self._checks_beside:
            self._break("an update command beside an application that answers (R27)")
        self._acknowledged.clear()
        self._packet = None
        self.ends, self._requests, self._is_erasing = 0, 0, True

    def _check_acknowledged(self, number: int) -> None:
        if number not in self._acked:
            self._break("a message follows a packet that was never acknowledged")

    def _check_repetition(self, number: int, now: float) -> None:
        acknowledged_at = self._acknowledged.get(number)
        if (
            self._checks_acks
            and acknowledged_at is not None
            and now - acknowledged_at > REPEAT_MARGIN_S
        ):
            self._break("a packet is sent again after its ACK")
        if self._packet is not None and self._packet[0] == number:
            waited_s = now - self._packet[1]
            is_early = waited_s < DEFAULT_TIMINGS.ack_timeout_s - _TOLERANCE_S
            is_answered = self._heard_at > self._packet_begun_at - REPEAT_MARGIN_S
            # A host that paused may read the second request for it when it has sent it (R16).
            is_answered |= number == 1 and self._requests > 1
            if is_early and self._checks_times and not is_answered:
                self._break("a packet is sent again before its answer is late")

    def _end_message(self, now: float, taken_at: float) -> None:
        self._left = 0
        if self._kind == "packet":
            # The host does not know how long its frames wait for those before them (R12).
            left_at = max(self._head_taken_at + _PACKET_WIRE_S, taken_at)
            self._packet = (self._number, min(left_at, now))
        elif self._kind == "end":
            if not self.ends:
                self._announced_at = float("-inf")
            self.ends += 1
            self.has_version_answer = False

    def host_hands_over(self, frame: Frame, now: float) -> None:
        """Check a frame that the host hands to its adapter."""
        data = frame.data
        self._in_adapter.append((data, now))
        if data[:2] == b"\x55\xaa" and _COMMANDS.get(data[4:6]) == "update":
            if now - self._updated_at < DEFAULT_TIMINGS.update_spacing_s - _TOLERANCE_S:
                self._break("two update commands with less than 30 ms between them")
            self._updated_at = now

    def _leaves_adapter(self, data: bytes, now: float) -> float:
        """Return when the adapter took a frame that has left; now for one of a killed process."""
        for index, (each, taken_at) in enumerate(self._in_adapter):
            if each == data:
                del self._in_adapter[index]
                return taken_at
        return now

    def delayed_frame_arrives(self, now: float) -> None:
        """Note a frame of a device that arrives later than the bus carried it."""
        self._heard_at = now

    def others_send(self, frame: Frame, now: float) -> None:
        """Note a frame of a device, of another tool, or of other traffic."""
        data = frame.data
        if data[:2] == b"\x55\xaa" and len(data) == 8:
            if frame.can_id == self._request_id:
                self._tool_begins(data, now)
            else:
                self._device_begins(data, now)
        self._heard_at = now

    def _tool_begins(self, data: bytes, now: float) -> None:
        """Note when another tool writes, unless its frame may be taken for an echo."""
        sent_at = self._heads.get(data)
        is_distinct = sent_at is None or (self._has_all_echoes and now - sent_at > _ECHOED_S)
        # Its second echo may have been taken for a copy of the first: another one is expected.
        is_distinct &= data not in self._sent_twice
        # The host takes it for the echo of its own frame, which still waits in the adapter.
        is_distinct &= all(each != data for each, _ in self._in_adapter)
        if data[2] == WRITE and is_distinct:
            self._tool_at = now

    def _device_begins(self, data: bytes, now: float) -> None:
        command, number = int.from_bytes(data[4:6], "big"), int.from_bytes(data[6:8], "little")
        if command == ACK and data[3] == 4:
            low = data[6]
            self._acked.add(low)
            self._acknowledged.setdefault(low, now)
            self._acknowledged.pop((low + 1) % 256, None)  # numbers come round after 255
            self._wanted = max(self._wanted, number + 1)
        elif command == NAK and self._checks_naks:
            if number != min(self._wanted, self._packets):
                self._break("a NAK names another packet than the device waits for")
        elif command == REQUEST:
            self._wanted = 1
            self._requests += 1
        elif command == VERSION:
            self.has_version_answer = True
        elif command == FEEDBACK:
            if self._has_reset and now - self._announced_at <= _BESIDE_S:
                self._beside_at = now
        elif command == BOOT_VERSION:
            self._left = 0  # a device that restarts waits for nothing
            if now - self._announced_at > _BURST_OVER_S:
                self._announcing_since = now
            self._announced_at = now

    def _break(self, text: str) -> None:
        self._broken[text] = self._broken.get(text, 0) + 1


def _has(clauses: tuple[plans.Clause, ...], kinds: tuple[type[plans.Clause], ...]) -> bool:
    return any(isinstance(each, kinds) for each in clauses)


def _names_packets_wanted(plan: plans.Plan) -> bool:
    """True if each NAK comes from a device model that names the packet that it waits for."""
    (device, *_) = plan.devices
    is_model = isinstance(device, plans.Mock) and "bad_packet=nak_received" not in device.choices
    return is_model and not _has(plan.clauses, (plans.Unsolicited, plans.Answer, plans.Tool))
