"""`flasher adapters`: list the adapters of this computer, with the arguments that select each."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

from flasher.bus.detect import (
    BUILT_IN,
    SERIAL_PORTS,
    SLOW,
    SOCKETCAN,
    DetectedAdapter,
    DetectionResult,
)
from flasher.cli.adapters import describe_adapter, detect_adapters, interface_of, slcan_ports
from flasher.cli.framework import command, option
from flasher.cli.look.udev import udev_rules
from flasher.cli.output import Output
from flasher.cli.values import interface_names
from flasher.errors import ExitCode, UsageError, install_command
from flasher.protocol.spec import WELLING
from flasher.protocol.text import printable

_EXAMPLES: Final = """\
examples:
  flasher adapters
  flasher adapters --network            listens for socketcand servers too, 4 s
  flasher adapters --udev | sudo tee /etc/udev/rules.d/60-flasher.rules
  flasher adapters --json | jq -r '.adapters[].arguments | join(" ")'

Opens no adapter and no serial port. If it finds only one adapter, commands that only read use it
by themselves; flash and write do so after receiving the device on it.
"""


@dataclass(frozen=True)
class FoundAdapter:
    """Adapter, or a serial port that may be one."""

    interface: str
    channel: str
    """Channel or port; empty if the back end does not report it."""
    arguments: list[str]
    """Options that select it."""
    serial_number: str | None
    usb_path: str | None
    is_up: bool | None
    """State of a SocketCAN interface; null for others."""
    bitrate_bps: int | None
    """Bit rate set in the kernel; null if unknown."""
    description: str


@dataclass(frozen=True)
class NotSeen:
    """Back end that cannot list its adapters."""

    interface: str
    why: Literal["package_missing", "not_loaded", "cannot_tell", "no_answer", "failed", "not_asked"]
    """`not_loaded`: its driver is missing, or it is for another operating system."""
    text: str
    fix: str
    """Command that helps; may be empty."""


@dataclass(frozen=True)
class AdaptersDocument:
    """Adapters of this computer, and back ends that cannot list theirs."""

    adapters: list[FoundAdapter]
    serial_ports: list[FoundAdapter] | None
    """Possible slcan adapters; null if the package that lists serial ports is missing."""
    not_seen: list[NotSeen]


DOCUMENTS: Final = (AdaptersDocument,)


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.INTERRUPTED,))
@option(
    "--network", is_flag=True, brief=True,
    help="listen for socketcand servers on the network too",
)  # fmt: skip
@option(
    "--udev", is_flag=True,
    help="print the udev rules that let users open adapters, for a file in /etc/udev/rules.d",
)  # fmt: skip
def adapters(output: Output, *, network: bool, udev: bool) -> int:
    """List the adapters of this computer, each with the arguments that select it, and the back ends
    that cannot list theirs.
    """
    if udev and output.json_wanted:
        raise UsageError(
            "--udev prints a file of rules, not a JSON document.", remedy="Leave out --json."
        )
    if udev and network:
        raise UsageError(
            "--udev lists no adapters, and --network is for the list.", remedy="Leave one out."
        )
    if udev:
        for line in udev_rules(WELLING):
            output.result(line)
        return ExitCode.OK
    detected, serial = detect_adapters(on_network=network), slcan_ports()
    document = adapters_document(detected, serial, on_network=network)
    if detected.found:
        output.table(_rows(detected.found))
    else:
        output.result("no adapter found")
    if serial:
        output.result("")
        output.result("USB serial ports; one with an slcan adapter is used by")
        output.table(_rows(serial))
    output.result("")
    output.result("not seen, even when plugged in:")
    alike: dict[str, list[str]] = {}  # one line for back ends with the same reason
    for each in document.not_seen:
        reason = f"{each.text}: {each.fix}" if each.fix else each.text
        alike.setdefault(reason, []).append(each.interface)
    rows = [(", ".join(names), reason) for reason, names in alike.items()]
    rows.append(("any other", "as long as its maker's driver is not installed"))
    output.table(rows, indent=2)
    return output.document(document)


def adapters_document(
    detected: DetectionResult, serial: list[DetectedAdapter] | None, *, on_network: bool = False
) -> AdaptersDocument:
    unseen = _list_unseen(detected, on_network=on_network, lists_ports=serial is not None)
    return AdaptersDocument(
        adapters=[_document(each) for each in detected.found],
        serial_ports=None if serial is None else [_document(each) for each in serial],
        not_seen=list(unseen),
    )


def _rows(found: Iterable[DetectedAdapter]) -> list[tuple[str, str]]:
    return [(printable(each.arguments), describe_adapter(each, WELLING)) for each in found]


def _document(found: DetectedAdapter) -> FoundAdapter:
    state = interface_of(found)
    return FoundAdapter(
        interface=found.interface,
        channel=found.channel,
        arguments=found.words,
        serial_number=found.serial_number or None,
        usb_path=found.usb_path or None,
        is_up=None if state is None else state.is_up,
        bitrate_bps=None if state is None else state.bitrate_bps,
        description=describe_adapter(found, WELLING),
    )


# -- back ends that list nothing -------------------------------------------------------------------


def _list_unseen(
    detected: DetectionResult, *, on_network: bool, lists_ports: bool
) -> Iterable[NotSeen]:
    """Yield the back ends that cannot list their adapters, each with the reason."""
    from flasher.bus.opening import needed_extra  # noqa: PLC0415  loads python-can

    found = {each.interface for each in detected.found}
    for name in interface_names():
        if name in BUILT_IN or name in found or name == SOCKETCAN:
            continue
        needed = needed_extra(name)
        if name in SERIAL_PORTS:
            if not lists_ports and needed is not None:
                yield _missing(name, needed[0])
        elif needed is not None and importlib.util.find_spec(needed[1]) is None:
            yield _missing(name, needed[0])
        elif name in SLOW and not on_network:
            text = "servers on the network"
            yield NotSeen(name, "not_asked", text, "flasher adapters --network")
        elif name in detected.hung:
            yield NotSeen(name, "no_answer", "the library did not answer in time", "")
        elif name in detected.failed:
            yield NotSeen(name, "failed", printable(detected.failed[name]), "")
        elif name in detected.not_loaded:
            text = "driver missing, or for another operating system"
            yield NotSeen(name, "not_loaded", text, "")
        elif name in detected.cannot_tell:
            yield NotSeen(name, "cannot_tell", "no way to list adapters: -i and -c name one", "")


def _missing(name: str, extra: str) -> NotSeen:
    fix = install_command(f"python-can[{extra}]")
    return NotSeen(name, "package_missing", "Python package missing", fix)
