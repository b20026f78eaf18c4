"""English texts of enumeration members for display, by enumeration and word.

The values of enumerations are stable words, used in JSON and records. Their texts are here, so that
they can be translated.
"""

from __future__ import annotations

from enum import Enum
from typing import Final, NamedTuple

_TEXTS: Final[dict[str, dict[str, str]]] = {
    "Ending": {
        "completed": "the device confirmed the complete image",
        "confirmed_by_version": "the final answer was lost, the new application answers its "
        "version",
        "unconfirmed": "everything was sent and acknowledged, the final answer never came",
        "other_version": "another version answers than the one that was sent",
        "refused": "the device refused the image at the end",
        "no_boot_version": "no boot version came",
        "no_announcement": "it did not announce itself",
        "no_request": "no request transfer came",
        "unhearing": "the bootloader announces itself but does not accept the update command",
        "wrong_device": "another device answers",
        "boot_too_old": "its bootloader is older than the image needs",
        "two_devices": "two devices answer on the same id",
        "not_for_device": "the image is not meant for this device",
        "not_trusted": "the trust file does not allow this release",
        "implausible": "not plausible as firmware",
        "unchecked": "it cannot be checked whether the image is meant for this device",
        "in_use": "the vehicle is in use",
        "low_charge": "the battery is nearly empty",
        "up_to_date": "the device already runs this version",
        "second_tool": "a second tool sends on the bus",
        "packet_failed": "a packet was not acknowledged",
        "restarted": "the device restarted too often",
        "broken_protocol": "the device confirmed the image before the transfer had ended",
        "out_of_time": "the overall deadline passed",
        "cancelled": "cancelled by the user",
    },
    "DeviceLeft": {
        "untouched": "this run erased nothing: the device is as it was before",
        "perhaps_erased": "the command to erase its application was sent, and not answered: "
        "flash it again, or check after a power cycle what it runs",
        "no_application": "its application is erased, half written or not accepted: it stays in "
        "its bootloader until an image is flashed completely",
        "unknown": "it acknowledged every byte of the image; whether it has and runs it now is not "
        "known",
        "new": "it has the new image",
        "other": "its application is, by its answers, not this image",
    },
    "Verdict": {
        "not_asked": "not asked for",
        "version_right": "the application runs and names the version of the image",
        "version_unjudged": "the application runs; the image names no version to compare with",
        "memory_right": "every byte read back is the image's",
        "version_other": "the application runs another version than the image names",
        "no_answer": "the application does not answer",
        "in_bootloader": "a bootloader keeps announcing itself and no application answers",
        "memory_other": "the memory differs from the image",
        "other_unit": "another unit answers",
        "two_devices": "two devices answer on the same id",
        "second_tool": "a second tool sends on the bus",
        "interrupted": "interrupted by the user",
    },
    "Reason": {
        "packet_refused": "the device refused {what}",
        "packet_unanswered": "the device did not answer {what} in time",
        "packet_given_up": "the device did not take a packet, however often it was sent",
        "request_again": "the device requested the transfer once more",
        "request_late": "the device requested the transfer again in the middle of it",
        "restarted": "the device restarted",
        "boot_given_up": "the device did not announce its bootloader",
        "boot_silent": "the device is silent, like one in an open session, and gets an update "
        "command",
        "request_given_up": "the device did not request the transfer in time",
        "end_refused": "the device refused the {what}",
        "end_unanswered": "the device did not answer the {what} in time",
        "second_tool": "another tool wrote to the device, and is silent now",
        "link_back": "the adapter was away for a while",
        "query_unanswered": "no answer came",
    },
    "Phase": {
        "listen": "listening for another tool",
        "identify": "asking the device who it is",
        "reset": "resetting the application",
        "boot": "waiting for the boot version",
        "update": "waiting for request transfer",
        "transfer": "transferring",
        "end": "waiting for the final answer",
        "confirm": "asking the new application for its version",
    },
    "DamageReason": {
        "junk": "bytes outside of any message",
        "bad_length": "length field does not fit the command",
        "bad_crc": "wrong CRC",
        "bad_tail": "wrong tail",
        "incomplete": "the rest of the message did not come in time",
    },
    "Cause": {
        "completed": "completed",
        "confirmed_by_version": "final answer lost, new application answers",
        "nobody_acknowledges": "no node acknowledges on the bus",
        "no_boot_version": "no boot version after the reset",
        "reset_ignored": "no boot version after a reset that the application confirmed",
        "no_request": "no request transfer after the update command",
        "update_not_taken": "the bootloader does not accept the update command",
        "wrong_device": "another kind of device",
        "two_devices": "two devices on one CAN id",
        "packet_refused": "a packet was refused again and again",
        "packet_unanswered": "a packet was never answered",
        "packet_answered_otherwise": "a packet has answers, but no ACK of its number",
        "packet_damaged": "damaged frames in the transfer",
        "device_restarted": "the device restarted in the middle",
        "second_tool": "two tools send on the bus",
        "shutdown": "the battery sent SHUTDOWN: it switches off",
        "bus_trouble": "error frames on the bus",
        "tool_stopped": "the tool fell silent in the middle",
        "tool_ended": "the tool gave up in the middle",
        "refused": "refused at the end",
        "unconfirmed": "the final answer never came",
        "complete_too_early": "complete before the end of the transfer",
        "other_version": "completed, but another version answers",
        "in_bootloader": "completed, but the device stays in its bootloader",
        "recording_ends": "the recording ends in the middle",
        "queries_only": "no upgrade, but drive-system traffic",
        "foreign_only": "no upgrade, only traffic of other kinds",
        "empty": "nothing in this trace",
    },
    "TalkerKind": {
        "node": "node of the drive system",
        "foreign": "foreign",
    },
    "Kind": {
        "message": "message",
        "unknown": "unknown message",
        "malformed": "malformed message",
        "damaged": "damaged bytes",
        "foreign": "foreign frame",
        "error_frame": "error frame",
    },
    "ControllerState": {
        "active": "error-active",
        "passive": "error-passive",
        "bus_off": "bus-off",
        "unknown": "unknown",
    },
}


