"""The document of the application's messages, drawn from the catalogue itself.

    python -m tests.messages_document

writes docs/reference/messages.md anew; a test holds it against the catalogue.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from flasher.protocol.catalogue import ITEMS, Item, answer_of
from flasher.protocol.fields import (
    AddressField,
    Codec,
    ConstantField,
    Content,
    DateField,
    FlagsField,
    NumberField,
    NumberListField,
    ReservedField,
    TextField,
    flag_names,
    label,
)
from flasher.protocol.messages import UPGRADE_MESSAGES
from flasher.protocol.spec import DIALECTS, Node

MESSAGES: Final = Path(__file__).parents[1] / "docs" / "reference" / "messages.md"

_INTRODUCTION: Final = """\
# Messages

Every message of both dialects, drawn from `flasher/protocol/catalogue.py` (chapter 3 of the
documents) and `flasher/protocol/messages.py` (the upgrade, appendix 3) by
`python -m tests.messages_document`; a test keeps it so. [How a message is framed](framing.md).

A message is named by its CAN id and its command, as the protocol documents print them; the second
byte of the command is the size of the data. Numbers have their low byte first. A text ends with `.`
and is filled with spaces; a reader takes a full field without it too (R20).

A field's name is that in programs and in JSON. Where messages stand side by side the title of the
message is before it, in small letters: `running_information.voltage_mv` is a column of a
[table](../how-to/notebook.md), `welling.running_information.voltage_mv` a filter of
[Wireshark](../how-to/wireshark.md), `running_information_voltage_mv` a signal of the
[DBC](../how-to/dbc.md).
"""

_SENDERS: Final = {
    Node.BMS: "the battery (BMS)",
    Node.WMC: "the motor controller (WMC)",
    Node.OBC: "the on-board computer or push buttons (OBC)",
    Node.HMI: "the display (HMI)",
    Node.CDL: "the tool (CDL)",
}


def messages_document() -> str:
    """docs/reference/messages.md."""
    lines = [_INTRODUCTION, *_upgrade(), *_dialects()]
    for node, name in _SENDERS.items():
        lines += [f"## Sent by {name}", "", *_rows(item for item in ITEMS if item.sender is node)]
    lines += ["## What they carry", ""]
    for content in dict.fromkeys(item.content for item in ITEMS if item.content.LAYOUT):
        lines += _content(content)
    return "\n".join(lines)


def _upgrade() -> Iterator[str]:
    yield from ("## The upgrade", "")
    yield "Between the tool (75x) and a device (7x5), in the order of"
    yield from ("[the upgrade](../explanation/upgrade.md).", "")
    yield from _table("message", "command", "mode", "what", "data")
    for row in UPGRADE_MESSAGES.values():
        title = _words(row.__name__)
        data = ", ".join(_part(name, codec) for name, codec in row.LAYOUT)
        command = f"{row.COMMAND:04X}"
        yield _cells(title, command, row.MODE.name.lower(), inspect.getdoc(row), data)
    yield ""


def _part(name: str, codec: Codec) -> str:
    if isinstance(codec, ConstantField):
        text = codec.expected.decode()
        return f"`{text}`" if text.isprintable() else codec.expected.hex(" ").upper()
    return f"{name.removesuffix('_bytes')} ({codec.size_bytes} B{_little(codec)})"


def _little(codec: Codec) -> str:
    return ", low byte first" if isinstance(codec, NumberField) else ""


def _dialects() -> Iterator[str]:
    yield from ("## The applications", "")
    yield from _table("dialect", "document", "bit rate", "nodes", "messages below")
    for dialect in DIALECTS.values():
        nodes = ", ".join(node.name for node in dialect.nodes)
        count = sum(dialect in item.dialects for item in ITEMS)
        yield _cells(
            dialect.name, dialect.version, f"{dialect.bitrate_bps // 1000} kbit/s", nodes, count
        )
    yield ""


def _rows(items: Iterable[Item]) -> Iterator[str]:
    yield from _table("message", "mode", "to", "what", "bytes", "carries", "answer", "dialect")
    for item in items:
        answer = answer_of(item)
        yield _cells(
            item.name,
            item.mode.name.lower(),
            item.receiver.name if item.receiver else "all",
            item.title + " (manufacturer only)" * item.manufacturer_only,
            item.content.SIZE_BYTES,
            _link(item.content),
            answer.name if answer else "",
            _only(item),
        )
    yield ""


def _only(item: Item) -> str:
    if len(item.dialects) == len(DIALECTS):
        return ""
    return f"{' and '.join(dialect.name for dialect in item.dialects)} only"


def _link(content: type[Content]) -> str:
    if not content.LAYOUT:
        return ""
    title = _title(content)
    return f"[{title}](#{title.lower().replace(' ', '-')})"


def _title(content: type[Content]) -> str:
    return _words(content.__name__)


def _words(name: str) -> str:
    """The name of a class in words."""
    return "".join(
        f" {char.lower()}" if char.isupper() and at else char for at, char in enumerate(name)
    )


def _content(content: type[Content]) -> Iterator[str]:
    carriers = ", ".join(item.name for item in ITEMS if item.content is content)
    yield from (f"### {_title(content)}", "", inspect.getdoc(content) or "", "")
    yield from (f"{content.SIZE_BYTES} bytes, in {carriers}.", "")
    yield from _table("first byte", "bytes", "field", "name", "type", "unit", "on the wire")
    at = 0
    for name, codec in content.LAYOUT:
        shown, kind = label(name, codec), _type(codec)
        yield _cells(
            at, codec.size_bytes, shown, f"`{name}`", kind, codec.unit, _on_the_wire(codec)
        )
        at += codec.size_bytes
    yield ""
    for name, codec in content.LAYOUT:
        if isinstance(codec, FlagsField):
            yield from _bits(label(name, codec), codec)


def _type(codec: Codec) -> str:
    match codec:
        case NumberField(size_bytes=size_bytes, signed=signed):
            return f"{'int' if signed else 'uint'}{8 * size_bytes}"
        case NumberListField(count=count, each=each):
            return f"{count} {_type(each)}"
        case FlagsField(size_bytes=size_bytes):
            return f"{8 * size_bytes} bits"
        case TextField() | ConstantField():
            return "text"
        case DateField():
            return "date"
        case _:
            return "bytes"


def _on_the_wire(codec: Codec) -> str:
    match codec:
        case AddressField():
            return "an address"
        case NumberField(offset=offset) if offset:
            return f"value + {offset}"
        case FlagsField(none=none):
            return f"no bit: {none}"
        case ConstantField(expected=expected):
            return f"`{expected.decode()}`, no terminator"
        case TextField(size_bytes=size_bytes):
            return f"up to {size_bytes - 1} characters"
        case DateField():
            return "YYYYMMDD"
        case ReservedField():
            return "00"
        case _:
            return ""


def _bits(name: str, codec: FlagsField) -> Iterator[str]:
    others = "are reserved" if "reserved" in codec.names.unnamed(0) else "are not in the document"
    yield from (f"Bits of {name}; the others {others}:", "")
    yield from _table("bit", "mask", "meaning")
    for flag in codec.names:
        (meaning,) = flag_names(codec.names, flag)
        mask = f"{int(flag):0{2 * codec.size_bytes}X}"
        yield _cells(int(flag).bit_length() - 1, mask, meaning)
    yield ""


def _table(*names: str) -> Iterator[str]:
    yield _cells(*names)
    yield "|" + "---|" * len(names)


def _cells(*values: object) -> str:
    return "| " + "".join(f"{value} | " if str(value) else "| " for value in values).rstrip()


if __name__ == "__main__":
    MESSAGES.parent.mkdir(exist_ok=True)
    MESSAGES.write_text(messages_document(), encoding="utf-8")
