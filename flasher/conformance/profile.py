"""The product's documented choices, limits and deviations, as the suite judges by them.

A profile is a TOML file; every key has a default, and may carry a rationale:

    tx_02 = "nak_next"
    tx_12 = { value = "waits", rationale = "the transfer may be paused by the charger" }
    [limits]
    erase_s = 2.5
    [device]
    largest_image_bytes = 0x1C000
    [deviations]
    "TX-03" = "an older packet restarts the transfer; fixed in V1.1.0"
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from flasher.conformance.profile_keys import BY_PATH, CHOICES, DEVICE, KEYS, LIMITS, Key
from flasher.errors import UsageError, did_you_mean, printable
from flasher.files import read_toml

DEVIATIONS: Final = "deviations"
_TABLES: Final = (LIMITS, DEVICE)
_CASE_ID: Final = re.compile(r"[A-Z]{2}-\d\d")
Value = str | int | float


@dataclass(frozen=True)
class ConformanceProfile:
    """What differs from the defaults, by path (`tx_02`, `limits.erase_s`), with the rationales.

    `deviations` is case id to reason. Raises UsageError for an unknown key, a value that is not
    allowed, and values that contradict each other.
    """

    given: Mapping[str, Value] = field(default_factory=dict)
    rationales: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[str, str] = field(default_factory=dict)
    source: str = "defaults"

    def __post_init__(self) -> None:
        for path, value in self.given.items():
            key = BY_PATH.get(path)
            if key is None:
                raise _unknown(path, self.source)
            if not key.accepts(value):
                raise UsageError(
                    f"{path} cannot be {value!a:.60}.",
                    where=self.source,
                    remedy=f"It is {key.allowed}: {key.text}.",
                )
        for case_id in self.deviations:
            if not _CASE_ID.fullmatch(case_id):
                raise UsageError(
                    f"[deviations] names {case_id!a:.60}, which is no case.",
                    where=self.source,
                    remedy='Write the id of a case and a reason, as "TX-03" = "why".',
                )
        if self.number("largest_image_bytes") > self.number("application_bytes"):
            raise UsageError(
                "device.largest_image_bytes is more than device.application_bytes holds.",
                where=self.source,
            )
        if len(self.text("reset_data")) != self.number("reset_command") & 0xFF:
            raise UsageError(
                "device.reset_data does not have the size that device.reset_command says "
                "(its second byte).",
                where=self.source,
            )

    def choice(self, name: str) -> str:
        """The choice of that name ("tx_02"). Raises KeyError for one that does not exist."""
        return str(self.value(name))

    def limit(self, name: str) -> float:
        """The time of that name in the table `limits` ("erase_s"), in seconds."""
        return float(self.value(f"{LIMITS}.{name}"))

    def number(self, name: str) -> int:
        """The number of that name in the table `device` ("largest_image_bytes")."""
        return int(self.value(f"{DEVICE}.{name}"))

    def text(self, name: str) -> str:
        """The text of that name in the table `device` ("reset_data")."""
        return str(self.value(f"{DEVICE}.{name}"))

    def value(self, path: str) -> Value:
        """The value of any key by its path. Raises KeyError."""
        return self.given.get(path, BY_PATH[path].default)

    def to_toml(self) -> str:
        """The whole profile as a file: every key with its help, defaults as comments."""
        lines: list[str] = []
        for table in (CHOICES, *_TABLES):
            if table:
                lines += ["", f"[{table}]"]
            for key in KEYS:
                if key.table == table:
                    lines += [f"# {key.text} ({key.allowed})", self._line(key)]
        lines += ["", f"[{DEVIATIONS}]", '# "TX-03" = "why the product differs here"']
        lines += [f"{_quoted(name)} = {_quoted(why)}" for name, why in self.deviations.items()]
        return "\n".join(lines) + "\n"

    def _line(self, key: Key) -> str:
        value = self.value(key.path)
        shown = _quoted(value) if isinstance(value, str) else repr(value)
        why = self.rationales.get(key.path)
        if why is not None:
            shown = f"{{ value = {shown}, rationale = {_quoted(why)} }}"
        return f"{'' if key.path in self.given else '# '}{key.name} = {shown}"


def load_profile(path: str | os.PathLike[str]) -> ConformanceProfile:
    """Read a profile. Raises UsageError for a file that cannot be read, is no TOML, or holds what
    is not allowed.
    """
    return read_profile(read_toml(path, what="profile"), printable(os.fspath(path)))


def read_profile(document: Mapping[str, Any], source: str) -> ConformanceProfile:
    """A profile from what a TOML file holds. Raises UsageError."""
    given: dict[str, Value] = {}
    rationales: dict[str, str] = {}
    deviations: dict[str, str] = {}
    for name, content in document.items():
        if name not in (*_TABLES, DEVIATIONS):
            _take(name, content, given, rationales, source)
            continue
        if not isinstance(content, dict):
            raise UsageError(f"{name} is a table, [{name}].", where=source)
        for inner, value in content.items():
            if name != DEVIATIONS:
                _take(f"{name}.{inner}", value, given, rationales, source)
            elif isinstance(value, str) and value.strip():
                deviations[inner] = value
            else:
                raise UsageError(
                    f"The deviation of {inner!a:.60} has no reason.",
                    where=source,
                    remedy="Say in a text why the product differs.",
                )
    return ConformanceProfile(given, rationales, deviations, source)


def check_deviations(profile: ConformanceProfile, known: Collection[str]) -> None:
    """Raise UsageError when a deviation names a case that the suite does not have."""
    for case_id in profile.deviations:
        if case_id not in known:
            raise UsageError(
                f"[deviations] names {case_id}, which is no case of the suite.",
                where=profile.source,
                remedy=did_you_mean(case_id, known).rstrip(),
            )


def describe_keys() -> list[tuple[str, str, str, str]]:
    """All keys as (path, default, allowed values, help): the documentation's table."""
    return [(key.path, str(key.default), key.allowed, key.text) for key in KEYS]


def _take(
    path: str,
    content: object,
    given: dict[str, Value],
    rationales: dict[str, str],
    source: str,
) -> None:
    if path not in BY_PATH:
        raise _unknown(path, source)
    if isinstance(content, dict):
        rationale = content.get("rationale", "")
        if set(content) - {"value", "rationale"} or "value" not in content:
            raise UsageError(
                f"{path} is a value, or a table of value and rationale.",
                where=source,
                remedy=f'Write {path.rpartition(".")[2]} = {{ value = ..., rationale = "why" }}.',
            )
        if not isinstance(rationale, str):
            raise UsageError(f"The rationale of {path} is a text.", where=source)
        if rationale:
            rationales[path] = rationale
        content = content["value"]
    if not isinstance(content, str | int | float):
        content = repr(content)
    given[path] = content


def _unknown(path: str, source: str) -> UsageError:
    name = path.rpartition(".")[2]
    names = {key.name: key.path for key in KEYS}
    hint = did_you_mean(name, names, names.__getitem__)
    return UsageError(
        f"The profile has an unknown key {path!a:.80}.",
        where=source,
        remedy=f"{hint}Known: {', '.join(BY_PATH)}; and the table {DEVIATIONS}.",
    )


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
