"""Output files: written atomically, complete or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from secrets import token_hex
from typing import Final

from flasher.errors import ErrorCode, UsageError
from flasher.files import make_private
from flasher.protocol.text import printable

_LINKS_MAX: Final = 40
"""Maximum number of chained links, as in the operating system."""


def check_writable(
    path: Path | None,
    option: str,
    others: Iterable[object] = (),
    *,
    is_appended_to: bool = False,
) -> None:
    """Check before the work that the file, if any, can be written, and that the command does not
    read it (`check_not_read`). Raises UsageError with the `option` that named the file. Its folder
    must be writable, because the file is replaced unless it `is_appended_to`.
    """
    if path is None:
        return
    if str(path) == "-":
        raise UsageError(
            "This command writes a file, not standard output.",
            where=option,
            remedy="Name a file.",
            code=ErrorCode.FILE_NOT_WRITTEN,
        )
    try:
        if path.is_dir():
            raise _not_written(path, option, "it is a folder")
        if not path.parent.is_dir():
            raise _not_written(path, option, "its folder does not exist")
    except PermissionError as error:  # a folder above it may not be entered
        raise _not_written(path, option, str(error.strerror)) from error
    if not is_appended_to and not _can_be_replaced(path):
        raise _not_written(path, option, "its folder may not be written into")
    check_not_read(path, option, others)


def check_new(path: Path, option: str, *, force: bool) -> None:
    """Check that a file can be written, and is new unless `force` is set. Raises UsageError."""
    check_writable(path, option)
    if path.exists() and not force:
        raise _exists_error(path, option)


def _exists_error(path: Path, option: str) -> UsageError:
    return UsageError(
        f"{printable(str(path))} exists already.",
        where=option,
        remedy="Name another file, or add --force.",
        code=ErrorCode.FILE_NOT_WRITTEN,
    )


@contextlib.contextmanager
def claimed(path: Path, option: str, *, force: bool) -> Iterator[None]:
    """Keep the name of a new file while the block makes its content, so that no second command
    takes it meanwhile; an error that leaves it empty removes it. Raises UsageError for a file that
    exists, unless `force` is set.
    """
    if force:
        yield
        return
    try:
        path.open("xb").close()
    except FileExistsError as error:
        raise _exists_error(path, option) from error
    except OSError as error:
        raise _not_written(path, option, error.strerror or type(error).__name__) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            if path.stat().st_size == 0:
                path.unlink()


def _can_be_replaced(path: Path) -> bool:
    """False if this user cannot create files in the folder; pipes and devices stay in place."""
    try:
        path = path.resolve(strict=False)
        is_special = path.exists() and not path.is_file()
    except (OSError, RuntimeError):
        return True  # writing it reports the reason
    return is_special or os.access(path.parent, os.W_OK)


def check_not_read(path: str | Path, option: str, others: Iterable[object]) -> None:
    """Raise UsageError if the file to be written is one of the `others`: texts of the command line
    that may name files which the command reads.
    """
    for other in others:
        if not isinstance(other, str | Path):
            continue
        is_same = Path(path).absolute() == Path(other).absolute()
        with contextlib.suppress(OSError, ValueError):  # else by what the names lead to
            is_same = Path(path).samefile(other)
        if is_same:
            raise UsageError(
                f"{printable(str(path))} is a file of the command itself.",
                where=option,
                remedy="Name another file: this one would be overwritten.",
                code=ErrorCode.FILE_NOT_WRITTEN,
            )


def write_whole(path: Path, data: bytes, option: str, *, is_private: bool = False) -> None:
    """Write a file atomically; if `is_private`, only its owner may read it. A link is followed,
    unless another user created it; a pipe or device is written to, not replaced. Raises UsageError
    with the `option` that named it.
    """
    try:
        # Inside: a link that leads to itself cannot be resolved.
        _check_links(path, option)
        path = path.resolve(strict=False)
        is_special = path.exists() and not path.is_file()
        if is_special:
            path.write_bytes(data)
        else:
            _replace(path, data, is_private=is_private)
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise _not_written(path, option, reason) from error


@contextlib.contextmanager
def writing(path: Path, option: str) -> Iterator[Path]:
    """Yield a temporary name next to `path`, with its suffixes, for data written in pieces: it
    replaces `path` when the block succeeds, else it is removed. Only its owner may read it. Raises
    UsageError with the `option` that named the file.
    """
    check_writable(path, option)
    if path.exists() and not path.is_file():
        raise _not_written(path, option, "it is not a regular file")
    part = path.with_name(f".flasher-{token_hex(8)}-part{''.join(path.suffixes[-2:])}")
    try:
        _check_links(path, option)
        make_private(part)
        yield part
        make_private(part, is_appended_to=True)  # the writer may have recreated it
        part.replace(path.resolve(strict=False))
    except OSError as error:
        raise _not_written(path, option, error.strerror or type(error).__name__) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _check_links(path: Path, option: str) -> None:
    """Raise UsageError for a link of another user: in a shared folder (/tmp) it could lead to any
    file of this user. Links of the system are followed.
    """
    for _ in range(_LINKS_MAX):
        if not path.is_symlink():
            return
        if hasattr(os, "geteuid") and path.lstat().st_uid not in (0, os.geteuid()):
            raise _not_written(path, option, "it is a link of another user")
        path = path.parent / path.readlink()


def _replace(path: Path, data: bytes, *, is_private: bool) -> None:
    # An unpredictable name, and "x": a link placed there before is never followed.
    part = path.with_name(f".flasher-{token_hex(8)}.part")
    try:
        with part.open("xb") as file:
            if is_private:
                make_private(part)
            file.write(data)
        part.replace(path)
    except BaseException:  # an interrupt leaves no partial file either
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def _not_written(path: Path, option: str, reason: str) -> UsageError:
    return UsageError(
        f"{printable(str(path))} cannot be written: {reason}.",
        where=option,
        remedy="Name a file in a folder that exists, is writable, and has room.",
        code=ErrorCode.FILE_NOT_WRITTEN,
    )
