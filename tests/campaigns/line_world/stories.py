"""Stories of a line, as text that replays exactly: what there is, and who does what when.

A story is a list of clauses, one a line (or all in one line, parted by " ; "), as plans of an
upgrade are (`flasher.simulate.plan`):

    line sockets=2 recipe=writes
    unit label=1 number=none
    unit label=2 number=maker pace=slow
    person name=jo source=page
    @0.5 put unit=1 socket=A
    @3.2 card unit=1 by=jo
    @3.9 label unit=1 by=jo
    @4.61 pull unit=1
    @4.91 put unit=2 socket=A

Units and times are concrete; where a card belongs follows from where the unit is. People are
honest: an act that an honest person would not do at that moment (scan a label for a socket in
which another unit is; put a unit into a socket that waits for another label) is skipped, so that
any part of a story is a story again, which is what shrinking needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from flasher.simulate.plan import Clause, When, parse_clauses

Number = Literal["none", "empty", "own", "maker", "other"]
SOCKETS: Final = "ABC"


@dataclass(frozen=True, kw_only=True)
class LineSetup(Clause):
    """The station. `recipe=writes` gives each unit its number, `plain` writes none; `held` writes
    it and goes on after a restart, in fixtures that hold the unit; units of `bicycle` have a BMS
    and a WMC, those of `wmc` and `obc` a device that tells nothing of itself.
    """

    NAME = "line"
    sockets: int
    recipe: Literal["writes", "plain", "held", "bicycle", "wmc", "obc"] = "writes"

    @property
    def writes(self) -> bool:
        """Each unit gets its number."""
        return self.recipe in ("writes", "held", "bicycle")

    @property
    def tells(self) -> bool:
        """A unit can be asked who it is."""
        return self.recipe not in ("wmc", "obc")


@dataclass(frozen=True, kw_only=True)
class UnitSetup(Clause):
    """A unit with its paper label. Its number: none, an empty one, that of its label, one of its
    maker, or that of a label which is not its own.
    """

    NAME = "unit"
    label: int
    number: Number = "none"
    application: Literal["old", "new", "none"] = "old"
    """New: it runs the recipe's firmware already."""
    pace: Literal["fast", "slow"] = "fast"
    """Slow: half a second to erase, a quarter of a second a packet."""
    answers: bool = True
    """False: its application does not answer the question for its version."""


@dataclass(frozen=True, kw_only=True)
class Person(Clause):
    """Somebody who works at the line; people with one source share a scanner or a page.
    `mounted`: the scanners at the sockets.
    """

    name: str
    source: str = "page"


# -- what people do --------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Act(Clause):
    """Has a time."""

    NAME = ""


@dataclass(frozen=True, kw_only=True)
class Put(Act):
    NAME = "put"
    unit: int
    socket: str


@dataclass(frozen=True, kw_only=True)
class Pull(Act):
    """Take the unit out of the socket that it is in."""

    unit: int


@dataclass(frozen=True, kw_only=True)
class Scan(Act):
    by: str


@dataclass(frozen=True, kw_only=True)
class Card(Scan):
    """Scan the card of the socket that the unit is in; of `socket`, while it is in the hand."""

    unit: int
    socket: str = ""


@dataclass(frozen=True, kw_only=True)
class Label(Scan):
    NAME = "label"
    unit: int


@dataclass(frozen=True, kw_only=True)
class Cancel(Scan):
    NAME = "cancel"


@dataclass(frozen=True, kw_only=True)
class Free(Scan):
    """Scan FREE of a socket that is empty."""

    socket: str


@dataclass(frozen=True, kw_only=True)
class Abort(Scan):
    """Scan ABORT of a socket."""

    socket: str


@dataclass(frozen=True, kw_only=True)
class Resume(Scan):
    """Scan RESUME, when the line has stopped."""


@dataclass(frozen=True, kw_only=True)
class Look(Act):
    """Do nothing: time passes."""


# -- what befalls them -----------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Sleep(Act):
    """A unit neither hears nor speaks for a time; its supply stays on."""

    unit: int
    seconds: float = 3.0


@dataclass(frozen=True, kw_only=True)
class Dip(Act):
    """The supply of a socket fails for a time."""

    socket: str
    seconds: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Stall(Act):
    """The process of a socket stalls for a time."""

    socket: str
    seconds: float = 1.0


@dataclass(frozen=True, kw_only=True)
class KillWorker(Act):
    NAME = "worker"
    socket: str


@dataclass(frozen=True, kw_only=True)
class KillStation(Act):
    """The station dies, and is started again after some seconds."""

    NAME = "station"
    seconds: float = 2.0


@dataclass(frozen=True, kw_only=True)
class KillPower(Act):
    """Nothing at the line has power for a time: units, the computer, the station."""

    NAME = "power"
    seconds: float = 2.0


@dataclass(frozen=True, kw_only=True)
class Unplug(Act):
    """The adapter of a socket is pulled out for a time."""

    socket: str
    seconds: float = 1.0


@dataclass(frozen=True, kw_only=True)
class FillDisk(Act):
    """Nothing can be saved for a time."""

    NAME = "disk"
    seconds: float = 4.0


CLAUSES: Final[dict[str, type[Clause]]] = {
    kind.NAME: kind
    for kind in (
        LineSetup, UnitSetup, Person, Put, Pull, Card, Label, Cancel, Free, Abort, Look, Sleep, Dip,
        Stall, KillWorker, KillStation, KillPower, Unplug, FillDisk, Resume,
    )
}  # fmt: skip


@dataclass(frozen=True)
class Story:
    """What there is, and what happens."""

    line: LineSetup
    units: Sequence[UnitSetup]
    people: Sequence[Person]
    acts: Sequence[Act]
    """In the order of their times."""

    def __str__(self) -> str:
        return " ; ".join(map(str, (self.line, *self.units, *self.people, *self.acts)))

    @classmethod
    def parse(cls, text: str) -> Story:
        clauses = list(parse_clauses(text, CLAUSES))
        acts = [each for each in clauses if isinstance(each, Act)]
        return cls(
            next((each for each in clauses if isinstance(each, LineSetup)), LineSetup(sockets=2)),
            [each for each in clauses if isinstance(each, UnitSetup)],
            [each for each in clauses if isinstance(each, Person)] or [Person(name="jo")],
            sorted(acts, key=time_of),
        )


def time_of(act: Act) -> float:
    return act.when.plus_s if act.when is not None else 0.0


def at(moment: float) -> When:
    """A time of a story: with microseconds, so that its text is exact."""
    return When(plus_s=round(moment, 6))
