"""Plans of simulated upgrades: the job, the devices and the faults, as text that replays exactly.

A plan is a list of clauses, one a line (or all in one line, separated by " ; "):

    job target=bms packets=40
    independent erase=0.31 session=0.0
    independent late=0.000117 application=none
    @packet12 drop sender=device count=2
    @packet20+0.0131 power seconds=1.2
    @update+0.2 unplug seconds=0.4

A clause is a name and the fields of its type that are not the default. Without a time it holds from
the beginning. `@1.25` is seconds since then, `@packet12`, `@reset`, `@update`, `@end` the moment at
which the host first begins to send that message, `@frame512` a frame on the bus, `@flash7` the
beginning of the seventh flash operation of the first device, and `+0.0131` so much later. The first
device is the one to be upgraded; a second one is its twin, which has the same CAN ids.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from functools import cache, partial
from typing import Annotated, Any, ClassVar, Final, Literal, get_args, get_origin, get_type_hints

from flasher.bus.simulated import DEFAULT_QUEUE_FRAMES
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import PACKET_COUNT_MAX, PACKET_DATA_SIZE
from flasher.simulate.independent import Choices
from flasher.validation import NumberRange

TEXT_MAX_SIZE: Final = 1_000_000
_LIMITS: Final[dict[object, NumberRange]] = {
    int: NumberRange(ge=0, le=0xFFFF),
    float: NumberRange(ge=0, le=3600),
}
"""Of numbers without another annotation; most floats are seconds."""
Count = Annotated[int, NumberRange(ge=1, le=1000)]
Interval = Annotated[float, NumberRange(ge=0.0001, le=3600)]
Share = Annotated[float, NumberRange(ge=0, le=1)]
Seed = Annotated[int, NumberRange(ge=0)]
Sender = Literal["any", "host", "device"]
_NUMBERED: Final = ("packet", "frame", "flash")
_SECONDS: Final = r"\d+(?:\.\d+)?(?:e[+-]?\d+)?"
_WHEN: Final = re.compile(
    rf"@(?:(?P<at>{_SECONDS})"
    rf"|(?:(?P<counted>{'|'.join(_NUMBERED)})(?P<number>\d*)|(?P<what>reset|update|end))"
    rf"(?:\+(?P<plus>{_SECONDS}))?)"
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
        number = str(self.number) if self.what in _NUMBERED else ""
        return f"@{self.what}{number}" + (f"+{self.plus_s!r}" if self.plus_s else "")

    @classmethod
    def parse(cls, text: str) -> When:
        found = _WHEN.fullmatch(text)
        seconds = float((found and (found["at"] or found["plus"])) or 0)
        if found is None or not math.isfinite(seconds):
            raise ValueError(f"{text[:40]!r} is not a time of a plan")
        what = found["counted"] or found["what"] or ""
        return cls(what, int(found["number"] or 0), seconds)


@dataclass(frozen=True, kw_only=True)
class Clause:
    """One line of a plan."""

    NAME: ClassVar[str]
    when: When | None = None

    def __init_subclass__(cls) -> None:
        cls.NAME = vars(cls).get("NAME", cls.__name__.lower())

    def __str__(self) -> str:
        words = [] if self.when is None else [str(self.when)]
        words.append(self.NAME)
        for known in fields(self):
            value = getattr(self, known.name)
            default = known.default if known.default_factory is MISSING else None
            if known.name != "when" and value != default:
                words += [value] if known.name == "choices" else [f"{known.name}={_text(value)}"]
        return " ".join(word for word in words if word)


# -- the job, the adapter, the devices ------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Job(Clause):
    """The upgrade, and whether anybody else is on the bus. 0 in a limit is the default."""

    target: Literal["bms", "wmc", "obc"] = "bms"
    packets: Annotated[int, NumberRange(ge=1, le=PACKET_COUNT_MAX)] = 20
    short: Annotated[int, NumberRange(ge=0, le=PACKET_DATA_SIZE - 1)] = 5
    """Bytes that the last packet is short of a whole one."""
    image: int = 5
    """Seed of the image's bytes."""
    others: bool = True
    """Another node acknowledges; False: the devices and the tool are alone on the bus."""
    attempts: int = 0
    tries: int = 0
    timeout: float = 0.0
    gap: float = 0.0
    """Seconds between the frames of a message."""


