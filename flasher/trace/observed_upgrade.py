"""Facts of one upgrade of one target in a trace: phases, packets, repetitions, damage.

It only records, and expects no certain message next. `verdict` judges the facts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from flasher.events import Phase
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import (
    COMMAND_SIZE,
    HEADER,
    OVERHEAD_SIZE,
    PREFIX_SIZE,
    Command,
    Mode,
    Target,
)
from flasher.protocol.text import find_firmware_version
from flasher.protocol.timing import DEFAULT_TIMINGS, Announcing
from flasher.protocol.wire import DamageReason
from flasher.trace.decoder import BusEvent, Kind, TimedEvent
from flasher.trace.figures import Transfer
from flasher.trace.steps import StepList, step_of
from flasher.trace.story import PacketStory, PhaseSpan, Step, StepKind, TraceVerdict

NEXT_UPGRADE_S: Final = 15.0
"""Silence after which a reset begins another upgrade, not another attempt."""
_GAP_S: Final = 1.0
"""Silence that is a line in the story."""
AT_ONCE_S: Final = 0.3
"""Shorter than a tool waits before it gives up and starts over."""
IN_VAIN_S: Final = 2 * DEFAULT_TIMINGS.command_timeout_s
"""Silence of a tool that waits for an answer before the transfer."""
_LATE_BOOT_S: Final = 0.25
"""Boot versions this soon after an update command may have been on the wire before it."""
_VERSION_SIZE: Final = 32
"""Size in bytes of the end of a packet that is searched for the begin of a version text."""
_MAX_NOTED: Final = 10
"""Maximum number of different texts of one kind."""


class Interleaving:
    """Detects messages that begin inside another one on the same CAN id: two senders at once."""

    def __init__(self) -> None:
        self.found = 0
        self._left = 0
        self._last_at = 0.0

    def frame(self, frame: Frame, now: float) -> None:
        data = frame.data
        if _is_head(data):
            soon = now - self._last_at <= DEFAULT_TIMINGS.inter_frame_timeout_s
            if self._left > 0 and soon:
                self.found += 1
            self._left = OVERHEAD_SIZE + data[PREFIX_SIZE - 1]
        self._left -= len(data)
        self._last_at = now

    def answered(self) -> None:
        """Expect no rest of an answered message: it was complete, even if frames are missing."""
        self._left = 0


def _is_head(data: bytes) -> bool:
    return (
        len(data) > PREFIX_SIZE + 1
        and data.startswith(HEADER)
        and data[len(HEADER)] in (Mode.READ, Mode.WRITE)
        and data[PREFIX_SIZE + 1] == data[PREFIX_SIZE - 1] - COMMAND_SIZE
    )


@dataclass
class ObservedUpgrade:
    """Facts of an upgrade so far. Times are seconds on the trace's clock.

    `steps` and `link` grow with it; `judge` gives the verdict of an attempt followed by another
    one.
    """

    target: Target
    begin_s: float
    bitrate_bps: int
    steps: StepList
    judge: Callable[[ObservedUpgrade, float], TraceVerdict]
    max_packets: int
    is_one_tool: bool = False
    """All messages with the tool's CAN id are known to come from one tool."""

    phase: Phase | None = None
    phase_begin_s: float = 0.0
    spans: list[PhaseSpan] = field(default_factory=list)
    attempt: int = 1
    earlier: TraceVerdict | None = None
    """Verdict of the previous attempt, if it reached the transfer."""
    is_answered: bool = False
    """The target sent an intact message."""

    # Before the transfer.
    resets: int = 0
    feedbacks: int = 0
    boot_versions: dict[str, int] = field(default_factory=dict)
    """Number of boot versions by name and version."""
    boot_names: set[str] = field(default_factory=set)
    is_boot_odd: bool = False
    """A boot version did not have the documented form."""
    boot_changes: int = 0
    """Number of boot versions that differ from the previous one in the same attempt."""
    is_announced: bool = False
    """The bootloader sent a boot version in this attempt."""
    updates: int = 0
    boots_after_update: int = 0
    feedbacks_after_update: int = 0
    image_size_bytes: int | None = None

    # The transfer.
    total: int | None = None
    packets: list[PacketStory] = field(default_factory=list)
    """Packets in the order of their first copies; limited in number."""
    current: PacketStory | None = None
    restarts: int = 0
    is_restarted: bool = False
    """The device restarted and has received no update command since."""
    damage_from_tool: int = 0
    damage_from_device: int = 0
    damage_now: int = 0
    """Damage since the last progress."""
    is_cut_short: bool = False
    """The latest message with the tool's CAN id is incomplete."""
    errors: int = 0
    errors_now: int = 0
    """Error frames since the last progress."""
    answered_otherwise: int = 0
    """General feedback, and ACKs with a number that was not sent, since the last progress."""
    other_answer: str = ""
    """The latest of these."""
    extra_acks: int = 0
    """Second ACKs for packets that were sent once."""
    image_versions: set[str] = field(default_factory=set)
    """Firmware versions found inside the packets."""

    # The end.
    ends: int = 0
    end_naks: int = 0
    boots_after_end: int = 0
    completed_at_s: float | None = None
    announcing: Announcing = field(default_factory=Announcing)
    """Boot versions after complete."""
    early_complete: bool = False
    running_version: str | None = None
    serial_number: str = ""
    """Serial number that the application answered before the upgrade or first after it."""
    other_serial_number: str = ""
    """Serial number of another unit that answered after the end."""

    # Others.
    shutdown_at_s: float | None = None
    intrusions: list[str] = field(default_factory=list)
    """Messages with the tool's CAN id that are not explained by this upgrade."""
    interleaving: Interleaving = field(default_factory=Interleaving)

    def __post_init__(self) -> None:
        self.last_at_s = self.tool_at_s = self.begin_s
        """Time of the latest message, of either side and of the tool."""
        self.link = Transfer(self.bitrate_bps)
        self._update_at_s = self._request_at_s = self.begin_s
        self._by_number: dict[int, PacketStory] = {}
        self._left_s: dict[int, float] = {}
        """Time when the latest copy of each packet had left the wire, in seconds."""
        self._last_boot = ""
        self._tail = b""

    @property
    def is_restart(self) -> bool:
        """True while the device restarted, sent boot versions, and received no update command."""
        return self.is_announced and not self.updates and self.phase is Phase.BOOT

    # -- inputs ------------------------------------------------------------------------------------

    def begins_another(self, event: BusEvent) -> bool:
        """True if a message of the tool belongs to the next upgrade."""
        is_over = self.completed_at_s is not None or self.early_complete
        is_later = event.at - self.last_at_s > NEXT_UPGRADE_S
        if event.command == Command.RESET:
            return is_over or is_later
        if event.command == Command.UPDATE:
            return self.completed_at_s is not None
        # A series: the tool identifies the next unit.
        return is_later and self.completed_at_s is not None and self.running_version is not None

    def tool(self, timed: TimedEvent) -> None:
        """Record an event with the CAN id of the tool's messages to the target."""
        self._silence(timed.begin_s)
        values = values_of(timed.event)
        is_damaged = timed.event.kind is Kind.DAMAGED
        self.damage_from_tool += is_damaged
        self.damage_now += is_damaged
        self.is_cut_short = is_damaged and values["reason"] == DamageReason.INCOMPLETE.value
        if timed.event.kind is Kind.MESSAGE and timed.event.command == Command.PACKET:
            self._packet(timed, values)
        else:
            self.steps.add(step_of(timed.event, timed.end_s))
            self._tool_message(timed, values)
        self.last_at_s = self.tool_at_s = timed.end_s

    def device(self, timed: TimedEvent) -> None:
        """Record an event with the CAN id of the target's answers to the tool."""
        self._silence(timed.begin_s)
        self.interleaving.answered()
        self.is_answered |= timed.event.kind is not Kind.DAMAGED
        step = step_of(timed.event, timed.end_s)
        values = values_of(timed.event)
        if timed.event.kind is Kind.MESSAGE and timed.event.command == Command.ACK:
            self.steps.ack(values["number"], step)
            self._ack(values["number"], timed)
        else:
            self.steps.add(step)
            if timed.event.kind is Kind.DAMAGED:
                self.damage_from_device += 1
                self.damage_now += 1
            elif timed.event.kind is Kind.MESSAGE:
                self._device_message(timed, values)
        self.last_at_s = timed.end_s

    def version(self, timed: TimedEvent) -> None:
        self.steps.add(step_of(timed.event, timed.end_s))
        values = values_of(timed.event)
        serial_number = str(values["serial_number"])
        if not self.ends:
            self.serial_number = self.serial_number or serial_number
        elif self.serial_number and serial_number not in ("", self.serial_number):
            self.other_serial_number = serial_number
        else:
            self._enter(Phase.CONFIRM, timed.begin_s)
            self.serial_number = serial_number
            self.running_version = str(values["firmware_version"])
            self.last_at_s = timed.end_s

    def shutdown(self, timed: TimedEvent) -> None:
        if self.shutdown_at_s is None:
            self.shutdown_at_s = timed.end_s
            self.steps.add(step_of(timed.event, timed.end_s))

    def error_frame(self, at_s: float) -> None:
        self.errors += 1
        self.errors_now += 1
        self.steps.error_frame(at_s)

    def finish(self) -> None:
        self._leave(self.last_at_s)

    # -- the tool ----------------------------------------------------------------------------------

    def _tool_message(self, timed: TimedEvent, values: dict[str, Any]) -> None:
        event = timed.event
        if event.kind is not Kind.MESSAGE:
            return
        match event.command:
            case Command.RESET:
                self._reset(timed)
            case Command.UPDATE:
                self._update(timed, values["size_bytes"])
            case Command.END_OF_TRANSFER:
                self.ends += 1
                if self.completed_at_s is None:
                    self._enter(Phase.END, timed.begin_s)
                    self._progress()
            case _ if self.phase is Phase.TRANSFER:
                self._add_intrusion(f"{event.title} (command {event.command:04X})")
            case _ if self.phase is Phase.END and event.command == Command.READ_VERSION:
                self._enter(Phase.CONFIRM, timed.begin_s)

    def _reset(self, timed: TimedEvent) -> None:
        is_early = self.phase in (None, Phase.RESET, Phase.BOOT)
        if is_early and self._gave_up(timed.begin_s):
            self._next_attempt(timed.begin_s)
        self.resets += 1
        if is_early:
            if self.phase is None:
                self._enter(Phase.RESET, timed.begin_s)
        elif self._is_undisturbed(timed.begin_s):
            self._add_intrusion("reset")
        else:
            self._next_attempt(timed.begin_s)
            self._enter(Phase.RESET, timed.begin_s)

    def _update(self, timed: TimedEvent, size_bytes: int) -> None:
        if self._is_undisturbed(timed.begin_s):
            self._add_intrusion("update command")
            return
        in_silence = not self.is_announced and self._gave_up(timed.begin_s)
        if self.phase in (Phase.TRANSFER, Phase.END, Phase.CONFIRM) or in_silence:
            self._next_attempt(timed.begin_s)
        self.updates += 1
        self.image_size_bytes = size_bytes
        self.is_restarted = False
        if self.phase is not Phase.UPDATE:
            self._update_at_s = timed.end_s
        self._enter(Phase.UPDATE, timed.begin_s)

    def _gave_up(self, now: float) -> bool:
        """True if the tool sent update commands and waited in vain: its next message begins another
        attempt.
        """
        return self.updates > 0 and now - self.tool_at_s >= IN_VAIN_S

    def _is_undisturbed(self, now: float) -> bool:
        """True while nothing went wrong, so that a tool has no reason to start over."""
        if self.is_one_tool:
            return False
        packet = self.current
        running = self.phase is Phase.TRANSFER and packet is not None and packet.is_clean
        return running and now - self.last_at_s < AT_ONCE_S and not self.is_restarted

    def _add_intrusion(self, what: str) -> None:
        if len(self.intrusions) < _MAX_NOTED:
            at = "" if self.current is None else f" while packet {self.current.number} was in work"
            self.intrusions.append(f"{what}{at}")

    def _packet(self, timed: TimedEvent, values: dict[str, Any]) -> None:
        number = values["number"]
        self.steps.packet(number, timed.begin_s, step_of(timed.event, timed.end_s))
        if self.phase is not Phase.TRANSFER or (self.is_restarted and number == 1):
            if self.phase in (Phase.END, Phase.CONFIRM) or self.is_restarted:
                self._next_attempt(timed.begin_s)
            self._enter(Phase.TRANSFER, timed.begin_s)
        self.total = values["total"]
        payload = bytes.fromhex(values["payload"])
        version = find_firmware_version(self._tail + payload)
        if version is not None and len(self.image_versions) < _MAX_NOTED:
            self.image_versions.add(version)
        self._tail = payload[-_VERSION_SIZE:]
        self.link.packet(number, timed)
        packet, current = self._by_number.get(number), self.current
        if packet is None:
            packet = PacketStory(number, self.attempt, 1, 0, timed.end_s, None, None)
            self._by_number[number] = packet
            if len(self.packets) < self.max_packets:
                self.packets.append(packet)
        else:
            if current is not None and current.number > number and packet.answered_at_s:
                self._add_intrusion(f"packet {number} once more")
                return
            packet.tries += 1
        self._left_s[number] = timed.left_s(self.bitrate_bps)
        self.current = packet

    # -- the device --------------------------------------------------------------------------------

    def _device_message(self, timed: TimedEvent, values: dict[str, Any]) -> None:
        match timed.event.command:
            case Command.GENERAL_FEEDBACK:
                self.feedbacks += 1
                if self.phase is Phase.RESET:
                    self._enter(Phase.BOOT, timed.end_s)
                elif self.phase in (Phase.UPDATE, Phase.TRANSFER):
                    self.feedbacks_after_update += 1
                    self._answered_otherwise("general feedback")
            case Command.BOOT_VERSION:
                self._boot_version(timed, values)
            case Command.REQUEST_TRANSFER:
                self._request(timed)
            case Command.NAK if self.phase is Phase.TRANSFER:
                self.link.answer(values["number"], timed, is_ack=False)
                if self.current is not None and self.current.number == values["number"]:
                    self.current.naks += 1
            case Command.NAK if self.phase in (Phase.END, Phase.CONFIRM):
                self.end_naks += 1
            case Command.COMPLETE if not self.ends:
                self.early_complete = True
            case Command.COMPLETE if self.completed_at_s is None:
                self.completed_at_s = timed.end_s

    def _boot_version(self, timed: TimedEvent, values: dict[str, Any]) -> None:
        now, text = timed.end_s, f"{values['name']} {values['version']}"
        self.boot_changes += bool(self._last_boot) and text != self._last_boot
        self._last_boot = text
        self.is_announced = True
        if text in self.boot_versions or len(self.boot_versions) < _MAX_NOTED:
            self.boot_versions[text] = self.boot_versions.get(text, 0) + 1
            self.boot_names.add(values["name"])
            self.is_boot_odd |= not BootVersion(values["name"], values["version"]).is_version
        match self.phase:
            case None | Phase.RESET:
                self._enter(Phase.BOOT, timed.begin_s)
            case Phase.UPDATE if now - self._update_at_s > _LATE_BOOT_S:
                self.boots_after_update += 1
            case Phase.TRANSFER:
                if now - self._request_at_s > DEFAULT_TIMINGS.leftover_boot_version_s:
                    self._restarted()
            case Phase.END | Phase.CONFIRM if self.completed_at_s is None:
                self.boots_after_end += 1
            case Phase.END | Phase.CONFIRM:
                self.announcing.note(now)

    def _request(self, timed: TimedEvent) -> None:
        if self.phase is Phase.TRANSFER and self.current is not None:
            if self.current.number > 1 or self.current.answered_at_s is not None:
                self._restarted()
            return
        self._request_at_s = timed.end_s
        self.link.begin_attempt()
        self._enter(Phase.TRANSFER, timed.end_s)
        self._progress()

    def _restarted(self) -> None:
        if not self.is_restarted:
            self.is_restarted = True
            self.restarts += 1

    def _ack(self, number: int, timed: TimedEvent) -> None:
        if self.phase is not Phase.TRANSFER:
            return
        self.link.answer(number, timed, is_ack=True)
        packet = self._by_number.get(number)
        if packet is None:
            self._answered_otherwise(f"ACK {number}")
            return
        if packet.answered_at_s is not None:
            self.extra_acks += packet.is_clean
            return
        packet.answered_at_s = timed.end_s
        packet.answer_s = max(0.0, timed.end_s - self._left_s[number])
        self._progress()

    def _answered_otherwise(self, how: str) -> None:
        self.answered_otherwise += 1
        self.other_answer = how

    # -- phases, attempts and silence --------------------------------------------------------------

    def _enter(self, phase: Phase, at_s: float) -> None:
        """Begin or continue a phase."""
        if self.phase is not phase:
            self._leave(at_s)
            self.phase, self.phase_begin_s = phase, at_s

    def _leave(self, at_s: float) -> None:
        """End the current phase, if any."""
        if self.phase is not None:
            end_s = max(self.phase_begin_s, at_s)
            self.spans.append(PhaseSpan(self.phase, self.attempt, self.phase_begin_s, end_s))

    def _progress(self) -> None:
        """Forget trouble before a success: it does not explain a later failure."""
        self.damage_now = self.errors_now = self.answered_otherwise = 0

    def _next_attempt(self, at_s: float) -> None:
        """Reset the facts of a single attempt, because the tool starts over."""
        is_first = self.phase is Phase.UPDATE and self.earlier is None
        if is_first or self.phase in (Phase.TRANSFER, Phase.END):
            self.earlier = self.judge(self, at_s)
        self._leave(at_s)
        self.phase = None
        self.attempt += 1
        self.current = None
        self.ends = self.end_naks = self.boots_after_end = self.boots_after_update = 0
        self.feedbacks_after_update = self.feedbacks = self.resets = 0
        self.is_restarted = self.early_complete = self.is_announced = False
        self._progress()
        self.link.begin_attempt()
        self._by_number = {}
        self._last_boot = ""

    def _silence(self, until_s: float) -> None:
        silent_s = until_s - self.last_at_s
        if silent_s >= _GAP_S:
            text = f"{silent_s:.2f} s without a message between tool and device"
            self.steps.add(
                Step(self.last_at_s, StepKind.GAP, "", "", "silence", text, is_trouble=False)
            )


def values_of(event: BusEvent) -> dict[str, Any]:
    """Field values by name."""
    return {shown.name: shown.value for shown in event.fields}
