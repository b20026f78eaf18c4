"""Options shared by several commands: image, target, bus and mock."""

from __future__ import annotations

import contextlib
import hashlib
import io
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Final

import click

from flasher import api
from flasher.bus.bit_rate import BitRate
from flasher.bus.detect import DetectedAdapter
from flasher.bus.fallback import Fallback
from flasher.cli import values
from flasher.cli.framework import Decorator, argument, option, option_set
from flasher.errors import ErrorCode, ImageError, UsageError
from flasher.files import opened
from flasher.host.options import FRAME_GAP_SHARE, PACKET_GAP_MAX_S
from flasher.host.waivers import IMPLAUSIBLE, OUTSIDE_VECTOR, WAIVERS
from flasher.image.image import Image
from flasher.image.load import DEFAULT_FILL_GAPS_UP_TO, FILE_MAX_SIZE, FORMATS, load
from flasher.image.release import Release
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import DIALECTS, TARGET_ALIASES, TARGETS, WELLING, Dialect, Target
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.settings.manifest import find_release
from flasher.settings.profile import FILE_NAME, find_bus

# -- the device ------------------------------------------------------------------------------------


def target_option(*, required: bool = True) -> Decorator:
    """Declare the option -t/--target."""
    return option(
        "-t", "--target", type=values.target, required=required, brief=True, panel="device",
        metavar="|".join((*TARGETS, *TARGET_ALIASES)),
        shell_complete=values.offers(values.target_names),
        help="the device: mc is another name for wmc, pbu for obc",
    )  # fmt: skip


dialect_option: Final = option(
    "--dialect", "dialect_name", type=click.Choice(tuple(DIALECTS)), default=WELLING.name,
    panel="device", help="the protocol document in use",
)  # fmt: skip
profile_option: Final = option(
    "--profile", metavar="FILE", type=values.FilePath("toml"), panel="device",
    help=f"target profile (default: {FILE_NAME} here or in the user's configuration)",
)  # fmt: skip


# -- the image -------------------------------------------------------------------------------------

STANDARD_INPUT: Final = "-"


@dataclass(frozen=True)
class Selection:
    """Selection of the bytes of an image file."""

    format: Annotated[str | None, option(
        "--format", type=click.Choice(FORMATS), panel="image",
        help="format of IMAGE, instead of detecting it",
    )]  # fmt: skip
    base: Annotated[int | None, option(
        "--base", type=values.address, metavar="ADDRESS", panel="image", brief=True,
        help="address of a raw binary's first byte",
    )]  # fmt: skip
    range_: Annotated[tuple[int, int] | None, option(
        "--range", "range_", type=values.address_range, metavar="START:END", panel="image",
        help="use only these addresses, END exclusive",
    )]  # fmt: skip


@dataclass(frozen=True)
class SentSelection(Selection):
    """Selection of the bytes to send."""

    fill_gaps_up_to: Annotated[int, option(
        "--fill-gaps-up-to", type=values.number, default=str(DEFAULT_FILL_GAPS_UP_TO),
        metavar="BYTES", panel="image",
        help="fill gaps between segments with FF up to this size; larger ones are refused",
    )]  # fmt: skip
    allow_outside_vector: Annotated[bool, option(
        "--allow-outside-vector", is_flag=True, panel="image",
        help=f"send {WAIVERS[OUTSIDE_VECTOR].permits}",
    )]  # fmt: skip


def image_argument(name: str = "image", *, also: str = "", **more: Any) -> Decorator:
    """Declare the argument IMAGE; `also` adds to its help."""
    return argument(
        name, **{"metavar": "IMAGE", **more}, type=values.FilePath(*values.IMAGE_SUFFIXES),
        help=f"Intel HEX, S-record, ELF or raw binary; - is standard input{also}",
    )  # fmt: skip


@dataclass(frozen=True)
class ImageOptions(SentSelection):
    """Image file, and the selection of its bytes."""

    image: Annotated[str, image_argument()]

    @property
    def is_piped(self) -> bool:
        """True for standard input, which can be read once and has no manifest beside it."""
        return self.image == STANDARD_INPUT

    def find_release(self, given: str | None = None) -> Release | None:
        """Read the manifest `given`, else the one beside the image."""
        return None if given is None and self.is_piped else find_release(self.image, given)

    @cached_property
    def _piped(self) -> io.BytesIO:
        return standard_input()

    def file_sha256(self) -> str:
        """Compute the SHA-256 of the file itself, in hexadecimal. Raises ImageError."""
        if self.is_piped:
            return hashlib.sha256(self._piped.getbuffer()).hexdigest()
        with opened(self.image, None, error=ImageError) as (file, _):
            return hashlib.file_digest(file, "sha256").hexdigest()

    def load(self, *, force: bool = False) -> Image:
        """Load the image. Raises ImageError and UsageError."""
        return load(self.source, **self.options(force=force))

    @property
    def source(self) -> str:
        """Name of the image in messages."""
        return "standard input" if self.is_piped else self.image

    def options(self, *, force: bool = False) -> dict[str, Any]:
        """Keywords for `load` that differ from its defaults."""
        names = ("format", "base", "range_")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        if self.fill_gaps_up_to != DEFAULT_FILL_GAPS_UP_TO:
            given["fill_gaps_up_to"] = self.fill_gaps_up_to
        if self.is_piped:
            given["stream"] = self._piped
        return {**given, "allow_outside_vector": self.allow_outside_vector or force}