@dataclass(frozen=True, kw_only=True)
class Adapter(Clause):
    """How the host's adapter returns its own frames, and how many it queues."""

    echoes: bool = False
    delay: float = 0.0
    """Seconds from the end of a frame to its echo."""
    jitter: float = 0.0
    """Up to so much more; later echoes overtake."""
    lost: Share = 0.0
    """Share of the echoes that never come."""
    doubled: Share = 0.0
    """Share that comes twice."""
    queue: Count = DEFAULT_QUEUE_FRAMES
    """Frames that wait to be sent; a full queue takes no more."""
    seed: Seed = 1


@dataclass(frozen=True, kw_only=True)
class Device(Clause):
    """A device; with a time, one that is connected then."""

    application: Literal["old", "none"] = "old"
    version: str = "V1r0r0_20220512"
    """Version of the old application."""
    begins: Literal["application", "boot", "off"] = "application"
    """`boot`: it is switched on at the beginning."""
    drift: Annotated[float, NumberRange(ge=-0.5, le=0.5)] = 0.0
    """Its clock is faster by this share."""
    choices: str = ""
    """What else a kind of device can choose."""


@dataclass(frozen=True, kw_only=True)
class Independent(Device):
    """A device that was written from the document alone; its choices are fields of `Choices`."""

    def chosen(self) -> Choices:
        return Choices(**_values(Choices, self.choices.split()))


@dataclass(frozen=True, kw_only=True)
class Mock(Device):
    """flasher's own device model; its choices are fields of `DeviceProfile`."""

    def chosen(self) -> DeviceProfile:
        profile = {"application_area_bytes": "131072"}
        words = (f"{name}={value}" for name, value in profile.items())
        return DeviceProfile(**_values(DeviceProfile, [*words, *self.choices.split()]))


@dataclass(frozen=True, kw_only=True)
class Subject(Device):
    """The bootloader under test; a plan chooses nothing for it."""


@dataclass(frozen=True, kw_only=True)
class Load(Clause):
    """Other traffic, one frame every so many seconds; id 0 wins every arbitration."""

    id: Annotated[int, NumberRange(ge=0, le=0x7FF)] = 0x712
    every: Interval = 0.002
    seconds: float = 3600.0


# -- faults of frames ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class OnFrames(Clause):
    """Happens to the next `count` frames of a sender."""

    sender: Sender = "any"
    count: Count = 1


@dataclass(frozen=True, kw_only=True)
class Drop(OnFrames):
    """Nobody receives it."""


@dataclass(frozen=True, kw_only=True)
class Double(OnFrames):
    """It arrives twice."""

    whole: bool = False
    """The frames of a message arrive again after its last one, as over a second way."""


@dataclass(frozen=True, kw_only=True)
class Swap(OnFrames):
    """It arrives after the next frame of the same sender."""


@dataclass(frozen=True, kw_only=True)
class Delay(OnFrames):
    """It arrives later: frames that were sent after it overtake it."""

    seconds: float = 0.001


@dataclass(frozen=True, kw_only=True)
class Flip(OnFrames):
    """One bit is wrong, and the checksum of the CAN frame does not detect it."""

    bit: Annotated[int, NumberRange(ge=0, le=63)] = 0


@dataclass(frozen=True, kw_only=True)
class Truncate(OnFrames):
    """Only its first `to` bytes arrive."""

    to: Annotated[int, NumberRange(ge=0, le=8)] = 3


@dataclass(frozen=True, kw_only=True)
class Noise(Clause):
    """For a time, shares of all frames are lost, wrong, doubled, or reported as error frames."""

    seconds: float = 0.5
    sender: Sender = "any"
    lost: Share = 0.0
    wrong: Share = 0.0
    doubled: Share = 0.0
    errors: Share = 0.0
    seed: Seed = 1


