"""Sources of scans for a running station: keys of a terminal, lines of a pipe, or a file.

Scanners act as keyboards. The labels of a file are submitted when units wait for them. Threads read
keys and lines, and only pass them on.
"""

from __future__ import annotations

import codecs
import importlib
import os
import re
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path
from typing import Any, Final, TextIO

from flasher.errors import ErrorCode, UsageError
from flasher.files import read
from flasher.protocol.text import printable
from flasher.station.scans import Label, ScanCommand, Word, understand
from flasher.station.socket import Socket

_ESCAPES: Final = re.compile(r"\x1b(?:\[[0-9;?]*[ -/]*[@-~]|O.|.)?")
"""Escape sequences of keys that type no character, such as arrows."""
_BACK: Final = "\x08\x7f"
_CLEAR: Final = "\x15\x03"
"""Ctrl-U."""
_LINE_MAX: Final = 300
_POLL_S: Final = 0.1
Submit = Callable[[str], None]
FILE_MAX_SIZE: Final = 4 * 1024 * 1024
"""Bytes."""
OPTION: Final = "--scans"
_AGAIN_MAX: Final = 3


def read_scans(path: Path) -> list[str]:
    """Read the scans of a file, without empty lines and comments (#). Raises UsageError."""
    shown = printable(str(path))
    raw = read(path, FILE_MAX_SIZE, what="file of scans")
    try:
        text = raw.decode("utf-8-sig")
    except ValueError as error:
        raise UsageError(
            f"{shown} is not a text file.", where=OPTION, code=ErrorCode.FILE_NOT_READ
        ) from error
    lines = [line.strip() for line in text.splitlines()]
    scans = [line for line in lines if line and not line.startswith("#")]
    if not scans:
        raise UsageError(
            f"{shown} contains no scans.",
            where=OPTION,
            remedy="Write one scan on each line: a label, or a command.",
        )
    return scans


class ScanFile:
    """Submits the scans of a file, without a time limit for units.

    A label goes to the socket of the command before it, or else to the next socket with a waiting
    unit; a virtual unit gets its own label if the file has it.
    """

    def __init__(
        self,
        scans: list[str],
        sockets: Collection[str],
        submit: Submit,
        *,
        badges: Collection[str] = (),
    ) -> None:
        """`badges`: scans that are not labels. Raises UsageError for an unknown socket."""
        names = {name.lower() for name in sockets}
        for each in map(understand, scans):
            if not isinstance(each, ScanCommand) or each.word is not Word.SOCKET:
                continue
            if each.argument.lower() not in names:
                raise UsageError(
                    f"The station has no socket {printable(each.argument)}.",
                    where=OPTION,
                    remedy=f"Its sockets are {', '.join(map(printable, sockets))}.",
                )
        self._badges = badges
        self.labels = frozenset(filter(self._is_label, scans))
        self._left = deque(scans)
        self._submit = submit
        self._again: Counter[str] = Counter()
        """Number of times that each label was submitted again."""

    @property
    def is_used_up(self) -> bool:
        """True if every scan was submitted."""
        return not self._left

    def turn(
        self,
        sockets: Iterable[Socket],
        virtual_labels: Mapping[str, str],
        exchanged: Collection[str] = (),
    ) -> None:
        """Submit the next scan if its unit waits. `virtual_labels`: labels of virtual units by
        socket; `exchanged`: labels of units taken out in their run, which are scanned again when
        the unit returns. Raises UsageError if no socket can detect units.
        """
        sockets = tuple(sockets)
        for socket in sockets:
            label = virtual_labels.get(socket.name, "")
            if socket.awaits_label and label in exchanged and self._again[label] < _AGAIN_MAX:
                self._again[label] += 1
                self._submit(f"{Word.SOCKET.value} {socket.name}")
                self._submit(label)
                return
        if not self._left:
            return
        working = [socket for socket in sockets if socket.can_work]
        if working and not any(socket.sees_units for socket in working):
            raise UsageError(
                "No socket of this station can detect whether a unit is in it.",
                where=OPTION,
                remedy="Scan each unit when it is in its socket.",
            )
        scan = understand(self._left[0])
        if self._is_label(self._left[0]):
            self._label(sockets, virtual_labels)
        elif isinstance(scan, ScanCommand) and scan.word is Word.SOCKET and len(self._left) > 1:
            named = next(e for e in sockets if e.name.lower() == scan.argument.lower())
            if named.awaits_label:
                self._submit(self._left.popleft())
                self._submit(self._left.popleft())
        else:
            self._submit(self._left.popleft())

    def _label(self, sockets: Iterable[Socket], virtual_labels: Mapping[str, str]) -> None:
        """Submit a label for a waiting unit."""
        ahead = list(takewhile(self._is_label, self._left))  # up to the next command
        for socket in sockets:
            if not (socket.awaits_label and socket.sees_units):
                continue
            own = virtual_labels.get(socket.name, "")
            # A virtual unit whose label comes later in the file waits for it.
            label = (
                own
                if own in ahead
                else next((e for e in ahead if e not in virtual_labels.values()), "")
            )
            if label:
                self._left.remove(label)
                self._submit(f"{Word.SOCKET.value} {socket.name}")
                self._submit(label)
                return

    def _is_label(self, text: str) -> bool:
        return isinstance(understand(text), Label) and text not in self._badges


