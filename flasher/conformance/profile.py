"""Conformance profile: documented choices, limits and deviations of a product.

A profile is a TOML file; every key has a default, and may carry a rationale:

    tx_02 = "nak_next"
    tx_12 = { value = "waits", rationale = "the transfer may be paused by the charger" }
    [limits]
    erase_s = 2.5
    [device]
    largest_image_bytes = 0x1C000
    [deviations]
    "TX-03" = "an older packet restarts the transfer; fixed in V1.1.0"
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, model_validator

from flasher.conformance.profile_time import ProfileTime
from flasher.conformance.wire import IMAGE_BYTES_MAX, RESET, RESET_TEXT
from flasher.errors import Fault, did_you_mean, printable
from flasher.files import read_toml
from flasher.settings.toml_reader import Key, Reader, TomlTable
from flasher.validation import NumberRange, Parsed

DEVIATIONS: Final = "deviations"
_TABLES: Final = ("limits", "device")
_CASE_ID: Final = re.compile(r"[A-Z]{2}-\d\d")
_TEXT_MAX: Final = 253
Value = str | int | float


def _ascii(value: object) -> str:
    if not isinstance(value, str) or not value.isascii() or len(value) > _TEXT_MAX:
        raise TypeError
    return value


def _check_deviations(deviations: dict[str, str]) -> dict[str, str]:
    for case_id, reason in deviations.items():
        if not _CASE_ID.fullmatch(case_id):
            raise ValueError(
                f'{case_id!a:.60} is not a case; write the id of a case and a reason, as "TX-03" = '
                '"why"'
            )
        if not reason.strip():
            raise ValueError(
                f"{case_id} has no reason; write a text that explains why the product differs"
            )
    return deviations


Limit = Annotated[float, NumberRange(ge=0, le=3600)]
Ascii = Annotated[str, Parsed("a text in ASCII", _ascii)]


class Limits(TomlTable):
    """Times; the defaults are this project's readings of the document."""

    feedback_s: Limit = 1.0
    """From reset to general feedback."""
    first_version_s: Limit = 5.0
    """From reset or power-up to the first boot version (R12)."""
    version_spacing_s: Limit = 0.05
    """Between two boot versions."""
    version_spacing_tolerance_s: Limit = 0.01
    """How far that spacing may be off."""
    window_s: Limit = 0.05
    """From the burst's last boot version to the window's end (UP-04); with up_04 either it lasts at
    least this long, and at most 1 s.
    """
    window_tolerance_s: Limit = 0.002
    """How far the window's end may be off."""
    start_s: Limit = 5.0
    """From the window's end, or complete, to an application that answers."""
    erase_s: Limit = 10.0
    """From the update command to request transfer (R12)."""
    ack_s: Limit = 0.5
    """From a packet to its ACK or NAK (R12)."""
    complete_s: Limit = 10.0
    """From end of transfer to the final answer (R12)."""
    inter_frame_s: Limit = 0.1
    """Between two frames of one message (R12)."""
    pause_s: Limit = 5.0
    """The pause in a transfer that tx_12 is about."""
    refused_s: Limit = 2.0
    """From a refused image to the next boot version."""
    silence_s: Limit = 0.7
    """How long the bus must be quiet to count as silent."""


class DeviceFacts(TomlTable):
    """Sizes and words of the product."""

    application_bytes: Annotated[int, NumberRange(ge=1, le=0xFFFF_FFFF)] = IMAGE_BYTES_MAX
    """Size of the application area."""
    largest_image_bytes: Annotated[int, NumberRange(ge=1, le=IMAGE_BYTES_MAX)] = IMAGE_BYTES_MAX
    """The largest image that the device accepts."""
    application_address: Annotated[int, NumberRange(ge=0, le=0xFFFF_FFFF)] = 0
    """Start of the application area in the memory that a BMS reports (4308), to compare the flash
    on a bench without readback; 0: unknown.
    """
    reset_command: Annotated[int, NumberRange(ge=0, le=0xFFFF)] = RESET
    """Command that restarts into the bootloader (R3)."""
    reset_data: Ascii = RESET_TEXT.decode()
    """Data of that command."""
    versions: Annotated[int, NumberRange(ge=1, le=100)] = 4
    """Boot versions in a burst."""
    buffer_bytes: Annotated[int, NumberRange(ge=0, le=IMAGE_BYTES_MAX)] = 0
    """Acknowledged bytes that may not be written to flash until the end of transfer."""

    @model_validator(mode="after")
    def _check_together(self) -> DeviceFacts:
        if self.largest_image_bytes > self.application_bytes:
            raise ValueError("largest_image_bytes is more than device.application_bytes holds")
        if len(self.reset_data) != self.reset_command & 0xFF:
            raise ValueError(
                "reset_data must have as many bytes as the second byte of reset_command says"
            )
        return self


