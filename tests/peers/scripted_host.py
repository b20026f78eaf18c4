"""The tool's side in its own words: a plain, right upgrade, and ways to stray from it.

What strays is either a first copy of a packet that is damaged on its way, or an aside: something
sent out of turn, whose answers are collected for a while before the upgrade goes on.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from .peer import Peer
from .wording import REPORT, WORDINGS, WRITE, build, literal, payloads

_PACKET_SIZE: Final = 128
_NOTHING: Final[frozenset[int]] = frozenset()
_NAMES: Final = {
    0x5503: "feedback",
    0xC109: "version",
    0xC402: "request",
    0xC202: "ack",
    0xC302: "nak",
    0xC502: "complete",
}


@dataclass(frozen=True)
class HostScript:
    """How the host strays. Sets and keys are packet numbers."""

    # Before the transfer.
    no_reset: bool = False
    """Waits for a device that announces itself."""
    update_on_version: int = 1
    """Which announcement is answered with the update command."""
    update_text: bytes | None = None
    update_size_bytes: int | None = None
    update_twice: bool = False
    """Two update commands in a row (UP-05)."""
    update_again_before_packet_1: bool = False
    """An aside after request transfer."""

    # First copies that go wrong; the packet is sent again when refused or not answered.
    wrong_crc: frozenset[int] = _NOTHING
    wrong_tail: frozenset[int] = _NOTHING
    lost_frame: Mapping[int, int] = field(default_factory=dict)
    """Packet number to the index of the frame (0 to 17) that is lost."""
    doubled_frame: Mapping[int, int] = field(default_factory=dict)
    swapped_frame: Mapping[int, int] = field(default_factory=dict)
    """The frame of that index changes places with the next one."""
    head: Mapping[int, bytes] = field(default_factory=dict)
    """Start byte, number and total in place of the right ones, 5 bytes (TX-03, TX-04, TX-06)."""

    # Asides; each happens after the ACK of that packet.
    repeat: frozenset[int] = _NOTHING
    """The packet again, as if its ACK had been lost."""
    other_data_on_repeat: frozenset[int] = _NOTHING
    """The packet again with every byte inverted (TX-05)."""
    skip: frozenset[int] = _NOTHING
    """The packet after the next one, out of turn."""
    early_end: frozenset[int] = _NOTHING
    update_after: frozenset[int] = _NOTHING
    """The update command in the midst (UP-08)."""
    reset_after: frozenset[int] = _NOTHING
    """The reset in the midst (TX-13)."""
    pause_s: Mapping[int, float] = field(default_factory=dict)
    """Silence for so long (TX-12)."""

    # The end.
    filler: int = 0xFF
    """Byte that fills the last packet (TX-08)."""
    end_twice: bool = False
    """End of transfer once more after the final answer (EN-02)."""
    stop_before_end: bool = False


@dataclass(frozen=True)
class Limits:
    """How long and how often the host tries, in seconds and copies."""

    version_s: float = 5.0
    request_s: float = 10.0
    ack_s: float = 0.5
    packet_tries: int = 5
    complete_s: float = 10.0
    end_tries: int = 3
    aside_s: float = 0.3


class ScriptedHost(Peer):
    """Upgrades one target with `image`. `outcome` is empty until it ends, then "complete" or what
    went wrong; `asides` has the answers to what was sent out of turn, as (name, number).
    """

    def __init__(
        self,
        target: str,
        image: bytes,
        script: HostScript | None = None,
        limits: Limits | None = None,
    ) -> None:
        self._words = WORDINGS[target]
        super().__init__(self._words.to_tool, self._words.to_device)
        self._image = image
        self._script = script or HostScript()
        self._limits = limits or Limits()
        self._total = -(-len(image) // _PACKET_SIZE)
        self.outcome = ""
        self.asides: dict[str, list[tuple[str, int]]] = {}
        self._aside: str | None = None
        self._awaits = "nothing"
        self._versions = 0
        self._number = 0
        self._tries = 0
        self._end_naks = 0
        self._done_asides: set[str] = set()
        self.alarm(0.0, self._begin)

    @property
    def done(self) -> bool:
        """True when the outcome is known and everything is sent."""
        return super().done or (self.outcome != "" and not self._outbox)

    # -- listening ----------------------------------------------------------------------------

    def hear(self, mode: int, command: int, data: bytes, now: float) -> None:
        name = _NAMES.get(command)
        if mode != REPORT or name is None:
            self.note("other", now, command)
            return
        number = int.from_bytes(data, "little") if name in {"ack", "nak"} else 0
        self.heard(name, now, number)
        if name == "version":
            self._versions += 1
        if self._aside is not None:
            self.asides[self._aside].append((name, number))
        elif self._awaits == "version":
            if name == "version" and self._versions == self._script.update_on_version:
                self._update(now)
        elif self._awaits == "request":
            if name == "request":
                self._requested(now)
        elif self._awaits == "answer":
            self._hear_answer(name, number, now)
        elif self._awaits == "complete":
            self._hear_final(name, now)

    def hear_damaged(self, wire: bytes, now: float) -> None:
        self.note("damaged", now, len(wire))

    def _hear_answer(self, name: str, number: int, now: float) -> None:
        if (name, number) == ("ack", self._number):
            self._acknowledged(now)
        elif name == "nak":
            self._packet(now)

    def _hear_final(self, name: str, now: float) -> None:
        if name == "complete":
            if self._script.end_twice and self._once("end twice"):
                self._go_aside("end twice", literal(self._words.end), now, self._completed)
                return
            self._completed(now)
        elif name == "nak":
            # R6: the end may have been damaged; a second NAK is the device's word.
            self._end_naks += 1
            if self._end_naks == 2:
                self._finish("refused", now)
            else:
                self._end(now)

    # -- speaking -----------------------------------------------------------------------------

    def _begin(self, now: float) -> None:
        if not self._script.no_reset:
            self.say("reset", literal(self._words.reset), not_before=now)
        self._await("version", now, self._limits.version_s, "no boot version")

    def _update_frames(self) -> list[bytes]:
        script = self._script
        if script.update_text is None and script.update_size_bytes is None:
            if len(self._image) == 128:
                return literal(self._words.update_128)
            if len(self._image) == 78351:
                return literal(self._words.update_78351)
        text = self._words.update_text if script.update_text is None else script.update_text
        size_bytes = len(self._image)
        if script.update_size_bytes is not None:
            size_bytes = script.update_size_bytes
        data = text + struct.pack("<I", size_bytes)
        return payloads(build(self.says_id, WRITE, 0xA100 | len(data), data))

    def _update(self, now: float) -> None:
        for _ in range(2 if self._script.update_twice else 1):
            self.say("update", self._update_frames(), not_before=now)
        self._await("request", now, self._limits.request_s, "no request transfer")

    def _requested(self, now: float) -> None:
        self._number, self._tries = 1, 0
        if self._script.update_again_before_packet_1 and self._once("update before 1"):
            self._go_aside("update before 1", self._update_frames(), now, self._packet)
            return
        self._packet(now)

    def _payload(self, number: int) -> bytes:
        start = (number - 1) * _PACKET_SIZE
        filler = bytes((self._script.filler,))
        return self._image[start : start + _PACKET_SIZE].ljust(_PACKET_SIZE, filler)

    def _packet_wire(self, number: int, payload: bytes, head: bytes | None = None) -> bytes:
        if head is None:
            head = struct.pack("<BHH", 1, number, self._total)
        return build(self.says_id, WRITE, 0xA385, head + payload)

    def _packet(self, now: float) -> None:
        if self._tries == self._limits.packet_tries:
            self._finish(f"no answer to packet {self._number}", now)
            return
        self._tries += 1
        frames = self._frames_of_copy(self._number, self._tries)
        number = self._number
        self.clear_alarms()
        self._awaits = "answer"
        self.say("packet", frames, number=number, not_before=now, then=self._packet_left)

    def _packet_left(self, now: float) -> None:
        if self._awaits == "answer":
            self.clear_alarms()
            self.alarm(now + self._limits.ack_s, self._packet)

    def _frames_of_copy(self, number: int, copy: int) -> list[bytes]:
        """The packet's CAN payloads, the first copy with the damage that the script wants."""
        script, payload = self._script, self._payload(number)
        if copy > 1:
            return payloads(self._packet_wire(number, payload))
        wire = bytearray(self._packet_wire(number, payload, script.head.get(number)))
        if number in script.wrong_crc:
            wire[-2] ^= 0x01
        if number in script.wrong_tail:
            wire[-1] ^= 0x01
        frames = payloads(bytes(wire))
        if number in script.swapped_frame:
            at = script.swapped_frame[number]
            frames[at : at + 2] = reversed(frames[at : at + 2])
        if number in script.doubled_frame:
            frames.insert(script.doubled_frame[number], frames[script.doubled_frame[number]])
        if number in script.lost_frame:
            del frames[script.lost_frame[number]]
        return frames

    def _acknowledged(self, now: float) -> None:
        """Packet `_number` is acknowledged: the asides wanted here, then the next packet."""
        self.clear_alarms()
        number, script = self._number, self._script
        asides: list[tuple[bool, str, Callable[[], list[bytes]]]] = [
            (number in script.repeat, "repeat", lambda: self._copy(number)),
            (number in script.other_data_on_repeat, "other data", lambda: self._inverted(number)),
            (number in script.skip, "skip", lambda: self._copy(number + 2)),
            (number in script.early_end, "early end", lambda: literal(self._words.end)),
            (number in script.update_after, "update", self._update_frames),
            (number in script.reset_after, "reset", lambda: literal(self._words.reset)),
            (number in script.pause_s, "pause", list),
        ]
        for wanted, name, frames in asides:
            if wanted and self._once(f"{name} {number}"):
                self._go_aside(f"{name} {number}", frames(), now, self._after_aside)
                return
        if number < self._total:
            self._number, self._tries = number + 1, 0
            self._packet(now)
        elif script.stop_before_end:
            self._finish("stopped before the end", now)
        else:
            self._tries = 0
            self._end(now)

    def _copy(self, number: int) -> list[bytes]:
        return payloads(self._packet_wire(number, self._payload(number)))

    def _inverted(self, number: int) -> list[bytes]:
        payload = bytes(byte ^ 0xFF for byte in self._payload(number))
        return payloads(self._packet_wire(number, payload))

    def _end(self, now: float) -> None:
        if self._tries == self._limits.end_tries:
            self._finish("no complete", now)
            return
        self._tries += 1
        self.clear_alarms()
        self._awaits = "complete"
        self.say("end", literal(self._words.end), not_before=now, then=self._end_left)

    def _end_left(self, now: float) -> None:
        if self._awaits == "complete" and self._aside is None:
            self.alarm(now + self._limits.complete_s, self._end)

    def _completed(self, now: float) -> None:
        self._finish("complete", now)

    # -- asides, waiting, ending --------------------------------------------------------------

    def _once(self, name: str) -> bool:
        if name in self._done_asides:
            return False
        self._done_asides.add(name)
        return True

    def _go_aside(
        self, name: str, frames: list[bytes], now: float, then: Callable[[float], None]
    ) -> None:
        """Say something out of turn, collect the answers for a while, go on with `then`."""
        self.clear_alarms()
        self._aside = name
        self.asides[name] = []
        wait_s = self._limits.aside_s
        if name.startswith("pause"):
            wait_s = self._script.pause_s[self._number]
        if frames:
            self.say(f"aside {name}", frames, not_before=now)

        def end_aside(later: float) -> None:
            self._aside = None
            then(later)

        self.alarm(now + wait_s, end_aside)

    def _after_aside(self, now: float) -> None:
        """Start over where the device did, else go on after the acknowledged packet."""
        answers = [name for heard in list(self.asides.values())[-1:] for name, _ in heard]
        if "request" in answers:
            self._requested(now)
        elif "version" in answers:
            self._versions = self._script.update_on_version
            self._update(now)
        else:
            self._acknowledged(now)

    def _await(self, what: str, now: float, limit_s: float, otherwise: str) -> None:
        self._awaits = what
        self.clear_alarms()
        self.alarm(now + limit_s, lambda later: self._finish(otherwise, later))

    def _finish(self, outcome: str, now: float) -> None:
        self.clear_alarms()
        self._awaits, self.outcome = "nothing", outcome
        self.note(outcome, now)
