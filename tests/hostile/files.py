"""Files that are made to hurt whoever reads them, and what a command has to say to each."""

from __future__ import annotations

import gzip
import os
import shutil
import socket
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

SAMPLES = Path(__file__).parents[2] / "firmware_samples"
MEGA = 1 << 20
IMAGE_MAX = 8_388_480

USAGE, IMAGE = 2, 3
FRAME = "(1.0) can0 752#55AA110234007A11"
GOOD_LOG = b"(1.0) can0 752#55AA110234007A11\n(1.1) can0 725#55AA0C0455030041\n"


@dataclass(frozen=True)
class Row:
    """`make` lays the file `name` into a folder; a command with it in place of FILE has to end with
    `code` and print `reported`, on stderr unless it ends well.
    """

    name: str
    make: Callable[[Path], object]
    command: str
    code: int
    reported: str


def content(data: bytes | Callable[[], bytes]) -> Callable[[Path], object]:
    """A file of these bytes; of a function where they take a while to make."""
    return lambda path: path.write_bytes(data if isinstance(data, bytes) else data())


def repeated(piece: bytes, size: int, end: bytes = b"") -> Callable[[Path], object]:
    """A file of `size` bytes, written a megabyte at a time."""

    def make(path: Path) -> None:
        block = piece * max(1, MEGA // len(piece))
        with path.open("wb") as file:
            for _ in range(size // len(block)):
                file.write(block)
            file.write(end)

    return make


def sparse(size: int, head: bytes = b"") -> Callable[[Path], object]:
    def make(path: Path) -> None:
        path.write_bytes(head)
        os.truncate(path, size)

    return make


def deflated(piece: bytes, times: int) -> bytes:
    """So many pieces without header and check sum, of which only the first one is compressed."""
    packer = zlib.compressobj(1, wbits=-zlib.MAX_WBITS)
    once = packer.compress(piece) + packer.flush(zlib.Z_FULL_FLUSH)
    return once * times + packer.flush()


def packed(piece: bytes, size: int) -> Callable[[Path], object]:
    """More than is read of it, so that its check sum may be wrong."""

    def make(path: Path) -> None:
        block = piece * max(1, MEGA // len(piece))
        path.write_bytes(gzip.compress(b"")[:10] + deflated(block, size // len(block)) + bytes(8))

    return make


def link(to: str | Path) -> Callable[[Path], object]:
    return lambda path: path.symlink_to(to)


def bound_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


# -- captures -------------------------------------------------------------------------------------


def block(kind: int, body: bytes, at: int = 0) -> bytes:
    """A block of a .pcapng; of a packet (kind 6) the bytes from `at` on, else everything."""
    if kind == 6:
        packet = bytearray(struct.pack("<5L", 0, 0, 0, 9, 9) + b"\0\0\7\x52\1\0\0\0\xaa\0\0\0")
        packet[at : at + len(body)] = body
        body = bytes(packet)
    size = struct.pack("<L", len(body) + 12)
    return struct.pack("<L", kind) + size + body + size


def pcapng(blocks: bytes, resolution: int = 0) -> bytes:
    """A .pcapng with a section and a CAN interface, whose times have this resolution."""
    section = block(0x0A0D0D0A, struct.pack("<LHHq", 0x1A2B3C4D, 1, 0, -1))
    interface = block(1, struct.pack("<HHLHHB3xL", 227, 0, 0, 9, 1, resolution, 0))
    return section + interface + blocks


# -- images ---------------------------------------------------------------------------------------


def elf(
    loads: list[tuple[int, int, int]], sections: list[tuple[int, int]], body: int = MEGA
) -> bytes:
    """An ELF file: segments (offset, address, size), loaded sections (offset, size)."""
    programs = b"".join(
        struct.pack("<8I", 1, offset, address, address, size, size, 5, 4)
        for offset, address, size in loads
    )
    table = b"".join(
        struct.pack("<10I", 0, 1, 2, 0, offset, size, 0, 0, 4, 0) for offset, size in sections
    )
    start = 52 + len(programs)
    head = struct.pack(
        "<16s2H5I6H", b"\x7fELF\x01\x01\x01", 2, 40, 1, 0, 52, start, 0, 52, 32, len(loads), 40,
        len(sections), 0,
    )  # fmt: skip
    whole = head + programs + table
    return whole + bytes(max(0, body - len(whole)))


def hex_record(kind: int, address: int, data: bytes) -> bytes:
    body = struct.pack(">BHB", len(data), address, kind) + data
    return b":" + body.hex().upper().encode() + b"%02X\n" % (-sum(body) & 0xFF)


def scattered(path: Path) -> None:
    """A byte here and there, from the top down, more of them than a linker makes pieces."""
    with path.open("wb") as file:
        for upper in range(0x0801, 0x07FE, -1):
            file.write(hex_record(4, 0, struct.pack(">H", upper)))
            file.writelines(hex_record(0, at, b"\x01") for at in range(0xFFFE, 0, -4))
        file.write(b":00000001FF\n")


def with_manifest(make: Callable[[Path], object]) -> Callable[[Path], object]:
    """An image, and a manifest beside it that `make` makes."""

    def both(path: Path) -> None:
        shutil.copy(SAMPLES / "station" / "bms.bin", path)
        make(path.with_name(f"{path.name}.toml"))

    return both


IMAGES = (
    Row("pipe.hex", os.mkfifo, "image-info FILE", USAGE, "not a regular file"),
    Row("socket.bin", bound_socket, "image-info FILE", USAGE, "not a regular file"),
    Row("zero.bin", link("/dev/zero"), "image-info FILE", USAGE, "not a regular file"),
    Row("terminal.bin", link("/dev/tty"), "image-info FILE", USAGE, "not a regular file"),
    Row("folder.bin", Path.mkdir, "image-info FILE", USAGE, "is a directory"),
    Row("loop.bin", link("loop.bin"), "image-info FILE", IMAGE, "symbolic links"),
    Row("nowhere.bin", link("none"), "image-info FILE", USAGE, "no file of this name"),
    Row("proc.bin", link("/proc/self/environ"), "image-info FILE", USAGE, "not a regular file"),
    Row("memory.bin", link("/proc/self/mem"), "image-info FILE", IMAGE, "cannot be read"),
    Row("blank.hex", repeated(b"\n", 100 * MEGA), "image-info FILE", IMAGE, "1,100,000 lines"),
    Row("blank.s19", repeated(b"\r\n", 4 * MEGA), "image-info FILE", IMAGE, "1,100,000 lines"),
    Row(
        "counts.s19",
        repeated(b"S5030000FC\n", 16 * MEGA),
        "image-info FILE",
        IMAGE,
        "1,100,000 lines",
    ),
    Row(
        "starts.hex",
        repeated(b":0400000508000000EF\n", 32 * MEGA),
        "image-info FILE",
        IMAGE,
        "1,100,000 lines",
    ),
    Row(
        "same.hex",
        repeated(hex_record(0, 0, bytes(16)), 16 * MEGA),
        "image-info FILE",
        IMAGE,
        "end record is missing",
    ),
    Row("nothing.hex", sparse(100 * MEGA, b":"), "image-info FILE", IMAGE, "longer than any"),
    Row("one_line.hex", repeated(b":00", 4 * MEGA), "image-info FILE", IMAGE, "longer than any"),
    Row("scattered.hex", scattered, "image-info FILE", IMAGE, "32768 separate pieces"),
    Row(
        "utf_16.hex",
        content((SAMPLES / "wmc.hex").read_text().encode("utf-16")),
        "image-info FILE",
        IMAGE,
        "damaged",
    ),
    Row("terabyte.bin", sparse(1 << 40, b"\x01"), "image-info FILE", IMAGE, "too large"),
    Row("terabyte.elf", sparse(1 << 40, b"\x7fELF"), "image-info FILE", IMAGE, "too large"),
    Row(
        "zeros.elf",
        sparse(100 * MEGA, b"\x7fELF\x01\x01\x01"),
        "image-info FILE",
        IMAGE,
        "no loadable segment",
    ),
    Row(
        "sections.elf",
        content(
            elf([(0, 0x0800_0000, IMAGE_MAX)], [(n, IMAGE_MAX - n) for n in range(4096)], IMAGE_MAX)
        ),
        "image-info --allow-implausible FILE",
        0,
        "8,388,480",
    ),
    Row(
        "segments.elf",
        content(
            elf(
                [(0, 0x0800_0000 + n * 8 * MEGA, 8 * MEGA) for n in range(64)],
                [(0, 8 * MEGA)],
                8 * MEGA,
            )
        ),
        "image-info FILE",
        IMAGE,
        "too large",
    ),
    Row(
        "same_place.elf",
        content(
            elf(
                [(n, 0x0800_0000, 4 * MEGA) for n in range(64)],
                [(n, MEGA) for n in range(64)],
                8 * MEGA,
            )
        ),
        "image-info FILE",
        IMAGE,
        "different bytes",
    ),
    Row(
        "sections_past.elf",
        content(elf([(0, 0, MEGA)], [(0, 0xFFFF_FFFF)])),
        "image-info FILE",
        IMAGE,
        "outside its program header",
    ),
    Row("bomb.hex", packed(b"\n", 60 * MEGA), "image-info FILE", IMAGE, "a gzip file"),
    Row(
        "a.bin",
        with_manifest(os.mkfifo),
        "flash FILE -t bms --mock --dry-run",
        USAGE,
        "not a regular file",
    ),
    Row(
        "b.bin",
        with_manifest(link("/dev/zero")),
        "flash FILE -t bms --mock --dry-run",
        USAGE,
        "not a regular file",
    ),
    Row(
        "c.bin",
        with_manifest(content(b"format = " + b"9" * 5000)),
        "flash FILE -t bms --mock --dry-run",
        IMAGE,
        "not a readable TOML file",
    ),
)


# -- settings -------------------------------------------------------------------------------------

TOML = (
    ("pipe", os.mkfifo, "not a regular file"),
    ("folder", Path.mkdir, "is a directory"),
    ("terabyte", sparse(1 << 40, b"a = 1\n"), "too large"),
    ("digits", content(b"attempts = " + b"9" * 5000), "not a readable TOML file"),
    ("hex_digits", content(b"attempts = 0x" + b"f" * 5000), "not a readable TOML file"),
    ("deep", content(b"attempts = " + b"[" * 100_000), "not a readable TOML file"),
    (
        "deep_tables",
        content(b"attempts = " + b"{a=" * 300 + b"1" + b"}" * 300),
        "not a readable TOML file",
    ),
    ("deep_key", content(b"a." * 100_000 + b"a = 1\n"), "not a readable TOML file"),
    (
        "deep_texts",
        content(('"\u2028".' * 20_000 + "a = 1\n").encode()),
        "not a readable TOML file",
    ),
    (
        "deep_keys",
        content(b"".join(b"[k%d%s]\n" % (n, b".a" * 125) for n in range(900))),
        "not a readable TOML file",
    ),
    ("unterminated", content(b'notes = "' + b"x" * 200_000), "not a readable TOML file"),
    ("long_text", content(b'notes = "' + b"x" * 200_000 + b'"\n'), ""),
    ("nul", content(b"attempts = 1\0\n"), "not a readable TOML file"),
    ("utf_16", content("attempts = 3\n".encode("utf-16")), "not a readable TOML file"),
    ("escape", content(b'"\\u001b[2J\\u202e" = 1\n'), ""),
    ("surrogate", content(b'a = "\\ud800"\n'), "not a readable TOML file"),
)


def settings(command: str, code: int, *, some: int = 1) -> Iterator[Row]:
    """The same bad settings for each command that reads some, or every `some`-th of them; what is
    no file is wrong usage.
    """
    for name, make, reported in TOML[::some]:
        usage = {"pipe": USAGE, "folder": USAGE}.get(name, code)
        yield Row(f"{name}.toml", make, command, usage, reported)


def bundle(
    trace: Callable[[Path], object], report: Callable[[Path], object] | None = None
) -> Callable[[Path], object]:
    def make(path: Path) -> None:
        path.mkdir()
        trace(path / "trace.log")
        if report is not None:
            report(path / "report.json")

    return make


SETTINGS = (
    *settings("profile check FILE", USAGE),
    *settings(f"flash {SAMPLES}/bms.bin -t bms --mock --dry-run --profile FILE", USAGE, some=4),
    *settings(f"manifest check {SAMPLES}/bms.bin -t bms --manifest FILE", IMAGE, some=4),
    *settings("conformance -t bms --mock --case RS-01 --profile FILE", USAGE, some=4),
    *settings("station check FILE", USAGE),
    *settings(f"station check {SAMPLES}/station/recipe.toml --sockets FILE", USAGE, some=4),
)
SCANS = tuple(
    Row(
        name,
        make,
        f"station run --recipe {SAMPLES}/station/recipe.toml --mock-sockets 1 "
        "--database records.sqlite --scans FILE",
        USAGE,
        reported,
    )
    for name, make, reported in (
        ("pipe.txt", os.mkfifo, "not a regular file"),
        ("zero.txt", link("/dev/zero"), "not a regular file"),
        ("terabyte.txt", sparse(1 << 40), "too large"),
        ("utf_16.txt", content("BAT2620-0001\n".encode("utf-16")), "not a text file"),
    )
)


# -- reports --------------------------------------------------------------------------------------


def report_with(number: str) -> bytes:
    return (
        '{"report_schema": 1, "target": "bms", "bitrate_bps": 250000, "seed": 1, "profile": {}, '
        '"timestamp_source": "", "profile_source": "", "cases": [], "results": [], "times": '
        f'[{{"name": "a", "count": {number}, "median_s": {number}, "p95_s": 1, '
        '"uncertainty_s": 1}]}'
    ).encode()


REPORTS = tuple(
    Row(name, make, "conformance diff FILE FILE", USAGE, reported)
    for name, make, reported in (
        ("pipe.json", os.mkfifo, "not a regular file"),
        ("terabyte.json", sparse(1 << 40), "too large"),
        ("deep.json", content(b"[" * 100_000), "not valid JSON"),
        (
            "deep_value.json",
            content(b'{"report_schema": ' + b"[" * 900 + b"]" * 900 + b"}"),
            "not valid JSON",
        ),
        ("infinite.json", content(report_with("1e999")), "not finite"),
        ("nan.json", content(report_with("NaN")), "not finite"),
        ("digits.json", content(report_with("9" * 5000)), "not valid JSON"),
        ("large.json", content(report_with("9" * 1000)), "bits"),
        ("objects.json", content(b"[" + b"{}," * (6 * MEGA // 3 - 2) + b"1]"), "no conformance"),
        ("nul.json", content(b"\0" * 100), "not valid JSON"),
    )
)


# -- traces ---------------------------------------------------------------------------------------


def blf(inner: bytes, times: int = 1, packed_as: int = 2) -> bytes:
    """A .blf file with one container that holds `inner` so many times."""
    held = inner
    if packed_as == 2:
        check_sum = reduce(lambda so_far, _: zlib.adler32(inner, so_far), range(times), 1)
        held = zlib.compress(b"", 1)[:2] + deflated(inner, times) + struct.pack(">L", check_sum)
    container = struct.pack("<H6xL4x", packed_as, len(inner)) + held
    return (
        struct.pack("<4sL", b"LOGG", 144)
        + bytes(136)
        + struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(container), 10)
        + container
        + bytes(len(container) % 4)
    )


def blf_object(kind: int, size: int, time_ns: int = 0, body: bytes = bytes(16)) -> bytes:
    head = struct.pack("<4sHHLL", b"LOBJ", 32, 1, size, kind)
    return head + struct.pack("<LHHQ", 2, 0, 0, time_ns) + body


def database(rows: list[tuple[object, ...]], schema: str = "") -> Callable[[Path], object]:
    plain = (
        "CREATE TABLE messages (ts REAL, arbitration_id INTEGER, extended INTEGER, remote INTEGER,"
        " error INTEGER, dlc INTEGER, data BLOB)"
    )

    def make(path: Path) -> None:
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.execute(schema or plain)
            if rows:
                connection.executemany("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)", rows)

    return make


def view(at: str) -> str:
    return (
        "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
        "SELECT {at} AS ts, 1 AS arbitration_id, 0 AS extended, 0 AS remote, 0 AS error, 0 AS dlc, "
        "x'00' AS data FROM n".replace("{at}", at)
    )


GOOD_ROW = (1.0, 0x752, 0, 0, 0, 2, b"\x55\xaa")
ASC_HEAD = b"date Sat Nov 21 10:00:00 2026\nbase hex timestamps absolute\ninternal events logged\n"
CSV_HEAD = b"timestamp,arbitration_id,extended,remote,error,dlc,data\n"
TRC_HEAD = b";$FILEVERSION=1.1\n;$STARTTIME=45000.5\n"


def several(*lines: str) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode()


TRACES = tuple(
    Row(name, make, "explain FILE", code, reported)
    for name, make, code, reported in (
        ("pipe.asc", os.mkfifo, USAGE, "not a regular file"),
        ("zero.log", link("/dev/zero"), USAGE, "not a regular file"),
        ("loop.log", link("loop.log"), USAGE, "symbolic links"),
        ("proc.log", link("/proc/self/environ"), USAGE, "not a regular file"),
        ("none.db", link("none"), USAGE, "no file of this name"),
        ("terabyte.log", sparse(1 << 40), USAGE, "too large"),
        ("nothing.log", sparse(500 * MEGA), USAGE, "longer than"),
        ("nul.asc", content(ASC_HEAD + b"\0" * 1000 + b"\n"), USAGE, "NUL"),
        ("utf_16.log", content(GOOD_LOG.decode().encode("utf-16")), USAGE, "not a trace"),
        (
            "utf_16.asc",
            content((ASC_HEAD + b"x\n").decode().encode("utf-16")),
            USAGE,
            "not a trace",
        ),
        ("random.trc", content(bytes(range(255, 0, -1)) * 100), USAGE, "not a trace"),
        # Times.
        ("infinite.log", content(several("(inf) can0 752#00", FRAME)), USAGE, "the time inf"),
        (
            "minus.log",
            content(several(FRAME, "(-inf) can0 752#00")),
            0,
            "after frame 1: a frame has the time -inf",
        ),
        ("nan.log", content(several("(nan) can0 752#00", FRAME)), USAGE, "the time nan"),
        ("year.log", content(several("(1e17) can0 752#00")), USAGE, "the time 1e+17"),
        ("back.log", content(several("(1e10) can0 752#00", FRAME)), 0, "2 frames"),
        (
            "negative.csv",
            content(CSV_HEAD + b"-5.5,0x752,0,0,0,1,AA==\n1,0x752,0,0,0,1,AA==\n"),
            0,
            "2 frames",
        ),
        ("infinite.csv", content(CSV_HEAD + b"inf,0x752,0,0,0,1,AA==\n"), USAGE, "the time inf"),
        ("huge.asc", content(ASC_HEAD + b"9" * 400 + b".0 1 752 Rx d 1 00\n"), USAGE, "time inf"),
        (
            "digits.asc",
            content(ASC_HEAD + b"1.0 " + b"1" * 60_000 + b" 752 Rx d 1 00\n"),
            0,
            "no frame",
        ),
        (
            "start.trc",
            content(b";$FILEVERSION=1.1\n;$STARTTIME=1e300\n1) 0.0 Rx 0752 1 00\n"),
            USAGE,
            "not a trace",
        ),
        ("offset.trc", content(TRC_HEAD + b"1) nan Rx 0752 1 00\n"), USAGE, "the time nan"),
        ("time.db", database([(1e300, *GOOD_ROW[1:])]), USAGE, "the time 1e+300"),
        # Frames that no bus has.
        ("id.log", content(several(f"(1.0) can0 {'C' * 60_000}#00")), 0, "0CCCCCCC"),
        ("id.csv", content(CSV_HEAD + b"1.0,-0x1,0,0,0,1,AA==\n"), USAGE, "the id -0x1"),
        (
            "id.asc",
            content(ASC_HEAD + b"1.0 1 " + b"F" * 60_000 + b"x Rx d 1 00\n"),
            USAGE,
            "the id 0xff",
        ),
        ("id.db", database([(1.0, 1 << 40, 0, 0, 0, 0, b"")]), USAGE, "the id 0x10000000000"),
        ("long.log", content(several(f"(1.0) can0 752#{'00' * 20_000}", FRAME)), 0, "1 frame"),
        ("null.db", database([GOOD_ROW, (None,) * 7]), 0, "lacks its time"),
        ("first_null.db", database([(None,) * 7]), USAGE, "lacks its time"),
        ("text.db", database([("now", 1, 0, 0, 0, 0, "x")]), USAGE, "lacks its time"),
        # What fills the memory, or never ends.
        ("newlines.log.gz", packed(b"\n", 60 * MEGA), USAGE, "unpacks to more"),
        ("frames.log.gz", packed(b"(1.0) can0 123#00\n", 60 * MEGA), USAGE, "unpacks to more"),
        ("one_line.asc.gz", packed(b"x", 60 * MEGA), USAGE, "unpacks to more"),
        ("blank.log", repeated(b"\n", MEGA), USAGE, "entries hold 0 frames"),
        ("comments.asc", repeated(b"// nothing\n", 4 * MEGA), USAGE, "entries hold 0 frames"),
        ("cut.log.gz", content(gzip.compress(GOOD_LOG * 1000)[:-20]), 0, "EOFError"),
        ("members.log.gz", content(lambda: gzip.compress(b"") * 200_000), 0, "no frame"),
        ("bomb.blf", content(lambda: blf(bytes(MEGA), 300)), USAGE, "unpacks to more"),
        (
            "bomb_of_frames.blf",
            content(lambda: blf(blf_object(1, 48) * 10_000, 200)),
            USAGE,
            "unpacks to more",
        ),
        (
            "bomb_of_objects.blf",
            content(lambda: blf(blf_object(7, 48) * 10_000, 200)),
            USAGE,
            "unpacks to more",
        ),
        (
            "bomb.blf.gz",
            content(lambda: gzip.compress(blf(blf_object(1, 48) * 10_000, 200))),
            USAGE,
            "unpacks to more",
        ),
        ("no_size.blf", content(blf(blf_object(1, 0))), USAGE, "a size of 0 bytes"),
        ("no_size_either.blf", content(blf(blf_object(7, 0))), USAGE, "a size of 0 bytes"),
        ("gigabyte.blf", content(blf(blf_object(7, 0xFFFF_FFFF))), USAGE, "4,294,967,295 bytes"),
        (
            "never_whole.blf",
            content(blf(blf_object(7, 16 * MEGA)) + blf(b"LOBJ")[144:] * 100_000),
            USAGE,
            "not a trace",
        ),
        ("plain.blf", content(blf(blf_object(1, 48), packed_as=0)), 0, "1 frame"),
        (
            "header.blf",
            content(struct.pack("<4sL", b"LOGG", 0xFFFF_FFFF) + bytes(200)),
            USAGE,
            "no header",
        ),
        ("negative.blf", content(struct.pack("<4sL", b"LOGG", 1) + bytes(200)), USAGE, "no header"),
        ("endless.db", database([], view("i")), USAGE, "not contain the table"),
        ("silent.db", database([], view("count(*)")), USAGE, "not contain the table"),
        ("blob.db", database([(1.0, 1, 0, 0, 0, 0, bytes(10 * MEGA))]), USAGE, "too big"),
        ("folder.db", bundle(os.mkfifo), USAGE, "not a bundle"),
        ("journal.db", content(b"SQLite format 3\0" + bytes(84)), USAGE, "not a trace"),
        ("table.db", database([], "CREATE TABLE other (a)"), USAGE, "not contain the table"),
        ("empty.db", content(b""), USAGE, "not contain the table"),
        (
            "columns.trc",
            content(b";$FILEVERSION=2.1\n;$COLUMNS=" + b"N," * 30_000 + b"N\n"),
            USAGE,
            "not a trace",
        ),
        (
            "length.trc",
            content(TRC_HEAD + b"1) 0.0 Rx 0752 99999999999 00\n" * 1000),
            0,
            "no frame",
        ),
        (
            "gigabyte.pcapng",
            content(pcapng(struct.pack("<LL", 9, 0xFFFF_FFFC))),
            USAGE,
            "4,294,967",
        ),
        (
            "idle.pcapng",
            content(pcapng(block(9, b"") * 110_000)),
            USAGE,
            "entries hold 0 frames",
        ),
        ("time.pcapng", content(pcapng(block(6, b"\xff" * 8, at=4))), USAGE, "the time 1.8"),
        (
            "resolution.pcapng",
            content(pcapng(block(6, b"\x01" * 8, at=4), resolution=0xFF)),
            0,
            "1 frame",
        ),
        ("bomb.pcapng.gz", packed(block(9, bytes(1000)), 400 * MEGA), USAGE, "unpacks to more"),
        (
            "ids.log",
            content(several(*(f"(1.0) can0 {n:08X}#" for n in range(40_000)))),
            0,
            "ids more",
        ),
        # Bundles.
        ("bundle", bundle(content(GOOD_LOG), os.mkfifo), USAGE, "not the report"),
        (
            "bundle_json",
            bundle(content(GOOD_LOG), content(b"[" * 100_000)),
            USAGE,
            "not the report",
        ),
        (
            "bundle_nan",
            bundle(content(GOOD_LOG), content(b'{"written_at": 1e999}')),
            USAGE,
            "not the report",
        ),
        ("bundle_far", bundle(content(GOOD_LOG), content(b'{"written_at": 1e300}')), 0, "2 frames"),
        ("bundle_link", bundle(link("/dev/zero")), USAGE, "not a bundle"),
    )
)

MONITOR = (
    Row("pipe.log", os.mkfifo, "monitor FILE", USAGE, "not a regular file"),
    Row("inf.log", content(several(FRAME, "(inf) can0 1#00")), "monitor FILE", USAGE, "time inf"),
    Row("far.log", content(several(FRAME, "(1e10) can0 1#00")), "monitor FILE", 0, "2 frames"),
)

ROWS = (*MONITOR, *IMAGES, *SETTINGS, *SCANS, *REPORTS, *TRACES)

COSTLY = frozenset(
    {
        "blank.hex", "blank.log", "blank.s19", "comments.asc", "counts.s19", "deep_keys.toml",
        "ids.log", "members.log.gz", "never_whole.blf", "objects.json", "same.hex",
        "scattered.hex", "sections.elf", "starts.hex", "zeros.elf",
    }
)  # fmt: skip
"""More than a tenth of a second of the processor each: four fifths of what all rows take."""
SAMPLE = tuple(row for row in ROWS if row.name not in COSTLY)
