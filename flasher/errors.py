"""Exceptions with exit code, error code, likely cause and remedy; hiding of passwords.

Each class has the exit code of the command line; each instance describes what happened, where
(phase, packet), the likely cause, and the next step. Printing and exiting are left to the command
line.
"""

from __future__ import annotations

import difflib
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import ClassVar, Final, Self

from flasher.builds import is_whole

_NEW: Final = "flasher-env"
"""Environment that a message proposes where no package can be added to this build."""
_PASSWORD: Final = re.compile(r"(:/+[^\s:@]*):[^@\n]*@(?:[^\s@]*@)*")
"""Matches from the user to the last @ of a URL: a password may contain an @."""
_NO_PORT: Final = re.compile(r"(:/+[^\s:/@]*):(?!\d+\b|\*+@)[^\s/@]+")
"""Matches a port that is not a number: a password of a URL without host."""
_SECRET_WORD: Final = r"(?:password|passwd|passphrase|secret|token|api_?key)"  # noqa: S105  a pattern
_SECRET_PART: Final = re.compile(_SECRET_WORD, re.IGNORECASE)
_SECRET_NAME: Final = rf"[\w-]*{_SECRET_WORD}[\w-]*"
_SECRET: Final = re.compile(_SECRET_NAME, re.IGNORECASE)
_IN_QUERY: Final = re.compile(rf"(?i)([?&]{_SECRET_NAME}=)[^\s&]*")
"""Matches a secret in the query of a URL."""
_ARGUMENT: Final = re.compile(
    rf"(?i)(?<![\w?&-])({_SECRET_NAME}=)(?!\*\*\*['\")]*(?:[\s,]|$))(?:'[^']*'|\"[^\"]*\"|\S+?(?=['\"]?(?:\s|$)))"
)
"""Matches a secret in arguments: `--bus-kwargs password=X`, `Bus(password='X')`."""
_WORD: Final = re.compile(rf"(?is)((?:--[\w-]+=)?{_SECRET_NAME}=).*")
"""Matches a whole command-line argument with a secret."""
_IN_DICT: Final = re.compile(rf"(?i)((['\"]){_SECRET_NAME}\2: )(?:'[^']*'|\"[^\"]*\"|[^\s,}}]+)")
"""Matches a secret in a Python dictionary or in JSON."""


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


class ErrorCode(StrEnum):
    """Error codes, printed after each error and explained by `flasher help CODE` and
    flasher/error_codes.md. The digits before the last two are the exit code.
    """

    BUG = "E100"
    INTERRUPTED = "E130"
    """Same as the exit code."""
    USAGE = "E200"
    FILE_NOT_READ = "E201"
    FILE_NOT_WRITTEN = "E202"
    FILE_FAULTS = "E203"
    PACKAGE_MISSING = "E204"
    WHICH_ADAPTER = "E205"
    NOT_CONFIRMED = "E206"
    PAGES_NOT_SERVED = "E207"
    UNFINISHED = "E208"
    FILE_NOT_TRUSTED = "E209"
    RECORDS = "E210"
    RECORDS_NO_ROOM = "E211"
    RECORDS_LOCKED = "E212"
    RECORDS_READ_ONLY = "E213"
    RECORDS_DAMAGED = "E214"
    RECORDS_VERSION = "E215"
    RECORDS_RULE = "E216"
    RECORDS_MOVED = "E217"
    RECORDS_NOT_FOUND = "E218"
    STATION_RUNNING = "E219"
    STATION_KEY = "E220"
    RECORDS_CUT = "E221"
    TRUST_FILE = "E222"
    TRUST_ROLLED_BACK = "E223"
    TRUST_MISSING = "E224"
    SIGNING_KEY = "E225"
    CLAIM_REFUSED = "E230"
    IMAGE = "E300"
    IMAGE_DAMAGED = "E301"
    IMAGE_EMPTY = "E302"
    IMAGE_TOO_LARGE = "E303"
    IMAGE_GAP = "E304"
    IMAGE_CONFLICT = "E305"
    IMAGE_IMPLAUSIBLE = "E306"
    IMAGE_OUTSIDE = "E307"
    MANIFEST = "E308"
    IMAGE_SAMPLE = "E309"
    IMAGE_READINGS = "E310"
    RELEASE_DAMAGED = "E311"
    RELEASE_UNSIGNED = "E312"
    RELEASE_DIFFERS = "E313"
    RELEASE_EXPIRED = "E314"
    RELEASE_OLD = "E315"
    RELEASE_LOG = "E316"
    BUS = "E400"
    ADAPTER_NOT_OPENED = "E401"
    ADAPTER_IN_USE = "E402"
    ADAPTER_LOST = "E403"
    SEND_BLOCKED = "E404"
    NOBODY_ACKNOWLEDGES = "E405"
    BUS_OFF = "E406"
    SECOND_TOOL = "E407"
    OTHER_BIT_RATE = "E408"
    NO_ADAPTER = "E409"
    COMMAND_FAILED = "E410"
    NO_SOCKET = "E411"
    DOCTOR = "E412"
    NO_ANSWER = "E500"
    NOBODY_HEARD = "E501"
    NOT_IN_DOCUMENTS = "E502"
    NO_BOOT_VERSION = "E503"
    NO_ANNOUNCEMENT = "E504"
    NO_REQUEST = "E505"
    UNHEARING = "E506"
    WRONG_DEVICE = "E600"
    NOT_FOR_DEVICE = "E601"
    BOOT_TOO_OLD = "E602"
    UNCHECKED = "E603"
    VEHICLE_IN_USE = "E604"
    TWO_DEVICES = "E605"
    LOW_CHARGE = "E606"
    NOT_TRUSTED = "E607"
    OTHER_UNIT = "E608"
    TRANSFER = "E700"
    PACKET_FAILED = "E701"
    RESTARTED = "E702"
    BROKEN_PROTOCOL = "E703"
    REFUSED = "E800"
    UNCONFIRMED = "E900"
    VERIFICATION = "E1000"
    OTHER_VERSION = "E1001"
    WRITE_DIFFERS = "E1002"
    RECORDS_UNPROVEN = "E1003"
    IN_BOOTLOADER = "E1004"


