"""`flasher doctor`: diagnose adapter, interface, bus and traffic, with a command for each fault.

It never sends a frame, because at a wrong bit rate that would disturb a live bus; except, on
request, queries that measure the speed of a bus that was found in order.
"""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from flasher import api
from flasher.bus.detect import SLOW, Detection, DetectionResult
from flasher.bus.health import ControllerState, HealthKeeper, LinkHealth
from flasher.bus.link import Clock, Link, MonotonicClock
from flasher.cli import values
from flasher.cli.adapters import use_only_adapter
from flasher.cli.framework import command, option
from flasher.cli.look import findings, throughput
from flasher.cli.look.findings import Finding, ListenResult, Severity, TrafficCounter
from flasher.cli.look.throughput import BURSTS, QUERIES, Throughput
from flasher.cli.options import Bus, bus_options
from flasher.cli.output import Output
from flasher.cli.stop import stop_on_signal
from flasher.cli.terminal import painted, takes_colour
from flasher.driver import drive
from flasher.errors import (
    BusError,
    ErrorCode,
    ExitCode,
    InterruptedByUserError,
    without_password,
)
from flasher.host.survey import Survey
from flasher.protocol.spec import BMS, FRAMES_PER_PACKET
from flasher.protocol.text import printable

LISTEN_S: Final = 1.0
"""Default of --listen: most nodes of a running system send within this time."""

_EXAMPLES: Final = f"""\
examples:
  flasher doctor                                   list the adapters
  flasher doctor -i socketcan -c can0              check one: interface, bus, traffic
  flasher doctor -i pcan -c PCAN_USBBUS1 --listen 5 --json
  flasher doctor -i slcan -c /dev/ttyACM0 --throughput
  flasher doctor --mock                            the output for a healthy bus

Never sends a frame, and listens without acknowledging where the adapter can. So it does not try
other bit rates, and cannot detect a device that sends only when asked: flasher scan asks.

--throughput then sends version queries to the BMS, which change nothing: {QUERIES} that wait for
their answer, and {BURSTS} bursts of {FRAMES_PER_PACKET} frames. It sends nothing if a problem was
found, another tool sends, or a device is in its bootloader.
"""


@dataclass(frozen=True)
class AdapterDocument:
    """Adapter that python-can detects."""

    interface: str
    channel: str


@dataclass(frozen=True)
class TrafficDocument:
    """Traffic received while listening."""

    listened_s: float
    listen_only: bool
    """True if the adapter acknowledged no frame."""
    frames: int
    frames_per_s: float
    bus_load: float
    """Bus load, 0 to 1."""
    nodes: list[str]
    foreign_frames: int


@dataclass(frozen=True)
class DoctorDocument:
    """Findings, and the figures that they follow from."""

    findings: list[Finding]
    adapters: list[AdapterDocument]
    bitrate_bps: int
    health: LinkHealth | None
    """State of the controller; null if no adapter was opened, like `traffic`."""
    traffic: TrafficDocument | None
    throughput: Throughput | None
    """Speed of the adapter; null unless it was measured."""


DOCUMENTS: Final = (DoctorDocument,)

_OWN_OPTIONS: Final = frozenset(
    {"interface", "channel", "bitrate", "fd", "data_bitrate", "timing", "can_filters"}
)
"""Keywords of a bus that have their own option."""
_WORDS: Final = {
    Severity.OK: ("ok", "green"),
    Severity.NOTE: ("note", "cyan"),
    Severity.WARNING: ("WARNING", "yellow"),
    Severity.PROBLEM: ("PROBLEM", "red"),
}
"""Label and colour of each severity."""


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.BUS, ExitCode.INTERRUPTED))
@option(
    "--listen", type=values.seconds, default=LISTEN_S, metavar="S", brief=True,
    help="listen for so many seconds",
)  # fmt: skip
@option(
    "--throughput", "measures", is_flag=True, brief=True,
    help="then measure the adapter's speed, with version queries to the BMS",
)  # fmt: skip
@bus_options()
def doctor(output: Output, bus: Bus, *, listen: float, measures: bool) -> int:
    """Check the adapters, the selected one, its bus and the traffic."""
    examination = Diagnostics(bus, listen, output)
    with stop_on_signal() as stopped:
        if bus.mock:
            examination.look_at_mock(stopped)
        else:
            examination.look_at_adapters(stopped)
        if measures:
            examination.measure(stopped)
    output.results(lines(examination.findings, is_coloured=takes_colour(sys.stdout)))
    worst = max(examination.findings, key=lambda finding: list(Severity).index(finding.severity))
    document = _document(examination)
    if worst.severity is not Severity.PROBLEM:
        return output.document(document)
    error = BusError(
        f"A problem was found. {worst.about}: {worst.what}.",
        remedy="; ".join(worst.fix),
        code=ErrorCode.DOCTOR,
    )
    return output.failure(error, document)


