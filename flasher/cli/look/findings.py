"""Findings of `flasher doctor` about python-can, adapters, interfaces, the bus and its traffic.
These functions judge data that was collected before.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from functools import partial
from math import ceil
from pathlib import Path
from typing import Final

from flasher.bus.bit_rate import is_same_rate
from flasher.bus.detect import DetectionResult
from flasher.bus.fallback import Fallback
from flasher.bus.health import ControllerState, LinkHealth
from flasher.bus.inspect_interface import (
    VIRTUAL_KINDS,
    Interface,
    Unseen,
    change_commands,
    find_commands,
    kernel_has_can,
    restart_commands,
    start_command,
)
from flasher.bus.opening import needed_extra
from flasher.cli.look.throughput import Throughput
from flasher.cli.output import counted, spread_ms
from flasher.errors import BusError, hide_passwords, install_command
from flasher.host.options import FRAME_GAP_SHARE
from flasher.host.survey import Survey
from flasher.protocol import contents
from flasher.protocol.frame import Frame
from flasher.protocol.spec import FRAMES_PER_PACKET, Dialect, Node
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS as TIMES
from flasher.trace.decoder import bits_of
from flasher.trace.figures import Distribution
from flasher.wording import wording

_SHOWN_AT_MOST: Final = 20
"""Maximum number of listed adapters."""
_EXAMPLES: Final = (
    "flasher doctor -i socketcan -c can0",
    "flasher doctor -i pcan -c PCAN_USBBUS1",
    "flasher doctor -i slcan -c /dev/ttyACM0",
)
_LIST_INTERFACES: Final = "ip -brief link show type can"
_VARIABLES: Final = ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG")
_HIGH_LOAD: Final = 0.8
_SLOW_TIMES: Final = 2.0
_MANY_ERRORS: Final = 0.1
"""Share of error frames from which a bus counts as disturbed."""


class Severity(Enum):
    """Severity of a finding, the worst last."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True)
class Finding:
    """Sentence about a check, with commands that repair the problem."""

    severity: Severity
    about: str
    """Subject: "python-can", "adapters", "interface", "adapter", "bus", "traffic", "speed"."""
    what: str
    fix: tuple[str, ...] = ()


_ok, _note, _warning, _problem = (partial(Finding, severity) for severity in Severity)


# -- python-can ------------------------------------------------------------------------------------


def python_can_setup(fallback: Fallback | None) -> Iterator[Finding]:
    """Report the version of python-can, and its configuration outside the command line."""
    from flasher.python_can import can  # noqa: PLC0415  slow

    yield _ok("python-can", f"python-can {can.__version__}")
    for name in can.util.CONFIG_FILES:
        path = Path(name).expanduser()
        if path.is_file():
            yield _note("python-can", f"the configuration file {printable(str(path))} is in effect")
    for variable in _VARIABLES:
        if os.environ.get(variable):
            value = printable(hide_passwords(os.environ[variable]))
            yield _note("python-can", f"{variable}={value} is set")
    if fallback is not None:
        named = " ".join(
            str(fallback.bus[k]) for k in ("interface", "channel") if k in fallback.bus
        )
        yield _note("python-can", f"{fallback.source} names {printable(named)}")


def package(interface: str) -> Iterator[Finding]:
    """Report a missing Python package of the selected interface."""
    needed = needed_extra(interface)
    if needed is not None and importlib.util.find_spec(needed[1]) is None:
        extra, module = needed
        what = f"the package {module!r}, which the interface {interface} needs, is not installed"
        yield _problem("python-can", what, (install_command(f"python-can[{extra}]"),))


def bit_rate(bitrate_bps: int, dialect: Dialect) -> Iterator[Finding]:
    """Compare the requested bit rate with the dialect's."""
    if bitrate_bps != dialect.bitrate_bps:
        yield _warning(
            "adapter",
            f"{bitrate_bps / 1000:g} kbit/s is configured, {dialect.name} runs at "
            f"{dialect.bitrate_bps / 1000:g} kbit/s",
            (f"-b {dialect.bitrate_bps}",),
        )


# -- adapters and interfaces -----------------------------------------------------------------------