def did_you_mean(
    word: str, known: Iterable[str], spelled: Callable[[str], str] = lambda known: known
) -> str:
    """Suggest the closest known word as a sentence with a trailing space; "" if none is close."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f"Did you mean {spelled(close[0])}? " if close else ""


def install_command(*requirements: str) -> str:
    """Return the command that installs packages into the running Python, quoted for the shell;
    where that cannot be, into a new environment, with the wheel of this version, which is here.
    """
    is_windows, whole = os.name == "nt", is_whole()
    if whole and not any(each.startswith(_wheel()) for each in requirements):
        requirements = (_wheel(), *requirements)
    python = sys.executable
    if whole:
        python = rf"{_NEW}\Scripts\python" if is_windows else f"{_NEW}/bin/python"
    words = [python, "-m", "pip", "install", *requirements]
    before = f"{'py' if is_windows else 'python3'} -m venv {_NEW} && " if whole else ""
    if is_windows:
        from subprocess import list2cmdline  # noqa: PLC0415  slow, and for this alone

        return before + list2cmdline(words)
    return before + shlex.join(words)


def _wheel() -> str:
    from importlib.metadata import version  # noqa: PLC0415  for this alone

    return f"./welling_flasher-{version('welling-flasher')}-py3-none-any.whl"


def how_to_install(extra: str) -> str:
    """Return the remedy for missing packages of an extra of flasher."""
    if is_whole():
        command = install_command(f"{_wheel()}[{extra}]")
        return f"This build cannot be extended. In the folder with the wheel: {command}"
    command = install_command("-c", ".ci/constraints.txt", f".[{extra}]")
    return f"In the checkout: {command}"


def hide_passwords(text: str) -> str:
    """Replace passwords in a text with database URLs or arguments."""
    if ":/" in text:
        text = _NO_PORT.sub(r"\1:***", _PASSWORD.sub(r"\1:***@", text))
    if _SECRET_PART.search(text):  # hardly any text has one, and the others take long to find none
        for secret in (_IN_QUERY, _ARGUMENT, _IN_DICT):
            text = secret.sub(r"\1***", text)
    return text


def without_password(word: str) -> str:
    """Replace the password in a command-line argument."""
    whole = _WORD.fullmatch(word)
    return hide_passwords(word) if whole is None else f"{whole[1]}***"


def is_secret(name: str) -> bool:
    """True if an argument of this name contains a secret."""
    return _SECRET.fullmatch(name) is not None


def printable(text: str) -> str:
    """Escape all characters except printable ASCII."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        char if char.isascii() and char.isprintable() else char.encode("unicode_escape").decode()
        for char in text
    )