# -- keys and lines --------------------------------------------------------------------------------


class Typing:
    """Builds lines from keys; `text` is the unfinished line."""

    def __init__(self, submit: Submit) -> None:
        self.text = ""
        self._submit = submit

    def feed(self, keys: str) -> None:
        for key in _ESCAPES.sub("", keys):
            if key in "\r\n":
                line, self.text = self.text, ""
                if line.strip():
                    self._submit(line)
            elif key in _BACK:
                self.text = self.text[:-1]
            elif key in _CLEAR:
                self.text = ""
            elif key.isprintable() and len(self.text) < _LINE_MAX:
                self.text += key


class LineReader:
    """Reads lines from a pipe and submits each as a scan."""

    def __init__(self, stream: TextIO, submit: Submit) -> None:
        self.is_at_end = False
        self._stream = stream
        self._submit = submit

    def start(self) -> None:
        """Read in a thread, which ends with the stream or the process."""
        threading.Thread(target=self.read, name="scans", daemon=True).start()

    def read(self) -> None:
        try:
            for line in self._stream:
                if line.strip():
                    self._submit(line)
        except (OSError, ValueError):
            pass  # a closed pipe, or one without text, has ended too
        finally:
            self.is_at_end = True


@contextmanager
def keyboard(typing: Typing) -> Iterator[None]:
    """Read keys of the terminal without echo while the block runs; restores the terminal."""
    ended = threading.Event()
    reader = _windows_keys if os.name == "nt" else _posix_keys
    with reader(typing, ended) as work:
        thread = threading.Thread(target=work, name="keys", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join(2 * _POLL_S)


@contextmanager
def _posix_keys(typing: Typing, ended: threading.Event) -> Iterator[Callable[[], None]]:
    termios: Any = importlib.import_module("termios")
    select: Any = importlib.import_module("select")
    descriptor = sys.stdin.fileno()
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")

    def work() -> None:
        while not ended.is_set():
            if select.select([descriptor], [], [], _POLL_S)[0]:
                data = os.read(descriptor, 4096)
                if not data:
                    return
                typing.feed(decoder.decode(data))

    before = termios.tcgetattr(descriptor)
    without = termios.tcgetattr(descriptor)
    # Signals (Ctrl-C) stay as they are.
    without[3] &= ~(termios.ECHO | termios.ICANON)
    termios.tcsetattr(descriptor, termios.TCSADRAIN, without)
    try:
        yield work
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


@contextmanager
def _windows_keys(typing: Typing, ended: threading.Event) -> Iterator[Callable[[], None]]:
    msvcrt: Any = importlib.import_module("msvcrt")

    def work() -> None:
        while not ended.wait(0.01):
            while msvcrt.kbhit():
                key = msvcrt.getwch()
                if key in "\x00\xe0":
                    msvcrt.getwch()  # the second half of a key that types no character
                else:
                    typing.feed(key)

    yield work