image_options: Final = option_set("image", ImageOptions)


def standard_input() -> io.BytesIO:
    """Read standard input to its end. Raises UsageError for a terminal and for too many bytes."""
    if sys.stdin.isatty():
        raise UsageError(
            "The image - is standard input, which is this terminal.",
            remedy="Pipe a program's output or a file into the command, or name a file.",
        )
    data = sys.stdin.buffer.read(FILE_MAX_SIZE + 1)
    if len(data) > FILE_MAX_SIZE:
        raise ImageError(
            f"Standard input has more than {FILE_MAX_SIZE:,} bytes.",
            cause="another program or file was meant",
            code=ErrorCode.IMAGE_TOO_LARGE,
        )
    return io.BytesIO(data)


def allow_implausible_option(panel: str | None = None) -> Decorator:
    """Declare --allow-implausible, for a command without other --allow-... options."""
    return option(
        "--allow-implausible",
        is_flag=True,
        panel=panel,
        help=f"let through {WAIVERS[IMPLAUSIBLE].permits}",
    )


def gap_options(function: Callable[..., int]) -> Callable[..., int]:
    frame_gap_max_s = FRAME_GAP_SHARE * DEFAULT_TIMINGS.inter_frame_timeout_s
    function = option(
        "--packet-gap", "packet_gap_s", type=values.seconds, metavar="S", panel="upgrade",
        help="seconds of silence before each packet, for slow receivers; at most "
        f"{PACKET_GAP_MAX_S:g}",
    )(function)  # fmt: skip
    decorated: Callable[..., int] = option(
        "--frame-gap", "frame_gap_s", type=values.seconds, metavar="S", panel="upgrade",
        help="seconds of silence between the frames of a message, for slow receivers; at most "
        f"{frame_gap_max_s:g}, or as a profile's inter_frame_timeout_s allows",
    )(function)  # fmt: skip
    return decorated


# -- the bus ---------------------------------------------------------------------------------------

_KEYWORDS: Final = ("interface", "channel", "bitrate", "fd", "data_bitrate")
"""Options with the names of python-can's keywords."""
_FILTER: Final = re.compile(r"([0-9A-Fa-f]+)([:~])([0-9A-Fa-f]+)")
_INVERTED: Final = 0x20000000
"""python-can's flag for a filter that accepts all other ids."""
_RIDING: Final = DeviceProfile(battery_use="riding")
"""A model with visible traffic."""


def _timing(pairs: tuple[tuple[str, str], ...]) -> Any:
    """Create python-can's bit timing. Raises click.BadParameter."""
    from flasher.python_can import can  # noqa: PLC0415  slow

    try:
        given: dict[str, Any] = {key: int(value) for key, value in pairs}
        return (can.BitTimingFd if "nom_brp" in given else can.BitTiming)(**given)
    except (TypeError, ValueError) as error:
        raise click.BadParameter(f"{error}", param_hint="--timing") from error


def can_filter(text: str) -> dict[str, int]:
    """Parse a filter of python-can: ID:MASK, or ID~MASK for all other ids, in hexadecimal."""
    match = _FILTER.fullmatch(text)
    if match is None:
        raise click.BadParameter(f"{text!a} is not ID:MASK in hexadecimal")
    inverted = _INVERTED if match[2] == "~" else 0
    return {"can_id": int(match[1], 16) | inverted, "can_mask": int(match[3], 16)}


