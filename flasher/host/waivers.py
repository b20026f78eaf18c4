"""The checks before an upgrade that a person may waive, each by its name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from flasher.said import say


class Waiver(NamedTuple):
    """A check that may be waived."""

    lets_through: str
    risk: str
    """What may happen when the check was right."""


IMPLAUSIBLE: Final = "implausible"
OUTSIDE_VECTOR: Final = "outside-vector"
BOOT_NAME: Final = "boot-name"
BOOT_VERSION: Final = "boot-version"
OF_DEVICE: Final[Mapping[str, Waiver]] = {
    IMPLAUSIBLE: Waiver(
        say("bytes that do not look like a program for the device"),
        say("If they are none, the device does not start any more and has to be rescued."),
    ),
    "other-target": Waiver(
        say("an image that its manifest, or a name inside, gives to another target"),
        say(
            "With the firmware of another device it may not start any more, and may damage itself "
            "or what is connected to it."
        ),
    ),
    "hardware": Waiver(
        say("a hardware version that the manifest does not list"),
        say(
            "The firmware of other hardware may drive its outputs wrongly and damage motor, "
            "charger or cells."
        ),
    ),
    "downgrade": Waiver(
        say("an image that is older than what runs"),
        say("Faults that were mended come back, and newer settings may not be understood."),
    ),
    "previous-version": Waiver(
        say("a running version that the manifest does not replace"),
        say("The maker has not foreseen this step: settings and calibration may be lost."),
    ),
    "in-use": Waiver(
        say("a vehicle whose battery gives much current"),
        say("Whoever rides it loses the drive or the display in the middle of the ride."),
    ),
    BOOT_NAME: Waiver(
        say("a bootloader that gives another name than the target's"),
        say("Another device than the one that was chosen may be erased."),
    ),
    BOOT_VERSION: Waiver(
        say("a bootloader that is older than the manifest asks for"),
        say("The bootloader may not take the image; the device has no application then."),
    ),
}
OF_IMAGE: Final[Mapping[str, Waiver]] = {
    OUTSIDE_VECTOR: Waiver(
        say("an image whose reset vector points outside of it"),
        say("The device may jump to where no program is, and does not start any more then."),
    ),
}
"""How the file is read."""
WAIVERS: Final[Mapping[str, Waiver]] = {**OF_DEVICE, **OF_IMAGE}
