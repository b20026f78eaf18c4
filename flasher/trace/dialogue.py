"""One upgrade of one target as it is heard on the bus: the facts, in the order in which they come.

It is no host and no device: it does not know what has to come next, it takes down what was said.
What the facts mean is judged by `verdict`.
"""

from __future__ import annotations

from typing import Any, Final

from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import Command, Target
from flasher.protocol.text import find_firmware_version
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import DamageReason
from flasher.trace.decoder import BusEvent, Kind
from flasher.trace.facts import Facts
from flasher.trace.link import Transfer
from flasher.trace.pieces import Piece
from flasher.trace.records import PacketRecord
from flasher.trace.steps import StepList, step_of
from flasher.trace.story import Phase, Step, StepKind
from flasher.trace.verdict import judge

NEXT_UPGRADE_S: Final = 15.0
"""A reset after so much silence begins another upgrade, not another attempt."""
_GAP_S: Final = 1.0
"""Silence that is worth a line."""
_AT_ONCE_S: Final = 0.3
"""A tool that gives up waits longer than this for an answer, before it starts over."""
_IN_VAIN_S: Final = 2 * DEFAULT_TIMINGS.command_timeout_s
"""A tool that is silent for so long before the transfer has waited for an answer."""
_LATE_BOOT_S: Final = 0.25
"""Boot versions up to here after an update command may have been on their way."""
_VERSION_SIZE: Final = 32
"""Bytes of the packet before, in which a version that spans two packets may begin."""
_MAX_NOTED: Final = 10
"""Different texts of one sort that are kept."""


