"""What `--json` prints, as types: the parts that commands share, and events as JSON.

A command's own documents are TypedDicts of its module, listed there as `DOCUMENTS` (and as `LINES`
what it prints meanwhile). `flasher.cli.output` puts them into the `Envelope`, `flasher.cli.schema`
makes a JSON Schema of all of it. A class behind the type in `Annotated` says more than the type: an
enumeration stands for its names in lower case, a dataclass for its fields.
"""

from __future__ import annotations

import dataclasses
from datetime import datetime
from enum import Enum, IntEnum
from typing import Annotated, Any, Final, TypedDict

from flasher.errors import ExitCode
from flasher.events import Phase
from flasher.host.outcome import DeviceLeft, Statistics
from flasher.host.table import Ending
from flasher.host.verify import Level, Verdict
from flasher.protocol.fields import Content

SCHEMA_VERSION: Final = 1
"""Counts up when a field of any document changes its meaning or goes away; not for a new one."""

FieldValue = str | int | list[int] | list[str] | None
"""A value of a message: bytes are in hexadecimal, flags are a list of names."""


# -- around every document -------------------------------------------------------------------------


class LineEnvelope(TypedDict):
    """What every line has. Those before the document have the key `event` too."""

    schema: int
    """Version of this schema."""


class Envelope(LineEnvelope):
    """What the document of a command has, which is the last line."""

    command: str | None
    """The command that ran; null when none was named."""
    ok: bool
    """True when the exit code is 0."""
    exit_code: Annotated[int, ExitCode]


class ErrorDocument(TypedDict):
    """What went wrong. Texts may be empty, but for `kind` and `what`."""

    kind: str
    """Name of the class in flasher.errors; FlasherError for a bug in flasher."""
    what: str
    where: str
    cause: str
    remedy: str
    command: str
    """The command that repairs what was left."""


# -- images and plans ------------------------------------------------------------------------------


class SegmentDocument(TypedDict):
    """A run of bytes of the file."""

    start: int
    size_bytes: int


class VectorTableDocument(TypedDict):
    """The first two words of the image, and what speaks against a Cortex-M application."""

    stack_pointer: int
    reset_vector: int
    plausible: bool
    problems: list[str]
    notes: list[str]


class ImageDocument(TypedDict):
    """What is in the file, and of it the bytes to be sent."""

    source: str
    format: str
    size_bytes: int
    base: int | None
    """Address of the first byte; null for a raw binary without --base."""
    segments: list[SegmentDocument]
    filled_bytes: int
    version: str | None
    """The firmware version found inside."""
    named_targets: list[str]
    """The targets that texts inside name."""
    sha256: str
    """Of the bytes to be sent, in hexadecimal."""
    vector_table: VectorTableDocument | None


class PlanDocument(TypedDict):
    """What would be sent to whom, and how long that takes on the bus."""

    target: str
    request_id: int
    answer_id: int
    bitrate_bps: int
    packets: int
    frames: int
    bytes_on_wire: int
    wire_s: float
    gaps_s: float
    """Silence between frames and before packets, on top of `wire_s`."""


# -- upgrades --------------------------------------------------------------------------------------


class OutcomeDocument(TypedDict):
    """How an upgrade ended."""

    ending: Annotated[str, Ending]
    phase: Annotated[str, Phase]
    packet: int | None
    device_left: Annotated[str, DeviceLeft]
    boot_version: str | None
    running_version: str | None
    detail: str
    statistics: Annotated[dict[str, Any], Statistics]


class VerificationDocument(TypedDict):
    """What the verification after an upgrade found."""

    level: Annotated[str, Level]
    verdict: Annotated[str, Verdict]
    running_version: str | None
    detail: str


# -- surveys ---------------------------------------------------------------------------------------


class HeardDocument(TypedDict):
    """What was heard of one node."""

    frames: int
    messages: dict[str, int]
    """How often each kind of message came."""
    last: dict[str, dict[str, FieldValue]]
    """The fields of the latest message of each kind."""
    damaged: int
    """How often bytes came that made no message."""
    boot_version: str | None
    not_in_dialect: list[str]
    """Kinds of message that the document of --dialect does not have."""


# -- events ----------------------------------------------------------------------------------------


def to_json(event: object) -> dict[str, Any]:
    """An event of flasher.events as JSON: the name of its class as `event`, and its fields.

    Raises TypeError for what is no dataclass.
    """
    return {"event": type(event).__name__, **_fields(event)}


def content_document(content: Content) -> dict[str, FieldValue]:
    """A content as JSON: field names with their units, texts escaped, bytes in hexadecimal, flags
    by name. Reserved bytes are left out, so that the keys do not depend on the answer.
    """
    from flasher.host.items import meaningful_fields  # noqa: PLC0415  rarely needed
    from flasher.trace.decoder import content_fields  # noqa: PLC0415

    names = {name for name, _ in meaningful_fields(type(content))}
    return {shown.name: shown.value for shown in content_fields(content) if shown.name in names}


def _fields(value: Any) -> dict[str, Any]:
    return {
        field.name: plain_value(getattr(value, field.name)) for field in dataclasses.fields(value)
    }


def plain_value(value: Any) -> Any:
    """A value as JSON holds it: enumerations by name in lower case, bytes in hexadecimal."""
    match value:
        case IntEnum():
            return int(value)
        case Enum():
            return value.name.lower()
        case bytes():
            return value.hex()
        case datetime():
            return value.isoformat()
        case Content():
            return content_document(value)
        case dict():
            return {str(key): plain_value(each) for key, each in value.items()}
        case tuple() | list():
            return [plain_value(each) for each in value]
        case _ if dataclasses.is_dataclass(value):
            return _fields(value)
        case _:
            return value
