"""What Wireshark shows with the exported dissector is what flasher decodes.

Every case is a stretch of one capture, with a pause between them, so that tshark starts twice in
all: once for each dialect.
"""

from __future__ import annotations

import json
import random
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from flasher.export.names import key
from flasher.protocol import catalogue, messages
from flasher.protocol.fields import Codec, ConstantField, FlagsField, NumberListField
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, DIALECTS, HEADER, TARGETS, Dialect, Mode
from flasher.protocol.text import printable
from flasher.protocol.wire import Message, encode, split
from flasher.trace.decoder import ROUTES, TITLES, BusEvent, Decoder, Kind, message_titles
from flasher.trace.explain import explain
from flasher.trace.recorder import message_of, writer_of
from flasher.trace.story import Cause, Story
from tests.export.tshark import Item, items, needs_tshark, run, write_capture
from tests.peers.wording import payloads
from tests.trace.tape import Tape

Frames = list[tuple[float, Frame]]

START_S: Final = 1_700_000_000.0
FRAME_S: Final = 0.0005
PAUSE_S: Final = 0.3
VECTORS: Final = Path(__file__).parents[1] / "vectors.json"

pytestmark = [needs_tshark, pytest.mark.slow]


class Reel:
    """Frames, each a moment after the one before."""

    def __init__(self) -> None:
        self.frames: Frames = []
        self.now = START_S

    def add(self, *frames: Frame) -> None:
        for frame in frames:
            self.now += FRAME_S
            self.frames.append((round(self.now, 6), frame))

    def message(self, message: Message) -> None:
        self.add(*split(message.can_id, encode(message)))

    def pause(self) -> None:
        self.now += PAUSE_S


def catalogue_messages(reel: Reel, chance: random.Random) -> None:
    """Every message of chapter 3: zeros, ones, as written by people, anything; and a wrong mode."""
    for item in catalogue.ITEMS:
        size = item.content.SIZE_BYTES
        text = b"Vr\xe9\x1b[2J.\n " * 20
        for data in (bytes(size), b"\xff" * size, text[:size], *(chance.randbytes(size),) * 3):
            reel.message(Message(item.can_id, item.mode, item.command, data))
        for mode in {*Mode, 0x00} - {item.mode}:
            reel.message(Message(item.can_id, mode, item.command, bytes(size)))


def upgrade_messages(reel: Reel, chance: random.Random) -> None:
    """Every message of the upgrade, both ways, for each target, right and with each byte wrong."""
    rows: list[messages.UpgradeMessage] = [
        messages.ResetCommand(), messages.GeneralFeedbackMessage(),
        messages.BootVersion("PBU", "V1.2.3"),
        messages.BootVersion("\xff\x1b[", "2J\n\0.\xe9"), messages.RequestTransfer(),
        messages.Packet(1, 613, bytes(range(128))), messages.Packet(65535, 65535, bytes(128)),
        messages.Ack(300), messages.Nak(1), messages.Ack(0), messages.EndOfTransfer(),
        messages.Complete(),
        *(messages.UpdateCommand(each.update_text, 78351) for each in TARGETS.values()),
    ]  # fmt: skip
    for target in TARGETS.values():
        for row in rows:
            for can_id in (target.request_id, target.answer_id):
                message = row.to_message(can_id)
                reel.message(message)
                reel.message(message._replace(mode=Mode.READ))
                for at in range(min(len(message.data), 6)):
                    data = bytearray(message.data)
                    data[at] ^= chance.choice((1, 0xFF, data[at]))
                    reel.message(message._replace(data=bytes(data)))
        reel.pause()


def _unknown(reel: Reel) -> None:
    """What no document has, on every id; and frames of others between."""
    for can_id in ROUTES:
        reel.message(Message(can_id, 0x0C, 0x7703, b"\x00ab"))
        reel.message(messages.Ack(3).to_message(can_id))
        reel.add(Frame(0x100, b"\x55\xaa\x0c"), Frame(can_id, b""))
        reel.add(Frame(can_id, b"\x55\xaa", is_extended=True), Frame(can_id, b"", is_remote=True))


def _vectors(reel: Reel) -> None:
    for vector in json.loads(VECTORS.read_text(encoding="utf-8"))["vectors"]:
        for payload in vector["can_frames"]:
            reel.add(Frame(int(vector["can_id"], 16), bytes.fromhex(payload)))


