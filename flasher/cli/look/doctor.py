"""`flasher doctor`: adapter, interface, bus and traffic, and the exact command for what is wrong.

It never sends a frame: at a wrong bit rate that would disturb a live bus.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated, Final, TypedDict

from flasher.bus.health import ControllerState
from flasher.cli import values
from flasher.cli.framework import command, option
from flasher.cli.look.doctor_traffic import Listened
from flasher.cli.look.examination import Examination
from flasher.cli.look.findings import Finding, Severity
from flasher.cli.options import Bus, bus_options
from flasher.cli.output import Output
from flasher.cli.stop import stop_on_signal
from flasher.errors import BusError, ExitCode
from flasher.protocol.text import printable

LISTEN_S: Final = 1.0
"""Unless --listen says otherwise: most nodes of a running system speak within it."""

_EXAMPLES: Final = """\
examples:
  flasher doctor                                   which adapters are there
  flasher doctor -i socketcan -c can0              this one: interface, bus, traffic
  flasher doctor -i pcan -c PCAN_USBBUS1 --listen 5 --json
  flasher doctor --mock                            what it looks like on a healthy bus

Never sends a frame, and listens without acknowledging where the adapter can be told so. So it does
not try other bit rates, and cannot see a device that speaks only when asked: flasher scan asks.
"""


class FindingDocument(TypedDict):
    """One thing that was looked at."""

    severity: Annotated[str, Severity]
    about: str
    what: str
    fix: list[str]
    """Commands, or what to do by hand."""


class AdapterDocument(TypedDict):
    """An adapter that python-can detects."""

    interface: str
    channel: str


class HealthDocument(TypedDict):
    """What the adapter tells about its controller."""

    state: Annotated[str, ControllerState]
    tx_errors: int | None
    rx_errors: int | None
    error_frames: int


class TrafficDocument(TypedDict):
    """What was heard."""

    listened_s: float
    listen_only: bool
    """True when the adapter acknowledged nothing."""
    frames: int
    frames_per_s: float
    bus_load: float
    """0 to 1."""
    nodes: list[str]
    foreign_frames: int


class DoctorDocument(TypedDict):
    """The findings, and the figures behind them."""

    findings: list[FindingDocument]
    adapters: list[AdapterDocument]
    bitrate_bps: int
    health: HealthDocument | None
    """Null when no adapter was opened, as `traffic`."""
    traffic: TrafficDocument | None


DOCUMENTS: Final = (DoctorDocument,)

_WORDS: Final = {
    Severity.OK: "ok",
    Severity.NOTE: "note",
    Severity.WARNING: "WARNING",
    Severity.PROBLEM: "PROBLEM",
}
_COLOURS: Final = {
    Severity.OK: "32",
    Severity.NOTE: "36",
    Severity.WARNING: "1;33",
    Severity.PROBLEM: "1;31",
}


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.BUS, ExitCode.INTERRUPTED))
@option(
    "--listen", type=values.seconds, default=LISTEN_S, metavar="S", brief=True,
    help="listen for so many seconds",
)  # fmt: skip
@bus_options()
def doctor(output: Output, bus: Bus, *, listen: float) -> int:
    """Look at the adapters, the chosen one, its bus and the traffic."""
    examination = Examination(bus, listen, output)
    with stop_on_signal() as stopped:
        if bus.mock:
            examination.look_at_mock(stopped)
        else:
            examination.look_at_adapters(stopped)
    is_coloured = sys.stdout.isatty() and not os.environ.get("NO_COLOR")
    for line in lines(examination.findings, is_coloured=is_coloured):
        output.result(line)
    worst = max(examination.findings, key=lambda finding: finding.severity.value)
    document = _document(examination)
    if worst.severity is not Severity.PROBLEM:
        output.document(document)
        return ExitCode.OK
    error = BusError(
        f"A problem was found. {worst.about}: {worst.what}.",
        remedy="; ".join(worst.fix),
    )
    output.failure(error, **document)
    return error.exit_code


def lines(findings: Sequence[Finding], *, is_coloured: bool) -> list[str]:
    """The findings as a person reads them, a line each, with their commands below."""
    shown = []
    for finding in findings:
        word = f"{_WORDS[finding.severity]:<7}"
        if is_coloured:
            word = f"\x1b[{_COLOURS[finding.severity]}m{word}\x1b[0m"
        shown.append(f"{word}  {finding.about}: {finding.what}")
        shown += [f"             {command}" for command in finding.fix]
    return shown


def _document(examination: Examination) -> DoctorDocument:
    heard = examination.listened
    return DoctorDocument(
        findings=[
            FindingDocument(
                severity=each.severity.name.lower(),
                about=each.about,
                what=each.what,
                fix=list(each.fix),
            )
            for each in examination.findings
        ],
        adapters=[
            AdapterDocument(interface=found.interface, channel=printable(found.channel))
            for found in examination.detected.found
        ],
        bitrate_bps=examination.bitrate_bps,
        health=None if heard is None else _health_document(heard),
        traffic=None if heard is None else _traffic_document(heard),
    )


def _health_document(heard: Listened) -> HealthDocument:
    return HealthDocument(
        state=heard.health.state.name.lower(),
        tx_errors=heard.health.tx_errors,
        rx_errors=heard.health.rx_errors,
        error_frames=heard.traffic.error_frames,
    )


def _traffic_document(heard: Listened) -> TrafficDocument:
    return TrafficDocument(
        listened_s=heard.duration_s,
        listen_only=heard.is_silent,
        frames=heard.traffic.frames,
        frames_per_s=round(heard.frames_per_s, 1),
        bus_load=round(heard.load, 4),
        nodes=sorted(node.name.lower() for node in heard.survey.heard),
        foreign_frames=heard.foreign_frames,
    )
