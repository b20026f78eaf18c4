"""Plans: what there is on the bus, and what happens when, as text that replays a run exactly.

A plan is a list of clauses, one a line (or all in one line, parted by " ; "):

    world target=bms packets=40
    stranger erase=0.31 session=0.0
    stranger late=0.000117 application=none
    @packet12 lose sender=device count=2
    @packet20+0.0131 power seconds=1.2
    @update+0.2 unplug seconds=0.4

A clause is a name and the fields of its type that are not the default. Without a time it holds from
the beginning; `@1.25` is seconds since then, `@packet12`, `@reset`, `@update`, `@end` the moment at
which the host first begins to send that message, `@frame512` a frame on the bus, and `+0.0131` so
much later. The first device is the one that is meant, a second one its twin.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar, Final, Literal, get_args, get_origin, get_type_hints

from flasher.mock.profile import DeviceProfile
from tests.campaigns.world.stranger import Choices

Sender = Literal["any", "host", "device"]
_WHEN: Final = re.compile(
    r"@(?:(?P<at>\d+(?:\.\d+)?(?:e-?\d+)?)|(?P<what>packet|frame|reset|update|end)(?P<number>\d*))"
    r"(?:\+(?P<plus>\d+(?:\.\d+)?(?:e-?\d+)?))?"
)


@dataclass(frozen=True)
class When:
    """A moment: seconds since the beginning, or since the `number`th `what` began."""

    what: str = ""
    number: int = 0
    plus_s: float = 0.0

    def __str__(self) -> str:
        if not self.what:
            return f"@{self.plus_s!r}"
        number = str(self.number) if self.what in ("packet", "frame") else ""
        return f"@{self.what}{number}" + (f"+{self.plus_s!r}" if self.plus_s else "")

    @classmethod
    def parse(cls, text: str) -> When:
        found = _WHEN.fullmatch(text)
        if found is None:
            raise ValueError(f"{text!r} is no time of a plan")
        if found["at"]:
            return cls(plus_s=float(found["at"]))
        return cls(found["what"], int(found["number"] or 0), float(found["plus"] or 0))


@dataclass(frozen=True, kw_only=True)
class Clause:
    """One line of a plan."""

    NAME: ClassVar[str]
    when: When | None = None

    def __str__(self) -> str:
        words = [] if self.when is None else [str(self.when)]
        words.append(self.NAME)
        for known in fields(self):
            value = getattr(self, known.name)
            default = known.default if known.default_factory is MISSING else None
            if known.name != "when" and value != default:
                words += [value] if known.name == "choices" else [f"{known.name}={_text(value)}"]
        return " ".join(word for word in words if word)


# -- what there is --------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class World(Clause):
    """The job, and the bus around it."""

    NAME = "world"
    target: Literal["bms", "wmc", "obc"] = "bms"
    packets: int = 20
    image: int = 5
    """The seed of the image's bytes."""
    others: bool = True
    """Somebody else acknowledges; False: the devices and the tool are alone on the bus."""
    attempts: int = 0
    """0: the default."""
    tries: int = 0
    timeout: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Adapter(Clause):
    """How the host's adapter gives its own frames back."""

    NAME = "adapter"
    echoes: bool = True
    delay: float = 0.0
    """Seconds from the end of a frame to its echo."""
    jitter: float = 0.0
    """Up to so much more; later echoes overtake."""
    lost: float = 0.0
    """Share of the echoes that never come."""
    doubled: float = 0.0
    """Share that comes twice."""
    seed: int = 1


@dataclass(frozen=True, kw_only=True)
class Device(Clause):
    """A device; with a time, one that is connected then."""

    application: Literal["old", "none"] = "old"
    version: str = "V1r0r0_20220512"
    """What the old application names."""
    begins: Literal["application", "boot", "off"] = "application"
    """`boot`: it is switched on at the beginning."""


@dataclass(frozen=True, kw_only=True)
class Strange(Device):
    """A device written from the document alone."""

    NAME = "stranger"
    choices: str = ""
    """Fields of `Choices`."""

    def chosen(self) -> Choices:
        return Choices(**_values(Choices, self.choices.split()))


@dataclass(frozen=True, kw_only=True)
class Mock(Device):
    """flasher's own device model."""

    NAME = "mock"
    choices: str = ""
    """Fields of `DeviceProfile`."""

    def chosen(self) -> DeviceProfile:
        profile = {"application_area_bytes": "32768"}
        words = (f"{name}={value}" for name, value in profile.items())
        return DeviceProfile(**_values(DeviceProfile, [*words, *self.choices.split()]))


@dataclass(frozen=True, kw_only=True)
class Load(Clause):
    """Other traffic, one frame every so many seconds."""

    NAME = "load"
    id: int = 0x712
    every: float = 0.002
    seconds: float = 1e9


# -- what happens to frames ------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class OnFrames(Clause):
    """Happens to the next `count` frames of a sender."""

    sender: Sender = "any"
    count: int = 1


@dataclass(frozen=True, kw_only=True)
class Lose(OnFrames):
    NAME = "lose"


@dataclass(frozen=True, kw_only=True)
class Double(OnFrames):
    NAME = "double"


@dataclass(frozen=True, kw_only=True)
class Delay(OnFrames):
    """Arrives later: what was sent after it overtakes it."""

    NAME = "delay"
    seconds: float = 0.001


@dataclass(frozen=True, kw_only=True)
class Flip(OnFrames):
    """A wrong bit that the bus's own checksum does not see."""

    NAME = "flip"
    bit: int = 0


