"""Documents of `--json`: registry of their types, and types that several of them contain.

A type that a command prints is printed as it is, or with the keys of
`flasher.validation.json_keys`. Only a view that differs from it is a document, a frozen dataclass
of the command's module. Each module lists the types that it prints as `DOCUMENTS`, and those of
lines before the document as `LINES`. `flasher.cli.output` puts them into the `Envelope`,
`tests.schema` makes a JSON Schema of them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from flasher.documents import as_json
from flasher.errors import ErrorCode, ExitCode, Fault
from flasher.events import QueryAnswered
from flasher.image.cortexm import VectorTable
from flasher.image.image import AddressSpan
from flasher.protocol.fields import Content

Kind = TypeVar("Kind")
FieldValue = str | int | list[int] | list[str] | None
"""Value of a message field: bytes are in hexadecimal, flags are a list of names."""


def document_of(kind: type[Kind], source: object, /, **others: Any) -> Kind:
    """Build a document from the attributes of `source` with the same names, and `others`."""
    names = {each.name for each in dataclasses.fields(cast("Any", kind))} - others.keys()
    return kind(**{name: getattr(source, name) for name in names}, **others)


def content_document(content: Content) -> dict[str, FieldValue]:
    """Convert message data to JSON: field names with units, texts escaped, bytes in hexadecimal,
    flags by name. Reserved bytes are omitted, so that the keys never vary.
    """
    from flasher.host.items import meaningful_fields  # noqa: PLC0415  rarely needed
    from flasher.trace.decoder import content_fields  # noqa: PLC0415

    names = {name for name, _ in meaningful_fields(type(content))}
    return {shown.name: shown.value for shown in content_fields(content) if shown.name in names}


def to_json(event: object) -> dict[str, Any]:
    """Convert an event of flasher.events to JSON: its class name as `event`, and its fields."""
    name = type(event).__name__
    if isinstance(event, QueryAnswered):
        event = dataclasses.replace(event, content=content_document(cast("Content", event.content)))
    return {"event": name, **as_json(event)}


# -- around every document -------------------------------------------------------------------------


@dataclass(frozen=True)
class Envelope:
    """Envelope of a command's document, the last line; earlier lines have `schema` and `event`."""

    schema: int
    """Version of this schema."""
    command: str | None
    """Name of the command; null without one."""
    ok: bool
    """True if the exit code is 0."""
    exit_code: ExitCode


@dataclass(frozen=True)
class ErrorDocument:
    """Error of a command. Texts may be empty, except for `kind` and `what`."""

    kind: str
    """Name of the class in flasher.errors; FlasherError for a bug in flasher."""
    code: ErrorCode
    """Error code; `flasher help CODE` explains it."""
    what: str
    where: str
    cause: str
    remedy: str
    command: str
    """Command that repairs the device."""
    faults: tuple[Fault, ...]
    """All problems of a file."""


# -- images and plans ------------------------------------------------------------------------------


@dataclass(frozen=True)
class ImageDocument:
    """Contents of an image file, and the bytes to be sent."""

    source: str
    format: str
    size_bytes: int
    base: int | None
    """Address of the first byte; null for a raw binary without --base."""
    segments: tuple[AddressSpan, ...]
    filled_bytes: int
    version: str | None
    """Firmware version inside the image."""
    named_targets: list[str]
    """Targets named inside the image."""
    sha256: str
    """SHA-256 of the bytes to be sent, in hexadecimal."""
    vector_table: VectorTable | None


@dataclass(frozen=True)
class PlanDocument:
    """Target and bytes of an upgrade, and its time on the bus."""

    target: str
    request_id: int
    answer_id: int
    bitrate_bps: int
    packets: int
    frames: int
    bytes_on_wire: int
    wire_s: float
    gaps_s: float
    """Silence between frames and before packets, in addition to `wire_s`."""


# -- surveys ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class HeardDocument:
    """Traffic received from one node."""

    frames: int
    messages: dict[str, int]
    """Number of messages by title."""
    last: dict[str, dict[str, FieldValue]]
    """Fields of the latest message by title."""
    damaged: int
    """Number of damaged stretches of bytes."""
    boot_version: str | None
    not_in_dialect: list[str]
    """Titles of messages that the dialect lacks."""
