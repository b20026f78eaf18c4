"""How `flasher doctor` looks: in which order, at what; it sends nothing."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from typing import Any, Final

from flasher import api
from flasher.bus.link import Clock, Link, MonotonicClock
from flasher.cli.look.detect import Detected, Detection
from flasher.cli.look.doctor_traffic import Listened, Traffic, traffic_findings
from flasher.cli.look.findings import (
    Finding,
    Severity,
    adapter_findings,
    health_findings,
    interface_findings,
    nameless_finding,
    opening_finding,
    unchosen_finding,
)
from flasher.cli.options import Bus
from flasher.cli.output import Output
from flasher.driver import drive
from flasher.errors import BusError, InterruptedByUserError
from flasher.host.survey import Survey
from flasher.protocol.spec import BMS
from flasher.protocol.text import printable

_SLOW: Final = frozenset({"socketcand"})
"""A back end that waits for servers on the network: asked only when no other one is chosen."""


_OWN_OPTIONS: Final = frozenset(
    {"interface", "channel", "bitrate", "fd", "data_bitrate", "timing", "can_filters"}
)
"""Keywords of a bus that have an option of their own."""


class Examination:
    """What was looked at, and what was found."""

    def __init__(self, bus: Bus, listen_s: float, output: Output) -> None:
        self._bus = bus
        self._listen_s = listen_s
        self._output = output
        self.dialect = bus.dialect
        self.bitrate_bps = self.dialect.bitrate_bps
        self.detected = Detected()
        self.listened: Listened | None = None
        self.findings: list[Finding] = []
        """In the order in which they are told."""

    def look_at_mock(self, stopped: Callable[[], bool]) -> None:
        """The built-in bicycle in place of an adapter."""
        speed = self._bus.mock_speed
        with api.connect_mock(BMS, self.dialect, speed=speed, system=True) as mock:
            self._note(opened_finding(mock.name, is_silent=False))
            self._listen(mock.link, mock.clock, "--mock", stopped)

    def look_at_adapters(self, stopped: Callable[[], bool]) -> None:
        """The adapters that are there, the chosen one, and its bus."""
        import can  # noqa: PLC0415  slow, and not needed for a mock

        from flasher.bus.opening import bus_config  # noqa: PLC0415
        from flasher.cli.look.doctor_setup import setup_findings  # noqa: PLC0415

        self._note(*setup_findings())
        given = self._bus.config
        config: dict[str, Any] | None = None
        try:
            config = bus_config(given)
        except BusError:  # none is named: no other failure is one of the bus
            config = None
        asked = can.VALID_INTERFACES - (_SLOW if config else set()) | _named(config)
        with Detection(sorted(asked)) as detection:
            before, self.findings = self.findings, []
            if config is not None:
                self._look_at(config, given, stopped)
            self.detected = detection.collect(stopped)
        _check_stopped(stopped())
        looked, self.findings = self.findings, before
        self._note(*adapter_findings(self.detected), *looked)
        if config is None:
            self._note(unchosen_finding(self.detected))

    def _look_at(
        self, config: dict[str, Any], given: dict[str, Any], stopped: Callable[[], bool]
    ) -> None:
        from flasher.bus.adapter import open_adapter  # noqa: PLC0415  loads python-can
        from flasher.bus.bit_rate import named_bit_rate  # noqa: PLC0415
        from flasher.bus.inspect_interface import Interface, read_interface  # noqa: PLC0415
        from flasher.bus.opening import can_listen_only  # noqa: PLC0415
        from flasher.cli.look.doctor_setup import (  # noqa: PLC0415
            bit_rate_findings,
            package_findings,
        )

        interface, channel = str(config["interface"]), str(config.get("channel") or "")
        named = named_bit_rate(given, config)
        if named is not None:
            self.bitrate_bps = named.bps
        self._note(*package_findings(interface))
        if "bitrate" in given or "timing" in given:  # any other source is refused at the opening
            self._note(*bit_rate_findings(self.bitrate_bps, self.dialect))
        if interface == "socketcan" and not channel:
            self._note(nameless_finding())
            return
        if interface == "socketcan":
            seen = read_interface(channel)
            self._note(*interface_findings(seen, channel, self.bitrate_bps))
            if isinstance(seen, Interface) and (
                not (seen.is_up and seen.is_can)  # it would open, and carry nothing
                or seen.bitrate_bps not in (None, self.bitrate_bps)  # it would not be opened
            ):
                return
        try:
            link = open_adapter(self.dialect.bitrate_bps, listen_only=True, **given)
        except BusError as error:
            self._note(opening_finding(error))
            return
        try:
            is_silent = can_listen_only(interface)
            self._note(opened_finding(str(link), is_silent=is_silent))
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
        """Listen, sending nothing, and note the health of the link and what was heard."""
        listen_s = self._listen_s
        survey = Survey(listen_s=listen_s, bitrate_bps=self.bitrate_bps, dialect=self.dialect)
        traffic = Traffic()
        where = str(link) if interface else "the built-in mock"
        self._output.progress(f"listening for {listen_s:g} s on {printable(where)} ...")
        try:
            drive(survey, link, clock, taps=(traffic,), cancelled=stopped)
        except BusError as error:
            self._note(opening_finding(error))
        _check_stopped(survey.cancelled)
        health = link.health()
        self._note(*health_findings(health, channel, is_socketcan=interface == "socketcan"))
        self.listened = Listened(
            traffic, survey, health, listen_s, self.bitrate_bps, self.dialect, is_silent,
            bus_arguments,
        )  # fmt: skip
        self._note(*traffic_findings(self.listened))

    def _note(self, *findings: Finding) -> None:
        self.findings += findings


def bus_words(interface: str, channel: str, given: Mapping[str, Any]) -> str:
    """What chooses this bus on the command line, as a shell takes it. What the back end was given
    beside its name comes last, where it swallows no other argument.
    """
    words = ["-i", interface, *(["-c", channel] if channel else [])]
    if "bitrate" in given:
        words += ["-b", str(given["bitrate"])]
    more = [
        f"{key}={value}"
        for key, value in given.items()
        if key not in _OWN_OPTIONS and isinstance(value, str | int | float)
    ]
    return printable(shlex.join([*words, *(["--bus-kwargs", *more] if more else [])]))


def opened_finding(name: str, *, is_silent: bool) -> Finding:
    """The adapter was opened."""
    how = "listens without acknowledging" if is_silent else "acknowledges as usual"
    return Finding(Severity.OK, "adapter", f"{printable(name)} opens and {how}")


def _named(config: Mapping[str, Any] | None) -> set[str]:
    return set() if config is None else {str(config["interface"])}


def _check_stopped(is_stopped: bool) -> None:  # noqa: FBT001  a guard
    if is_stopped:
        raise InterruptedByUserError("Interrupted by the user.")
