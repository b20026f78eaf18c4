"""From the ending of an upgrade, and where it stood, to its outcome."""

from __future__ import annotations

from typing import Final

from flasher.events import Phase
from flasher.host.journal import Received
from flasher.host.outcome import DeviceLeft, Outcome, Statistics
from flasher.host.situation import Situation
from flasher.host.table import Ending
from flasher.image.plan import Plan
from flasher.protocol.messages import BootVersion
from flasher.protocol.text import printable

_SETTLED: Final = {
    Ending.COMPLETED: DeviceLeft.NEW,
    Ending.CONFIRMED_BY_VERSION: DeviceLeft.NEW,
    Ending.REFUSED: DeviceLeft.NO_APPLICATION,
    Ending.RESTARTED: DeviceLeft.NO_APPLICATION,
}
"""Endings that by themselves say what the device has."""


def conclude(
    ending: Ending, detail: str, plan: Plan, at: Situation, statistics: Statistics
) -> Outcome:
    """The outcome of an upgrade that ended so where `at` stands."""
    phase, packet, boot = at.phase, at.packet, at.last_boot
    if ending is Ending.PACKET_FAILED and packet is None:
        # It failed in an earlier attempt, and the device did not come back for this one.
        phase, packet = Phase.TRANSFER, at.failed_packet
    return Outcome(
        ending=ending,
        phase=phase,
        device_left=_SETTLED.get(ending, at.device_left),
        target=plan.target,
        total_packets=plan.total_packets,
        packet=packet,
        boot_version=printable(f"{boot.name} {boot.version}") if boot else None,
        running_version=at.running_version,
        statistics=statistics,
        detail=detail,
    )


def detail_of(ending: Ending, row: Received, plan: Plan, at: Situation) -> str:
    """What was seen, where the ending alone does not say it; device text is escaped."""
    if isinstance(row, BootVersion):
        return f"boot version {printable(row.name)!r} {printable(row.version)!r}"
    if ending is Ending.SECOND_TOOL:
        return at.second_tool
    if ending is Ending.OTHER_VERSION:
        return f"{at.running_version} instead of {plan.image.version}"
    if ending is Ending.PACKET_FAILED and at.nak_next_seen:
        return "it answers NAK n+1 to a repeated n; --nak-next-is-ack takes that for an ACK"
    if ending is Ending.PACKET_FAILED and at.phase is not Phase.TRANSFER:
        return "and no boot version came after it"
    return ""
