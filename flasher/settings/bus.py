"""Adapter settings: table [bus] of a settings file, which may also contain a target profile.

[bus]
interface = "pcan"
channel = "PCAN_USBBUS1"
bitrate = 250000

[bus.bus_kwargs]
auto_reset = true
"""

from __future__ import annotations

import os
from typing import Any, Final

from pydantic import Field, field_validator

from flasher.bus.bit_rate import DECIDING, HIGHEST_BPS, LOWEST_BPS
from flasher.bus.fallback import Fallback
from flasher.errors import Fault, did_you_mean
from flasher.protocol.text import printable
from flasher.python_can import can
from flasher.settings.toml_reader import Reader, TomlTable

BUS: Final = "bus"


class BusTable(TomlTable):
    """Table [bus]: one adapter, by python-can's keywords."""

    interface: str
    """Back end of python-can for the adapter."""
    channel: str | None = None
    """Adapter or port."""
    bitrate: int | None = Field(default=None, ge=LOWEST_BPS, le=HIGHEST_BPS)
    """Bits per second; a rate other than the dialect's is refused unless given with -b."""
    fd: bool | None = None
    """Open the adapter for CAN FD."""
    data_bitrate: int | None = Field(default=None, ge=LOWEST_BPS)
    """Bits per second of the data phase of CAN FD."""
    bus_kwargs: dict[str, bool | int | float | str] = Field(default_factory=dict)
    """More arguments for the back end."""

    @field_validator("interface")
    @classmethod
    def _check_interface(cls, value: str) -> str:
        if value not in can.VALID_INTERFACES:
            hint = did_you_mean(value, can.VALID_INTERFACES)
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise ValueError(f"python-can has no interface {value!a:.60}. {hint}It has {known}")
        return value

    @field_validator("channel", mode="before")
    @classmethod
    def _number_is_text(cls, value: Any) -> Any:
        return str(value) if type(value) is int else value

    @field_validator("bus_kwargs")
    @classmethod
    def _check_kwargs(cls, value: dict[str, Any]) -> dict[str, Any]:
        own = cls.model_fields.keys() - {"bus_kwargs"}
        if beside := sorted(own & value.keys()):
            raise ValueError(f"{beside[0]} belongs directly in [{BUS}]")
        if deciding := sorted(DECIDING & value.keys()):
            raise ValueError(f"{deciding[0]} decides the bit rate: only --timing may set it")
        return value


READER: Final = Reader(BusTable, "profile")


def bus_faults(table: object) -> list[Fault]:
    """Return all problems of a table [bus]."""
    if not isinstance(table, dict):
        return [READER.fault((BUS,), f"is a table, [{BUS}].")]
    return READER.check(table, (BUS,))[1]


def read_bus(table: object, path: str | os.PathLike[str]) -> Fallback:
    """Read the table [bus] of the file `path`. Raises UsageError with all problems."""
    faults = bus_faults(table)
    if faults or not isinstance(table, dict):
        raise READER.refusal(path, faults)
    keywords = READER.read(table, path).model_dump(exclude_none=True)
    more = keywords.pop("bus_kwargs")
    return Fallback({**keywords, **more}, f"[{BUS}] of {printable(os.fspath(path))}")
