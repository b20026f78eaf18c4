"""Runs a bootloader in C inside this process, for campaigns, where pipes take a third of the time.
Only for bootloaders that are known to return and to keep to their memory.
"""

from __future__ import annotations

import _ctypes
import ctypes
from typing import Final

from flasher.conformance.dut import Facts, pipes
from flasher.conformance.dut.pipes import HEADER, Pipe, PipeMessage
from flasher.conformance.dut.process import BootloaderProcess

CALLS: Final = ("read", "writev", "_exit", "dup", "dup2")
"""Calls of `flasher_dut_process.c` that `right_c_in_process.c` wraps."""


class _LibraryPipe(Pipe):
    """The messages that the library would read from and write to its pipes."""

    def __init__(self, path: str) -> None:
        super().__init__(-1, -1)
        self._library = ctypes.CDLL(path)
        self._exchange = self._library.exchange
        self._exchange.argtypes = (ctypes.c_char_p, ctypes.c_size_t, ctypes.c_void_p)
        self._exchange.restype = ctypes.c_size_t
        self._found = ctypes.c_void_p()
        self._found_at = ctypes.byref(self._found)
        self._input = b""

    def write(self, kind: PipeMessage, *parts: bytes) -> None:
        data = b"".join(parts)
        self._input += HEADER.pack(kind, len(data)) + data

    def fill(self) -> bool:
        data, self._input = self._input, b""
        size: int = self._exchange(data, len(data), self._found_at)
        self._buffer += ctypes.string_at(self._found.value or 0, size)
        return size > 0

    def close(self) -> None:
        _ctypes.dlclose(self._library._handle)


class LoadedBootloader(BootloaderProcess):
    """The bootloader of a shared library of `flasher_dut_process.c` and `right_c_in_process.c`,
    loaded anew at each start.
    """

    _loaded: _LibraryPipe | None = None

    @property
    def is_running(self) -> bool:
        return self._loaded is not None

    def start(self) -> Facts:
        self.kill()
        self._pipe = self._loaded = _LibraryPipe(self.subject)
        return pipes.unpack_facts(self._next("flasher_dut_about")[1])

    def kill(self) -> None:
        loaded, self._loaded = self._loaded, None
        if loaded is not None:
            loaded.close()

    def _next(self, doing: str) -> tuple[PipeMessage, bytes]:
        while (found := self._pipe.take()) is None:
            if not self._pipe.fill():
                raise AssertionError(f"the bootloader ended in {doing}")
        return found
