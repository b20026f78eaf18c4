"""What was heard of the nodes on a bus, in words and as JSON."""

from __future__ import annotations

from typing import Final

from flasher.cli.documents import HeardDocument
from flasher.cli.look.content_text import content_document, content_rows, row_line
from flasher.cli.output import counted
from flasher.host.survey import Heard
from flasher.trace.decoder import NOT_IN_DIALECT

_SHOWN_AT_MOST: Final = 40
"""Kinds of message listed: a babbling node must not fill the screen."""


def heard_lines(heard: Heard, *, contents: bool = False) -> list[str]:
    """What one node sent, one kind of message a line, with its last content on request."""
    lines = []
    if heard.boot_version:
        lines.append(row_line("bootloader", heard.boot_version))
    for title, times in sorted(heard.messages.items())[:_SHOWN_AT_MOST]:
        mark = f" {NOT_IN_DIALECT}" if title in heard.not_in_dialect else ""
        lines.append(row_line(title, (f"{times} times" if times > 1 else "once") + mark))
        if contents and title in heard.last:
            lines += ["  " + row_line(*row) for row in content_rows(heard.last[title])]
    left_out = len(heard.messages) - _SHOWN_AT_MOST
    if left_out > 0:
        lines.append(f"  and {counted(left_out, 'kind')} of message more")
    if heard.damaged:
        lines.append(row_line("bytes that made no message", f"{heard.damaged} times"))
    return lines or [f"  {counted(heard.frames, 'frame')} that made no message"]


def heard_document(heard: Heard) -> HeardDocument:
    """The same as JSON."""
    return {
        "frames": heard.frames,
        "messages": dict(sorted(heard.messages.items())),
        "last": {title: content_document(content) for title, content in heard.last.items()},
        "damaged": heard.damaged,
        "boot_version": heard.boot_version or None,
        "not_in_dialect": sorted(heard.not_in_dialect),
    }
