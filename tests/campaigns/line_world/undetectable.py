"""Exchanges of units that nobody can detect, each with a name of its own.

What follows from one is no violation: it is counted under its name. Each is as narrow as what
cannot be seen; `docs/how-to/station_run.md` says why ("What nobody can detect").
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from flasher.mock.table import State
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.station.records.model import StepName

FASTEST_S: Final = 0.25
"""A unit that is put in sooner after the one before may announce itself as if it were that one."""
_LABEL: Final = re.compile(r"\bW2605\d{3}\b")
_KINDS: Final = ("NUMBER", "TOUCHED", "FALSE PASS")


@dataclass(frozen=True)
class Pulled:
    """A unit at the moment at which it was pulled out of its socket."""

    label: str
    at_s: float
    state: State
    """Of its device."""
    step: StepName | None
    """Of the run; None: none went on."""
    was_silent: bool
    """It had sent nothing for some time, before the run began if there was one."""


@dataclass(frozen=True)
class Exchange:
    """One unit was pulled out of a socket, and then another one was put in."""

    pulled: Pulled
    label: str
    """Of the other one."""
    gap_s: float
    is_new: bool
    """The other one runs the version of the recipe already."""


def _may_announce_itself(pulled: Pulled) -> bool:
    """It announces itself, has just done so, or is just being reset."""
    may_be_reset = pulled.step in (StepName.FLASH, StepName.RESTART)
    is_reset = pulled.state is State.APPLICATION and may_be_reset
    return is_reset or pulled.state in (State.ANNOUNCING, State.ERASING)


UNDETECTABLE: Final[Mapping[str, Callable[[Exchange], bool]]] = {
    "silent when its label was scanned": lambda each: each.pulled.was_silent,
    "as fast as the next announcement": lambda each: (
        each.gap_s <= FASTEST_S and _may_announce_itself(each.pulled)
    ),
    "between the confirmed reset and the announcement": lambda each: (
        each.pulled.state is State.RESTARTING
        and each.gap_s <= DEFAULT_TIMINGS.boot_version_timeout_s
    ),
    "between the complete image and the first answer": lambda each: (
        each.pulled.state is State.STARTING
        and each.is_new
        and each.gap_s <= DEFAULT_TIMINGS.application_start_timeout_s
    ),
}
"""Whether an exchange cannot be detected, by when it happened."""


class Exchanges:
    """All exchanges of a story."""

    def __init__(self) -> None:
        self._pulled: dict[str, Pulled] = {}
        """The last one, by socket."""
        self._all: list[Exchange] = []

    def pull(self, socket: str, pulled: Pulled) -> None:
        self._pulled[socket] = pulled

    def put(self, socket: str, label: str, now: float, *, is_new: bool) -> None:
        pulled = self._pulled.get(socket)
        if pulled is not None and pulled.label != label:
            self._all.append(Exchange(pulled, label, now - pulled.at_s, is_new))

    def reason_of(self, kind: str, text: str) -> str:
        """Why nobody could detect what a violation comes from; empty where somebody could. It comes
        from the last exchange of the two units that it names.
        """
        labels = set(_LABEL.findall(text))
        of_both = [each for each in self._all if {each.pulled.label, each.label} <= labels]
        if kind not in _KINDS or not of_both:
            return ""
        last = of_both[-1]
        return next((name for name, is_so in UNDETECTABLE.items() if is_so(last)), "")
