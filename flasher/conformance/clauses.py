"""The clauses that cases are judged by, each with its content in this project's words: those of the
vendor's document under its own numbers, and the readings of what it leaves open.
"""

from __future__ import annotations

from typing import Final

ROBUSTNESS: Final = "robustness, not in the document"
"""Label of a case that no clause asks for; what the product does is a choice in the profile, or it
only has to stay reachable.
"""
_DOCUMENT: Final = {
    "2.1": "CAN 2.0A: classic frames of up to 8 bytes with 11-bit ids, at 250 kbit/s",
    "2.2.1, table 1": "a message is header 55 AA, mode, length, command, data, CRC, tail F0",
    "2.2.1 (1)": "the header is always 55 AA, the tail always F0",
    "2.2.1 (2)": "the mode is read 11, write 16 or report 0C; a device that receives a write sends "
    "general feedback to its sender",
    "2.2.1 (3)": "the length is one byte, 02 to FF, and counts command and data",
    "2.2.1 (4, 5)": "the command has two bytes, the second one is the length of the data: the "
    "message's length less 2",
    "2.2.1 (6)": "the CRC runs from the header to the last byte of the data, with the CAN id, high "
    "byte first, put behind the header; it is sent high byte first",
    "2.2.1 (7)": "numbers in the data are sent low byte first",
    "2.2.2, table 2": "the CAN id names the sender and the receiver: 7, the digit of the sender (1 "
    "WMC, 2 BMS, 3 OBC, 5 CDL), the digit of the receiver (0 for all)",
    "2.2.3, table 3": "a message of more than 8 bytes is sent in frames of 8 bytes and a last one "
    "with the rest, all with the same id",
    "3, tables 4 to 7": "what the applications of the nodes send each other; the upgrade has no "
    "part in it but reset and general feedback",
    "3.2, table 5 (1540)": "version information of the BMS: model, serial number, hardware and "
    "firmware version, 16 characters each",
    "3.2, table 5 (5503)": "general feedback: the three characters ACK",
    "3.4, table 7 (4205)": "the tool's write that resets a device: the five characters RESET",
    "4.1": "the CRC's table: polynomial 04C11DB7, not reflected",
    "4.2": "the CRC starts with FFFFFFFF; each byte is XORed into its low byte, and four steps "
    "through the table follow",
    "5.1, figure 2 (begin)": "after reset and general feedback the bootloader announces its boot "
    "version 4 times, 50 ms apart, and asks whether an update command came; then it requests the "
    "transfer, else it does not upgrade",
    "5.1, figure 2 (packets)": "a packet that is received correctly is answered by ACK, another "
    "one by NAK, which asks for it again",
    "5.1, figure 2 (end)": "after end of transfer the packets are checked: complete when they are "
    "right, NAK when they are not, and the upgrade has failed",
    "5.2": "reset and its feedback are those of chapter 3, on the ids of each device",
    "5.2, table 8 (A10B)": "update command: the name of the device (WMC_UPD, BMS_UPD, OBC_UPD) and "
    "the size in bytes, 4 bytes",
    "5.2, table 8 (A385)": "packet: 01, number and total of packets (1 to 65535, 2 bytes each), "
    "128 bytes of the image, filled with FF",
    "5.2, table 8 (A401)": "end of transfer: 04",
    "5.2, table 9 (C109)": "boot version: the name WMC, BMS or PBU (for the OBC) and Vx.x.x",
    "5.2, table 9 (C202, C302)": "ACK and NAK, each with the current packet number, 2 bytes",
    "5.2, table 9 (C402)": "request transfer: 00 00",
    "5.2, table 9 (C502)": "complete: 00 00",
}
_READINGS: Final = {
    "R1": "running information has 16 bytes, 4 of them reserved",
    "R2": "the tool answers every boot version with the update command until request transfer "
    "comes; a device may listen during the announcements or only after them",
    "R3": "reset and general feedback of WMC and OBC are those of the BMS on their own ids",
    "R4": "packet numbers are sent low byte first in packet, ACK and NAK alike",
    "R5": "a memory query names the first byte and the one behind the last",
    "R6": "a NAK after end of transfer may be a damaged message: the tool sends it once more, and "
    "a second NAK means that the image was refused",
    "R7": "no CRC of the image is sent: the device checks that all packets are there and fit the "
    "size, and the image's own checksum where the product has one",
    "R8": "the image has no address: it is sent from its lowest byte on, gaps filled with FF, and "
    "has to fit the application area",
    "R9": "the update command has the true size, 1 to 65535 x 128 bytes; the last packet is filled "
    "with FF",
    "R10": "a packet that is stored and comes again is acknowledged again and not stored again",
    "R11": "a boot version in the midst of a transfer is a restart; after end of transfer it is "
    "not answered",
    "R12": "the limits of the upgrade are not in the document: they are values of the profile; the "
    "frames of a message are at most 100 ms apart",
    "R13": "a short physical ID may be filled with FF or with 01",
    "R14": "without a valid application the bootloader announces itself until an update command "
    "comes",
    "R15": "the bootloader answers update command, packet and end of transfer with its own "
    "messages; general feedback beside them, or to an unknown write, is right too",
    "R16": "request transfer again before the first ACK: the tool sends packet 1 again",
    "R17": "an application that runs answers upgrade messages with general feedback or nothing, "
    "and erases nothing",
    "R18": "the bootloader ignores reset, which belongs to the application",
    "R19": "power-up passes through the bootloader; without update command it starts the "
    "application, after complete the new one; a message begins at the beginning of a frame",
    "R20": "texts that break the rule of the terminator are shown as they are",
    "R21": "status 00 of the battery means that no flag is set",
    "R22": "state of health 0 may be that of an older device",
    "R23": "SHUTDOWN is repeated every 200 ms, for 1 s at most",
    "R24": "fault bits 25 to 31 have no meaning",
    "R25": "a second update command before the first packet may be answered by a second request "
    "transfer, or not",
    "R26": "a device that sits silent in a broken transfer gets one update command into the "
    "silence",
}
CLAUSES: Final = {
    **{f"Welling {number}": content for number, content in _DOCUMENT.items()},
    **_READINGS,
    ROBUSTNESS: "no clause asks for it, but a bootloader on a real bus meets it",
}
"""Every clause with its content."""


def contents(clause: str) -> dict[str, str]:
    """The clauses that a case names ("Welling 5.2, table 8 (A10B); R9") with their contents.

    Raises ValueError for one that does not exist.
    """
    named = clause.split("; ")
    unknown = [label for label in named if label not in CLAUSES]
    if unknown:
        raise ValueError(f"there is no clause {', '.join(map(repr, unknown))}")
    return {label: CLAUSES[label] for label in named}
