"""Exchanges of units that cannot be detected, each with a name of its own.

What follows from one is no violation: it is counted under its name. Each is as narrow as what
cannot be detected; `docs/how-to/station_run.md` says why ("What cannot be detected").
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Final

from flasher.mock.table import BootloaderState
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.station.records.model import StepName
from tests.campaigns.line_world.promises import Violation

_LABEL: Final = re.compile(r"\bW2605\d{3}\b")
_AFTER_ITS_ANSWER: Final = ("NUMBER", "FALSE PASS")
"""Before these a unit is asked who it is."""
_KINDS: Final = (*_AFTER_ITS_ANSWER, "TOUCHED")


@dataclass(frozen=True)
class Pulled:
    """A unit at the moment at which it was pulled out of its socket."""

    label: str
    at_s: float
    last_word: BootloaderState | None
    """State of its device when its last message was received; None: since then it has begun another
    one, or its power came."""
    step: StepName | None
    """Of the run; None: none went on."""
    was_silent: bool
    """It had sent nothing for some time, before the run began if there was one."""
    sent_at_s: float = 0.0
    """When its last frame was received."""


@dataclass(frozen=True)
class Exchange:
    """One unit was pulled out of a socket, and then another one was put in."""

    pulled: Pulled
    socket: str
    label: str
    """Of the other one."""
    gap_s: float
    is_new: bool
    """The other one runs the version of the recipe already."""
    is_alike: bool
    """What the other one answers is no evidence."""
    is_observed: bool = True
    """The station has observed the socket since the last frame of the first one."""


UNDETECTABLE: Final[Mapping[str, Callable[[Exchange], bool]]] = {
    "silent when its label was scanned": lambda each: each.pulled.was_silent,
    "between the confirmed reset and the announcement": lambda each: (
        each.pulled.last_word is BootloaderState.RESTARTING
        and each.is_observed
        and each.gap_s <= DEFAULT_TIMINGS.boot_version_timeout_s
    ),
    "between the complete image and the first answer": lambda each: (
        each.pulled.last_word is BootloaderState.STARTING
        and each.pulled.step is StepName.FLASH
        and each.is_new
        and each.is_alike
        and each.is_observed
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

    def put(
        self,
        socket: str,
        label: str,
        now: float,
        *,
        is_new: bool,
        is_alike: bool,
        unobserved_until_s: float = -inf,
    ) -> None:
        """`unobserved_until_s`: when the socket was not observed last, for so long that a unit can
        be exchanged.
        """
        pulled = self._pulled.get(socket)
        if pulled is not None and pulled.label != label:
            gap_s, is_observed = now - pulled.at_s, unobserved_until_s <= pulled.sent_at_s
            self._all.append(Exchange(pulled, socket, label, gap_s, is_new, is_alike, is_observed))

    def reason_of(self, violation: Violation) -> str:
        """Why the cause of a violation was undetectable; empty where it was detectable. It comes
        from the last exchange in its socket of the two units that it names, or from exchanges that
        led from one to the other: all of them have to be undetectable.
        """
        if violation.kind not in _KINDS:
            return ""
        labels = set(_LABEL.findall(str(violation)))
        in_socket = [each for each in self._all if each.socket == violation.socket]
        chains = (_chain(in_socket[:end], labels) for end in range(len(in_socket), 0, -1))
        chain = next(filter(None, chains), [])
        if violation.kind in _AFTER_ITS_ANSWER and not all(each.is_alike for each in chain):
            return ""
        reasons = [
            next((name for name, is_so in UNDETECTABLE.items() if is_so(each)), "")
            for each in chain
        ]
        return reasons[-1] if reasons and all(reasons) else ""


def _chain(exchanges: list[Exchange], labels: set[str]) -> list[Exchange]:
    """Return the exchanges that lead from a unit with one of the labels to one with another, the
    last one of `exchanges` at their end; the run went on with the units between. May be empty.
    """
    *before, last = exchanges
    if last.label not in labels:
        return []
    chain = [last]
    for each in reversed(before):
        if chain[0].pulled.label in labels or chain[0].pulled.step is None:
            break
        if each.label == chain[0].pulled.label:
            chain.insert(0, each)
    return chain if chain[0].pulled.label in labels else []