@dataclass(frozen=True, kw_only=True)
class Cut(OnFrames):
    """Arrives with so many bytes only."""

    NAME = "cut"
    to: int = 3


@dataclass(frozen=True, kw_only=True)
class Noise(Clause):
    """For a time, a share of all frames is lost, wrong, or doubled."""

    NAME = "noise"
    seconds: float = 0.5
    sender: Sender = "any"
    lost: float = 0.0
    wrong: float = 0.0
    doubled: float = 0.0
    seed: int = 1


# -- what devices do ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Say(Clause):
    """A message that the device should not send now."""

    NAME = "say"
    what: Literal["ack", "nak", "boot", "request", "complete", "feedback"] = "nak"
    number: int = 1
    count: int = 1


@dataclass(frozen=True, kw_only=True)
class OnDevice(Clause):
    """Happens to a device: 0 is the one that is meant, 1 its twin."""

    device: int = 0


@dataclass(frozen=True, kw_only=True)
class Power(OnDevice):
    """Its supply fails."""

    NAME = "power"
    seconds: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Restart(OnDevice):
    """Its supply dips: it starts anew at once."""

    NAME = "restart"


@dataclass(frozen=True, kw_only=True)
class Hang(OnDevice):
    """It neither hears nor speaks."""

    NAME = "hang"
    seconds: float = 2.0


# -- what happens on the tool's side ---------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Unplug(Clause):
    NAME = "unplug"
    seconds: float = 0.4


@dataclass(frozen=True, kw_only=True)
class BusOff(Clause):
    NAME = "busoff"
    seconds: float = 0.3


@dataclass(frozen=True, kw_only=True)
class Tool(Clause):
    """A second tool sends."""

    NAME = "tool"
    does: Literal["asks", "writes", "resets", "updates", "packets"] = "asks"
    count: int = 1
    every: float = 0.2


@dataclass(frozen=True, kw_only=True)
class Stall(Clause):
    """The host's computer stands still."""

    NAME = "stall"
    seconds: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Kill(Clause):
    """The host's process dies; the same command is run so much later."""

    NAME = "kill"
    again: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Interrupt(Clause):
    """Ctrl-C."""

    NAME = "interrupt"


# -- the text -------------------------------------------------------------------------------------

CLAUSES: Final[dict[str, type[Clause]]] = {
    kind.NAME: kind
    for kind in (
        World, Adapter, Strange, Mock, Load, Lose, Double, Delay, Flip, Cut, Noise, Say, Power,
        Restart, Hang, Unplug, BusOff, Tool, Stall, Kill, Interrupt,
    )
}  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """What is, and what happens."""

    clauses: tuple[Clause, ...]
    _kinds: dict[type, tuple[Any, ...]] = field(default_factory=dict, repr=False, compare=False)

    def __str__(self) -> str:
        return " ; ".join(map(str, self.clauses))

    @property
    def world(self) -> World:
        return next((each for each in self.clauses if isinstance(each, World)), World())

    @property
    def adapter(self) -> Adapter:
        return next((each for each in self.clauses if isinstance(each, Adapter)), Adapter())

    @property
    def devices(self) -> Sequence[Strange | Mock]:
        found = [each for each in self.clauses if isinstance(each, Strange | Mock)]
        return found or [Strange()]

    @property
    def happenings(self) -> Iterator[Clause]:
        """What happens at a time."""
        for each in self.clauses:
            if each.when is not None or isinstance(each, Load):
                yield each

    @classmethod
    def parse(cls, text: str) -> Plan:
        return cls(tuple(parse_clauses(text, CLAUSES)))


def parse_clauses(text: str, kinds: Mapping[str, type[Clause]]) -> Iterator[Clause]:
    """The clauses of a text. Raises ValueError for one that is none of `kinds`."""
    lines = (part.strip() for line in text.splitlines() for part in line.split(";"))
    for line in lines:
        if line:
            yield _clause(line, kinds)


def _clause(line: str, kinds: Mapping[str, type[Clause]]) -> Clause:
    words = line.split()
    when = When.parse(words.pop(0)) if words and words[0].startswith("@") else None
    if not words or words[0] not in kinds:
        raise ValueError(f"{line!r} begins with no name of a clause: {', '.join(kinds)}")
    kind = kinds[words[0]]
    own = {known.name for known in fields(kind)} - {"choices", "when"}
    given = [word for word in words[1:] if word.partition("=")[0] in own]
    others = [word for word in words[1:] if word not in given]
    values = _values(kind, given)
    if issubclass(kind, Strange | Mock):
        clause: Clause = kind(when=when, choices=" ".join(others), **values)
        clause.chosen()  # type: ignore[attr-defined]  # raises for a choice that is none
        return clause
    if others:
        raise ValueError(f"{line!r}: {kind.NAME} has no {' '.join(others)}")
    return kind(when=when, **values)


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _values(kind: type, words: Sequence[str]) -> dict[str, Any]:
    """The fields that words of the form name=value give."""
    hints = get_type_hints(kind)
    values: dict[str, Any] = {}
    for word in words:
        name, _, text = word.partition("=")
        hint = hints.get(name)
        if hint is None:
            raise ValueError(f"{kind.__name__} has no {name!r}")
        if get_origin(hint) is Literal:
            if text not in get_args(hint):
                raise ValueError(f"{word!r}: it is one of {', '.join(get_args(hint))}")
            values[name] = text
        elif hint is bool:
            values[name] = {"true": True, "false": False}[text]
        elif hint is int:
            values[name] = int(text, 0)
        elif hint is float:
            values[name] = float(text)
        else:
            values[name] = text
    return values