@dataclass(frozen=True)
class Bus:
    """Bus of a command: an adapter, or a device model in this process."""

    dialect_name: str = WELLING.name
    mock: bool = False
    mock_speed: float = 1.0
    interface: Annotated[str | None, option(
        "-i", "--interface", type=values.interface, metavar="BACKEND", panel="bus", brief=True,
        shell_complete=values.offers(values.interface_names),
        help="python-can's back end for the adapter: socketcan, pcan, kvaser, vector, slcan, ...",
    )] = None  # fmt: skip
    channel: Annotated[str | None, option(
        "-c", "--channel", metavar="CHANNEL", panel="bus", brief=True,
        shell_complete=values.offers(values.channels),
        help="which adapter or port: can0, PCAN_USBBUS1, 0, COM3, ...",
    )] = None  # fmt: skip
    bitrate: Annotated[int | None, option(
        "-b", "--bitrate", type=int, metavar="BPS", panel="bus",
        help="bits per second (default: the dialect's)",
    )] = None  # fmt: skip
    fd: Annotated[bool | None, option(
        "--fd", is_flag=True,
        default=None, panel="bus",
        help="open the adapter for CAN FD; the protocol itself uses classical frames",
    )] = None  # fmt: skip
    data_bitrate: Annotated[int | None, option(
        "--data-bitrate", type=int, metavar="BPS", panel="bus",
        help="bits per second of the data phase of CAN FD",
    )] = None  # fmt: skip
    timing: Annotated[tuple[tuple[str, str], ...], option(
        "--timing", type=values.key_value, multiple=True, metavar="KEY=VALUE", panel="bus",
        help="bit timing: f_clock, brp, tseg1, tseg2, sjw, ..., each by an option of its own",
    )] = ()  # fmt: skip
    can_filters: Annotated[tuple[dict[str, int], ...], option(
        "--filter", "can_filters", type=can_filter, multiple=True, metavar="ID:MASK", panel="bus",
        help="a filter of the adapter, in hexadecimal; ID~MASK for all others; may be repeated. At "
        "least the device's answers must pass: 725:7FF and 720:7FF for the BMS",
    )] = ()  # fmt: skip
    bus_kwargs: Annotated[tuple[tuple[str, str], ...], option(
        "--bus-kwargs", type=values.key_value, multiple=True, metavar="KEY=VALUE", panel="bus",
        help="one more argument for the back end, such as app_name=CANalyzer; may be repeated",
    )] = ()  # fmt: skip
    settings: str | None = None
    """File that may name the adapter, from --profile."""
    found: DetectedAdapter | None = None
    """The only detected adapter, if none is named (`flasher.cli.adapters`)."""

    def __post_init__(self) -> None:
        named = (self.interface, self.channel, self.bitrate, self.timing, self.bus_kwargs)
        if self.mock and any(named):
            raise UsageError(
                "--mock takes no adapter, and an option names or sets one.",
                remedy="Leave out --mock to use the adapter, or the options of the adapter (-i, "
                "-c, -b, --timing, --bus-kwargs) to use the device model.",
            )

    @property
    def dialect(self) -> Dialect:
        """Protocol dialect in use."""
        return api.as_dialect(self.dialect_name)

    @cached_property
    def config(self) -> dict[str, Any]:
        """python-can's keywords from the command line."""
        given = {name: getattr(self, name) for name in _KEYWORDS if getattr(self, name) is not None}
        if self.timing:
            given["timing"] = _timing(self.timing)
        if self.can_filters:
            given["can_filters"] = list(self.can_filters)
        if self.bus_kwargs:
            from flasher.python_can import can  # noqa: PLC0415  slow

            given |= {key: can.util.cast_from_string(value) for key, value in self.bus_kwargs}
        return given

    @cached_property
    def fallback(self) -> Fallback | None:
        """Adapter of the settings file. Raises UsageError for an invalid file."""
        return None if self.mock else find_bus(self.settings)

    @cached_property
    def is_named(self) -> bool:
        """True if an option, a variable or a file names an adapter. Raises UsageError."""
        from flasher.bus.opening import names_adapter  # noqa: PLC0415  loads python-can

        return names_adapter(self.config, self.fallback)

    def with_profile(self, file: str | None) -> Bus:
        """Return the same bus, but a table [bus] of the --profile file takes precedence."""
        return replace(self, settings=file)

    @cached_property
    def bit_rate(self) -> BitRate:
        """Bit rate, read once so that all output agrees. Raises UsageError and BusError."""
        if self.mock:
            return BitRate(self.dialect.bitrate_bps, "the dialect's")
        return api.bit_rate(self.dialect, fallback=self.fallback, **self.config)

    def connect(
        self,
        target: Target,
        *,
        asks: bool = True,
        profile: DeviceProfile | None = _RIDING,
        system: bool = True,
        has_application: bool = True,
    ) -> contextlib.AbstractContextManager[api.Connection]:
        """Open the adapter or, with --mock, the model of `target`: of this profile, in a whole
        bicycle, with an application. With `asks` False nothing may be sent.
        """
        if self.mock:
            return api.connect_mock(
                target,
                self.dialect,
                speed=self.mock_speed,
                system=system,
                has_application=has_application,
                profile=profile,
            )
        return api.connect(
            self.dialect,
            holder=_holder() if asks else None,
            sends=asks,
            fallback=self.fallback,
            **self.config,
        )


def _holder() -> str:
    """Name of this command for other programs, while it locks the adapter."""
    return " ".join(click.get_current_context().command_path.split()[:2])


def mock_options(what: str) -> tuple[Decorator, ...]:
    """Declare --mock and its speed; `what` describes its use."""
    return (
        option("--mock", is_flag=True, panel="without hardware", brief=True, help=what),
        option(
            "--mock-speed", type=values.speed, default=1.0, metavar="X", panel="without hardware",
            help="speed relative to a real bus; 0: no delays",
        ),
    )  # fmt: skip


adapter_options: Final = option_set("bus", Bus)
"""Bus of a command that has neither a dialect nor a mock."""


def bus_options(
    *,
    mock: str | None = "use a device model in this process",
) -> Decorator:
    """Declare the options of the bus: dialect, adapter, and the mock unless that is None."""
    in_its_place = () if mock is None else mock_options(mock)
    return option_set("bus", Bus, dialect_option, *in_its_place)
