"""A question before something that cannot be taken back."""

from __future__ import annotations

import sys

from flasher.errors import InterruptedByUserError


def can_ask() -> bool:
    """True where somebody reads and answers."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def agrees(question: str, *, interrupted: str) -> bool:
    """Ask; True for yes. Raises InterruptedByUserError, which says `interrupted`, for Ctrl-C."""
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    try:
        answer = sys.stdin.readline()
    except KeyboardInterrupt as interrupt:
        sys.stderr.write("\n")
        raise InterruptedByUserError(f"Interrupted at the question: {interrupted}") from interrupt
    return answer.strip().lower() in {"y", "yes"}
