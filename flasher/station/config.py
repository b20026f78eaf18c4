"""The station's own file: its name, where its records are, and its sockets.

    name = "line-2"
    records = "records.sqlite"

    [[socket]]
    name = "A"
    interface = "slcan"
    serial_number = "A50285BI"
    power = "relay 3 {on|off}"

    [[socket]]
    name = "B"
    mock = { bad = 0.1, slow = 0.1, seed = 7 }

A socket finds its adapter by the adapter's serial number or by its place on the USB, never by the
order in which the computer counted them (`adapters.resolve`).
"""

from __future__ import annotations

import re
import shlex
from collections import Counter
from datetime import time
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator, model_validator

from flasher.errors import UsageError
from flasher.settings.toml_reader import Reader, TomlTable
from flasher.station.recipe import ShortText
from flasher.station.records.model import DEFAULT_LOCK_TIMEOUT_S
from flasher.station.shift_counts import DEFAULT_SHIFTS

SOCKETS_MAX: Final = 64
_SWITCH: Final = re.compile(r"\{([^{}|]*)\|([^{}|]*)\}")
_NOT_FOR_BUS: Final = frozenset({"interface", "channel", "serial_number", "usb_path"})
_PRINTER: Final = re.compile(r"file:.+|tcp://(?:\[[0-9A-Fa-f:.]+\]|[^:/\s\[\]]+):[1-9][0-9]{0,4}")
Share = Annotated[float, Field(ge=0, le=1)]
BusValue = bool | int | float | str


class MockUnits(TomlTable):
    """What virtual units a socket without an adapter meets: shares of 1 of all units."""

    bad: Share = 0.0
    """Units that take the image, and then do not run it, or refuse it."""
    slow: Share = 0.0
    """Units that take long."""
    dead: Share = 0.0
    """Units that never answer."""
    exchanged: Share = 0.0
    """Units that somebody exchanges for the next one while they are flashed; they come back."""
    mislabelled: Share = 0.0
    """Units with the serial number of another one in them than their label says."""
    seed: int = Field(default=1, ge=0)
    """The same seed and serial number is the same unit."""

    @model_validator(mode="after")
    def _check_sum(self) -> MockUnits:
        if self.bad + self.slow + self.dead > 1:
            raise ValueError("bad, slow and dead are more than all units together")
        return self


class SocketConfig(TomlTable):
    """One socket: an adapter of its own, or virtual units."""

    name: ShortText
    """As screens and cards call it."""
    interface: str = ""
    """As python-can names it."""
    channel: str = ""
    """As python-can names it; not needed with one of the next two."""
    serial_number: str = ""
    """Of the adapter; it finds the channel."""
    usb_path: str = ""
    """Place of the adapter on the USB, as "1-1.4"; for adapters without a serial number."""
    bus: dict[str, BusValue] = Field(default_factory=dict)
    """Further keywords of python-can's bus."""
    power: str = ""
    """A command, run without a shell, that switches the unit's power; `{on|off}` for the words."""
    mock: MockUnits | None = None

    @field_validator("channel", mode="before")
    @classmethod
    def _number_is_text(cls, value: Any) -> Any:
        return str(value) if type(value) is int else value

    @field_validator("power")
    @classmethod
    def _check_power(cls, value: str) -> str:
        if value:
            power_command(value, on=True)
        return value

    @model_validator(mode="after")
    def _check_adapter(self) -> SocketConfig:
        if self.mock is not None:
            named = ("interface", "channel", "serial_number", "usb_path", "bus")
            given = [key for key in named if getattr(self, key)]
            if given:
                raise ValueError(f"a mock socket has no adapter: leave {', '.join(given)} out")
            return self
        if not self.interface:
            raise ValueError("it has neither an interface nor mock")
        if self.serial_number and self.usb_path:
            raise ValueError("give serial_number or usb_path, not both")
        if not (self.channel or self.serial_number or self.usb_path):
            raise ValueError("it has no channel, serial_number or usb_path to find its adapter by")
        taken = sorted(_NOT_FOR_BUS & self.bus.keys())
        if taken:
            raise ValueError(f"{taken[0]} stands beside bus, not in it")
        return self


class ScannerConfig(TomlTable):
    """A scanner that the station reads itself."""

    name: ShortText
    """As screens call it."""
    input: str = ""
    """A Linux input device, as "/dev/input/by-id/usb-..."."""
    usb_path: str = ""
    """In place of input: where it is plugged in, as "1-1.4"."""
    port: str = ""
    """In place of both: a serial port."""
    baudrate: int = Field(default=9600, ge=300, le=4_000_000)
    """Of the serial port."""
    socket: str = ""
    """The socket that it is mounted at: the labels that it scans are for that one."""

    @model_validator(mode="after")
    def _check_place(self) -> ScannerConfig:
        if sum(map(bool, (self.input, self.usb_path, self.port))) != 1:
            raise ValueError("give input, usb_path or port, one of them")
        return self


class LabelConfig(TomlTable):
    """The label that a unit gets when it has passed."""

    template: str = Field(min_length=1)
    """A file with ZPL, in which values stand as {{ serial }}."""
    printer: str = ""
    """As "tcp://192.168.1.7:9100", or "file:/dev/usb/lp0"."""
    command: tuple[str, ...] = ()
    """In place of printer: a program that reads the label on its standard input."""
    on: Literal["pass", "reprint"] = "pass"
    """Print for every unit that passes, or only what REPRINT asks for."""
    time_limit_s: float = Field(default=10.0, gt=0, le=60)
    """How long the printer may take for a label."""

    @model_validator(mode="after")
    def _check_printer(self) -> LabelConfig:
        if bool(self.printer) == bool(self.command):
            raise ValueError("give printer or command, one of them")
        if self.printer and not _PRINTER.fullmatch(self.printer):
            raise ValueError(f"{self.printer!a:.60} is no printer: tcp://HOST:PORT or file:PATH")
        return self


