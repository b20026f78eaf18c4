"""The station file: the station's name, records, sockets, scanners and label printer.

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

A socket finds its adapter by the adapter's serial number or USB path, never by the order in which
the computer found them (`adapters.resolve`).
"""

from __future__ import annotations

import re
import shlex
from collections import Counter
from datetime import time
from pathlib import Path
from typing import Annotated, Any, Final, Literal
from urllib.parse import urlsplit

from pydantic import Field, field_validator, model_validator

from flasher.errors import UsageError
from flasher.settings.toml_reader import Reader, TomlTable
from flasher.station.recipe import ShortText, Unchecked
from flasher.station.records.model import DEFAULT_LOCK_TIMEOUT_S
from flasher.station.shift_counts import DEFAULT_SHIFTS

SOCKETS_MAX: Final = 64
_SWITCH: Final = re.compile(r"\{([^{}|]*)\|([^{}|]*)\}")
_NOT_FOR_BUS: Final = frozenset({"interface", "channel", "serial_number", "usb_path"})
_PRINTER: Final = re.compile(r"file:.+|tcp://(?:\[[0-9A-Fa-f:.]+\]|[^:/\s\[\]]+):[1-9][0-9]{0,4}")
_NOT_IN_URL: Final = frozenset(map(chr, (*range(33), 127)))
Share = Annotated[float, Field(ge=0, le=1)]
BusValue = bool | int | float | str


class MockUnits(TomlTable):
    """Virtual units of a socket without an adapter: shares of faulty units, from 0 to 1."""

    bad: Share = 0.0
    """Units that refuse the image, or do not run it afterwards."""
    slow: Share = 0.0
    """Units that are slow."""
    dead: Share = 0.0
    """Units that never answer."""
    exchanged: Share = 0.0
    """Units that are exchanged for the next one while they are flashed, and return later."""
    mislabelled: Share = 0.0
    """Units whose stored serial number differs from their label."""
    seed: int = Field(default=1, ge=0)
    """Random seed: the same seed and serial number give the same unit."""

    @model_validator(mode="after")
    def _check_sum(self) -> MockUnits:
        if self.bad + self.slow + self.dead > 1:
            raise ValueError("bad, slow and dead add up to more than 1")
        return self


class SocketConfig(TomlTable):
    """A socket with its own adapter, or with virtual units."""

    name: ShortText
    """Name of the socket on screens and cards."""
    interface: str = ""
    """Interface of python-can."""
    channel: str = ""
    """Channel of python-can; not needed with serial_number or usb_path."""
    serial_number: str = ""
    """Serial number of the adapter, which determines the channel."""
    usb_path: str = ""
    """USB path of the adapter, such as "1-1.4"; for adapters without a serial number."""
    bus: dict[str, BusValue] = Field(default_factory=dict)
    """Further arguments of python-can's bus."""
    power: str = ""
    """Command that switches the unit's power, run without a shell, such as "relay 3 {on|off}"."""
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
            raise ValueError(f"{taken[0]} belongs beside bus, not in it")
        return self


class ScannerConfig(TomlTable):
    """A scanner that the station reads directly. It has one of input, usb_path and port."""

    name: ShortText
    """Name of the scanner on screens."""
    input: str = ""
    """Linux input device, such as "/dev/input/by-id/usb-..."."""
    usb_path: str = ""
    """USB path, such as "1-1.4"."""
    port: str = ""
    """Serial port."""
    baudrate: int = Field(default=9600, ge=300, le=4_000_000)
    """Baud rate of the serial port."""
    socket: str = ""
    """Socket at which the scanner is mounted, and to which its labels are assigned; empty: none."""

    @model_validator(mode="after")
    def _check_place(self) -> ScannerConfig:
        if sum(map(bool, (self.input, self.usb_path, self.port))) != 1:
            raise ValueError("give exactly one of input, usb_path and port")
        return self


class LabelConfig(TomlTable):
    """The label that is printed for a passed unit."""

    template: str = Field(min_length=1)
    """A file with ZPL and placeholders such as {{ serial }}."""
    printer: str = ""
    """Address of the printer, such as "tcp://192.168.1.7:9100" or "file:/dev/usb/lp0"."""
    command: tuple[str, ...] = ()
    """Instead of printer: a program that reads the label from its standard input."""
    on: Literal["pass", "reprint"] = "pass"
    """Print for every passed unit, or only on REPRINT."""
    time_limit_s: float = Field(default=10.0, gt=0, le=60)
    """Time limit for printing a label."""

    @model_validator(mode="after")
    def _check_printer(self) -> LabelConfig:
        if bool(self.printer) == bool(self.command):
            raise ValueError("give either printer or command")
        if self.printer and not _PRINTER.fullmatch(self.printer):
            raise ValueError(f"{self.printer!a:.60} is not tcp://HOST:PORT or file:PATH")
        return self


class QuestionConfig(TomlTable):
    """A system of the plant that is asked by HTTP before each unit whether it may be here. It
    replies with JSON: {"answer": "yes" or "no", "reason": "..."}.
    """

    url: str
    """Its address, such as "https://mes.plant/may-begin"."""
    method: Literal["POST", "GET"] = "POST"
    """POST sends the facts as JSON, GET in the address."""
    time_limit_s: float = Field(default=3.0, gt=0, le=30)
    """Time limit for the answer."""
    silence: Unchecked = Unchecked.BLOCK
    """A unit about which no answer came: block refuses it; allow begins, and records it."""
    certificates: str = ""
    """File (PEM) with the certificate of the server's issuer; empty: those of this computer."""

    @field_validator("url")
    @classmethod
    def _check_url(cls, value: str) -> str:
        parts = urlsplit(value)
        is_known = parts.scheme in ("http", "https") and parts.hostname and "@" not in parts.netloc
        if not is_known or parts.fragment or not value.isascii() or set(value) & _NOT_IN_URL:
            raise ValueError(f"{value!a:.60} is not http://HOST/PATH or https://HOST/PATH")
        try:
            _ = parts.port
        except ValueError:
            raise ValueError(f"the port in {value!a:.60} is not a number up to 65535") from None
        return value


