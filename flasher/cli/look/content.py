"""Texts and JSON of message contents, and of a node's traffic.

Both query answers and live traffic are formatted by `flasher.trace.decoder`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from flasher.cli.documents import HeardDocument, content_document, document_of
from flasher.cli.output import counted
from flasher.cli.terminal import columns
from flasher.host.survey import NodeTraffic
from flasher.protocol.fields import Content
from flasher.trace.decoder import NOT_IN_DIALECT, content_fields

LABEL_WIDTH: Final = 33
"""Minimum width of labels, so that the values of several tables are aligned."""
_SHOWN_AT_MOST: Final = 40
"""Maximum number of listed messages: a babbling node must not fill the screen."""


def rows_lines(rows: list[tuple[str, str]]) -> list[str]:
    """Format labels with their values."""
    return columns(rows, indent=2, first=LABEL_WIDTH)


def content_rows(content: Content, field: str = "") -> Iterator[tuple[str, str]]:
    """Yield label and value of every field, or of one by its name, escaped for a terminal."""
    for shown in content_fields(content):
        if field in ("", shown.name):
            yield shown.label, f"{shown.text} {shown.unit}".rstrip()


def content_lines(content: Content, field: str = "") -> list[str]:
    """Format the fields of a content, or one of them, one per line."""
    return rows_lines(list(content_rows(content, field)))


def heard_lines(heard: NodeTraffic, *, contents: bool = False) -> list[str]:
    """Format the traffic of a node, one line per kind of message, or with its last content."""
    rows = [("bootloader", heard.boot_version)] if heard.boot_version else []
    for title, times in sorted(heard.messages.items())[:_SHOWN_AT_MOST]:
        mark = f" {NOT_IN_DIALECT}" if title in heard.not_in_dialect else ""
        rows.append((title, (f"{times} times" if times > 1 else "once") + mark))
        if contents and title in heard.last:
            rows += [(f"  {label}", value) for label, value in content_rows(heard.last[title])]
    left_out = len(heard.messages) - _SHOWN_AT_MOST
    if left_out > 0:
        rows.append((f"and {counted(left_out, 'kind')} of message more", ""))
    if heard.damaged:
        rows.append(("bytes outside any message", f"{heard.damaged} times"))
    return rows_lines(rows or [(f"{counted(heard.frames, 'frame')} that made no message", "")])


def heard_document(heard: NodeTraffic) -> HeardDocument:
    return document_of(
        HeardDocument,
        heard,
        messages=dict(sorted(heard.messages.items())),
        last={title: content_document(content) for title, content in heard.last.items()},
        boot_version=heard.boot_version or None,
        not_in_dialect=sorted(heard.not_in_dialect),
    )