def adapter(detected: DetectionResult) -> Iterator[Finding]:
    """Report the adapters that python-can detects, and the back ends that did not answer."""
    for found in detected.found[:_SHOWN_AT_MOST]:
        details = " ".join(f"{key}={value}" for key, value in found.details.items())
        shown = printable(f"{found.interface} {found.channel} {details}".strip())
        yield _ok("adapters", f"detected {shown}")
    if not detected.found:
        yield _note(
            "adapters",
            "no adapter is detected; some back ends cannot list theirs (slcan and gs_usb)",
            ("flasher adapters",),
        )
    if detected.hung:
        names = ", ".join(detected.hung)
        yield _note("adapters", f"no answer in time from the back ends {names}")
    for name, error in detected.failed.items():
        text = printable(error)
        yield _note("adapters", f"the back end {name} fails: {text}")


def opened(name: str, *, is_silent: bool) -> Finding:
    """Report that the adapter was opened."""
    how = "listens without acknowledging" if is_silent else "acknowledges as usual"
    return _ok("adapter", f"{printable(name)} opens and {how}")


def opening_failed(error: BusError) -> Finding:
    """Explain why opening the adapter failed."""
    cause = f" ({printable(error.cause)})" if error.cause else ""
    what = f"{printable(error.what).rstrip('.')}{cause}"
    return _problem("adapter", what, (printable(error.remedy),))


def no_adapter_selected(detected: DetectionResult) -> Finding:
    """Explain how to select an adapter if none is selected."""
    ways = [f"flasher doctor {printable(each.arguments)}" for each in detected.found]
    return _problem(
        "adapter",
        "no adapter is chosen: neither -i, nor the variable CAN_INTERFACE, nor a configuration "
        "file of python-can, nor [bus] of flasher.toml names one",
        tuple(ways[:_SHOWN_AT_MOST]) or _EXAMPLES,
    )


def no_channel() -> Finding:
    """Report a missing channel: SocketCAN then receives from all interfaces, but cannot send."""
    what = "no channel is named: without one, SocketCAN can send nothing"
    return _problem("interface", what, (_LIST_INTERFACES, _EXAMPLES[0]))


def interface(state: Interface | Unseen, channel: str, bitrate_bps: int) -> Iterator[Finding]:
    """Check a SocketCAN interface for the settings that flasher needs."""
    name = printable(channel)
    if state is Unseen.CANNOT_TELL:
        yield _note("interface", f"{name}: this system gives no information about it")
    elif state is Unseen.MISSING and not kernel_has_can():
        what = "this system's kernel has no CAN; an adapter that python-can drives itself (slcan, "
        yield _problem("interface", f"{what}gs_usb, pcan) works without", ("flasher adapters",))
    elif state is Unseen.MISSING:
        yield _problem("interface", f"no interface {name} exists", find_commands(name))
    elif isinstance(state, Interface):
        yield from _kind(state, name, bitrate_bps)


def _kind(state: Interface, name: str, bitrate_bps: int) -> Iterator[Finding]:
    if not state.is_can:
        yield _problem("interface", f"{name} is not a CAN interface", (_LIST_INTERFACES,))
        return
    is_virtual = state.kind in VIRTUAL_KINDS
    if not state.is_up:
        start = f"ip link set {name} up" if is_virtual else start_command(name, bitrate_bps)
        yield _problem("interface", f"{name} is down", (start,))
    else:
        yield _ok("interface", f"{name} is up")
    if is_virtual:
        what = f"{name} is virtual ({state.kind}): no wire, no bit rate, no acknowledgement"
        yield _note("interface", what)
        return
    yield from _bit_rate(state, name, bitrate_bps)
    yield from _modes(state, name)
    yield from _queue_and_restart(state, name)


def _bit_rate(state: Interface, name: str, bitrate_bps: int) -> Iterator[Finding]:
    wanted = f"{bitrate_bps / 1000:g} kbit/s"
    if state.bitrate_bps is None:
        if state.is_up:
            what = f"the bit rate of {name} is not known; {wanted} is needed"
            fix = (f"ip -details link show {name}",)
            yield _note("interface", what, fix)
    elif not is_same_rate(state.bitrate_bps, bitrate_bps):
        yield _problem(
            "interface",
            f"{name} runs at {state.bitrate_bps / 1000:g} kbit/s, {wanted} is needed",
            change_commands(name, f"bitrate {bitrate_bps}"),
        )
    else:
        yield _ok("interface", f"{name} runs at {state.bitrate_bps / 1000:g} kbit/s")


