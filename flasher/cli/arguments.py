"""Arguments that commands share: the image, the target, the bus, the mock."""

from __future__ import annotations

import argparse
import contextlib
import re
from collections.abc import Sequence
from typing import Any, Final

from flasher.api import Connection, as_dialect, as_target, connect, connect_mock
from flasher.api import bit_rate as settle_bit_rate
from flasher.bus.bit_rate import BitRate
from flasher.errors import UsageError
from flasher.host.options import FRAME_GAP_SHARE, PACKET_GAP_MAX_S
from flasher.image.image import Image
from flasher.image.load import DEFAULT_FILL_GAPS_UP_TO, FORMATS, load
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import DIALECTS, TARGET_ALIASES, TARGETS, WELLING, Target
from flasher.protocol.timing import DEFAULT_TIMINGS

IMPLAUSIBLE: Final = "bytes that do not look like a program for the device"
"""What --allow-implausible lets through."""
SLOWEST: Final = 0.1
"""Of the mock's speeds."""
_NUMBER: Final = re.compile(r"(0[xX][0-9a-fA-F_]+|[0-9][0-9_]*)([kKmM]?)")
_SUFFIXES: Final = {"": 1, "k": 1024, "m": 1024 * 1024}
_BUS_KEYWORDS: Final = (
    "interface",
    "channel",
    "bitrate",
    "fd",
    "data_bitrate",
    "timing",
    "can_filters",
)


def number(text: str) -> int:
    """A whole number: decimal or 0x, with K or M for 1024 and 1024 * 1024."""
    match = _NUMBER.fullmatch(text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no number (decimal, 0x..., K or M suffix)")
    return (
        int(match[1], 0 if match[1].lower().startswith("0x") else 10) * _SUFFIXES[match[2].lower()]
    )


def address_range(text: str) -> tuple[int, int]:
    """START:END, the end exclusive."""
    start, colon, end = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"{text!r} is no range; write START:END")
    return number(start), number(end)


def seconds(text: str) -> float:
    """A time in seconds, zero or more."""
    with contextlib.suppress(ValueError):
        value = float(text)
        if 0 <= value < float("inf"):
            return value
    raise argparse.ArgumentTypeError(f"{text!r} is no time in seconds")


def speed(text: str) -> float:
    """Times as fast as a real bus: 0, or a number that is not so small that nothing moves."""
    value = seconds(text)
    if value and value < SLOWEST:
        raise argparse.ArgumentTypeError(f"must be 0, or {SLOWEST} and more")
    return value


