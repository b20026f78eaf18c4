"""What a run yields: everything that the reports show, as data."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

from flasher.conformance.model import CaseResult, Status

SCHEMA_VERSION: Final = 1
_BAD: Final = frozenset({Status.FAIL, Status.ERROR, Status.NOT_RUN})


@dataclass(frozen=True)
class CaseText:
    """What a report says about a case beside its result."""

    id: str
    group: str
    title: str
    clause: str
    stimulus: str
    expectation: str
    requires: tuple[str, ...]
    choices: Mapping[str, str]
    """Keys of the profile that it was judged by, and what they said."""
    deviation: str = ""
    """The reason in the profile why the device may differ."""


@dataclass(frozen=True)
class Rescue:
    """A case after which the device was not reachable as it should be, and what brought it back."""

    case_id: str
    how: str


@dataclass(frozen=True)
class Report:
    """A run from its first case to the last. Times in seconds, on the bench's clock."""

    subject: str
    target: str
    bitrate_bps: int
    timestamp_source: str
    uncertainty_s: float
    profile_source: str
    profile: Mapping[str, str | int | float]
    """Every key of the profile with its value."""
    seed: str
    strict: bool
    cases: tuple[CaseText, ...]
    """The cases of `results`, each once, in the order of the catalogue."""
    results: tuple[CaseResult, ...]
    not_selected: tuple[str, ...] = ()
    """Cases that the selection left out."""
    host_cases: tuple[str, ...] = ()
    """Cases of the catalogue that concern the host, and are no part of this suite."""
    stopped: str = ""
    """Why the run ended before its end; empty for a whole one."""
    adapter_failed: bool = False
    """True when the adapter, or a command for power or readback, is what `stopped` is about."""
    not_upgradable: str = ""
    """Why the good image could not be flashed before the first case; the cases were run all the
    same, as the bootloader could be reached, and those that need an application have none."""
    killed_by: str = ""
    """The case after which the device could not be brought back."""
    rescues: tuple[Rescue, ...] = ()
    final_image: str = ""
    """What came of flashing and checking the good image at the end: "verified", or what failed."""
    duration_s: float = 0.0

    def count(self, status: Status) -> int:
        """How many results have that status."""
        return sum(result.status is status for result in self.results)

    @property
    def resolved_deviations(self) -> tuple[str, ...]:
        """Cases that pass although the profile documents a deviation."""
        return tuple(result.case_id for result in self.results if result.deviation_resolved)

    @property
    def ok(self) -> bool:
        """True when nothing failed, nothing was left out by a stop, and the good image is back."""
        if self.stopped or self.final_image != FINAL_IMAGE_OK:
            return False
        if self.strict and self.resolved_deviations:
            return False
        return not any(result.status in _BAD for result in self.results)

    def to_dict(self) -> dict[str, Any]:
        """The report in JSON's types. Frames are [seconds, "tx" or "rx", id, hex bytes, flags]."""
        plain = {
            field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self)
        }
        return {"schema": SCHEMA_VERSION, "ok": self.ok, **plain}


FINAL_IMAGE_OK: Final = "verified"


def _plain(value: Any) -> Any:
    if isinstance(value, CaseResult):
        fields = {
            field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
        fields["trace"] = [
            [entry.at_s, "tx" if entry.sent else "rx", entry.frame.can_id, entry.frame.data.hex()]
            + [
                flag
                for flag, is_set in zip(
                    ("extended", "remote", "error"), entry.frame[2:], strict=True
                )
                if is_set
            ]
            for entry in value.trace
        ]
        return fields
    if isinstance(value, Enum):
        return value.value
    if dataclasses.is_dataclass(value):
        return {
            field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value
