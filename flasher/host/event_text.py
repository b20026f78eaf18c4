"""Texts of upgrade events: warnings and progress lines for terminal and pages."""

from __future__ import annotations

from typing import Final

from flasher import events
from flasher.i18n import text
from flasher.wording import wording, wording_of

_MINUTES_FROM_S: Final = 180.0
_TRIES_SHOWN: Final = 10
"""Without -v only every tenth try of a message is shown, after 5 s without an answer."""


def reason_text(reason: str, what: str = "") -> str:
    """Text of a repetition's reason (`MessageRepeated`, `AttemptStarted`)."""
    return text(wording_of("Reason", reason), what=what)


def warning_text(event: object) -> str:
    """Text of an event that the user must see at once; empty for other events."""
    match event:
        case events.ShutdownHeard(sender):
            return text("the {sender} sent the command SHUTDOWN: it switches off", sender=sender)
        case events.ForeignQuery(title):
            return text(
                "another tool asks the device ({title}); the upgrade goes on. End that tool.",
                title=title,
            )
        case events.AdapterLost(reason, wait_s):
            return text(
                "{reason} Waiting {wait_s:g} s for the adapter ...", reason=reason, wait_s=wait_s
            )
        case events.BusBlocked(reason, limit_s):
            return text(
                "{reason} Trying on for {limit_s}: check power and contacts of the device.",
                reason=reason,
                limit_s=_span(limit_s),
            )
        case events.SecondToolAwaited(seen, quiet_s):
            return text(
                "another tool writes to the device ({seen}). It has no application any more: "
                "beginning again when the other tool has been silent for {quiet_s:g} s.",
                seen=seen,
                quiet_s=quiet_s,
            )
        case events.TwoDevicesSeen(what):
            return text(
                "two devices of one kind are on the bus: {what}. Disconnect one of them.", what=what
            )
        case events.CheckMade(_, "warned" | "waived", sentence):
            return sentence
        case _:
            return ""


def progress_line(event: object) -> tuple[str, int] | None:
    """Return the progress line of an event and the verbosity that shows it; None without one."""
    match event:
        case events.PhaseEntered(phase, _):
            return text("{phase} ...", phase=text(wording(phase))), 0
        case events.AttemptStarted(attempt, reason, left_s):
            left = text(" ({time} left)", time=_span(left_s)) if left_s else ""
            again = text(
                "{reason}: beginning again, attempt {attempt}{left}",
                reason=reason_text(reason),
                attempt=attempt,
                left=left,
            )
            return again, 0
        case events.UpgradeLeftOpen(at, image, has_end):
            has_left = text("left the device without an application")
            line = text(
                "the upgrade of {value} with {image} {left}: the device gets an update command if "
                "it stays silent",
                value=at.replace("T", " "),
                image=image,
                left=has_left if has_end else text("has no end"),
            )
            return line, 0
        case events.MessageRepeated(what, reason, tries):
            level = 1 if tries % _TRIES_SHOWN else 0
            again = text(
                "{reason}: sending {what} again, try {tries}",
                reason=reason_text(reason, what),
                what=what,
                tries=tries,
            )
            return again, level
        case events.BootVersionSeen(name, version):
            return text("boot version: {name} {version}", name=name, version=version), 0
        case events.CheckMade(check, verdict, sentence):
            is_usual = verdict == "passed" and check not in events.ALWAYS_SHOWN
            return f"check: {verdict}: {sentence}", 1 if is_usual else 0
        case events.AdapterBack():
            return text("the adapter is back"), 0
        case events.HostStalled(stalled_s):
            return text("this computer paused for {stalled_s:.1f} s", stalled_s=stalled_s), 1
        case events.Reported(what):
            return text("note: {what}", what=what), 1
        case events.BytesDamaged(can_id, reason, data):
            why = wording_of("DamageReason", reason)
            return f"bytes on 0x{can_id:03X} ignored: {why}: {data[:24].hex(' ')}", 2
        case _:
            return None


def _span(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= _MINUTES_FROM_S else f"{seconds:.0f} s"
