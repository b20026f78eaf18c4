"""The rows of chapter 3, typed a second time from the documents' tables, and their messages on the
wire. What the messages carry is held by `test_contents`.
"""

from __future__ import annotations

import random
from typing import Any, Final, NamedTuple

import pytest

from flasher.protocol import contents, wire
from flasher.protocol.catalogue import (
    BY_KEY,
    ITEMS,
    Decoded,
    Item,
    answer_of,
    decode,
    encode,
    has_message,
)
from flasher.protocol.fields import Content, WireText
from flasher.protocol.spec import (
    DIALECTS,
    HEADER,
    MOTINOVA,
    WELLING,
    Dialect,
    Mode,
    data_size,
)
from flasher.protocol.wire import Message
from tests import messages_document
from tests.loops import each

from .cases import CASES, Case, case

DIALECT_OF_ROW: Final = {
    "both": {"welling", "motinova"},
    "welling": {"welling"},
    "motinova": {"motinova"},
}


class Row(NamedTuple):
    """A row as the documents' tables print it; `answer` is id and command, empty for reports."""

    can_id: int
    mode: int
    command: int
    size_bytes: int
    content: type[Content]
    answer: tuple[int, int] | tuple[()] = ()
    dialects: str = "both"
    for_the_manufacturer: bool = False

    @property
    def key(self) -> tuple[int, int]:
        return self.can_id, self.command


R, W, P = 0x11, 0x16, 0x0C
FEEDBACK: Final = (0x725, 0x5503)

