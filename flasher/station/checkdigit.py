"""Check digits of serial numbers: small functions, each held against its standard's own example.

All take the whole text, check characters included, and raise nothing: a text with characters that
the method does not know is simply not valid.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

_DIGITS: Final = "0123456789"
_ALPHANUMERIC: Final = _DIGITS + "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def _values(text: str, alphabet: str) -> list[int] | None:
    """The characters as numbers; None when one is unknown, or there are fewer than 2."""
    values = [alphabet.find(char) for char in text]
    return values if len(values) >= 2 and min(values) >= 0 else None


def luhn(text: str) -> bool:
    """Luhn's formula (ISO/IEC 7812-1, annex B): every second digit from the right doubled."""
    values = _values(text, _DIGITS)
    if values is None:
        return False
    doubled = (sum(divmod(2 * value, 10)) for value in values[-2::-2])
    return (sum(values[-1::-2]) + sum(doubled)) % 10 == 0


def gtin(text: str) -> bool:
    """GS1's modulo 10 with the weights 3 and 1 (GTIN-8, 12, 13, 14, SSCC)."""
    values = _values(text, _DIGITS)
    return values is not None and (sum(values[-1::-2]) + 3 * sum(values[-2::-2])) % 10 == 0


def _pure(text: str, alphabet: str, check: str, modulus: int, radix: int) -> bool:
    """A pure system of ISO/IEC 7064 with one check character out of `check`."""
    values = _values(text[:-1], alphabet) if len(text) > 2 else None
    last = check.find(text[-1:]) if text else -1
    if values is None or last < 0:
        return False
    rest = 0
    for value in values:
        rest = (rest + value) * radix % modulus
    return (rest + last) % modulus == 1


def mod11_2(text: str) -> bool:
    """ISO/IEC 7064 MOD 11-2: digits, and a check digit that may be X."""
    return _pure(text, _DIGITS, _DIGITS + "X", 11, 2)


def mod37_2(text: str) -> bool:
    """ISO/IEC 7064 MOD 37-2: digits and letters, and a check character that may be *."""
    return _pure(text, _ALPHANUMERIC, _ALPHANUMERIC + "*", 37, 2)


def mod97_10(text: str) -> bool:
    """ISO/IEC 7064 MOD 97-10: digits, and two check digits. Letters count as 10 to 35, as in
    ISO 13616.
    """
    values = _values(text, _ALPHANUMERIC)
    if values is None or len(values) < 3:
        return False
    return int("".join(map(str, values))) % 97 == 1


def _hybrid(text: str, alphabet: str) -> bool:
    """A hybrid system of ISO/IEC 7064: modulus M + 1 and M, one check character."""
    values = _values(text, alphabet)
    if values is None:
        return False
    modulus = len(alphabet)
    rest = modulus
    for value in values[:-1]:
        rest = (rest + value) % modulus or modulus
        rest = rest * 2 % (modulus + 1)
    return (rest + values[-1]) % modulus == 1


def mod11_10(text: str) -> bool:
    """ISO/IEC 7064 MOD 11,10: digits."""
    return _hybrid(text, _DIGITS)


def mod37_36(text: str) -> bool:
    """ISO/IEC 7064 MOD 37,36: digits and letters."""
    return _hybrid(text, _ALPHANUMERIC)


CHECKS: Final[dict[str, Callable[[str], bool]]] = {
    "luhn": luhn,
    "gtin": gtin,
    "mod11-2": mod11_2,
    "mod11-10": mod11_10,
    "mod37-2": mod37_2,
    "mod37-36": mod37_36,
    "mod97-10": mod97_10,
}
"""By the word that a recipe uses."""
