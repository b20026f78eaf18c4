"""Which keys a scanner presses for a character."""

from __future__ import annotations

from flasher.station.keys import _CHARS

KEYS = {char: (code, at == 1) for code, pair in _CHARS.items() for at, char in enumerate(pair)}
"""Code of the key, and whether it is pressed with shift."""
