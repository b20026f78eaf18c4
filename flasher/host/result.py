"""What a session came to, and the error and the exit code that stand for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.errors import (
    ExitCode,
    FlasherError,
    NoAnswerError,
    TransferError,
    UnconfirmedError,
    VerificationError,
)
from flasher.host.outcome import Outcome
from flasher.host.verify import NOT_ASKED, Verification

_BY_LOST_POWER: Final = (NoAnswerError, TransferError, UnconfirmedError, VerificationError)
"""Errors that a battery which switched off explains."""


@dataclass(frozen=True)
class Result:
    """What a session came to: the upgrade's outcome, and what the verification found."""

    outcome: Outcome
    verification: Verification = NOT_ASKED
    shutdown_heard: bool = False
    """The battery sent SHUTDOWN while the session ran."""
    previous_version: str | None = None
    """What the application answered before the upgrade, escaped; None when it was not asked or did
    not answer."""

    @property
    def ok(self) -> bool:
        """True when the upgrade is good and nothing speaks against the new image."""
        return self.outcome.ok and self.verification.ok

    @property
    def exit_code(self) -> ExitCode:
        """The exit code that stands for it."""
        if self.outcome.nothing_to_do:
            return ExitCode.NOTHING_TO_DO
        error = self.error()
        return ExitCode.OK if error is None else error.exit_code

    @property
    def running_version(self) -> str | None:
        """What the application answered, wherever it was asked; escaped."""
        return self.verification.running_version or self.outcome.running_version

    def error(self) -> FlasherError | None:
        """The error that stands for it; None when it is good, or there was nothing to do."""
        error = self.outcome.error() or self.verification.error(self.outcome.target)
        if self.shutdown_heard and isinstance(error, _BY_LOST_POWER):
            error.cause = f"the battery sent SHUTDOWN and switched off; else {error.cause}"
        return error
