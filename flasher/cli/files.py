"""The one way in which commands write a file: whole or not at all."""

from __future__ import annotations

import contextlib
from pathlib import Path

from flasher.errors import UsageError
from flasher.protocol.text import printable


def check_writable(path: Path, option: str) -> None:
    """Raises UsageError where no file can come to be: better before the work than after it.
    `option` is the one that named the file.
    """
    if path.is_dir():
        raise _not_written(path, option, "it is a folder")
    if not path.parent.is_dir():
        raise _not_written(path, option, "its folder does not exist")


def write_whole(path: Path, data: bytes, option: str) -> None:
    """Write a file whole or not at all, where a link leads to. What is no regular file (a pipe, a
    device) is written into, not replaced. Raises UsageError, with the `option` that named the file,
    when it cannot be written.
    """
    try:
        # Inside: a link that leads to itself cannot be resolved.
        path = path.resolve(strict=False)
        is_special = path.exists() and not path.is_file()
        if is_special:
            path.write_bytes(data)
        else:
            _replace(path, data)
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise _not_written(path, option, reason) from error


def _replace(path: Path, data: bytes) -> None:
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_bytes(data)
        part.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def _not_written(path: Path, option: str, reason: str) -> UsageError:
    return UsageError(
        f"{printable(str(path))} cannot be written: {reason}.",
        where=option,
        remedy="Name a file in a folder that exists and has room.",
    )