def _hidden(text: str) -> str:
    """Replace passwords; a translatable sentence without any stays one."""
    hidden = hide_passwords(text)
    return text if hidden == text else hidden


@dataclass(frozen=True)
class Fault:
    """Problem in a file: "target[0].base cannot be -1."."""

    place: str
    """Key with its tables; "" for the whole file."""
    what: str
    remedy: str = ""
    alone: str = ""
    """Message with its place, for a file without other problems; empty: `sentence`."""

    @property
    def sentence(self) -> str:
        """Message with its place."""
        return self.what if self.what.startswith(self.place) else f"{self.place}: {self.what}"

    def __str__(self) -> str:
        return f"{self.sentence} {self.remedy}".rstrip()


class FlasherError(Exception):
    """Base class of all errors that flasher raises on purpose.

    `what` is one sentence; `where`, `cause` and `remedy` complete it and may be empty. Passwords in
    URLs are removed.
    """

    exit_code: ClassVar[ExitCode] = ExitCode.INTERNAL
    default_code: ClassVar[ErrorCode] = ErrorCode.BUG

    def __init__(
        self,
        what: str,
        *,
        where: str = "",
        cause: str = "",
        remedy: str = "",
        code: ErrorCode | None = None,
    ) -> None:
        self.what, self.where, self.cause, self.remedy = map(_hidden, (what, where, cause, remedy))
        super().__init__(self.what)
        self.code = code or self.default_code
        self.command = ""
        """Command that repairs the state, ready to be copied; "" without one."""
        self.needs_rescue = False
        """True if a device was left without an application, or perhaps without one."""
        self.waiver = ""
        """Check of flasher.host.waivers that refused, if it can be waived."""
        self.faults: tuple[Fault, ...] = ()
        """All problems of a file."""

    def with_faults(self, faults: Iterable[Fault]) -> Self:
        """Return this error with these problems of a file."""
        self.faults = tuple(faults)
        if self.code is ErrorCode.USAGE:
            self.code = ErrorCode.FILE_FAULTS
        return self

    def __str__(self) -> str:
        """Return the whole message, one part per line."""
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
    """Invalid argument or option."""

    exit_code = ExitCode.USAGE
    default_code = ErrorCode.USAGE


class ImageError(FlasherError):
    """Unusable image: unreadable, damaged, empty, too large, wrong range."""

    exit_code = ExitCode.IMAGE
    default_code = ErrorCode.IMAGE


class BusError(FlasherError):
    """The adapter or the bus failed."""

    exit_code = ExitCode.BUS
    default_code = ErrorCode.BUS


class TransmitBlockedError(BusError):
    """The adapter accepted no frame within the time limit."""

    default_code = ErrorCode.SEND_BLOCKED


class NoAnswerError(FlasherError):
    """The device did not answer."""

    exit_code = ExitCode.NO_ANSWER
    default_code = ErrorCode.NO_ANSWER


class WrongDeviceError(FlasherError):
    """Another device answers, the image is not meant for it, or it is not ready for an upgrade."""

    exit_code = ExitCode.WRONG_DEVICE
    default_code = ErrorCode.WRONG_DEVICE


class TransferError(FlasherError):
    """The transfer failed: tries or attempts exhausted, or the device broke the protocol."""

    exit_code = ExitCode.TRANSFER
    default_code = ErrorCode.TRANSFER


class RefusedError(FlasherError):
    """The device received everything and refused the image at the end."""

    exit_code = ExitCode.REFUSED
    default_code = ErrorCode.REFUSED


class UnconfirmedError(FlasherError):
    """Everything was sent and acknowledged, but the final answer never came."""

    exit_code = ExitCode.UNCONFIRMED
    default_code = ErrorCode.UNCONFIRMED


class VerificationError(FlasherError):
    """The application after the upgrade is not the one sent."""

    exit_code = ExitCode.VERIFICATION
    default_code = ErrorCode.VERIFICATION


class InterruptedByUserError(FlasherError):
    """The user stopped the command."""

    exit_code = ExitCode.INTERRUPTED
    default_code = ErrorCode.INTERRUPTED
