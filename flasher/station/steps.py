"""The steps of a run, and how far a target is verified: words that recipe and records share."""

from __future__ import annotations

from enum import IntEnum, StrEnum


class StepName(StrEnum):
    """A step of a run, in the order in which they come."""

    CONNECT = "connect"
    IDENTIFY = "identify"
    CHECK = "check"
    FLASH = "flash"
    WRITE = "write"
    RESTART = "restart"
    VERIFY = "verify"
    SAVE = "save"


class Verified(IntEnum):
    """How far a target was verified; more is greater."""

    COMPLETED = 0
    """The device confirmed the complete image; nothing was read back."""
    VERSION = 1
    """The new application runs and names the version of the image."""
    MEMORY = 2
    """Version, and every byte of the image read back."""

    @property
    def words(self) -> str:
        """As a person reads it."""
        return _WORDS[self]


_WORDS = {
    Verified.COMPLETED: "completed, not read back",
    Verified.VERSION: "version read back",
    Verified.MEMORY: "memory read back",
}
