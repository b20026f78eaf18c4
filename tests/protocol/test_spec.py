"""The facts of the documents, typed a second time from their tables."""

from __future__ import annotations

from typing import get_type_hints

import pytest
from pydantic import TypeAdapter, ValidationError

from flasher.errors import UsageError
from flasher.protocol import spec
from flasher.protocol.spec import Command, Mode, Node, Target, can_id
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from tests.loops import each


@each(
    "sender, receiver, expected",
    [
        (Node.CDL, Node.WMC, 0x751),
        (Node.CDL, Node.BMS, 0x752),
        (Node.CDL, Node.OBC, 0x753),
        (Node.CDL, Node.HMI, 0x754),
        (Node.WMC, Node.CDL, 0x715),
        (Node.BMS, Node.CDL, 0x725),
        (Node.OBC, Node.CDL, 0x735),
        (Node.HMI, Node.CDL, 0x745),
        (Node.WMC, None, 0x710),
        (Node.BMS, None, 0x720),
        (Node.OBC, None, 0x730),
        (Node.HMI, None, 0x740),
        (Node.CDL, None, 0x750),
        (Node.WMC, Node.BMS, 0x712),
        (Node.BMS, Node.WMC, 0x721),
        (Node.OBC, Node.BMS, 0x732),
        (Node.HMI, Node.BMS, 0x742),
    ],
)
def test_an_id_names_sender_and_receiver(
    sender: Node, receiver: Node | None, expected: int
) -> None:
    assert can_id(sender, receiver) == expected


@each(
    "target, name, request_id, answer_id, broadcast_id, update_text, boot_name",
    [
        (spec.WMC, "wmc", 0x751, 0x715, 0x710, "WMC_UPD", "WMC"),
        (spec.BMS, "bms", 0x752, 0x725, 0x720, "BMS_UPD", "BMS"),
        (spec.OBC, "obc", 0x753, 0x735, 0x730, "OBC_UPD", "PBU"),
    ],
)
def test_a_target_has_the_ids_and_texts_of_tables_8_and_9(
    target: Target,
    name: str,
    request_id: int,
    answer_id: int,
    broadcast_id: int,
    update_text: str,
    boot_name: str,
) -> None:
    assert target.name == name
    assert (target.request_id, target.answer_id) == (request_id, answer_id)
    assert target.broadcast_id == broadcast_id
    assert (target.update_text, target.boot_name) == (update_text, boot_name)


def test_only_the_bms_has_a_version_query() -> None:
    asked = [name for name, target in spec.TARGETS.items() if target.has_version_query]
    assert asked == ["bms"]


@each(
    "name, target",
    [
        ("wmc", spec.WMC),
        ("WMC", spec.WMC),
        ("mc", spec.WMC),
        ("Bms", spec.BMS),
        ("obc", spec.OBC),
        ("PBU", spec.OBC),
        ("hmi", None),
        ("cdl", None),
        ("", None),
    ],
)
def test_a_target_is_found_by_its_names_in_either_case(name: str, target: Target | None) -> None:
    assert spec.find_target(name) is target


def test_what_a_user_names_is_the_target_or_dialect_or_wrong_usage() -> None:
    assert spec.as_target("PBU") is spec.as_target(spec.OBC) is spec.OBC
    assert spec.as_dialect("Motinova") is spec.as_dialect(spec.MOTINOVA) is spec.MOTINOVA
    with pytest.raises(UsageError, match="no target 'hmi'; targets are wmc, bms, obc"):
        spec.as_target("hmi")
    with pytest.raises(UsageError, match="no dialect 'can'; dialects are welling, motinova"):
        spec.as_dialect("can")


@each(
    "command, code, size_bytes",
    [
        (Command.RESET, 0x4205, 5),
        (Command.GENERAL_FEEDBACK, 0x5503, 3),
        (Command.BOOT_VERSION, 0xC109, 9),
        (Command.UPDATE, 0xA10B, 11),
        (Command.REQUEST_TRANSFER, 0xC402, 2),
        (Command.PACKET, 0xA385, 133),
        (Command.ACK, 0xC202, 2),
        (Command.NAK, 0xC302, 2),
        (Command.END_OF_TRANSFER, 0xA401, 1),
        (Command.COMPLETE, 0xC502, 2),
        (Command.READ_VERSION, 0x3300, 0),
        (Command.VERSION_INFORMATION, 0x1540, 64),
    ],
)
def test_a_command_names_the_size_of_its_data(command: Command, code: int, size_bytes: int) -> None:
    assert command == code
    assert spec.data_size(command) == size_bytes


