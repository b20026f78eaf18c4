"""Trace recorder: writes all frames in both directions to a file; the suffix chooses the format."""

from __future__ import annotations

import os
import re
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, Protocol, Self

from flasher.errors import ErrorCode, UsageError
from flasher.files import make_private
from flasher.protocol.frame import Frame
from flasher.protocol.text import printable
from flasher.python_can import can, load_mf4
from flasher.trace.pcapng import PcapngWriter

_CANDUMP_ERROR: Final = 0x2000_0080
"""CAN id of an error frame for a bus error."""
_INTERFACE_MAX: Final = 15
"""Maximum length of a Linux interface name: can-utils have no room for more."""
_NOT_IN_NAME: Final = re.compile(r"[^A-Za-z0-9.:_-]")
DATA_MAX: Final = 8
"""Bytes of a CAN frame that is not CAN FD."""
_COMMIT_FRAMES: Final = 500
"""Maximum number of frames that are lost when the process is killed."""
ONE_TOOL_CHANNEL: Final = "conformance"
"""Channel in logs of the conformance suite, which breaks the protocol on purpose."""


def message_of(frame: Frame, *, sent: bool, at_s: float, channel: int | str = 0) -> can.Message:
    """Convert a frame to a python-can message at wall time `at_s`."""
    return can.Message(
        timestamp=at_s,
        arbitration_id=frame.can_id,
        data=frame.data,
        is_extended_id=frame.is_extended,
        is_remote_frame=frame.is_remote,
        is_error_frame=frame.is_error,
        is_rx=not sent,
        channel=channel,
    )


def frame_of(message: can.Message) -> Frame:
    """Convert a python-can message to a frame."""
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        # An error frame has no id of its own; some formats give it the longer form.
        message.is_extended_id and not message.is_error_frame,
        message.is_remote_frame,
        message.is_error_frame,
    )


def is_classic(message: can.Message) -> bool:
    """True unless it is CAN FD, which not every format marks: only CAN FD has more bytes."""
    return not message.is_fd and len(message.data) <= DATA_MAX


class Writer(Protocol):
    """Interface of all trace writers."""

    def __call__(self, msg: can.Message, /) -> None: ...

    def stop(self) -> None: ...


