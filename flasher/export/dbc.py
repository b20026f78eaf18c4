"""DBC export: message definitions for CANalyzer and similar tools.

A DBC describes single frames and has no messages of several frames. So it describes each message as
one CAN FD frame with the same id (`joined_frames` makes them from a trace): the first 64 bytes,
from the header on, with the command as multiplexer. A DBC cannot describe texts, opaque bytes,
bytes after byte 64, and the CRC, whose position varies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Final

from flasher.export.names import key
from flasher.protocol import messages
from flasher.protocol.catalogue import ITEMS
from flasher.protocol.fields import Codec, FlagsField, NumberField, NumberListField, flag_names
from flasher.protocol.frame import Frame
from flasher.protocol.spec import COMMAND_SIZE, PREFIX_SIZE, TARGETS, Mode
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Message, Reassembler, encode
from flasher.python_can import can
from flasher.trace.decoder import ROUTES, TITLES

FD_SIZE: Final = 64
"""Size of each frame in bytes: programs refuse frames shorter than the DBC states."""
_DATA_AT: Final = PREFIX_SIZE + COMMAND_SIZE
_NAME_MAX: Final = 32
"""Maximum length of a name; longer ones go into an attribute, as Vector's tools write them."""
_LONG_NAME: Final = "SystemSignalLongSymbol"
_COMMAND: Final = "command"
_NODE_OF_ALL: Final = "Vector__XXX"
_FRAME_FORMAT: Final = "VFrameFormat"
_FRAME_FORMATS: Final = (
    "StandardCAN", "ExtendedCAN", *(["reserved"] * 12), "StandardCAN_FD", "ExtendedCAN_FD",
)  # fmt: skip
_COMMENT: Final = (
    "Messages of the Welling drive system, each joined to one CAN FD frame (flasher export "
    "trace --joined): its first 64 bytes, from the header 55 AA on. Left out is what a DBC cannot "
    "say: texts, plain bytes, everything after byte 64, and the CRC. Frames of a message as they "
    "are on the bus are not described."
)


@dataclass(frozen=True)
class _Signal:
    name: str
    """Full name, unique in a message."""
    mux: int
    start_bit: int
    bits: int
    offset: int = 0
    is_signed: bool = False
    unit: str = ""


def dbc() -> str:
    """Create the DBC text for the messages of both dialects."""
    described = _messages()
    names = _short_names(signal.name for signals, _ in described.values() for signal in signals)
    nodes = sorted({sender for sender, _ in ROUTES.values()})
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", f"BU_: {' '.join(nodes)}", ""]
    for can_id, (signals, _) in described.items():
        sender, receiver = ROUTES[can_id]
        to = receiver if receiver in nodes else _NODE_OF_ALL
        lines.append(f"BO_ {can_id} {sender}_to_{receiver}: {FD_SIZE} {sender}")
        lines.append(f' SG_ mode : 16|8@1+ (1,0) [0|255] "" {to}')
        lines.append(f' SG_ length : 24|8@1+ (1,0) [0|255] "" {to}')
        lines.append(f' SG_ {_COMMAND} M : 39|16@0+ (1,0) [0|65535] "" {to}')
        lines += [f" SG_ {_declared(signal, names)} {to}" for signal in signals]
        lines.append("")
    lines.append(f'CM_ "{_COMMENT}";')
    formats = ",".join(f'"{each}"' for each in _FRAME_FORMATS)
    lines += [
        f'BA_DEF_ SG_ "{_LONG_NAME}" STRING ;',
        f'BA_DEF_ BO_ "{_FRAME_FORMAT}" ENUM {formats};',
        'BA_DEF_ "BusType" STRING ;',
        f'BA_DEF_DEF_ "{_LONG_NAME}" "";',
        f'BA_DEF_DEF_ "{_FRAME_FORMAT}" "{_FRAME_FORMATS[0]}";',
        'BA_DEF_DEF_ "BusType" "";',
        'BA_ "BusType" "CAN FD";',
    ]
    fd = _FRAME_FORMATS.index("StandardCAN_FD")
    lines += [f'BA_ "{_FRAME_FORMAT}" BO_ {can_id} {fd};' for can_id in described]
    for can_id, (signals, titles) in described.items():
        lines += [
            f'BA_ "{_LONG_NAME}" SG_ {can_id} {names[signal.name]} "{signal.name}";'
            for signal in signals
            if names[signal.name] != signal.name
        ]
        lines.append(f"VAL_ {can_id} mode {_choices((m.value, m.name.lower()) for m in Mode)} ;")
        lines.append(f"VAL_ {can_id} {_COMMAND} {_choices(titles.items())} ;")
    return "\n".join([*lines, ""])