def test_the_list_of_commands_above_is_complete() -> None:
    assert len(Command) == 12


def test_modes_and_frame_of_a_message_are_the_documents() -> None:
    assert (Mode.READ, Mode.WRITE, Mode.REPORT) == (0x11, 0x16, 0x0C)
    assert (spec.HEADER, spec.TAIL) == (b"\x55\xaa", b"\xf0")
    assert (spec.LENGTH_MIN, spec.LENGTH_MAX) == (2, 255)
    assert (spec.OVERHEAD_SIZE + spec.LENGTH_MIN, spec.MESSAGE_MAX_SIZE) == (11, 264)
    assert spec.FRAME_DATA_SIZE == 8
    assert spec.FRAMES_PER_PACKET == 18


def test_the_upgrade_has_the_documents_constants() -> None:
    assert (spec.PACKET_START, spec.END_OF_TRANSFER_MARK) == (0x01, 0x04)
    assert (spec.PACKET_DATA_SIZE, spec.PACKET_FILLER) == (128, 0xFF)
    assert spec.PACKET_COUNT_MAX == 65535
    assert spec.IMAGE_MAX_SIZE == 8388480
    assert spec.BOOT_VERSION_BURST == 4


@each(
    "size_bytes, packets",
    [
        (0, 0),
        (1, 1),
        (127, 1),
        (128, 1),
        (129, 2),
        (256, 2),
        (257, 3),
        (78351, 613),
        (8388352, 65534),
        (8388353, 65535),
        (8388480, 65535),
        (8388481, 65536),
    ],
)
def test_an_image_takes_as_many_packets_as_its_bytes_need(size_bytes: int, packets: int) -> None:
    assert spec.packet_count(size_bytes) == packets


def test_the_welling_dialect_upgrades_at_250_kbit_without_hmi() -> None:
    assert spec.DIALECTS["welling"] is spec.WELLING
    assert (spec.WELLING.version, spec.WELLING.bitrate_bps) == ("V1.0.0", 250_000)
    assert spec.WELLING.has_upgrade
    assert spec.WELLING.nodes == (Node.WMC, Node.BMS, Node.OBC, Node.CDL)


def test_the_motinova_dialect_knows_the_hmi_at_125_kbit_and_cancelled_the_upgrade() -> None:
    assert spec.DIALECTS["motinova"] is spec.MOTINOVA
    assert (spec.MOTINOVA.version, spec.MOTINOVA.bitrate_bps) == ("V2.7.1", 125_000)
    assert not spec.MOTINOVA.has_upgrade
    assert spec.MOTINOVA.nodes == (Node.WMC, Node.BMS, Node.OBC, Node.HMI, Node.CDL)


def test_the_default_timings_are_the_documents_and_r12s() -> None:
    timings = DEFAULT_TIMINGS
    assert (timings.command_repeat_s, timings.command_timeout_s) == (0.2, 1.0)
    assert timings.boot_version_spacing_s == 0.05
    assert timings.inter_frame_timeout_s == 0.1
    assert timings.boot_version_timeout_s == 5.0
    assert timings.request_transfer_timeout_s == 10.0
    assert (timings.ack_timeout_s, timings.packet_tries) == (0.5, 5)
    assert (timings.complete_timeout_s, timings.end_tries) == (10.0, 3)
    assert (timings.update_spacing_s, timings.leftover_boot_version_s) == (0.03, 0.06)
    assert timings.quiet_after_repeat_s == 0.05
    assert (timings.announcing_on_s, timings.application_start_timeout_s) == (1.0, 5.0)


@each(
    "name, allowed, refused",
    [
        ("ack_timeout_s", (0.001, 3600), (0, -1, 3600.1)),
        ("update_spacing_s", (0, 3600), (-0.001, 3600.1)),
        ("packet_tries", (1, 1000), (0, 1001)),
    ],
)
def test_a_profile_may_set_a_timing_within_its_bounds(
    name: str, allowed: tuple[float, ...], refused: tuple[float, ...]
) -> None:
    adapter: TypeAdapter[float] = TypeAdapter(get_type_hints(Timings, include_extras=True)[name])
    for value in allowed:
        assert adapter.validate_python(value) == value
    for value in refused:
        with pytest.raises(ValidationError):
            adapter.validate_python(value)