# fmt: off
ROWS: Final = (
    # Sent by the BMS (5.1), to all.
    Row(0x720, P, 0x1010, 16, contents.RunningInformation),
    Row(0x720, P, 0x1120, 32, contents.CellVoltages),
    Row(0x720, P, 0x1204, 4, contents.Faults),
    Row(0x720, P, 0x1308, 8, contents.Shutdown),
    Row(0x720, P, 0x1410, 16, contents.DesignInformation),
    Row(0x720, P, 0x1540, 64, contents.VersionInformation),
    Row(0x720, P, 0x160C, 12, contents.PhysicalId),
    Row(0x720, P, 0x170C, 12, contents.CheckCode),
    # Sent by the BMS to the WMC.
    Row(0x721, P, 0x3005, 5, contents.Ready),
    # Sent by the BMS to the tool.
    Row(0x725, P, 0x5028, 40, contents.History),
    Row(0x725, P, 0x5120, 32, contents.ProductionInformation),
    Row(0x725, P, 0x5210, 16, contents.UserString),
    Row(0x725, P, 0x5310, 16, contents.UserString),
    Row(0x725, P, 0x5410, 16, contents.UserString),
    Row(0x725, P, 0x5503, 3, contents.GeneralFeedback),
    Row(0x725, P, 0x5688, 136, contents.Memory),
    # Sent by the WMC (5.2).
    Row(0x710, P, 0x1305, 5, contents.Ready),
    Row(0x710, P, 0x1808, 8, contents.Shutdown, dialects="welling"),
    Row(0x712, R, 0x3009, 9, contents.Handshake, (0x721, 0x3005)),
    Row(0x712, R, 0x3100, 0, contents.Empty, (0x720, 0x160C)),
    Row(0x712, R, 0x3200, 0, contents.Empty, (0x720, 0x170C)),
    Row(0x712, R, 0x3300, 0, contents.Empty, (0x720, 0x1410)),
    # Sent by the OBC.
    Row(0x730, P, 0x1405, 5, contents.Ready),
    Row(0x732, R, 0x5000, 0, contents.Empty, (0x720, 0x1010)),
    Row(0x732, R, 0x5100, 0, contents.Empty, (0x720, 0x1540)),
    Row(0x732, R, 0x5200, 0, contents.Empty, (0x720, 0x1410)),
    Row(0x732, R, 0x5300, 0, contents.Empty, (0x720, 0x1120)),
    # Sent by the HMI.
    Row(0x740, P, 0x1305, 5, contents.Ready, dialects="motinova"),
    Row(0x742, R, 0x5000, 0, contents.Empty, (0x720, 0x1540), "motinova"),
    Row(0x742, R, 0x5100, 0, contents.Empty, (0x720, 0x1410), "motinova"),
    Row(0x742, R, 0x5200, 0, contents.Empty, (0x720, 0x1120), "motinova"),
    # Sent by the tool.
    Row(0x752, R, 0x3000, 0, contents.Empty, (0x720, 0x160C)),
    Row(0x752, R, 0x3100, 0, contents.Empty, (0x720, 0x170C)),
    Row(0x752, W, 0x320C, 12, contents.CheckCode, FEEDBACK),
    Row(0x752, R, 0x3300, 0, contents.Empty, (0x720, 0x1540)),
    Row(0x752, R, 0x3400, 0, contents.Empty, (0x720, 0x1010)),
    Row(0x752, R, 0x3500, 0, contents.Empty, (0x720, 0x1120)),
    Row(0x752, R, 0x3600, 0, contents.Empty, (0x720, 0x1410)),
    Row(0x752, R, 0x3700, 0, contents.Empty, (0x725, 0x5120)),
    Row(0x752, R, 0x3800, 0, contents.Empty, (0x725, 0x5028)),
    Row(0x752, R, 0x3900, 0, contents.Empty, (0x725, 0x5210)),
    Row(0x752, W, 0x3A10, 16, contents.UserString, FEEDBACK),
    Row(0x752, R, 0x3B00, 0, contents.Empty, (0x725, 0x5310)),
    Row(0x752, W, 0x3C10, 16, contents.UserString, FEEDBACK),
    Row(0x752, R, 0x3D00, 0, contents.Empty, (0x725, 0x5410)),
    Row(0x752, W, 0x3E10, 16, contents.UserString, FEEDBACK),
    Row(0x752, W, 0x3F20, 32, contents.ProductionInformation, FEEDBACK, "both", True),
    Row(0x752, W, 0x4010, 16, contents.Model, FEEDBACK, "both", True),
    Row(0x752, W, 0x4110, 16, contents.SerialNumber, FEEDBACK, "both", True),
    Row(0x752, W, 0x4205, 5, contents.Reset, FEEDBACK),
    Row(0x752, R, 0x4308, 8, contents.ReadMemory, (0x725, 0x5688)),
)
# fmt: on

every_row = each("row", ROWS)
every_item = each("item", ITEMS)


def message_of(item: Item, fill: int = 0x00) -> Message:
    """A message of that row, its data all the same byte."""
    return Message(item.can_id, item.mode, item.command, bytes([fill]) * data_size(item.command))


# -- the rows -------------------------------------------------------------------------------------


def test_no_row_of_the_documents_is_missing_and_none_is_added_or_listed_twice() -> None:
    assert sorted(item.key for item in ITEMS) == sorted(row.key for row in ROWS)
    assert len({row.key for row in ROWS}) == 51


@every_row
def test_a_row_has_the_id_mode_size_and_content_of_the_documents(row: Row) -> None:
    item = BY_KEY[row.key]
    assert item.can_id == row.can_id
    assert item.mode == row.mode
    assert item.content is row.content
    assert row.size_bytes == item.content.SIZE_BYTES
    assert row.command & 0xFF == row.size_bytes


@every_row
def test_a_row_is_in_the_dialects_that_have_it(row: Row) -> None:
    assert {dialect.name for dialect in BY_KEY[row.key].dialects} == DIALECT_OF_ROW[row.dialects]


@every_row
def test_a_query_or_write_is_answered_as_the_documents_state(row: Row) -> None:
    answer = answer_of(BY_KEY[row.key])
    assert (answer.key if answer else ()) == row.answer
    assert (row.mode == P) == (answer is None)


