"""A device in its own words: application and bootloader as the documents tell, and ways to stray.

Without a script it is a plain, right device. A script makes it lose, double, delay or garble what
it says, restart or fall silent, each at a chosen packet.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from .peer import Peer
from .wording import (
    REPORT,
    WORDINGS,
    WRITE,
    Frame,
    build,
    literal,
    numbered,
    payloads,
)

_ACK: Final = 0xC202
_NAK: Final = 0xC302
_PACKET_SIZE: Final = 128
_BROADCAST_OF: Final = {"wmc": 0x710, "bms": 0x720, "obc": 0x730}
_NOTHING: Final[frozenset[int]] = frozenset()


@dataclass(frozen=True)
class DeviceScript:
    """How the device strays. Sets and keys are packet numbers; each entry acts once, on the first
    copy of that packet, unless its line says otherwise.
    """

    # Before the transfer.
    no_feedback: bool = False
    """The reset is not answered, but obeyed."""
    deaf_to_reset: bool = False
    """The reset is neither answered nor obeyed."""
    versions_lost: frozenset[int] = _NOTHING
    """Which of a burst's four announcements are lost."""
    wrong_name: bool = False
    """The announcements bear another target's name."""
    bad_version_text: bytes | None = None
    """Six bytes in place of V1.2.3."""
    version_changes: bool = False
    """From the second announcement on the version is another one (RS-09)."""
    deaf_to_updates: int = 0
    """So many update commands are not taken."""
    no_request: bool = False
    """The update command is taken, but transfer is never requested."""
    request_twice: bool = False
    """Transfer is requested twice before packet 1."""
    leftover_version: bool = False
    """One more announcement comes 20 ms after the request."""

    # In the transfer.
    drop_ack: frozenset[int] = _NOTHING
    nak: Mapping[int, int] = field(default_factory=dict)
    """So many copies of the packet are refused."""
    silent_after: int | None = None
    """After this packet's ACK nothing more is sent; 0 means after the request."""
    restart_at: int | None = None
    """On this packet the device restarts and announces itself."""
    request_at: int | None = None
    """On this packet transfer is requested again, and nothing stored."""
    complete_at: int | None = None
    """On this packet completion is claimed (EN-05)."""
    late_ack: Mapping[int, float] = field(default_factory=dict)
    """ACK so many seconds late."""
    double_ack: frozenset[int] = _NOTHING
    ack_then_nak: frozenset[int] = _NOTHING
    nak_then_ack: frozenset[int] = _NOTHING
    """A NAK and right after it the ACK, for a packet that is stored."""
    stale_ack: frozenset[int] = _NOTHING
    """Before ACK n the ACK of the packet before it comes again."""
    future_ack: frozenset[int] = _NOTHING
    """Before ACK n there comes ACK n + 1."""
    nak_next_on_repeat: bool = False
    """A repeated packet n is answered NAK n + 1 (R10), always."""

    # The end.
    end_nak: int = 0
    """So many ends of transfer are refused although all is well."""
    lose_complete: int = 0
    """So many final answers are lost."""
    announce_after_complete: int = 0
    """So many announcements after the final answer, lost or not (EN-03)."""

    # The bus.
    foreign_frames: bool = False
    """With every answer come frames of other kinds and messages on other ids."""