def lines(findings: Sequence[Finding], *, is_coloured: bool) -> list[str]:
    """Format the findings, one per line, each followed by its commands."""
    shown = []
    for finding in findings:
        name, colour = _WORDS[finding.severity]
        word = painted(f"{name:<7}", colour) if is_coloured else f"{name:<7}"
        shown.append(f"{word}  {finding.about}: {finding.what}")
        shown += [f"             {command}" for command in finding.fix]
    return shown


def _document(examination: Diagnostics) -> DoctorDocument:
    heard = examination.listened
    return DoctorDocument(
        findings=examination.findings,
        adapters=[
            AdapterDocument(interface=found.interface, channel=printable(found.channel))
            for found in examination.detected.found
        ],
        bitrate_bps=examination.bitrate_bps,
        health=None
        if heard is None
        else replace(heard.health, error_frames=heard.traffic.error_frames),
        traffic=None
        if heard is None
        else TrafficDocument(
            listened_s=heard.duration_s,
            listen_only=heard.is_silent,
            frames=heard.traffic.frames,
            frames_per_s=round(heard.frames_per_s, 1),
            bus_load=round(heard.load, 4),
            nodes=sorted(node.name.lower() for node in heard.survey.heard),
            foreign_frames=heard.foreign_frames,
        ),
        throughput=examination.throughput,
    )


# -- the checks ------------------------------------------------------------------------------------


