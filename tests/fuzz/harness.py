"""Harness: a function that gives any bytes to a part of flasher, and what that part may do then."""

from __future__ import annotations

import itertools
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Final

from flasher.errors import FlasherError
from tests.hostile.judge import LIMIT_S, fault_of

CORPUS: Final = Path(__file__).parent / "corpus"
_MEMORY_MAX_MB: Final = 200
"""By which an input may raise the peak of the process: a module that it loads takes a tenth."""
MODULES: Final = {
    "reassembler": "wire",
    "messages": "wire",
    "image": "images",
    "image-hex": "images",
    "image-srec": "images",
    "image-elf": "images",
    "manifest": "settings",
    "target-profile": "settings",
    "conformance-profile": "settings",
    "conformance-report": "settings",
    "release": "releases",
    "recipe": "line",
    "station": "line",
    "scans": "line",
    "plan": "plans",
    "trace-asc": "traces",
    "trace-blf": "traces",
    "trace-csv": "traces",
    "trace-db": "traces",
    "trace-gz": "traces",
    "trace-log": "traces",
    "trace-pcap": "traces",
    "trace-pcapng": "traces",
    "trace-trc": "traces",
    "bundle": "stories",
    "story": "stories",
    "bench-pages": "bench_pages",
    "station-pages": "station_pages",
    "certificate": "station_pages",
}
"""The module of each harness. A process imports one of them: to instrument all takes 12 s."""


@dataclass(frozen=True)
class Harness:
    """Part of flasher that reads input from outside."""

    run: Callable[[bytes], None]
    """Raises AssertionError if a property does not hold."""
    seeds: Callable[[], Iterable[bytes]]
    """Good inputs, made from what the tests have."""
    below: str
    """A function of flasher that every seed calls: a test lets it fail."""
    allowed: tuple[type[FlasherError], ...] = ()
    """Errors by which the part refuses an input."""
    max_size: int = 4096
    words: Callable[[], Iterable[str | bytes]] = tuple
    """What the format is made of, for the fuzzer's dictionary."""

    def take(self, data: bytes) -> None:
        """Run it on an input. Raises AssertionError beyond its limits, and any other error that the
        part may not raise.
        """
        peak_mb, began_s = _peak_mb(), time.process_time()
        try:
            self.run(data)
        except self.allowed as error:
            fault = fault_of(error)
            assert not fault, fault
        took_s = time.process_time() - began_s
        assert took_s <= LIMIT_S, f"{took_s:.1f} s of the processor"
        grown_mb = _peak_mb() - peak_mb
        assert grown_mb <= _MEMORY_MAX_MB, f"{grown_mb:.0f} MB of memory"

    def corpus(self, name: str) -> list[bytes]:
        """Seeds, and the inputs that fuzzing found."""
        kept = sorted((CORPUS / name).glob("*"))
        return [*self.seeds(), *(path.read_bytes() for path in kept)]


def find(name: str) -> Harness:
    """The harness of this name. Raises KeyError."""
    found: dict[str, Harness] = import_module(f"tests.fuzz.{MODULES[name]}").HARNESSES
    return found[name]


def _peak_mb() -> float:
    if sys.platform == "win32":
        return 0.0
    import resource  # noqa: PLC0415  Windows has none

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


# -- what harnesses share --------------------------------------------------------------------------


class Choices:
    """An input, as choices of a program and bytes for it. After its end all are 0."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        return int.from_bytes(self.take(1), "big")

    def number(self, size: int) -> int:
        return int.from_bytes(self.take(size), "big")

    def take(self, size: int) -> bytes:
        """The next bytes, fewer at the end."""
        found = self._data[self._at : self._at + size]
        self._at += size
        return found

    def rest(self) -> bytes:
        return self.take(len(self._data))


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """Removed when the process ends; a fuzzer's process is removed with all of its folder."""
    return tempfile.TemporaryDirectory(prefix="flasher-fuzz-")


_NUMBERS: Final = itertools.count()


def own_folder() -> Path:
    """A new folder."""
    path = Path(_folder().name) / str(next(_NUMBERS))
    path.mkdir()
    return path


@cache
def _scratch() -> Path:
    return own_folder()


@contextmanager
def own_words() -> Iterator[None]:
    """Around the reading of what flasher wrote itself, which it may not refuse."""
    try:
        yield
    except FlasherError as error:
        raise AssertionError(f"flasher refuses what it wrote: {error}") from error


def written(data: bytes, suffix: str) -> Path:
    """A file of these bytes, in the place of the last one of this suffix."""
    path = _scratch() / f"file{suffix}"
    path.write_bytes(data)
    return path
