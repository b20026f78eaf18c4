"""Contents of messages in words and as JSON, for the commands that show them. What a field's value
looks like is told by `flasher.trace.decoder`, the same for a query's answer and for live traffic.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from flasher.cli.documents import FieldValue
from flasher.host.items import meaningful_fields
from flasher.protocol.fields import Content
from flasher.trace.decoder import content_fields

_LABEL_WIDTH: Final = 33


def content_rows(content: Content) -> Iterator[tuple[str, str]]:
    """Label and value with unit of every field, safe to show."""
    for shown in content_fields(content):
        yield shown.label, f"{shown.text} {shown.unit}".rstrip()


def row_line(label: str, value: str) -> str:
    """One line of a table of two columns."""
    return f"  {label:<{_LABEL_WIDTH}} {value}".rstrip()


def content_lines(content: Content) -> list[str]:
    """The fields of a content, one a line."""
    return [row_line(label, value) for label, value in content_rows(content)]


def content_document(content: Content) -> dict[str, FieldValue]:
    """A content as JSON: field names with their units, texts escaped, bytes in hexadecimal, flags
    by name; null for a state of health that an older device does not know. Reserved bytes are
    left out, so that the keys do not depend on the answer.
    """
    names = {name for name, _ in meaningful_fields(type(content))}
    return {shown.name: shown.value for shown in content_fields(content) if shown.name in names}
