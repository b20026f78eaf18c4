"""Adapter lock: one tool at a time on an adapter, for the programs of one user on one computer.

Two tools on a bus disturb each other. The lock is an advisory lock of the operating system on a
file in the user's state folder, so that a dead process holds nothing. The file next to it only
names the holder.
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
"""python-can's bus inside a process: the same channel in another process is another bus."""
_OPENED_ONCE: Final = frozenset({"slcan", "robotell", "seeedstudio", "serial"})
"""On serial ports: opening one reconfigures it, and so disturbs another program that uses it."""
_LONG_PORT: Final = re.compile(r"^[\\/]{2}[.?][\\/](?=COM\d+$)", re.IGNORECASE)
r"""Prefix of a Windows serial port: \\.\COM3 is COM3."""
_ON_A_PORT: Final = "udp_multicast"
"""Receives every multicast group on its port, so the port is the bus."""
_MULTICAST_PORT: Final = 43113
_PLACE: Final = ("channel", "host", "port", "index", "bus", "address", "serial", "serial_number",
                 "unique_hardware_id")  # fmt: skip
"""Keywords of python-can's back ends that identify an adapter."""


def acquire(config: Mapping[str, Any], holder: str | None) -> Callable[[], None]:
    """Lock the adapter that `config` (python-can's keywords) names; return the function that
    unlocks it, which may be called twice.

    `holder` is shown to others. None is for programs that never send as the tool: they lock only
    what cannot be opened twice. Raises BusError with the holder if it is locked. If the state
    folder is not writable, only a warning is logged.
    """
    interface = config["interface"]
    name = f"{interface} {config.get('channel') or ''}".strip()
    if interface == _IN_PROCESS or (holder is None and interface not in _OPENED_ONCE):
        return lambda: None
    try:
        folder = user_state_path("flasher", appauthor=False) / "locks"
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        path = folder / f"{lock_name(config)}.lock"
        lock = FileLock(path, timeout=0, thread_local=False)
        lock.acquire()
    except Timeout:
        raise BusError(
            f"{printable(name)} is in use by {_holder_of(path)}.",
            where="before the adapter was opened",
            cause="two tools on one bus disturb each other, and any upgrade",
            remedy="Wait until it has ended, or end it; flasher monitor watches the bus meanwhile.",
            code=ErrorCode.ADAPTER_IN_USE,
        ) from None
    except OSError as error:
        _LOG.warning("no lock for %s: %s", name, error)
        return lambda: None
    note_path = path.with_suffix(".json")
    note = {
        "holder": holder or "a program that listens",
        "pid": os.getpid(),
        "since": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S"),
    }
    with contextlib.suppress(OSError):
        note_path.write_text(json.dumps(note))

    def release() -> None:
        if lock.is_locked:
            with contextlib.suppress(OSError):
                note_path.unlink()
            lock.release()

    return release


def lock_name(config: Mapping[str, Any]) -> str:
    """File name for an adapter, however it is named, on this computer."""
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


def _holder_of(path: Path) -> str:
    """Name the holder of the lock."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        note = json.loads(path.with_suffix(".json").read_text())
        return printable(f"{note['holder']} (process {note['pid']}, since {note['since']})")
    return "another program that sends as the tool"
