"""Check digits of serial numbers, by the word that a recipe uses; python-stdnum calculates them."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Final

from stdnum import ean, luhn
from stdnum.iso7064 import mod_11_2, mod_11_10, mod_37_2, mod_37_36, mod_97_10


def _check(form: str, is_right: Callable[[str], bool]) -> Callable[[str], bool]:
    """A check of texts of this form; stdnum's own take more than their standards allow."""
    return lambda text: re.fullmatch(form, text) is not None and is_right(text)


def _gtin(text: str) -> bool:
    """Of any length: stdnum's `is_valid` knows no SSCC."""
    return bool(ean.calc_check_digit(text[:-1]) == text[-1])


CHECKS: Final = {
    "luhn": _check("[0-9]{2,}", luhn.is_valid),
    "gtin": _check("[0-9]{2,}", _gtin),
    "mod11-2": _check("[0-9]{2,}[0-9X]", mod_11_2.is_valid),
    "mod11-10": _check("[0-9]{2,}", mod_11_10.is_valid),
    "mod37-2": _check("[0-9A-Z]{2,}[0-9A-Z*]", mod_37_2.is_valid),
    "mod37-36": _check("[0-9A-Z]{2,}", mod_37_36.is_valid),
    "mod97-10": _check("[0-9A-Z]{3,}", mod_97_10.is_valid),
}
"""Each takes the whole text, check characters included; texts of another form are not valid."""
