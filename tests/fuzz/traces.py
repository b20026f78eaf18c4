"""Harnesses of trace files, one for each format but .mf4: another process reads that, in C."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from flasher.errors import UsageError
from flasher.protocol.frame import EXTENDED_ID_MAX, Frame
from flasher.python_can import can
from flasher.trace.reader import read_trace
from flasher.trace.recorder import message_of, writer_of
from flasher.trace.source import frames_until_damage
from tests.fuzz.harness import Harness, own_folder, own_words, written
from tests.hostile import good

_WRITTEN: Final = (".db", ".log", ".pcapng")
"""Formats that flasher writes itself: what was read of one is written, and read again."""
_PACKED: Final = b"\x1f\x8b"


def take_trace(suffix: str, data: bytes) -> None:
    damage: list[str] = []
    timed = list(frames_until_damage(written(data, suffix), damage))
    for at_s, frame in timed:
        assert math.isfinite(at_s)
        assert 0 <= frame.can_id <= EXTENDED_ID_MAX
        assert len(frame.data) <= 8
        assert not frame.is_echo
    assert all(text.isprintable() for text in damage)
    if suffix in _WRITTEN and timed:
        path = written(b"", f".again{suffix}")
        writer = writer_of(path)
        for _, frame in timed:
            writer(message_of(frame, sent=False, at_s=1.0))
        writer.stop()
        with own_words():
            assert [frame for _, frame in read_trace(path)] == [frame for _, frame in timed]


def take_packed(data: bytes) -> None:
    """A packed log, or the text that the harness packs."""
    is_packed = data.startswith(_PACKED)
    take_trace(".log.gz", data if is_packed else gzip.compress(data, 1))


def _recorded(suffix: str) -> Iterator[bytes]:
    folder = own_folder()
    special = (
        Frame(0x18DA00F1, b"\1", is_extended=True),
        Frame(0x725, b"", is_remote=True),
        Frame(0, b"", is_error=True),
        Frame(0x725, b""),
    )
    frames = good.FRAMES if suffix == ".trc" else (*special, *good.FRAMES)
    yield good.trace(folder / f"trace{suffix}", frames)
    yield good.trace(folder / f"short{suffix}", good.FRAMES[:2])


def _blf() -> Iterator[bytes]:
    yield from _recorded(".blf")
    path = own_folder() / "plain.blf"
    with can.BLFWriter(path, compression_level=0, max_container_size=100) as writer:
        for frame in good.FRAMES:
            writer(message_of(frame, sent=True, at_s=1.7e9))
    yield path.read_bytes()


def _packed() -> Iterator[bytes]:
    for text in _recorded(".log"):
        yield text
        yield gzip.compress(text)


def _pcap() -> Iterator[bytes]:
    from tests.trace.test_pcapng import pcap  # noqa: PLC0415

    yield pcap("<", 0xA1B2C3D4)
    yield pcap(">", 0xA1B23C4D)


def _trace(
    suffix: str,
    seeds: Callable[[], Iterator[bytes]] | None = None,
    *,
    max_size: int = 4096,
) -> Harness:
    return Harness(
        partial(take_trace, suffix),
        seeds or partial(_recorded, suffix),
        "flasher.trace.reader.Bounds",
        (UsageError,),
        max_size,
    )


HARNESSES: Final = {
    "trace-asc": _trace(".asc"),
    "trace-blf": _trace(".blf", _blf),
    "trace-csv": _trace(".csv"),
    "trace-db": _trace(".db", max_size=16_384),
    "trace-log": _trace(".log"),
    "trace-pcap": _trace(".pcap", _pcap),
    "trace-pcapng": _trace(".pcapng"),
    "trace-trc": _trace(".trc"),
    "trace-gz": Harness(take_packed, _packed, "flasher.trace.reader.Bounds", (UsageError,)),
}
