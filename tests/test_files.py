"""The gate for files that are read: what changes under it, and what passes it unchanged."""

from __future__ import annotations

import hashlib
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from flasher.errors import ImageError, UsageError
from flasher.files import opened, part_of, read
from flasher.protocol.spec import BMS, IMAGE_MAX_SIZE
from flasher.settings.profile import load_profile

pytestmark = pytest.mark.slow


def append(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"more")


def shorten(path: Path) -> None:
    os.truncate(path, 3)


def write_over(path: Path) -> None:
    path.write_bytes(b"87654321")
    os.utime(path, ns=(1, 1))


@pytest.mark.parametrize("change", [append, shorten, write_over])
def test_a_file_that_changes_while_it_is_read_is_not_used(
    tmp_path: Path, change: Callable[[Path], None]
) -> None:
    path = tmp_path / "app.bin"
    path.write_bytes(b"12345678")
    with (
        pytest.raises(ImageError, match="changed while"),
        opened(path, None, error=ImageError),
    ):
        change(path)


def test_a_recording_may_grow_and_not_shrink(tmp_path: Path) -> None:
    path = tmp_path / "trace.log"
    path.write_bytes(b"12345678")
    with opened(path, 8, may_grow=True):
        append(path)
    with pytest.raises(UsageError, match="changed while"), opened(path, 12, may_grow=True):
        shorten(path)


def test_a_file_of_exactly_the_largest_size_is_read_and_one_byte_more_is_not(
    tmp_path: Path,
) -> None:
    path = tmp_path / "app.bin"
    path.write_bytes(b"12345678")
    assert read(path, 8) == b"12345678"
    with pytest.raises(UsageError, match="too large: 8 bytes, where at most 7 are read"):
        read(path, 7)


def test_a_pipe_in_the_place_of_the_file_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was a file when it was looked at."""
    path = tmp_path / "app.bin"
    path.write_bytes(b"x")
    real_stat = os.stat

    def replaced(name: Path) -> os.stat_result:
        status = real_stat(name)
        path.unlink()
        os.mkfifo(path)
        return status

    monkeypatch.setattr(os, "stat", replaced)
    with pytest.raises(UsageError, match="not a regular file"):
        read(path, 10)


def test_a_file_of_the_largest_size_is_read(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_bytes(b"12345678")
    assert read(path, 8) == b"12345678"
    with pytest.raises(UsageError, match="8 bytes, where at most 7 are read"):
        read(path, 7)


def test_no_profile_is_looked_for_where_that_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "flasher.toml").write_text("attempts = 9\n")
    monkeypatch.chdir(tmp_path)
    assert load_profile(None, BMS).attempts == 9
    assert load_profile(os.devnull, BMS).attempts != 9


# -- the largest images ---------------------------------------------------------------------------

BASE = 0x0800_0000
LARGEST = struct.pack("<II", 0x2000_5000, BASE | 0x101) + bytes(range(249, 0, -1)) * 33_689
MEASURE = """
import hashlib, re, sys
from pathlib import Path
from flasher.image.load import load
image = load(sys.argv[1])
peak = re.search(r"VmHWM:\\s*([0-9]+) kB", Path("/proc/self/status").read_text())
print(image.sha256, int(peak[1]) // 1024)
"""


def as_hex(data: bytes, step: int) -> bytes:
    lines = []
    for offset in range(0, len(data), step):
        if not offset % 0x1_0000:
            head = struct.pack(">BHBH", 2, 0, 4, (BASE + offset) >> 16)
            lines.append(f":{head.hex()}{-sum(head) & 0xFF:02X}")
        piece = data[offset : offset + step]
        body = struct.pack(">BHB", len(piece), offset & 0xFFFF, 0) + piece
        lines.append(f":{body.hex()}{-sum(body) & 0xFF:02X}")
    return "\r\n".join([*lines, ":00000001FF"]).encode()


def as_s_records(data: bytes, step: int) -> bytes:
    lines = []
    for offset in range(0, len(data), step):
        piece = data[offset : offset + step]
        body = struct.pack(">BI", len(piece) + 5, BASE + offset) + piece
        lines.append(f"S3{body.hex()}{~sum(body) & 0xFF:02X}")
    return "\n".join([*lines, "S70508000000F2"]).encode()


def as_elf(data: bytes, _step: int) -> bytes:
    head = struct.pack(
        "<16s2H5I6H", b"\x7fELF\x01\x01\x01", 2, 40, 1, 0, 52, 84, 0, 52, 32, 1, 40, 1, 0
    )
    segment = struct.pack("<8I", 1, 124, BASE, BASE, len(data), len(data), 5, 4)
    section = struct.pack("<10I", 0, 1, 2, BASE, 124, len(data), 0, 0, 4, 0)
    return head + segment + section + data


def as_binary(data: bytes, _step: int) -> bytes:
    return data


@pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="the system reports no peak of memory"
)
@pytest.mark.parametrize(
    ("make", "step"), [(as_hex, 32), (as_s_records, 32), (as_elf, 0), (as_binary, 0)]
)
def test_the_largest_image_of_each_format_is_read_in_little_memory(
    tmp_path: Path, make: Callable[[bytes, int], bytes], step: int
) -> None:
    data = LARGEST[:IMAGE_MAX_SIZE]
    assert len(data) == IMAGE_MAX_SIZE
    path = tmp_path / "app"
    path.write_bytes(make(data, step))
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, path], check=True, capture_output=True, text=True
    )
    digest, megabytes = done.stdout.split()
    assert digest == hashlib.sha256(data).hexdigest()
    assert int(megabytes) < 100
    path.unlink()


def test_what_a_killed_process_left_beside_a_file_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "state[1].json"
    left, young, other = (tmp_path / f".{name}.part" for name in
        ("state[1].json-0a", "state[1].json-0b", "state1.json-0c"))  # fmt: skip
    for each in (left, young, other):
        each.touch()
    os.utime(left, (0, 0))
    part_of(path, left_s=3600.0).write_bytes(b"written by another process")
    assert (left.exists(), young.exists(), other.exists()) == (False, True, True)
    part = part_of(path)
    assert list(tmp_path.iterdir()) == [other]
    part.write_bytes(b"x")
    part.replace(path)
