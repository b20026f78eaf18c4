"""Harnesses of firmware files.

Fuzzing finds no checksums. So an input that does not begin as a file of records does is taken for
records without them, of which the harness writes the lines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from flasher.errors import ImageError, UsageError
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.plan import plan
from flasher.image.plausible import find_doubt
from flasher.protocol.messages import Packet, decode
from flasher.protocol.spec import BMS, PACKET_FILLER, WELLING
from tests.fuzz.harness import Choices, Harness, own_words, written
from tests.hostile.files import SAMPLES
from tests.protocol.cases import feed_all, make_reassembler, messages_of

_PLANNED_MAX: Final = 600
"""Bytes of an image whose packets are checked: gaps are filled, to many times an input's size."""
_RAW: Final = 1 << 7
"""Flag of an input: the file is all that follows."""


def _check(image: Image) -> None:
    """An image is sent as it was read, and reads again as it was."""
    find_doubt(image)
    assert image.named_targets is not None
    assert len(image.data) == sum(span.size_bytes for span in image.segments) + image.filled_bytes
    path = written(image.data, ".again")
    with own_words():
        again = load(path, format="bin", base=image.base, allow_outside_vector=True)
    assert (again.data, again.base, again.version) == (image.data, image.base, image.version)
    if image.size_bytes > _PLANNED_MAX:
        return
    planned, sent = plan(image, BMS, WELLING.bitrate_bps), b""
    reassembler = make_reassembler(BMS.request_id)
    for number in range(1, planned.total_packets + 1):
        payloads = (frame.data for frame in planned.packet_frames(number))
        packets = list(map(decode, messages_of(feed_all(reassembler, payloads))))
        assert len(packets) == 1
        packet = packets[0]
        assert isinstance(packet, Packet)
        assert (packet.number, packet.total) == (number, planned.total_packets)
        sent += packet.payload
    assert sent.startswith(image.data)
    assert not sent[image.size_bytes :].strip(bytes((PACKET_FILLER,)))


def take_any(data: bytes) -> None:
    """A file of any format, with options."""
    choices = Choices(data)
    options = choices.byte()
    base = choices.number(4) if options & 1 else None
    start = choices.number(4) if options & 2 else 0
    range_ = (start, start + choices.number(3)) if options & 2 else None
    suffix = (".bin", ".hex", ".s19", ".elf")[options >> 2 & 3]
    _check(
        load(
            written(choices.rest(), suffix),
            base=base,
            range_=range_,
            fill_gaps_up_to=0 if options & 16 else 256,
            allow_outside_vector=bool(options & 32),
        )
    )


def take_elf(data: bytes) -> None:
    _check(load(written(data, ".elf"), format="elf"))


def _take_records(name: str, lines: Callable[[Choices], Iterator[bytes]], data: bytes) -> None:
    choices = Choices(data)
    flags = choices.byte()
    content = choices.rest() if flags & _RAW else b"\n".join(lines(choices))
    window = (0x1000, 0x2000) if flags & 1 else None
    file = written(content, f".{name}")
    _check(load(file, format=name, range_=window, allow_outside_vector=bool(flags & 2)))


def _hex_lines(choices: Choices) -> Iterator[bytes]:
    """Records of a size, a type, an address and data; the end is written too."""
    while choices:
        size, kind, address = choices.byte() % 64, choices.byte() % 7, choices.take(2)
        content = choices.take(size)
        record = bytes((len(content), *address.rjust(2, b"\0"), kind)) + content
        yield b":" + (record + bytes((-sum(record) & 0xFF,))).hex().encode()
    yield b":00000001FF"


def _srec_lines(choices: Choices) -> Iterator[bytes]:
    sizes = {b"0": 2, b"1": 2, b"2": 3, b"3": 4, b"5": 2, b"6": 3, b"7": 4, b"8": 3, b"9": 2}
    while choices:
        size, kind = choices.byte() % 64, b"%d" % (choices.byte() % 10)
        body = choices.take(sizes.get(kind, 2)) + choices.take(size)
        record = bytes((len(body) + 1,)) + body
        yield b"S" + kind + (record + bytes((~sum(record) & 0xFF,))).hex().encode()
    yield b"S9030000FC"


def _hex_seeds() -> Iterator[bytes]:
    lines = (SAMPLES / "wmc.hex").read_bytes().splitlines(keepends=True)
    yield bytes((_RAW,)) + b"".join([*lines[:20], lines[-1]])
    yield bytes((_RAW,)) + b"".join(lines[:5])
    records = b""
    for line in lines[:20]:
        record = bytes.fromhex(line.strip()[1:].decode())
        records += bytes((record[0], record[3])) + record[1:3] + record[4:-1]
    yield b"\0" + records
    yield b"\0" + records + records
    for kind in (2, 4):  # addresses of both kinds; a record across 64 KiB
        yield bytes((2, 2, kind, 0, 0, 0x10, 0, 4, 0, 0xFF, 0xFE, 1, 2, 3, 4))


def _srec_seeds() -> Iterator[bytes]:
    lines = (SAMPLES / "wmc.s19").read_bytes().splitlines(keepends=True)
    yield bytes((_RAW,)) + b"".join([*lines[:20], lines[-1]])
    yield bytes((_RAW,)) + b"".join(lines[:5])
    for kind, address in ((1, b"\x10\0"), (2, b"\0\x10\0"), (3, b"\0\0\x10\0")):
        data = bytes(range(16))
        yield b"\3" + bytes((16, kind)) + address + data
        yield b"\0" + bytes((2, 0)) + b"\0\0hi" + bytes((16, kind)) + address + data
        yield b"\2" + bytes((4, kind)) + address + data[:4] + bytes((0, 5, 0, 1))


def _elf_seeds() -> Iterator[bytes]:
    yield (SAMPLES / "obc.elf").read_bytes()
    for path in sorted((SAMPLES / "bad").glob("*.elf")):
        yield path.read_bytes()


def _seeds() -> Iterator[bytes]:
    firmware = (SAMPLES / "obc.bin").read_bytes()
    yield b"\0" + firmware
    yield b"\x20" + firmware
    yield b"\x23" + bytes.fromhex("08002000 08002100 000100") + firmware
    yield b"\1" + bytes.fromhex("08002000") + firmware
    yield b"\x0c" + (SAMPLES / "obc.elf").read_bytes()
    for option, name in ((4, "wmc.hex"), (8, "wmc.s19")):
        lines = (SAMPLES / name).read_bytes().splitlines(keepends=True)
        yield bytes((option,)) + b"".join([*lines[:20], lines[-1]])
    for path in sorted((SAMPLES / "bad").iterdir()):
        yield b"\0" + path.read_bytes()[:4000]


_BELOW: Final = "flasher.image.load._check_options"
_ALLOWED: Final = (ImageError, UsageError)


HARNESSES: Final = {
    "image": Harness(take_any, _seeds, _BELOW, _ALLOWED, max_size=6000),
    "image-hex": Harness(partial(_take_records, "hex", _hex_lines), _hex_seeds, _BELOW, _ALLOWED),
    "image-srec": Harness(
        partial(_take_records, "srec", _srec_lines), _srec_seeds, _BELOW, _ALLOWED
    ),
    "image-elf": Harness(take_elf, _elf_seeds, _BELOW, _ALLOWED, max_size=6000),
}
