"""The kept heads of a station: segments, what a crash leaves of them, and what a forger does."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from flasher import files
from flasher.errors import FlasherError
from flasher.station.records import heads as heads_module
from flasher.station.records.heads import ChainHead, Checkpoint, HeadsFault, HeadsFile, Position
from flasher.station.records.signatures import SigningKey
from tests.loops import each
from tests.station.factory import Bench

SEGMENT_BYTES = 1500
"""Room for four heads."""


@pytest.fixture
def key(tmp_path: Path) -> SigningKey:
    return SigningKey.make(tmp_path / "own.key")


def head(number: int) -> ChainHead:
    return ChainHead("line-2", number, "2026-05-17", f"{number:064x}", "s" * 88, "k" * 64)


def kept(folder: Path, key: SigningKey, count: int = 30) -> HeadsFile:
    """Heads that were added one by one, in several segments."""
    file = HeadsFile(folder / "line.heads", SEGMENT_BYTES)
    for number in range(1, count + 1):
        file.append([head(number)], key)
    return file


def again(file: HeadsFile) -> HeadsFile:
    """The same heads, as another process reads them."""
    return HeadsFile(file.path, SEGMENT_BYTES)


def heads_of(file: HeadsFile) -> list[int]:
    return [each.number for each in file.entries() if isinstance(each, ChainHead)]


def faults_of(file: HeadsFile) -> list[str]:
    return [
        f"{Path(each.where).name}: {each.what}"
        for each in file.entries()
        if isinstance(each, HeadsFault)
    ]


def test_a_full_segment_is_closed_and_another_one_goes_on(tmp_path: Path, key: SigningKey) -> None:
    file = again(kept(tmp_path, key))
    assert heads_of(file) == list(range(1, 31))
    assert faults_of(file) == []
    names = sorted(path.name for path in tmp_path.glob("line.heads*"))
    assert len(names) > 5
    assert names[:2] == ["line.heads", "line.heads.000002"]
    assert all(path.stat().st_size < 3 * SEGMENT_BYTES for path in tmp_path.glob("line.heads*"))
    closed = [each for each in file.entries() if isinstance(each, Checkpoint)]
    assert [each.segment for each in closed] == list(range(1, len(names)))
    assert file.last() == head(30)
    assert file.first() == head(1)


@each("room", [0, 1, 100])
def test_a_disk_that_gets_full_in_a_line_loses_no_head(
    tmp_path: Path, key: SigningKey, room: int
) -> None:
    """The system writes the part for which there is room, and reports no error at first."""
    resource = pytest.importorskip("resource")
    folder = tmp_path / f"{room}"
    folder.mkdir()
    file = kept(folder, key, count=2)
    size = file.path.stat().st_size
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + room, before[1]))
    try:
        with pytest.raises(FlasherError):
            file.append([head(3)], key)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert file.path.stat().st_size == size
    file.append([head(3)], key)
    assert heads_of(again(file)) == [1, 2, 3]
    assert faults_of(again(file)) == []


def test_only_the_last_segment_is_read_at_start_and_to_add(
    tmp_path: Path, key: SigningKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept(tmp_path, key)
    *_, last = sorted(tmp_path.glob("line.heads*"))
    opened: set[Path] = set()
    real = files.opened

    def spy(path: Path, *words: object, **named: object) -> object:
        opened.add(path)
        return real(path, *words, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(heads_module, "opened", spy)
    file = HeadsFile(tmp_path / "line.heads", SEGMENT_BYTES)
    assert file.last() == head(30)
    file.append([head(31)], key)
    assert opened == {last}


def test_a_file_of_any_size_that_an_older_flasher_wrote_is_taken_over(
    tmp_path: Path, key: SigningKey
) -> None:
    old = tmp_path / "line.heads"
    lines = [json.dumps(vars(head(number)), sort_keys=True) for number in range(1, 101)]
    old.write_text("\n".join(lines) + "\n", "ascii")
    before = old.read_bytes()
    file = HeadsFile(old, SEGMENT_BYTES)
    assert file.last() == head(100)
    file.append([head(101)], key)
    assert old.read_bytes().startswith(before)
    assert heads_of(again(file)) == list(range(1, 102))
    assert faults_of(again(file)) == []
    assert len(list(tmp_path.glob("line.heads*"))) == 2


def test_the_heads_of_a_row_are_found_without_reading_all(tmp_path: Path, key: SigningKey) -> None:
    file = again(kept(tmp_path, key))
    assert [file.of_row(number) for number in range(33)] == [
        (head(number),) if 1 <= number <= 30 else () for number in range(33)
    ]


def test_closed_segments_up_to_a_row_are_left_out(tmp_path: Path, key: SigningKey) -> None:
    found = [
        each for each in again(kept(tmp_path, key)).entries(after=20) if isinstance(each, ChainHead)
    ]
    assert 10 <= len(found) < 20
    assert found[-1] == head(30)


def test_reading_goes_on_where_it_ended(tmp_path: Path, key: SigningKey) -> None:
    file = kept(tmp_path, key)
    position = again(file).position_after(head(12))
    assert position is not None
    assert [each.number for each, _ in file.since(position)] == list(range(13, 31))
    *_, (_, end) = file.since(Position())
    assert list(file.since(end)) == []
    file.append([head(31)], key)
    assert [each.number for each, _ in file.since(end)] == [31]
    assert file.position_after(head(99)) is None


def changed(text: str) -> Iterator[tuple[str, str]]:
    lines = text.splitlines(keepends=True)
    yield "a head is taken out", "".join([lines[0], *lines[2:]])
    yield "a head is changed", text.replace('"number": 6,', '"number": 7,')
    yield (
        "the checkpoint is changed",
        "".join([*lines[:-1], lines[-1].replace('"at": "2', '"at": "1')]),
    )
    yield "its end is cut off", "".join(lines[:-1])


@pytest.mark.parametrize("which", range(4))
def test_a_changed_segment_is_reported(tmp_path: Path, key: SigningKey, which: int) -> None:
    file = kept(tmp_path, key)
    path = tmp_path / "line.heads.000002"
    path.write_text(list(changed(path.read_text()))[which][1])
    assert any(each.startswith("line.heads.00000") for each in faults_of(again(file)))


def test_a_segment_that_is_gone_is_reported(tmp_path: Path, key: SigningKey) -> None:
    file = kept(tmp_path, key)
    (tmp_path / "line.heads.000003").unlink()
    assert "line.heads.000003: it is missing" in faults_of(again(file))


def test_a_segment_closed_anew_with_another_key_is_reported(bench: Bench) -> None:
    store = bench.store
    file = HeadsFile(store.signer.heads_file.path, 1)
    other = SigningKey.make(bench.folder / "other.key")
    run_id = bench.make()
    last = store.read.head_of(run_id)
    assert last is not None
    file.append([last], other)
    (problem,) = store.examine().problems
    assert "segment 1 in" in problem.where
    assert "not signed with a key of the station" in problem.what


@pytest.mark.parametrize("left", [b"", b'{"check'])
def test_a_crash_between_two_segments_spoils_nothing(
    tmp_path: Path, key: SigningKey, left: bytes
) -> None:
    file = kept(tmp_path, key)
    *_, last = sorted(tmp_path.glob("line.heads*"))
    numbers = heads_of(again(file))
    following = HeadsFile(file.path, 1)
    following.append([head(31)], key)
    (new,) = (
        set(tmp_path.glob("line.heads*"))
        - {*tmp_path.glob("*.key")}
        - {path for path in tmp_path.glob("line.heads*") if path <= last}
    )
    new.write_bytes(left)  # as a power cut leaves it
    assert again(file).last() == head(30)
    again(file).append([head(31)], key)
    assert heads_of(again(file)) == [*numbers, 31]
    assert faults_of(again(file)) == ([f"{new.name}: line 1 is not a head"] if left else [])


@pytest.mark.slow
def test_a_line_does_not_stop_at_any_size_of_its_heads(
    bench: Bench,
) -> None:
    bench.store.signer.heads_file = HeadsFile(bench.store.signer.heads_file.path, 1)
    for number in range(4):
        bench.make(serial=f"W260501{number}")
    found = bench.store.examine()
    assert not found.problems
    assert found.kept[0].last == 10
    assert len(list(bench.keys.glob("*.heads*"))) > 4


def test_what_is_no_segment_is_no_heads(tmp_path: Path, key: SigningKey) -> None:
    file = kept(tmp_path, key, 3)
    (tmp_path / "line.heads.bak").write_text("x")
    (tmp_path / "line.heads.000002").mkdir()
    with pytest.raises(FlasherError):
        again(file).last()
