"""Every row of the upgrade's message tables in both directions, and how strictly they are read."""

from __future__ import annotations

from typing import Final

from hypothesis import given, settings
from hypothesis import strategies as st

from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Malformed,
    Nak,
    Packet,
    RequestTransfer,
    ResetCommand,
    Unknown,
    UpdateCommand,
    UpgradeMessage,
    decode,
)
from flasher.protocol.wire import Message, encode
from tests.loops import each

from .cases import CASES

_PAYLOAD: Final = bytes(range(128))

# The typed form, its CAN id, and the message typed from the tables: mode, command, data.
_ROWS: Final[list[tuple[UpgradeMessage, int, str]]] = [
    (ResetCommand(), 0x751, "16 4205 52 45 53 45 54"),
    (GeneralFeedbackMessage(), 0x715, "0C 5503 41 43 4B"),
    (BootVersion("WMC", "V1.2.3"), 0x715, "0C C109 57 4D 43 56 31 2E 32 2E 33"),
    (BootVersion("BMS", "V1.2.3"), 0x725, "0C C109 42 4D 53 56 31 2E 32 2E 33"),
    (BootVersion("PBU", "V1.2.3"), 0x735, "0C C109 50 42 55 56 31 2E 32 2E 33"),
    (UpdateCommand("WMC_UPD", 78351), 0x751, "16 A10B 57 4D 43 5F 55 50 44 0F 32 01 00"),
    (UpdateCommand("BMS_UPD", 78351), 0x752, "16 A10B 42 4D 53 5F 55 50 44 0F 32 01 00"),
    (UpdateCommand("OBC_UPD", 78351), 0x753, "16 A10B 4F 42 43 5F 55 50 44 0F 32 01 00"),
    (UpdateCommand("BMS_UPD", 0), 0x752, "16 A10B 42 4D 53 5F 55 50 44 00 00 00 00"),
    (UpdateCommand("BMS_UPD", 2**32 - 1), 0x752, "16 A10B 42 4D 53 5F 55 50 44 FF FF FF FF"),
    (RequestTransfer(), 0x725, "0C C402 00 00"),
    (Packet(1, 613, _PAYLOAD), 0x752, "16 A385 01 01 00 65 02" + _PAYLOAD.hex()),
    (Packet(300, 613, _PAYLOAD), 0x752, "16 A385 01 2C 01 65 02" + _PAYLOAD.hex()),
    (Packet(65535, 65535, _PAYLOAD), 0x752, "16 A385 01 FF FF FF FF" + _PAYLOAD.hex()),
    (Ack(1), 0x725, "0C C202 01 00"),
    (Ack(300), 0x725, "0C C202 2C 01"),
    (Ack(65535), 0x725, "0C C202 FF FF"),
    (Nak(1), 0x725, "0C C302 01 00"),
    (Nak(256), 0x725, "0C C302 00 01"),
    (EndOfTransfer(), 0x752, "16 A401 04"),
    (Complete(), 0x725, "0C C502 00 00"),
]


def _message(can_id: int, text: str) -> Message:
    raw = bytes.fromhex(text)
    return Message(can_id, raw[0], int.from_bytes(raw[1:3], "big"), raw[3:])


every_row = each("row, can_id, text", _ROWS)


@every_row
def test_a_row_becomes_the_documents_bytes(row: UpgradeMessage, can_id: int, text: str) -> None:
    message = row.to_message(can_id)
    assert message == _message(can_id, text)
    assert encode(message)[2:3] == bytes.fromhex(text)[:1]


@every_row
def test_the_documents_bytes_become_the_row(row: UpgradeMessage, can_id: int, text: str) -> None:
    assert decode(_message(can_id, text)) == row


@every_row
@each("mode", [0x00, 0x0C, 0x11, 0x16, 0xFF])
def test_a_row_in_another_mode_is_malformed(
    row: UpgradeMessage, can_id: int, text: str, mode: int
) -> None:
    message = _message(can_id, text)
    if mode == message.mode:
        assert decode(message) == row
        return
    found = decode(message._replace(mode=mode))
    assert isinstance(found, Malformed)
    assert found.problem == f"mode is {mode:02X}, not {message.mode:02X}"
    assert found.message.mode == mode


_CONSTANT: Final = [entry for entry in _ROWS if not vars(entry[0]) and entry[2][3:] != "3300"]


@each("row, can_id, text", _CONSTANT)
def test_no_byte_of_a_constant_row_may_differ(row: UpgradeMessage, can_id: int, text: str) -> None:
    message = _message(can_id, text)
    assert decode(message) == row
    for position in range(len(message.data)):
        data = bytearray(message.data)
        data[position] ^= 0x01
        found = decode(message._replace(data=bytes(data)))
        assert isinstance(found, Malformed)
        assert bytes(data).hex(" ") in found.problem