# -- faults of devices -----------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Unsolicited(Clause):
    """A message of the device that nobody asked for, valid, from another sender."""

    what: Literal["ack", "nak", "boot", "request", "complete", "feedback", "unknown"] = "nak"
    """`unknown` is a message of no document."""
    number: int = 1
    count: Count = 1


@dataclass(frozen=True, kw_only=True)
class OnDevice(Clause):
    """Happens to a device: 0 is the one to be upgraded, 1 its twin."""

    device: int = 0


@dataclass(frozen=True, kw_only=True)
class Answer(OnDevice):
    """The next answer of the device is another one, or comes later."""

    becomes: Literal["same", "ack", "nak", "silence", "twice"] = "same"
    """An ACK becomes a NAK of the same number, and the reverse; `twice`: it is sent twice, unless
    it is general feedback."""
    shift: Annotated[int, NumberRange(ge=-0xFFFF, le=0xFFFF)] = 0
    """Added to the number of an ACK or NAK."""
    late: float = 0.0
    """Seconds."""
    count: Count = 1


@dataclass(frozen=True, kw_only=True)
class Power(OnDevice):
    """Its supply fails."""

    seconds: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Restart(OnDevice):
    """Its supply dips: it restarts at once."""


@dataclass(frozen=True, kw_only=True)
class Hang(OnDevice):
    """It neither receives nor sends."""

    seconds: float = 2.0


@dataclass(frozen=True, kw_only=True)
class FlashFails(OnDevice):
    """Its next `count` flash operations change nothing, and it can detect that; not `mock`."""

    NAME = "flash-fails"
    count: Count = 1


# -- faults of the host's side ---------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Unplug(Clause):
    """The adapter is removed; it comes back, for `wrong_rate` seconds at another bit rate."""

    seconds: float = 0.4
    wrong_rate: float = 0.0


@dataclass(frozen=True, kw_only=True)
class BusOff(Clause):
    """The adapter's controller is off."""

    seconds: float = 0.3


@dataclass(frozen=True, kw_only=True)
class Tool(Clause):
    """A second tool sends."""

    does: Literal[
        "asks",
        "writes",
        "resets",
        "updates",
        "packets",
        "refused",
        "ends",
        "unknown",
        "damaged",
        "shortens",
        "answers",
    ] = "asks"
    """`refused` is an update command of size 0, `unknown` a command of no document, `damaged` a
    packet with a wrong checksum, `shortens` an update command for an image that is one byte
    shorter, `answers` an ACK, which only a device sends.
    """
    count: Count = 1
    every: Interval = 0.2


@dataclass(frozen=True, kw_only=True)
class Stall(Clause):
    """The host's computer pauses."""

    seconds: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Kill(Clause):
    """The host's process dies; the same command runs so much later, with the history alone."""

    again: float = 1.0
    rescue: bool = False
    """`flasher rescue` runs then instead, with an operator who follows its prompts."""


@dataclass(frozen=True, kw_only=True)
class Interrupt(Clause):
    """Ctrl-C."""


# -- the text -------------------------------------------------------------------------------------

CLAUSES: Final[dict[str, type[Clause]]] = {
    kind.NAME: kind
    for kind in (
        Job, Adapter, Independent, Mock, Subject, Load, Drop, Double, Swap, Delay, Flip, Truncate,
        Noise, Unsolicited, Answer, Power, Restart, Hang, FlashFails, Unplug, BusOff, Tool, Stall,
        Kill, Interrupt,
    )
}  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """What there is on the bus, and what happens."""

    clauses: tuple[Clause, ...]

    def __str__(self) -> str:
        return " ; ".join(map(str, self.clauses))

    @property
    def job(self) -> Job:
        return next((each for each in self.clauses if isinstance(each, Job)), Job())

    @property
    def adapter(self) -> Adapter:
        return next((each for each in self.clauses if isinstance(each, Adapter)), Adapter())

    @property
    def devices(self) -> Sequence[Device]:
        found = [each for each in self.clauses if isinstance(each, Device)]
        return found or [Independent()]

    @property
    def events(self) -> Iterator[Clause]:
        """Clauses that happen at a time."""
        for each in self.clauses:
            if each.when is not None or isinstance(each, Load):
                yield each

    @classmethod
    def parse(cls, text: str) -> Plan:
        """Raises ValueError for a text that is no plan, UsageError for what `mock` refuses."""
        if len(text) > TEXT_MAX_SIZE:
            raise ValueError(f"it has more than {TEXT_MAX_SIZE:,} characters")
        plan = cls(tuple(parse_clauses(text, CLAUSES)))
        if not plan.clauses:
            raise ValueError("it is empty")
        for kind in (Job, Adapter):
            own = [each for each in plan.clauses if isinstance(each, kind)]
            if len(own) > 1 or any(each.when for each in own):
                raise ValueError(f"{kind.NAME!r} holds for all of a plan: name it once, no time")
        return plan