@every_row
def test_an_answer_is_a_report_that_exists_in_every_dialect_of_its_question(row: Row) -> None:
    item = BY_KEY[row.key]
    answer = answer_of(item)
    if answer is not None:
        assert answer.mode is Mode.REPORT
        assert set(item.dialects) <= set(answer.dialects)


@every_row
def test_only_what_the_documents_mark_is_for_the_manufacturer(row: Row) -> None:
    assert BY_KEY[row.key].manufacturer_only == row.for_the_manufacturer


@every_item
def test_a_row_is_sent_by_and_to_nodes_that_its_dialects_have(item: Item) -> None:
    for dialect in item.dialects:
        assert item.sender in dialect.nodes
        assert item.receiver is None or item.receiver in dialect.nodes


def test_titles_distinguish_the_rows_of_one_sender() -> None:
    titles = [(item.can_id, item.title) for item in ITEMS]
    assert len(set(titles)) == len(titles)


def test_a_row_is_named_as_the_documents_print_it() -> None:
    assert BY_KEY[0x752, 0x320C].name == "752 320C"
    assert BY_KEY[0x725, 0x5028].name == "725 5028"


def test_an_answer_that_no_row_gives_is_a_mistake_in_the_catalogue() -> None:
    asked = BY_KEY[0x752, 0x3000]
    wrong = Item(
        asked.sender, asked.receiver, asked.mode, 0x3000, contents.Empty, "read nothing", 0x9900
    )
    with pytest.raises(LookupError, match="752 3000 has no answering row"):
        answer_of(wrong)


# -- dialects (section 6) -------------------------------------------------------------------------


def rows_of(dialect: Dialect) -> set[tuple[int, int]]:
    return {item.key for item in ITEMS if dialect in item.dialects}


def test_welling_alone_broadcasts_the_shutdown_of_the_wmc() -> None:
    assert rows_of(WELLING) - rows_of(MOTINOVA) == {(0x710, 0x1808)}


def test_motinova_alone_has_messages_of_the_hmi() -> None:
    assert rows_of(MOTINOVA) - rows_of(WELLING) == {
        (0x740, 0x1305),
        (0x742, 0x5000),
        (0x742, 0x5100),
        (0x742, 0x5200),
    }


def test_the_dialects_count_47_and_50_rows() -> None:
    assert (len(rows_of(WELLING)), len(rows_of(MOTINOVA))) == (47, 50)


def test_the_dialects_differ_in_bit_rate_nodes_and_upgrade() -> None:
    assert (WELLING.version, WELLING.bitrate_bps) == ("V1.0.0", 250_000)
    assert [node.name for node in WELLING.nodes] == ["WMC", "BMS", "OBC", "CDL"]
    assert WELLING.has_upgrade
    assert (MOTINOVA.version, MOTINOVA.bitrate_bps) == ("V2.7.1", 125_000)
    assert [node.name for node in MOTINOVA.nodes] == ["WMC", "BMS", "OBC", "HMI", "CDL"]
    assert not MOTINOVA.has_upgrade


@each(
    "message, welling, motinova",
    [
        (Message(0x710, 0x0C, 0x1808, b""), True, False),
        (Message(0x740, 0x0C, 0x1305, b"READY"), False, True),
        (Message(0x720, 0x0C, 0x1308, b"SHUTDOWN"), True, True),
        (Message(0x725, 0x0C, 0xC109, b"BMSV1.0.0"), True, False),  # of the upgrade
        (Message(0x752, 0x11, 0x9901, b"?"), True, True),  # not in the documents
    ],
)
def test_a_dialect_has_its_own_messages_and_does_not_judge_unknown_ones(
    message: Message, *, welling: bool, motinova: bool
) -> None:
    assert has_message(WELLING, message) is welling
    assert has_message(MOTINOVA, message) is motinova


@each("dialect", DIALECTS.values())
def test_both_dialects_keep_the_reset_command(dialect: Dialect) -> None:
    assert (0x752, 0x4205) in rows_of(dialect)


