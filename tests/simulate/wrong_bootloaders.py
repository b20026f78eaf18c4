"""Bootloaders in Python with a flaw, for campaigns with `--subject`."""

from __future__ import annotations

from dataclasses import replace

from tests.peers.python_bootloader import PythonBootloader


class ReportsErrors(PythonBootloader):
    """Its flash reports errors, which it handles by a restart."""

    facts = replace(PythonBootloader.facts, abi=2)

    def start(self, host: object, cause: int) -> None:
        super().start(_Restarting(host), cause)  # type: ignore[arg-type]


class _Restarting:
    def __init__(self, host: object) -> None:
        self._host = host

    def __getattr__(self, name: str) -> object:
        return getattr(self._host, name)

    def flash_erase(self, offset: int) -> None:
        self._host.flash_erase(offset) or self._host.reset()  # type: ignore[attr-defined]

    def flash_write(self, offset: int, data: bytes) -> None:
        self._host.flash_write(offset, data) or self._host.reset()  # type: ignore[attr-defined]


class IgnoresErrors(PythonBootloader):
    facts = ReportsErrors.facts


class ForgetsTheRecord(PythonBootloader):
    """It starts what it received, until the power fails."""

    def _end(self) -> None:
        write = self.host.flash_write
        self.host.flash_write = lambda _offset, _data: True  # type: ignore[method-assign,assignment]
        super()._end()
        self.host.flash_write = write  # type: ignore[method-assign]


class TrustsTheRecord(PythonBootloader):
    """It erases the record last, and does not check what that describes."""

    def _begin(self, size: int) -> None:
        erase = self.host.flash_erase
        offsets: list[int] = []

        def note(offset: int) -> bool:
            offsets.append(offset)
            return True

        self.host.flash_erase = note  # type: ignore[method-assign]
        super()._begin(size)
        self.host.flash_erase = erase  # type: ignore[method-assign]
        for offset in reversed(offsets):
            erase(offset)

    def _is_whole(self) -> bool:
        return self.host.flash_read(0, 4) != b"\xff" * 4


class Crashes(PythonBootloader):
    def _store(self, data: bytes) -> None:
        super()._store(data)
        self._size // (self._stored - 2)


class Hangs(PythonBootloader):
    def _store(self, data: bytes) -> None:
        while True:
            pass


class Deaf(PythonBootloader):
    def _take_messages(self) -> None:
        pass