def parse_clauses(text: str, kinds: Mapping[str, type[Clause]]) -> Iterator[Clause]:
    """Yield the clauses of a text. Raises ValueError for one that is none of `kinds`."""
    lines = (part.strip() for line in text.splitlines() for part in line.split(";"))
    for line in lines:
        if line:
            yield _clause(line, kinds)


def _clause(line: str, kinds: Mapping[str, type[Clause]]) -> Clause:
    words = line.split()
    when = When.parse(words.pop(0)) if words and words[0].startswith("@") else None
    if not words or words[0] not in kinds:
        raise ValueError(
            f"{line[:40]!r} does not begin with the name of a clause: {', '.join(kinds)}"
        )
    kind = kinds[words[0]]
    names = [word.partition("=")[0] for word in words[1:]]
    if len({*names}) < len(names):
        raise ValueError(f"{line[:40]!r} has a value twice")
    own = {known.name for known in fields(kind)} - {"choices", "when"}
    given = [word for word in words[1:] if word.partition("=")[0] in own]
    others = [word for word in words[1:] if word not in given]
    values = _values(kind, given)
    if issubclass(kind, Independent | Mock):
        clause: Clause = kind(when=when, choices=" ".join(others), **values)
        clause.chosen()  # type: ignore[attr-defined]  # raises for an unknown choice
        return clause
    if others:
        raise ValueError(f"{kind.NAME} has no {others[0][:40]!r}")
    return kind(when=when, **values)


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


_type_hints = cache(partial(get_type_hints, include_extras=True))


def _values(kind: type, words: Sequence[str]) -> dict[str, Any]:
    """The fields that words of the form name=value give."""
    hints = _type_hints(kind)
    values: dict[str, Any] = {}
    for word in words:
        name, _, text = word.partition("=")
        hint = hints.get(name)
        if hint is None:
            raise ValueError(f"{kind.__name__} has no {name[:40]!r}")
        limits = _LIMITS.get(hint)
        if get_origin(hint) is Annotated:
            hint, *others = get_args(hint)
            limits = next((each for each in others if isinstance(each, NumberRange)), None)
        if get_origin(hint) is Literal:
            if text not in get_args(hint):
                raise ValueError(f"{word[:40]!r}: it is one of {', '.join(get_args(hint))}")
            values[name] = text
        elif hint is bool:
            if text not in ("true", "false"):
                raise ValueError(f"{word[:40]!r}: it is true or false")
            values[name] = text == "true"
        elif hint in (int, float):
            values[name] = _number(word, text, hint, limits)
        else:
            values[name] = text
    return values


def _number(word: str, text: str, kind: type, limits: NumberRange | None) -> float:
    try:
        value: float = int(text, 0) if kind is int else float(text)
    except ValueError as error:
        raise ValueError(f"{word[:40]!r}: it is not a number") from error
    if kind is float and not math.isfinite(value):
        raise ValueError(f"{word[:40]!r}: it is not finite")
    if limits is not None and not limits.allows(value):
        raise ValueError(
            f"{word[:40]!r}: it is from {limits.ge or 0:g} to {limits.le or math.inf:g}"
        )
    return value