@each("dialect", DIALECTS.values())
def test_both_dialects_give_the_four_queries_of_the_push_buttons_and_the_obc(
    dialect: Dialect,
) -> None:
    asked = {command for can_id, command in rows_of(dialect) if can_id == 0x732}
    assert asked == {0x5000, 0x5100, 0x5200, 0x5300}


@each("dialect", DIALECTS.values())
def test_both_dialects_leave_four_bytes_reserved_in_running_information(dialect: Dialect) -> None:
    """R1: one document lists five, which its own length of 16 leaves no room for."""
    decoded = decode(Message(0x720, P, 0x1010, bytes(12) + b"\x01\x02\x03\x04"), dialect)
    assert decoded is not None
    assert isinstance(decoded.content, contents.RunningInformation)
    assert decoded.content.reserved == b"\x01\x02\x03\x04"
    assert decode(Message(0x720, P, 0x1010, bytes(17)), dialect) is None


# -- decoding -------------------------------------------------------------------------------------


@every_row
def test_a_message_of_a_row_is_decoded_and_encoded_back(row: Row) -> None:
    for fill in (0x00, 0x5A, 0xFF):
        message = Message(row.can_id, row.mode, row.command, bytes([fill]) * row.size_bytes)
        decoded = decode(message)
        assert decoded is not None, fill
        assert decoded.item is BY_KEY[row.key]
        assert type(decoded.content) is row.content
        assert encode(decoded.item, decoded.content) == message


@every_row
def test_a_message_is_decoded_in_its_dialects_and_in_no_other(row: Row) -> None:
    message = Message(row.can_id, row.mode, row.command, bytes(row.size_bytes))
    decoding = {name for name, dialect in DIALECTS.items() if decode(message, dialect) is not None}
    assert decoding == DIALECT_OF_ROW[row.dialects]


@every_item
def test_data_of_another_size_is_not_decoded(item: Item) -> None:
    right = message_of(item)
    assert decode(right) is not None
    for size_bytes in {0, 1, len(right.data) - 1, len(right.data) + 1, 253} - {len(right.data)}:
        if size_bytes >= 0:
            assert decode(right._replace(data=bytes(size_bytes))) is None


@every_item
def test_another_mode_is_not_decoded(item: Item) -> None:
    for mode in range(0x100):
        decoded = decode(message_of(item)._replace(mode=mode))
        assert (decoded is not None) == (mode == item.mode)


@every_item
def test_a_row_is_not_decoded_on_an_id_without_it(item: Item) -> None:
    with_it = {row.can_id for row in ROWS if (row.command, row.mode) == (item.command, item.mode)}
    for can_id in [*range(0x700, 0x760), 0x000, 0x7FF]:
        decoded = decode(message_of(item)._replace(can_id=can_id))
        assert (decoded is not None) == (can_id in with_it)


def test_one_command_means_different_things_on_different_ids() -> None:
    titles = {
        can_id: found.item.title
        for can_id in (0x732, 0x742)
        if (found := decode(Message(can_id, R, 0x5000, b"")))
    }
    assert titles == {0x732: "read running information", 0x742: "read version information"}


def test_unknown_commands_and_ids_are_not_decoded_and_raise_nothing() -> None:
    rng = random.Random("unknown messages")
    known = {row.key for row in ROWS}
    for _ in range(2000):
        can_id, command = rng.randrange(0x800), rng.randrange(0x10000)
        data = rng.randbytes(data_size(command))
        if (can_id, command) not in known:
            assert decode(Message(can_id, rng.choice((R, W, P)), command, data)) is None


def test_the_messages_of_the_upgrade_are_none_of_the_catalogue() -> None:
    upgrade = [found for found in CASES if found.message.command >> 8 >= 0xA1]
    assert len(upgrade) == 45
    assert not [found.name for found in upgrade if decode(found.message)]