@each(
    "data, problem",
    [
        ("00 01 00 01 00", "a packet starts with 01, not 00"),
        ("02 01 00 01 00", "a packet starts with 01, not 02"),
        ("01 00 00 01 00", "packet 0 of 1: numbers start at 1"),
        ("01 01 00 00 00", "packet 1 of 0: numbers start at 1"),
        ("01 00 00 00 00", "packet 0 of 0: numbers start at 1"),
    ],
)
def test_a_packet_with_a_wrong_start_or_number_is_malformed(data: str, problem: str) -> None:
    message = Message(0x752, 0x16, 0xA385, bytes.fromhex(data) + _PAYLOAD)
    assert decode(message) == Malformed(message, problem)


def test_a_packet_beyond_its_total_is_for_the_receiver_to_judge() -> None:
    message = Message(0x752, 0x16, 0xA385, bytes.fromhex("01 03 00 02 00") + _PAYLOAD)
    assert decode(message) == Packet(3, 2, _PAYLOAD)


@each("text", [b"BMS_UPd", b"PBU_UPD", b"HMI_UPD", b"\x00" * 7, b"\xff\x1b[2J\r\n"])
def test_an_update_text_of_no_target_is_malformed(text: bytes) -> None:
    message = Message(0x752, 0x16, 0xA10B, text + b"\x80\x00\x00\x00")
    found = decode(message)
    assert isinstance(found, Malformed)
    assert found.problem.startswith("no target has the update text")
    assert found.problem.isprintable()
    assert found.problem.isascii()


@each(
    "version, is_version",
    [
        ("V1.2.3", True),
        ("V0.0.0", True),
        ("V9.9.9", True),
        ("v1.2.3", False),
        ("V1.2,3", False),
        ("V1.2.\n", False),
        ("V1.2.x", False),
        ("V12.34", False),
        ("V1\u00b2.2.", False),
        ("\x1b[2J\r\n", False),
        ("\x00" * 6, False),
    ],
)
def test_a_boot_version_text_is_kept_as_received_and_judged(version: str, is_version: bool) -> None:
    # RS-08: text that is no version is not a malformed message, it has to be shown.
    data = b"BMS" + version.encode("latin-1").ljust(6, b" ")[:6]
    found = decode(Message(0x725, 0x0C, 0xC109, data))
    assert isinstance(found, BootVersion)
    assert found.name == "BMS"
    assert found.version == data[3:].decode("latin-1")
    assert found.is_version is is_version


@each("version", ["V1.2.34", "V\u0661.2.3", "xV1.2.3", ""])
def test_a_text_that_could_not_come_over_the_wire_is_no_version_either(version: str) -> None:
    assert not BootVersion("BMS", version).is_version


@each("can_id", [0x715, 0x725, 0x735, 0x7FF])
def test_the_typed_form_does_not_depend_on_the_id(can_id: int) -> None:
    assert decode(Message(can_id, 0x0C, 0xC202, b"\x05\x00")) == Ack(5)
    assert Ack(5).to_message(can_id).can_id == can_id


@each("command", [0x0000, 0x1010, 0x4206, 0xC203, 0xA384, 0xFFFF])
def test_a_command_that_is_not_in_the_table_is_unknown(command: int) -> None:
    message = Message(0x752, 0x16, command, bytes(command & 0xFF))
    assert decode(message) == Unknown(message)


def test_every_upgrade_message_of_the_vectors_has_a_row() -> None:
    serials = {0x42, 0x55, 0xA1, 0xA3, 0xA4, 0xC1, 0xC2, 0xC3, 0xC4, 0xC5}
    upgrade = [
        found
        for found in CASES
        if found.message.command >> 8 in serials and found.name[:3] in {"wmc", "bms", "obc"}
    ]
    assert len(upgrade) == 3 * 17
    for found in upgrade:
        row = decode(found.message)
        assert not isinstance(row, Malformed | Unknown), found.name
        assert encode(row.to_message(found.message.can_id)) == found.wire


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    mode=st.one_of(st.sampled_from([0x0C, 0x11, 0x16]), st.integers(0, 255)),
    command=st.one_of(
        st.sampled_from(sorted({row.COMMAND for row, _, _ in _ROWS})), st.integers(0, 0xFFFF)
    ),
    filling=st.binary(min_size=255, max_size=255),
)
def test_whatever_intact_message_comes_is_a_value_and_comes_back_unchanged(
    mode: int, command: int, filling: bytes
) -> None:
    message = Message(0x725, mode, command, filling[: command & 0xFF])
    found = decode(message)
    if isinstance(found, Malformed | Unknown):
        assert found.message == message
    else:
        assert found.to_message(0x725) == message
