"""What `flasher doctor` can find at an adapter and its interface: rules, without asking anybody."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Final

from flasher.bus.health import ControllerState, LinkHealth
from flasher.bus.inspect_interface import VIRTUAL_KINDS, Interface, Unseen
from flasher.bus.opening import start_command
from flasher.cli.look.detect import Detected
from flasher.cli.output import counted
from flasher.errors import BusError
from flasher.prose import prose
from flasher.protocol.spec import FRAMES_PER_PACKET
from flasher.protocol.text import printable

_SHOWN_AT_MOST: Final = 20
"""Adapters listed."""
_EXAMPLES: Final = (
    "flasher doctor -i socketcan -c can0",
    "flasher doctor -i pcan -c PCAN_USBBUS1",
    "flasher doctor -i slcan -c /dev/ttyACM0",
)
_LIST_INTERFACES: Final = "ip -brief link show type can"


class Severity(Enum):
    """How bad a finding is; a greater value is worse."""

    OK = 0
    NOTE = 1
    WARNING = 2
    PROBLEM = 3


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at, in a sentence, and the commands that put it right."""

    severity: Severity
    about: str
    """What was looked at: "python-can", "adapters", "interface", "adapter", "bus", "traffic"."""
    what: str
    fix: tuple[str, ...] = ()


def adapter_findings(detected: Detected) -> Iterator[Finding]:
    """The adapters that python-can sees, and the back ends that gave no answer."""
    for found in detected.found[:_SHOWN_AT_MOST]:
        details = " ".join(f"{key}={value}" for key, value in found.details.items())
        shown = printable(f"{found.interface} {found.channel} {details}".strip())
        yield Finding(Severity.OK, "adapters", f"detected {shown}")
    if not detected.found:
        yield Finding(
            Severity.NOTE,
            "adapters",
            "python-can detects no adapter; not every back end can tell (slcan and gs_usb cannot), "
            "and a SocketCAN interface is listed only while it is up",
            (_LIST_INTERFACES,) if platform.system() == "Linux" else (),
        )
    if detected.hung:
        names = ", ".join(detected.hung)
        yield Finding(Severity.NOTE, "adapters", f"no answer in time from the back ends {names}")
    for name, said in detected.failed.items():
        text = printable(said)
        yield Finding(Severity.NOTE, "adapters", f"the back end {name} fails: {text}")


def opening_finding(error: BusError) -> Finding:
    """Why the adapter cannot be opened."""
    cause = f" ({printable(error.cause)})" if error.cause else ""
    what = f"{printable(error.what).rstrip('.')}{cause}"
    return Finding(Severity.PROBLEM, "adapter", what, (printable(error.remedy),))


def unchosen_finding(detected: Detected) -> Finding:
    """No adapter was named, on the command line or elsewhere: how to choose one."""
    ways = [f"flasher doctor {printable(each.arguments)}" for each in detected.found]
    return Finding(
        Severity.PROBLEM,
        "adapter",
        "no adapter is chosen: neither -i, nor a configuration file of python-can, nor the "
        "variable CAN_INTERFACE names one",
        tuple(ways[:_SHOWN_AT_MOST]) or _EXAMPLES,
    )


def nameless_finding() -> Finding:
    """SocketCAN without a channel listens to all interfaces, and can send to none."""
    what = "no channel is named: without one, SocketCAN can send nothing"
    return Finding(Severity.PROBLEM, "interface", what, (_LIST_INTERFACES, _EXAMPLES[0]))


def interface_findings(
    seen: Interface | Unseen, channel: str, bitrate_bps: int
) -> Iterator[Finding]:
    """A SocketCAN interface against what flasher needs of it."""
    name = printable(channel)
    if seen is Unseen.CANNOT_TELL:
        yield Finding(Severity.NOTE, "interface", f"{name}: this system tells nothing about it")
    elif seen is Unseen.MISSING:
        yield Finding(Severity.PROBLEM, "interface", f"there is no interface {name}", _make(name))
    elif isinstance(seen, Interface):
        yield from _kind(seen, name, bitrate_bps)


def _make(name: str) -> tuple[str, ...]:
    if name.startswith("vcan"):
        return (f"ip link add dev {name} type vcan", f"ip link set {name} up")
    return (_LIST_INTERFACES, "dmesg | grep -i can")


