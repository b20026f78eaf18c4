"""Every way in which flasher can fail, with its exit code and what to do about it.

One tree. Each class carries the exit code of the command-line contract; each instance says what
happened, where (phase, packet), the likely cause, and what to do next. Nothing here prints or
exits: that is the command line's business.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Final

_PASSWORD: Final = re.compile(r"(:/+[^\s:@]*):[^@\n]*@(?:[^\s@]*@)*")
"""Between the user and the last @ of a URL: a password may hold an @ of its own."""
_NO_PORT: Final = re.compile(r"(:/+[^\s:/@]*):(?!\d+\b|\*+@)[^\s/@]+")
"""In the place of a port there is no number: the host was forgotten."""
_PASSWORD_KEY: Final = re.compile(r"(?i)([?&][^\s=&]*password=)[^\s&]*")


class ExitCode(IntEnum):
    """Exit codes of the command line (docs/reference/exit_codes.md)."""

    OK = 0
    INTERNAL = 1
    USAGE = 2
    IMAGE = 3
    BUS = 4
    NO_ANSWER = 5
    WRONG_DEVICE = 6
    TRANSFER = 7
    REFUSED = 8
    UNCONFIRMED = 9
    VERIFICATION = 10
    NOTHING_TO_DO = 11
    PARTIAL = 12
    INTERRUPTED = 130


def did_you_mean(
    word: str, known: Iterable[str], spelled: Callable[[str], str] = lambda known: known
) -> str:
    """The known word that was probably meant, `spelled` as people write it, as a sentence with a
    blank behind it; "" when none is close.
    """
    close = difflib.get_close_matches(word, list(known), n=1)
    return f"Did you mean {spelled(close[0])}? " if close else ""


def hide_passwords(text: str) -> str:
    """A text that may hold the URL of a database, without the password in it."""
    text = _NO_PORT.sub(r"\1:***", _PASSWORD.sub(r"\1:***@", text))
    return _PASSWORD_KEY.sub(r"\1***", text)


def printable(text: str) -> str:
    """`text` with everything but printable ASCII escaped."""
    return "".join(
        char if char.isascii() and char.isprintable() else char.encode("unicode_escape").decode()
        for char in text
    )


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong with a file: "target[0].base cannot be -1."."""

    place: str
    """The key, with the tables that it is in; "" is the whole file."""
    what: str
    remedy: str = ""
    alone: str = ""
    """Says it with its place, where it is the only fault; empty: as `said` does."""

    @property
    def said(self) -> str:
        """The fault with its place."""
        return self.what if self.what.startswith(self.place) else f"{self.place}: {self.what}"

    def __str__(self) -> str:
        return f"{self.said} {self.remedy}".rstrip()


class FlasherError(Exception):
    """Base of all errors that flasher raises on purpose.

    `what` is one sentence; `where`, `cause` and `remedy` complete it and may be empty. No password
    of a URL is in them.
    """

    exit_code: ClassVar[ExitCode] = ExitCode.INTERNAL

    def __init__(self, what: str, *, where: str = "", cause: str = "", remedy: str = "") -> None:
        self.what, self.where, self.cause, self.remedy = map(
            hide_passwords, (what, where, cause, remedy)
        )
        super().__init__(self.what)
        self.command = ""
        """The command that repairs what was left, to be copied as it stands; "" where none does."""
        self.needs_rescue = False
        """True when a device was left that has no application, or perhaps none."""
        self.faults: tuple[Fault, ...] = ()
        """Everything that is wrong with a file, where the error is about one."""

    def __str__(self) -> str:
        """The whole message, one part a line, as a person reads it."""
        lines = [self.what]
        if self.where:
            lines.append(f"  where: {self.where}")
        if self.cause:
            lines.append(f"  likely cause: {self.cause}")
        if self.remedy:
            lines.append(f"  what to do: {self.remedy}")
        if self.command:
            lines += ["  to repair it:", f"    {self.command}"]
        return "\n".join(lines)


class UsageError(FlasherError):
    """An argument or option makes no sense."""

    exit_code = ExitCode.USAGE


class ImageError(FlasherError):
    """The image cannot be used: unreadable, damaged, empty, too large, wrong range."""

    exit_code = ExitCode.IMAGE


class BusError(FlasherError):
    """The adapter or the bus failed."""

    exit_code = ExitCode.BUS


class TransmitBlockedError(BusError):
    """The adapter took no further frame within the time allowed for it."""


class NoAnswerError(FlasherError):
    """The device did not answer."""

    exit_code = ExitCode.NO_ANSWER


class WrongDeviceError(FlasherError):
    """Another device answers than the one that was asked for, or the image is not meant for it, or
    it is not in a state to be upgraded.
    """

    exit_code = ExitCode.WRONG_DEVICE


class TransferError(FlasherError):
    """The transfer failed: tries or attempts exhausted, or the device broke the protocol."""

    exit_code = ExitCode.TRANSFER


class RefusedError(FlasherError):
    """The device received everything and refused the image at the end."""

    exit_code = ExitCode.REFUSED


class UnconfirmedError(FlasherError):
    """Everything was sent and acknowledged, but the final answer never came."""

    exit_code = ExitCode.UNCONFIRMED


class VerificationError(FlasherError):
    """The application that runs after the upgrade is not the one that was sent."""

    exit_code = ExitCode.VERIFICATION


class InterruptedByUserError(FlasherError):
    """The user stopped the command."""

    exit_code = ExitCode.INTERRUPTED
