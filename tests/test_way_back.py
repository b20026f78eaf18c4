"""Images on this computer by version: the way back from an upgrade."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from intelhex import IntelHex

from flasher.files import read
from flasher.history import Began, FlashHistory
from flasher.protocol.spec import BMS, WMC
from flasher.way_back import images_beside, images_here
from tests.end_to_end.stage import NEW, OLD, image_of
from tests.loops import each

SUFFIXES = ("hex", "bin", "s19", "wfw")
DATA = image_of(4, OLD).data


def as_hex(path: Path) -> None:
    file = IntelHex()
    file.frombytes(DATA, 0x0800_4000)
    file.write_hex_file(str(path), byte_count=8)  # the version's text lies in several records


def as_srec(path: Path) -> None:
    lines = []
    for at in range(0, len(DATA), 16):
        part = DATA[at : at + 16]
        body = bytes([len(part) + 5, *(0x0800_4000 + at).to_bytes(4), *part])
        lines.append(f"S3{body.hex().upper()}{(~sum(body)) & 0xFF:02X}\n")
    path.write_text("".join(lines))


@each(
    "name, write",
    [("a.bin", lambda path: path.write_bytes(DATA)), ("a.hex", as_hex), ("a.s19", as_srec)],
)
def test_an_image_beside_is_found_by_the_version_inside(
    tmp_path: Path, name: str, write: Callable[[Path], object]
) -> None:
    folder = tmp_path / name
    folder.mkdir()
    write(folder / name)
    found = images_here(BMS, images_beside(folder / "new.hex", SUFFIXES))
    assert found == {OLD: str(folder / name)}


def test_files_that_are_no_images_are_passed_over(tmp_path: Path) -> None:
    (tmp_path / "a.hex").write_bytes(b":zz\n:00\nS3\n\xff")
    (tmp_path / "b.wfw").write_bytes(b"PK\x03\x04 damaged")
    (tmp_path / "c.txt").write_bytes(DATA)
    (tmp_path / "two.bin").write_bytes(DATA + NEW.encode())
    (tmp_path / "d.bin").mkdir()
    (tmp_path / "e.bin").symlink_to(tmp_path / "nowhere")
    assert images_here(BMS, images_beside(tmp_path / "new.hex", SUFFIXES)) == {}
    assert images_beside(tmp_path / "nowhere" / "new.hex", SUFFIXES) == []


def test_the_newest_files_of_a_large_folder_are_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.way_back.FILES_MAX", 2)
    for age in range(4):
        path = tmp_path / f"{age}.bin"
        path.write_bytes(DATA)
        os.utime(path, (1_000_000 - age, 1_000_000 - age))
    names = [path.name for path in images_beside(tmp_path / "new.hex", SUFFIXES)]
    assert names == ["0.bin", "1.bin"]


def test_an_image_of_the_history_is_found_while_it_is_still_the_one_that_was_flashed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    path = tmp_path / "old.bin"
    path.write_bytes(DATA)
    began = Began(
        "2026-05-17T10:31:02+02:00", "flash", "bms", False, "can0", "old.bin", "ab", 3, OLD,
        folder=str(tmp_path),
    )  # fmt: skip
    FlashHistory().begin(began)
    assert images_here(BMS, ()) == {OLD: str(path)}
    assert images_here(WMC, ()) == {}
    path.write_bytes(image_of(4, NEW).data)
    assert images_here(BMS, ()) == {}
    path.unlink()
    assert images_here(BMS, ()) == {}


def test_a_file_that_was_flashed_many_times_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    (tmp_path / "old.bin").write_bytes(DATA)
    for _ in range(3):
        FlashHistory().begin(
            Began(
                "2026-05-17T10:31:02+02:00", "flash", "bms", False, "can0", "old.bin", "ab", 3, OLD,
                folder=str(tmp_path),
            )
        )  # fmt: skip
    reads: list[object] = []

    def counted(path: Path, size_max: int) -> bytes:
        reads.append(path)
        return read(path, size_max)

    monkeypatch.setattr("flasher.way_back.read", counted)
    assert images_here(BMS, ()) == {OLD: str(tmp_path / "old.bin")}
    assert reads == [tmp_path / "old.bin"]