def wording(word: Enum) -> str:
    return _TEXTS[type(word).__name__][word.value]


def wording_of(enumeration: str, word: str) -> str:
    """Text for a word of the enumeration of this name; the word itself without one."""
    return _TEXTS[enumeration].get(word, word)


# -- causes of failure in a trace -----------------------------------------------------------------


class Explanation(NamedTuple):
    """Likely cause and remedy, with placeholders {node} and {boot_name}."""

    likely: str
    remedy: str


_NOTHING: Final = Explanation("", "")
_AGAIN: Final = "Then run the upgrade again."
_RESCUE: Final = "The device stays in its bootloader until an image is flashed completely."

_EXPLANATIONS: Final[dict[str, Explanation]] = {
    "nobody_acknowledges": Explanation(
        "no device is connected or powered, the bit rate is wrong, CAN-H and CAN-L are "
        "swapped, or the termination is missing",
        f"Check supply, wiring, the 120 ohm termination at both ends, and the bit rate. {_AGAIN}",
    ),
    "no_boot_version": Explanation(
        "the device has no power, sleeps, is not on this bus, or its bootloader announces itself "
        "only at power-up",
        "Check supply and wiring. A device whose upgrade was broken off may still wait in it: "
        "--in-session reaches that. One that announces itself at power-up only is reached by "
        "flasher rescue and a power cycle.",
    ),
    "reset_ignored": Explanation(
        "it ignores the reset in its state, its profile needs another reset_command, its "
        "announcement was lost, or its bootloader announces itself only at power-up",
        f"{_AGAIN} If it does not help, flasher rescue and a power cycle reach its bootloader.",
    ),
    "no_request": Explanation(
        "erasing takes longer than the tool waited, the device refuses this size or target, or it "
        "hangs",
        f"Power-cycle the device. {_AGAIN} If it happens again, allow more time for erasing.",
    ),
    "update_not_taken": Explanation(
        "the update command names another target or too large an image, or it comes when the "
        "bootloader does not listen",
        "Check that the device is the {node} and that the image fits it.",
    ),
    "wrong_device": Explanation(
        "the connected device is not the {node}, whose bootloader reports {boot_name}",
        "Check what is connected and which target was named.",
    ),
    "two_devices": Explanation(
        "two devices of the same kind are on the bus",
        f"Disconnect one of them. {_AGAIN}",
    ),
    "packet_refused": Explanation(
        "the device cannot store this packet (flash that is worn, locked or not erased), or it "
        "receives it damaged each time",
        f"Check supply and wiring. {_AGAIN} If it stops there again, the device is defective.",
    ),
    "packet_unanswered": Explanation(
        "the device lost power or contact, hangs, or its answers do not get through",
        f"Check supply and wiring, power-cycle the device. {_AGAIN} {_RESCUE}",
    ),
    "packet_answered_otherwise": Explanation(
        "the bootloader numbers packets in another way than table 9 (two bytes, the low one "
        "first) or answers them with another message, or an application runs again",
        f"Report it to the maker of the bootloader. {_AGAIN} {_RESCUE}",
    ),
    "packet_damaged": Explanation(
        "the line is disturbed, an adapter loses frames, or two senders share one id",
        "Check wiring, termination and ground; try another adapter or a shorter cable. "
        f"{_AGAIN} {_RESCUE}",
    ),
    "device_restarted": Explanation(
        "its supply drops, its watchdog resets it, it refuses a packet, or two devices "
        "of the same kind answer",
        f"Check the supply, and that there is one {{node}} only. {_AGAIN} {_RESCUE}",
    ),
    "second_tool": Explanation(
        "a second dongle, a diagnostic program or another copy of this tool is on the bus",
        f"Disconnect or stop the other tool. {_AGAIN}",
    ),
    "shutdown": Explanation(
        "the key was held, or the battery found the vehicle idle and switched everything off",
        f"Switch the battery on and keep it awake. {_AGAIN} {_RESCUE}",
    ),
    "bus_trouble": Explanation(
        "a loose contact, a missing termination, or a node with another bit rate",
        f"Check wiring and termination; disconnect other nodes one by one. {_AGAIN}",
    ),
    "tool_stopped": Explanation(
        "the tool was interrupted, its computer or adapter failed, or it was unplugged",
        f"Look at what the tool reported. {_AGAIN} {_RESCUE}",
    ),
    "tool_ended": Explanation(
        "the tool itself ended the upgrade, for the reason that it reported",
        "Follow the message of the tool, which also gives the state of the device.",
    ),
    "refused": Explanation(
        "the image is not meant for this device, or the checksum that it carries is wrong",
        f"Look at the image (flasher image-info) and flash one that fits. {_RESCUE}",
    ),
    "unconfirmed": Explanation(
        "the answer was lost, or the device restarted without sending it",
        "Unconfirmed is not complete: check whether the new application runs (flasher info), or "
        "flash it again.",
    ),
    "complete_too_early": Explanation(
        "the bootloader counts other packets than the tool, or does not follow the protocol",
        "Report the boot version to its maker, and see what the device runs (flasher info).",
    ),
    "other_version": Explanation(
        "the device fell back to an older image, or the image names its version wrongly",
        "Compare with flasher image-info, then flash the right image.",
    ),
    "in_bootloader": Explanation(
        "the device does not start the image that it confirmed, or a second device of its kind has "
        "lost its application",
        f"It has no application now. {_RESCUE}",
    ),
    "recording_ends": Explanation(
        "the recording was stopped or its file was cut off before the upgrade was over",
        "Record a whole upgrade: begin before the tool starts, stop after it has ended.",
    ),
    "queries_only": Explanation("", "See the messages with flasher monitor TRACE."),
    "foreign_only": Explanation(
        "this is another bus, or another bit rate or filter was set when it was recorded",
        "Record the drive system's bus with all ids.",
    ),
    "empty": Explanation(
        "nothing was sent during the recording, the adapter did not receive it, it contains "
        "only CAN FD frames, or the file is not in the format of its suffix",
        "Check with flasher doctor whether the adapter receives the bus.",
    ),
}


def explanation(cause: Enum) -> Explanation:
    """Explanation of a cause; empty if it needs none."""
    return _EXPLANATIONS.get(cause.value, _NOTHING)
