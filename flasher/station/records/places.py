"""Copies chain heads to folders and PostgreSQL servers, in a background thread."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from flasher.errors import ErrorCode, FlasherError, UsageError, how_to_install
from flasher.protocol.text import printable
from flasher.station.records.database import in_file_name, locate
from flasher.station.records.errors import RecordError
from flasher.station.records.heads import ChainHead, Checkpoint, HeadsFault, HeadsFile, Position
from flasher.station.records.signatures import SigningKey

RETRY_S: Final = 10.0
"""Interval of attempts to reach a place; a new audit row causes one at once."""
PATIENCE_S: Final = 5.0
"""Time limit for a place to return its last head; a lost network share may hang forever."""
_END_S: Final = 2.0
_SOME: Final = 500
_RECENT: Final = 100_000
"""Number of rows before the last one in which the common part of two places is searched."""
_Found = TypeVar("_Found")


class Heads(Protocol):
    """The chain heads of one station that a place stores."""

    def append(self, heads: Iterable[ChainHead], key: SigningKey) -> None: ...

    def last(self) -> ChainHead | None: ...

    def entries(self, after: int = 0) -> Iterator[ChainHead | Checkpoint | HeadsFault]: ...

    def of_row(self, number: int) -> tuple[ChainHead, ...]: ...


class Place(Protocol):
    """A folder or server that stores chain heads. Methods raise FlasherError."""

    @property
    def shown(self) -> str:
        """Name for messages, without a password."""

    def of(self, station: str, records_id: str) -> Heads: ...

    def stations(self, records_id: str) -> Iterable[str]:
        """Stations with heads of these records in this place."""


class FolderPlace:
    """A folder of this computer, or a network share."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shown = printable(str(folder))

    def of(self, station: str, records_id: str) -> HeadsFile:
        return HeadsFile(self.folder / file_name(station, records_id, ".heads"))

    def stations(self, records_id: str) -> Iterator[str]:
        if not self.folder.is_dir():
            cause = "there is no such folder"
            raise RecordError(f"{self.shown} cannot be read: {cause}.", cause=cause)
        for path in sorted(self.folder.glob("*.heads")):
            first = HeadsFile(path).first()
            if first and path.name == file_name(first.station, records_id, ".heads"):
                yield first.station


def place_of(text: str) -> Place:
    """Parse a setting: a folder, or a PostgreSQL URL. Raises UsageError."""
    if "://" not in text:
        return FolderPlace(Path(text))
    location = locate(text, Path())
    if location.url.get_backend_name() != "postgresql":
        raise UsageError(
            f"{location.shown} is neither a folder nor a PostgreSQL server.",
            remedy="Name a folder, or postgresql://USER@HOST/NAME.",
        )
    try:
        from flasher.station.records.heads_server import ServerPlace  # noqa: PLC0415
    except ImportError as error:
        raise UsageError(
            "Heads on a PostgreSQL server need a driver that is not installed.",
            cause=printable(str(error)),
            remedy=how_to_install("plant"),
            code=ErrorCode.PACKAGE_MISSING,
        ) from error
    return ServerPlace(location)


def file_name(station: str, records_id: str, suffix: str) -> str:
    """File name for a station and its records; different names never collide."""
    plain = in_file_name(station)[:40]
    mark = hashlib.sha256(f"{records_id} {station}".encode()).hexdigest()[:12]
    return f"{plain}-{mark}{suffix}"


def call_all(
    works: Sequence[Callable[[], _Found]], limit_s: float = PATIENCE_S
) -> list[_Found | FlasherError]:
    """Make calls in parallel threads; returns their results or errors after at most `limit_s`."""
    found: dict[int, _Found | FlasherError] = {}

    def run(at: int, work: Callable[[], _Found]) -> None:
        try:
            found[at] = work()
        except FlasherError as error:
            found[at] = error
        except OSError as error:
            found[at] = RecordError(f"It cannot be read: {error.strerror or error}.")

    threads = [
        threading.Thread(target=run, args=(at, work), daemon=True) for at, work in enumerate(works)
    ]
    for thread in threads:
        thread.start()
    silent = RecordError(f"It did not answer within {limit_s:g} s.")
    for thread in threads:
        thread.join(limit_s)
        limit_s = limit_s if not thread.is_alive() else 0.0
    return [found.get(at, silent) for at in range(len(works))]