# -- the vectors of chapter 3 ---------------------------------------------------------------------

VECTORS: Final = [
    found for found in CASES if (found.message.can_id, found.message.command) in BY_KEY
]


def test_nineteen_vectors_are_messages_of_the_catalogue() -> None:
    assert len(VECTORS) == 19


@each("vector", VECTORS)
def test_a_vector_is_decoded_and_encoded_to_its_wire_bytes(vector: Case) -> None:
    decoded = decode(vector.message)
    assert decoded is not None
    message = encode(decoded.item, decoded.content)
    assert message == vector.message
    assert wire.encode(message) == vector.wire


@each(
    "key, content, name",
    [
        (
            (0x720, 0x1010),
            contents.RunningInformation(
                41250, -1234, 9000, 10000, 25, 90, contents.BatteryStatus.CHARGER_CONNECTED, 99
            ),
            (
                "running information: 41.250 V, -1.234 A, 9000 of 10000 mAh, 25 C, 90 %, "
                "charger connected, health 99 %"
            ),
        ),
        (
            (0x720, 0x1120),
            contents.CellVoltages(
                (4100, 4101, 4102, 4103, 4104, 4105, 4106, 4107, 4108, 4109, 0, 0, 0, 0, 0, 0)
            ),
            "cell voltages: 10 cells 4100..4109 mV",
        ),
        (
            (0x720, 0x1204),
            contents.Faults(
                contents.BatteryFault.CHARGE_OVER_VOLTAGE_WARNING
                | contents.BatteryFault.MOS_OVER_TEMPERATURE_WARNING
                | contents.BatteryFault.SHORT_CIRCUIT_PROTECTION
                | contents.BatteryFault.MCU_FAULT
            ),
            (
                "faults: charge over-voltage warning, MOS over-temperature warning, "
                "short-circuit protection, MCU fault"
            ),
        ),
        (
            (0x720, 0x1410),
            contents.DesignInformation(10000, 36, WireText(b"21700A. ")),
            "design: 10000 mAh, 36 V, cell model 21700A",
        ),
        (
            (0x720, 0x1540),
            contents.VersionInformation(
                WireText(b"BM36.           "),
                WireText(b"W2605001.       "),
                WireText(b"V1r2r0_20220512."),
                WireText(b"V1r2r3_20220512."),
            ),
            "version: BM36, W2605001, V1r2r0_20220512, V1r2r3_20220512",
        ),
        (
            (0x725, 0x5028),
            contents.History(
                45, -5, 25000, 4000, 12, 30, 400, 1, 2, 3, 4, 5, 6, 7, 8, 9, 60000, 98
            ),
            (
                "history: 45 C, -5 C, 25000 mA, 4000 mA, 12 cycles, 30 h, 400 h, counts 1..9, "
                "60000 min, health 98 %"
            ),
        ),
        (
            (0x725, 0x5120),
            contents.ProductionInformation(
                WireText(b"WELLING."), WireText(b"WUXI.   "), WireText(b"20220512")
            ),
            "production: WELLING, WUXI, 2022-05-12",
        ),
        (
            (0x752, 0x4308),
            contents.ReadMemory(0x08004000, 0x08004040),
            "read memory 0x08004000..0x08004040",
        ),
        (
            (0x725, 0x5688),
            contents.Memory(0x08004000, 0x08004040, bytes(range(64)) + b"\xff" * 64),
            "memory 0x08004000..0x08004040",
        ),
        ((0x712, 0x3009), contents.Handshake(), "WMC asks BMS: handshake"),
        ((0x721, 0x3005), contents.Ready(), "BMS to WMC: ready"),
        ((0x720, 0x1308), contents.Shutdown(), "BMS announces shutdown"),
        ((0x730, 0x1405), contents.Ready(), "OBC ready for shutdown"),
        ((0x732, 0x5000), contents.Empty(), "OBC asks running information"),
        ((0x742, 0x5000), contents.Empty(), "HMI asks version"),
        ((0x752, 0x3300), contents.Empty(), "CDL asks version"),
        (
            (0x752, 0x4110),
            contents.SerialNumber(WireText(b"W2605001.       ")),
            "CDL writes serial number W2605001",
        ),
        ((0x752, 0x4205), contents.Reset(), "bms reset"),
        ((0x725, 0x5503), contents.GeneralFeedback(), "bms general feedback ACK"),
    ],
)
def test_a_vector_is_what_its_name_states(
    key: tuple[int, int], content: Content, name: str
) -> None:
    vector = case(name)
    assert decode(vector.message) == Decoded(BY_KEY[key], content)
    assert wire.encode(encode(BY_KEY[key], content)) == vector.wire