def damaged(reel: Reel, chance: random.Random, *, count: int) -> None:
    """Messages of several senders among each other, cut, doubled, with wrong bytes and pauses."""
    ids = [0x720, 0x725, 0x752, 0x732]
    waiting: list[list[Frame]] = []
    for _ in range(count):
        item = chance.choice([each for each in catalogue.ITEMS if each.can_id in ids])
        data = chance.choice((chance.randbytes(item.content.SIZE_BYTES),
                              (b"\x55\xaa" * 70)[: item.content.SIZE_BYTES]))  # fmt: skip
        wire = bytearray(encode(Message(item.can_id, item.mode, item.command, data)))
        for _ in range(chance.choice((0, 0, 0, 1, 2))):
            wire[chance.randrange(len(wire))] ^= 1 << chance.randrange(8)
        if chance.random() < 0.1:
            wire = wire[: chance.randrange(1, len(wire))]
        frames = split(item.can_id, bytes(wire))
        if chance.random() < 0.2:
            del frames[chance.randrange(len(frames))]
        if chance.random() < 0.1:
            frames.insert(chance.randrange(len(frames) + 1), Frame(item.can_id, b"\x55"))
        waiting.append(frames)
        while len(waiting) > chance.randrange(4):
            frames = chance.choice(waiting)
            if frames:
                reel.add(frames.pop(0))
            else:
                waiting.remove(frames)
        if chance.random() < 0.1:
            reel.pause()


def _reel() -> Reel:
    chance = random.Random(15)
    reel = Reel()
    packet = messages.Packet(7, 9, chance.randbytes(128)).to_message(0x752)
    reel.add(*split(0x752, encode(packet))[5:])  # as of a capture that begins in the middle
    catalogue_messages(reel, chance)
    reel.pause()
    upgrade_messages(reel, chance)
    _unknown(reel)
    reel.pause()
    _vectors(reel)
    damaged(reel, chance, count=600)
    reel.pause()
    reel.message(messages.Ack(1).to_message(0x725))  # so that everything before is over
    return reel


REEL: Final = _reel()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("wireshark")


@pytest.fixture(scope="module")
def capture(folder: Path) -> Path:
    return write_capture(folder / "reel.pcapng", REEL.frames)


def decoded(reel: Reel, dialect: Dialect) -> Iterator[tuple[int, BusEvent]]:
    """What flasher decodes, with the number of the frame at which it shows."""
    decoder = Decoder(dialect=dialect)
    late: list[BusEvent] = []
    for number, (now, frame) in enumerate(reel.frames, 1):
        while (due := decoder.deadline()) is not None and due < now:
            late += decoder.tick(due)
        found = [each for each in decoder.feed(frame, now) if each.kind is not Kind.FOREIGN]
        if frame.is_payload and frame.can_id in ROUTES:
            yield from ((number, event) for event in (*late, *found))
            late = []


def expected_of(event: BusEvent) -> list[tuple[str, str]]:
    """Filter names and values."""
    if event.kind is Kind.DAMAGED:
        reason, raw = event.fields
        return [("damage", reason.value), ("damage.bytes", raw.value)]
    if event.kind is not Kind.MESSAGE:
        held = {field.name: field.value for field in event.fields}
        data = [("data", held["data"])] if held["data"] else []
        return [("mode", str(held["mode"])), ("command", str(int(held["command"], 16))), *data]
    codecs, own = _layout(event)
    found = []
    for field in event.fields:
        name = own.get(field.name, f"{key(event.title)}.{field.name}")
        codec = codecs[field.name]
        match codec:
            case ConstantField():
                text = printable(bytes.fromhex(field.value).decode("latin-1"))
                found.append((name, text))
            case NumberListField():
                found += [(name, str(value)) for value in field.value]
            case FlagsField():
                found += [(f"{name}.{key(bit)}", "set") for bit in field.value]
            case _:
                found.append((name, str(field.value)))
    return found


def _layout(event: BusEvent) -> tuple[dict[str, Codec], dict[str, str]]:
    item = catalogue.BY_KEY.get((event.can_id, event.command or 0))
    if item is not None:
        return dict(item.content.LAYOUT), {}
    row = next(row for row, title in TITLES.items() if title == event.title)
    return dict(row.LAYOUT), {"number": "packet", "total": "packets"}


_AROUND: Final = {
    "kind", "message", "sender", "receiver", "length", "crc", "crc.ok", "crc.expected",
    "in_dialect", "problem", "begin", "frames", "upgrade", "attempt", "copy", "answer_to",
    "answer_in", "answer_ms",
}  # fmt: skip


