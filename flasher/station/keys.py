"""Decodes the key events of a scanner (a Linux input device) into scans.

Uses the US keyboard layout, the default of scanners. Times are arguments, in seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Final

PAUSE_S: Final = 2.0
"""A longer pause within a scan means that its end was lost."""
LENGTH_MAX: Final = 300

_ROWS: Final = (
    (2, "1234567890-=", "!@#$%^&*()_+"),
    (16, "qwertyuiop[]", "QWERTYUIOP{}"),
    (30, "asdfghjkl;'`", 'ASDFGHJKL:"~'),
    (43, "\\zxcvbnm,./", "|ZXCVBNM<>?"),
    (55, "*", "*"),
    (57, " ", " "),
    (71, "789-456+1230.", "789-456+1230."),
    (86, "\\", "|"),
    (98, "/", "/"),
)
"""Code of a row's first key, characters of its keys, and characters with shift."""
_CHARS: Final = {
    first + at: pair for first, *both in _ROWS for at, pair in enumerate(zip(*both, strict=True))
}
_ENDS: Final = frozenset({15, 28, 96})
"""Tab, Enter, and Enter of the number block."""
_SHIFTS: Final = frozenset({42, 54})
_SILENT: Final = frozenset({29, 97, 56, 100, 125, 126})
"""Ctrl, Alt and Meta: keys pressed with them type no characters."""
_CAPS_LOCK: Final = 58
_SYN, _KEY = 0, 1
_SYN_REPORT, _SYN_DROPPED = 0, 3
_RELEASED, _PRESSED = 0, 1


class ScanBuilder:
    """Builds scans from characters. Calls `submit` with each scan, or `damaged` for a part."""

    def __init__(self, submit: Callable[[str], None], damaged: Callable[[], None]) -> None:
        self._submit = submit
        self._damaged = damaged
        self._text = ""
        self._at_s = 0.0
        self._is_damaged = False

    def put(self, char: str, at_s: float) -> None:
        if self._text and at_s - self._at_s > PAUSE_S:
            self.drop()
        self._at_s = at_s
        if len(self._text) < LENGTH_MAX:
            self._text += char
        else:
            self._is_damaged = True

    def end(self, at_s: float) -> None:
        """Complete the scan."""
        if self._text and at_s - self._at_s > PAUSE_S:
            self._is_damaged = True
        if self._is_damaged:
            self.drop()
        elif self._text.strip():
            self._submit(self._text)
        self._text = ""

    def damage(self) -> None:
        """Mark the current scan as incomplete."""
        self._is_damaged = True

    def drop(self) -> None:
        """Discard an unfinished scan and report it as damaged."""
        if self._text or self._is_damaged:
            self._damaged()
        self._text, self._is_damaged = "", False


class KeyDecoder:
    """Decodes events of an input device. `held` returns the codes of keys that are down now; it is
    called after the device dropped events.
    """

    def __init__(self, builder: ScanBuilder, held: Callable[[], Collection[int]]) -> None:
        self._builder = builder
        self._ask_held = held
        self._held: set[int] = set()
        self._has_caps = False
        self._is_lost = False
        """The device dropped events; those up to the next report are ignored."""

    def feed(self, kind: int, code: int, value: int, at_s: float) -> None:
        if kind == _SYN:
            self._report(code)
        elif kind == _KEY and not self._is_lost:
            self._key(code, value, at_s)

    def _report(self, code: int) -> None:
        if code == _SYN_DROPPED:
            self._is_lost = True
            self._builder.damage()
        elif code == _SYN_REPORT and self._is_lost:
            self._is_lost, self._held = False, set(self._ask_held())

    def _key(self, code: int, value: int, at_s: float) -> None:
        if value == _RELEASED:
            self._held.discard(code)
        if value != _PRESSED:  # repeats of a held key are ignored
            return
        self._held.add(code)
        if code in _ENDS:
            self._builder.end(at_s)
        elif code == _CAPS_LOCK:
            self._has_caps = not self._has_caps
        elif code in _CHARS and not self._held & _SILENT:
            plain, shifted = _CHARS[code]
            is_upper = bool(self._held & _SHIFTS) != (self._has_caps and plain.isalpha())
            self._builder.put(shifted if is_upper else plain, at_s)
