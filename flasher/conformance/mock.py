"""Subject for the device model, on a simulated bus with a virtual clock.

Only this module and `real` depend on the rest of flasher; code that makes or judges bytes does not
import them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final, get_args, get_type_hints

from flasher.conformance.firmware import GOOD, SECOND
from flasher.conformance.profile import ConformanceProfile, Value
from flasher.conformance.simulated import SimulatedSubject
from flasher.mock.faults import FaultInjector, InOperation, PowerCut
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.store import with_checksum
from flasher.mock.variants import find, make
from flasher.protocol.bittime import message_bits
from flasher.protocol.engine import Engine
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import TARGETS, WELLING
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import encode, split

AREA_BYTES: Final = 256 * 1024
"""Size of the mock's application area: enough for every case, and quick to fill."""
MOCK_PROFILE: Final = DeviceProfile(application_area_bytes=AREA_BYTES)
_SPACING_TOLERANCE_S: Final = 0.005
"""An announcement of the model waits for at most a few frames of others."""
_SOON_S: Final = 0.05
"""Longest time from complete to an immediately following end of transfer."""
_WINDOW_TOLERANCE_S: Final = 0.0005
"""The model's clock is exact; only the announcement's time on the wire is rounded."""


def model_image(version: str, size_bytes: int, content: bytes = b"") -> bytes:
    """Make an image of `content` (default: filler) for the device model, with `version` in its head
    and its own checksum.
    """
    head = f"conformance {version}".encode("ascii") + b"\0"
    return with_checksum(head, size_bytes, content)


GOOD_IMAGE: Final = model_image(*GOOD)
SECOND_IMAGE: Final = model_image(*SECOND)


class MockSubject(SimulatedSubject[MockDevice]):
    """A device model or a variant of it, with power, readback and bus faults.

    `make_device` gets the target's name and the profile (`variant_maker` for a variant). `others`
    are further engines on the same bus.
    """

    has_own_clock = False

    def __init__(
        self,
        target: str = "bms",
        *,
        profile: DeviceProfile = MOCK_PROFILE,
        make_device: Callable[[str, DeviceProfile], MockDevice] | None = None,
        others: Sequence[Engine] = (),
        name: str = "the built-in mock",
        good_image: bytes | None = None,
        second_image: bytes | None = None,
    ) -> None:
        super().__init__(
            (make_device or device_maker(MockDevice))(target, profile),
            target,
            model_image,
            sector_bytes=profile.page_size_bytes,
            area_bytes=profile.image_limit_bytes,
            name=name,
            good_image=good_image,
            second_image=second_image,
        )
        self._injector = FaultInjector(self.device)
        for engine in (self._injector, *others):
            self.bus.attach(engine)

    def cut_in_operation(self, operation: int, share: float, off_s: float) -> None:
        self._injector.set(PowerCut(off_s), InOperation(operation, share))

    @property
    def is_cut_pending(self) -> bool:
        return self._injector.is_set

    def take_cut(self) -> bool:
        happened = not self.is_cut_pending
        self._injector.clear()
        return happened


def device_maker(kind: Callable[..., MockDevice]) -> Callable[[str, DeviceProfile], MockDevice]:
    """Return a function that makes a device of this class for a subject."""
    return lambda target, profile: kind(
        TARGETS[target], bitrate_bps=WELLING.bitrate_bps, profile=profile
    )


def variant_maker(name: str) -> Callable[[str, DeviceProfile], MockDevice]:
    """Return a function that makes a deliberately wrong device. Raises UsageError for an unknown
    name.
    """
    return device_maker(partial(make, find(name)))


# -- the model's choices as the suite's -----------------------------------------------------------

_MODEL_OPTIONS: Final[dict[str, tuple[str, dict[str, str]]]] = {
    "rs_02": ("reset_in_bootloader", {}),
    "rs_03": ("without_application", {}),
    "up_03": ("upgrade_in_application", {"general_feedback": "feedback"}),
    "up_08": ("update_in_transfer", {"ignored": "rejected"}),
    "tx_01": ("bad_packet", {}),
    "tx_02": ("repeated_packet", {}),
    "tx_03": ("older_packet", {}),
    "tx_12": ("pause_in_transfer", {}),
    "tx_13": ("reset_in_transfer", {}),
    "en_02": ("repeated_end", {}),
    "en_03": ("after_complete", {}),
    "en_04": ("image_checksum", {}),
}
"""Suite key to the model's option, and the values whose names differ."""
_FIXED_CHOICES: Final = {
    "fr_01": "accepted",
    "fr_02": "found",
    "fr_04": "rescanned",
    "fr_07": "ignored",
    "fr_10": "silence",
    "rs_03_old": "erased",
    "up_02": "silence",
    "up_04": "rejected",
    "up_04_burst": "accepted",
    "tx_08": "ignored",
}
"""Choices of the model that no option changes."""


def profile_of_mock(device: DeviceProfile = MOCK_PROFILE) -> ConformanceProfile:
    """Make the conformance profile of a device model with these options."""
    given: dict[str, Value] = dict(_FIXED_CHOICES)
    for key, (option, renamed) in _MODEL_OPTIONS.items():
        value = str(getattr(device, option))
        given[key] = renamed.get(value, value)
    # Its application may run by then, or it may have restarted after a refused image.
    if min(device.start_delay_s, device.refused_hold_s) < _SOON_S:
        given["en_02"] = "either"
    # The model's window starts when it queues an announcement, the suite's when it has arrived.
    target = TARGETS["bms"]
    announcement = BootVersion(target.boot_name, device.boot_version).to_message(target.answer_id)
    frames = split(announcement.can_id, encode(announcement))
    given["limits.window_s"] = device.window_s - message_bits(frames) / WELLING.bitrate_bps
    given["limits.window_tolerance_s"] = _WINDOW_TOLERANCE_S
    given["limits.version_spacing_s"] = DEFAULT_TIMINGS.boot_version_spacing_s
    given["limits.version_spacing_tolerance_s"] = _SPACING_TOLERANCE_S
    given["limits.pause_s"] = device.transfer_timeout_s
    given["limits.refused_s"] = device.refused_hold_s + 1.0
    given["device.application_bytes"] = device.application_area_bytes
    given["device.largest_image_bytes"] = device.image_limit_bytes
    return ConformanceProfile(given, source="the mock's own choices")


def model_of_profile(profile: ConformanceProfile) -> DeviceProfile:
    """Make the options of a device model that follows a conformance profile as far as it can."""
    choices: dict[str, Any] = {}
    kinds = get_type_hints(DeviceProfile)
    for key, (option, renamed) in _MODEL_OPTIONS.items():
        names = {given: name for name, given in renamed.items()}
        value = names.get(profile.choice(key), profile.choice(key))
        if value in get_args(kinds[option]):
            choices[option] = value
    return replace(MOCK_PROFILE, transfer_timeout_s=profile.limit("pause_s"), **choices)