class Dialogue(Facts):
    """Takes down one upgrade, message by message; `steps` and `link` grow with it."""

    def __init__(
        self,
        target: Target,
        begin_s: float,
        bitrate_bps: int,
        *,
        steps: StepList,
        max_packets: int,
        is_one_tool: bool = False,
    ) -> None:
        super().__init__(target, begin_s, begin_s, begin_s, is_one_tool=is_one_tool)
        self.steps = steps
        self.link = Transfer(bitrate_bps)
        self._bitrate_bps = bitrate_bps
        self._max_packets = max_packets
        self._update_at_s = self._request_at_s = begin_s
        self._by_number: dict[int, PacketRecord] = {}
        self._last_boot = ""
        self._tail = b""

    # -- what is told to it ----------------------------------------------------------------------

    def begins_another(self, seen: BusEvent) -> bool:
        """True when a message of the tool belongs to the next upgrade, not to this one."""
        is_over = self.completed_at_s is not None or self.early_complete
        if seen.command == Command.RESET:
            return is_over or seen.at - self.last_at_s > NEXT_UPGRADE_S
        if seen.command == Command.UPDATE:
            return self.completed_at_s is not None
        return False

    def tool(self, piece: Piece) -> None:
        """Something on the id of the tool's messages to the target."""
        self._silence(piece.begin_s)
        values = values_of(piece.seen)
        is_damaged = piece.seen.kind is Kind.DAMAGED
        self.damage_from_tool += is_damaged
        self.damage_now += is_damaged
        self.is_cut_short = is_damaged and values["reason"] == DamageReason.INCOMPLETE.value
        if piece.seen.kind is Kind.MESSAGE and piece.seen.command == Command.PACKET:
            self._packet(piece, values)
        else:
            self.steps.add(step_of(piece.seen, piece.end_s))
            self._tool_says(piece, values)
        self.last_at_s = self.tool_at_s = piece.end_s

    def device(self, piece: Piece) -> None:
        """Something on the id of the target's answers to the tool."""
        self._silence(piece.begin_s)
        self.interleaving.answered()
        self.is_answered |= piece.seen.kind is not Kind.DAMAGED
        step = step_of(piece.seen, piece.end_s)
        values = values_of(piece.seen)
        if piece.seen.kind is Kind.MESSAGE and piece.seen.command == Command.ACK:
            self.steps.ack(values["number"], step)
            self._ack(values["number"], piece)
        else:
            self.steps.add(step)
            if piece.seen.kind is Kind.DAMAGED:
                self.damage_from_device += 1
                self.damage_now += 1
            elif piece.seen.kind is Kind.MESSAGE:
                self._device_says(piece, values)
        self.last_at_s = piece.end_s

    def version(self, piece: Piece) -> None:
        """The target's application told its version."""
        self.steps.add(step_of(piece.seen, piece.end_s))
        if self.ends:
            self.enter(Phase.CONFIRM, piece.begin_s)
            self.running_version = str(values_of(piece.seen)["firmware_version"])
            self.last_at_s = piece.end_s

    def shutdown(self, piece: Piece) -> None:
        """The battery announced that it switches off."""
        if self.shutdown_at_s is None:
            self.shutdown_at_s = piece.end_s
            self.steps.add(step_of(piece.seen, piece.end_s))

    def error_frame(self, at_s: float) -> None:
        """An error frame."""
        self.errors += 1
        self.errors_now += 1
        self.steps.error_frame(at_s)

    def finish(self) -> None:
        """Nothing more will come."""
        self.leave(self.last_at_s)

    # -- the tool ----------------------------------------------------------------------------------

    def _tool_says(self, piece: Piece, values: dict[str, Any]) -> None:
        seen = piece.seen
        if seen.kind is not Kind.MESSAGE:
            return
        match seen.command:
            case Command.RESET:
                self._reset(piece)
            case Command.UPDATE:
                self._update(piece, values["size_bytes"])
            case Command.END_OF_TRANSFER:
                self.ends += 1
                if self.completed_at_s is None:
                    self.enter(Phase.END, piece.begin_s)
                    self.progress()
            case _ if self.phase is Phase.TRANSFER:
                self._intrude(f"{seen.title} (command {seen.command:04X})")
            case _ if self.phase is Phase.END and seen.command == Command.READ_VERSION:
                self.enter(Phase.CONFIRM, piece.begin_s)

    def _reset(self, piece: Piece) -> None:
        is_early = self.phase in (None, Phase.RESET, Phase.BOOT)
        if is_early and self._gave_up(piece.begin_s):
            self._next_attempt(piece.begin_s)
        self.resets += 1
        if is_early:
            if self.phase is None:
                self.enter(Phase.RESET, piece.begin_s)
        elif self._is_undisturbed(piece.begin_s):
            self._intrude("reset")
        else:
            self._next_attempt(piece.begin_s)
            self.enter(Phase.RESET, piece.begin_s)

    def _update(self, piece: Piece, size_bytes: int) -> None:
        if self._is_undisturbed(piece.begin_s):
            self._intrude("update command")
            return
        in_silence = not self.is_announced and self._gave_up(piece.begin_s)
        if self.phase in (Phase.TRANSFER, Phase.END, Phase.CONFIRM) or in_silence:
            self._next_attempt(piece.begin_s)
        self.updates += 1
        self.image_size_bytes = size_bytes
        self.is_restarted = False
        if self.phase is not Phase.UPDATE:
            self._update_at_s = piece.end_s
        self.enter(Phase.UPDATE, piece.begin_s)

    def _gave_up(self, now: float) -> bool:
        """True when a tool that has told the device to update before waited for it in vain: what it
        sends now is its next attempt.
        """
        return self.updates > 0 and now - self.tool_at_s >= _IN_VAIN_S

    def _is_undisturbed(self, now: float) -> bool:
        """True while all goes well, so that no tool has a reason to start over."""
        if self.is_one_tool:
            return False
        packet = self.current
        running = self.phase is Phase.TRANSFER and packet is not None and packet.is_clean
        return running and now - self.last_at_s < _AT_ONCE_S and not self.is_restarted

    def _intrude(self, what: str) -> None:
        if len(self.intrusions) < _MAX_NOTED:
            at = "" if self.current is None else f" while packet {self.current.number} was in work"
            self.intrusions.append(f"{what}{at}")

    def _packet(self, piece: Piece, values: dict[str, Any]) -> None:
        number = values["number"]
        self.steps.packet(number, piece.begin_s, step_of(piece.seen, piece.end_s))
        if self.phase is not Phase.TRANSFER or (self.is_restarted and number == 1):
            if self.phase in (Phase.END, Phase.CONFIRM) or self.is_restarted:
                self._next_attempt(piece.begin_s)
            self.enter(Phase.TRANSFER, piece.begin_s)
        self.total = values["total"]
        self._look_for_version(bytes.fromhex(values["payload"]))
        self.link.packet(number, piece)
        record = self._by_number.get(number)
        current = self.current
        if record is None:
            left_s = piece.left_s(self._bitrate_bps)
            record = PacketRecord(number, self.attempt, piece.end_s, left_s)
            self._by_number[number] = record
            if len(self.packets) < self._max_packets:
                self.packets.append(record)
        else:
            if current is not None and current.number > number and record.answered_at_s:
                self._intrude(f"packet {number} once more")
                return
            record.tries += 1
            record.left_s = piece.left_s(self._bitrate_bps)
        self.current = record

    def _look_for_version(self, payload: bytes) -> None:
        found = find_firmware_version(self._tail + payload)
        if found is not None and len(self.image_versions) < _MAX_NOTED:
            self.image_versions.add(found)
        self._tail = payload[-_VERSION_SIZE:]

    # -- the device --------------------------------------------------------------------------------

    def _device_says(self, piece: Piece, values: dict[str, Any]) -> None:
        match piece.seen.command:
            case Command.GENERAL_FEEDBACK:
                self._feedback(piece)
            case Command.BOOT_VERSION:
                self._boot_version(piece, values)
            case Command.REQUEST_TRANSFER:
                self._request(piece)
            case Command.NAK:
                self._nak(values["number"], piece)
            case Command.COMPLETE:
                self._complete(piece)

    def _feedback(self, piece: Piece) -> None:
        self.feedbacks += 1
        if self.phase is Phase.RESET:
            self.enter(Phase.BOOT, piece.end_s)
        elif self.phase in (Phase.UPDATE, Phase.TRANSFER):
            self.feedbacks_after_update += 1

    def _boot_version(self, piece: Piece, values: dict[str, Any]) -> None:
        now, text = piece.end_s, f"{values['name']} {values['version']}"
        self.boot_changes += bool(self._last_boot) and text != self._last_boot
        self._last_boot = text
        self.is_announced = True
        if text in self.boot_versions or len(self.boot_versions) < _MAX_NOTED:
            self.boot_versions[text] = self.boot_versions.get(text, 0) + 1
            self.boot_names.add(values["name"])
            self.is_boot_odd |= not BootVersion(values["name"], values["version"]).is_version
        match self.phase:
            case None | Phase.RESET:
                self.enter(Phase.BOOT, piece.begin_s)
            case Phase.UPDATE if now - self._update_at_s > _LATE_BOOT_S:
                self.boots_after_update += 1
            case Phase.TRANSFER:
                if now - self._request_at_s > DEFAULT_TIMINGS.leftover_boot_version_s:
                    self._restarted()
            case Phase.END | Phase.CONFIRM if self.completed_at_s is None:
                self.boots_after_end += 1

    def _request(self, piece: Piece) -> None:
        if self.phase is Phase.TRANSFER and self.current is not None:
            if self.current.number > 1 or self.current.answered_at_s is not None:
                self._restarted()
            return
        self._request_at_s = piece.end_s
        self.link.begin_attempt()
        self.enter(Phase.TRANSFER, piece.end_s)
        self.progress()

    def _restarted(self) -> None:
        if not self.is_restarted:
            self.is_restarted = True
            self.restarts += 1

    def _ack(self, number: int, piece: Piece) -> None:
        if self.phase is not Phase.TRANSFER:
            return
        self.link.answer(number, piece, is_ack=True)
        packet = self._by_number.get(number)
        if packet is None:
            return
        if packet.answered_at_s is not None:
            self.extra_acks += packet.is_clean
            return
        packet.answered_at_s = piece.end_s
        packet.answer_s = max(0.0, piece.end_s - packet.left_s)
        self.progress()

    def _nak(self, number: int, piece: Piece) -> None:
        if self.phase is Phase.TRANSFER:
            self.link.answer(number, piece, is_ack=False)
            if self.current is not None and self.current.number == number:
                self.current.naks += 1
        elif self.phase in (Phase.END, Phase.CONFIRM):
            self.end_naks += 1

    def _complete(self, piece: Piece) -> None:
        if not self.ends:
            self.early_complete = True
        elif self.completed_at_s is None:
            self.completed_at_s = piece.end_s

    # -- attempts and silence ----------------------------------------------------------------------

    def _next_attempt(self, at_s: float) -> None:
        if self.phase in (Phase.TRANSFER, Phase.END):
            self.earlier = judge(self, at_s, is_alone=False)
        self.begin_attempt(at_s)
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


def values_of(seen: BusEvent) -> dict[str, Any]:
    """The values of the fields by their names."""
    return {shown.name: shown.value for shown in seen.fields}
