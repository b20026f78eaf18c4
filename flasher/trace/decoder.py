"""Trace decoder: CAN frames to messages, damaged bytes, foreign frames and error frames.

`Decoder` takes the whole bus, one byte stream for each CAN id. It returns a `BusEvent` for each
message, each stretch of damaged bytes and each foreign frame, with typed fields and as text that is
safe on any screen. `TimedDecoder` adds their times on the wire.

Time stamps differ: adapters and candump stamp the end of a frame; our own recorder stamps a sent
frame when the driver accepts it, and a queue accepts a whole message at once. `TimedEvent` computes
begin and end on the wire for both: frames stamped closer together than the wire allows were stamped
on acceptance, and their message ended when the wire could have carried it.

Pure: the time is an argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from math import inf
from typing import Any, Final, NamedTuple

from flasher.protocol import catalogue, messages
from flasher.protocol.bittime import fixed_bits, frame_bits
from flasher.protocol.contents import Faults
from flasher.protocol.fields import Bits, Content, ReservedField, WireText, flag_names, label
from flasher.protocol.frame import Frame
from flasher.protocol.spec import TARGETS, Dialect, Mode, Node, can_id
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Damage, Message, Reassembler
from flasher.wording import wording

_TIMEOUT_S: Final = DEFAULT_TIMINGS.inter_frame_timeout_s
_LONG_ID_BITS: Final = 20
"""Additional bits of a 29-bit id: 18 id bits, SRR and r1."""
_ERROR_FRAME_BITS: Final = 20
"""Flags, delimiter and interframe space, approximately."""
ACCEPTED_SHARE: Final = 0.9
"""Frames stamped closer together than this share of their wire time were stamped on acceptance."""


class Kind(Enum):
    """Kinds of bus events."""

    MESSAGE = "message"
    UNKNOWN = "unknown"
    """Intact, but not documented."""
    MALFORMED = "malformed"
    """Documented, but with another mode or other data."""
    DAMAGED = "damaged"
    FOREIGN = "foreign"
    """Frame with a CAN id or format that no documented node sends."""
    ERROR_FRAME = "error_frame"


class Field(NamedTuple):
    """Value in a message: `name` includes its unit, `value` is ready for JSON."""

    name: str
    value: Any
    label: str
    text: str
    unit: str = ""

    def words(self, limit: int | None = None, mark: str = "") -> str:
        """Label, value and unit as text; the value is truncated after `limit` characters."""
        text = self.text
        if limit is not None and len(text) > limit:
            text = f"{text[:limit].rstrip()} ..."
        return f"{mark}{self.label} {text} {self.unit}".rstrip()


@dataclass(frozen=True)
class BusEvent:
    """Event on the bus at `at` seconds. `sender` and `receiver` are node names, "all" for a
    broadcast, empty for the CAN id of no node.
    """

    at: float
    kind: Kind
    can_id: int
    title: str
    sender: str = ""
    receiver: str = ""
    command: int | None = None
    fields: tuple[Field, ...] = ()
    is_alarm: bool = False
    """The message is intact and reports trouble: a NAK, or active faults."""
    in_dialect: bool = True
    """False for a message that the requested dialect lacks."""

    @property
    def route(self) -> str:
        """Sender and receiver; empty for the CAN id of no node."""
        return f"{self.sender} > {self.receiver}" if self.sender else ""

    @property
    def marked_title(self) -> str:
        """Title, marked if the dialect lacks the message."""
        return self.title if self.in_dialect else f"{self.title} {NOT_IN_DIALECT}"

    @property
    def is_trouble(self) -> bool:
        """True for an event that does not occur on a healthy bus."""
        return self.is_alarm or self.kind not in (Kind.MESSAGE, Kind.FOREIGN)


BROADCAST: Final = "all"
NOT_IN_DIALECT: Final = "(not in this dialect)"
_HEALTH: Final = "state_of_health_percent"
_OLDER: Final = "or an older device, which does not know it"
ROUTES: Final = {
    can_id(sender, receiver): (sender.name, BROADCAST if receiver is None else receiver.name)
    for sender in Node
    for receiver in (None, *Node)
    if sender is not receiver
}
"""Sender and receiver of every documented CAN id."""
_TO_DEVICE: Final = frozenset(target.request_id for target in TARGETS.values())
_TO_TOOL: Final = frozenset(target.answer_id for target in TARGETS.values())

TITLES: Final[dict[type[messages.UpgradeMessage], str]] = {
    messages.ResetCommand: "reset",
    messages.GeneralFeedbackMessage: "general feedback",
    messages.BootVersion: "boot version",
    messages.UpdateCommand: "update command",
    messages.RequestTransfer: "request transfer",
    messages.Packet: "packet",
    messages.Ack: "ACK",
    messages.Nak: "NAK",
    messages.EndOfTransfer: "end of transfer",
    messages.Complete: "complete",
}
"""Titles of the upgrade messages."""


def message_titles() -> tuple[str, ...]:
    """List the titles of all messages, each once."""
    titles = [item.title for item in catalogue.ITEMS] + list(TITLES.values())
    return tuple(dict.fromkeys(titles))


class Decoder:
    """Decodes the frames of a bus in either dialect; with a `dialect`, marks messages that it
    lacks. Feed every frame, and call `tick` at `deadline`.
    """

    def __init__(self, dialect: Dialect | None = None) -> None:
        self._dialect = dialect
        self._streams = {key: Reassembler(key, _TIMEOUT_S) for key in ROUTES}
        self._holding: dict[int, Reassembler] = {}
        """Streams with an incomplete message: rarely more than two or three."""

    def feed(self, frame: Frame, now: float) -> Sequence[BusEvent]:
        """Return the events that a frame completes, in order: usually none, sometimes several."""
        if frame.is_error:
            return (BusEvent(now, Kind.ERROR_FRAME, frame.can_id, wording(Kind.ERROR_FRAME)),)
        stream = self._streams.get(frame.can_id)
        if stream is None or not frame.is_payload:
            return (_foreign(frame, now),)
        found = stream.feed(frame.data, now)
        if stream.due_at < inf:
            self._holding[frame.can_id] = stream
        else:
            self._holding.pop(frame.can_id, None)
        return [self._describe(each, now) for each in found] if found else ()

    def deadline(self) -> float | None:
        """Time at which `tick` next drops an incomplete message; None without one."""
        return min((stream.due_at for stream in self._holding.values()), default=None)

    def tick(self, now: float) -> list[BusEvent]:
        """Return messages whose remaining frames did not arrive in time (R12), as damaged bytes."""
        found = [each for stream in self._holding.values() for each in stream.tick(now)]
        self._holding = {key: held for key, held in self._holding.items() if held.due_at < inf}
        return [self._describe(each, now) for each in found]

    def _describe(self, found: Message | Damage, now: float) -> BusEvent:
        sender, receiver = ROUTES[found.can_id]
        if isinstance(found, Damage):
            reason = Field("reason", found.reason.value, "reason", wording(found.reason))
            fields = (reason, _raw("bytes", found.data))
            title = wording(Kind.DAMAGED)
            return BusEvent(now, Kind.DAMAGED, found.can_id, title, sender, receiver, fields=fields)
        kind, title, shown, alarm = _judge(found)
        return BusEvent(
            now, kind, found.can_id, title, sender, receiver, found.command, shown, alarm,
            in_dialect=self._dialect is None or catalogue.has_message(self._dialect, found),
        )  # fmt: skip


def _judge(message: Message) -> tuple[Kind, str, tuple[Field, ...], bool]:
    """Return kind, title and fields of a message, and whether it reports trouble."""
    decoded = catalogue.decode(message)
    if decoded is not None:
        content = decoded.content
        alarm = isinstance(content, Faults) and bool(content.faults)
        return Kind.MESSAGE, decoded.item.title, content_fields(content), alarm
    known = catalogue.BY_KEY.get((message.can_id, message.command))
    if known is not None:
        problem = f"mode is {message.mode:02X}, not {known.mode:02X}"
        return Kind.MALFORMED, known.title, _undecoded(message, problem), False
    if message.can_id in _TO_DEVICE | _TO_TOOL:
        row = messages.decode(message)
        if isinstance(row, messages.Malformed):
            return Kind.MALFORMED, wording(Kind.MALFORMED), _undecoded(message, row.problem), False
        # Devices report, the tool reads and writes (2.2.1).
        if not isinstance(row, messages.Unknown) and message.can_id in (
            _TO_TOOL if row.MODE == Mode.REPORT else _TO_DEVICE
        ):
            alarm = isinstance(row, messages.Nak)
            return Kind.MESSAGE, TITLES[type(row)], _row_fields(row), alarm
    return Kind.UNKNOWN, wording(Kind.UNKNOWN), _undecoded(message), False


# -- fields ---------------------------------------------------------------------------------------


def content_fields(content: Content) -> tuple[Field, ...]:
    """Return the fields of an application message; reserved bytes only if not zero."""
    fields = []
    for name, codec in content.LAYOUT:
        value = getattr(content, name)
        if not isinstance(codec, ReservedField) or any(value):
            shown = Field(name, _plain_value(value), label(name, codec), codec.show(value))
            words = remark(name, codec.unit, value)
            if words:
                fields.append(shown._replace(text=f"{shown.text} {codec.unit} ({words})"))
            else:
                fields.append(shown._replace(unit=codec.unit))
    return tuple(fields)


def remark(name: str, unit: str, value: object) -> str:
    """Return a remark on a percentage that is shown as received (R22); empty without one."""
    if unit != "%" or not isinstance(value, int):
        return ""
    if value > 100:
        return "more than the document allows"
    return _OLDER if name == _HEALTH and value == 0 else ""


def _row_fields(row: messages.UpgradeMessage) -> tuple[Field, ...]:
    """Return the fields of an upgrade message."""
    values = vars(row)
    return tuple(
        Field(
            name, _plain_value(values[name]), label(name, codec), codec.show(values[name]),
            codec.unit,
        )
        for name, codec in row.LAYOUT
        if name in values
    )  # fmt: skip


def _undecoded(message: Message, problem: str = "") -> tuple[Field, ...]:
    """Return command, mode and data of an undocumented or malformed message as fields."""
    fields = (
        Field("command", f"{message.command:04X}", "command", f"{message.command:04X}"),
        Field("mode", message.mode, "mode", f"{message.mode:02X}"),
        _raw("data", message.data),
    )
    return (_plain("problem", problem), *fields) if problem else fields


def _foreign(frame: Frame, now: float) -> BusEvent:
    fields = [_raw("data", frame.data)]
    if frame.is_extended:
        fields.insert(0, _plain("identifier", "29 bits"))
    if frame.is_remote:
        fields.insert(0, _plain("frame", "remote request"))
    sender, receiver = ("", "") if frame.is_extended else ROUTES.get(frame.can_id, ("", ""))
    title = wording(Kind.FOREIGN)
    return BusEvent(now, Kind.FOREIGN, frame.can_id, title, sender, receiver, fields=tuple(fields))


def _plain(name: str, value: int | str) -> Field:
    value = printable(value) if isinstance(value, str) else value
    return Field(name, value, name.replace("_", " "), str(value))


def _raw(name: str, data: bytes) -> Field:
    return Field(name, data.hex(), name.replace("_", " "), data.hex(" ") or "none")


def _plain_value(value: object) -> Any:
    """Convert a value for JSON: numbers, texts, lists of them; bytes in hexadecimal."""
    match value:
        case Bits():
            return flag_names(type(value), value)
        case WireText():
            return str(value)
        case str():
            return printable(value)
        case bytes():
            return value.hex()
        case tuple():
            return list(value)
        case _:
            return value


# -- with times ----------------------------------------------------------------------------------


def bits_of(frame: Frame) -> int:
    """Length of any frame in bit times; stuff bits are counted for the base format only."""
    if frame.is_error:
        return _ERROR_FRAME_BITS
    if frame.is_extended:
        return fixed_bits(len(frame.data)) + _LONG_ID_BITS
    return frame_bits(frame)


@dataclass(frozen=True, slots=True)
class TimedEvent:
    """Bus event with the time stamps and bit times of its frames."""

    event: BusEvent
    begin_s: float
    """Time stamp of the first frame."""
    end_s: float
    """Time stamp of the last frame."""
    bits: int
    first_bits: int
    """Bit times of the first frame."""

    def began_s(self, bitrate_bps: int) -> float:
        """Estimated time at which the first frame began on the wire."""
        if self._stamps_mark_ends(bitrate_bps):
            return self.begin_s - self.first_bits / bitrate_bps
        return self.begin_s

    def left_s(self, bitrate_bps: int) -> float:
        """Estimated time at which the last frame ended on the wire."""
        if self._stamps_mark_ends(bitrate_bps):
            return self.end_s
        return max(self.end_s, self.begin_s + self.bits / bitrate_bps)

    def _stamps_mark_ends(self, bitrate_bps: int) -> bool:
        """True if stamps mark the end of each frame, False if they mark its acceptance."""
        between_s = (self.bits - self.first_bits) / bitrate_bps
        return self.end_s - self.begin_s >= ACCEPTED_SHARE * between_s


@dataclass(slots=True)
class _Open:
    """Frames of one CAN id since its last timed event."""

    begin_s: float
    first_bits: int
    bits: int = 0
    end_s: float = field(default=0.0)


class TimedDecoder:
    """Decodes the frames of a bus, in the order of time, with their times on the wire."""

    def __init__(self) -> None:
        self._decoder = Decoder()
        self._open: dict[int, _Open] = {}
        self._nothing_due_before = -inf

    def feed(self, frame: Frame, now: float, bits: int) -> Sequence[TimedEvent]:
        """Return messages that became incomplete by `now`, then those that the frame completes."""
        found: list[TimedEvent] = []
        if now > self._nothing_due_before:
            found = self._cut_short(now)
            due = self._decoder.deadline()
            self._nothing_due_before = now + _TIMEOUT_S if due is None else due
        if frame.is_payload:
            held = self._open.get(frame.can_id)
            if held is None:
                held = self._open[frame.can_id] = _Open(now, bits)
            held.bits += bits
            held.end_s = now
        for event in self._decoder.feed(frame, now):
            found.append(self._timed(event, bits))
        return found

    def finish(self, now: float) -> list[TimedEvent]:
        """Return the messages that are still incomplete at the end."""
        return self._cut_short(now + 2 * _TIMEOUT_S)

    def _cut_short(self, now: float) -> list[TimedEvent]:
        found: list[TimedEvent] = []
        while (due := self._decoder.deadline()) is not None and due < now:
            found += [self._timed(event, 0) for event in self._decoder.tick(due)]
        return found

    def _timed(self, event: BusEvent, bits: int) -> TimedEvent:
        held = None
        if event.kind not in (Kind.FOREIGN, Kind.ERROR_FRAME):
            # A second event of the same frame begins and ends with it.
            held = self._open.pop(event.can_id, None)
        if held is None:
            return TimedEvent(event, event.at, event.at, bits, bits)
        return TimedEvent(event, held.begin_s, held.end_s, held.bits, held.first_bits)