class Diagnostics:
    """Runs the checks and collects their findings."""

    def __init__(self, bus: Bus, listen_s: float, output: Output) -> None:
        self._bus = bus
        self._listen_s = listen_s
        self._output = output
        self.dialect = bus.dialect
        self.bitrate_bps = self.dialect.bitrate_bps
        self.detected = DetectionResult()
        self.listened: ListenResult | None = None
        self.throughput: Throughput | None = None
        self.findings: list[Finding] = []
        """Findings in the order of printing."""

    def look_at_mock(self, stopped: Callable[[], bool]) -> None:
        """Check the built-in bicycle instead of an adapter."""
        speed = self._bus.mock_speed
        with api.connect_mock(BMS, self.dialect, speed=speed, system=True) as mock:
            self._note(findings.opened(mock.name, is_silent=False))
            self._listen(mock.link, mock.clock, "--mock", stopped)

    def look_at_adapters(self, stopped: Callable[[], bool]) -> None:
        """Check the adapters of this computer, the selected one, and its bus."""
        from flasher.bus.opening import bus_config  # noqa: PLC0415
        from flasher.python_can import can  # noqa: PLC0415  slow, and not needed for a mock

        self._note(*findings.python_can_setup(self._bus.fallback))
        config: dict[str, Any] | None = None
        with contextlib.suppress(BusError):  # no adapter is selected
            config = bus_config(self._bus.config, self._bus.fallback)
        asked = set(can.VALID_INTERFACES)
        if config is not None:
            asked = asked - SLOW | {str(config["interface"])}
        with Detection(sorted(asked)) as detection:
            before, self.findings = self.findings, []
            if config is not None:
                self._look_at(config, stopped)
            self.detected = detection.collect(stopped)
        _check_stopped(is_stopped=stopped())
        looked, self.findings = self.findings, before
        self._note(*findings.adapter(self.detected), *looked)
        if config is None:
            found = [each for each in self.detected.found if each.channel]
            if len(found) != 1 or self._bus.is_named:
                self._note(findings.no_adapter_selected(self.detected))
                return
            self._bus = use_only_adapter(found[0], self._bus, self._output)
            self._look_at(bus_config(self._bus.config, self._bus.fallback), stopped)

    def _look_at(self, config: dict[str, Any], stopped: Callable[[], bool]) -> None:
        from flasher.bus.adapter import open_adapter  # noqa: PLC0415  loads python-can
        from flasher.bus.bit_rate import named_bit_rate  # noqa: PLC0415
        from flasher.bus.inspect_interface import (  # noqa: PLC0415
            Interface,
            Unseen,
            read_interface,
        )
        from flasher.bus.opening import can_listen_only  # noqa: PLC0415

        given = self._bus.config
        interface, channel = str(config["interface"]), str(config.get("channel") or "")
        named = named_bit_rate(given, config, self._bus.fallback)
        if named is not None:
            self.bitrate_bps = named.bps
        self._note(*findings.package(interface))
        if "bitrate" in given or "timing" in given:  # opening fails for any other source
            self._note(*findings.bit_rate(self.bitrate_bps, self.dialect))
        if interface == "socketcan" and not channel:
            self._note(findings.no_channel())
            return
        only_listens = False
        if interface == "socketcan":
            state = read_interface(channel)
            only_listens = isinstance(state, Interface) and state.only_listens
            self._note(*findings.interface(state, channel, self.bitrate_bps))
            if state is Unseen.MISSING:
                return
            if isinstance(state, Interface) and (
                not (state.is_up and state.is_can)  # it would open, but transfer nothing
                or state.bitrate_bps not in (None, self.bitrate_bps)  # opening it would fail
            ):
                return
            if isinstance(state, Interface) and state.state is ControllerState.BUS_OFF:
                health = HealthKeeper().health(state.state, state.tx_errors, state.rx_errors)
                self._note(*findings.health(health, channel, is_socketcan=True))
                return
        try:
            link = open_adapter(
                self.dialect.bitrate_bps,
                sends=False,
                listen_only=True,
                fallback=self._bus.fallback,
                **given,
            )
        except BusError as error:
            self._note(findings.opening_failed(error))
            return
        try:
            is_silent = can_listen_only(interface) or only_listens
            self._note(findings.opened(str(link), is_silent=is_silent))
            self._listen(
                link, MonotonicClock(), bus_words(interface, channel, given), stopped,
                interface=interface, channel=channel, is_silent=is_silent,
            )  # fmt: skip
        finally:
            link.close()

    def _listen(
        self,
        link: Link,
        clock: Clock,
        bus_arguments: str,
        stopped: Callable[[], bool],
        *,
        interface: str = "",
        channel: str = "",
        is_silent: bool = False,
    ) -> None:
        """Listen without sending; record the health of the link and the traffic."""
        listen_s = self._listen_s
        survey = Survey(listen_s=listen_s, bitrate_bps=self.bitrate_bps, dialect=self.dialect)
        traffic = TrafficCounter()
        where = str(link) if interface else "the built-in mock"
        self._output.progress(f"listening for {listen_s:g} s on {printable(where)} ...")
        try:
            drive(survey, link, clock, taps=(traffic,), cancelled=stopped)
        except BusError as error:
            self._note(findings.opening_failed(error))
        _check_stopped(is_stopped=survey.cancelled)
        health = link.health()
        self._note(*findings.health(health, channel, is_socketcan=interface == "socketcan"))
        self.listened = ListenResult(
            traffic, survey, health, listen_s, self.bitrate_bps, self.dialect, is_silent,
            bus_arguments,
        )  # fmt: skip
        self._note(*findings.traffic(self.listened))

    def measure(self, stopped: Callable[[], bool]) -> None:
        """Measure the speed of the adapter, unless its queries could disturb something."""
        reason = self._reason_not_to_send()
        if reason is not None:
            self._note(Finding(Severity.WARNING, "speed", f"not measured: {reason}"))
            return
        self._output.progress("measuring, with version queries to the BMS ...")
        try:
            with self._bus.connect(BMS) as connection:
                device = connection.device(BMS, dialect=self.dialect, cancelled=stopped)
                is_real_time = not self._bus.mock or self._bus.mock_speed > 0
                self.throughput = throughput.measure(device, is_real_time=is_real_time)
        except BusError as error:
            self._note(findings.opening_failed(error))
            return
        self._note(*findings.throughput(self.throughput))

    def _reason_not_to_send(self) -> str | None:
        if self.listened is None or any(
            each.severity is Severity.PROBLEM for each in self.findings
        ):
            return "a problem was found above"
        if any(node.boot_version for node in self.listened.survey.heard.values()):
            return "a device is in its bootloader"
        return None

    def _note(self, *findings: Finding) -> None:
        self.findings += findings


def bus_words(interface: str, channel: str, given: Mapping[str, Any]) -> str:
    """Format the options that select this bus, quoted for a shell."""
    words = ["-i", interface, *(["-c", channel] if channel else [])]
    if "bitrate" in given:
        words += ["-b", str(given["bitrate"])]
    for key, value in given.items():
        if key not in _OWN_OPTIONS and isinstance(value, str | int | float):
            words += ["--bus-kwargs", without_password(f"{key}={value}")]
    return printable(shlex.join(words))


def _check_stopped(*, is_stopped: bool) -> None:
    if is_stopped:
        raise InterruptedByUserError("Interrupted by the user.")