class StationConfig(TomlTable):
    """The whole file."""

    name: ShortText = "station"
    """Of the station; another one for each."""
    records: str = "records.sqlite"
    """A file beside this one, or the URL of a PostgreSQL server."""
    files: str = ""
    """The folder of the traces; needed for a server, else beside the file of the records."""
    keys: str = ""
    """The folder of the signing key; empty: a place of this user."""
    heads: tuple[str, ...] = Field(default=(), max_length=8)
    """Other places than beside the key in which the signed heads of the audit trail are kept: a
    folder, best on another computer, or the URL of a PostgreSQL server; or a list of them.
    """
    lock_timeout_s: float = Field(default=DEFAULT_LOCK_TIMEOUT_S, gt=0, le=60)
    """How long a record waits for another program that holds the database."""
    badges: str = ""
    """The table of the badges (TOML): who may work here; empty: there are none."""
    shifts: tuple[time, ...] = Field(default=DEFAULT_SHIFTS, min_length=1, max_length=8)
    """When each shift begins, as "06:00"; figures of the operator page count from there."""
    sound_volume: float = Field(default=0.3, ge=0, le=1)
    """Of the operator page; 0 is silent."""
    label: LabelConfig | None = None
    scanner: tuple[ScannerConfig, ...] = Field(default=(), max_length=SOCKETS_MAX)
    socket: tuple[SocketConfig, ...] = Field(min_length=1, max_length=SOCKETS_MAX)

    @field_validator("heads", mode="before")
    @classmethod
    def _one_is_a_list(cls, value: Any) -> Any:
        if isinstance(value, str):
            return (value,)
        return tuple(value) if isinstance(value, list) else value

    @field_validator("heads")
    @classmethod
    def _check_heads(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not all(value):
            raise ValueError("a place of the heads is empty")
        return value

    @model_validator(mode="after")
    def _check_sockets(self) -> StationConfig:
        no_two("sockets", "name", [socket.name for socket in self.socket])
        no_two("scanners", "name", [each.name for each in self.scanner])
        places = [each.input or each.usb_path or each.port for each in self.scanner]
        no_two("scanners", "place", places)
        names = [socket.name for socket in self.socket]
        for each in self.scanner:
            if each.socket and each.socket not in names:
                raise ValueError(f"there is no socket {each.socket!a:.60} for scanner {each.name}")
        real = [socket for socket in self.socket if socket.mock is None]
        for first in ("serial_number", "usb_path"):
            named = [socket for socket in real if getattr(socket, first)]
            no_two("sockets", first, [f"{getattr(s, first)} {s.channel}".strip() for s in named])
        plain = [s for s in real if not (s.serial_number or s.usb_path)]
        no_two("sockets", "adapter", [f"{s.interface} {s.channel}" for s in plain])
        return self


CONFIG: Final = Reader(StationConfig, "station file")


def no_two(which: str, what: str, values: list[str]) -> None:
    """Raises ValueError for a value that occurs twice."""
    twice = [value for value, count in Counter(values).items() if count > 1]
    if twice:
        raise ValueError(f"two {which} have the same {what} {twice[0]!a:.60}")


def load_config(path: Path) -> StationConfig:
    """Load a station file. Raises UsageError naming every wrong key."""
    config = CONFIG.load(path)
    here = path.parent
    changes: dict[str, str] = {}
    if "://" not in config.records:
        changes["records"] = str(here / config.records)
    for key in ("files", "keys", "badges"):
        if getattr(config, key):
            changes[key] = str(here / getattr(config, key))
    heads = tuple(each if "://" in each else str(here / each) for each in config.heads)
    label = config.label
    if label is not None:
        places = {"template": str(here / label.template)}
        if label.printer.startswith("file:"):
            places["printer"] = f"file:{here / label.printer.removeprefix('file:')}"
        label = label.model_copy(update=places)
    return config.model_copy(update={**changes, "heads": heads, "label": label})


def mock_config(
    count: int, units: MockUnits, *, name: str = "mock", records: str = "records.sqlite"
) -> StationConfig:
    """A station of virtual units: sockets 1 to `count`. Raises UsageError for a wrong count."""
    if not 1 <= count <= SOCKETS_MAX:
        raise UsageError(f"A station has 1 to {SOCKETS_MAX} sockets, not {count}.")
    sockets = tuple(SocketConfig(name=str(number + 1), mock=units) for number in range(count))
    return StationConfig(name=name, records=records, socket=sockets)


def power_command(template: str, *, on: bool) -> list[str]:
    """The words of a power command, to be run without a shell. Raises ValueError."""
    words = shlex.split(template)
    switches = [word for word in words if _SWITCH.search(word)]
    if not words or len(switches) != 1 or len(_SWITCH.findall(switches[0])) != 1:
        raise ValueError('power has one {on|off}, as in "relay 3 {on|off}"')
    if _SWITCH.search(words[0]):
        raise ValueError("power begins with the program, and {on|off} stands behind it")
    return [_SWITCH.sub(lambda found: found[1 if on else 2], word) for word in words]
