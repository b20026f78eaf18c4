"""Options of a bench, and `open_bench`, which opens the device under test and its profile.

Used by the command line and the pytest plugin.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from flasher import api
from flasher.bus.fallback import Fallback
from flasher.conformance.real import (
    HOST_UNCERTAINTY_S,
    PowerControl,
    Readback,
    RealPort,
    RealSubject,
)
from flasher.conformance.subject import Subject
from flasher.errors import UsageError
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.plausible import check_plausible
from flasher.procedures import check_sample
from flasher.protocol.spec import WELLING, Target
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from flasher.conformance.profile import ConformanceProfile
    from flasher.mock.profile import DeviceProfile

_ECHO_OPTIONS: Final[Mapping[str, Mapping[str, Any]]] = {
    "socketcan": {"receive_own_messages": True},
    "udp_multicast": {},
}
"""Interfaces that echo sent frames, with the arguments that enable it: answer times start at the
echo. For other interfaces the end of a frame is calculated from its length.
"""


@dataclass(frozen=True)
class BenchOptions:
    """A bench as the user describes it, with file names, by options of the command line or of
    pytest. `bus` and `fallback` are arguments of `api.connect`; `choices` are KEY=VALUE options of
    the device model.
    """

    target: str | Target | None
    is_mock: bool = False
    subject: str | None = None
    """A bootloader compiled for this computer: a program, a shared library or MODULE:FACTORY."""
    variant: str | None = None
    choices: Sequence[str] = ()
    profile: str | None = None
    good_image: str | None = None
    second_image: str | None = None
    allow_implausible: bool = False
    bus: Mapping[str, Any] = field(default_factory=dict)
    fallback: Fallback | None = None
    power: PowerControl | None = None
    readback: Readback | None = None
    uncertainty_s: float = HOST_UNCERTAINTY_S

    @property
    def is_simulated(self) -> bool:
        """True for the device model and for a bootloader that runs on this computer."""
        return self.is_mock or self.subject is not None

    @property
    def device(self) -> Target:
        """The target. Raises UsageError."""
        return api.as_target(self.target or "")


@contextmanager
def open_bench(options: BenchOptions) -> Iterator[tuple[Subject, ConformanceProfile]]:
    """Open the device under test and its profile. Raises UsageError, ImageError and BusError."""
    check_bench(options)
    from flasher.conformance.profile import ConformanceProfile, load_profile  # noqa: PLC0415

    profile = None if options.profile is None else load_profile(options.profile)
    images = [_image(path, options) for path in (options.good_image, options.second_image)]
    good, second = (None if image is None else image.data for image in images)
    if second is not None and good is not None and len(second) >= len(good):
        raise UsageError(
            f"The second image has to be smaller than the good image ({len(good):,} bytes), but "
            f"has {len(second):,} bytes.",
            remedy="Swap the two images, or choose a smaller second one.",
        )
    if options.is_mock:
        subject, profile = _mock(options, profile, good, second)
        _check_size(subject.good_image, profile)
        yield subject, profile
        return
    if options.subject is not None:
        from flasher.conformance.dut.subject import open_subject  # noqa: PLC0415  only here

        with open_subject(
            options.subject, options.device.name, profile, good_image=good, second_image=second
        ) as (compiled, profile):
            _check_size(compiled.good_image, profile)
            yield compiled, profile
        return
    assert good is not None  # noqa: S101  check_bench
    profile = profile or ConformanceProfile()
    _check_size(good, profile)
    from flasher.bus.opening import bus_config  # noqa: PLC0415  loads python-can

    named = bus_config(options.bus, options.fallback)
    asked = _ECHO_OPTIONS.get(named["interface"])
    bus = {**(asked or {}), **options.bus}
    echoes = asked is not None and bus.get("receive_own_messages", True) is True
    with api.connect(
        WELLING, holder="flasher conformance", fallback=options.fallback, **bus
    ) as connection:
        for image in filter(None, images):
            check_sample(image, connection.link)
        connection.listen_first(WELLING)
        port = RealPort(
            connection.link,
            connection.clock,
            connection.bit_rate.bps if connection.bit_rate else WELLING.bitrate_bps,
            echoes=echoes,
            uncertainty_s=options.uncertainty_s,
        )
        yield (
            RealSubject(
                port,
                options.device.name,
                good,
                name=f"the device on {printable(connection.name)}",
                second_image=second,
                power=options.power,
                readback=options.readback,
            ),
            profile,
        )


def _image(path: str | None, options: BenchOptions) -> Image | None:
    """Load an image file for a real device."""
    if path is None:
        return None
    image = load(path)
    if not options.allow_implausible:
        check_plausible(image)
    return image


def check_bench(options: BenchOptions) -> None:
    """Raise UsageError for options that contradict each other."""
    if options.is_mock and options.subject is not None:
        raise UsageError("--mock and --subject exclude each other: choose one.")
    if options.is_simulated and not (options.power is None and options.readback is None):
        what = "The mock" if options.is_mock else "A bootloader on this computer"
        raise UsageError(f"{what} has its own power control and readback.")
    if not options.is_mock and (options.variant is not None or options.choices):
        raise UsageError("Variants and choices of the device model need --mock.")
    if options.is_simulated:
        return
    if options.good_image is None:
        raise UsageError(
            "A good image is required.",
            cause="the suite erases the device many times and has to restore it",
            remedy="Give an image that is known to run on the device (--good-image), or use the "
            "mock (--mock).",
        )


def device_profile(choices: Sequence[str]) -> DeviceProfile:
    """Build the device model's profile from KEY=VALUE choices. Raises UsageError."""
    from flasher.conformance.mock import MOCK_PROFILE  # noqa: PLC0415  only for the mock
    from flasher.settings.device_model import set_options  # noqa: PLC0415

    return set_options(MOCK_PROFILE, choices)


def _check_size(good: bytes, profile: ConformanceProfile) -> None:
    limit = profile.number("largest_image_bytes")
    if len(good) > limit:
        raise UsageError(
            f"The good image has {len(good):,} bytes, but the profile allows {limit:,}.",
            remedy="Correct device.largest_image_bytes in the profile, or give a smaller image.",
        )


def _mock(
    options: BenchOptions,
    profile: ConformanceProfile | None,
    good: bytes | None,
    second: bytes | None,
) -> tuple[Subject, ConformanceProfile]:
    from flasher.conformance import mock  # noqa: PLC0415  only for the mock

    choices, variant = device_profile(options.choices), options.variant
    subject = mock.MockSubject(
        options.device.name,
        profile=choices,
        make_device=None if variant is None else mock.variant_maker(variant),
        name="the built-in mock" + (f", variant {variant}" if variant else ""),
        good_image=good,
        second_image=second,
    )
    return subject, profile or mock.profile_of_mock(choices)