def shown(item: Item) -> list[tuple[str, str]]:
    """Filter names and values, without those of every message."""
    kind = item.one("kind")
    found = []
    flags = {name: codec for row in catalogue.ITEMS for name, codec in row.content.LAYOUT
             if isinstance(codec, FlagsField)}  # fmt: skip
    for field in item.fields:
        name = field.name.removeprefix("welling.")
        if not field.name.startswith("welling.") or name in _AROUND or name.startswith("expert"):
            continue
        last = name.rpartition(".")[2]
        is_number = field.show.startswith("0x")
        if kind == "message" and name in ("mode", "command"):
            continue
        if kind == "message" and name.count(".") == 1 and last in flags:
            continue
        if name.count(".") == 2:
            if field.show in ("1", "True"):
                found.append((name, "set"))
        elif is_number:
            found.append((name, str(int(field.show, 16))))
        elif field.show.replace(":", "") == field.value:
            found.append((name, field.value))
        else:
            found.append((name, field.show))
    return found


@pytest.mark.parametrize("dialect", DIALECTS.values(), ids=lambda dialect: dialect.name)
def test_every_message_and_every_damage_is_what_flasher_decodes(
    dialect: Dialect, capture: Path, folder: Path
) -> None:
    found = list(items(capture, folder, "-o", f"welling.dialect:{dialect.name}"))
    expected = list(decoded(REEL, dialect))
    for item, (number, event) in zip(found, expected, strict=False):
        where = (number, event)
        assert item.frame == number, (where, item)
        assert item.one("kind") == event.kind.value, where
        assert item.one("message") == event.title, where
        assert (item.one("sender"), item.one("receiver")) == (event.sender, event.receiver)
        assert shown(item) == expected_of(event), where
        if event.kind is not Kind.DAMAGED:
            assert item.one("crc.ok") in ("1", "True"), where
            assert (item.one("in_dialect") in ("1", "True")) == event.in_dialect, where
        for unit in {field.unit for field in event.fields if field.unit}:
            assert any(unit in field.text for field in item.fields), where
    assert len(found) == len(expected)
    assert {event.title for _, event in expected} >= set(message_titles())
    assert sum(event.kind is Kind.DAMAGED for _, event in expected) > 200


def test_what_candump_writes_is_read_as_well(capture: Path, folder: Path) -> None:
    """A `.log` that flasher records is one that Wireshark knows for a capture."""
    log = folder / "reel.log"
    writer = writer_of(log)
    for at, frame in REEL.frames:
        writer(message_of(frame, sent=True, at_s=at))
    writer.stop()
    words = ("-Y", "welling.message", "-T", "fields", "-e", "frame.number", "-e", "welling.message")
    printed = run("-r", log, *words, folder=folder)
    assert printed == run("-r", capture, *words, folder=folder)
    assert len(printed.splitlines()) > 1000


# -- the course of an upgrade ---------------------------------------------------------------------


def _stories() -> dict[str, Tape]:
    """Upgrades that go well and wrong, each as a trace of its own."""
    return {
        "from the middle": _from(Tape().to_end().complete(), 75),
        "clean": Tape().to_end().wait(0.01).complete(),
        "nak and repetition": Tape().to_packet(4).damaged_packet(4).nak(4).packet(4).wait(0.6)
        .packet(4).wait(0.002).ack(4).packets(5, 10).end().nak(0).end().complete(),
        "restart": Tape("wmc").to_packet(3).wait(0.1).boot().boot().update().request()
        .packets(1, 10).end().complete(),
        "twice": Tape().to_end().complete().wait(1).to_end().complete(),
        "two tools": Tape().to_packet(5).reset().packets(5, 6),
        "a query between": Tape().to_packet(5).tool(0x3300, b"", mode=0x11).packets(5, 6),
        "an old packet again": Tape().to_packet(5).packet(5).wait(0.01).ack(5).packet(6).packet(2),
        "accepted at once": _accepted(Tape().to_end().complete()),
        "a message in a message": _interleaved(),
    }  # fmt: skip


def _from(tape: Tape, frame: int) -> Tape:
    del tape.frames[:frame]
    return tape


def _accepted(tape: Tape) -> Tape:
    """As a recorder of one's own stamps: all frames of a message when the adapter takes it."""
    begun = 0.0
    for at, (now, frame) in enumerate(tape.frames):
        begun = now if frame.data.startswith(HEADER) else begun
        is_own = frame.can_id == BMS.request_id
        tape.frames[at] = (begun if is_own else now, frame)
    tape.frames.sort(key=lambda timed: timed[0])
    return tape


