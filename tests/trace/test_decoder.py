"""Frames in, decoded messages out: both chapters, damage and what is not ours."""

from __future__ import annotations

import json
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flasher.protocol.frame import Frame
from flasher.trace.decoder import BusEvent, Decoder, Kind, message_titles
from tests.loops import each
from tests.peers.wording import READ, REPORT, WORDINGS, WRITE, literal
from tests.trace import traffic


def decoded(frames: Iterable[Frame]) -> list[BusEvent]:
    decoder = Decoder()
    return [seen for frame in frames for seen in decoder.feed(frame, 1.0)]


def only(frames: Iterable[Frame]) -> BusEvent:
    (seen,) = decoded(frames)
    return seen


def texts(seen: BusEvent) -> dict[str, str]:
    return {shown.label: f"{shown.text} {shown.unit}".rstrip() for shown in seen.fields}


def test_running_information_has_its_route_fields_and_units() -> None:
    seen = only(traffic.running())
    assert (seen.kind, seen.title, seen.at) == (Kind.MESSAGE, "running information", 1.0)
    assert (seen.can_id, seen.command, seen.sender, seen.receiver) == (0x720, 0x1010, "BMS", "all")
    assert texts(seen) == {
        "voltage": "36000 mV",
        "mean current": "-1000 mA",
        "remaining capacity": "9000 mAh",
        "full-charge capacity": "10400 mAh",
        "cell temperature": "25 °C",
        "state of charge": "80 %",
        "status": "charger connected",
        "state of health": "98 %",
    }
    assert not seen.is_trouble


def test_values_are_typed_and_their_names_carry_the_units() -> None:
    values = {shown.name: shown.value for shown in only(traffic.running()).fields}
    assert values["voltage_mv"] == 36000
    assert values["mean_current_ma"] == -1000
    assert values["status"] == ["charger connected"]
    assert json.loads(json.dumps(values)) == values


@each(
    "raw, text",
    [
        (0, "0 % (or an older device, which does not know it)"),
        (1, "1"),
        (100, "100"),
        (101, "101 % (more than the document allows)"),
        (255, "255 % (more than the document allows)"),
    ],
)
def test_a_state_of_health_is_shown_as_received_and_remarked_on(raw: int, text: str) -> None:
    """R22."""
    data = traffic.RUNNING_DATA[:11] + bytes([raw, 0, 0, 0, 0])
    health = only(traffic.running(data)).fields[-1]
    assert (health.value, health.text) == (raw, text)
    assert health.unit == ("" if "%" in text else "%")


def test_reserved_bytes_are_shown_only_when_they_are_not_zero() -> None:
    data = traffic.RUNNING_DATA[:12] + b"\x00\x00\x00\x07"
    assert texts(only(traffic.running(data)))["reserved"] == "00 00 00 07"


@each(
    "target, attribute, title, fields",
    [
        ("bms", "reset", "reset", {"text": "RESET"}),
        ("wmc", "reset", "reset", {}),
        ("wmc", "feedback", "general feedback", {}),
        ("bms", "boot_version", "boot version", {"name": "BMS", "version": "V1.2.3"}),
        ("obc", "boot_version", "boot version", {"name": "PBU", "version": "V1.2.3"}),
        ("bms", "update_78351", "update command", {"text": "BMS_UPD", "size": "78351 B"}),
        ("wmc", "request", "request transfer", {}),
        ("obc", "ack_1", "ACK", {"number": "1"}),
        ("bms", "nak_1", "NAK", {"number": "1"}),
        ("wmc", "end", "end of transfer", {}),
        ("bms", "complete", "complete", {}),
    ],
)
def test_the_upgrade_is_decoded_on_every_targets_ids(
    target: str, attribute: str, title: str, fields: dict[str, str]
) -> None:
    words = WORDINGS[target]
    from_tool = attribute in ("reset", "update_78351", "end")
    can_id = words.to_device if from_tool else words.to_tool
    seen = only(Frame(can_id, payload) for payload in literal(getattr(words, attribute)))
    assert (seen.kind, seen.title) == (Kind.MESSAGE, title)
    assert texts(seen) == fields
    route = ("CDL", target.upper()) if from_tool else (target.upper(), "CDL")
    assert (seen.sender, seen.receiver) == route


def test_a_packet_shows_its_number_its_total_and_its_bytes() -> None:
    data = b"\x01\x02\x00\x05\x00" + bytes(range(128))
    seen = only(traffic.frames(0x752, WRITE, 0xA385, data))
    assert seen.title == "packet"
    assert [shown.value for shown in seen.fields[:2]] == [2, 5]
    assert seen.fields[2].text.startswith("00 01 02 03")


def test_messages_of_several_senders_interleave() -> None:
    pairs = zip(traffic.running()[:3], traffic.handshake()[:3], strict=True)
    mixed = [frame for pair in pairs for frame in pair]
    mixed += traffic.running()[3:] + traffic.handshake()[3:]
    assert [seen.title for seen in decoded(mixed)] == ["handshake", "running information"]


