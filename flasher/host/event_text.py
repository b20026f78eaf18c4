"""Texts of upgrade events: warnings and progress lines for terminal and pages."""

from __future__ import annotations

from typing import Final

from flasher import events
from flasher.wording import wording, wording_of

_MINUTES_FROM_S: Final = 180.0
_TRIES_SHOWN: Final = 10
"""Without -v only every tenth try of a message is shown, after 5 s without an answer."""


def reason_text(reason: str, what: str = "") -> str:
    """Text of a repetition's reason (`MessageRepeated`, `AttemptStarted`)."""
    return wording_of("Reason", reason).replace("{what}", what)


def warning_text(event: object) -> str:
    """Text of an event that the user must see at once; empty for other events."""
    match event:
        case events.ShutdownHeard(sender):
            return f"the {sender} sent the command SHUTDOWN: it switches off"
        case events.ForeignQuery(title):
            return f"another tool asks the device ({title}); the upgrade goes on. End that tool."
        case events.AdapterLost(reason, wait_s):
            return f"{reason} Waiting {wait_s:g} s for the adapter ..."
        case events.BusBlocked(reason, limit_s):
            return (
                f"{reason} Trying on for {_span(limit_s)}: check power and contacts of the device."
            )
        case events.SecondToolAwaited(seen, quiet_s):
            return (
                f"another tool writes to the device ({seen}). It has no application any more: "
                f"beginning again when the other tool has been silent for {quiet_s:g} s."
            )
        case events.TwoDevicesSeen(what):
            return f"two devices of one kind are on the bus: {what}. Disconnect one of them."
        case events.CheckMade(_, "warned" | "waived", text):
            return text
        case _:
            return ""


def progress_line(event: object) -> tuple[str, int] | None:
    """Return the progress line of an event and the verbosity that shows it; None without one."""
    match event:
        case events.PhaseEntered(phase, _):
            return f"{wording(phase)} ...", 0
        case events.AttemptStarted(attempt, reason, left_s):
            left = f" ({_span(left_s)} left)" if left_s else ""
            return f"{reason_text(reason)}: beginning again, attempt {attempt}{left}", 0
        case events.UpgradeLeftOpen(at, image, has_end):
            left = "left the device without an application" if has_end else "has no end"
            line = (
                f"the upgrade of {at.replace('T', ' ')} with {image} {left}: the device gets an "
                "update command if it stays silent"
            )
            return line, 0
        case events.MessageRepeated(what, reason, tries):
            level = 1 if tries % _TRIES_SHOWN else 0
            return f"{reason_text(reason, what)}: sending {what} again, try {tries}", level
        case events.BootVersionSeen(name, version):
            return f"boot version: {name} {version}", 0
        case events.CheckMade(_, verdict, text):
            return f"check: {verdict}: {text}", 1 if verdict == "passed" else 0
        case events.AdapterBack():
            return "the adapter is back", 0
        case events.HostStalled(stalled_s):
            return f"this computer paused for {stalled_s:.1f} s", 1
        case events.Reported(what):
            return f"note: {what}", 1
        case events.BytesDamaged(can_id, reason, data):
            why = wording_of("DamageReason", reason)
            return f"bytes on 0x{can_id:03X} ignored: {why}: {data[:24].hex(' ')}", 2
        case _:
            return None


def _span(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= _MINUTES_FROM_S else f"{seconds:.0f} s"
