"""Trace explanation: builds the story of the upgrades in a trace from its frames.

Reads the frames once and keeps none. Uses CAN ids alone, as most formats do not record the sender.
Shares no code with the host engines, whose bugs it would repeat.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from flasher.protocol.frame import Frame
from flasher.protocol.spec import (
    BMS,
    BOOT_VERSION_BURST,
    MOTINOVA,
    TARGETS,
    WELLING,
    Command,
    Node,
    Target,
    can_id,
)
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.trace.decoder import ROUTES, BusEvent, Kind, TimedDecoder, TimedEvent, bits_of
from flasher.trace.observed_upgrade import NEXT_UPGRADE_S, ObservedUpgrade, values_of
from flasher.trace.steps import MAX_STEPS, StepList, mark_unanswered, step_of
from flasher.trace.story import (
    BusFigures,
    Cause,
    Recorded,
    Step,
    Story,
    Talker,
    TalkerKind,
    TraceVerdict,
    UpgradeStory,
)
from flasher.trace.verdict import judge, remarks, times
from flasher.wording import explanation

MAX_TALKERS: Final = 100
"""Maximum number of listed CAN ids; further ones are only counted."""
_MAX_IDS: Final = 100_000
MAX_PACKETS: Final = 200_000
"""Maximum number of packets stored one by one in a story, over all upgrades."""
EVERYTHING_LIMIT: Final = 200_000
"""Maximum number of lines in a list of every message."""
WALL_TIME_FROM: Final = 1e8
"""Time stamps from here on (1973) are wall time; smaller ones are relative to a start."""
_MAY_BE_ANSWERED: Final = frozenset({Cause.RECORDING_ENDS, Cause.TOOL_STOPPED})
"""Verdicts after which the last message may have been answered outside the trace."""
_BEGINNING_COMMANDS: Final = (
    Command.RESET,
    Command.UPDATE,
    Command.PACKET,
    Command.END_OF_TRANSFER,
)
"""Messages of the tool with which an upgrade begins."""
_BOOTLOADER_COMMANDS: Final = frozenset(Command) - {
    Command.READ_VERSION,
    Command.VERSION_INFORMATION,
}
"""Commands that applications never send."""
_BURST_S: Final = 1.0
"""Maximum time between a boot version and the upgrade that it belongs to."""
_SHUTDOWN: Final = 0x1308
_BY_REQUEST: Final = {target.request_id: target for target in TARGETS.values()}
_BY_ANSWER: Final = {target.answer_id: target for target in TARGETS.values()}
_HMI_IDS: Final = frozenset(
    can_id(sender, receiver)
    for sender in Node
    for receiver in (None, *Node)
    if sender is not receiver and Node.HMI in (sender, receiver)
)


def explain(
    frames: Iterable[tuple[float, Frame]],
    *,
    source: str,
    suffix: str = "",
    bitrate_bps: int | None = None,
    until: float | None = None,
    everything: bool = False,
    recorded: Recorded | None = None,
    is_one_tool: bool = False,
) -> Story:
    """Build the story of a trace: `frames` with their times in seconds, in file order.

    `suffix` names the format. `bitrate_bps` None means the dialect's own rate. `until` is the end
    of the recording on the same clock, if known. `everything` keeps every message as its own line.
    `is_one_tool` means that one tool sent everything, and may break the protocol on purpose. Raises
    the exceptions of `frames`.
    """
    reading = _StoryBuilder(bitrate_bps, everything=everything, is_one_tool=is_one_tool)
    now = float("-inf")
    for at, frame in frames:
        now = max(now, at)
        reading.frame(frame, now)
    return reading.story(source, suffix, until, recorded)


class _StoryBuilder:
    """Collects facts while the frames are read."""

    def __init__(self, bitrate_bps: int | None, *, everything: bool, is_one_tool: bool) -> None:
        self._given_bps = bitrate_bps
        self._bitrate_bps = bitrate_bps or WELLING.bitrate_bps
        self._everything = everything
        self._is_one_tool = is_one_tool
        self._bus = BusCounter()
        self._decoder = TimedDecoder()
        self._open: dict[Target, ObservedUpgrade] = {}
        self._upgrades: list[tuple[float, UpgradeStory]] = []
        self._packets_left = MAX_PACKETS
        self._outside = self._new_steps()
        self._announced: dict[Target, list[TimedEvent]] = {}
        """Latest boot versions that no tool has answered yet."""
        self._identified = "", float("-inf")
        """Serial number of the battery that answered last outside an upgrade, and when."""
        self._announcements = 0
        self._has_hmi = False
        self._has_nodes = False
        self._start: float | None = None

    def frame(self, frame: Frame, now: float) -> None:
        if self._start is None:
            self._start = now
        now -= self._start
        bits = bits_of(frame)
        self._bus.frame(frame, now, bits)
        if frame.is_error:
            for upgrade in self._open.values():
                upgrade.error_frame(now)
            if not self._open:
                self._outside.error_frame(now)
            return
        for timed in self._decoder.feed(frame, now, bits):
            self._take(timed)
        target = None if frame.is_extended else _BY_REQUEST.get(frame.can_id)
        if target in self._open and frame.is_payload:
            self._open[target].interleaving.frame(frame, now)

    def _take(self, timed: TimedEvent) -> None:
        event = timed.event
        if event.kind is Kind.FOREIGN:
            return
        self._has_nodes |= event.kind is not Kind.DAMAGED
        self._has_hmi |= event.can_id in _HMI_IDS
        self._bus.note(event)
        if event.can_id in _BY_REQUEST:
            self._tool(_BY_REQUEST[event.can_id], timed)
        elif event.can_id in _BY_ANSWER:
            self._device(_BY_ANSWER[event.can_id], timed)
        else:
            self._other(timed)

    # -- routing to upgrades ----------------------------------------------------------------------

    def _tool(self, target: Target, timed: TimedEvent) -> None:
        upgrade = self._open.get(target)
        if upgrade is not None and upgrade.begins_another(timed.event):
            self._close(target, timed.begin_s)
            upgrade = None
        if upgrade is None:
            if (
                timed.event.kind is not Kind.MESSAGE
                or timed.event.command not in _BEGINNING_COMMANDS
            ):
                self._outside.add(step_of(timed.event, timed.end_s))
                return
            upgrade = self._begin(target, timed)
        upgrade.tool(timed)

    def _begin(self, target: Target, timed: TimedEvent) -> ObservedUpgrade:
        """Begin an upgrade, with the boot versions that led to it."""
        heard = [
            message
            for message in self._announced.pop(target, [])
            if timed.begin_s - message.end_s <= _BURST_S
        ]
        upgrade = self._open[target] = ObservedUpgrade(
            target,
            heard[0].begin_s if heard else timed.begin_s,
            self._bitrate_bps,
            steps=self._new_steps(),
            judge=judge,
            max_packets=self._packets_left,
            is_one_tool=self._is_one_tool,
        )
        serial_number, answered_at_s = self._identified
        if target is BMS and timed.begin_s - answered_at_s <= NEXT_UPGRADE_S:
            upgrade.serial_number = serial_number
        for message in heard:
            upgrade.device(message)
        return upgrade

    def _end_of_restart(self, target: Target, timed: TimedEvent) -> None:
        """Drop an upgrade that was a mere restart: the device sent boot versions, received no
        update command, and its application answers.
        """
        upgrade = self._open.get(target)
        is_application = timed.event.kind in (Kind.MESSAGE, Kind.UNKNOWN)
        if upgrade is None or not upgrade.is_restart or not is_application:
            return
        if timed.event.command not in _BOOTLOADER_COMMANDS:
            del self._open[target]
            for line in upgrade.steps.lines():
                if isinstance(line, Step):
                    self._outside.add(line)

    def _device(self, target: Target, timed: TimedEvent) -> None:
        self._end_of_restart(target, timed)
        upgrade = self._open.get(target)
        if upgrade is not None:
            upgrade.device(timed)
            return
        if timed.event.command == Command.BOOT_VERSION and timed.event.kind is Kind.MESSAGE:
            self._announcements += 1
            self._announced[target] = [
                *self._announced.get(target, [])[1 - BOOT_VERSION_BURST :],
                timed,
            ]
        self._outside.add(step_of(timed.event, timed.end_s))

    def _other(self, timed: TimedEvent) -> None:
        """Process a message between other nodes, or a broadcast."""
        event = timed.event
        if event.kind is Kind.MESSAGE and event.can_id == BMS.broadcast_id:
            if event.command == Command.VERSION_INFORMATION:
                self._end_of_restart(BMS, timed)
            battery = self._open.get(BMS)
            if event.command == Command.VERSION_INFORMATION:
                if battery is not None:
                    battery.version(timed)
                    return
                self._identified = str(values_of(event)["serial_number"]), timed.end_s
            if event.command == _SHUTDOWN:
                for upgrade in self._open.values():
                    upgrade.shutdown(timed)
        tells = event.is_trouble or Node.CDL.name in (event.sender, event.receiver)
        if tells or self._everything or event.command == _SHUTDOWN:
            self._outside.add(step_of(event, timed.end_s))

    def _new_steps(self) -> StepList:
        limit = EVERYTHING_LIMIT if self._everything else MAX_STEPS
        return StepList(fold=not self._everything, limit=limit)

    # -- the story ---------------------------------------------------------------------------------

    def _close(self, target: Target, until_s: float) -> None:
        upgrade = self._open.pop(target)
        upgrade.finish()
        self._packets_left = max(0, self._packets_left - len(upgrade.packets))
        is_alone = self._bus.is_alone and not upgrade.is_answered
        verdict = judge(upgrade, until_s, is_alone=is_alone)
        story = UpgradeStory(
            target=target.node.name,
            begin_s=upgrade.begin_s,
            end_s=upgrade.last_at_s,
            image_size_bytes=upgrade.image_size_bytes,
            total_packets=upgrade.total,
            boot_version=next(reversed(upgrade.boot_versions), None),
            running_version=upgrade.running_version,
            attempts=upgrade.attempt,
            phases=tuple(upgrade.spans),
            packets=tuple(upgrade.packets),
            steps=mark_unanswered(
                upgrade.steps, target.node.name, is_over=verdict.cause not in _MAY_BE_ANSWERED
            ),
            steps_left_out=upgrade.steps.left_out,
            link=upgrade.link.report(),
            remarks=remarks(upgrade, verdict.cause),
            verdict=verdict,
        )
        self._upgrades.append((upgrade.begin_s, story))

    def story(
        self, source: str, suffix: str, until: float | None, recorded: Recorded | None
    ) -> Story:
        """Return the story, after the last frame. `until` is the end of the trace in seconds on its
        clock; None means its last frame.
        """
        start = self._start or 0.0
        until_s = max(self._bus.last_at, 0.0 if until is None else until - start)
        for timed in self._decoder.finish(self._bus.last_at):
            # A device that was still speaking when the recording ended has damaged nothing.
            was_speaking = until_s - timed.end_s < DEFAULT_TIMINGS.inter_frame_timeout_s
            if timed.event.can_id in _BY_REQUEST or not was_speaking:
                self._take(timed)
        for target in tuple(self._open):
            self._close(target, until_s)
        upgrades = tuple(story for _, story in sorted(self._upgrades, key=lambda one: one[0]))
        # The first bad verdict among the last upgrades of each target.
        verdicts = list({upgrade.target: upgrade.verdict for upgrade in upgrades}.values())
        bad = [verdict for verdict in verdicts if not verdict.cause.is_good]
        chief = next(iter(bad or verdicts), None)
        bitrate_bps = self._bitrate_bps
        if self._given_bps is None and self._has_hmi and not upgrades:
            # Only one dialect has displays, and only the other one has upgrades.
            bitrate_bps = MOTINOVA.bitrate_bps
        bus = self._bus.figures(bitrate_bps)
        targets = [TARGETS[upgrade.target.lower()] for upgrade in upgrades]
        talkers = self._bus.talkers(
            {of for each in targets for of in (each.request_id, each.answer_id)}
        )
        return Story(
            source=printable(source),
            format=printable(suffix),
            started_at=start if start >= WALL_TIME_FROM else None,
            duration_s=bus.duration_s,
            bitrate_bps=bitrate_bps,
            frames=bus.frames,
            bus=bus,
            upgrades=upgrades,
            talkers=tuple(talkers[:MAX_TALKERS]),
            verdict=self._without_upgrade() if chief is None else chief,
            steps=self._outside.lines(),
            steps_left_out=self._outside.left_out,
            talkers_left_out=max(0, len(talkers) - MAX_TALKERS),
            recorded=recorded,
        )

    def _without_upgrade(self) -> TraceVerdict:
        bus = self._bus
        if self._announcements:
            cause = Cause.QUERIES_ONLY
            text = (
                f"A bootloader announced itself {times(self._announcements)}, and no tool began an "
                "upgrade."
            )
        elif self._has_nodes:
            cause = Cause.QUERIES_ONLY
            text = "No tool began an upgrade; the trace holds messages of the drive system."
        elif bus.frames:
            cause = Cause.FOREIGN_ONLY
            text = f"None of the {bus.frames:,} frames holds a message of the drive system."
        else:
            cause = Cause.EMPTY
            text = "The trace holds no classic CAN frame."
        if bus.error_frames:
            text += f" Error frames: {bus.error_frames:,}."
        likely, remedy = explanation(cause)
        return TraceVerdict(cause, None, None, 0, text, likely, remedy)


class BusCounter:
    """Counts the frames of a trace."""

    def __init__(self) -> None:
        self.frames = 0
        self.first_at: float | None = None
        self.last_at = 0.0
        self.error_frames = 0
        self.damaged = 0
        self.malformed = 0
        self.is_alone = True
        """Only the tool sent frames."""
        self._bits = 0
        self._peak_bits = 0
        self._second = 0
        self._second_bits = 0
        self._gap = (0.0, 0.0)
        self._talkers: dict[tuple[int, bool], int] = {}

    def frame(self, frame: Frame, now: float, bits: int) -> None:
        """Count a frame; times never decrease."""
        if self.first_at is None:
            self.first_at = self.last_at = now
        if now - self.last_at > self._gap[0]:
            self._gap = (now - self.last_at, self.last_at)
        self.last_at = now
        self._bits += bits
        second = int(now - self.first_at)
        if second != self._second:
            self._second, self._second_bits = second, 0
        self._second_bits += bits
        self._peak_bits = max(self._peak_bits, self._second_bits)
        if frame.is_error:
            self.error_frames += 1
            return
        self.frames += 1
        key = (frame.can_id, frame.is_extended)
        if key in self._talkers or len(self._talkers) < _MAX_IDS:
            self._talkers[key] = self._talkers.get(key, 0) + 1
        if self.is_alone:
            names = None if frame.is_extended else ROUTES.get(frame.can_id)
            self.is_alone = names is not None and names[0] == Node.CDL.name

    def note(self, event: BusEvent) -> None:
        """Count damaged bytes, and malformed or unknown messages."""
        self.damaged += event.kind is Kind.DAMAGED
        self.malformed += event.kind in (Kind.MALFORMED, Kind.UNKNOWN)

    def figures(self, bitrate_bps: int) -> BusFigures:
        first_at = self.first_at or 0.0
        duration_s = self.last_at - first_at if self.frames or self.error_frames else 0.0
        return BusFigures(
            duration_s=duration_s,
            frames=self.frames,
            load=self._bits / bitrate_bps / duration_s if duration_s > 0 else None,
            peak_load=self._peak_bits / bitrate_bps if duration_s >= 1 else None,
            error_frames=self.error_frames,
            damaged=self.damaged,
            malformed=self.malformed,
            longest_gap_s=self._gap[0],
            longest_gap_at_s=max(0.0, self._gap[1] - first_at),
        )

    def talkers(self, but: set[int]) -> list[Talker]:
        """Return all senders except these 11-bit CAN ids, most frames first."""
        found = []
        for (of_id, is_extended), frames in self._talkers.items():
            names = None if is_extended else ROUTES.get(of_id)
            if of_id in but and not is_extended:
                continue
            kind = TalkerKind.FOREIGN if names is None else TalkerKind.NODE
            name = "" if names is None else f"{names[0]} > {names[1]}"
            found.append(Talker(of_id, is_extended, name, frames, kind))
        return sorted(found, key=lambda talker: -talker.frames)
