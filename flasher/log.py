"""Logging of events with the standard library, under loggers named `flasher.*`.

Only callers of engines log; engines report events. Nothing is shown unless the program using
flasher configures logging.
"""

from __future__ import annotations

import dataclasses
import logging
from enum import Enum
from typing import Final

from flasher import events
from flasher.protocol.fields import Content
from flasher.protocol.text import printable

ROOT: Final = "flasher"
_HOST: Final = logging.getLogger("flasher.host")
_DEVICE: Final = logging.getLogger("flasher.mock")
_INFO: Final = frozenset(
    {
        events.PhaseEntered,
        events.BootVersionSeen,
        events.VerificationStarted,
        events.PowerCycleAwaited,
        events.CheckMade,
        events.AdapterBack,
        events.DeviceStateEntered,
        events.ImageStored,
        events.DeviceWritten,
        events.ShutdownAnnounced,
        events.ShutdownEnded,
    }
)
"""Phases and waits."""
_WARNING: Final = frozenset(
    {
        events.HostStalled,
        events.MessageRepeated,
        events.Reported,
        events.AttemptStarted,
        events.QueryUnanswered,
        events.ShutdownHeard,
        events.ForeignQuery,
        events.SecondToolAwaited,
        events.AdapterLost,
        events.BusBlocked,
        events.BytesDamaged,
        events.DeviceReported,
    }
)
"""Problems, fatal or not."""
BY_DEVICE: Final = frozenset(
    {
        events.DeviceStateEntered,
        events.PacketStored,
        events.ImageStored,
        events.DeviceWritten,
        events.ShutdownAnnounced,
        events.ShutdownEnded,
        events.DeviceReported,
    }
)
"""Events of the device model."""
_BAD_VERDICTS: Final = frozenset({"warned", "waived", "refused"})
_CONTENT_WIDTH: Final = 400

# A library must not print: without this, warnings go to stderr.
logging.getLogger(ROOT).addHandler(logging.NullHandler())


def log_event(event: object) -> None:
    """Log an event: phases as INFO, problems as WARNING, others as DEBUG; `event` in `extra`."""
    logger = _DEVICE if type(event) in BY_DEVICE else _HOST
    level = level_of(event)
    if logger.isEnabledFor(level):
        logger.log(level, "%s", describe(event), extra={"event": event})


def level_of(event: object) -> int:
    """Log level of an event."""
    if isinstance(event, events.CheckMade) and event.verdict in _BAD_VERDICTS:
        return logging.WARNING
    if type(event) in _WARNING:
        return logging.WARNING
    return logging.INFO if type(event) in _INFO else logging.DEBUG


def describe(event: object) -> str:
    """Format an event as one escaped line: its name, then its fields."""
    name = type(event).__name__
    if not dataclasses.is_dataclass(event):
        return printable(f"{name}: {event}")
    values = ", ".join(
        f"{field.name}={_shown(getattr(event, field.name))}" for field in dataclasses.fields(event)
    )
    return f"{name}: {values}" if values else name


def _shown(value: object) -> str:
    match value:
        case Enum():
            return value.name.lower()
        case bytes():
            return value.hex(" ")
        case float():
            return f"{value:g}"
        case Content():
            return f"{type(value).__name__} {value.data().hex(' ')}"[:_CONTENT_WIDTH]
        case tuple():
            return " ".join(map(_shown, value)) or "none"
        case str():
            return repr(printable(value)) if " " in value or not value else printable(value)
        case _:
            return printable(str(value))