def _modes(state: Interface, name: str) -> Iterator[Finding]:
    harm = {
        "LISTEN-ONLY": (Severity.PROBLEM, "nothing can be sent"),
        "LOOPBACK": (Severity.PROBLEM, "it talks to itself only"),
        "ONE-SHOT": (Severity.WARNING, "a frame that meets an error is lost"),
        "PRESUME-ACK": (Severity.WARNING, "a frame that no device acknowledges counts as sent"),
    }
    for mode, (severity, why) in harm.items():
        if mode in state.modes:
            what = f"{name} is in {mode.lower()} mode: {why}"
            yield Finding(severity, "interface", what, change_commands(name, f"{mode.lower()} off"))
    if "FD" in state.modes:
        what = f"{name} takes CAN FD; the protocol is classic CAN, which works there as well"
        yield _note("interface", what)


def _queue_and_restart(state: Interface, name: str) -> Iterator[Finding]:
    if state.restart_ms == 0:
        what = f"{name} stays off the bus after a bus-off"
        if state.can_restart:
            fix = change_commands(name, "restart-ms 100")
            yield _warning("interface", f"{what} (restart-ms 0)", fix)
        else:
            yield _note("interface", f"{what}, until it is taken down and up again")
    if state.queue_frames is not None and state.queue_frames < FRAMES_PER_PACKET:
        what = (
            f"the transmit queue of {name} holds {counted(state.queue_frames, 'frame')}, a packet"
        )
        what += f" has {FRAMES_PER_PACKET}: flasher waits for room, nothing is to be done"
        yield _note("interface", what)


def health(health: LinkHealth, channel: str, *, is_socketcan: bool) -> Iterator[Finding]:
    """Report the state of the controller and its error counters."""
    counters = ""
    if health.tx_errors is not None:
        counters = f", error counters: transmit {health.tx_errors}, receive {health.rx_errors}"
    restart = restart_commands(channel) if is_socketcan else ()
    what = f"the controller is {wording(health.state)}{counters}"
    if health.state is ControllerState.ACTIVE:
        yield _ok("bus", what)
    elif health.state is ControllerState.BUS_OFF:
        why = "too many frames met errors (bit rate, short circuit, CAN-H and CAN-L swapped)"
        yield _problem("bus", f"{what}: {why}", restart)
    elif health.state is ControllerState.PASSIVE:
        silent = not health.frames_received
        severity = Severity.PROBLEM if silent else Severity.WARNING
        why = "no device acknowledges, or the bit rate is wrong" if silent else "the bus is bad"
        yield Finding(severity, "bus", f"{what}: {why}", ("check power, wiring, termination",))
    else:
        yield _note("bus", "this back end does not report the controller's state")


# -- traffic ---------------------------------------------------------------------------------------


class TrafficCounter:
    """Tap that counts frames (see flasher.driver)."""

    def __init__(self) -> None:
        self.frames = 0
        self.error_frames = 0
        self.bits = 0
        """Bit times of the frames on the wire."""

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if frame.is_error:
            self.error_frames += 1
            return
        self.frames += 1
        self.bits += bits_of(frame)


@dataclass(frozen=True)
class ListenResult:
    """Traffic received while listening, with duration and settings."""

    traffic: TrafficCounter
    survey: Survey
    health: LinkHealth
    duration_s: float
    bitrate_bps: int
    dialect: Dialect
    is_silent: bool
    """True if the adapter acknowledged no frame (listen-only)."""
    bus_arguments: str
    """Options that select this bus."""

    @property
    def frames_per_s(self) -> float:
        """Frames per second on the wire."""
        return self.traffic.frames / self.duration_s if self.duration_s else 0.0

    @property
    def load(self) -> float:
        """Bus load, 0 to 1."""
        return self.traffic.bits / self.bitrate_bps / self.duration_s if self.duration_s else 0.0

    @property
    def foreign_frames(self) -> int:
        """Frames of other protocols; the survey counts error frames among them."""
        return self.survey.foreign_frames - self.traffic.error_frames


