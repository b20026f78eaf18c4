"""Captures of Wireshark: what is read of them, and what is written. The blocks are typed here from
the formats' descriptions, in both orders of bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.protocol.frame import Frame
from flasher.trace.pcapng import PcapngWriter
from flasher.trace.reader import read_trace
from flasher.trace.recorder import Recorder, message_of

PACKET = struct.pack(">LB3x", 0x752, 2) + b"ab"
FRAME = Frame(0x752, b"ab")


def block(kind: int, body: bytes, order: str = "<") -> bytes:
    body += bytes(-len(body) % 4)
    size = struct.pack(f"{order}L", len(body) + 12)
    return struct.pack(f"{order}L", kind) + size + body + size


def section(order: str = "<") -> bytes:
    return block(0x0A0D0D0A, struct.pack(f"{order}LHHq", 0x1A2B3C4D, 1, 0, -1), order)


def interface(link_type: int = 227, options: bytes = b"", order: str = "<") -> bytes:
    return block(1, struct.pack(f"{order}HHL", link_type, 0, 0) + options, order)


def packet(
    data: bytes = PACKET, *, number: int = 0, units: int = 5_000_000, order: str = "<"
) -> bytes:
    high, low = units >> 32, units & 0xFFFFFFFF
    head = struct.pack(f"{order}5L", number, high, low, len(data), len(data))
    return block(6, head + data, order)


def pcap(order: str, magic: int, *, link_type: int = 227) -> bytes:
    head = struct.pack(f"{order}LHHlLLL", magic, 2, 4, 0, 0, 65535, link_type)
    return head + struct.pack(f"{order}4L", 5, 250_000, len(PACKET), len(PACKET)) + PACKET


def read(path: Path, data: bytes) -> list[tuple[float, Frame]]:
    path.write_bytes(data)
    return list(read_trace(path))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "trace.pcapng"


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_capture_is_read_in_either_order_of_bytes(path: Path, order: str) -> None:
    data = section(order) + interface(order=order) + packet(order=order)
    assert read(path, data) == [(5.0, FRAME)]


@pytest.mark.parametrize(
    ("options", "units", "at_s"),
    [
        (struct.pack("<HHB3x", 9, 1, 9), 5 * 10**9, 5.0),
        (struct.pack("<HHB3x", 9, 1, 0x80 | 10), 5 * 1024, 5.0),
        (struct.pack("<HHqL", 14, 8, 1000, 0), 5 * 10**6, 1005.0),
        (struct.pack("<HH4sL", 2, 4, b"can0", 0), 5 * 10**6, 5.0),
        (struct.pack("<HHB3x", 9, 1, 6), 1_700_000_000_000_000, 1.7e9),
    ],
)
def test_times_are_read_as_the_interface_states(
    path: Path, options: bytes, units: int, at_s: float
) -> None:
    data = section() + interface(options=options) + packet(units=units)
    assert [at for at, _ in read(path, data)] == [at_s]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("magic", [0xA1B2C3D4, 0xA1B23C4D])
@pytest.mark.parametrize("suffix", [".pcap", ".pcapng"])
def test_an_old_capture_is_read_whatever_its_suffix(
    tmp_path: Path, order: str, magic: int, suffix: str
) -> None:
    ((at_s, frame),) = read(tmp_path / f"trace{suffix}", pcap(order, magic))
    assert frame == FRAME
    assert at_s == pytest.approx(5.25 if magic == 0xA1B2C3D4 else 5.00025)


def test_frames_of_can_fd_and_xl_blocks_and_packets_of_others_are_passed_over(path: Path) -> None:
    fd = struct.pack(">LBB2x", 0x752, 2, 0x04) + b"ab"
    long_fd = struct.pack(">LB3x", 0x752, 12) + bytes(12)
    xl = struct.pack(">LBB2x", 0x752, 0x80, 0) + bytes(8)
    data = section() + interface(1) + interface() + block(5, bytes(12)) + block(0xBAD, b"x")
    data += packet(b"ethernet" * 8) + b"".join(packet(each, number=1) for each in (fd, long_fd, xl))
    assert read(path, data + packet(number=1)) == [(5.0, FRAME)]


def test_the_flags_of_an_identifier_are_read(path: Path) -> None:
    kinds = [
        packet(struct.pack(">LB3x", 1 << 31 | 0x18DA00F1, 1) + b"x"),
        packet(struct.pack(">LB3x", 1 << 30 | 0x725, 8)),
        packet(struct.pack(">LB3x", 1 << 29 | 0x80, 8) + bytes(8)),
    ]
    assert [frame for _, frame in read(path, section() + interface() + b"".join(kinds))] == [
        Frame(0x18DA00F1, b"x", is_extended=True),
        Frame(0x725, b"", is_remote=True),
        Frame(0x80, bytes(8), is_error=True),
    ]


def test_what_holds_nothing_is_a_trace_without_frames(path: Path) -> None:
    assert read(path, b"") == []
    assert read(path, section()) == []
    assert read(path, section() + interface()) == []


WHOLE = section() + interface() + packet()


@pytest.mark.parametrize(
    ("data", "reported"),
    [
        (section() + interface(1) + packet(bytes(60)), "link type 1 (Ethernet), not 227"),
        (pcap("<", 0xA1B2C3D4, link_type=113), 'link type 113 (Linux "any"), not 227'),
        (section() + interface() * 2 + packet() + packet(number=1), "more than one CAN interface"),
        (WHOLE[:-2], "ends within a block"),
        (WHOLE[: len(section()) + 6], "ends within a block"),
        (WHOLE + packet(number=7), "of no interface"),
        (section() + packet(), "of no interface"),
        (WHOLE + block(6, bytes(16)), "of no interface"),
        (WHOLE + block(6, bytes(8)), "a block is too short"),
        (section() + block(1, b""), "a block is too short"),
        (section() + interface() + block(3, bytes(4) + PACKET), "packets have no times"),
        (section() + interface() + packet(b"abc"), "too short for a CAN frame"),
        (section() + interface() + packet(PACKET[:-1]), "is cut off"),
        (WHOLE + struct.pack("<LL", 7, 11), "a size of 11 bytes"),
        (WHOLE + struct.pack("<LL", 7, 0xFFFFFFFC), "a size of 4,294,967,"),
        (struct.pack("<LLL", 0x0A0D0D0A, 28, 0x01020304), "no byte order"),
        (b"this is no capture, whatever its name says", "does not begin as a capture"),
        (pcap("<", 0xA1B2C3D4)[:-20], "ends within a packet"),
        (pcap("<", 0xA1B2C3D4)[:20], "does not begin as a capture"),
    ],
)
def test_what_cannot_be_read_is_reported_in_words(path: Path, data: bytes, reported: str) -> None:
    path.write_bytes(data)
    with pytest.raises(UsageError) as caught:
        list(read_trace(path))
    assert reported in caught.value.cause


@pytest.mark.parametrize(
    ("data", "remedy"),
    [
        (section() + interface(1) + packet(bytes(60)), "Capture on the CAN interface itself"),
        (section() + interface() * 2 + packet() + packet(number=1), "frame.interface_id==0"),
    ],
)
def test_a_right_capture_of_something_else_is_not_blamed_for_its_suffix(
    path: Path, data: bytes, remedy: str
) -> None:
    path.write_bytes(data)
    with pytest.raises(UsageError, match="is not a trace of one CAN bus") as caught:
        list(read_trace(path))
    assert remedy in caught.value.remedy


def test_what_comes_before_a_cut_is_read(path: Path) -> None:
    path.write_bytes(WHOLE + packet()[:-3])
    found: list[Frame] = []
    with pytest.raises(UsageError, match="is not a trace") as caught:
        found.extend(frame for _, frame in read_trace(path))
    assert found == [FRAME]
    assert caught.value.where == "after frame 1"


FRAMES = [
    (FRAME, True),
    (Frame(0x18DA00F1, b"12345678", is_extended=True), False),
    (Frame(0x725, b"", is_remote=True), False),
    (Frame(0x80, bytes(8), is_error=True), False),
    (Frame(0x725, b""), False),
]


def test_what_is_written_is_read_again(path: Path) -> None:
    writer = PcapngWriter(path, "of the file: é")
    for number, (frame, sent) in enumerate(FRAMES):
        writer(message_of(frame, sent=sent, at_s=1.7e9 + number), "odd" * number)
    writer.stop()
    assert list(read_trace(path)) == [(1.7e9 + at, frame) for at, (frame, _) in enumerate(FRAMES)]
    raw = path.read_bytes()
    assert "of the file: é".encode() in raw
    assert b"oddodd" in raw


@pytest.mark.parametrize("make", [PcapngWriter, Recorder])
def test_a_folder_is_no_file_to_write(tmp_path: Path, make: Callable[[Path], object]) -> None:
    folder = tmp_path / "folder.pcapng"
    folder.mkdir()
    with pytest.raises((OSError, UsageError), match="directory"):
        make(folder)


def test_a_disk_that_fills_up_ends_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "full.pcapng"
    path.symlink_to("/dev/full")
    with Recorder(path) as recorder:
        for number in range(1000):
            recorder(FRAME, sent=True, now=float(number))
    assert recorder.failure == "No space left on device"