def test_a_nak_and_faults_that_are_set_are_trouble() -> None:
    assert only(traffic.nak()).is_trouble
    set_faults = only(traffic.faults(bytes.fromhex("00400200")))
    assert set_faults.is_trouble
    assert texts(set_faults)["faults"] == "AFE fault, discharge under voltage warning"
    assert not only(traffic.faults(bytes(4))).is_trouble


def test_an_unknown_command_is_shown_with_its_bytes() -> None:
    seen = only(traffic.frames(0x720, REPORT, 0x7702, b"\xab\xcd"))
    assert seen.kind is Kind.UNKNOWN
    assert texts(seen) == {"command": "7702", "mode": "0C", "data": "ab cd"}
    assert seen.is_trouble


@each(
    "can_id, mode, command, data, problem",
    [
        (0x720, READ, 0x1010, bytes(16), "mode is 11, not 0C"),
        (0x725, WRITE, 0xC202, b"\x01\x00", "mode is 16, not 0C"),
        (0x725, REPORT, 0xC402, b"\x00\x01", "data are 00 01, not 00 00"),
    ],
)
def test_a_message_that_breaks_its_row_states_how(
    can_id: int, mode: int, command: int, data: bytes, problem: str
) -> None:
    seen = only(traffic.frames(can_id, mode, command, data))
    assert seen.kind is Kind.MALFORMED
    assert texts(seen)["problem"] == problem
    assert seen.is_trouble


def test_a_message_of_the_upgrade_in_the_wrong_direction_is_unknown() -> None:
    """An ACK that the tool sends: no row has it, whatever its form."""
    assert only(traffic.frames(0x752, REPORT, 0xC202, b"\x01\x00")).kind is Kind.UNKNOWN


def test_an_upgrade_message_between_devices_is_unknown() -> None:
    assert only(traffic.frames(0x712, WRITE, 0xA401, b"\x04")).kind is Kind.UNKNOWN


def test_a_wrong_crc_is_damage_with_its_bytes() -> None:
    frames = traffic.faults(bytes(4))
    data = bytearray(frames[0].data)
    data[7] ^= 1
    seen = decoded([Frame(0x720, bytes(data)), *frames[1:]])[0]
    assert seen.kind is Kind.DAMAGED
    assert texts(seen)["reason"] == "wrong CRC"
    assert (seen.sender, seen.receiver, seen.is_trouble) == ("BMS", "all", True)


def test_a_message_cut_short_is_reported_when_its_time_is_over() -> None:
    decoder = Decoder()
    assert list(decoder.feed(traffic.running()[0], 1.0)) == []
    assert decoder.deadline() == pytest.approx(1.1)
    assert list(decoder.tick(1.05)) == []
    (seen,) = decoder.tick(1.2)
    assert texts(seen)["reason"] == "the rest of the message did not come in time"
    assert decoder.deadline() is None


@each(
    "frame, kind",
    [
        (Frame(0x123, b"abc"), Kind.FOREIGN),
        (Frame(0x722, b"\x55\xaa"), Kind.FOREIGN),
        (Frame(0x720, b"abc", is_extended=True), Kind.FOREIGN),
        (Frame(0x720, b"", is_remote=True), Kind.FOREIGN),
        (Frame(0x720, b""), Kind.FOREIGN),
        (Frame(0x20000004, bytes(8), is_error=True), Kind.ERROR_FRAME),
    ],
)
def test_what_no_node_sends_has_its_own_kind(frame: Frame, kind: Kind) -> None:
    seen = only([frame])
    assert seen.kind is kind
    assert seen.is_trouble is (kind is Kind.ERROR_FRAME)


def test_an_extended_id_is_not_taken_for_a_node() -> None:
    seen = only([Frame(0x720, b"abc", is_extended=True)])
    assert (seen.sender, texts(seen)["identifier"]) == ("", "29 bits")


def test_device_text_is_harmless() -> None:
    hostile = b"\x1b[2J\x07\xff".ljust(16, b"\x00") + b"[red].".ljust(16) + bytes(32)
    seen = only(traffic.frames(0x720, REPORT, 0x1540, hostile))
    assert all(shown.text.isascii() and shown.text.isprintable() for shown in seen.fields)
    boot = only(traffic.frames(0x725, REPORT, 0xC109, b"\x1b[2\nV1.0\x00"))
    assert all(shown.text.isascii() and shown.text.isprintable() for shown in boot.fields)


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(st.sampled_from([0x710, 0x720, 0x725, 0x752, 0x123]), st.binary(max_size=8)),
        max_size=60,
    )
)
def test_nothing_on_the_bus_raises_and_everything_is_harmless(
    traffic_: list[tuple[int, bytes]],
) -> None:
    decoder = Decoder()
    seen = [s for can_id, data in traffic_ for s in decoder.feed(Frame(can_id, data), 0.0)]
    seen += decoder.tick(1.0)
    for found in seen:
        json.dumps({shown.name: shown.value for shown in found.fields})
        assert all(shown.text.replace("°", "").isascii() for shown in found.fields)
        assert all(shown.text.isprintable() for shown in found.fields)


def test_every_title_is_listed_once() -> None:
    titles = message_titles()
    assert len(titles) == len(set(titles))
    assert {"running information", "boot version", "NAK", "write serial number"} <= set(titles)