def traffic(heard: ListenResult) -> Iterator[Finding]:
    """Judge the quality of the traffic, and list the nodes."""
    traffic, unreadable = heard.traffic, heard.health.unreadable
    if unreadable:
        what = f"{counted(unreadable, 'time')} the adapter delivered unreadable frames, "
        yield Finding(
            Severity.WARNING if traffic.frames else Severity.PROBLEM,
            "adapter",
            f"{what}the last: {printable(heard.health.last_unreadable)}",
            (
                "try another cable, port or adapter",
                "check the speed of a serial adapter (of slcan: --bus-kwargs tty_baudrate=...)",
            ),
        )
    if not traffic.frames:
        if traffic.error_frames:
            yield _only_errors(heard)
        elif not unreadable:
            yield _silence(heard)
        return
    nodes = ", ".join(sorted(node.name for node in heard.survey.heard)) or "no node of the system"
    what = f"{heard.frames_per_s:.0f} frames/s, {heard.load:.0%} load, from {nodes}"
    if heard.foreign_frames:
        what += f"; {counted(heard.foreign_frames, 'frame')} of other protocols"
    yield Finding(Severity.OK if heard.survey.heard else Severity.WARNING, "traffic", what)
    if heard.load > _HIGH_LOAD:
        what = "the bus is nearly full: an upgrade will be slow, and answers come late"
        fix = (f"flasher monitor {heard.bus_arguments}",)
        yield _warning("traffic", what, fix)
    if traffic.error_frames:
        many = traffic.error_frames > _MANY_ERRORS * traffic.frames
        what = f"{counted(traffic.error_frames, 'error frame')} among {traffic.frames:,} frames"
        yield Finding(
            Severity.WARNING if many else Severity.NOTE,
            "traffic",
            f"{what}{_reported(heard.health)}",
            ("check wiring, termination (60 ohms between CAN-H and CAN-L) and ground",),
        )
    yield from _nodes(heard)


def _reported(health: LinkHealth) -> str:
    return f", the last: {health.last_trouble.words}" if health.last_trouble else ""


def _only_errors(heard: ListenResult) -> Finding:
    causes = f"the bus runs at another bit rate than {heard.bitrate_bps / 1000:g} kbit/s, or "
    causes += (
        "one device is alone there, without an acknowledgement while flasher only listens"
        if heard.is_silent
        else "CAN-H and CAN-L are swapped, or termination is missing"
    )
    other = "motinova" if heard.dialect.name == "welling" else "welling"
    errors = counted(heard.traffic.error_frames, "error frame")
    return _problem(
        "traffic",
        f"{errors} and nothing else{_reported(heard.health)}: {causes}",
        (f"flasher doctor --dialect {other} {heard.bus_arguments}".rstrip(),),
    )


def _silence(heard: ListenResult) -> Finding:
    return _warning(
        "traffic",
        f"the bus was silent for {heard.duration_s:g} s. In this order: the system is off or "
        "asleep (press its key); a device that is alone sends only when asked (flasher scan asks "
        "it); wiring or connector; another bit rate",
        (f"flasher scan {heard.bus_arguments}".rstrip(),),
    )


def _nodes(heard: ListenResult) -> Iterator[Finding]:
    survey = heard.survey
    if Node.CDL in survey.heard:
        yield _problem(
            "traffic",
            "another tool sends as CDL on this bus: two tools at once disturb an upgrade",
            ("wait if it upgrades a device; else close the other tool, or disconnect it",),
        )
    if survey.duplicates.evidence:
        what = f"two devices of one kind are on the bus: {survey.duplicates.evidence}"
        yield _problem("traffic", what, ("disconnect one of them",))
    for node, traffic in sorted(survey.heard.items(), key=lambda pair: pair[0].value):
        if any(isinstance(content, contents.Shutdown) for content in traffic.last.values()):
            what = f"the {node.name} sent the command SHUTDOWN: the system switches off"
            yield _warning("traffic", what, ("press the key of the system",))
        if traffic.boot_version:
            what = f"the {node.name} is in its bootloader ({traffic.boot_version})"
            fix = f"flasher flash IMAGE -t {node.name.lower()} {heard.bus_arguments}".rstrip()
            yield _note("traffic", what, (fix,))
        if traffic.damaged:
            what = f"the {node.name} sent {counted(traffic.damaged, 'run')} of bytes that made no "
            yield _note("traffic", f"{what}message")
    guessed, why = survey.guess_dialect()
    if guessed is not None and guessed is not heard.dialect:
        fix = f"flasher doctor --dialect {guessed.name} {heard.bus_arguments}".rstrip()
        what = f"the bus speaks {guessed.name}, not {heard.dialect.name}: {why}"
        yield _warning("traffic", what, (fix,))


