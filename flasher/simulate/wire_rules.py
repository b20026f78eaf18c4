"""Rules for what a host sends, checked on the frames of the bus.

Times are those at which frames end. A rule is not checked in plans whose faults break it without
the host's doing, as a bus that is full.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

from flasher.protocol.frame import Frame
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.simulate import plan as plans
from flasher.simulate.independent import (
    ACK,
    BOOT_VERSION,
    END,
    PACKET,
    RESET,
    UPDATE,
    VERSION,
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
    plans.Stall, plans.Kill, plans.Restart, plans.Power, plans.Hang, plans.Unplug, plans.BusOff,
)  # fmt: skip
_DELAYS_FRAMES: Final = (plans.Load, plans.Unplug, plans.BusOff, plans.Tool)
_MESSAGE_OVERHEAD: Final = 9
"""Bytes of a message beside those that its length counts."""


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
        has_gaps = not plan.job.others or _has(clauses, _DELAYS_FRAMES)
        self._checks_gaps = not has_gaps
        # Frames that wait in a controller that cannot send come out when it can.
        is_stuck = not plan.job.others or any(
            isinstance(each, plans.Unplug) and each.wrong_rate for each in clauses
        )
        self._checks_messages = not (is_stuck or _has(clauses, (plans.Tool, plans.BusOff)))
        self._checks_times = not _has(clauses, (plans.Load, plans.Unplug, plans.BusOff))
        self.has_version_answer = False
        """The device answered a version request after its last announcement or complete."""
        self.updates = 0
        self._broken: dict[str, int] = {}
        self.begin_run()

    def begin_run(self) -> None:
        """Begin with another process of the host, which knows nothing of the one before."""
        self._left = self._update_left = 0
        self.has_update = False
        """A whole update command was sent."""
        self._had_gap = False
        self._kind = ""
        self._ended_at = float("-inf")
        self._acknowledged: dict[int, float] = {}
        self._packet: tuple[int, float] | None = None
        """Low byte of the number of the packet sent last, and its end."""
        self._packet_begun_at = self._heard_at = float("-inf")
        self._updated_at = float("-inf")
        self._number = 0

    def broken(self) -> Iterator[str]:
        """Yield the rules that were broken, with their numbers."""
        for text, count in self._broken.items():
            yield text if count == 1 else f"{text} ({count} times)"

    def host_sends(self, frame: Frame, now: float) -> Begun | None:
        """Check a frame of the host; return the message that begins with it."""
        data = frame.data
        gap_s, self._ended_at = now - self._ended_at, now
        name = _COMMANDS.get(data[4:6]) if data[:3] == b"\x55\xaa\x16" else None
        if name is not None:
            self._update_left = data[3] + _MESSAGE_OVERHEAD if name == "update" else 0
        if self._update_left:
            self._update_left = max(0, self._update_left - len(data))
            self.has_update |= not self._update_left
        if name is None:
            if self._left > 0:
                limit_s = DEFAULT_TIMINGS.inter_frame_timeout_s + _TOLERANCE_S
                # One frame may have been on its way to the adapter when the host paused.
                if self._had_gap and self._checks_gaps:
                    self._break("a message goes on after a gap in which the device dropped it")
                self._had_gap = gap_s > limit_s
                self._left -= len(data)
                self._end_message(now)
            elif data[:2] == b"\x55\xaa" and len(data) == 8:
                self._left = data[3] + _MESSAGE_OVERHEAD - len(data)
                self._kind = ""
            return None
        is_short = gap_s < DEFAULT_TIMINGS.inter_frame_timeout_s - _TOLERANCE_S
        # The device dropped a message whose rest came after a gap.
        if self._left > 0 and is_short and self._checks_messages and not self._had_gap:
            self._break("a message begins while the device waits for the rest of another one")
        self._kind, self._had_gap = name, False
        self._number = data[7] if name == "packet" and len(data) > 7 else 0
        self._left = data[3] + _MESSAGE_OVERHEAD - len(data)
        self._check_begin(name, self._number, now)
        self._end_message(now)
        return Begun(name, self._number)

    def _check_begin(self, name: str, number: int, now: float) -> None:
        if name == "update":
            self.updates += 1
            self._acknowledged.clear()
            self._packet = None
        elif name == "packet":
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
                if is_early and self._checks_times and not is_answered:
                    self._break("a packet is sent again before its answer is late")
            self._packet_begun_at = now

    def _end_message(self, now: float) -> None:
        if self._left > 0:
            return
        self._left = 0
        if self._kind == "packet":
            self._packet = (self._number, now)

    def update_handed_over(self, now: float) -> None:
        """Check an update command that the host hands to its adapter."""
        if now - self._updated_at < DEFAULT_TIMINGS.update_spacing_s - _TOLERANCE_S:
            self._break("two update commands with less than 30 ms between them")
        self._updated_at = now

    def others_send(self, frame: Frame, now: float) -> None:
        """Note a frame of a device, of another tool, or of other traffic."""
        data = frame.data
        if data[:2] == b"\x55\xaa" and len(data) == 8:
            command = int.from_bytes(data[4:6], "big")
            if command == ACK and data[3] == 4:
                number = data[6]
                self._acknowledged.setdefault(number, now)
                self._acknowledged.pop((number + 1) % 256, None)  # numbers come round after 255
            elif command == VERSION:
                self.has_version_answer = True
            elif command == BOOT_VERSION:
                self._left = 0  # a device that restarts waits for nothing
        self._heard_at = now

    def _break(self, text: str) -> None:
        self._broken[text] = self._broken.get(text, 0) + 1


def _has(clauses: tuple[plans.Clause, ...], kinds: tuple[type[plans.Clause], ...]) -> bool:
    return any(isinstance(each, kinds) for each in clauses)
