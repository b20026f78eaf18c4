"""Options of the device model, as given by `flasher mock --set KEY=VALUE`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from typing import TYPE_CHECKING

from flasher.errors import UsageError
from flasher.mock.profile import DeviceProfile
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from flasher.settings.toml_reader import Reader


@cache
def reader() -> Reader[DeviceProfile]:
    from flasher.settings.toml_reader import Reader  # noqa: PLC0415

    return Reader(DeviceProfile, "device model")


def set_option(profile: DeviceProfile, key: str, text: str) -> DeviceProfile:
    """Return `profile` with option `key` set from `text`.

    Integers accept 0x and the suffixes K and M. Raises UsageError for an unknown key, listing the
    known ones, and for an invalid value.
    """
    return reader().read({**asdict(profile), key: text}, "--set")


def set_options(profile: DeviceProfile, choices: Sequence[str]) -> DeviceProfile:
    """Return `profile` with options of the form KEY=VALUE. Raises UsageError."""
    for choice in choices:
        key, equals, value = choice.partition("=")
        if not equals:
            raise UsageError(f"--set {printable(choice)}: write KEY=VALUE.")
        profile = set_option(profile, key, value)
    return profile


def describe_options() -> list[tuple[str, str, str]]:
    """List all options as (key, allowed values with the default first, help text)."""
    described = []
    for key in reader().keys.values():
        default = "none" if key.default is None else str(key.default)
        words = [default, *(word for word in key.choices if word != default)]
        described.append((key.path, " | ".join(words), key.text))
    return described
