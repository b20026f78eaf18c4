"""Verdict on an upgrade in a trace: its result, phase, likely cause and next step.

Causes that concern the whole bus (a second tool, no acknowledgement, two devices) are checked
first, as their symptoms look like the fault of a phase.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

from flasher.events import Phase
from flasher.protocol.text import BOOT_VERSION_FORM
from flasher.trace.observed_upgrade import ObservedUpgrade
from flasher.trace.story import Cause, TraceVerdict
from flasher.wording import explanation

_SILENT_S: Final = 1.0
"""Silence after which a tool that should send has stopped."""
_ACK_WAIT_S: Final = 0.4
"""Silence after which a packet is unanswered, even if sent only once."""
_RESETS: Final = 3
"""Number of unanswered resets that are not the begin of a truncated trace."""
_ERRORS: Final = 3
"""Number of error frames since the last progress that are the reason, not a coincidence."""
_EXTRA_ACKS: Final = 3
_NO_RETURN: Final = frozenset(
    {Cause.NO_BOOT_VERSION, Cause.RESET_IGNORED, Cause.NO_REQUEST, Cause.UPDATE_NOT_TAKEN}
)


class _Found(NamedTuple):
    cause: Cause
    text: str


def judge(upgrade: ObservedUpgrade, until_s: float, *, is_alone: bool = False) -> TraceVerdict:
    """Judge an upgrade in a trace that continues until `until_s`; `is_alone` means that only the
    tool sent frames.
    """
    found = _completed(upgrade) or _bus_cause(upgrade, is_alone=is_alone)
    if found is None:
        silent_s = until_s - upgrade.last_at_s
        match upgrade.phase:
            case Phase.UPDATE:
                found = _in_update(upgrade)
            case Phase.TRANSFER:
                found = _in_transfer(upgrade, silent_s)
            case Phase.END | Phase.CONFIRM:
                found = _at_end(upgrade)
            case _:
                found = _before_update(upgrade, until_s)
    if upgrade.earlier is not None and found.cause in _NO_RETURN:
        # The device did not come back: what happened before says more than that.
        return replace(upgrade.earlier, text=f"{upgrade.earlier.text} Then: {found.text}")
    packet = upgrade.current if upgrade.phase is Phase.TRANSFER else None
    likely, remedy = explanation(found.cause)
    names = {"node": upgrade.target.node.name, "boot_name": upgrade.target.boot_name}
    return TraceVerdict(
        cause=found.cause,
        phase=upgrade.phase,
        packet=None if packet is None else packet.number,
        attempt=upgrade.attempt,
        text=found.text,
        likely=likely.format(**names),
        remedy=remedy.format(**names),
    )


def _completed(upgrade: ObservedUpgrade) -> _Found | None:
    node, running = upgrade.target.node.name, upgrade.running_version
    if upgrade.completed_at_s is None:
        return None
    if running is None and upgrade.announcing.goes_on(upgrade.last_at_s):
        text = (
            f"The {node} reported complete, then its bootloader announced itself for "
            f"{upgrade.announcing.lasted_s:.1f} s, and no application answered."
        )
        return _Found(Cause.IN_BOOTLOADER, text)
    if running is None:
        text = (
            f"The {node} has every packet and reported complete; the trace holds no version answer."
        )
        return _Found(Cause.COMPLETED, text)
    if _is_other(upgrade):
        return _other_version(upgrade)
    return _Found(
        Cause.COMPLETED,
        f"The {node} has every packet, reported complete, and is running version {running}.",
    )


def _is_other(upgrade: ObservedUpgrade) -> bool:
    """True if the image contains exactly one version and the device answers another."""
    known = upgrade.image_versions
    return len(known) == 1 and upgrade.running_version not in known


def _other_version(upgrade: ObservedUpgrade) -> _Found:
    (sent,) = upgrade.image_versions
    end = "reported complete" if upgrade.completed_at_s is not None else "did not report complete"
    return _Found(
        Cause.OTHER_VERSION,
        f"The {upgrade.target.node.name} {end}; it answers version {upgrade.running_version}, "
        f"the packets hold version {sent}.",
    )


# -- causes of the whole bus -----------------------------------------------------------------------


def _bus_cause(upgrade: ObservedUpgrade, *, is_alone: bool) -> _Found | None:
    node = upgrade.target.node.name
    if upgrade.intrusions and not upgrade.is_one_tool:
        unexplained = "; ".join(upgrade.intrusions[:3])
        text = f"This upgrade does not explain messages on the tool's own CAN id: {unexplained}."
        return _Found(Cause.SECOND_TOOL, text)
    is_cut_in = upgrade.interleaving.found and upgrade.damage_from_tool
    if is_cut_in and not upgrade.is_one_tool:
        begun = "began inside another one"
        found = times(upgrade.interleaving.found)
        text = f"On the tool's own CAN id a message {begun} {found}."
        return _Found(Cause.SECOND_TOOL, text)
    if is_alone and upgrade.errors:
        text = f"Only the tool's frames and error frames ({upgrade.errors:,}) are on this bus."
        return _Found(Cause.NOBODY_ACKNOWLEDGES, text)
    if upgrade.boot_changes or upgrade.extra_acks >= _EXTRA_ACKS:
        text = f"{upgrade.extra_acks} packets that were sent once had two ACKs."
        if upgrade.boot_changes:
            each = ", ".join(f"{name} ({n})" for name, n in upgrade.boot_versions.items())
            text = f"On the id of the {node} bootloaders announce different versions: {each}."
        return _Found(Cause.TWO_DEVICES, text)
    names = upgrade.boot_names
    is_other = names and (upgrade.target.boot_name not in names or upgrade.is_boot_odd)
    if is_other and upgrade.phase is not Phase.TRANSFER and not upgrade.ends:
        own = f"{upgrade.target.boot_name} {BOOT_VERSION_FORM}"
        text = f"The bootloader announces {', '.join(upgrade.boot_versions)}; not {own}."
        return _Found(Cause.WRONG_DEVICE, text)
    if upgrade.early_complete and not upgrade.ends:
        text = f"The {node} reported complete before the tool had sent the end of the transfer."
        return _Found(Cause.COMPLETE_TOO_EARLY, text)
    if upgrade.shutdown_at_s is not None:
        after_s = upgrade.shutdown_at_s - upgrade.begin_s
        text = (
            f"The battery sent SHUTDOWN {after_s:.2f} s after the begin of the upgrade, which was "
            "not completed."
        )
        return _Found(Cause.SHUTDOWN, text)
    if upgrade.errors_now >= _ERRORS:
        text = f"{upgrade.errors_now:,} error frames came since the last progress."
        return _Found(Cause.BUS_TROUBLE, text)
    return None


# -- phase by phase -------------------------------------------------------------------------------


def _before_update(upgrade: ObservedUpgrade, until_s: float) -> _Found:
    node = upgrade.target.node.name
    if upgrade.is_announced:
        announced = ", ".join(upgrade.boot_versions)
        text = f"The bootloader announced {announced}, and the tool sent no update command."
        return _stopped(text, until_s - upgrade.tool_at_s)
    if upgrade.feedbacks:
        text = f"The application of the {node} confirmed the reset, and no boot version followed."
        return _Found(Cause.RESET_IGNORED, text + _short(until_s - upgrade.last_at_s))
    text = f"The reset was sent {times(upgrade.resets)}, and the {node} did not answer."
    if upgrade.resets >= _RESETS or until_s - upgrade.begin_s >= _SILENT_S:
        return _Found(Cause.NO_BOOT_VERSION, text)
    return _Found(Cause.RECORDING_ENDS, text)


def _in_update(upgrade: ObservedUpgrade) -> _Found:
    node = upgrade.target.node.name
    sent = f"The update command was sent {times(upgrade.updates)}"
    if upgrade.feedbacks_after_update:
        text = f"{sent}; the application of the {node} answers it, not the bootloader."
        return _Found(Cause.UPDATE_NOT_TAKEN, text)
    if upgrade.boots_after_update:
        text = f"{sent}; the bootloader of the {node} goes on announcing itself."
        return _Found(Cause.UPDATE_NOT_TAKEN, text)
    return _Found(Cause.NO_REQUEST, f"{sent}, and the {node} did not request the transfer.")


def _in_transfer(upgrade: ObservedUpgrade, silent_s: float) -> _Found:
    node, packet = upgrade.target.node.name, upgrade.current
    if upgrade.is_restarted:
        at = "" if packet is None else f" at packet {packet.number} of {upgrade.total}"
        text = f"The {node} restarted{at}, {times(upgrade.restarts)} in all."
        return _Found(Cause.DEVICE_RESTARTED, text)
    if upgrade.is_cut_short:
        after = "" if packet is None else f" after packet {packet.number} of {upgrade.total}"
        return _stopped(f"The tool's last message{after} was never finished.", silent_s)
    if packet is None:
        return _stopped(f"The {node} requested the transfer, and no packet came.", silent_s)
    which = f"Packet {packet.number} of {upgrade.total}"
    if packet.answered_at_s is not None:
        return _stopped(f"{which} was acknowledged, and nothing followed.", silent_s)
    sent = f"{which} was sent {times(packet.tries)}"
    if upgrade.damage_now * 2 >= packet.tries:
        pieces = f"{_pieces(upgrade.damage_now)} among tool and device"
        return _Found(Cause.PACKET_DAMAGED, f"{sent} whole and never acknowledged; {pieces}.")
    if packet.naks * 2 >= packet.tries and packet.naks > 1:
        return _Found(Cause.PACKET_REFUSED, f"{sent} and refused {times(packet.naks)} (NAK).")
    if packet.naks and packet.tries == 1:
        return _stopped(f"{which} was refused once, and was not sent again.", silent_s)
    if packet.tries > 1 or silent_s >= _ACK_WAIT_S:
        if upgrade.answered_otherwise > 1 and upgrade.answered_otherwise * 2 >= packet.tries:
            text = f"{sent}, and was answered by {upgrade.other_answer}."
            return _Found(Cause.PACKET_ANSWERED_OTHERWISE, text)
        return _Found(Cause.PACKET_UNANSWERED, f"{sent}, and no ACK came.")
    return _Found(Cause.RECORDING_ENDS, f"{sent}, its answer is not in the trace any more.")


def _at_end(upgrade: ObservedUpgrade) -> _Found:
    node = upgrade.target.node.name
    if upgrade.running_version is not None:
        if _is_other(upgrade):
            return _other_version(upgrade)
        if upgrade.image_versions:
            text = (
                f"The {node} did not report complete; the new application answers its version, "
                f"{upgrade.running_version}."
            )
            return _Found(Cause.CONFIRMED_BY_VERSION, text)
    if upgrade.end_naks:
        text = (
            f"The {node} has every packet and answered the end of the transfer with NAK, "
            f"{times(upgrade.end_naks)}."
        )
        return _Found(Cause.REFUSED, text)
    text = (
        f"Every packet is acknowledged, the end was sent {times(upgrade.ends)}, and neither "
        "complete nor NAK came."
    )
    if upgrade.boots_after_end:
        text += f" The bootloader announced itself {times(upgrade.boots_after_end)} after it."
    if upgrade.running_version is not None:
        text += (
            f" An application answers, version {upgrade.running_version}; the packets hold no "
            "version to compare it with."
        )
    return _Found(Cause.UNCONFIRMED, text)


def _stopped(text: str, silent_s: float) -> _Found:
    """Verdict for a tool that should have sent next: it stopped, or the recording did."""
    if silent_s >= _SILENT_S:
        return _Found(Cause.TOOL_STOPPED, f"{text} The trace goes on for {silent_s:.2f} s.")
    return _Found(Cause.RECORDING_ENDS, text)


def _pieces(count: int) -> str:
    return f"{count} damaged piece{'' if count == 1 else 's'}"


def _short(silent_s: float) -> str:
    """Addition to the text of a trace that ends before a wait is over."""
    if silent_s >= _SILENT_S:
        return f" The trace goes on for {silent_s:.2f} s."
    return " The trace ends here: either the tool gave up, or the recording was stopped."


def times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


# -- further remarks -------------------------------------------------------------------------------


def remarks(upgrade: ObservedUpgrade, cause: Cause) -> tuple[str, ...]:
    """Return remarks besides the verdict, without repeating it."""
    found = []
    names = upgrade.boot_names
    if upgrade.restarts and cause is not Cause.DEVICE_RESTARTED:
        found.append(f"the device restarted in the transfer {times(upgrade.restarts)}")
    if upgrade.early_complete and cause is not Cause.COMPLETE_TOO_EARLY:
        found.append("the device reported complete before the end of the transfer was sent")
    if upgrade.boot_changes and cause is not Cause.TWO_DEVICES:
        found.append(f"different boot versions: {', '.join(upgrade.boot_versions)}")
    if upgrade.extra_acks and cause is not Cause.TWO_DEVICES:
        found.append(f"packets with an ACK too many: {upgrade.extra_acks}")
    if names and upgrade.target.boot_name not in names and cause is not Cause.WRONG_DEVICE:
        found.append(f"boot name is {', '.join(sorted(names))}, not {upgrade.target.boot_name}")
    found += _of_another_unit(upgrade)
    if upgrade.shutdown_at_s is not None and cause is not Cause.SHUTDOWN:
        found.append("the battery sent SHUTDOWN in the meantime")
    if upgrade.intrusions and cause is not Cause.SECOND_TOOL:
        found.append(f"not explained by this upgrade: {'; '.join(upgrade.intrusions)}")
    if upgrade.errors and cause not in {Cause.BUS_TROUBLE, Cause.NOBODY_ACKNOWLEDGES}:
        found.append(f"error frames in the meantime: {upgrade.errors:,}")
    if upgrade.damage_from_tool:
        found.append(f"{_pieces(upgrade.damage_from_tool)} on the tool's id")
    if upgrade.damage_from_device:
        found.append(f"{_pieces(upgrade.damage_from_device)} on the device's id")
    if upgrade.end_naks and cause is not Cause.REFUSED:
        found.append(f"the end of the transfer was refused {times(upgrade.end_naks)}")
    return tuple(found)


def _of_another_unit(upgrade: ObservedUpgrade) -> list[str]:
    other, own = upgrade.other_serial_number, upgrade.serial_number
    if not other:
        return []
    return [f"another unit answers after the end: serial number {other}, not {own}"]
