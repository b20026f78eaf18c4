"""Reader of .mf4 measurement files, in a process of its own.

The library for the format is written in C, and some damaged files crash the process.

`python -m flasher.trace.mf4` is that process. It writes the frames of the file on its standard
input to its standard output.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from io import BytesIO
from struct import Struct
from tempfile import TemporaryFile
from typing import IO, Final

from flasher.builds import module_command
from flasher.python_can import can, load_mf4
from flasher.trace.bounds import UnfitError
from flasher.trace.recorder import frame_of, is_classic

_COMMAND: Final = module_command("flasher.trace.mf4")
_RECORD: Final = Struct("<BdIhB")
"""Kind, time in seconds, CAN id, channel (-1 for none), size of what follows: the data, or the
reason of the end."""
_END: Final = 1 << 7
"""Kind of the last record; the others have the flags of a frame."""
_EXTENDED, _REMOTE, _ERROR = 1, 2, 4
_REASON_MAX: Final = 255


def read_measurement(whole: bytes) -> Iterator[can.Message]:
    """Yield the frames of a file with these bytes, without CAN FD. Raises UnfitError for a damaged
    file, and NotImplementedError without the package.
    """
    if find_spec("asammdf") is None:
        raise NotImplementedError("the package asammdf (the extra mf4) is not installed")
    with TemporaryFile() as file:
        file.write(whole)
        file.seek(0)
        with subprocess.Popen(  # noqa: S603  our own interpreter
            _COMMAND,
            stdin=file,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for this process, which ends it
        ) as process:
            assert process.stdout is not None  # noqa: S101  it is piped
            try:
                yield from _received(process.stdout)
            finally:
                process.kill()


def _received(source: IO[bytes]) -> Iterator[can.Message]:
    while len(head := source.read(_RECORD.size)) == _RECORD.size:
        kind, at_s, can_id, channel, size = _RECORD.unpack(head)
        data = source.read(size)
        if kind == _END:
            if data:
                raise UnfitError(data.decode("utf-8", "replace"))
            return
        yield can.Message(
            timestamp=at_s,
            arbitration_id=can_id,
            is_extended_id=bool(kind & _EXTENDED),
            is_remote_frame=bool(kind & _REMOTE),
            is_error_frame=bool(kind & _ERROR),
            channel=None if channel < 0 else channel,
            data=data,
        )
    raise UnfitError("it is damaged: the library for this format ended its process")


def _send(output: IO[bytes]) -> str:
    """Write the frames of the file on standard input; return why no more follow, "" at its end."""
    load_mf4()
    try:
        reader = can.MF4Reader(BytesIO(sys.stdin.buffer.read()))
    except Exception:  # noqa: BLE001  whatever it meets in a foreign file
        return "it is not a measurement file of version 4, or it is cut off"
    try:
        for message in filter(is_classic, reader):
            frame = frame_of(message)
            kind = _EXTENDED * frame.is_extended | _REMOTE * frame.is_remote
            kind |= _ERROR * frame.is_error
            channel = -1 if message.channel is None else message.channel
            head = _RECORD.pack(kind, message.timestamp, frame.can_id, channel, len(frame.data))
            output.write(head + frame.data)
    except Exception as error:  # noqa: BLE001  as above
        return f"{type(error).__name__}: {error!s:.100}"
    return ""


def main() -> None:
    output, sys.stdout = sys.stdout.buffer, sys.stderr  # what a library prints is no frame
    reason = _send(output).encode("utf-8", "replace")[:_REASON_MAX]
    output.write(_RECORD.pack(_END, 0.0, 0, 0, len(reason)) + reason)
    output.flush()


if __name__ == "__main__":
    main()
