"""Every key of a conformance profile, once: its table, default, allowed values and help.

Keys named after a case (`tx_02`) are the choices that the catalogue marks P. The tables `limits`
and `device` hold times and sizes. The defaults are this project's readings of the document.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.conformance.wire import IMAGE_BYTES_MAX, RESET, RESET_TEXT

CHOICES: Final = ""
"""The table of the choices: the file's first lines, without a heading."""
LIMITS: Final = "limits"
DEVICE: Final = "device"
_HOUR_S: Final = 3600.0


@dataclass(frozen=True)
class Key:
    """One key: a text out of `values`, or a number from `low` to `high`, or a text in ASCII.

    A number is a whole one when its default is.
    """

    name: str
    default: str | int | float
    text: str
    table: str = CHOICES
    values: tuple[str, ...] = ()
    low: float = 0
    high: float = _HOUR_S

    @property
    def path(self) -> str:
        """The key with its table, as `limits.ack_s`."""
        return f"{self.table}.{self.name}" if self.table else self.name

    @property
    def allowed(self) -> str:
        """The allowed values in words."""
        if self.values:
            return ", ".join(self.values)
        if isinstance(self.default, str):
            return "a text in ASCII"
        what = "a whole number" if isinstance(self.default, int) else "seconds"
        return f"{what} from {self.low:g} to {int(self.high)}"

    def accepts(self, value: object) -> bool:
        """True for an allowed value."""
        if self.values:
            return value in self.values
        if isinstance(self.default, str):
            return isinstance(value, str) and value.isascii() and len(value) <= 253
        if isinstance(value, bool) or not isinstance(value, int | float):
            return False
        is_right_kind = isinstance(value, int) or isinstance(self.default, float)
        return is_right_kind and self.low <= value <= self.high


def _choice(name: str, text: str, *values: str) -> Key:
    return Key(name, values[0], text, values=values)


def _limit(name: str, default: float, text: str) -> Key:
    return Key(name, default, text, LIMITS)


def _size(name: str, default: int, text: str, low: int, high: int) -> Key:
    return Key(name, default, text, DEVICE, low=low, high=high)


_BAD_PACKET: Final = ("nak_expected", "nak_received", "silence", "either")
KEYS: Final = (
    _choice(
        "fr_01",
        "a message in CAN frames of 1 to 7 bytes (other than 8 and a rest)",
        "accepted",
        "rejected",
        "either",
    ),
    _choice(
        "fr_02",
        "junk in the same CAN frame before a message: the message is found, or lost",
        "found",
        "lost",
        "either",
    ),
    _choice(
        "fr_04",
        "what follows a wrong tail in the same CAN frame is looked at again, or dropped",
        "rescanned",
        "dropped",
        "either",
    ),
    _choice("fr_07", "a last CAN frame padded to 8 bytes", "ignored", "rejected", "either"),
    _choice("rs_02", "reset that reaches the announcing bootloader (R18)", "ignored", "restarts"),
    _choice(
        "rs_03",
        "after the burst, with no application to start: announces on, or listens silently (R14)",
        "announces",
        "listens",
    ),
    _choice(
        "up_02",
        "answer to an update command that is rejected",
        "silence",
        "nak",
        "either",
    ),
    _choice(
        "up_03",
        "answer of the running application to upgrade messages (R17)",
        "either",
        "feedback",
        "silence",
    ),
    _choice(
        "up_04",
        "update command just after the window's end",
        "rejected",
        "accepted",
        "either",
    ),
    _choice(
        "up_04_burst",
        "update command between the announcements of a burst, not behind the last one (R2)",
        "accepted",
        "rejected",
        "either",
    ),
    _choice("up_08", "update command in the middle of a transfer", "starts_over", "rejected"),
    _choice(
        "tx_01",
        "answer to a damaged or impossible packet: NAK with the number wanted, NAK with the number "
        "it names, or nothing; either: one or the other, packet by packet",
        *_BAD_PACKET,
    ),
    _choice(
        "tx_01_lost_frame",
        "answer to a packet of which a frame is lost",
        "either",
        "nak",
        "silence",
    ),
    _choice("tx_02", "the packet stored last, again: ACK n, or NAK n+1 (R10)", "ack", "nak_next"),
    _choice("tx_03", "a packet older than the last one stored", "ack", "nak", "silence"),
    _choice("tx_08", "last packet: other bytes than FF beyond the size", "ignored", "rejected"),
    _choice(
        "tx_12",
        "a pause in the transfer longer than limits.pause_s: announces again, or waits on",
        "announces",
        "waits",
    ),
    _choice("tx_13", "reset during a transfer", "ignored", "restarts"),
    _choice("en_02", "end of transfer again, once answered", "same_answer", "silence", "either"),
    _choice(
        "en_03",
        "after complete: starts the application at once, or through the bootloader (R11)",
        "starts",
        "restarts",
    ),
    _choice(
        "en_04",
        "checksum inside the product's images; crc32: the last four bytes are the CRC-32 of the "
        "rest, little-endian (R7)",
        "none",
        "crc32",
    ),
    _choice("tm_02", "frames of a message up to limits.inter_frame_s apart", "accepted", "either"),
    _limit("feedback_s", 1.0, "from reset to general feedback"),
    _limit("first_version_s", 5.0, "from reset or power-up to the first boot version (R12)"),
    _limit("version_spacing_s", 0.05, "between two boot versions"),
    _limit("version_spacing_tolerance_s", 0.01, "how far that spacing may be off"),
    _limit("window_s", 0.198, "from the burst's last boot version to the window's end (UP-04)"),
    _limit("window_tolerance_s", 0.002, "how far the window's end may be off"),
    _limit("start_s", 5.0, "from the window's end, or complete, to an application that answers"),
    _limit("erase_s", 10.0, "from the update command to request transfer (R12)"),
    _limit("ack_s", 0.5, "from a packet to its ACK or NAK (R12)"),
    _limit("complete_s", 10.0, "from end of transfer to the final answer (R12)"),
    _limit("inter_frame_s", 0.1, "between two frames of one message (R12)"),
    _limit("pause_s", 5.0, "the pause in a transfer that tx_12 is about"),
    _limit("refused_s", 2.0, "from a refused image to the next boot version"),
    _limit("silence_s", 0.7, "how long the bus is watched before it counts as silent"),
    _size(
        "application_bytes",
        IMAGE_BYTES_MAX,
        "size of the application area",
        1,
        0xFFFF_FFFF,
    ),
    _size(
        "largest_image_bytes",
        IMAGE_BYTES_MAX,
        "the largest image that is taken",
        1,
        IMAGE_BYTES_MAX,
    ),
    _size("reset_command", RESET, "command that restarts into the bootloader (R3)", 0, 0xFFFF),
    Key("reset_data", RESET_TEXT.decode(), "data of that command", DEVICE),
    _size("versions", 4, "boot versions in a burst", 1, 100),
    _size(
        "buffer_bytes",
        0,
        "what it has acknowledged and may not have written yet, until the end of transfer",
        0,
        IMAGE_BYTES_MAX,
    ),
)
BY_PATH: Final = {key.path: key for key in KEYS}
