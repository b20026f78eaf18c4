"""The options of the device model, as `flasher mock --set KEY=VALUE` gives them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from typing import TYPE_CHECKING

from flasher.errors import UsageError
from flasher.mock.profile import DeviceProfile
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from flasher.settings.reading import Reader


@cache
def reader() -> Reader[DeviceProfile]:
    from flasher.settings.reading import Reader  # noqa: PLC0415

    return Reader(DeviceProfile, "device model")


def set_option(profile: DeviceProfile, key: str, text: str) -> DeviceProfile:
    """`profile` with the option `key` set to what `text` says.

    Whole numbers take 0x and the suffixes K and M. Raises UsageError, naming what is known, for
    an unknown key and for a value that is not allowed.
    """
    return reader().read({**asdict(profile), key: text}, "--set")


def set_options(profile: DeviceProfile, choices: Sequence[str]) -> DeviceProfile:
    """`profile` with options that are each written as KEY=VALUE. Raises UsageError."""
    for choice in choices:
        key, equals, value = choice.partition("=")
        if not equals:
            raise UsageError(f"--set {printable(choice)}: write KEY=VALUE.")
        profile = set_option(profile, key, value)
    return profile


def describe_options() -> list[tuple[str, str, str]]:
    """All options as (key, allowed values with the default first, one line of help)."""
    described = []
    for key in reader().keys.values():
        default = "none" if key.default is None else str(key.default)
        words = [default, *(word for word in key.choices if word != default)]
        described.append((key.path, " | ".join(words), key.text))
    return described
