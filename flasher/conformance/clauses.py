"""Clauses that the cases refer to, in this project's words.

Those of the vendor's document have its own numbers; the readings R1 to R28 are this project's, of
what the document leaves open.
"""

from __future__ import annotations

from typing import Final, NamedTuple

ROBUSTNESS: Final = "robustness, not in the document"
"""Label of a case without a clause: the profile decides, or the device must stay reachable."""
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
    "byte first, inserted after the header; it is sent high byte first",
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


class ClauseReading(NamedTuple):
    """This project's reading of a place where the documents are silent or contradictory."""

    asks: str
    why: str
    suite: tuple[str, ...] = ()
    """Suite profile keys that change it."""
    host: tuple[str, ...] = ()
    """Host profile keys (`flasher profile`) that change it."""
    model: tuple[str, ...] = ()
    """Device model options (`flasher mock --set`) that change it."""


READINGS: Final = {
    "R1": ClauseReading(
        "running information has 16 bytes, 4 of them reserved",
        "Welling lists 5 reserved bytes, but the command says 16 bytes of data, which leaves 4; "
        "MOTINOVA lists 4.",
    ),
    "R2": ClauseReading(
        "the tool answers every boot version with the update command until request transfer "
        "comes; a device may listen during the announcements or only after them",
        "The flow chart does not define when the device listens. Answering each announcement works "
        "for a device that listens from the first one on and for one that waits for the end of its "
        "burst. Update commands are at least 30 ms apart: a second one may start a second erase. "
        "During silence the tool sends none, as a silent device may be erasing (but R26).",
        suite=("up_04", "up_04_burst", "up_08", "limits.window_s"),
        host=("timings.update_spacing_s",),
        model=("window_s", "update_in_transfer"),
    ),
    "R3": ClauseReading(
        "reset and general feedback of WMC and OBC are those of the BMS on their own ids",
        "The document refers to chapter 3, which only has them for the BMS.",
        suite=("device.reset_command", "device.reset_data"),
        host=("reset_command", "reset_data"),
    ),
    "R4": ClauseReading(
        "packet numbers are sent low byte first in packet, ACK and NAK alike",
        "The tables do not define it for these numbers; 2.2.1 (7) applies to all data.",
    ),
    "R5": ClauseReading(
        "a memory query names the first byte and the byte after the last one",
        "The answer is padded where the difference of end and start is below 128, so that "
        "difference is the number of bytes.",
    ),
    "R6": ClauseReading(
        "a NAK after end of transfer may mean a damaged message: the tool repeats it once, and "
        "a second NAK means that the image was rejected",
        "The flow chart has two branches there, one for a damaged message and one for a failed "
        "upgrade, both with NAK.",
        suite=("en_02", "limits.refused_s"),
        host=("timings.end_tries",),
        model=("repeated_end", "refused_hold_s"),
    ),
    "R7": ClauseReading(
        "no CRC of the image is sent: the device checks that all packets are there and fit the "
        "size, and the image's own checksum where the product has one",
        "The document calls it a CRC32 check of the received data, but gives the device no value "
        "to compare with.",
        suite=("en_04",),
        model=("image_checksum",),
    ),
    "R8": ClauseReading(
        "the image has no address: it is sent from its lowest byte on, gaps filled with FF, and "
        "has to fit the application area",
        "No message carries an address. A file with bootloader and application in one would be "
        "written to the wrong place, so the host rejects bytes outside the area.",
        suite=("device.application_bytes", "device.largest_image_bytes"),
        host=("application_area.start", "application_area.size_bytes", "image_limit_bytes", "cpu"),
        model=("application_area_bytes", "largest_image_bytes"),
    ),
    "R9": ClauseReading(
        "the update command has the true size, 1 to 65535 x 128 bytes; the last packet is filled "
        "with FF",
        "The document's example, 78351 bytes, is no multiple of 128; packet numbers end at 65535; "
        "an image without bytes is an error.",
        suite=("up_02", "tx_08", "device.largest_image_bytes"),
        host=("image_limit_bytes",),
        model=("largest_image_bytes",),
    ),
    "R10": ClauseReading(
        "a repeated packet that is already stored is acknowledged again, not stored again",
        "A lost ACK makes every tool repeat the packet. Some bootloaders answer NAK n+1 then "
        '("I want the next one"), which is an ACK only where a profile says so and the packet was '
        "sent more than once. An ACK or NAK of an older packet is stale. After a repetition the "
        "tool waits until each copy is answered or 50 ms passed, else one late answer doubles "
        "every later packet.",
        suite=("tx_02", "tx_03"),
        host=("nak_next_is_ack", "timings.quiet_after_repeat_s"),
        model=("repeated_packet", "older_packet"),
    ),
    "R11": ClauseReading(
        "a boot version during a transfer is a restart; after end of transfer it is not answered",
        "A device that announces itself has left the transfer, so the upgrade restarts, a limited "
        "number of times. Up to 60 ms after request transfer a boot version is a leftover of the "
        "burst. After the end the device may be starting its new application, which an update "
        "command would erase: the version answer decides, else the outcome is unconfirmed.",
        suite=("en_03",),
        host=("attempts", "timings.leftover_boot_version_s", "timings.announcing_on_s"),
        model=("after_complete",),
    ),
    "R12": ClauseReading(
        "the limits of the upgrade are not in the document: they are values of the profile; the "
        "frames of a message are at most 100 ms apart",
        "The 200 ms and 1 s of chapter 3 are about queries and writes of the application. A limit "
        "counts from the moment the last frame of a message has left.",
        suite=(
            "tm_02",
            "limits.erase_s",
            "limits.ack_s",
            "limits.complete_s",
            "limits.first_version_s",
            "limits.inter_frame_s",
            "limits.pause_s",
        ),
        host=(
            "timings.boot_version_timeout_s",
            "timings.request_transfer_timeout_s",
            "timings.ack_timeout_s",
            "timings.complete_timeout_s",
            "timings.inter_frame_timeout_s",
        ),
        model=("transfer_timeout_s",),
    ),
    "R13": ClauseReading(
        "a short physical ID may be filled with FF or with 01",
        'The document fills it "with 1", by a word that means bit or place: a reader shows all 12 '
        "bytes.",
    ),
    "R14": ClauseReading(
        "without a valid application the bootloader announces itself until an update command",
        "The document does not describe this case. A device that is silent after its burst can be "
        "upgraded too, but only after power-up.",
        suite=("rs_03", "tx_12"),
        host=("power_up_timeout_s",),
        model=("without_application", "pause_in_transfer"),
    ),
    "R15": ClauseReading(
        "the bootloader answers update command, packet and end of transfer with its own "
        "messages; additional general feedback, also to an unknown write, is correct too",
        "2.2.1 (2) requires general feedback to every write, appendix 3 defines other answers of "
        "the bootloader. Both are correct.",
    ),
    "R16": ClauseReading(
        "request transfer again before the first ACK: the tool sends packet 1 again",
        "An update command would make the device erase again. After the first ACK it is a restart "
        "(R11).",
    ),
    "R17": ClauseReading(
        "a running application answers upgrade messages with general feedback or not at all, "
        "and erases nothing",
        "They are writes, but meant for the bootloader.",
        suite=("up_03",),
        model=("upgrade_in_application",),
    ),
    "R18": ClauseReading(
        "the bootloader ignores reset, which belongs to the application",
        "The document assigns the command to the application (5.2). A bootloader may also restart.",
        suite=("rs_02", "tx_13"),
        model=("reset_in_bootloader", "reset_in_transfer"),
    ),
    "R19": ClauseReading(
        "power-up starts the bootloader; without update command it starts the application, "
        "after complete the new one; a message starts at the start of a frame",
        "Not explicit, but the only consistent reading of the flow chart and of the division into "
        "frames. A temperature is degrees Celsius + 40; the 32 fault bits are sent low byte first "
        "like all data.",
        suite=("fr_02", "en_03", "limits.start_s"),
        model=("after_complete", "start_delay_s"),
    ),
    "R20": ClauseReading(
        "texts without a valid terminator are shown unchanged",
        "Real devices fill a field to its last byte; control characters are shown escaped. This "
        "project only writes texts with a valid terminator.",
    ),
    "R21": ClauseReading(
        "status 00 of the battery means that no flag is set",
        "The table calls 00 asleep, but also defines the byte as combined flags: an awake battery "
        "without a charger is 00 too.",
    ),
    "R22": ClauseReading(
        "state of health 0 may be that of an older device",
        "The byte used to be one of five reserved zero bytes (R1). It is shown as received; values "
        "above 100 % are marked.",
        model=("older_battery",),
    ),
    "R23": ClauseReading(
        "SHUTDOWN is repeated every 200 ms, for 1 s at most",
        "The document gives this interval for the tool's commands and none for SHUTDOWN.",
        model=("idle_shutdown",),
    ),
    "R24": ClauseReading(
        "fault bits 25 to 31 have no meaning",
        "The document neither defines nor reserves them; they are shown by number.",
    ),
    "R25": ClauseReading(
        "a second update command before the first packet may be answered by a second request "
        "transfer, or not",
        "The device may erase again, or recognise that it already has.",
    ),
    "R26": ClauseReading(
        "a silent device in an interrupted transfer gets one update command during the silence",
        "The document defines no time limit, so a device whose tool was lost may wait forever, "
        "without announcing itself or accepting a reset. After a reset without an answer and the "
        "erase limit in silence, the tool sends the update command once, as a new attempt; if "
        "the device has no application to lose, again after each further erase limit. This also "
        "applies to an upgrade of an earlier run that did not end or left the device without an "
        "application, according to the history of this computer for this adapter or to "
        "--in-session. A station has its own rule.",
        suite=("tx_12", "tx_13"),
        host=("attempts", "timings.request_transfer_timeout_s"),
        model=("pause_in_transfer",),
    ),
    "R27": ClauseReading(
        "a query that is answered twice, a packet with more answers than copies, or overlapping "
        "announcements: two devices of the same kind are on the bus",
        "The document has one device of each kind. The tool then writes nothing, and reports no "
        "success of a transfer. Two devices that send equal bits at the same time cannot be "
        "distinguished, and a silent one cannot be detected.",
        host=("timings.boot_watch_s",),
    ),
    "R28": ClauseReading(
        "an announcement that the tool did not cause means another unit or a power loss",
        "The announcement after power-up equals that after a reset and identifies no unit. An "
        "upgrade treats it as a restart of its device (R11); a run of the station ends.",
    ),
}
CLAUSES: Final = {
    **{f"Welling {number}": content for number, content in _DOCUMENT.items()},
    **{number: reading.asks for number, reading in READINGS.items()},
    ROBUSTNESS: "not required by a clause, but it happens on a real bus",
}
"""Text of every clause by its label."""


def clause_texts(clause: str) -> dict[str, str]:
    """Texts of the clauses that a case names ("Welling 5.2, table 8 (A10B); R9").

    Raises ValueError for an unknown clause.
    """
    named = clause.split("; ")
    unknown = [label for label in named if label not in CLAUSES]
    if unknown:
        raise ValueError(f"unknown clause {', '.join(map(repr, unknown))}")
    return {label: CLAUSES[label] for label in named}
