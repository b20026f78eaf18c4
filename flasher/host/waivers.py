"""Waivable checks of an upgrade, with the risk of waiving each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from flasher.i18n import text


class Waiver(NamedTuple):
    """Texts of a waivable check: the upgrade that a waiver permits, and its risk."""

    permits: str
    risk: str
    """Possible consequence if the check was right."""


IMPLAUSIBLE: Final = "implausible"
OUTSIDE_VECTOR: Final = "outside-vector"
BOOT_NAME: Final = "boot-name"
BOOT_VERSION: Final = "boot-version"
UNSIGNED: Final = "unsigned"
OF_DEVICE: Final[Mapping[str, Waiver]] = {
    IMPLAUSIBLE: Waiver(
        text("bytes that do not look like a program for the device"),
        text("If they are not, the device no longer starts and has to be rescued."),
    ),
    "other-target": Waiver(
        text("an image that its manifest, or a name inside, gives to another target"),
        text(
            "With the firmware of another device it may not start any more, and may damage itself "
            "or what is connected to it."
        ),
    ),
    "hardware": Waiver(
        text("a hardware version that the manifest does not list"),
        text(
            "The firmware of other hardware may drive its outputs wrongly and damage motor, "
            "charger or cells."
        ),
    ),
    "downgrade": Waiver(
        text("an image that is older than what runs"),
        text("Faults that were fixed come back, and newer settings may not be understood."),
    ),
    "previous-version": Waiver(
        text("a running version that the manifest does not replace"),
        text("The maker has not foreseen this step: settings and calibration may be lost."),
    ),
    "in-use": Waiver(
        text("a vehicle whose battery gives much current"),
        text("Whoever rides it loses the drive or the display in the middle of the ride."),
    ),
    "low-charge": Waiver(
        text("a battery that is nearly empty and not being charged"),
        text("It may switch itself off during the upgrade, and does not start any more then."),
    ),
    BOOT_NAME: Waiver(
        text("a bootloader that gives another name than the target's"),
        text("Another device than the one that was chosen may be erased."),
    ),
    BOOT_VERSION: Waiver(
        text("a bootloader that is older than the manifest asks for"),
        text("The bootloader may not take the image; the device has no application then."),
    ),
}
OF_IMAGE: Final[Mapping[str, Waiver]] = {
    UNSIGNED: Waiver(
        text("an image that the trust file of this computer does not allow"),
        text(
            "No trusted key has signed it: it may be forged, or an old release with known faults."
        ),
    ),
    OUTSIDE_VECTOR: Waiver(
        text("an image whose reset vector points outside of it"),
        text("The device may jump to where no program is, and does not start any more then."),
    ),
}
"""Checks of the file that is read."""
WAIVERS: Final[Mapping[str, Waiver]] = {**OF_DEVICE, **OF_IMAGE}
