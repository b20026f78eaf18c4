"""`flasher mock`: the device model on any python-can bus, until interrupted."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from pathlib import Path
from typing import Any

from flasher import api, events
from flasher.cli import arguments
from flasher.cli.output import Output, byte_count
from flasher.cli.stop import stop_on_signal
from flasher.device.model import Device
from flasher.device.profile import DeviceProfile, describe_options, set_option
from flasher.driver import drive
from flasher.errors import ExitCode, UsageError
from flasher.protocol.text import printable

_EXAMPLES = """\
examples:
  flasher mock -t bms -i socketcan -c vcan0
  flasher mock -t mc -i udp_multicast -c 239.74.163.2 --bus-kwargs hop_limit=0 port=43210
  flasher mock -t bms -i socketcan -c vcan0 --no-app --save-image received.bin
  flasher mock -t bms -i socketcan -c vcan0 --set repeated_packet=nak_next

Ends with exit code 0 when interrupted.

choices for --set, the first value is the default:
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = "Serve as a device: its application and its bootloader."
    rows = [f"  {key:<24} {values}\n      {summary}" for key, values, summary in describe_options()]
    parser.epilog = _EXAMPLES + "\n".join(rows)
    arguments.add_target(parser)
    arguments.add_dialect(parser)
    group = parser.add_argument_group("device model")
    group.add_argument(
        "--save-image", metavar="FILE", help="write each image that was received completely"
    )
    group.add_argument(
        "--no-app", action="store_true", help="start without a valid application (R14)"
    )
    group.add_argument(
        "--set",
        dest="choices",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="set a choice of the device; may be repeated, see below",
    )
    group.add_argument(
        "--upgrades", type=arguments.count, metavar="N", help="end after N complete upgrades"
    )
    arguments.add_bus(parser)


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    dialect = api.as_dialect(options.dialect)
    _check_folder(options.save_image)
    device = Device(
        options.target,
        bitrate_bps=dialect.bitrate_bps,
        profile=_profile(options.choices),
        has_application=not options.no_app,
    )
    watcher = _Watcher(device, options.save_image, output)
    with (
        api.connect(dialect, **arguments.bus_config(options)) as connection,
        stop_on_signal() as stopped,
    ):
        if not dialect.has_upgrade:
            output.progress(
                f"note: the {dialect.name.upper()} document has no upgrade; behind its RESET "
                "stands Welling's bootloader here"
            )
        output.progress(f"{options.target.node.name} on {connection.name}; Ctrl-C ends it")
        drive(
            device,
            connection.link,
            connection.clock,
            on_event=watcher,
            cancelled=lambda: stopped() or watcher.images == options.upgrades,
        )
    output.document({"ok": True, "exit_code": int(ExitCode.OK), "images": watcher.images})
    return ExitCode.OK


def _profile(choices: list[str]) -> DeviceProfile:
    profile = DeviceProfile()
    for choice in choices:
        key, equals, value = choice.partition("=")
        if not equals:
            raise UsageError(f"--set {choice}: write KEY=VALUE.")
        profile = set_option(profile, key, value)
    return profile


class _Watcher:
    """Prints what the device model sees, and saves what it received."""

    def __init__(self, device: Device, save_to: str | None, output: Output) -> None:
        self._device = device
        self._save_to = save_to
        self._output = output
        self.images = 0

    def __call__(self, event: object) -> None:
        match event:
            case events.DeviceStateEntered(state, detail):
                self._say("state", f"{state}{f': {detail}' if detail else ''}", event)
            case events.PacketStored(number, total) if number == total:
                self._say("packets", f"all {total:,} stored", event)
            case events.PacketStored(number, total) if number == 1:
                self._say("packets", f"first of {total:,} stored", event)
            case events.ImageStored(size_bytes, sha256):
                self._save()
                self.images += 1
                self._say("image", f"{byte_count(size_bytes)}, sha256 {sha256}", event)
            case events.DeviceReported(what):
                self._say("note", what, event)
            case events.BytesDamaged(can_id, reason, data):
                self._say("damage", f"0x{can_id:03X}: {reason}: {data[:16].hex(' ')} ...", event)

    def _say(self, kind: str, text: str, event: Any) -> None:
        self._output.result(f"{kind + ':':<9}{text}")
        fields = {
            name: value.hex() if isinstance(value, bytes) else value
            for name, value in dataclasses.asdict(event).items()
        }
        self._output.document({"event": type(event).__name__, **fields, "text": text})

    def _save(self) -> None:
        image = self._device.stored_image
        if self._save_to and image is not None:
            _write_file(Path(self._save_to), image)
            self._output.result(f"saved:   {printable(self._save_to)}")


def _check_folder(save_to: str | None) -> None:
    """Raises UsageError where no file can come to be: better now than after an upgrade."""
    if save_to is None:
        return
    path = Path(save_to)
    if path.is_dir():
        raise _not_written(path, "it is a folder")
    if not path.parent.is_dir():
        raise _not_written(path, "its folder does not exist")


def _write_file(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, where a link leads to. Raises UsageError when it cannot be
    written. What is no regular file (a pipe, a device) is written into, not replaced.
    """
    path = path.resolve()
    part = path.with_name(f".{path.name}.part")
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(data)
        else:
            part.write_bytes(data)
            part.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise _not_written(path, error.strerror or type(error).__name__) from error


def _not_written(path: Path, reason: str) -> UsageError:
    return UsageError(
        f"{printable(str(path))} cannot be written: {reason}.",
        where="--save-image",
        remedy="Name a file in a folder that exists and has room.",
    )
