"""One tool at a time on an adapter: an advisory lock, for the programs of one user on one computer.

Two tools on a bus spoil each other's dialogue. The lock is the operating system's, on a file in the
user's state folder: a process that died holds nothing any more. What stands beside it only tells
others who holds it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import platform
import re
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout
from platformdirs import user_state_path

from flasher.errors import BusError, ErrorCode
from flasher.protocol.text import printable

_LOG: Final = logging.getLogger("flasher.bus")
_IN_PROCESS: Final = "virtual"
"""python-can's bus inside of a process: the same channel of another process is another bus."""
_OPENED_ONCE: Final = frozenset({"slcan", "robotell", "seeedstudio", "serial"})
"""On serial ports: who opens one sets it up anew, and so ends what another program does with it."""
_LONG_PORT: Final = re.compile(r"^[\\/]{2}[.?][\\/](?=COM\d+$)", re.IGNORECASE)
r"""Before the name of a serial port of Windows: \\.\COM3 is COM3."""
_ON_A_PORT: Final = "udp_multicast"
"""Hears every multicast group on its port, so the port is the bus."""
_MULTICAST_PORT: Final = 43113
_PLACE: Final = ("channel", "host", "port", "index", "bus", "address", "serial", "serial_number",
                 "unique_hardware_id")  # fmt: skip
"""Keywords of python-can's back ends that tell one adapter from another."""


def hold(config: Mapping[str, Any], holder: str | None) -> Callable[[], None]:
    """Take the adapter that `config` (python-can's keywords) names; returns what gives it back,
    which may be called twice.

    `holder` is what others are told; None is for who never speaks as the tool, and takes only what
    cannot be opened twice. Raises BusError, naming who has it, when somebody has. Where the state
    folder cannot be written to, it is only logged that there is no lock.
    """
    interface = config["interface"]
    name = f"{interface} {config.get('channel') or ''}".strip()
    if interface == _IN_PROCESS or (holder is None and interface not in _OPENED_ONCE):
        return lambda: None
    try:
        folder = user_state_path("flasher", appauthor=False) / "locks"
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        path = folder / f"{place_of(config)}.lock"
        lock = FileLock(path, timeout=0, thread_local=False)
        lock.acquire()
    except Timeout:
        raise BusError(
            f"{printable(name)} is in use by {_told(path)}.",
            where="before the adapter was opened",
            cause="two tools on one bus spoil each other's dialogue, and an upgrade with it",
            remedy="Wait until it has ended, or end it; flasher monitor watches the bus meanwhile.",
            code=ErrorCode.ADAPTER_IN_USE,
        ) from None
    except OSError as error:
        _LOG.warning("no lock for %s: %s", name, error)
        return lambda: None
    told = path.with_suffix(".json")
    note = {
        "holder": holder or "a program that listens",
        "pid": os.getpid(),
        "since": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S"),
    }
    with contextlib.suppress(OSError):
        told.write_text(json.dumps(note))

    def give_back() -> None:
        if lock.is_locked:
            with contextlib.suppress(OSError):
                told.unlink()
            lock.release()

    return give_back


def place_of(config: Mapping[str, Any]) -> str:
    """One adapter, whoever names it, as the name of a file. The folder may be shared with other
    computers.
    """
    interface = str(config["interface"])
    place = {key: str(config[key]) for key in _PLACE if config.get(key) is not None}
    if interface == _ON_A_PORT:
        place = {"port": str(config.get("port", _MULTICAST_PORT))}
    if interface in _OPENED_ONCE and "channel" in place:
        port = _LONG_PORT.sub("", place["channel"].partition("@")[0])  # slcan: DEVICE@BAUDRATE
        place["channel"] = os.path.realpath(port) if port.startswith("/") else port
    words = [platform.node(), interface, *(f"{key}={place[key]}" for key in place)]
    text = "-".join(words).casefold()
    readable = re.sub(r"[^a-z0-9.=-]+", "_", text)[:80]
    return f"{readable}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _told(path: Path) -> str:
    """Who holds the lock, as it says itself."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        told = json.loads(path.with_suffix(".json").read_text())
        return printable(f"{told['holder']} (process {told['pid']}, since {told['since']})")
    return "another program that speaks as the tool"