def count(text: str) -> int:
    """A whole number from 1 on."""
    value = number(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return value


def target(text: str) -> Target:
    """A target by its name or alias."""
    try:
        return as_target(text)
    except UsageError as error:
        raise argparse.ArgumentTypeError(error.what) from error


def add_image(parser: argparse.ArgumentParser) -> None:
    """The image file and what decides which of its bytes are sent."""
    parser.add_argument("image", metavar="IMAGE", help="Intel HEX, S-record, ELF or raw binary")
    group = parser.add_argument_group("image")
    group.add_argument("--format", choices=FORMATS, help="read IMAGE as this, do not detect")
    group.add_argument(
        "--base", type=number, metavar="ADDRESS", help="address of a raw binary's first byte"
    )
    group.add_argument(
        "--range",
        dest="range_",
        type=address_range,
        metavar="START:END",
        help="send only these addresses, END exclusive",
    )
    group.add_argument(
        "--fill-gaps-up-to",
        type=number,
        default=DEFAULT_FILL_GAPS_UP_TO,
        metavar="BYTES",
        help="fill gaps between segments with FF up to this size; larger ones are refused "
        "(default %(default)s)",
    )
    group.add_argument(
        "--allow-outside-vector",
        action="store_true",
        help="send an image whose reset vector points outside of it",
    )


def add_implausible(parser: argparse._ActionsContainer) -> None:
    """--allow-implausible, for a command that has no other --allow-... for a device."""
    parser.add_argument(
        "--allow-implausible", action="store_true", help=f"let through {IMPLAUSIBLE}"
    )


def add_gaps(parser: argparse._ActionsContainer) -> None:
    """--frame-gap and --packet-gap."""
    parser.add_argument(
        "--frame-gap",
        type=seconds,
        metavar="S",
        help="seconds of silence between the frames of a message, for slow receivers; at most "
        f"{FRAME_GAP_SHARE * DEFAULT_TIMINGS.inter_frame_timeout_s:g}, or as a profile's "
        "inter_frame_timeout_s allows",
    )
    parser.add_argument(
        "--packet-gap",
        type=seconds,
        metavar="S",
        help="seconds of silence before each packet, for slow receivers; at most "
        f"{PACKET_GAP_MAX_S:g}",
    )


def load_image(options: argparse.Namespace) -> Image:
    """The image that the options describe. Raises ImageError or UsageError."""
    return load(
        options.image,
        format=options.format,
        base=options.base,
        range_=options.range_,
        fill_gaps_up_to=options.fill_gaps_up_to,
        allow_outside_vector=options.allow_outside_vector or getattr(options, "force", False),
    )


def add_target(parser: argparse.ArgumentParser, *, required: bool = True) -> None:
    """Which device."""
    names = "|".join((*TARGETS, *TARGET_ALIASES))
    parser.add_argument(
        "-t",
        "--target",
        type=target,
        required=required,
        metavar=names,
        help="the device: mc is another name for wmc, pbu for obc",
    )


def add_dialect(parser: argparse.ArgumentParser) -> None:
    """Which document."""
    parser.add_argument(
        "--dialect",
        choices=tuple(DIALECTS),
        default=WELLING.name,
        help="which protocol document holds (default %(default)s)",
    )


def add_bus(parser: argparse.ArgumentParser) -> None:
    """python-can's own bus arguments."""
    from can.cli import add_bus_arguments  # noqa: PLC0415  loads python-can

    add_bus_arguments(parser, filter_arg=True, group_title="bus (python-can)")


def bus_config(options: argparse.Namespace) -> dict[str, Any]:
    """The keywords for python-can that were given on the command line."""
    config = {name: getattr(options, name) for name in _BUS_KEYWORDS if hasattr(options, name)}
    return config | getattr(options, "bus_kwargs", {})


def bit_rate(options: argparse.Namespace) -> BitRate:
    """The bit rate of the bus that the options name, asked once: what is planned, said and
    recorded. Raises UsageError or BusError.
    """
    if not hasattr(options, "settled_bit_rate"):
        dialect = as_dialect(options.dialect)
        options.settled_bit_rate = (
            BitRate(dialect.bitrate_bps, "the dialect's")
            if options.mock
            else settle_bit_rate(dialect, **bus_config(options))
        )
    rate: BitRate = options.settled_bit_rate
    return rate


def add_mock(parser: argparse.ArgumentParser) -> None:
    """The device model in this process, in place of an adapter."""
    mock = parser.add_argument_group("without hardware")
    mock.add_argument("--mock", action="store_true", help="use a device model in this process")
    mock.add_argument(
        "--mock-speed",
        type=seconds,
        default=1.0,
        metavar="X",
        help="times as fast as a real bus; 0 takes no time (default %(default)s)",
    )


def open_connection(
    options: argparse.Namespace, target: Target, *, asks: bool = True
) -> contextlib.AbstractContextManager[Connection]:
    """The bus that the options name: an adapter, or a whole bicycle with the model of `target`.
    With `asks` False nothing will be sent.
    """
    if options.mock:
        riding = DeviceProfile(battery_use="riding")  # so that there is something to see
        return connect_mock(
            target, options.dialect, speed=options.mock_speed, system=True, profile=riding
        )
    holder = holder_of(options) if asks else None
    return connect(options.dialect, holder=holder, **bus_config(options))


def holder_of(options: argparse.Namespace) -> str:
    """What other programs are told of this command while it has the adapter."""
    return f"flasher {options.command}"


def take_values_anywhere(parser: argparse.ArgumentParser, dest: str) -> None:
    """Let the values of a command stand behind options too (`write model -t bms X`): argparse
    itself takes only those that stand together, and calls the others unrecognized.
    """
    parse_known = parser.parse_known_args

    def parse(
        words: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        options, rest = parse_known(words, namespace)
        values = [word for word in rest if not word.startswith("-")]
        setattr(options, dest, [*getattr(options, dest), *values])
        return options, [word for word in rest if word.startswith("-")]

    setattr(parser, "parse_known_args", parse)  # noqa: B010  mypy forbids the plain assignment
