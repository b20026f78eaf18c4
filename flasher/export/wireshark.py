"""Generator of the Wireshark dissector `welling.lua`.

CAN ids, messages, fields, time limits and texts come from the program's own tables. The script
implements only what tables cannot express: reassembly as in `flasher.protocol.wire`, the course of
an upgrade as in `flasher.trace.observed_upgrade`. The tests compare tshark's result with this
program's decoder.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any, Final

from flasher.export.names import key
from flasher.protocol import messages, spec
from flasher.protocol.bittime import frame_tables
from flasher.protocol.catalogue import ITEMS, UPGRADE_COMMANDS, Item, answer_of
from flasher.protocol.contents import Faults
from flasher.protocol.fields import (
    AddressField,
    BytesField,
    Codec,
    ConstantField,
    DateField,
    FlagsField,
    LatinField,
    NumberField,
    NumberListField,
    ReservedField,
    TextField,
    flag_names,
    label,
)
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import DamageReason
from flasher.trace.decoder import ACCEPTED_SHARE, ROUTES, TITLES, Kind, remark
from flasher.trace.observed_upgrade import AT_ONCE_S, IN_VAIN_S, NEXT_UPGRADE_S
from flasher.wording import wording

_SCRIPT: Final = "welling.lua"
_MARK: Final = "{} --[[ tables ]]"
_LINE_MAX: Final = 96
_LUA_WORDS: Final = frozenset({"and", "end", "false", "function", "in", "nil", "not", "or", "true"})
_ANSWERS: Final[dict[type[messages.UpgradeMessage], tuple[type[messages.UpgradeMessage], ...]]] = {
    messages.ResetCommand: (messages.GeneralFeedbackMessage,),
    messages.UpdateCommand: (messages.RequestTransfer,),
    messages.Packet: (messages.Ack, messages.Nak),
    messages.EndOfTransfer: (messages.Complete, messages.Nak),
}
"""Answers of a bootloader (table 9)."""
_OWN_FILTERS: Final = {"number": "packet", "total": "packets"}
"""Upgrade fields that a packet, its ACK and its NAK share as one filter."""


def dissector(version: str) -> str:
    """Create the script, for Wireshark from 4.0 on; `version` is this program's."""
    script = (files("flasher.export") / _SCRIPT).read_text(encoding="utf-8")
    assert script.count(_MARK) == 1  # noqa: S101  the two files belong together
    return script.replace(_MARK, _lua({"version": version, **_tables()}))


def _tables() -> dict[str, Any]:
    return {
        "header": spec.HEADER,
        "tail": spec.TAIL,
        "prefix_size": spec.PREFIX_SIZE,
        "overhead_size": spec.OVERHEAD_SIZE,
        "message_max_size": spec.MESSAGE_MAX_SIZE,
        "frame_data_size": spec.FRAME_DATA_SIZE,
        "modes": {mode.value: mode.name.lower() for mode in spec.Mode},
        "inter_frame_timeout_s": DEFAULT_TIMINGS.inter_frame_timeout_s,
        "command_timeout_s": DEFAULT_TIMINGS.command_timeout_s,
        "leftover_boot_version_s": DEFAULT_TIMINGS.leftover_boot_version_s,
        "next_upgrade_s": NEXT_UPGRADE_S,
        "at_once_s": AT_ONCE_S,
        "in_vain_s": IN_VAIN_S,
        "dialects": [
            {
                "name": dialect.name,
                "text": f"{dialect.name} {dialect.version}, {dialect.bitrate_bps // 1000} kbit/s",
                "has_upgrade": dialect.has_upgrade,
                "bitrate_bps": dialect.bitrate_bps,
            }
            for dialect in spec.DIALECTS.values()
        ],
        "ids": {
            can_id: {"sender": sender, "receiver": receiver}
            for can_id, (sender, receiver) in ROUTES.items()
        },
        "bits": frame_tables(ROUTES),
        "accepted_share": ACCEPTED_SHARE,
        "targets": [
            {"request_id": target.request_id, "answer_id": target.answer_id}
            for target in spec.TARGETS.values()
        ],
        "commands": {command.name: command.value for command in spec.Command},
        "items": [_item(item) for item in ITEMS],
        "rows": [_row(row) for row in messages.UPGRADE_MESSAGES.values()],
        "titles": {kind.value: wording(kind) for kind in Kind},
        "reasons": {reason.name: reason.value for reason in DamageReason},
        "reason_texts": {reason.value: wording(reason) for reason in DamageReason},
    }


