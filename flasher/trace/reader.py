"""Trace reader: python-can's formats and Wireshark captures, with limits on size and time.

python-can parses the content, but accepts a line, a container or a database of any size and may
read forever; this module limits its input.

SQLite creates and removes files next to a database that it opens, and repairs it. So a copy in a
temporary folder is read: the original stays unchanged, and content that another program has not yet
merged into the file is read too.
"""

from __future__ import annotations

import gzip
import math
import os
import shutil
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from io import BufferedIOBase
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, Final, TextIO, cast

from flasher.errors import ErrorCode, UsageError
from flasher.files import opened
from flasher.protocol.frame import EXTENDED_ID_MAX, STANDARD_ID_MAX, Frame
from flasher.protocol.text import printable
from flasher.python_can import can
from flasher.trace.blf import UnpackedBlf
from flasher.trace.bounds import FILE_MAX_SIZE, BoundedLines, Bounds, UnfitError, check_unpacked
from flasher.trace.mf4 import read_measurement
from flasher.trace.pcapng import frames_of_capture
from flasher.trace.recorder import DATA_MAX, frame_of, is_classic

_FRAMES: Final = "SELECT ts, arbitration_id, extended, remote, error, data FROM messages"
_IS_TABLE: Final = (
    "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'messages' AND rootpage > 0"
)
"""A view or a virtual table is excluded, because it may have endless rows."""
_COMPANIONS: Final = ("-journal", "-wal")
"""Suffixes of files that SQLite writes next to a database, with parts of its content."""
_COPIED_MAX_SIZE: Final = 256 * 1024 * 1024
_VALUE_MAX: Final = 65_536
"""Maximum size of a value in bytes."""
_ROW_MIN_SIZE: Final = 8
"""Minimum size of a row of seven columns, in bytes: a damaged file may lead in circles."""

SUFFIXES = ".asc .blf .csv .db .log .mf4 .pcap .pcapng .trc, also followed by .gz"
_WHOLE_MAX_SIZE: Final = 64 * 1024 * 1024
"""Maximum size in bytes of a format that is read in one piece."""
_PIECE_SIZE: Final = 65_536
_TIME_MAX_S: Final = 1e11
"""About the year 5000. No clock gives a later time, or its negative."""
_LINE_READERS: Final = {
    ".asc": can.ASCReader,
    ".csv": can.CSVReader,
    ".log": can.CanutilsLogReader,
    ".trc": can.TRCReader,
}
_CAPTURES: Final = (".pcap", ".pcapng")
_OTHERS: Final = (".blf", ".db", ".mf4", *_CAPTURES)
_FIRST_CHANNEL: Final = {".asc": 1, ".blf": 1}
"""Number in the file of the channel that python-can calls 0."""
_CHANNELS_MAX: Final = 100


class SeveralBusesError(UsageError):
    """The trace is right, but not of one CAN bus."""


def read_trace(
    path: str | os.PathLike[str], *, channel: str | None = None
) -> Iterator[tuple[float, Frame]]:
    """Yield time in seconds and frame, in file order, without CAN FD frames; of a `channel` as the
    file names it, or of all.

    Times are those of the file: seconds since its start or since 1970. Raises UsageError for a file
    that cannot be opened, whose suffix is unknown, or whose content does not match the suffix, and
    SeveralBusesError for one with the frames of several buses.
    """
    shown = printable(os.fspath(path))
    suffixes = [suffix.lower() for suffix in Path(path).suffixes]
    is_packed = suffixes[-1:] == [".gz"]
    suffix = "".join(suffixes[-2:-1] if is_packed else suffixes[-1:])
    if suffix not in (*_LINE_READERS, *_OTHERS):
        raise UsageError(
            f"{shown}: no trace format has this suffix.", remedy=f"Known suffixes: {SUFFIXES}."
        )
    with opened(path, FILE_MAX_SIZE, may_grow=True) as (file, size):
        bounds = Bounds()
        try:
            source: BufferedIOBase = file
            if is_packed:
                source = gzip.GzipFile(fileobj=file)
                check_unpacked(iter(partial(source.read, _PIECE_SIZE), b""), size)
                source.seek(0)
            one = _OneBus(suffix, channel)
            for at_s, frame in _frames(suffix, source, size, Path(path), bounds, one):
                _check(at_s, frame)
                bounds.frames += 1
                yield at_s, frame
        except NotImplementedError as error:
            raise UsageError(
                f"{shown}: this trace format needs a package that is not installed.",
                cause=printable(str(error)),
                remedy="Install it, or convert the trace to .asc, .blf or .log.",
                code=ErrorCode.PACKAGE_MISSING,
            ) from error
        except Exception as error:
            if isinstance(error, OSError) and not isinstance(error, gzip.BadGzipFile):
                raise
            reason = "" if isinstance(error, UnfitError) else f"{type(error).__name__}: "
            remedy = error.remedy if isinstance(error, UnfitError) else ""
            wrong = f"{shown} is not a trace of the format that its suffix says."
            kind = SeveralBusesError if remedy else UsageError
            raise kind(
                f"{shown} is not a trace of one CAN bus." if remedy else wrong,
                where=f"after frame {bounds.frames:,}" if bounds.frames else "at its beginning",
                cause=printable(f"{reason}{error!s:.100}"),
                remedy=remedy or "Record it again, or rename it to the suffix of its format.",
            ) from error
    one.check_found(shown)


