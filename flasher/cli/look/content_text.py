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


def content_rows(content: Content, field: str = "") -> Iterator[tuple[str, str]]:
    """Label and value with unit of every field, or of one by its name, safe to show."""
    for shown in content_fields(content):
        if field in ("", shown.name):
            yield shown.label, f"{shown.text} {shown.unit}".rstrip()


def row_line(label: str, value: str, width: int = _LABEL_WIDTH) -> str:
    """One line of a table of two columns."""
    return f"  {label:<{width}} {value}".rstrip()


def content_lines(content: Content, field: str = "") -> list[str]:
    """The fields of a content, or one of them, one a line."""
    rows = list(content_rows(content, field))
    width = max([_LABEL_WIDTH, *(len(label) for label, _ in rows)])
    return [row_line(label, value, width) for label, value in rows]


def content_document(content: Content) -> dict[str, FieldValue]:
    """A content as JSON: field names with their units, texts escaped, bytes in hexadecimal, flags
    by name. Reserved bytes are left out, so that the keys do not depend on the answer.
    """
    names = {name for name, _ in meaningful_fields(type(content))}
    return {shown.name: shown.value for shown in content_fields(content) if shown.name in names}