# -- speed -----------------------------------------------------------------------------------------


def throughput(found: Throughput) -> Iterator[Finding]:
    """Judge the speed of the adapter, and name the profile keys that it needs."""
    sent = f"{counted(found.frames_sent, 'frame')} sent, all of them version queries to the BMS"
    yield _note("speed", sent)
    if found.set_aside:
        what = f"this computer paused for up to {found.worst_pause_s * 1000:.0f} ms: "
        what += f"{counted(found.set_aside, 'measurement')} set aside, not blamed on the adapter"
        fix = ("close other programs, and measure again",)
        yield _warning("speed", what, fix)
    else:
        what = f"longest pause of this computer: {found.worst_pause_s * 1000:.1f} ms"
        yield _ok("speed", what)
    if found.worst_gap_out_s is not None:
        yield from _sending(found)
    if found.echo_delay is not None:
        what = f"own frames are returned after {spread_ms(found.echo_delay)} ms"
        yield _ok("speed", f"{what} (min/median/p95/p99/max)")
    if found.round_trip is None:
        what = "no answer was measured: only sending is known"
        yield _warning("speed", what, ("switch the system on (press its key)",))
        return
    yield from _answers(found, found.round_trip)


def _sending(found: Throughput) -> Iterator[Finding]:
    rate = found.frames_out_per_s
    out = "at once" if rate is None else f"at {rate:,.0f} frames/s"
    queued = "" if rate is not None and rate <= found.line_frames_per_s else ", and queues them"
    gap_s = found.worst_gap_out_s or 0.0
    what = f"accepts frames {out} (the line: {found.line_frames_per_s:,.0f}){queued}, "
    what += f"longest gap {gap_s * 1000:.1f} ms"
    if gap_s > FRAME_GAP_SHARE * TIMES.inter_frame_timeout_s:
        limit = f"{TIMES.inter_frame_timeout_s * 1000:.0f} ms"
        yield _problem(
            "speed",
            f"{what}: a device drops a message whose frames are {limit} apart, and no setting of "
            "this computer changes that",
            ("try another cable, port or adapter",),
        )
    else:
        yield _ok("speed", what)


def _answers(found: Throughput, trip: Distribution) -> Iterator[Finding]:
    what = f"round trip {spread_ms(trip)} ms (min/median/p95/p99/max), the device's own time "
    yield _ok("speed", f"{what}included; {found.answered} of {found.queries} answered")
    if found.worst_gap_in_s is not None:
        rate = found.frames_in_per_s
        how = "at once" if rate is None else f"at {rate:,.0f} frames/s"
        what = f"delivers answers {how}, longest gap {found.worst_gap_in_s * 1000:.1f} ms"
        yield _ok("speed", what)
    needed = {}
    if (found.worst_gap_in_s or 0.0) > TIMES.inter_frame_timeout_s / 2:
        needed["inter_frame_timeout_s"] = 3 * (found.worst_gap_in_s or 0.0)
    if trip.maximum_s > TIMES.ack_timeout_s / 2:
        needed["ack_timeout_s"] = 3 * trip.maximum_s
    if trip.maximum_s > TIMES.command_repeat_s:
        needed["command_repeat_s"] = 2 * trip.maximum_s
        needed["command_timeout_s"] = max(TIMES.command_timeout_s, 6 * trip.maximum_s)
    if needed:
        keys = tuple(f"{key} = {ceil(value * 10) / 10:g}" for key, value in needed.items())
        what = "slow for the default limits; a profile needs"
        yield _warning("speed", what, ("[timings]", *keys))
    else:
        yield _ok("speed", "the default limits of a profile are enough")
    if trip.median_s > TIMES.burst_s - TIMES.boot_watch_s:
        what = (
            f"an update command may reach a bootloader {trip.median_s * 1000:.0f} ms late, after "
        )
        what += f"the {TIMES.burst_s * 1000:.0f} ms in which it announces itself"
        yield _problem("speed", what, ("try another cable, port or adapter",))
    if found.packet_s is not None:
        times = found.packet_s / found.line_packet_s
        what = f"a packet takes about {found.packet_s * 1000:.1f} ms, {times:.1f} times as long as "
        what += "on a line that never waits"
        yield (_note if times > _SLOW_TIMES else _ok)("speed", what)