class ScriptedDevice(Peer):
    """One target's device. `image_check` judges the whole image at the end of transfer (R7)."""

    def __init__(
        self,
        target: str,
        script: DeviceScript | None = None,
        *,
        image_check: Callable[[bytes], bool] = lambda _image: True,
        capacity_bytes: int = 65535 * _PACKET_SIZE,
        has_application: bool = True,
        erase_s: float = 0.02,
        answer_s: float = 0.0,
        start_s: float = 0.1,
    ) -> None:
        self._words = WORDINGS[target]
        super().__init__(self._words.to_device, self._words.to_tool)
        self._target = target
        self._script = script or DeviceScript()
        self._image_check = image_check
        self._capacity_bytes = capacity_bytes
        self._erase_s = erase_s
        self._answer_s = answer_s
        self._start_s = start_s
        self.state = "application" if has_application else "off"
        self.old_application_whole = has_application
        self.completed = False
        """True once an image was found whole; it is what `image` holds."""
        self.updates_taken = 0
        self._silent = False
        self._size_bytes = 0
        self._stored = bytearray()
        self._next_number = 0
        self._announced = 0
        self._used: set[tuple[str, int]] = set()
        self._naks_left = dict(self._script.nak)
        self._deaf_left = self._script.deaf_to_updates
        self._end_naks_left = self._script.end_nak
        self._completes_to_lose = self._script.lose_complete
        if not has_application:
            self.alarm(0.0, self._boot)

    @property
    def image(self) -> bytes:
        """The image bytes received so far, without the padding of the last packet."""
        return bytes(self._stored[: self._size_bytes])

    def power_on(self, now: float) -> None:
        """Power up: whatever ran before, the bootloader announces itself (RS-05)."""
        self.hush()
        self._boot(now)

    # -- the application ----------------------------------------------------------------------

    def hear(self, mode: int, command: int, data: bytes, now: float) -> None:
        name = {0x4205: "reset", 0xA10B: "update", 0xA385: "packet", 0xA401: "end"}.get(command)
        if name is None or mode != WRITE:
            self.note("other", now, command)
            if (mode, command, self._target) == (0x11, 0x3300, "bms"):
                self._hear_version_query(now)
            return
        number = int.from_bytes(data[1:3], "little") if name == "packet" else 0
        self.heard(name, now, number)
        if name == "reset":
            self._hear_reset(data, now)
        elif self.state == "application":
            self._answer("feedback", literal(self._words.feedback), now)
        elif name == "update":
            self._hear_update(data, now)
        elif name == "packet":
            self._hear_packet(data, now)
        else:
            self._hear_end(data, now)

    def hear_damaged(self, wire: bytes, now: float) -> None:
        self.note("damaged", now)
        if self.state == "transfer" and wire[4:6] == b"\xa3\x85":
            self._nak(self._next_number, now)

    def _hear_reset(self, data: bytes, now: float) -> None:
        if self.state != "application" or data != b"RESET" or self._script.deaf_to_reset:
            return
        if not self._script.no_feedback:
            self._answer("feedback", literal(self._words.feedback), now)
        self.state = "restarting"
        self.alarm(now + 0.03, self._boot)

    def _hear_version_query(self, now: float) -> None:
        if self.state != "application":
            return
        firmware = b"V1r2r3_20220512." if self.completed else b"V1r2r2_20220401."
        fields = b"BM36.           W2605001.       V1r2r0_20220512." + firmware
        wire = build(_BROADCAST_OF["bms"], REPORT, 0x1540, fields)
        self.say("version", payloads(wire), can_id=_BROADCAST_OF["bms"], not_before=now)

    # -- announcing ---------------------------------------------------------------------------

    def _boot(self, now: float) -> None:
        self.clear_alarms()
        self.state = "announcing"
        self._announced = 0
        self._announce(now)

    def _announce(self, now: float) -> None:
        if self._announced == 4:
            if self.completed or self.old_application_whole:
                self._start_application(now)
                return
            self._announced = 0  # R14: without an application it goes on.
        self._announced += 1
        if self._announced not in self._script.versions_lost:
            self._say_version(now)
        self.alarm(now + 0.05, self._announce)

    def _say_version(self, now: float) -> None:
        frames = literal(self._words.boot_version)
        name, version = b"".join(frames)[6:9], b"V1.2.3"
        if self._script.wrong_name:
            name = b"WMC" if self._target != "wmc" else b"BMS"
        if self._script.bad_version_text is not None:
            version = self._script.bad_version_text
        if self._script.version_changes and self._announced > 1:
            version = b"V1.2.4"
        if self._script.wrong_name or version != b"V1.2.3":
            frames = payloads(build(self.says_id, REPORT, 0xC109, name + version))
        self._answer("version", frames, now)

    def _start_application(self, now: float) -> None:
        self.clear_alarms()
        self.state = "application"
        self.note("application started", now)

    # -- the update command -------------------------------------------------------------------

    def _hear_update(self, data: bytes, now: float) -> None:
        text, size_bytes = struct.unpack("<7sI", data)
        if self._deaf_left:
            self._deaf_left -= 1
            return
        if text != self._words.update_text or not 0 < size_bytes <= self._capacity_bytes:
            self.note("update refused", now)
            return
        same = size_bytes == self._size_bytes
        if self.state == "erasing" and same:
            return
        if self.state == "transfer" and self._next_number == 1 and same:
            self._request(now)
            return
        self.updates_taken += 1
        self.clear_alarms()
        self.hush()
        self.state = "erasing"
        self.completed = self.old_application_whole = False
        self._size_bytes, self._stored = size_bytes, bytearray()
        if not self._script.no_request:
            self.alarm(now + self._erase_s, self._ready)

    def _ready(self, now: float) -> None:
        self.state = "transfer"
        self._next_number = 1
        self._request(now)
        if self._script.request_twice:
            self._request(now)
        if self._script.leftover_version:
            self.alarm(now + 0.02, self._say_version)
        self._silent = self._script.silent_after == 0

    def _request(self, now: float) -> None:
        self._answer("request", literal(self._words.request), now)

    # -- packets ------------------------------------------------------------------------------

    def _hear_packet(self, data: bytes, now: float) -> None:
        start, number, total = struct.unpack_from("<BHH", data)
        if self.state != "transfer" or self._strays_on(number, now):
            return
        if (start, total) != (1, -(-self._size_bytes // _PACKET_SIZE)):
            self._nak(self._next_number, now)
        elif number == self._next_number - 1 and number:
            if self._script.nak_next_on_repeat:
                self._nak(self._next_number, now)
            else:
                self._ack(number, now)
        elif number != self._next_number or number > total:
            self._nak(self._next_number, now)
        else:
            self._stored += data[5:]
            self._next_number += 1
            self._acknowledge_stored(number, now)

    def _strays_on(self, number: int, now: float) -> bool:
        """True when the script has something else in mind for this copy of the packet."""
        script = self._script
        if self._naks_left.get(number, 0):
            self._naks_left[number] -= 1
            self._nak(number, now)
            return True
        if script.restart_at == number and self._first("restart", number):
            self.hush()
            self._boot(now)
            return True
        if script.request_at == number and self._first("request", number):
            self._request(now)
            return True
        if script.complete_at == number and self._first("complete", number):
            self._answer("complete", literal(self._words.complete), now)
            return True
        return False

    def _acknowledge_stored(self, number: int, now: float) -> None:
        """ACK, in the way that the script wants for this packet."""
        script = self._script
        if number in script.stale_ack and number > 1:
            self._ack(number - 1, now)
        if number in script.future_ack:
            self._ack(number + 1, now)
        if number in script.nak_then_ack:
            self._nak(number, now)
        if number not in script.drop_ack:
            self._ack(number, now + script.late_ack.get(number, 0.0))
        if number in script.double_ack:
            self._ack(number, now)
        if number in script.ack_then_nak:
            self._nak(number, now)
        if script.silent_after == number:
            self._silent = True

    def _ack(self, number: int, at: float) -> None:
        literal_1 = literal(self._words.ack_1)
        frames = literal_1 if number == 1 else numbered(self.says_id, _ACK, number)
        self._answer("ack", frames, at, number)

    def _nak(self, number: int, at: float) -> None:
        literal_1 = literal(self._words.nak_1)
        frames = literal_1 if number == 1 else numbered(self.says_id, _NAK, number)
        self._answer("nak", frames, at, number)

    # -- the end ------------------------------------------------------------------------------

    def _hear_end(self, data: bytes, now: float) -> None:
        if self.state == "completed":
            self._complete(now)  # The final answer was lost, or the end doubled.
            return
        if self.state != "transfer":
            return
        total = -(-self._size_bytes // _PACKET_SIZE)
        all_there = data == b"\x04" and self._next_number == total + 1
        if self._end_naks_left or not all_there or not self._image_check(self.image):
            self._end_naks_left = max(0, self._end_naks_left - 1)
            self._nak(self._next_number, now)
            return
        self.state, self.completed = "completed", True
        self._complete(now)
        self.alarm(now + self._start_s, self._start_or_announce)

    def _complete(self, now: float) -> None:
        if self._completes_to_lose:
            self._completes_to_lose -= 1
            self.note("complete lost", now)
            return
        self._answer("complete", literal(self._words.complete), now)

    def _start_or_announce(self, now: float) -> None:
        for index in range(self._script.announce_after_complete):
            self.say("version", literal(self._words.boot_version), not_before=now + 0.05 * index)
        self.alarm(now + 0.05 * self._script.announce_after_complete, self._start_application)

    # -- saying -------------------------------------------------------------------------------

    def _first(self, what: str, number: int) -> bool:
        """True once for each stray."""
        if (what, number) in self._used:
            return False
        self._used.add((what, number))
        return True

    def _answer(self, what: str, frames: list[bytes], at: float, number: int = 0) -> None:
        if self._silent:
            return
        if self._script.foreign_frames:
            self.say_frames("foreign", self._foreign(), not_before=at)
        self.say(what, frames, not_before=at + self._answer_s, number=number)

    def _foreign(self) -> list[Frame]:
        """Traffic of others: other kinds of frames on the own id, messages on other ids."""
        tail = b"\xf0" * 8
        return [
            Frame(self.says_id, b"\x55\xaa" + bytes(6), is_extended=True),
            Frame(self.says_id, b"", is_remote=True),
            Frame(self.says_id, tail, is_error=True),
            Frame(self.says_id, b""),
            *(Frame(0x720, payload) for payload in literal("55AA0C0612040480 01013A143A12F0")),
            *(Frame(0x712, payload) for payload in literal("55AA110322010001 295122F0")),
            Frame(self.hears_id ^ 0x070, tail),
        ]