class CandumpWriter:
    """Writes the format of `candump -L`, for canplayer, log2asc and Wireshark. python-can's own
    writer adds a direction letter that Wireshark does not accept.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._file = Path(path).open("w", encoding="ascii")  # noqa: SIM115  stop() closes it
        self.interface = "can0"
        """Interface name in every line; without spaces."""

    def __call__(self, message: can.Message) -> None:
        """Write a frame. Raises OSError."""
        can_id, data = f"{message.arbitration_id:03X}", bytes(message.data).hex().upper()
        if message.is_error_frame:
            can_id, data = f"{_CANDUMP_ERROR | message.arbitration_id:08X}", data or "00" * 8
        elif message.is_extended_id:
            can_id = f"{message.arbitration_id:08X}"
        if message.is_remote_frame:
            data = "R"
        kind = "##0" if message.is_fd else "#"
        self._file.write(f"({message.timestamp:f}) {self.interface} {can_id}{kind}{data}\n")

    def stop(self) -> None:
        """Close the file. Raises OSError."""
        self._file.close()


class DatabaseWriter:
    """Writes an SQLite file with the table that python-can reads. python-can's own writer loses
    queued frames at the end, and appends to an existing file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        Path(path).write_bytes(b"")
        # The tap of an asynchronous program is called in several threads, one after the other.
        self._connection = sqlite3.connect(path, check_same_thread=False)
        self._frames = 0
        self._is_closed = False
        # An upgrade does not wait for the disk.
        self._do(self._connection.execute, "PRAGMA synchronous = OFF")
        self._do(
            self._connection.execute,
            "CREATE TABLE messages (ts REAL, arbitration_id INTEGER, extended INTEGER,"
            " remote INTEGER, error INTEGER, dlc INTEGER, data BLOB)",
        )

    def __call__(self, message: can.Message) -> None:
        """Write a frame. Raises OSError."""
        row = (
            message.timestamp,
            message.arbitration_id,
            message.is_extended_id,
            message.is_remote_frame,
            message.is_error_frame,
            message.dlc,
            bytes(message.data),
        )
        self._do(self._connection.execute, "INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        self._frames += 1
        if self._frames % _COMMIT_FRAMES == 0:
            self._do(self._connection.commit)

    def stop(self) -> None:
        """Close the file. Raises OSError, and ValueError if it is already closed."""
        if self._is_closed:
            raise ValueError("it is closed")
        self._is_closed = True
        try:
            self._do(self._connection.commit)
        finally:
            self._connection.close()

    def _do(self, work: Callable[..., object], *arguments: object) -> None:
        """Execute a statement. Raises OSError for errors of the database."""
        try:
            work(*arguments)
        except sqlite3.Error as error:
            raise OSError(None, str(error)) from error


def writer_of(path: str | os.PathLike[str], *, name: str = "") -> Writer:
    """Create the trace writer for a file's suffix; only the owner can read the file. Messages name
    it `called`. Raises UsageError for an unknown suffix, a missing package, or a file that cannot
    be written.
    """
    suffix, shown = Path(path).suffix.lower(), printable(name or os.fspath(path)) or "''"
    try:
        with _created_private(path):
            if suffix == ".pcapng":
                return PcapngWriter(path)
            if suffix == ".log":
                return CandumpWriter(path)
            if suffix == ".db":
                return DatabaseWriter(path)
            if suffix == ".mf4":
                load_mf4()
            return can.Logger(path)
    except ValueError as error:
        raise UsageError(
            f"{shown}: no trace format has this suffix.",
            remedy="Use one of .asc .blf .csv .db .log .mf4 .pcapng .trc .txt.",
        ) from error
    except (ImportError, NotImplementedError) as error:
        raise UsageError(
            f"{shown}: this trace format needs a package that is not installed.",
            cause=str(error),
            remedy="Install it, or use .asc, .blf or .log.",
            code=ErrorCode.PACKAGE_MISSING,
        ) from error
    except OSError as error:
        raise UsageError(
            f"{shown} cannot be written: {error.strerror}.", code=ErrorCode.FILE_NOT_WRITTEN
        ) from error


@contextmanager
def _created_private(path: str | os.PathLike[str]) -> Iterator[None]:
    """Create a file that only its owner can read, before the block opens it. On failure a new file
    is removed and an existing one is unchanged. Raises OSError.
    """
    was_there = os.path.lexists(path)
    make_private(path, is_appended_to=True)
    try:
        yield
    except BaseException:
        if not was_there:
            with suppress(OSError):
                Path(path).unlink()
        raise


class Recorder:
    """Driver's tap that records to a file (.asc, .blf, .log, .csv, ...).

    Times in the file are wall-clock times, counted from the start by the driver's clock, so that a
    jump of the wall clock leaves no gap. Use it as a context manager: formats like .blf are
    complete only when closed. Raises UsageError for an unknown suffix or a file that cannot be
    written. A full disk ends only the recording; see `failure`.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = os.fspath(path)
        self.failure: str | None = None
        """Reason why the recording ended early; None while it is complete."""
        shown = printable(self._path) or "''"
        if not Path(self._path).absolute().parent.is_dir():
            raise UsageError(
                f"{shown} cannot be written: its folder does not exist.",
                code=ErrorCode.FILE_NOT_WRITTEN,
            )
        self._writer = writer_of(self._path)
        self._channel = ""
        self._wall_offset_s: float | None = None

    @property
    def channel(self) -> str:
        """Adapter of the frames. Only `.log` stores it; empty means `can0`."""
        return self._channel

    @channel.setter
    def channel(self, channel: str) -> None:
        self._channel = channel
        name = _NOT_IN_NAME.sub("_", channel.rpartition("/")[2])[:_INTERFACE_MAX]
        if name and isinstance(self._writer, CandumpWriter):
            self._writer.interface = name

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if self.failure is not None:
            return
        if self._wall_offset_s is None:
            self._wall_offset_s = time.time() - now
        message = message_of(frame, sent=sent, at_s=now + self._wall_offset_s)
        try:
            self._writer(message)
        except OSError as error:
            self.failure = error.strerror or type(error).__name__

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        # ValueError: some formats touch their file once more when they are closed again.
        try:
            self._writer.stop()
        except OSError as problem:
            self.failure = self.failure or problem.strerror or type(problem).__name__
        except ValueError:
            return
