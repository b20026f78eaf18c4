"""History of the upgrades on this computer: a file of JSON lines in the user's data folder.

Each upgrade has two lines, at its beginning and its end, so that one whose program was killed has
no end. Lines are only appended, under a lock; incomplete lines are skipped when reading. The file
is private, because it contains serial numbers and paths.

During an upgrade, a lock (which the operating system releases in any case) and a progress file
exist next to the history. A killed program leaves them there.
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

from filelock import FileLock, Timeout
from platformdirs import user_data_path

from flasher.errors import UsageError, printable
from flasher.events import Phase
from flasher.files import opened, owner_only, replace_private
from flasher.i18n import text
from flasher.wording import wording_of

SIZE_MAX: Final = 2 * 1024 * 1024
"""Size in bytes above which the older half is dropped: some thousand upgrades."""
_READ_MAX: Final = 2 * SIZE_MAX
"""Maximum size in bytes that is read, from the end: other programs may have made it larger."""
_LOCK_LIMIT_S: Final = 3.0
_BEGAN: Final = "began"
_ENDED: Final = "ended"
_REACHED_SIZE: Final = 32
"""Size of a progress file in bytes, written with one call."""
MOCK: Final = text("the built-in mock")
"""Adapter name of a device model, which ends with its program."""
_LEFT_IN: Final = {
    Phase.UPDATE.value: "perhaps_erased",
    Phase.TRANSFER.value: "no_application",
    Phase.END.value: "unknown",
    Phase.CONFIRM.value: "unknown",
}
"""Values of `flasher.host.outcome.DeviceLeft` by the phase reached."""

_TRANSFERRED: Final = {
    True: text("transferred"),
    False: text("not transferred"),
    None: text("transferred not known"),
}
_COMPLETED: Final = {
    True: text("completed"),
    False: text("not completed"),
    None: text("completed not known"),
}


@dataclass(frozen=True)
class Began:
    """History entry for the start of an upgrade, before anything is written to the device."""

    at: str
    """Local time with UTC offset."""
    command: str
    """"flash" or "rescue"."""
    target: str
    is_virtual: bool
    """True for a device model, or a bus without hardware."""
    adapter: str
    image: str
    """File name as given."""
    image_sha256: str
    """SHA-256 of the bytes to send."""
    image_size_bytes: int
    image_version: str | None
    waived: str = ""
    """Names of the waived checks, separated by commas."""
    again: str = ""
    """Command line, quoted for a shell; empty for a page."""
    folder: str = ""
    """Working directory of the command."""
    product: str = ""
    """Product of a signed release; empty for other images."""
    counter: int = 0
    """Counter of a signed release; 0 for other images."""
    signers: str = ""
    """Ids of the trusted keys that signed the image, separated by commas."""


@dataclass(frozen=True)
class Ended:
    """End of an upgrade. For the three claims, null means unknown."""

    at: str
    exit_code: int
    what: str
    """Error as a sentence; empty for a success."""
    serial_number: str | None
    previous_version: str | None
    transferred: bool | None
    """Every packet was acknowledged."""
    completed: bool | None
    """The device confirmed the complete image."""
    running_version: str | None
    """Firmware version that the application reported."""
    needs_rescue: bool
    """The device was left without an application, or perhaps without one."""
    bundle: str | None
    """Folder with trace and report."""

    @property
    def claims(self) -> tuple[str, str, str]:
        """Texts of the three claims."""
        version = self.running_version
        return (
            _TRANSFERRED[self.transferred],
            _COMPLETED[self.completed],
            text("running {version}", version=version) if version else text("running not known"),
        )


@dataclass(frozen=True)
class Reached:
    """Progress of an upgrade without an end, after the update command."""

    phase: str
    packet: int
    """Last acknowledged packet; 0 before the first."""


@dataclass(frozen=True)
class Flash:
    """Upgrade in the history; `ended` is null if no end was recorded."""

    began: Began
    ended: Ended | None
    is_running: bool = False
    """True while a program runs the upgrade."""
    reached: Reached | None = None
    """Last progress of an upgrade without an end; null for others."""

    @property
    def device_left(self) -> str:
        """State in which an upgrade without an end left the device, as a sentence."""
        if self.reached is None:
            return text("as far as is known it received no update command")
        return text(wording_of("DeviceLeft", _LEFT_IN[self.reached.phase]))

    @property
    def left_device_open(self) -> bool:
        """True if the device may still be in the transfer of this upgrade."""
        return not self.is_running and (self.ended is None or self.ended.needs_rescue)

    @property
    def shows_application(self) -> bool:
        """True if the device had an application at the end."""
        ended = self.ended
        if ended is None or ended.needs_rescue:
            return False
        return bool(ended.completed or ended.running_version or ended.previous_version)


T = TypeVar("T", Began, Ended)


class FlashHistory:
    """History file. Writing raises OSError, or TimeoutError if it is locked."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or user_data_path("flasher", appauthor=False) / "history.jsonl"
        self._held: dict[str, FileLock] = {}
        """Locks of the upgrades that this program runs."""

    def begin(self, began: Began) -> str:
        """Add the beginning of an upgrade; return its name for `end`."""
        name = token_hex(8)
        for folder in (self.path.parent, self._folder):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        lock = FileLock(self._lock_of(name), timeout=0, thread_local=False, mode=0o600)
        with lock:
            self.changed(name, began)
            self._held[name] = lock
            lock.acquire()  # a second time, so that it stays locked
        return name

    def changed(self, name: str, began: Began) -> None:
        """Replace what is recorded of the beginning of the upgrade `name`."""
        self._add({"flash": name, "event": _BEGAN, **dataclasses.asdict(began)})

    def reached(self, name: str, reached: Reached) -> None:
        """Record the progress of the upgrade `name`. Suitable for every packet: nothing is synced,
        so it survives the program but not the computer. Phases without erasing are ignored, because
        a later attempt begins with them.
        """
        if reached.phase not in _LEFT_IN:
            return
        descriptor = owner_only(str(self._place_of(name)), os.O_WRONLY | os.O_CREAT)
        try:
            text = f"{reached.phase} {reached.packet}"
            os.write(descriptor, text.ljust(_REACHED_SIZE).encode())
        finally:
            os.close(descriptor)

    def end(self, name: str, ended: Ended) -> None:
        """Add the end of the upgrade `name`."""
        try:
            self._add({"flash": name, "event": _ENDED, **dataclasses.asdict(ended)})
        finally:
            self._forget(name)

    @property
    def _folder(self) -> Path:
        return self.path.parent / "running"

    def _lock_of(self, name: str) -> Path:
        return self._folder / f"{name}.lock"

    def _place_of(self, name: str) -> Path:
        return self._folder / f"{name}.reached"

    def _forget(self, name: str) -> None:
        """Release the lock of an upgrade and delete its files."""
        self._held.pop(name).release()
        for path in (self._lock_of(name), self._place_of(name)):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)

    def _is_running(self, name: str) -> bool:
        path = self._lock_of(name)
        try:
            if path.exists():
                with FileLock(path, timeout=0):
                    pass
        except Timeout:
            return True
        except OSError:
            return False
        return False

    def _reached(self, name: str) -> Reached | None:
        try:
            phase, packet = self._place_of(name).read_text("ascii").split()
            return Reached(phase, int(packet)) if phase in _LEFT_IN else None
        except (OSError, ValueError):
            return None

    def flashes(self) -> tuple[list[Flash], int]:
        """Return all upgrades, the latest last, and the number of unreadable lines. Raises
        UsageError if the file cannot be read.
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
        return [
            Flash(each, ended[name])
            if name in ended
            else Flash(each, None, self._is_running(name), self._reached(name))
            for name, each in begun.items()
        ], damaged

    def _lines(self, max_size: int) -> list[bytes]:
        """Return the lines in the last `max_size` bytes."""
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
            descriptor = owner_only(str(self.path), os.O_RDWR | os.O_APPEND | os.O_CREAT)
            with open(descriptor, "r+b", buffering=0) as file:  # noqa: PTH123  a descriptor
                text = f"{json.dumps(line)}\n".encode()
                if not _ends_whole(file.fileno()):
                    text = b"\n" + text
                if file.write(text) != len(text):
                    raise OSError(0, "it was written in part")
                os.fsync(descriptor)

    def _drop_older_half(self) -> None:
        lines = self._lines(SIZE_MAX // 2)
        replace_private(self.path, b"".join(b"%s\n" % each for each in lines))
        kept = b"".join(lines)
        for path in self._folder.glob("*"):
            if path.stem.encode() not in kept and not self._is_running(path.stem):
                path.unlink(missing_ok=True)


def _ends_whole(descriptor: int) -> bool:
    """False after a line that a full disk or a power cut left incomplete."""
    size = os.fstat(descriptor).st_size
    if not size:
        return True
    os.lseek(descriptor, size - 1, os.SEEK_SET)
    return os.read(descriptor, 1) == b"\n"


def _made(kind: type[T], found: dict[str, Any]) -> T:
    """Create a record; ignores keys of newer versions. Raises LookupError and TypeError."""
    values = {
        each.name: found[each.name]
        for each in dataclasses.fields(kind)
        if each.default is dataclasses.MISSING or each.name in found
    }
    types = _TYPES[kind.__name__]
    for name, value in values.items():
        if type(value) not in types[name]:
            raise TypeError(name)
    return kind(**values)


_TYPES: Final = {
    kind.__name__: {
        name: get_args(found) or (found,) for name, found in get_type_hints(kind).items()
    }
    for kind in (Began, Ended)
}
"""Allowed JSON types of each key of a line."""


def working_folder() -> str:
    """Working directory, escaped; empty if it was deleted."""
    try:
        return printable(str(Path.cwd()))
    except OSError:
        return ""


def left_open(flashes: list[Flash], *, target: str, adapter: str) -> Flash | None:
    """Return the latest upgrade of a target on an adapter that may have left its device in the
    transfer; None without one, or if the device had an application later.
    """
    found = None
    for each in flashes:
        if (each.began.target, each.began.adapter) != (target, adapter) or adapter == MOCK:
            continue
        if each.left_device_open:
            found = each
        elif each.shows_application:
            found = None
    return found


def highest_counters(flashes: list[Flash], *, target: str, product: str) -> dict[str, int]:
    """Return the highest counter of a product's signed releases that each device of a target
    received, by serial number.
    """
    found: dict[str, int] = {}
    for each in flashes:
        began, ended = each.began, each.ended
        if (began.target, began.product) == (target, product) and ended and ended.transferred:
            serial_number = ended.serial_number or ""
            found[serial_number] = max(began.counter, found.get(serial_number, 0))
    found.pop("", None)
    return found


def latest_left_open(flashes: list[Flash]) -> Flash | None:
    """Return the latest upgrade on a real adapter that may have left its device in the transfer."""
    places = {(each.began.target, each.began.adapter) for each in flashes}
    found = [left_open(flashes, target=target, adapter=adapter) for target, adapter in places]
    return max((each for each in found if each is not None), key=flashes.index, default=None)


def matching(
    flashes: list[Flash], *, target: str | None, serial_number: str | None
) -> Iterator[Flash]:
    """Yield the upgrades of a target whose serial number contains a text; None matches all."""
    for each in flashes:
        serial = (each.ended and each.ended.serial_number) or ""
        if target in (None, each.began.target) and (serial_number or "").lower() in serial.lower():
            yield each
