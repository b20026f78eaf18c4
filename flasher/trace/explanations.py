"""For each cause, why it happens most likely and what to do about it."""

from __future__ import annotations

from typing import Final, NamedTuple

from flasher.trace.story import Cause


class Explanation(NamedTuple):
    """Likely cause and remedy, with {node} and {boot_name} to be filled in."""

    likely: str
    remedy: str


NOTHING: Final = Explanation("", "")
_AGAIN: Final = "Then run the upgrade again."
_RESCUE: Final = "The device stays in its bootloader until an image is flashed completely."

EXPLANATIONS: Final[dict[Cause, Explanation]] = {
    Cause.NOBODY_ACKNOWLEDGES: Explanation(
        "no device is connected or powered, the bit rate is another one, CAN-H and CAN-L are "
        "swapped, or the termination is missing",
        f"Check supply, wiring, the 120 ohm termination at both ends, and the bit rate. {_AGAIN}",
    ),
    Cause.NO_BOOT_VERSION: Explanation(
        "the device has no power, sleeps, is not on this bus, or its bootloader announces itself "
        "only at power-up",
        "Check supply and wiring. A device that announces itself at power-up only is reached by "
        "flasher rescue and a power cycle.",
    ),
    Cause.NO_REQUEST: Explanation(
        "erasing takes longer than the tool waited, the device refuses this size or target, or it "
        "hangs",
        f"Power-cycle the device. {_AGAIN} If it happens again, allow more time for erasing.",
    ),
    Cause.UPDATE_NOT_TAKEN: Explanation(
        "the update command names another target or too large an image, or it comes when the "
        "bootloader does not listen",
        "Check that the device is a {node} and that the image fits it.",
    ),
    Cause.WRONG_DEVICE: Explanation(
        "the connected device is no {node}, whose bootloader calls itself {boot_name}",
        "Check what is connected and which target was named.",
    ),
    Cause.TWO_DEVICES: Explanation(
        "two devices of the same kind are on the bus",
        f"Disconnect one of them. {_AGAIN}",
    ),
    Cause.PACKET_REFUSED: Explanation(
        "the device cannot store this packet (flash that is worn, locked or not erased), or it "
        "receives it damaged each time",
        f"Check supply and wiring. {_AGAIN} If it stops there again, the device is defective.",
    ),
    Cause.PACKET_UNANSWERED: Explanation(
        "the device lost power or contact, hangs, or its answers do not get through",
        f"Check supply and wiring, power-cycle the device. {_AGAIN} {_RESCUE}",
    ),
    Cause.PACKET_DAMAGED: Explanation(
        "the line is disturbed, an adapter loses frames, or two senders share one id",
        "Check wiring, termination and ground; try another adapter or a shorter cable. "
        f"{_AGAIN} {_RESCUE}",
    ),
    Cause.DEVICE_RESTARTED: Explanation(
        "its supply drops, its watchdog bites, it does not accept what it is sent, or two devices "
        "of the same kind answer",
        f"Check the supply, and that there is one {{node}} only. {_AGAIN} {_RESCUE}",
    ),
    Cause.SECOND_TOOL: Explanation(
        "a second dongle, a diagnostic program or another copy of this tool is on the bus",
        f"Disconnect or stop the other tool. {_AGAIN}",
    ),
    Cause.SHUTDOWN: Explanation(
        "the key was held, or the battery found the vehicle idle and switched everything off",
        f"Switch the battery on and keep it awake. {_AGAIN} {_RESCUE}",
    ),
    Cause.BUS_TROUBLE: Explanation(
        "a loose contact, a missing termination, or a node with another bit rate",
        f"Check wiring and termination; disconnect other nodes one by one. {_AGAIN}",
    ),
    Cause.TOOL_STOPPED: Explanation(
        "the tool was interrupted, its computer or adapter failed, or it was unplugged",
        f"Look at what the tool reported. {_AGAIN} {_RESCUE}",
    ),
    Cause.TOOL_ENDED: Explanation(
        "the tool itself ended the upgrade, for the reason that it reported",
        "Do what the tool said then: it names the state of the device too.",
    ),
    Cause.REFUSED: Explanation(
        "the image is not meant for this device, or the checksum that it carries is wrong",
        f"Look at the image (flasher image-info) and flash one that fits. {_RESCUE}",
    ),
    Cause.UNCONFIRMED: Explanation(
        "the answer was lost, or the device restarted without sending it",
        "Unconfirmed is not done: see whether the new application runs (flasher info), or flash "
        "it again.",
    ),
    Cause.COMPLETE_TOO_EARLY: Explanation(
        "the bootloader counts other packets than the tool, or does not follow the protocol",
        "Report the boot version to its maker, and see what the device runs (flasher info).",
    ),
    Cause.OTHER_VERSION: Explanation(
        "the device fell back to an older image, or the image names its version wrongly",
        "Compare with flasher image-info, then flash the right image.",
    ),
    Cause.RECORDING_ENDS: Explanation(
        "the recording was stopped or its file was cut off before the upgrade was over",
        "Record a whole upgrade: begin before the tool starts, stop after it has ended.",
    ),
    Cause.QUERIES_ONLY: Explanation("", "See what is said with flasher monitor TRACE."),
    Cause.FOREIGN_ONLY: Explanation(
        "this is another bus, or another bit rate or filter was set when it was recorded",
        "Record the drive system's bus with all ids.",
    ),
    Cause.EMPTY: Explanation(
        "nothing was sent while it was recorded, the adapter did not hear it, or the file is no "
        "trace of its suffix's format",
        "See with flasher doctor whether the adapter hears the bus.",
    ),
}
