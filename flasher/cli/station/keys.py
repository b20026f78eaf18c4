"""Where scans come from while a station runs: keys on a terminal (a scanner is a keyboard), or the
lines of a pipe. Each is read by a thread, which only hands texts on.
"""

from __future__ import annotations

import codecs
import importlib
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, TextIO

_ESCAPES: Final = re.compile(r"\x1b(?:\[[0-9;?]*[ -/]*[@-~]|O.|.)?")
"""Arrows and other keys that are no text."""
_BACK: Final = "\x08\x7f"
_CLEAR: Final = "\x15\x03"
"""Ctrl-U."""
_LINE_MAX: Final = 300
_POLL_S: Final = 0.1
Submit = Callable[[str], None]


class Typing:
    """Puts keys together to lines. `text` is what stands there so far."""

    def __init__(self, submit: Submit) -> None:
        self.text = ""
        self._submit = submit

    def feed(self, keys: str) -> None:
        """Keys came."""
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
    """Lines of a pipe, each a scan, until its end."""

    def __init__(self, stream: TextIO, submit: Submit) -> None:
        self.is_at_end = False
        self._stream = stream
        self._submit = submit

    def start(self) -> None:
        """Read in a thread, which ends with the stream or the process."""
        threading.Thread(target=self.read, name="scans", daemon=True).start()

    def read(self) -> None:
        """Read to the end."""
        try:
            for line in self._stream:
                if line.strip():
                    self._submit(line)
        except (OSError, ValueError):
            pass  # closed, or no text: the end as well
        finally:
            self.is_at_end = True


@contextmanager
def keyboard(typing: Typing) -> Iterator[None]:
    """Read keys from the terminal into `typing` while the block runs, without echo; the terminal
    is as before afterwards.
    """
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
                    msvcrt.getwch()  # the second half of a key that is no text
                else:
                    typing.feed(key)

    yield work
