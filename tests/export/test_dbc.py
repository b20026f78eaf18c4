"""The DBC in cantools: it loads, and gives the numbers and flags that flasher decodes."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import can
import cantools
import pytest
from cantools.database.can import Database

from flasher.export.dbc import FD_SIZE, dbc, joined
from flasher.export.names import key
from flasher.protocol import catalogue, messages
from flasher.protocol.fields import Content, FlagsField, NumberField, NumberListField, flag_names
from flasher.protocol.spec import BMS
from flasher.protocol.wire import Message, encode
from tests.cli.conftest import Flasher
from tests.trace.tape import Tape


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Database:
    path = tmp_path_factory.mktemp("dbc") / "welling.dbc"
    path.write_bytes(dbc().encode("cp1252"))
    loaded = cantools.database.load_file(path)
    assert isinstance(loaded, Database)
    return loaded


def _decoded(database: Database, message: Message) -> dict[str, object]:
    frame = joined(message, 0.0)
    assert frame.is_fd
    assert len(frame.data) == FD_SIZE
    decoded = database.decode_message(frame.arbitration_id, bytes(frame.data), decode_choices=False)
    assert isinstance(decoded, dict)
    found: dict[str, object] = {**decoded}
    wire = encode(message)
    assert found.pop("mode") == wire[2]
    assert found.pop("length") == wire[3]
    assert found.pop("command") == message.command
    return found


def _sayable(title: str, content: Content) -> Iterator[tuple[str, int, int]]:
    """Name, value and end of each value that is a number or a flag."""
    at = 6
    for name, codec in content.LAYOUT:
        value, whole = getattr(content, name), f"{key(title)}_{name}"
        at += codec.size_bytes
        match codec:
            case NumberField():
                yield whole, value, at
            case NumberListField():
                yield from ((f"{whole}_{n}", each, at) for n, each in enumerate(value, 1))
            case FlagsField():
                set_flags = flag_names(codec.names, value)
                for flag in codec.names:
                    (text,) = flag_names(codec.names, flag)
                    yield f"{whole}_{key(text)}", int(text in set_flags), at


@pytest.mark.parametrize("item", catalogue.ITEMS, ids=lambda item: item.name)
def test_every_message_is_decoded_as_flasher_decodes_it(
    database: Database, item: catalogue.Item
) -> None:
    chance = random.Random(item.command)
    size = item.content.SIZE_BYTES
    for data in (bytes(size), b"\xff" * size, *(chance.randbytes(size) for _ in range(5))):
        content = item.content.from_data(data)
        expected = {name: value for name, value, end in _sayable(item.title, content) if end <= 64}
        message = Message(item.can_id, item.mode, item.command, data)
        assert _decoded(database, message) == expected


@pytest.mark.parametrize(
    ("row", "can_id", "expected"),
    [
        (messages.Packet(17, 613, bytes(128)), BMS.request_id,
         {"packet_number": 17, "packet_total": 613}),
        (messages.Ack(300), BMS.answer_id, {"ack_number": 300}),
        (messages.Nak(300), BMS.answer_id, {"nak_number": 300}),
        (messages.UpdateCommand("BMS_UPD", 2**32 - 1), BMS.request_id,
         {"update_command_size_bytes": 2**32 - 1}),
        (messages.Complete(), BMS.answer_id, {}),
    ],
)  # fmt: skip
def test_messages_of_the_upgrade_are_decoded(
    database: Database, row: messages.UpgradeMessage, can_id: int, expected: dict[str, int]
) -> None:
    assert _decoded(database, row.to_message(can_id)) == expected


def test_signals_have_the_units_of_the_fields(database: Database) -> None:
    signals = {
        signal.name: signal.unit for message in database.messages for signal in message.signals
    }
    for item in catalogue.ITEMS:
        for name, codec in item.content.LAYOUT:
            whole = f"{key(item.title)}_{name}"
            if isinstance(codec, NumberField) and whole in signals:
                assert (signals[whole] or "") == codec.unit
    assert signals["running_information_cell_temperature_c"] == "°C"
    assert all(message.is_fd for message in database.messages)


def test_names_are_short_enough_and_each_there_once() -> None:
    declared = [line.split()[1] for line in dbc().splitlines() if line.startswith(" SG_ ")]
    own = [name for name in declared if name not in ("mode", "length", "command")]
    assert max(map(len, own)) == 32
    assert len(set(own)) >= 60


def test_what_it_cannot_state_is_named_in_it() -> None:
    assert 'CM_ "' in dbc()
    assert "Left out is what a DBC cannot say: texts" in dbc()


def test_a_joined_trace_has_a_frame_a_message(
    database: Database, flasher: Flasher, tmp_path: Path
) -> None:
    trace = Tape().to_packet(4).damaged_packet(4).nak(4).save(tmp_path / "trace.blf")
    for suffix in (".asc", ".blf", ".log", ".pcapng"):
        path = tmp_path / f"joined{suffix}"
        assert flasher("export", "trace", trace, "--joined", "-o", path).code == 0
    for suffix in (".asc", ".blf", ".log"):
        with can.LogReader(tmp_path / f"joined{suffix}") as reader:
            frames = list(reader)
        assert len(frames) == 12
        assert all(frame.is_fd for frame in frames)
        last = database.decode_message(0x725, bytes(frames[-1].data))
        assert isinstance(last, dict)
        assert last["nak_number"] == 4
    # flasher reads classic CAN alone: these are no frames of the bus.
    assert flasher("explain", tmp_path / "joined.pcapng").out.startswith(
        f"{tmp_path / 'joined.pcapng'}: 0 frames"
    )


def test_the_command_writes_it_for_programs_of_windows(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "welling.dbc"
    assert flasher("export", "dbc", "-o", path).code == 0
    assert path.read_bytes() == dbc().encode("cp1252")
    assert flasher("export", "dbc").out == dbc()