def _item(item: Item) -> dict[str, Any]:
    """Convert an application message to a table."""
    answer = answer_of(item)
    return {
        "id": item.can_id,
        "command": item.command,
        "mode": item.mode.value,
        "title": item.title,
        "answers": [] if answer is None else [{"id": answer.can_id, "command": answer.command}],
        "dialects": {dialect.name: True for dialect in item.dialects},
        "is_alarm": item.content is Faults,
        "fields": [
            _field(f"{key(item.title)}.{name}", name, codec) for name, codec in item.content.LAYOUT
        ],
    }


def _row(row: type[messages.UpgradeMessage]) -> dict[str, Any]:
    """Convert an upgrade message to a table, with the values that its fields allow."""
    title = TITLES[row]
    return {
        "command": row.COMMAND.value,
        "mode": row.MODE.value,
        "title": title,
        "is_upgrade": row.COMMAND in UPGRADE_COMMANDS,
        "answers": [{"command": answer.COMMAND.value} for answer in _ANSWERS.get(row, ())],
        "fields": [
            _field(_OWN_FILTERS.get(name, f"{key(title)}.{name}"), name, codec) | _limits(codec)
            for name, codec in row.LAYOUT
        ],
    }


def _limits(codec: Codec) -> dict[str, Any]:
    match codec:
        case ConstantField():
            return {"must_be": codec.expected}
        case messages.PacketNumber():
            return {"least": 1}
        case messages.UpdateText():
            return {"known": dict.fromkeys(sorted(codec.KNOWN), True)}
    return {}


def _field(filter_name: str, name: str, codec: Codec) -> dict[str, Any]:
    unit = codec.unit
    return {
        "filter": filter_name,
        "label": label(name, codec),
        "size": codec.size_bytes,
        "unit": unit,
        "if_zero": remark(name, unit, 0),
        "if_above_100": remark(name, unit, 101),
        **_kind(filter_name, codec),
    }


def _kind(filter_name: str, codec: Codec) -> dict[str, Any]:
    """Return the decoder of a field's bytes in Lua."""
    match codec:
        case AddressField():
            return {"kind": "address"}
        case NumberField():
            return {"kind": "number", "offset": codec.offset, "signed": codec.signed}
        case NumberListField():
            return {"kind": "numbers", "each": codec.each.size_bytes}
        case FlagsField():
            bits = [1 << bit for bit in range(8 * codec.size_bytes)]
            return {"kind": "flags", "none": codec.none, "bits": [_bit(codec, bit) for bit in bits]}
        case TextField() | DateField():
            return {"kind": "text"}
        case LatinField():
            return {"kind": "latin"}
        case ConstantField():
            return {"kind": "constant", "expected": codec.expected}
        case ReservedField():
            return {"kind": "reserved"}
        case BytesField():
            return {"kind": "bytes"}
    raise TypeError(f"{filter_name} has a codec that the dissector lacks: {codec}")


def _bit(codec: FlagsField, mask: int) -> dict[str, Any]:
    (text,) = flag_names(codec.names, mask)
    return {"mask": mask, "name": key(text), "text": text}


# -- Lua ------------------------------------------------------------------------------------------


def _lua(value: object, indent: str = "") -> str:
    """Format a value in Lua syntax."""
    deeper = f"{indent}  "
    match value:
        case bool():
            return str(value).lower()
        case int():
            return str(int(value))
        case float():
            return repr(value)
        case str():
            return _lua_text(value.encode())
        case bytes():
            return _lua_text(value)
        case dict():
            lines = [f"{_lua_key(name)} = {_lua(each, deeper)}" for name, each in value.items()]
        case list():
            lines = [_lua(each, deeper) for each in value]
        case _:
            raise TypeError(f"{value!r} has no form in Lua")
    short = f"{{{', '.join(lines)}}}"
    if len(short) <= _LINE_MAX - len(indent):
        return short
    joined = f",\n{deeper}".join(lines)
    return f"{{\n{deeper}{joined}\n{indent}}}"


def _lua_key(name: object) -> str:
    is_word = isinstance(name, str) and name.isidentifier() and name not in _LUA_WORDS
    return str(name) if is_word else f"[{_lua(name)}]"


def _lua_text(raw: bytes) -> str:
    return '"{}"'.format(
        "".join(
            chr(byte) if 0x20 <= byte < 0x7F and byte not in b'"\\' else f"\\{byte:03d}"
            for byte in raw
        )
    )