def _interleaved() -> Tape:
    tape = Tape().to_packet(3)
    packet = [Frame(0x752, payload) for payload in payloads(tape.packet_wire(3, 10, b""))]
    for frame in packet[:7]:
        tape.frame(frame)
    tape.reset()
    for frame in packet[7:]:
        tape.frame(frame)
    return tape


STORIES: Final = _stories()


@pytest.fixture(scope="module")
def printed(folder: Path) -> dict[str, list[Item]]:
    """What tshark says of each story: all in one capture, with a minute between them."""
    frames: Frames = []
    first: dict[str, int] = {}
    for number, (name, tape) in enumerate(STORIES.items()):
        first[name] = len(frames)
        frames += [(round(at + 60 * number, 6), frame) for at, frame in tape.frames]
    capture = write_capture(folder / "stories.pcapng", frames)
    found = list(items(capture, folder))
    ends = [*list(first.values())[1:], len(frames)]
    return {
        name: [item for item in found if begin < item.frame <= end]
        for (name, begin), end in zip(first.items(), ends, strict=True)
    }


def _explained(name: str) -> Story:
    return explain(iter(STORIES[name]), source=name)


def _packets(of: list[Item]) -> dict[tuple[int, int], tuple[int, list[float]]]:
    """Copies and answer times in ms of each packet, by attempt and number."""
    found: dict[tuple[int, int], tuple[int, list[float]]] = {}
    for item in of:
        if item.one("message") not in ("packet", "ACK") or not item.all("upgrade"):
            continue
        at = int(item.one("attempt")), int(item.one("packet"))
        copies, answers = found.get(at, (0, []))
        found[at] = (
            max(copies, *map(int, item.all("copy")), 0),
            answers + [float(each) for each in item.all("answer_ms")],
        )
    return found


@pytest.mark.parametrize(
    "name",
    [
        "clean",
        "nak and repetition",
        "restart",
        "from the middle",
        "accepted at once",
    ],
)
def test_packets_copies_and_answer_times_are_those_of_the_story(
    name: str, printed: dict[str, list[Item]]
) -> None:
    (upgrade,) = _explained(name).upgrades
    found = _packets(printed[name])
    assert len(found) == len(upgrade.packets) >= 6
    for packet in upgrade.packets:
        copies, answers = found[packet.attempt, packet.number]
        assert copies == packet.tries, packet
        assert answers[:1] == pytest.approx(
            [] if packet.answer_s is None else [1000 * packet.answer_s], abs=0.05
        ), packet


def test_every_upgrade_has_a_number_of_its_own(printed: dict[str, list[Item]]) -> None:
    numbers = {
        name: {each for item in printed[name] for each in item.all("upgrade")} for name in printed
    }
    assert [len(each) for each in numbers.values()] == [
        len(_explained(name).upgrades) for name in numbers
    ]
    assert len(set.union(*numbers.values())) == sum(map(len, numbers.values()))


def _experts(of: list[Item]) -> set[str]:
    return {
        field.name.removeprefix("welling.expert.")
        for item in of
        for field in item.fields
        if field.name.startswith("welling.expert.")
    }


def test_what_went_wrong_is_an_expert_information(printed: dict[str, list[Item]]) -> None:
    assert _experts(printed["clean"]) == set()
    assert _experts(printed["nak and repetition"]) == {"crc", "nak", "repeated"}


@pytest.mark.parametrize("name", STORIES)
def test_a_second_tool_is_found_where_explain_finds_one(
    name: str, printed: dict[str, list[Item]]
) -> None:
    is_foreign = any(
        each.verdict.cause is Cause.SECOND_TOOL or any("not explained" in of for of in each.remarks)
        for each in _explained(name).upgrades
    )
    assert ("foreign_tool" in _experts(printed[name])) == is_foreign


def test_two_buses_in_one_capture_are_two(folder: Path) -> None:
    """The same id on two interfaces, frame by frame in turn."""
    captures = []
    for number in (1, 2):
        message = messages.Packet(number, 9, bytes([number]) * 128).to_message(0x752)
        frames = [
            (START_S + at / 1000 + number / 4000, frame)
            for at, frame in enumerate(split(0x752, encode(message)))
        ]
        captures.append(write_capture(folder / f"bus{number}.pcapng", frames))
    both = folder / "buses.pcapng"
    subprocess.run(["mergecap", "-I", "none", "-w", both, *captures], check=True)
    found = list(items(both, folder))
    assert [(item.one("message"), item.one("packet")) for item in found] == [
        ("packet", "1"),
        ("packet", "2"),
    ]
    assert [item.one("upgrade") for item in found] == ["1", "2"]
