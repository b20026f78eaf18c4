"""Safe reading of files: only regular files of limited size, checked TOML and JSON, private files.

A name may lead to a pipe without writer, a device, a link to itself, or a huge file. Only a regular
file of a stated size is opened, and only for reading.
"""

from __future__ import annotations

import glob
import json
import math
import os
import shlex
import stat
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from secrets import token_hex
from typing import Any, Final

from flasher.errors import ErrorCode, Fault, FlasherError, UsageError, printable

TOML_MAX_SIZE: Final = 256 * 1024
"""Maximum size of a settings file in bytes."""
JSON_MAX_SIZE: Final = 6 * 1024 * 1024
"""Maximum size of a report in bytes. JSON takes up to thirty times its size in memory."""
_DEPTH_MAX: Final = 32
_NUMBER_BITS_MAX: Final = 64
_DOTS_MAX: Final = 128
"""Dots in a line of TOML. The time of tomllib grows with the square of the parts of a key."""
_OWNER_ONLY: Final = 0o600
_OF_OTHERS: Final = 0o077
_OPEN_FLAGS: Final = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Does not wait for a pipe that replaced the file meanwhile; no translation of line ends."""


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
    """Open a regular file of at most `max_size` bytes (None: any size) for reading; yield it with
    its size in bytes.

    `what` names the kind of file in messages. A file that `may_grow`, such as a recording in
    progress, may get longer; any other must not change until the end of the block. Unless the user
    named it (`was_named`), it must belong to the user or root, and no other user may have write
    permission (not checked on Windows).

    Raises UsageError if the file does not exist or is not regular; `error` if it is too large,
    changes, or cannot be read.
    """
    shown = printable(os.fspath(path))
    subject = f"The {what} {shown}" if what else shown
    try:
        _check_regular(os.stat(path), subject)  # noqa: PTH116  a name that is not a path fails here
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
        with open(descriptor, "rb") as file:  # noqa: PTH123  a descriptor is not a path
            before = os.fstat(descriptor)
            _check_regular(before, subject)
            if not was_named:
                _check_trusted(path, before, subject)
            if max_size is not None and before.st_size > max_size:
                raise error(
                    f"{subject} is too large: {before.st_size:,} bytes, where at most "
                    f"{max_size:,} are read.",
                    cause="another file was meant",
                )
            if not before.st_size and os.read(descriptor, 1):
                raise _not_regular(subject)  # as in /proc: created while it is read
            yield file, before.st_size
            after = os.fstat(descriptor)
    except OSError as problem:
        raise _unreadable(subject, problem, error) from problem
    is_changed = (after.st_size, after.st_mtime_ns) != (before.st_size, before.st_mtime_ns)
    if is_changed and not (may_grow and after.st_size >= before.st_size):
        raise error(
            f"{subject} cannot be read: it changed while being read.",
            cause="another program writes it",
            remedy="Try again when that program has finished, or copy the file.",
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
    """Read all bytes of a file. Raises UsageError and `error` like `opened`."""
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
    """Read a TOML file. Raises UsageError like `opened`, and `error` for invalid TOML."""
    raw = read(
        path, TOML_MAX_SIZE, what=what, error=error, if_missing=if_missing, was_named=was_named
    )
    return parse_file(raw, path, what=what, error=error)


def parse_file(
    raw: bytes, path: str | os.PathLike[str], *, what: str, error: type[FlasherError] = UsageError
) -> dict[str, Any]:
    """Parse the bytes of the TOML file `path`. Raises `error` for invalid TOML."""
    try:
        return parse_toml(raw)
    except ValueError as problem:
        shown, why = printable(os.fspath(path)), printable(str(problem))
        refusal = error(
            f"The {what} {shown} is not a readable TOML file: {why}.",
            where=shown,
            remedy="Texts are in quotes, lists in brackets, tables as [name], numbers as 0x4205 "
            "or 0.5.",
        )
        fault = Fault("", f"It is not a TOML file: {why}.", refusal.remedy)
        raise refusal.with_faults((fault,)) from problem


def parse_toml(raw: bytes) -> dict[str, Any]:
    """Parse TOML; numbers may be `inf` or `nan`. Raises ValueError for invalid TOML and for
    integers of more than 64 bits.
    """
    text = raw.decode("utf-8-sig")  # some editors write a BOM, which is not part of TOML
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
    """Parse JSON. Raises ValueError for invalid JSON, long integers and infinite numbers."""
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
    """Opener for `open` that creates files readable only by their owner."""
    return os.open(path, flags, _OWNER_ONLY)


def is_plain(name: str) -> bool:
    """True for the path of a file below a folder, with /, which all systems read alike."""
    return not ("\\" in name or ":" in name or {"", ".", ".."} & set(name.split("/")))


def is_folder(path: str | os.PathLike[str]) -> bool:
    """True for a folder. Raises UsageError for a name in a folder that may not be entered."""
    return stat.S_ISDIR(_mode(path))


def is_regular(path: str | os.PathLike[str]) -> bool:
    """True for a regular file. Raises UsageError for one in a folder that may not be entered."""
    return stat.S_ISREG(_mode(path))


def check_secret(path: str | os.PathLike[str], what: str) -> None:
    """Check that not every user of this computer may read or write a file that holds `what`. A
    group may: that of a service shares its files so, and systemd its credentials. Raises
    UsageError.
    """
    if os.name == "posix" and _mode(path) & stat.S_IRWXO:
        raise UsageError(
            f"Every user of this computer may read {what}, or change it.",
            where=printable(os.fspath(path)),
            cause="its mode; a secret that a container mounts has to be declared with mode 0440",
            remedy="Let the user of this program, or its group, alone read it:"
            f" chmod o= {printable(shlex.quote(os.fspath(path)))}",
        )


def _mode(path: str | os.PathLike[str]) -> int:
    try:
        return os.stat(path).st_mode  # noqa: PTH116  a name that is not a path
    except PermissionError as problem:
        raise _unreadable(printable(os.fspath(path)), problem, UsageError) from problem
    except (OSError, ValueError):
        return 0


def part_of(path: Path, *, left_s: float = 0.0) -> Path:
    """A new name beside `path`, for a file that then replaces it. What a killed process left under
    such a name, and has not written to for `left_s`, is removed: 0 where a lock keeps others away.
    """
    for left in path.parent.glob(f".{glob.escape(path.name)}-*.part"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime >= left_s:
                left.unlink()
    return path.with_name(f".{path.name}-{token_hex(4)}.part")


def replace_private(path: Path, data: bytes) -> None:
    """Replace a file as a whole by one that only its owner may read; a lock keeps others away.
    Raises OSError.
    """
    part = part_of(path)
    try:
        with open(part, "xb", opener=owner_only) as file:
            file.write(data)
        part.replace(path)
    finally:  # an interrupt leaves no part either
        with suppress(OSError):
            part.unlink(missing_ok=True)


def make_private(path: str | os.PathLike[str], *, is_appended_to: bool = False) -> None:
    """Create a file readable only by its owner, to be opened by name. An existing one is emptied,
    unless it `is_appended_to`, and loses the permissions of others. Pipes and devices are not
    touched. Raises OSError, also for a file of another user.
    """
    with suppress(FileNotFoundError):
        if not stat.S_ISREG(os.stat(path).st_mode):  # noqa: PTH116  a name that is not a path
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
            # A file system without permissions (FAT) refuses its owner, or root who mounted it.
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
        raise _not_regular(subject)


def _check_trusted(path: str | os.PathLike[str], status: os.stat_result, subject: str) -> None:
    """Raise UsageError for a file at a default place that another user owns or may write. Its
    folder is not checked, because the owner of a replaced file is.
    """
    if os.name != "posix":
        return
    own = {os.geteuid(), 0}
    if not os.geteuid() and os.environ.get("SUDO_UID", "").isdecimal():
        own.add(int(os.environ["SUDO_UID"]))  # the user of sudo
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
        cause="it was not named on the command line, but found at a default place",
        remedy=f"Check its contents; then `{printable(mended)}` lets it be taken.",
        code=ErrorCode.FILE_NOT_TRUSTED,
    )


def _is_own_group(status: os.stat_result) -> bool:
    """True for a user's private group, to which many systems give write permission."""
    import grp  # noqa: PLC0415  not on Windows
    import pwd  # noqa: PLC0415

    try:
        owner, group = pwd.getpwuid(status.st_uid), grp.getgrgid(status.st_gid)
    except KeyError:
        return False
    return group.gr_name == owner.pw_name and set(group.gr_mem) <= {owner.pw_name}


def _not_regular(subject: str) -> UsageError:
    return UsageError(
        f"{subject} cannot be read: it is not a regular file.",
        cause="a pipe, a device or another special file",
        remedy="Name a file on a disk; save the output of a pipe first.",
        code=ErrorCode.FILE_NOT_READ,
    )


def _unreadable(subject: str, problem: OSError, error: type[FlasherError]) -> FlasherError:
    return error(
        f"{subject} cannot be read: {printable(problem.strerror or str(problem))}.",
        remedy="Make the file readable for this user, or copy it to this computer.",
    )
