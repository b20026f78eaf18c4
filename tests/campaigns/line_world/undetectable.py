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

FASTEST_S: Final = 0.25
"""A unit that is put in sooner after the one before may announce itself as if it were that one."""
_LABEL: Final = re.compile(r"\bW2605\d{3}\b")
_KINDS: Final = ("NUMBER", "TOUCHED", "FALSE PASS")


@dataclass(frozen=True)
class Exchange:
    """One unit was pulled out of a socket, and then another one was put in."""

    pulled: str
    """Their labels."""
    put: str
    gap_s: float
    state: State
    """Of the device of the unit that was pulled, at that moment."""
    was_heard: bool
    """It has sent something since it was put in."""
    is_new: bool
    """The unit that was put in has the image of the recipe already."""


UNDETECTABLE: Final[Mapping[str, Callable[[Exchange], bool]]] = {
    "never heard, and exchanged": lambda each: not each.was_heard,
    "exchanged between two announcements": lambda each: (
        each.state is State.ANNOUNCING and each.gap_s <= FASTEST_S
    ),
    "exchanged between the confirmed reset and the announcement": lambda each: (
        each.state is State.RESTARTING and each.gap_s <= DEFAULT_TIMINGS.boot_version_timeout_s
    ),
    "exchanged between the end of the transfer and the first answer": lambda each: (
        each.state in (State.CHECKING, State.STARTING)
        and each.is_new
        and each.gap_s <= DEFAULT_TIMINGS.application_start_timeout_s
    ),
}
"""Whether an exchange cannot be detected, by the name of the reason."""


class Exchanges:
    """All exchanges of a story."""

    def __init__(self) -> None:
        self._pulled: dict[str, tuple[float, str, State, bool]] = {}
        self._all: list[Exchange] = []

    def pull(self, socket: str, label: str, now: float, state: State, *, was_heard: bool) -> None:
        self._pulled[socket] = now, label, state, was_heard

    def put(self, socket: str, label: str, now: float, *, is_new: bool) -> None:
        pulled_at, pulled, state, was_heard = self._pulled.get(
            socket, (now, label, State.OFF, True)
        )
        if pulled != label:
            self._all.append(Exchange(pulled, label, now - pulled_at, state, was_heard, is_new))

    def reason_of(self, kind: str, text: str) -> str:
        """Why nobody could detect what a violation comes from; empty where somebody could. It comes
        from the last exchange of the two units that it names.
        """
        labels = set(_LABEL.findall(text))
        of_both = [each for each in self._all if {each.pulled, each.put} <= labels]
        if kind not in _KINDS or not of_both:
            return ""
        last = of_both[-1]
        return next((name for name, is_so in UNDETECTABLE.items() if is_so(last)), "")