class StationConfig(TomlTable):
    """The station file. Relative paths start at its folder."""

    name: ShortText = "station"
    """Name of the station; different for each station of a plant, or that shares the records."""
    records: str = "records.sqlite"
    """Records: an SQLite file."""
    files: str = ""
    """Folder of the traces; empty: beside the SQLite file."""
    keys: str = ""
    """Folder of the signing key; empty: a folder of this user."""
    heads: tuple[str, ...] = Field(default=(), max_length=8)
    """Places for copies of the signed heads of the audit trail: folders, best on another computer,
    or URLs of PostgreSQL databases; one text, or a list."""
    plant: str = ""
    """Database that collects the records of all stations, such as
    "postgresql://flasher_line_2@plant-db/flasher"; empty: none."""
    plant_recipes: bool = False
    """Recipes come from the plant, and a supervisor approves them at the station."""
    golden_unit: Literal["optional", "required"] = "optional"
    """required: after an update of flasher or a change of the recipe a golden unit has to pass
    before any other unit begins."""
    lock_timeout_s: float = Field(default=DEFAULT_LOCK_TIMEOUT_S, gt=0, le=60)
    """Time limit of a write while another program locks the database."""
    badges: str = ""
    """The badge table (TOML) of the people who may work here; empty: no badges."""
    shifts: tuple[time, ...] = Field(default=DEFAULT_SHIFTS, min_length=1, max_length=8)
    """Local start times of the shifts, such as "06:00"; the operator page counts per shift."""
    sound_volume: float = Field(default=0.3, ge=0, le=1)
    """Volume of the operator page's sounds, from 0 (silent) to 1."""
    label: LabelConfig | None = None
    question: QuestionConfig | None = None
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
            raise ValueError("heads contains an empty place")
        return value

    @field_validator("shifts")
    @classmethod
    def _check_shifts(cls, value: tuple[time, ...]) -> tuple[time, ...]:
        if any(start.tzinfo is not None for start in value):
            raise ValueError("shifts are local times, without a time zone")
        no_two("shifts", "start", [f"{start:%H:%M}" for start in value])
        return value

    @model_validator(mode="after")
    def _check_plant(self) -> StationConfig:
        if self.plant_recipes and not (self.plant and self.badges):
            raise ValueError("plant_recipes needs plant, and badges of the people who approve")
        return self

    @model_validator(mode="after")
    def _check_sockets(self) -> StationConfig:
        no_two("sockets", "name", [socket.name for socket in self.socket])
        no_two("scanners", "name", [each.name for each in self.scanner])
        places = [each.input or each.usb_path or each.port for each in self.scanner]
        no_two("scanners", "place", places)
        names = [socket.name for socket in self.socket]
        for each in self.scanner:
            if each.socket and each.socket not in names:
                raise ValueError(
                    f"scanner {each.name} names the unknown socket {each.socket!a:.60}"
                )
        real = [socket for socket in self.socket if socket.mock is None]
        for first in ("serial_number", "usb_path"):
            named = [socket for socket in real if getattr(socket, first)]
            no_two("sockets", first, [f"{getattr(s, first)} {s.channel}".strip() for s in named])
        plain = [s for s in real if not (s.serial_number or s.usb_path)]
        no_two("sockets", "adapter", [f"{s.interface} {s.channel}" for s in plain])
        return self


CONFIG: Final = Reader(StationConfig, "station file")


def no_two(which: str, what: str, values: list[str]) -> None:
    """Check that no value occurs twice. Raises ValueError."""
    twice = [value for value, count in Counter(values).items() if count > 1]
    if twice:
        raise ValueError(f"two {which} have the same {what} {twice[0]!a:.60}")


def load_config(path: Path) -> StationConfig:
    """Load a station file and make its paths absolute. Raises UsageError with all wrong keys."""
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
    question = config.question
    if question is not None and question.certificates:
        file = str(here / question.certificates)
        question = question.model_copy(update={"certificates": file})
    changed = {**changes, "heads": heads, "label": label, "question": question}
    return config.model_copy(update=changed)


def mock_config(count: int, units: MockUnits) -> StationConfig:
    """Settings of a station with virtual units in sockets 1 to `count`. Raises UsageError."""
    if not 1 <= count <= SOCKETS_MAX:
        raise UsageError(f"A station has 1 to {SOCKETS_MAX} sockets, not {count}.")
    sockets = tuple(SocketConfig(name=str(number + 1), mock=units) for number in range(count))
    return StationConfig(name="mock", socket=sockets)


def power_command(template: str, *, on: bool) -> list[str]:
    """Argument list of a power command, to be run without a shell. Raises ValueError for a
    template without exactly one `{on|off}`.
    """
    words = shlex.split(template)
    switches = [word for word in words if _SWITCH.search(word)]
    if not words or len(switches) != 1 or len(_SWITCH.findall(switches[0])) != 1:
        raise ValueError('power needs exactly one {on|off}, such as "relay 3 {on|off}"')
    if _SWITCH.search(words[0]):
        raise ValueError("power must begin with the program, followed by {on|off}")
    return [_SWITCH.sub(lambda match: match[1 if on else 2], word) for word in words]