def _messages() -> dict[int, tuple[list[_Signal], dict[int, str]]]:
    """Return the signals, and the titles by command, of each CAN id with messages."""
    found: dict[int, tuple[list[_Signal], dict[int, str]]] = {}

    def add(can_id: int, command: int, title: str, layout: Iterable[tuple[str, Codec]]) -> None:
        signals, titles = found.setdefault(can_id, ([], {}))
        if command not in titles:
            titles[command] = title
            signals += _signals(command, key(title), layout)

    for item in ITEMS:
        add(item.can_id, item.command, item.title, item.content.LAYOUT)
    for target in TARGETS.values():
        for command, row in messages.UPGRADE_MESSAGES.items():
            of_id = target.answer_id if row.MODE == Mode.REPORT else target.request_id
            add(of_id, command, TITLES[row], row.LAYOUT)
    return dict(sorted(found.items()))


def _signals(command: int, prefix: str, layout: Iterable[tuple[str, Codec]]) -> Iterator[_Signal]:
    """Yield numbers and flags in the first 64 bytes."""
    at = _DATA_AT
    for name, codec in layout:
        size, bit, whole = codec.size_bytes, 8 * at, f"{prefix}_{name}"
        at += size
        if at > FD_SIZE:
            return
        match codec:
            case NumberField():
                yield _Signal(
                    whole, command, bit, 8 * size, -codec.offset, codec.signed, codec.unit
                )
            case NumberListField():
                each = 8 * codec.each.size_bytes
                for number in range(codec.count):
                    place = bit + number * each
                    yield _Signal(
                        f"{whole}_{number + 1}", command, place, each, unit=codec.each.unit
                    )
            case FlagsField():
                for flag in codec.names:
                    (text,) = flag_names(codec.names, flag)
                    place = bit + int(flag).bit_length() - 1
                    yield _Signal(f"{whole}_{key(text)}", command, place, 1)


def _declared(signal: _Signal, names: dict[str, str]) -> str:
    low = -(1 << signal.bits - 1) if signal.is_signed else 0
    high = low + (1 << signal.bits) - 1
    return (
        f"{names[signal.name]} m{signal.mux} : {signal.start_bit}|{signal.bits}@1"
        f"{'-' if signal.is_signed else '+'} (1,{signal.offset}) "
        f'[{low + signal.offset}|{high + signal.offset}] "{signal.unit}"'
    )


def _short_names(names: Iterable[str]) -> dict[str, str]:
    """Map each name to a unique name of at most 32 characters."""
    short: dict[str, str] = {}
    numbers = count()
    for name in names:
        if name not in short:
            fits = len(name) <= _NAME_MAX
            short[name] = name if fits else f"{name[: _NAME_MAX - 5]}_{next(numbers):04}"
    return short


def _choices(values: Iterable[tuple[int, str]]) -> str:
    return " ".join(f'{value} "{text}"' for value, text in values)


# -- frames ---------------------------------------------------------------------------------------


def joined_frames(frames: Iterable[tuple[float, Frame]]) -> Iterator[can.Message]:
    """Yield each intact message as one CAN FD frame at the time of its last frame: the first 64
    bytes, zero-padded.
    """
    streams = {
        can_id: Reassembler(can_id, DEFAULT_TIMINGS.inter_frame_timeout_s) for can_id in ROUTES
    }
    for now, frame in frames:
        stream = streams.get(frame.can_id)
        if stream is None or not frame.is_payload:
            continue
        for found in (*stream.tick(now), *stream.feed(frame.data, now)):
            if isinstance(found, Message):
                yield joined(found, now)


def joined(message: Message, at_s: float) -> can.Message:
    """Convert a message to a CAN FD frame."""
    data = encode(message)[:FD_SIZE]
    return can.Message(
        timestamp=at_s,
        arbitration_id=message.can_id,
        is_extended_id=False,
        is_fd=True,
        data=data.ljust(FD_SIZE, b"\0"),
        channel=0,
    )