class ProfileKeys(TomlTable):
    """Keys of a profile file without rationales. Keys named after a case (`tx_02`) are choices."""

    fr_01: Literal["either", "accepted", "rejected"] = "either"
    """A message in CAN frames of 1 to 7 bytes (other than 8 and a rest)."""
    fr_02: Literal["either", "found", "lost"] = "either"
    """Junk in the same CAN frame before a message: the message is found, or lost."""
    fr_04: Literal["either", "rescanned", "dropped"] = "either"
    """Bytes after a wrong tail in the same CAN frame are scanned again, or dropped."""
    fr_07: Literal["either", "ignored", "rejected"] = "either"
    """A last CAN frame padded to 8 bytes."""
    fr_10: Literal["either", "silence"] = "either"
    """General feedback of the bootloader to writes (2.2.1 (2), R15); silence: it sends none."""
    rs_02: Literal["either", "ignored", "restarts"] = "either"
    """Reset that reaches the announcing bootloader (R18)."""
    rs_03: Literal["either", "announces", "listens"] = "either"
    """After the burst, without an application: keeps announcing, or listens silently (R14)."""
    rs_03_old: Literal["either", "erased", "kept"] = "either"
    """The old application after a transfer that was broken off or refused: erased, or kept until
    complete, as with two banks.
    """
    up_02: Literal["either", "silence", "nak"] = "either"
    """Answer to an update command that is rejected."""
    up_03: Literal["either", "feedback", "silence"] = "either"
    """Answer of the running application to upgrade messages (R17)."""
    up_04: Literal["either", "rejected", "accepted"] = "either"
    """Update command just after the window's end; either: its end is unknown."""
    up_04_burst: Literal["either", "accepted", "rejected"] = "either"
    """Update command between the announcements of a burst, not after the last one (R2)."""
    up_05: Literal["either", "once", "each"] = "either"
    """Update command twice before request transfer: one of these, or one for each (R25)."""
    up_08: Literal["either", "starts_over", "rejected"] = "either"
    """Update command in the middle of a transfer."""
    tx_01: Literal["either", "nak_expected", "nak_received", "silence"] = "either"
    """Answer to a damaged or impossible packet: NAK with the number expected, NAK with the number
    received, or nothing; either: may differ from packet to packet.
    """
    tx_01_lost_frame: Literal["either", "nak", "silence"] = "either"
    """Answer to a packet with a lost frame."""
    tx_02: Literal["either", "ack", "nak_next"] = "either"
    """The packet stored last, again: ACK n, or NAK n+1 (R10)."""
    tx_03: Literal["either", "ack", "nak", "silence"] = "either"
    """A packet older than the last one stored."""
    tx_08: Literal["either", "ignored", "rejected"] = "either"
    """Last packet: other bytes than FF beyond the size."""
    tx_12: Literal["either", "announces", "waits"] = "either"
    """A pause in the transfer longer than limits.pause_s: announces again, or keeps waiting."""
    tx_13: Literal["either", "ignored", "restarts"] = "either"
    """Reset during a transfer."""
    en_02: Literal["either", "same_answer", "silence"] = "either"
    """End of transfer again, once answered."""
    en_03: Literal["either", "starts", "restarts"] = "either"
    """After complete: starts the application directly, or through the bootloader (R11)."""
    en_04: Literal["none", "crc32"] = "none"
    """Checksum inside the product's images; crc32: the last four bytes are the CRC-32 of the rest,
    little-endian (R7).
    """
    tm_02: Literal["accepted", "either"] = "accepted"
    """Frames of a message up to limits.inter_frame_s apart."""
    limits: Limits = Limits()
    device: DeviceFacts = DeviceFacts()
    deviations: Annotated[dict[str, str], AfterValidator(_check_deviations)] = Field(
        default_factory=dict
    )
    """Cases in which the product differs, with the reason."""


_READER: Final = Reader(ProfileKeys, "profile")


def profile_keys() -> dict[str, Key]:
    """Every key by its path (`tx_02`, `limits.erase_s`)."""
    return {path: key for path, key in _READER.keys.items() if path != DEVIATIONS}


def unstated() -> str:
    """What holds for a choice that a profile does not state, for people."""
    others = {
        path: key.default
        for path, key in profile_keys().items()
        if key.choices and key.default != "either"
    }
    named = " and ".join(f"{path} is {value}" for path, value in others.items())
    return (
        "A choice that the profile does not state is either: each behaviour listed for it is "
        f"right, and may change from time to time. Only {named}."
    )


def choice_words(name: str) -> list[str]:
    """Values of a choice besides `either`."""
    return [word for word in profile_keys()[name].choices if word != "either"]


