"""Wireshark captures: reader of .pcapng and .pcap files, writer of .pcapng files.

The reader skips names, statistics and other link types. A CAN frame is a packet of SocketCAN (link
type 227): identifier with flags, high byte first, size, CAN FD flags, data.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from struct import Struct
from typing import Final

from flasher.protocol.frame import Frame
from flasher.python_can import can
from flasher.trace.bounds import Bounds, UnfitError

_LINK_TYPE_CAN: Final = 227
_LINK_TYPES: Final = {1: "Ethernet", 113: 'Linux "any"', 190: "CAN 2.0B", 276: 'Linux "any"'}
"""Names of link types, for messages."""

_EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29
_ID_MASK: Final = _ERROR - 1
_CAN_HEADER: Final = Struct(">LBBxx")
_IS_FD: Final = 0x04
_IS_XL: Final = 0x80
_DATA_MAX: Final = 8

_SECTION, _INTERFACE, _SIMPLE, _PACKET = 0x0A0D0D0A, 1, 3, 6
_BYTE_ORDER: Final = 0x1A2B3C4D
_OPTION_END, _OPTION_COMMENT, _OPTION_NAME, _OPTION_APPLICATION = 0, 1, 2, 4
_OPTION_FLAGS, _OPTION_RESOLUTION, _OPTION_OFFSET = 2, 9, 14
_INBOUND, _OUTBOUND = 1, 2
_BLOCK_MAX: Final = 16 * 1024 * 1024
_PCAP_MAGICS: Final = {0xA1B2C3D4: 10**6, 0xA1B23C4D: 10**9}
"""Time units per second, by the first bytes of a .pcap file."""


def frames_of_capture(source: BufferedIOBase, bounds: Bounds) -> Iterator[tuple[float, Frame]]:
    """Yield time in seconds and frame of each packet of a .pcapng or .pcap file. Raises UnfitError
    for other files, for captures without CAN, and at frames of a second interface.
    """
    magic = source.read(4)
    source.seek(0)
    if not magic:
        return
    found = _Interfaces()
    is_pcapng = magic == _SECTION.to_bytes(4, "big")
    for interface, at_s, packet in (_pcapng if is_pcapng else _pcap)(source, bounds, found):
        frame = _frame(packet)
        if frame is not None:
            found.take(interface)
            yield at_s, frame
    found.check_can()


@dataclass(frozen=True)
class _Interface:
    """Link type and time unit of a captured interface."""

    link_type: int
    units_per_s: int = 10**6
    offset_s: int = 0


class _Interfaces:
    """Interfaces of a capture, of which exactly one may have CAN frames."""

    def __init__(self) -> None:
        self.link_types: set[int] = set()
        self._of_frames: object = None

    def take(self, key: object) -> None:
        """Record a frame of an interface. Raises UnfitError for a second interface with frames."""
        if self._of_frames not in (None, key):
            raise UnfitError(
                "it holds frames of more than one CAN interface",
                remedy="Keep one: tshark -r FILE -Y frame.interface_id==0 -w ONE.pcapng",
            )
        self._of_frames = key

    def check_can(self) -> None:
        """Raise UnfitError if there are interfaces, but none is CAN."""
        if not self.link_types or _LINK_TYPE_CAN in self.link_types:
            return
        kinds = ", ".join(
            f"{kind} ({_LINK_TYPES[kind]})" if kind in _LINK_TYPES else str(kind)
            for kind in sorted(self.link_types)
        )
        raise UnfitError(
            f"it has the link type {kinds}, not {_LINK_TYPE_CAN} (SocketCAN)",
            remedy="Capture on the CAN interface itself: tshark -i can0 -w FILE.",
        )


def _frame(packet: bytes) -> Frame | None:
    """Decode the CAN frame in a packet; None for CAN FD and CAN XL. Raises UnfitError."""
    if len(packet) < _CAN_HEADER.size:
        raise UnfitError("a packet is too short for a CAN frame")
    can_id, size, flags = _CAN_HEADER.unpack_from(packet)
    if size & _IS_XL or flags & _IS_FD or size > _DATA_MAX:
        return None
    is_error, is_remote = bool(can_id & _ERROR), bool(can_id & _REMOTE)
    data = b"" if is_remote else packet[_CAN_HEADER.size : _CAN_HEADER.size + size]
    if not is_remote and len(data) < size:
        raise UnfitError("a frame is cut off: the capture kept a part of each packet only")
    is_extended = bool(can_id & _EXTENDED) and not is_error
    return Frame(can_id & _ID_MASK, data, is_extended, is_remote, is_error)


# -- reading ---------------------------------------------------------------------------------------

_Packets = Iterator[tuple[object, float, bytes]]
"""Interface, time in seconds and content of each CAN packet."""


def _pcap(source: BufferedIOBase, bounds: Bounds, found: _Interfaces) -> _Packets:
    head = source.read(24)
    for order in "<>":
        units = _PCAP_MAGICS.get(Struct(f"{order}L").unpack_from(head.ljust(4, b"\0"))[0])
        if units is not None and len(head) == 24:
            break
    else:
        raise UnfitError("it does not begin as a capture of Wireshark does")
    link_type = Struct(f"{order}L").unpack_from(head, 20)[0] & 0xFFFF
    found.link_types.add(link_type)
    record = Struct(f"{order}4L")
    while raw := source.read(record.size):
        if len(raw) < record.size:
            raise UnfitError("it ends within a packet")
        seconds, fraction, size, _ = record.unpack(raw)
        packet = _exactly(source, size)
        bounds.entry()
        if link_type == _LINK_TYPE_CAN:
            yield 0, seconds + fraction / units, packet


def _pcapng(source: BufferedIOBase, bounds: Bounds, found: _Interfaces) -> _Packets:
    order, section = "<", 0
    interfaces: list[_Interface] = []
    while head := source.read(8):
        if len(head) < 8:
            raise UnfitError("it ends within a block")
        kind, size = Struct(f"{order}LL").unpack(head)
        read = 8
        if kind == _SECTION:
            mark = _exactly(source, 4)
            read = 12
            order = "<" if mark == _BYTE_ORDER.to_bytes(4, "little") else ">"
            if mark != _BYTE_ORDER.to_bytes(4, "little" if order == "<" else "big"):
                raise UnfitError("a section has no byte order")
            size = Struct(f"{order}L").unpack_from(head, 4)[0]
            section += 1
            interfaces = []
        if size % 4 or not read + 4 <= size:
            raise UnfitError(f"a block states a size of {size:,} bytes")
        body = _exactly(source, size - read)[:-4]
        bounds.entry()
        if kind == _INTERFACE:
            interfaces.append(_interface(body, order))
            found.link_types.add(interfaces[-1].link_type)
        elif kind == _SIMPLE and interfaces and interfaces[0].link_type == _LINK_TYPE_CAN:
            raise UnfitError("its packets have no times")
        elif kind == _PACKET:
            number, high, low, captured = _unpacked(Struct(f"{order}4L"), body)
            if number >= len(interfaces) or 20 + captured > len(body):
                raise UnfitError("a packet is not within its block, or of no interface")
            of = interfaces[number]
            if of.link_type == _LINK_TYPE_CAN:
                at_s = of.offset_s + (high << 32 | low) / of.units_per_s
                yield (section, number), at_s, body[20 : 20 + captured]


def _interface(body: bytes, order: str) -> _Interface:
    (link_type,) = _unpacked(Struct(f"{order}H"), body)
    units, offset_s, at = 10**6, 0, 8
    option = Struct(f"{order}HH")
    while at + option.size <= len(body):
        code, size = option.unpack_from(body, at)
        value = body[at + option.size :][:size]
        if code == _OPTION_END:
            break
        if code == _OPTION_RESOLUTION and value:
            is_binary, digits = value[0] & 0x80, value[0] & 0x7F
            units = 2**digits if is_binary else 10 ** min(digits, 18)
        elif code == _OPTION_OFFSET and len(value) == 8:
            offset_s = int.from_bytes(value, "little" if order == "<" else "big", signed=True)
        at += option.size + _padded(size)
    return _Interface(link_type, units, offset_s)


def _unpacked(form: Struct, body: bytes) -> tuple[int, ...]:
    if len(body) < form.size:
        raise UnfitError("a block is too short")
    return form.unpack_from(body)


def _exactly(source: BufferedIOBase, size: int) -> bytes:
    if size > _BLOCK_MAX:
        raise UnfitError(f"a block states a size of {size:,} bytes")
    data = source.read(size)
    if len(data) < size:
        raise UnfitError("it ends within a block")
    return data


def _padded(size: int) -> int:
    return -(-size // 4) * 4


# -- writing --------------------------------------------------------------------------------------


class PcapngWriter:
    """Trace writer with the interface of python-can's writers, and comments for Wireshark."""

    def __init__(self, path: str | os.PathLike[str], comment: str = "") -> None:
        """`comment` is for the whole file. Raises OSError."""
        self._file = Path(path).open("wb")  # noqa: SIM115  stop() closes it
        section = Struct("<LHHq").pack(_BYTE_ORDER, 1, 0, -1)
        texts = {_OPTION_COMMENT: comment.encode(), _OPTION_APPLICATION: b"flasher"}
        self._block(_SECTION, section + _options(texts))
        interface = Struct("<HHL").pack(_LINK_TYPE_CAN, 0, 0)
        self._block(
            _INTERFACE, interface + _options({_OPTION_NAME: b"can", _OPTION_RESOLUTION: b"\x09"})
        )

    def __call__(self, message: can.Message, comment: str = "") -> None:
        """Write a frame with an optional `comment`. Raises OSError."""
        flags = (
            _EXTENDED * message.is_extended_id
            | _REMOTE * message.is_remote_frame
            | _ERROR * message.is_error_frame
        )
        data = b"" if message.is_remote_frame else bytes(message.data)
        kind = _IS_FD if message.is_fd else 0
        packet = _CAN_HEADER.pack(message.arbitration_id | flags, message.dlc, kind) + data
        at_ns = round(message.timestamp * 10**9)
        head = Struct("<5L").pack(0, at_ns >> 32, at_ns & 0xFFFFFFFF, len(packet), len(packet))
        direction = (_INBOUND if message.is_rx else _OUTBOUND).to_bytes(4, "little")
        options = _options({_OPTION_COMMENT: comment.encode(), _OPTION_FLAGS: direction})
        self._block(_PACKET, head + packet.ljust(_padded(len(packet)), b"\0") + options)

    def stop(self) -> None:
        """Close the file. Raises OSError."""
        self._file.close()

    def _block(self, kind: int, body: bytes) -> None:
        size = Struct("<L").pack(len(body) + 12)
        self._file.write(Struct("<L").pack(kind) + size + body + size)


def _options(values: dict[int, bytes]) -> bytes:
    """Encode the options of a block, without empty ones."""
    written = [
        Struct("<HH").pack(code, len(value)) + value.ljust(_padded(len(value)), b"\0")
        for code, value in values.items()
        if value
    ]
    return b"".join([*written, bytes(4)])
