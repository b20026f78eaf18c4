"""What `flasher doctor` finds about python-can itself: version, configuration, missing packages."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import can
import can.util

from flasher.bus.opening import needed_extra
from flasher.cli.look.findings import Finding, Severity
from flasher.protocol.spec import Dialect
from flasher.protocol.text import printable

_VARIABLES: Final = ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG")
_ABOUT: Final = "python-can"


def setup_findings() -> Iterator[Finding]:
    """python-can's version, and what configures it besides the command line."""
    yield Finding(Severity.OK, _ABOUT, f"python-can {can.__version__}")
    for name in can.util.CONFIG_FILES:
        path = Path(name).expanduser()
        if path.is_file():
            what = f"the configuration file {printable(str(path))} is in effect"
            yield Finding(Severity.NOTE, _ABOUT, what)
    for variable in _VARIABLES:
        if os.environ.get(variable):
            what = f"{variable}={printable(os.environ[variable])} is set"
            yield Finding(Severity.NOTE, _ABOUT, what)


def package_findings(interface: str) -> Iterator[Finding]:
    """The Python package that the chosen interface needs, when it is missing."""
    needed = needed_extra(interface)
    if needed is not None and importlib.util.find_spec(needed[1]) is None:
        extra, module = needed
        what = f"the package {module!r}, which the interface {interface} needs, is not installed"
        yield Finding(Severity.PROBLEM, _ABOUT, what, (f"pip install 'python-can[{extra}]'",))


def bit_rate_findings(bitrate_bps: int, dialect: Dialect) -> Iterator[Finding]:
    """A bit rate that was asked for against the one of the dialect."""
    if bitrate_bps != dialect.bitrate_bps:
        yield Finding(
            Severity.WARNING,
            "adapter",
            f"{bitrate_bps / 1000:g} kbit/s is configured, {dialect.name} runs at "
            f"{dialect.bitrate_bps / 1000:g} kbit/s",
            (f"-b {dialect.bitrate_bps}",),
        )
