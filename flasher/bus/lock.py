"""Adapter lock: one program at a time on an adapter, among those of one user on one computer.

Two tools on a bus disturb each other. The lock is an advisory lock of the operating system on a
file in the user's state folder; it ends with its process. A second file next to it names the
holder.
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
_VIRTUAL: Final = "virtual"
"""python-can's bus inside a process: another process has another bus of that name."""
_OPENED_ONCE: Final = frozenset({"slcan", "robotell", "seeedstudio", "serial"})
"""Back ends on serial ports: opening a port reconfigures it and disturbs another user."""
_LONG_PORT: Final = re.compile(r"^[\\/]{2}[.?][\\/](?=COM\d+$)", re.IGNORECASE)
r"""Prefix of Windows serial ports: \\.\COM3 is COM3."""
_MULTICAST: Final = "udp_multicast"
"""Receives all multicast groups of its port, so that the port is the bus."""
_MULTICAST_PORT: Final = 43113
_KEYS: Final = ("channel", "host", "port", "index", "bus", "address", "serial", "serial_number",
                 "unique_hardware_id")  # fmt: skip
"""python-can keywords that identify an adapter."""


def acquire(config: Mapping[str, Any], holder: str | None) -> Callable[[], None]:
    """Lock the adapter that `config` (python-can's keywords) names; return the function that
    unlocks it, which may be called twice.

    `holder` is shown to other programs. None is for programs that only listen: they lock only
    serial ports, which cannot be opened twice. Raises BusError with the holder if the adapter is
    locked. If the state folder is not writable, a warning is logged and nothing is locked.
    """
    interface = config["interface"]
    name = f"{interface} {config.get('channel') or ''}".strip()
    if interface == _VIRTUAL or (holder is None and interface not in _OPENED_ONCE):
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
            remedy="Wait until it has ended, or end it."
            if interface in _OPENED_ONCE
            else "Wait until it has ended, or end it; flasher monitor watches the bus meanwhile.",
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
    """Lock file name of an adapter, the same for all names of that adapter."""
    interface = str(config["interface"])
    place = {key: str(config[key]) for key in _KEYS if config.get(key) is not None}
    if interface == _MULTICAST:
        place = {"port": str(config.get("port", _MULTICAST_PORT))}
    if interface in _OPENED_ONCE and "channel" in place:
        port = _LONG_PORT.sub("", place["channel"].partition("@")[0])  # slcan: DEVICE@BAUDRATE
        place["channel"] = os.path.realpath(port) if port.startswith("/") else port
    words = [platform.node(), interface, *(f"{key}={place[key]}" for key in place)]
    text = "-".join(words).casefold()
    readable = re.sub(r"[^a-z0-9.=-]+", "_", text)[:80]
    return f"{readable}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _holder_of(path: Path) -> str:
    """Describe the program that holds the lock."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        note = json.loads(path.with_suffix(".json").read_text())
        return printable(f"{note['holder']} (process {note['pid']}, since {note['since']})")
    return "another program that sends as the tool"