@dataclass(frozen=True)
class ConformanceProfile:
    """Values that differ from the defaults, by path (`tx_02`, `limits.erase_s`), with rationales.

    `deviations` maps case ids to reasons. Raises UsageError listing all errors.
    """

    given: Mapping[str, Value] = field(default_factory=dict)
    rationales: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[str, str] = field(default_factory=dict)
    source: str = "defaults"

    def __post_init__(self) -> None:
        document: dict[str, Any] = {DEVIATIONS: dict(self.deviations)}
        for path, value in self.given.items():
            table, _, name = path.rpartition(".")
            (document.setdefault(table, {}) if table else document)[name] = value
        _READER.read(document, self.source)

    def choice(self, name: str) -> str:
        """The choice `name` ("tx_02"). Raises KeyError for an unknown one."""
        return str(self.value(name))

    def allows(self, name: str, word: str) -> bool:
        """True when the choice `name` is `word` or "either"."""
        return self.choice(name) in (word, "either")

    def limit(self, name: str) -> float:
        """Time `name` of the table `limits` ("erase_s"), in seconds; a `ProfileTime`."""
        path = f"limits.{name}"
        value_s = float(self.value(path))
        return ProfileTime(value_s, {path: value_s})

    def number(self, name: str) -> int:
        """Number `name` of the table `device` ("largest_image_bytes")."""
        return int(self.value(f"device.{name}"))

    def text(self, name: str) -> str:
        """Text `name` of the table `device` ("reset_data")."""
        return str(self.value(f"device.{name}"))

    def value(self, path: str) -> Value:
        """Value of any key by its path. Raises KeyError."""
        value: Value = self.given.get(path, _READER.keys[path].default)
        return value

    def to_toml(self, remarks: Mapping[str, str] = MappingProxyType({})) -> str:
        """The whole profile as a TOML file with the help of every key; defaults are comments.
        `remarks` explain why keys stay open.
        """
        lines = [f"# {unstated()}", ""]
        table = ""
        for path, key in profile_keys().items():
            its_table, _, name = path.rpartition(".")
            if its_table != table:
                table = its_table
                lines += ["", f"[{table}]"]
            lines.append(f"# {key.text} ({key.allowed})")
            if path in remarks:
                lines.append(f"# open: {printable(remarks[path])}")
            lines.append(self._line(path, name))
        lines += ["", f"[{DEVIATIONS}]", '# "TX-03" = "why the product differs here"']
        lines += [f"{_quoted(name)} = {_quoted(why)}" for name, why in self.deviations.items()]
        return "\n".join(lines) + "\n"

    def _line(self, path: str, name: str) -> str:
        value = self.value(path)
        shown = _quoted(value) if isinstance(value, str) else value_text(path, value)
        why = self.rationales.get(path)
        if why is not None:
            shown = f"{{ value = {shown}, rationale = {_quoted(why)} }}"
        return f"{'' if path in self.given else '# '}{name} = {shown}"


def value_text(path: str, value: Value) -> str:
    """The value of a key for people; commands and addresses in hexadecimal."""
    is_hexadecimal = path.endswith(("_command", "_address")) and isinstance(value, int)
    return f"0x{value:04X}" if is_hexadecimal else str(value)


def load_profile(path: str | os.PathLike[str]) -> ConformanceProfile:
    """Read a profile file. Raises UsageError listing all errors."""
    return read_profile(read_toml(path, what="profile"), os.fspath(path))


def read_profile(document: Mapping[str, Any], source: str) -> ConformanceProfile:
    """Convert parsed TOML to a profile. Raises UsageError."""
    plain: dict[str, Any] = {}
    rationales: dict[str, str] = {}
    faults: list[Fault] = []

    def without_rationale(path: str, content: Any) -> Any:
        if not isinstance(content, dict) or path not in _READER.keys:
            return content
        why = content.get("rationale", "")
        if set(content) - {"value", "rationale"} or "value" not in content:
            remedy = f'Write {path.rpartition(".")[2]} = {{ value = ..., rationale = "why" }}.'
            text = f"{path} must be a value, or a table of value and rationale."
            faults.append(Fault(path, text, remedy))
            return _READER.keys[path].default
        if not isinstance(why, str):
            faults.append(Fault(f"{path}.rationale", f"The rationale of {path} must be a text."))
        elif why:
            rationales[path] = why
        return content["value"]

    for name, content in document.items():
        if name in _TABLES and isinstance(content, dict):
            plain[name] = {
                key: without_rationale(f"{name}.{key}", value) for key, value in content.items()
            }
        elif name != DEVIATIONS:
            plain[name] = without_rationale(name, content)
        else:
            plain[name] = content
    faults += _READER.check(plain)[1]
    if faults:
        raise _READER.refusal(source, faults)
    given = {name: value for name, value in plain.items() if not isinstance(value, dict)}
    for table in _TABLES:
        given |= {f"{table}.{name}": value for name, value in plain.get(table, {}).items()}
    return ConformanceProfile(given, rationales, plain.get(DEVIATIONS, {}), printable(source))


def check_deviations(profile: ConformanceProfile, known: Collection[str]) -> None:
    """Raise UsageError for a deviation of an unknown case."""
    faults = [
        Fault(
            f"{DEVIATIONS}.{case_id}",
            f"[{DEVIATIONS}] names {case_id}, which is not a case of the suite.",
            did_you_mean(case_id, known).rstrip(),
        )
        for case_id in profile.deviations
        if case_id not in known
    ]
    if faults:
        raise _READER.refusal(profile.source, faults)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
