"""What this computer has flashed: a file of JSON lines in the user's data folder.

Two lines a flash: one when it begins, one when it has ended. So a flash whose program was killed
shows as begun, without an end. Lines are only added, under a lock; what is torn is left out when it
is read. Only its owner may read the file: serial numbers and paths are nobody else's business.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from secrets import token_hex
from typing import Any, Final, TypeVar, get_args, get_type_hints

from filelock import FileLock
from platformdirs import user_data_path

from flasher.errors import UsageError
from flasher.files import opened
from flasher.said import say

SIZE_MAX: Final = 2 * 1024 * 1024
"""In bytes: beyond it the older half is dropped, some thousand flashes."""
_READ_MAX: Final = 2 * SIZE_MAX
"""In bytes, from the end of the file: other programs may have made it larger."""
_LOCK_LIMIT_S: Final = 3.0
_BEGAN: Final = "began"
_ENDED: Final = "ended"


_TRANSFERRED: Final = {
    True: say("transferred"),
    False: say("not transferred"),
    None: say("transferred not known"),
}
_COMPLETED: Final = {
    True: say("completed"),
    False: say("not completed"),
    None: say("completed not known"),
}


@dataclass(frozen=True)
class Began:
    """A flash that begins: nothing was written to the device yet."""

    at: str
    """Local time with its offset."""
    command: str
    """"flash" or "rescue"."""
    target: str
    is_virtual: bool
    """A device model, or a bus without hardware."""
    adapter: str
    image: str
    """Name of the file as given."""
    image_sha256: str
    """Of the bytes to be sent."""
    image_size_bytes: int
    image_version: str | None
    waived: str = ""
    """Checks that somebody has waived, by their names, a comma between two."""


@dataclass(frozen=True)
class Ended:
    """How it ended. Of the three claims null is: not known."""

    at: str
    exit_code: int
    what: str
    """The error in a sentence; empty where there is none."""
    serial_number: str | None
    previous_version: str | None
    transferred: bool | None
    """Every packet was acknowledged."""
    completed: bool | None
    """The device confirmed the complete image."""
    running_version: str | None
    """What the application answers."""
    needs_rescue: bool
    """The device was left without an application, or perhaps without one."""
    bundle: str | None
    """The folder with trace and report."""

    @property
    def claims(self) -> tuple[str, str, str]:
        """The three claims in words, of which none stands for another."""
        version = self.running_version
        return (
            _TRANSFERRED[self.transferred],
            _COMPLETED[self.completed],
            say("running {version}", version=version) if version else say("running not known"),
        )


@dataclass(frozen=True)
class Flash:
    """One flash; `ended` is null when no end was recorded."""

    began: Began
    ended: Ended | None


T = TypeVar("T", Began, Ended)


class History:
    """The file. Writing raises OSError, or TimeoutError when another program holds it."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or user_data_path("flasher", appauthor=False) / "history.jsonl"

    def begin(self, began: Began) -> str:
        """Add a flash that begins; returns what `end` wants."""
        name = token_hex(8)
        self._add({"flash": name, "event": _BEGAN, **dataclasses.asdict(began)})
        return name

    def end(self, name: str, ended: Ended) -> None:
        """Add how the flash `name` ended."""
        self._add({"flash": name, "event": _ENDED, **dataclasses.asdict(ended)})

    def flashes(self) -> tuple[list[Flash], int]:
        """Every flash, the latest last, and how many lines could not be read. Raises UsageError
        for a file that cannot be read.
        """
        begun: dict[str, Began] = {}
        ended: dict[str, Ended] = {}
        damaged = 0
        for line in self._lines(_READ_MAX):
            try:
                found = json.loads(line)
                if found["event"] == _BEGAN:
                    begun[found["flash"]] = _made(Began, found)
                elif found["event"] == _ENDED:
                    ended[found["flash"]] = _made(Ended, found)
            except (ValueError, LookupError, TypeError, RecursionError):
                damaged += 1
        return [Flash(each, ended.get(name)) for name, each in begun.items()], damaged

    def _lines(self, max_size: int) -> list[bytes]:
        """The lines in the last `max_size` bytes."""
        try:
            with opened(self.path, None, what="history", may_grow=True) as (file, size):
                file.seek(max(0, size - max_size))
                lines = file.read(max_size).splitlines()
        except UsageError as error:
            if isinstance(error.__cause__, FileNotFoundError):
                return []
            error.remedy = "Move it away, or make it readable for this user."
            raise
        return lines if size <= max_size else lines[1:]

    def _add(self, line: dict[str, Any]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with FileLock(f"{self.path}.lock", timeout=_LOCK_LIMIT_S, mode=0o600):
            if self.path.exists() and self.path.stat().st_size > SIZE_MAX:
                self._drop_older_half()
            descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o600)
            with open(descriptor, "r+b", buffering=0) as file:  # noqa: PTH123  a descriptor
                text = f"{json.dumps(line)}\n".encode()
                if not _ends_whole(file.fileno()):
                    text = b"\n" + text
                if file.write(text) != len(text):
                    raise OSError(0, "it was written in part")
                os.fsync(descriptor)

    def _drop_older_half(self) -> None:
        lines = self._lines(SIZE_MAX // 2)
        part = self.path.with_name(f".{self.path.name}-{token_hex(4)}.part")
        try:
            with open(part, "xb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
                file.writelines(b"%s\n" % each for each in lines)
            part.replace(self.path)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise


def _ends_whole(descriptor: int) -> bool:
    """False behind a line that a full disk or a power cut has torn."""
    size = os.fstat(descriptor).st_size
    if not size:
        return True
    os.lseek(descriptor, size - 1, os.SEEK_SET)
    return os.read(descriptor, 1) == b"\n"


def _made(kind: type[T], found: dict[str, Any]) -> T:
    """Keys that a newer flasher has added are left out. Raises LookupError and TypeError."""
    values = {
        each.name: found[each.name]
        for each in dataclasses.fields(kind)
        if each.default is dataclasses.MISSING or each.name in found
    }
    types = get_type_hints(kind)
    for name, value in values.items():
        if type(value) not in (get_args(types[name]) or (types[name],)):
            raise TypeError(name)
    return kind(**values)


def matching(
    flashes: list[Flash], *, target: str | None, serial_number: str | None
) -> Iterator[Flash]:
    """Those of a target, and those whose serial number has this text in it."""
    for each in flashes:
        serial = (each.ended and each.ended.serial_number) or ""
        if target in (None, each.began.target) and (serial_number or "").lower() in serial.lower():
            yield each
