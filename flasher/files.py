"""The one gate for every file that is read, and for what TOML and JSON files hold; and what makes a
file readable by its owner alone.

A name may lead to anything: a pipe that nobody writes to, a device, a link to itself, a file larger
than the memory. Only a regular file of a stated size passes, and it is opened for reading alone.
"""

from __future__ import annotations

import json
import math
import os
import shlex
import stat
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from typing import Any, Final

from flasher.errors import ErrorCode, Fault, FlasherError, UsageError, printable

TOML_MAX_SIZE: Final = 256 * 1024
"""In bytes, of any file of settings."""
JSON_MAX_SIZE: Final = 6 * 1024 * 1024
"""In bytes, of a report. What JSON holds takes up to thirty times its size in memory."""
_DEPTH_MAX: Final = 32
_NUMBER_BITS_MAX: Final = 64
_DOTS_MAX: Final = 128
"""In a line of TOML. The time that tomllib takes grows with the square of the parts of a key."""
_OWNER_ONLY: Final = 0o600
_OF_OTHERS: Final = 0o077
_OPEN_FLAGS: Final = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Not to wait for a pipe that took the place of the file in this moment; no line end translated."""


@contextmanager
def opened(
    path: str | os.PathLike[str],
    max_size: int | None,
    *,
    what: str = "",
    error: type[FlasherError] = UsageError,
    if_missing: str = "Correct the name.",
    may_grow: bool = False,
    was_named: bool = True,
) -> Iterator[tuple[BufferedReader, int]]:
    """A regular file of at most `max_size` bytes, or of any size, open for reading; and its size
    in bytes.

    `what` says in messages what kind of file was wanted. A recording that is still written to
    `may_grow`; any other file must not change until the end of the block. Unless it `was_named` by
    the user, it has to be the user's own or root's, and nobody else may write it (Windows: not
    looked at).

    Raises UsageError when there is no such file or it is no regular one; `error` when it is too
    large, changes, or cannot be read, here or in the block.
    """
    shown = printable(os.fspath(path))
    subject = f"The {what} {shown}" if what else shown
    try:
        _check_regular(os.stat(path), subject)  # noqa: PTH116  a name that is no path fails here
        descriptor = os.open(path, _OPEN_FLAGS)
    except (FileNotFoundError, NotADirectoryError, ValueError) as missing:
        raise UsageError(
            f"{subject} cannot be read: there is no file of this name.",
            remedy=if_missing,
            code=ErrorCode.FILE_NOT_READ,
        ) from missing
    except OSError as problem:
        raise _unreadable(subject, problem, error) from problem
    try:
        with open(descriptor, "rb") as file:  # noqa: PTH123  a descriptor is no path
            before = os.fstat(descriptor)
            _check_regular(before, subject)
            if not was_named:
                _check_trusted(path, before, subject)
            if max_size is not None and before.st_size > max_size:
                raise error(
                    f"{subject} is too large: {before.st_size:,} bytes, where at most "
                    f"{max_size:,} are read.",
                    cause="another file than the one that was meant",
                )
            if not before.st_size and os.read(descriptor, 1):
                raise _no_regular(subject)  # as in /proc: made up while it is read
            yield file, before.st_size
            after = os.fstat(descriptor)
    except OSError as problem:
        raise _unreadable(subject, problem, error) from problem
    is_changed = (after.st_size, after.st_mtime_ns) != (before.st_size, before.st_mtime_ns)
    if is_changed and not (may_grow and after.st_size >= before.st_size):
        raise error(
            f"{subject} cannot be read: it changed meanwhile.",
            cause="another program writes it",
            remedy="Try again when that has ended, or copy the file.",
        )


def read(
    path: str | os.PathLike[str],
    max_size: int,
    *,
    what: str = "",
    error: type[FlasherError] = UsageError,
    if_missing: str = "Correct the name.",
    was_named: bool = True,
) -> bytes:
    """All bytes of a file. Raises as `opened`."""
    with opened(
        path, max_size, what=what, error=error, if_missing=if_missing, was_named=was_named
    ) as (file, size):
        return file.read(size)


def read_toml(
    path: str | os.PathLike[str],
    *,
    what: str,
    error: type[FlasherError] = UsageError,
    if_missing: str = "Correct the name.",
    was_named: bool = True,
) -> dict[str, Any]:
    """What a TOML file of settings holds. Raises as `opened`, and `error` when it is none."""
    raw = read(
        path, TOML_MAX_SIZE, what=what, error=error, if_missing=if_missing, was_named=was_named
    )
    return parse_file(raw, path, what=what, error=error)


def parse_file(
    raw: bytes, path: str | os.PathLike[str], *, what: str, error: type[FlasherError] = UsageError
) -> dict[str, Any]:
    """What the bytes of the TOML file `path` hold. Raises `error` when they are none."""
    try:
        return parse_toml(raw)
    except ValueError as problem:
        shown, why = printable(os.fspath(path)), printable(str(problem))
        refusal = error(
            f"The {what} {shown} is no TOML file that can be read: {why}.",
            where=shown,
            remedy="Texts stand in quotes, lists in brackets, tables as [name], numbers as 0x4205 "
            "or 0.5.",
        )
        fault = Fault("", f"It is no TOML file: {why}.", refusal.remedy)
        raise refusal.with_faults((fault,)) from problem


def parse_toml(raw: bytes) -> dict[str, Any]:
    """What a TOML file holds; a number in it may be `inf` or `nan`, as the format has them. Raises
    ValueError saying why it is none, or has whole numbers of more than 64 bits.
    """
    text = raw.decode("utf-8-sig")  # some editors write a BOM, which is no part of TOML
    for number, line in enumerate(text.split("\n"), 1):
        if line.count(".") > _DOTS_MAX and not line.lstrip().startswith("#"):
            raise ValueError(f"more than {_DOTS_MAX} dots (at line {number})")
    try:
        document = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deep") from error
    _check_values(document, all_finite=False)
    return document


def parse_json(raw: bytes) -> Any:
    """What a JSON file holds. Raises ValueError as `parse_toml`, and for a number that is infinite,
    which Python's reader takes and the format has not.
    """
    try:
        document = json.loads(raw)
    except RecursionError as error:
        raise ValueError("nested too deep") from error
    _check_values(document, all_finite=True)
    return document


def _check_values(document: object, *, all_finite: bool) -> None:
    level: list[object] = [document]
    for _ in range(_DEPTH_MAX):
        inner: list[object] = []
        for value in level:
            if isinstance(value, dict):
                inner += value.values()
            elif isinstance(value, list):
                inner += value
            elif all_finite and isinstance(value, float) and not math.isfinite(value):
                raise ValueError("a number in it is not finite")
            elif isinstance(value, int) and value.bit_length() > _NUMBER_BITS_MAX:
                raise ValueError(f"a number in it has more than {_NUMBER_BITS_MAX} bits")
        level = inner
    if level:
        raise ValueError("nested too deep")


def owner_only(path: str, flags: int) -> int:
    """An opener for `open`: a file that it creates is readable by its owner alone."""
    return os.open(path, flags, _OWNER_ONLY)


def make_private(path: str | os.PathLike[str], *, is_appended_to: bool = False) -> None:
    """Create a file that its owner alone may read, for somebody who opens it by its name; one that
    is there is emptied, unless it `is_appended_to`, and others lose their rights. Pipes and devices
    are left alone. Raises OSError, also for a file of another user.
    """
    with suppress(FileNotFoundError):
        if not stat.S_ISREG(os.stat(path).st_mode):  # noqa: PTH116  a name that is no path
            return
    how = os.O_WRONLY | os.O_CREAT | (0 if is_appended_to else os.O_TRUNC)
    descriptor = owner_only(os.fspath(path), how)
    try:
        status = os.fstat(descriptor)
        if os.name != "posix" or not status.st_mode & _OF_OTHERS:
            return
        try:
            os.fchmod(descriptor, _OWNER_ONLY)
        except PermissionError as error:
            # A disk without rights (FAT) refuses its owner, or root who has mounted it.
            if status.st_uid not in (os.geteuid(), 0):
                raise PermissionError(error.errno, "it belongs to another user") from error
    finally:
        os.close(descriptor)


def _check_regular(status: os.stat_result, subject: str) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise UsageError(
            f"{subject} cannot be read: it is a directory.",
            remedy="Name a file in it.",
            code=ErrorCode.FILE_NOT_READ,
        )
    if not stat.S_ISREG(status.st_mode):
        raise _no_regular(subject)


def _check_trusted(path: str | os.PathLike[str], status: os.stat_result, subject: str) -> None:
    """Raises UsageError for an open file that another user has laid, or may write, where it is
    looked for. Its folder does not matter: who puts another file there is the owner of that one.
    """
    if os.name != "posix":
        return
    own = {os.geteuid(), 0}
    if not os.geteuid() and os.environ.get("SUDO_UID", "").isdecimal():
        own.add(int(os.environ["SUDO_UID"]))  # who became root by sudo
    quoted = shlex.quote(os.fspath(path))
    laid = os.lstat(path)
    if laid.st_uid not in own or status.st_uid not in own:
        why = "it belongs to another user"
        mended = f"cp {quoted} {quoted}.own && mv -f {quoted}.own {quoted}"
    elif status.st_mode & stat.S_IWOTH or (
        status.st_mode & stat.S_IWGRP and not _is_own_group(status)
    ):
        why, mended = "other users may write it", f"chmod go-w {quoted}"
    else:
        return
    raise UsageError(
        f"{subject} is not taken: {why}.",
        cause="it was not named; it was found where such a file is looked for",
        remedy=f"Read what is in it; then `{printable(mended)}` lets it be taken.",
        code=ErrorCode.FILE_NOT_TRUSTED,
    )


def _is_own_group(status: os.stat_result) -> bool:
    """True for the group that many systems give each user alone, with the right to write."""
    import grp  # noqa: PLC0415  not on Windows
    import pwd  # noqa: PLC0415

    try:
        owner, group = pwd.getpwuid(status.st_uid), grp.getgrgid(status.st_gid)
    except KeyError:
        return False
    return group.gr_name == owner.pw_name and set(group.gr_mem) <= {owner.pw_name}


def _no_regular(subject: str) -> UsageError:
    return UsageError(
        f"{subject} cannot be read: it is no regular file.",
        cause="a pipe, a device or another special file",
        remedy="Name a file on a disk; what comes through a pipe has to be saved first.",
        code=ErrorCode.FILE_NOT_READ,
    )


def _unreadable(subject: str, problem: OSError, error: type[FlasherError]) -> FlasherError:
    return error(
        f"{subject} cannot be read: {printable(problem.strerror or str(problem))}.",
        remedy="Make the file readable for this user, or copy it to this computer.",
    )
