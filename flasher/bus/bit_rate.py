"""Bit rate of a CAN bus: chosen, compared with the dialect's, and refused if it differs.

A wrong bit rate disturbs a live bus. The dialect's applies unless an option names another one. A
bit rate from variables, configuration files or the kernel is compared with it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from flasher.bus.fallback import Fallback
from flasher.bus.inspect_interface import Interface, change_commands, read_interface
from flasher.errors import BusError, ErrorCode, UsageError
from flasher.protocol.text import printable

LOWEST_BPS: Final = 5_000
HIGHEST_BPS: Final = 1_000_000
"""Limits of classic CAN."""
_TOLERANCE: Final = 0.005
"""Relative: the kernel reports the bit rate that its clock can reach."""
_NAMES: Final = ("timing", "bitrate", "nom_tseg1", "tseg1")
"""Keywords that determine the bit rate; python-can converts the last two to a timing."""
DECIDING: Final = frozenset(
    {
        "timing", "f_clock", "f_clock_mhz", "brp", "tseg1", "tseg2", "sjw", "nof_samples",
        "nom_brp", "nom_tseg1", "nom_tseg2", "nom_sjw", "btr0", "btr1", "bitrate",
    }
)  # fmt: skip
"""Keywords of all back ends that set the bit rate or a part of the bit timing."""
_BY_OPTION: Final = {"bitrate": "-b", "timing": "--timing"}


@dataclass(frozen=True)
class BitRate:
    """Bit rate in bit/s, and the option, file or variable that it comes from."""

    bps: int
    source: str

    def __str__(self) -> str:
        return f"{self.bps / 1000:g} kbit/s ({self.source})"


def bit_rate(
    dialect_bps: int,
    given: Mapping[str, Any],
    merged: Mapping[str, Any],
    fallback: Fallback | None = None,
) -> BitRate:
    """Return the bit rate at which a bus runs, or is to be opened.

    `given` are the options, `merged` is their combination with python-can's variables and files and
    with the `fallback`. Raises UsageError for an invalid bit rate; BusError if it is not the
    dialect's and no option chose it, or if the kernel has set a SocketCAN interface differently.
    """
    named = named_bit_rate(given, merged, fallback)
    wanted = BitRate(dialect_bps, "the dialect's") if named is None else named
    is_chosen = any(name in given for name in _NAMES)
    kernel = _of_kernel(merged)
    if named is not None and not is_chosen:
        _refuse_other(named, BitRate(dialect_bps, "the dialect's"), merged)
    if kernel is not None:
        _refuse_other(kernel, wanted, merged)
        return kernel
    return wanted


def named_bit_rate(
    given: Mapping[str, Any], merged: Mapping[str, Any], fallback: Fallback | None = None
) -> BitRate | None:
    """Return the bit rate named by an option, a variable or a file; None without one. Raises
    UsageError for an invalid one.
    """
    name = next((each for each in ("timing", "bitrate") if each in merged), None)
    if name is None:
        return None
    value = merged[name]
    source = _BY_OPTION[name] if name in given else _configured_by(fallback)
    if name == "timing":
        value = getattr(value, "nom_bitrate", None) or value.bitrate
    if isinstance(value, str) and value.isdigit():
        value = int(value)
    if type(value) is not int or not LOWEST_BPS <= value <= HIGHEST_BPS:
        raise UsageError(
            f"{printable(str(value))} is not a bit rate in bit/s.",
            where=source,
            remedy=f"Give one from {LOWEST_BPS} to {HIGHEST_BPS}, as 250000; without one the "
            "dialect's holds.",
        )
    return BitRate(value, source)


def _configured_by(fallback: Fallback | None) -> str:
    """Name the variable or file that sets the bit rate, if no option does."""
    from flasher.python_can import can  # noqa: PLC0415  slow, and not needed for a mock

    variables = can.util.load_environment_config()
    if any(name in variables for name in _NAMES):
        as_json = json.loads(os.environ.get("CAN_CONFIG") or "{}")
        return "CAN_CONFIG" if any(name in as_json for name in _NAMES) else "CAN_BITRATE"
    for name in reversed(can.util.CONFIG_FILES):
        path = Path(name).expanduser()
        if path.is_file() and any(each in can.util.load_file_config(path) for each in _NAMES):
            return printable(str(path))
    if fallback is not None and "bitrate" in fallback.bus:
        return fallback.source
    return "python-can's configuration"


def _of_kernel(merged: Mapping[str, Any]) -> BitRate | None:
    """Return the bit rate of a SocketCAN interface; None if unknown."""
    channel = merged.get("channel")
    if merged.get("interface") != "socketcan" or not channel:
        return None
    interface = read_interface(str(channel))
    if not isinstance(interface, Interface) or interface.bitrate_bps is None:
        return None
    return BitRate(interface.bitrate_bps, f"the kernel's setting of {printable(str(channel))}")


def is_same_rate(found_bps: int, wanted_bps: int) -> bool:
    """True for bit rates of nodes that understand each other."""
    return abs(found_bps - wanted_bps) <= wanted_bps * _TOLERANCE


def _refuse_other(found: BitRate, wanted: BitRate, merged: Mapping[str, Any]) -> None:
    if is_same_rate(found.bps, wanted.bps):
        return
    if found.source.startswith("the kernel"):
        commands = change_commands(merged["channel"], f"bitrate {wanted.bps}")
        change = f"`{'; '.join(commands)}` (as root) sets it"
    else:
        change = f"take it out of {found.source}"
    raise BusError(
        f"The bit rate would be {found}, not {wanted}: nothing was opened.",
        where=f"interface {merged.get('interface')}, channel {merged.get('channel')}",
        cause="a wrong bit rate disturbs every node on the bus",
        remedy=f"If the bus runs at {wanted.bps} bit/s: {change}. If it runs at {found.bps}: "
        f"-b {found.bps}.",
        code=ErrorCode.OTHER_BIT_RATE,
    )
