"""Steps of a walk: parsing, and random choice of the next one."""

from __future__ import annotations

import random
import re
from typing import Final, NamedTuple

from flasher.conformance.cases.fr import forms
from flasher.conformance.explore.stimuli import ENDS, NO_CONCERN, PACKETS, UPDATES
from flasher.conformance.explore.walk import ALL_STEPS, DevicePhase, Walk
from flasher.conformance.wire import Encoder
from flasher.errors import UsageError, did_you_mean

_NUMBER: Final = re.compile("[0-9]{1,9}")
_SHARE: Final = 12 / len(PACKETS)
_PACKET_OPEN: Final = "packet-open"
"""Takes any packet form that the profile decides about."""
_WEIGHTS: Final[dict[DevicePhase, dict[str, float]]] = {
    DevicePhase.APPLICATION: {
        "reset": 14,
        **dict.fromkeys(("burst", "burst=twice", "query", "update=384", "packet", "end"), 1),
        **dict.fromkeys(("wait=0.3", "power", "bus-off"), 1),
        # Apart from resets, do not send writes to an application, which may store them.
        **dict.fromkeys([name for name in NO_CONCERN if name != "unknown"], 0.7),
        **dict.fromkeys(("packet-crc", "update-others"), 0.4),
    },
    DevicePhase.ANNOUNCING: {
        "update=good": 8,
        "update=second": 6,
        "update=384": 6,
        "update=300": 3,
        "update=128": 2,
        "update=wrong": 2,
        "update=1": 1,
        "update=33100": 0.5,
        "update=70000": 0.3,
        "reset": 2,
        "wait=window": 1,
        "wait=0.3": 0.5,
        "power": 1,
        **dict.fromkeys(("packet", "end", "query", "update-reset"), 1),
        **dict.fromkeys(("wait=20", "cut=0", "cut=1", "cut=2"), 0.6),
        **dict.fromkeys(UPDATES, 1),
        **dict.fromkeys((*NO_CONCERN, "bus-off"), 0.5),
    },
    DevicePhase.BEGUN: {
        "packet": 10,
        "packets=4": 6,
        "packets=all": 4,
        "packets=most": 2,
        "update=good": 2,
        **dict.fromkeys(("packet-slow", "packet-behind", "packet-between"), 1),
        **dict.fromkeys(("end", "reset", "wait=0.3", "power", "query"), 1),
        "wait=pause": 0.7,
        _PACKET_OPEN: 1.4,
        **dict.fromkeys(PACKETS, _SHARE),
        **dict.fromkeys((*ENDS, *UPDATES, *NO_CONCERN, "bus-off"), 0.3),
    },
    DevicePhase.TRANSFER: {
        "packet": 5,
        "packets=2": 5,
        "packets=all": 14,
        "packets=most": 4,
        "packet-filler": 3,
        "packet-again": 3,
        "packet-again=other": 3,
        "packet-again=older": 2,
        "packet-again=older-other": 2,
        "read": 2,
        "end": 2,
        "update=good": 2,
        "update=300": 1,
        **dict.fromkeys(("packet-slow", "packet-behind", "packet-between", "reset", "power"), 1),
        "wait=pause": 0.7,
        _PACKET_OPEN: 1.4,
        **dict.fromkeys(("wait=0.3", "query"), 0.5),
        **dict.fromkeys(PACKETS, _SHARE),
        **dict.fromkeys((*ENDS, *UPDATES, *NO_CONCERN, "bus-off"), 0.3),
    },
    DevicePhase.STORED: {
        "end": 15,
        "end=twice": 5,
        "end=padded": 3,
        "packet-again": 2,
        "packet-again=other": 2,
        "power": 2,
        "update=good": 2,
        "packet": 1,
        "reset": 1,
        "wait=pause": 0.5,
        "query": 0.5,
        **dict.fromkeys((*ENDS, "cut=0", "cut=1"), 1),
        **dict.fromkeys((*PACKETS, *NO_CONCERN), 0.2),
    },
    DevicePhase.UNCLEAR: {
        "packet": 3,
        "end": 3,
        "update=good": 3,
        "power": 3,
        "reset": 2,
        **dict.fromkeys(("wait=window", "wait=pause", "query"), 1),
    },
}
"""Weight of each step in each phase."""


class WalkStep(NamedTuple):
    """One step in its written form: `packet` or `update=384`."""

    name: str
    argument: str = ""

    def __str__(self) -> str:
        return f"{self.name}={self.argument}" if self.argument else self.name


_ARGUMENTS: Final = {
    name: {text.partition("=")[2] for weights in _WEIGHTS.values() for text in weights
           if text.partition("=")[0] == name}
    for name in ALL_STEPS
}  # fmt: skip
"""Valid arguments of each step; where one is a number, any number is valid."""


def parse_step(text: str) -> WalkStep:
    """Parse a step. Raises UsageError for one that does not exist."""
    name, _, argument = text.partition("=")
    known = set(_form_arguments()) if name == _PACKET_OPEN else _ARGUMENTS.get(name, set())
    is_number = _NUMBER.fullmatch(argument) and any(map(_NUMBER.fullmatch, known))
    if argument not in known and not is_number:
        hint = did_you_mean(text, ALL_STEPS).rstrip()
        raise UsageError(f"There is no step {text!a}.", remedy=hint)
    return WalkStep(name, argument)


def next_step(walk: Walk, chance: random.Random) -> WalkStep:
    """Choose a random step for the current phase that the bench supports."""
    weights, subject = _WEIGHTS[walk.phase], walk.bench.subject
    lacks = {
        "power": not subject.has_power,
        "bus-off": not subject.has_bus_off,
        "cut": not subject.has_timed_cuts,
    }
    texts = [text for text in weights if not lacks.get(text.partition("=")[0])]
    (text,) = chance.choices(texts, [weights[text] for text in texts])
    return (
        WalkStep(_PACKET_OPEN, chance.choice(_form_arguments()))
        if text == _PACKET_OPEN
        else parse_step(text)
    )


def _form_arguments() -> list[str]:
    found = forms(Encoder("bms")).items()
    return [f"{key}-{index}" for key, each in found for index in range(len(each))]


def reachable_pairs() -> list[tuple[DevicePhase, str]]:
    """Every phase with every step that a walk may take in it, without arguments."""
    return [
        (phase, name)
        for phase, weights in _WEIGHTS.items()
        for name in dict.fromkeys(text.partition("=")[0] for text in weights)
    ]