def _kind(seen: Interface, name: str, bitrate_bps: int) -> Iterator[Finding]:
    if not seen.is_can:
        yield Finding(
            Severity.PROBLEM,
            "interface",
            f"{name} is no CAN interface",
            (_LIST_INTERFACES,),
        )
        return
    is_virtual = seen.kind in VIRTUAL_KINDS
    if not seen.is_up:
        start = f"ip link set {name} up" if is_virtual else start_command(name, bitrate_bps)
        yield Finding(Severity.PROBLEM, "interface", f"{name} is down", (start,))
    else:
        yield Finding(Severity.OK, "interface", f"{name} is up")
    if is_virtual:
        what = f"{name} is virtual ({seen.kind}): no wire, no bit rate, no acknowledgement"
        yield Finding(Severity.NOTE, "interface", what)
        return
    yield from _bit_rate(seen, name, bitrate_bps)
    yield from _modes(seen, name)
    yield from _queue_and_restart(seen, name)


def _again(name: str, *options: str) -> tuple[str, ...]:
    """Options of a CAN interface change only while it is down."""
    changes = f"ip link set {name} type can {' '.join(options)}"
    return (f"ip link set {name} down", changes, f"ip link set {name} up")


def _bit_rate(seen: Interface, name: str, bitrate_bps: int) -> Iterator[Finding]:
    wanted = f"{bitrate_bps / 1000:g} kbit/s"
    if seen.bitrate_bps is None:
        if seen.is_up:
            what = f"the bit rate of {name} is not told; {wanted} is needed"
            fix = (f"ip -details link show {name}",)
            yield Finding(Severity.NOTE, "interface", what, fix)
    elif seen.bitrate_bps != bitrate_bps:
        yield Finding(
            Severity.PROBLEM,
            "interface",
            f"{name} runs at {seen.bitrate_bps / 1000:g} kbit/s, {wanted} is needed",
            _again(name, f"bitrate {bitrate_bps}", "restart-ms 100"),
        )
    else:
        yield Finding(Severity.OK, "interface", f"{name} runs at {wanted}")


def _modes(seen: Interface, name: str) -> Iterator[Finding]:
    harm = {
        "LISTEN-ONLY": (Severity.PROBLEM, "nothing can be sent"),
        "LOOPBACK": (Severity.PROBLEM, "it talks to itself only"),
        "ONE-SHOT": (Severity.WARNING, "a frame that meets an error is lost"),
    }
    for mode, (severity, why) in harm.items():
        if mode in seen.modes:
            what = f"{name} is in {mode.lower()} mode: {why}"
            yield Finding(severity, "interface", what, _again(name, f"{mode.lower()} off"))
    if "FD" in seen.modes:
        what = f"{name} takes CAN FD; the protocol is classic CAN, which works there as well"
        yield Finding(Severity.NOTE, "interface", what)


def _queue_and_restart(seen: Interface, name: str) -> Iterator[Finding]:
    if seen.restart_ms == 0:
        yield Finding(
            Severity.WARNING,
            "interface",
            f"{name} stays off the bus after a bus-off (restart-ms 0)",
            _again(name, "restart-ms 100"),
        )
    if seen.queue_frames is not None and seen.queue_frames < FRAMES_PER_PACKET:
        what = f"the transmit queue of {name} holds {counted(seen.queue_frames, 'frame')}, a packet"
        what += f" has {FRAMES_PER_PACKET}: flasher waits for room, nothing is to be done"
        yield Finding(Severity.NOTE, "interface", what)


def health_findings(health: LinkHealth, channel: str, *, is_socketcan: bool) -> Iterator[Finding]:
    """The state of the controller and its error counters."""
    counters = ""
    if health.tx_errors is not None:
        counters = f", error counters: transmit {health.tx_errors}, receive {health.rx_errors}"
    restart = (f"ip link set {channel} type can restart",) if is_socketcan else ()
    what = f"the controller is {prose(health.state)}{counters}"
    if health.state is ControllerState.ACTIVE:
        yield Finding(Severity.OK, "bus", what)
    elif health.state is ControllerState.BUS_OFF:
        why = "too many frames met errors (bit rate, short circuit, CAN-H and CAN-L swapped)"
        yield Finding(Severity.PROBLEM, "bus", f"{what}: {why}", restart)
    elif health.state is ControllerState.PASSIVE:
        silent = not health.frames_received
        severity = Severity.PROBLEM if silent else Severity.WARNING
        why = "nobody acknowledges it, or the bit rate is wrong" if silent else "the bus is bad"
        yield Finding(severity, "bus", f"{what}: {why}", ("check power, wiring, termination",))
    else:
        yield Finding(Severity.NOTE, "bus", "this back end does not tell the controller's state")
