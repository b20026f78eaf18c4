"""Reads recorded traces of any format that python-can knows, as frames with their times."""

from __future__ import annotations

import os
from collections.abc import Iterator

import can

from flasher.errors import UsageError
from flasher.protocol.frame import Frame
from flasher.protocol.text import printable

SUFFIXES = ".asc .blf .csv .db .log .mf4 .trc, also with .gz behind it"


def read_trace(path: str | os.PathLike[str]) -> Iterator[tuple[float, Frame]]:
    """Time in seconds and frame, one after the other, as they stand in the file; CAN FD frames are
    left out. Times are those of the file: seconds since its start or since 1970.

    Raises UsageError for a file that cannot be opened, whose suffix python-can does not know, or
    whose content is not what the suffix says.
    """
    name = os.fspath(path)
    shown = printable(name)
    count = 0
    try:
        with can.LogReader(name) as reader:
            for message in reader:
                count += 1
                if not message.is_fd:
                    yield message.timestamp, _frame(message)
    except OSError as error:
        raise UsageError(f"{shown} cannot be read: {error.strerror or error}.") from error
    except Exception as error:
        if isinstance(error, ValueError) and "log format" in str(error):
            raise UsageError(
                f"{shown}: no trace format has this suffix.", remedy=f"Known are {SUFFIXES}."
            ) from error
        raise UsageError(
            f"{shown} is not a trace of the format that its suffix says.",
            where=f"behind frame {count:,}" if count else "at its beginning",
            cause=printable(f"{type(error).__name__}: {error!s:.100}"),
            remedy="Record it again, or rename it to the suffix of its format.",
        ) from error


def _frame(message: can.Message) -> Frame:
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        # An error frame has no id of its own; some formats give it the longer form.
        message.is_extended_id and not message.is_error_frame,
        message.is_remote_frame,
        message.is_error_frame,
    )
