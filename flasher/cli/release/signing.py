"""Options of commands that sign: keys, and where their passphrases come from."""

from __future__ import annotations

import datetime
import getpass
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final

import click

from flasher.cli import values
from flasher.cli.framework import Decorator, option, option_set
from flasher.cli.terminal import check_can_ask
from flasher.errors import InterruptedByUserError, UsageError
from flasher.protocol.text import printable
from flasher.release.keys import SigningKey, open_key

_PASSPHRASE_MAX_SIZE: Final = 1024
_BUILD_TIME: Final = "SOURCE_DATE_EPOCH"
"""Variable with the time of a reproducible build, in seconds since 1970."""


@dataclass(frozen=True)
class Passphrases:
    """Source of passphrases: a variable, a file descriptor, or a question."""

    passphrase_env: Annotated[str | None, option(
        "--passphrase-env", metavar="NAME", panel="keys",
        help="read the passphrase or PIN from this environment variable, instead of asking",
    )]  # fmt: skip
    passphrase_fd: Annotated[int | None, option(
        "--passphrase-fd", type=values.number, metavar="N", panel="keys",
        help="read the passphrase or PIN from this open file descriptor: 0 is standard input",
    )]  # fmt: skip

    def reader(self) -> Callable[[str], str]:
        """Return what gives the passphrase of a named key. A descriptor is read once."""
        known: list[str] = []

        def read(name: str) -> str:
            if self.passphrase_env is not None:
                return self._of_variable(self.passphrase_env)
            if self.passphrase_fd is not None:
                known[:] = known or [_of_descriptor(self.passphrase_fd)]
                return known[0]
            return _ask(f"passphrase of {printable(name)}: ")

        return read

    def new(self, name: str) -> str:
        """Return the passphrase for a new key, asked for twice. Raises UsageError for none."""
        read = self.reader()
        passphrase = read(name)
        is_asked = self.passphrase_env is None and self.passphrase_fd is None
        if is_asked and _ask("the same again: ") != passphrase:
            raise UsageError("The two passphrases differ.", remedy="Run the command again.")
        if not passphrase:
            raise UsageError(
                "A key needs a passphrase: whoever copies its file could sign otherwise.",
                remedy="Give one.",
            )
        return passphrase

    def _of_variable(self, name: str) -> str:
        if name not in os.environ:
            raise UsageError(
                f"There is no environment variable {printable(name)}.",
                where="--passphrase-env",
                remedy="Name the variable that has the passphrase, not the passphrase itself.",
            )
        return os.environ[name]


passphrase_options: Final = option_set("passphrases", Passphrases)


def _of_descriptor(number: int) -> str:
    try:
        raw = os.read(number, _PASSPHRASE_MAX_SIZE)
    except OSError as error:
        raise UsageError(
            f"The file descriptor {number} cannot be read: {error.strerror}.",
            where="--passphrase-fd",
            remedy="Open it for the command, as in `--passphrase-fd 3 3<FILE`.",
        ) from error
    return raw.decode("utf-8", "surrogateescape").partition("\n")[0]


def _ask(question: str) -> str:
    check_can_ask("A passphrase is needed", "Use --passphrase-env or --passphrase-fd.")
    try:
        return getpass.getpass(question)
    except (KeyboardInterrupt, EOFError) as error:
        raise InterruptedByUserError(
            "Interrupted at the passphrase; nothing was signed."
        ) from error


def key_option(text: str) -> Decorator:
    """Declare --key, which may be repeated."""
    return option(
        "--key", "keys", multiple=True, required=True, metavar="KEY", panel="keys",
        type=values.FilePath(), brief=True,
        help=f"{text}: a private key file, or hsm:ID?label=LABEL in a token; may be repeated",
    )  # fmt: skip


def open_keys(names: tuple[str, ...], passphrases: Passphrases) -> list[SigningKey]:
    """Open private keys. Raises UsageError."""
    secret = passphrases.reader()
    return [open_key(name, secret) for name in names]


def today() -> str:
    """Return the day of a build: of SOURCE_DATE_EPOCH, else of the clock. Raises UsageError."""
    given = os.environ.get(_BUILD_TIME)
    try:
        seconds = time.time() if given is None else int(given)
        return datetime.datetime.fromtimestamp(seconds, datetime.UTC).date().isoformat()
    except (ValueError, OverflowError, OSError) as error:
        raise UsageError(
            f"{_BUILD_TIME} is no time: {given!a:.60}.",
            remedy="Set it to seconds since 1970, or unset it.",
        ) from error


def coming_date(text: str) -> str:
    """Parse a date that has not passed."""
    chosen = date(text)
    if chosen < datetime.datetime.now(datetime.UTC).date().isoformat():
        raise click.BadParameter(f"{chosen} has passed")
    return chosen


def date(text: str) -> str:
    """Parse a date, as 2027-11-24."""
    try:
        return datetime.date.fromisoformat(text).isoformat()
    except ValueError as error:
        raise click.BadParameter(f"{text!a} is not a date as 2027-11-24") from error
