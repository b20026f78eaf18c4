"""PINs of badges: format and argon2 hashes."""

from __future__ import annotations

import re
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Final

from argon2 import PasswordHasher, extract_parameters
from argon2.exceptions import InvalidHashError, VerificationError
from argon2.low_level import Type

_FORM: Final = re.compile(r"[0-9]{4,12}", re.ASCII)
FORM_WORDS: Final = "4 to 12 digits"
_MEMORY_MAX_KIB: Final = 1024 * 1024
_ROUNDS_MAX: Final = 20
"""Time cost from which a hash is refused: checking it would delay the line."""


@dataclass(frozen=True)
class Pin:
    """A typed PIN; its repr does not contain it."""

    text: str = field(repr=False)


def is_form(text: str) -> bool:
    """True for a text with the format of a PIN."""
    return _FORM.fullmatch(text) is not None


def hash_of(pin: Pin) -> str:
    """Hash a PIN for the badge table."""
    return PasswordHasher().hash(pin.text)


def checker() -> Executor:
    """Make an executor that checks PINs one at a time, since each check takes 64 MiB."""
    return ThreadPoolExecutor(1, "pins")


def is_right(pin: Pin, pin_hash: str) -> bool:
    """True if the hash is of this PIN. Takes about 50 ms, which slows down guessing."""
    try:
        return PasswordHasher().verify(pin_hash, pin.text)
    except VerificationError:
        return False


def check_hash(pin_hash: str) -> None:
    """Check that a text is the hash of a PIN. Raises ValueError, without the text."""
    try:
        parameters = extract_parameters(pin_hash)
    except InvalidHashError:
        parameters = None
    if parameters is None or parameters.type is not Type.ID:
        raise ValueError("must be an argon2id hash; flasher station pin makes one")
    if parameters.memory_cost > _MEMORY_MAX_KIB or parameters.time_cost > _ROUNDS_MAX:
        raise ValueError("takes too long to check; flasher station pin makes another hash")