class _OneBus:
    """Chooses the frames of one channel. Without a choice, an id on two channels shows two buses;
    programs that write what they send and receive to two channels use each id on one.
    """

    def __init__(self, suffix: str, chosen: str | None) -> None:
        self._first = _FIRST_CHANNEL.get(suffix, 0)
        self._chosen = chosen
        self._of_id: dict[int, str] = {}
        self._names: dict[str, None] = {}

    def takes(self, message: can.Message) -> bool:
        """True for a frame to read. Raises UnfitError for an id on a second channel."""
        channel = message.channel
        name = str(channel + self._first if isinstance(channel, int) else channel)
        if len(self._names) < _CHANNELS_MAX:
            self._names.setdefault(name)
        if self._chosen is not None:
            return name == self._chosen
        is_payload = not (message.is_extended_id or message.is_error_frame)
        if is_payload and self._of_id.setdefault(message.arbitration_id, name) != name:
            names = [self._of_id[message.arbitration_id], name]
            raise UnfitError(
                f"id {message.arbitration_id:03X} is on the channels {' and '.join(names)}",
                remedy=f"Keep one: flasher export trace FILE --channel {names[0]} -o ONE.log",
            )
        return True

    def check_found(self, shown: str) -> None:
        """Raise UsageError if no frame of the file is of the chosen channel."""
        if self._chosen is not None and self._chosen not in self._names:
            chosen = printable(self._chosen)
            raise UsageError(
                f"{shown} has no frame of the channel {chosen}.",
                remedy=f"Name one of these: {printable(', '.join(self._names)) or 'none'}.",
            )


def _frames(
    suffix: str, source: BufferedIOBase, size: int, path: Path, bounds: Bounds, one: _OneBus
) -> Iterator[tuple[float, Frame]]:
    """Yield the frames from the format's reader. Raises any exception of that reader."""
    if suffix == ".db":
        yield from _frames_of_database(source, path)
        return
    if suffix in _CAPTURES:
        yield from frames_of_capture(source, bounds)
        return
    reader: Iterable[can.Message]
    if suffix == ".blf":
        reader = can.BLFReader(cast("BinaryIO", UnpackedBlf(source, size, bounds)))
    elif suffix == ".mf4":
        whole = source.read(_WHOLE_MAX_SIZE + 1)
        if len(whole) > _WHOLE_MAX_SIZE:
            raise UnfitError(f"it has more than {_WHOLE_MAX_SIZE:,} bytes")
        reader = read_measurement(whole)
    else:
        reader = _LINE_READERS[suffix](
            cast(
                "TextIO",
                BoundedLines(source, None if isinstance(source, gzip.GzipFile) else size, bounds),
            )
        )
    for message in filter(is_classic, reader):
        if one.takes(message):
            yield message.timestamp, frame_of(message)


def _check(at_s: float, frame: Frame) -> None:
    """Raise UnfitError for an impossible time or CAN id."""
    if not math.isfinite(at_s) or abs(at_s) > _TIME_MAX_S:
        raise UnfitError(f"a frame has the time {at_s!r}")
    is_long = frame.is_extended or frame.is_error
    if not 0 <= frame.can_id <= (EXTENDED_ID_MAX if is_long else STANDARD_ID_MAX):
        raise UnfitError(f"a frame has the id {frame.can_id:#x}")


# -- databases ------------------------------------------------------------------------------------


def _frames_of_database(source: BufferedIOBase, path: Path) -> Iterator[tuple[float, Frame]]:
    """Yield time in seconds and frame of each row; `path` locates the companion files.

    Raises UnfitError, and sqlite3.Error for an invalid database.
    """
    with _copied(source, path) as copy, closing(sqlite3.connect(copy)) as connection:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _VALUE_MAX)
        if connection.execute(_IS_TABLE).fetchone() is None:
            raise UnfitError("it does not contain the table messages")
        left = copy.stat().st_size // _ROW_MIN_SIZE
        for at_s, can_id, extended, remote, error, held in connection.execute(_FRAMES):
            left -= 1
            if left < 0:
                raise UnfitError("it claims more rows than fit into its size")
            data = b"" if remote else held
            kinds = (
                isinstance(at_s, int | float),
                isinstance(can_id, int),
                isinstance(data, bytes),
            )
            if not all(kinds):
                raise UnfitError("a row lacks its time, its id or its data")
            if len(data) <= DATA_MAX:  # the table does not mark CAN FD
                yield (
                    float(at_s),
                    Frame(can_id, data, bool(extended) and not error, bool(remote), bool(error)),
                )


@contextmanager
def _copied(source: BufferedIOBase, path: Path) -> Iterator[Path]:
    with TemporaryDirectory(prefix="flasher-") as folder:
        copy = Path(folder) / "trace.db"
        with copy.open("wb") as file:
            while piece := source.read(_PIECE_SIZE):
                if file.tell() > _COPIED_MAX_SIZE:
                    raise UnfitError(f"it has more than {_COPIED_MAX_SIZE:,} bytes")
                file.write(piece)
        for companion in _COMPANIONS:
            beside = path.with_name(path.name + companion)
            if beside.exists():
                with (
                    opened(beside, _COPIED_MAX_SIZE, may_grow=True) as (file_beside, _),
                    copy.with_name(copy.name + companion).open("wb") as file,
                ):
                    shutil.copyfileobj(file_beside, file)
        yield copy