class Copying:
    """Copies heads from the key's folder to another place in a background thread, and tries again
    while the place cannot be reached.
    """

    def __init__(
        self, source: HeadsFile, place: Place, target: Heads, key: Callable[[], SigningKey]
    ) -> None:
        self._source = source
        self._place = place
        self._target = target
        self._key = key
        self._position: Position | None = None
        self._last: ChainHead | None = None
        """The last head that was copied to the place."""
        self._known = source.path.with_name(f"{source.path.name}.places")
        self._wake, self._is_ending = threading.Event(), False
        self._idle = threading.Event()
        self._begun_s: float | None = None
        """Time at which the attempt in progress began."""
        self._thread = threading.Thread(target=self._run, daemon=True, name="heads")
        self.fault = ""
        """Reason why the place lacks the last heads; "" if it has them."""

    @property
    def shown(self) -> str:
        return self._place.shown

    @property
    def is_behind(self) -> bool:
        """True if the place lacks the last heads: it cannot be reached, or does not answer."""
        begun_s = self._begun_s
        is_late = begun_s is not None and time.perf_counter() - begun_s > PATIENCE_S
        return is_late or bool(self.fault)

    def begin(self) -> None:
        self._thread.start()
        self.wake()

    def wake(self) -> None:
        """Start copying: there are new heads."""
        self._idle.clear()
        self._wake.set()

    def wait(self, limit_s: float = _END_S) -> bool:
        """Wait until all heads are copied or the place cannot be reached. False after `limit_s`."""
        return self._idle.wait(limit_s)

    def end(self) -> None:
        """Copy the remaining heads within a time limit, and stop."""
        self._is_ending = True
        self.wake()
        self._thread.join(_END_S)

    def _run(self) -> None:
        while True:
            self._wake.wait(RETRY_S if self.fault else None)
            self._wake.clear()
            is_ending = self._is_ending
            self._begun_s = time.perf_counter()
            try:
                self._copy()
            except FlasherError as error:
                self._position, self.fault = None, error.cause or error.what
            except OSError as error:
                self._position, self.fault = None, error.strerror or str(error)
            else:
                self.fault = ""
            self._begun_s = None
            if not self._wake.is_set():
                self._idle.set()
            if is_ending:
                return

    def _copy(self) -> None:
        # The place may be another one since: a share that was unmounted, or an older copy of it.
        if self._position is None or self._target.last() != self._last:
            self._position = self._find()
        some: list[ChainHead] = []
        for head, position in self._source.since(self._position):
            some.append(head)
            if len(some) == _SOME:
                self._put(some, position)
                some = []
        if some:
            self._put(some, position)

    def _put(self, some: list[ChainHead], position: Position) -> None:
        self._target.append(some, self._key())
        self._position, self._last = position, some[-1]
        self._note_known()

    def _note_known(self) -> None:
        """Remember that the place has heads, so that their loss is noticed."""
        known = self._known_places()
        if self.shown not in known:
            self._known.write_text("".join(f"{each}\n" for each in [*known, self.shown]), "utf-8")

    def _known_places(self) -> list[str]:
        return self._known.read_text("utf-8").splitlines() if self._known.exists() else []

    def _find(self) -> Position:
        """Position from which to copy. Raises RecordError if the place lost its heads."""
        last = self._target.last()
        if last is None and self.shown in self._known_places():
            raise RecordError(
                f"The heads of the hash chain that were copied to {self.shown} are missing.",
                cause="another share may be mounted there, or its files were deleted",
                remedy=f"Mount the share. To start again there, delete {self._known}.",
            )
        if last is None:
            return Position()
        self._note_known()
        found = self._source.position_after(last)
        if found is not None:
            return found
        # The last head is unknown here: older records were restored, or the file in the
        # key's folder is younger than this place.
        old = last.number - _RECENT
        recent = {
            each.hash for each in self._target.entries(max(old, 0)) if isinstance(each, ChainHead)
        }
        found = Position()
        for head, position in self._source.since(found):
            if head.hash in recent or head.number <= old:
                found = position
        return found


def lasts(
    places: Sequence[Place], station: str, records_id: str
) -> list[tuple[Place, ChainHead | FlasherError | None]]:
    """The last head of each place (None without one), or its error."""

    def asked(place: Place) -> Callable[[], Any]:
        return lambda: place.of(station, records_id).last()

    return list(zip(places, call_all([asked(each) for each in places]), strict=True))