# -- encoding -------------------------------------------------------------------------------------


@every_item
def test_whatever_is_encoded_fits_the_wire(item: Item) -> None:
    content = item.content.from_data(bytes(item.content.SIZE_BYTES))
    message = encode(item, content)
    assert message == message_of(item)
    assert wire.encode(message).startswith(HEADER + bytes([item.mode, len(message.data) + 2]))


def test_a_value_that_does_not_fit_is_refused_with_the_name_of_its_field() -> None:
    too_long: dict[str, Any] = {"serial_number": "W" * 16}
    with pytest.raises(ValueError, match=r"^serial number: .*longer than 15 characters"):
        encode(BY_KEY[0x752, 0x4110], contents.SerialNumber(**too_long))


@each("content", [contents.Empty(), contents.CheckCode(bytes(12))])
def test_the_content_of_another_message_is_refused(content: Content) -> None:
    with pytest.raises(ValueError, match=r"^write model \(752 4010\) carries Model, not "):
        encode(BY_KEY[0x752, 0x4010], content)


def test_the_content_of_another_message_of_the_same_size_is_refused() -> None:
    serial_number = contents.SerialNumber(WireText(b"W2605001.       "))
    with pytest.raises(ValueError, match=r"carries Model, not SerialNumber"):
        encode(BY_KEY[0x752, 0x4010], serial_number)


# -- the document ---------------------------------------------------------------------------------


def test_the_document_of_the_messages_is_that_of_the_catalogue() -> None:
    written = messages_document.MESSAGES.read_text(encoding="utf-8")
    assert written == messages_document.messages_document(), (
        "write it anew: python -m tests.messages_document"
    )


@every_row
def test_the_document_lists_the_row_with_its_answer(row: Row) -> None:
    written = messages_document.MESSAGES.read_text(encoding="utf-8")
    start = f"| {row.can_id:03X} {row.command:04X} | "
    (line,) = [line for line in written.splitlines() if line.startswith(start)]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[1] == {R: "read", W: "write", P: "report"}[row.mode]
    assert int(cells[4]) == row.size_bytes
    assert cells[-2] == ("{:03X} {:04X}".format(*row.answer) if row.answer else "")
    assert cells[-1] == ("" if row.dialects == "both" else f"{row.dialects} only")


@each(
    "line",
    [
        "| 2 | 2 | mean current | `mean_current_ma` | int16 | mA | |",
        "| 8 | 1 | cell temperature | `cell_temperature_c` | uint8 | °C | value + 40 |",
        "| 0 | 32 | cells | `cells_mv` | 16 uint16 | mV | |",
        "| 16 | 8 | date | `date` | date | | YYYYMMDD |",
        "| 12 | 4 | reserved | `reserved` | bytes | | 00 |",
        "| 30 | 4 | running time | `running_time_min` | uint32 | min | |",
        "| 24 | 01000000 | mos over temperature warning |",
        "| 2 | 00000004 | short circuit protection |",
        "| 8 | 128 | content | `content` | bytes | | |",
    ],
)
def test_the_document_has_the_fields_where_the_documents_have_them(line: str) -> None:
    assert line in messages_document.MESSAGES.read_text(encoding="utf-8").splitlines()
