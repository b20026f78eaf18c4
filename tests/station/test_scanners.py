"""Scanners that the station reads itself: no scan is lost, split, or another socket's."""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.station.board import Board
from flasher.station.config import ScannerConfig, load_config
from flasher.station.events import (
    OperatorPrompted,
    RunStarted,
    ScanAccepted,
    ScannerChanged,
    ScanRefused,
    SocketState,
    StationEvent,
)
from flasher.station.keys import LENGTH_MAX, PAUSE_S, KeyDecoder, ScanBuilder
from flasher.station.operators import Crew, Person, Role
from flasher.station.scanners import InputScanner, NoScanner, Reads, Scanner, input_device
from flasher.station.socket import Source
from tests.loops import each
from tests.station.factory import SERIAL, Bench
from tests.station.line_bench import LineBench
from tests.station.scanner_keys import KEYS
from tests.station.test_operators import PIN, REWORK, crew

ENTER, TAB, SHIFT, CAPS, CTRL = 28, 15, 42, 58, 29
SYN_REPORT, SYN_DROPPED = 0, 3
OTHER = "W2605003"


@dataclass
class KeyEvent:
    """As evdev has it."""

    type: int
    code: int
    value: int
    at_s: float = 0.0

    def timestamp(self) -> float:
        return self.at_s


def press(code: int, at_s: float = 0.0) -> Iterator[KeyEvent]:
    for value in (1, 0):
        yield KeyEvent(4, 4, code, at_s)  # MSC_SCAN, which keyboards send too
        yield KeyEvent(1, code, value, at_s)
        yield KeyEvent(0, SYN_REPORT, 0, at_s)


def typed(text: str, at_s: float = 0.0, end: int = ENTER) -> Iterator[KeyEvent]:
    """What a scanner sends for a text."""
    for char in text:
        code, has_shift = KEYS[char]
        if has_shift:
            yield KeyEvent(1, SHIFT, 1, at_s)
        yield from press(code, at_s)
        if has_shift:
            yield KeyEvent(1, SHIFT, 0, at_s)
    yield from press(end, at_s)


class Decoded:
    """A decoder, and what came out of it."""

    def __init__(self) -> None:
        self.scans: list[str] = []
        self.damaged = 0
        self.held: set[int] = set()
        self.builder = ScanBuilder(self.scans.append, self._damage)
        self.decoder = KeyDecoder(self.builder, lambda: self.held)

    def _damage(self) -> None:
        self.damaged += 1

    def feed(self, *events: KeyEvent) -> None:
        for event in events:
            self.decoder.feed(event.type, event.code, event.value, event.at_s)


@pytest.fixture
def decoded() -> Decoded:
    return Decoded()


# -- keys -----------------------------------------------------------------------------------------


def test_every_printable_character_of_ascii_is_typed(decoded: Decoded) -> None:
    text = "".join(map(chr, range(0x20, 0x7F)))
    decoded.feed(*typed(text))
    decoded.feed(*typed(text, end=TAB))
    decoded.feed(*typed(text, end=96))
    assert decoded.scans == [text] * 3


def test_caps_lock_turns_letters_and_nothing_else(decoded: Decoded) -> None:
    decoded.feed(*press(CAPS), *typed("aB1!"), *press(CAPS), *typed("aB1!"))
    assert decoded.scans == ["Ab1!", "aB1!"]


def test_what_is_typed_with_ctrl_is_no_text_and_repeats_are_none(decoded: Decoded) -> None:
    decoded.feed(KeyEvent(1, CTRL, 1), *press(KEYS["a"][0]), KeyEvent(1, CTRL, 0))
    decoded.feed(KeyEvent(1, KEYS["b"][0], 1), KeyEvent(1, KEYS["b"][0], 2), *press(ENTER))
    decoded.feed(*press(ENTER), *press(ENTER), *typed("  "))
    assert decoded.scans == ["b"]


def test_a_scan_without_its_end_is_not_put_before_the_next(decoded: Decoded) -> None:
    decoded.feed(*list(typed("W26", at_s=1.0))[:-6])
    decoded.feed(*typed("W2605002", at_s=1.0 + PAUSE_S + 0.1))
    assert (decoded.scans, decoded.damaged) == (["W2605002"], 1)


def test_an_end_that_comes_late_ends_nothing(decoded: Decoded) -> None:
    decoded.feed(*list(typed("W26", at_s=1.0))[:-6], *press(ENTER, 9.0), *typed("W2", at_s=10.0))
    assert (decoded.scans, decoded.damaged) == (["W2"], 1)


def test_what_is_too_long_is_damaged_and_ends(decoded: Decoded) -> None:
    decoded.feed(*typed("x" * (LENGTH_MAX + 1)), *typed("W2"))
    assert (decoded.scans, decoded.damaged) == (["W2"], 1)


def test_events_that_the_kernel_dropped_damage_one_scan_and_are_reported(decoded: Decoded) -> None:
    events = list(typed("W2605002"))
    decoded.feed(*events[:6], KeyEvent(0, SYN_DROPPED, 0), *events[20:])
    decoded.feed(*typed("W2605003"))
    assert (decoded.scans, decoded.damaged) == (["W2605003"], 1)


def test_the_shift_key_is_asked_for_after_a_drop(decoded: Decoded) -> None:
    decoded.feed(KeyEvent(1, SHIFT, 1), KeyEvent(0, SYN_DROPPED, 0), KeyEvent(1, SHIFT, 0))
    decoded.feed(KeyEvent(0, SYN_REPORT, 0), *press(ENTER), *typed("w2"))
    assert decoded.scans == ["w2"], "its release was dropped"
    decoded.held = {SHIFT}
    decoded.feed(KeyEvent(0, SYN_DROPPED, 0), KeyEvent(0, SYN_REPORT, 0), *press(ENTER))
    decoded.feed(*press(KEYS["w"][0]), *press(ENTER))
    assert decoded.scans[1:] == ["W"]


# -- a scanner that comes and goes ----------------------------------------------------------------


class FakeInput:
    """An input device of evdev: events through a pipe."""

    def __init__(self) -> None:
        self.fd, self._writer = os.pipe()
        self._events: list[KeyEvent] = []
        self.is_grabbed = self.is_gone = False

    def type(self, *events: KeyEvent) -> None:
        self._events += events
        os.write(self._writer, b"x")

    def unplug(self) -> None:
        self.is_gone = True
        os.write(self._writer, b"x")

    def grab(self) -> None:
        self.is_grabbed = True

    def active_keys(self) -> list[int]:
        return []

    def read(self) -> list[KeyEvent]:
        os.read(self.fd, 1)
        if self.is_gone:
            raise OSError(19, "No such device")
        events, self._events = self._events, []
        return events

    def close(self) -> None:
        os.close(self.fd)
        os.close(self._writer)


class Desk:
    """A scanner that a test plugs in and out; `socket`: where it is mounted."""

    def __init__(self, socket: str = "", name: str = "left") -> None:
        self.plugged: FakeInput | None = None
        self.reported: list[StationEvent] = []
        self.scans: list[tuple[str, str]] = []
        config = ScannerConfig(name=name, input="/dev/input/event7", socket=socket)
        self.scanner = Scanner(config, self._take, self.reported.append, self._open)

    def _take(self, text: str, source: Source) -> None:
        assert source.name == f"scanner {self.scanner.config.name}"
        self.scans.append((text, source.socket))

    def _open(self, builder: ScanBuilder) -> Reads:
        if self.plugged is None or self.plugged.is_gone:
            raise FileNotFoundError(2, "No such file or directory")
        return InputScanner(self.plugged, builder)

    def plug(self) -> FakeInput:
        self.plugged = FakeInput()
        assert self.scanner.step(0.0)
        return self.plugged


def test_a_scanner_is_taken_for_the_station_alone() -> None:
    desk = Desk()
    assert desk.plug().is_grabbed
    desk.scanner.close()


def test_a_scanner_that_is_missing_is_reported_once_and_opened_when_it_comes() -> None:
    desk = Desk()
    assert not desk.scanner.step(0.0)
    assert not desk.scanner.step(0.0)
    missing = ScannerChanged("left", is_ready=False, reason="No such file or directory")
    assert desk.reported == [missing]
    device = desk.plug()
    device.type(*typed("W2605002"))
    assert desk.scanner.step(0.0)
    assert desk.reported[1:] == [ScannerChanged("left", is_ready=True)]
    assert desk.scans == [("W2605002", "")]
    desk.scanner.close()


def test_an_unplugged_scanner_is_reported_and_its_half_scan_goes_nowhere() -> None:
    desk = Desk("A")
    device = desk.plug()
    device.type(*list(typed("W26"))[:-6])
    desk.scanner.step(0.0)
    device.unplug()
    assert not desk.scanner.step(0.0)
    assert not desk.scanner.step(0.0)
    gone = ScannerChanged("left", is_ready=False, reason="No such device")
    again = ScannerChanged("left", is_ready=False, reason="No such file or directory")
    assert [event for event in desk.reported[1:] if isinstance(event, ScannerChanged)] == [
        gone,
        again,
    ]
    refused = next(event for event in desk.reported if isinstance(event, ScanRefused))
    assert (refused.code, refused.socket) == ("DAMAGED", "A")
    desk.plug().type(*typed("W2605002"))
    desk.scanner.step(0.0)
    assert desk.scans == [("W2605002", "A")]
    desk.scanner.close()


def test_an_error_of_a_library_is_a_scanner_that_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk()
    device = desk.plug()

    def read() -> list[KeyEvent]:
        raise RuntimeError("Inappropriate ioctl")

    monkeypatch.setattr(device, "read", read)
    device.type()
    assert not desk.scanner.step(0.0)
    lost = ScannerChanged("left", is_ready=False, reason="Inappropriate ioctl")
    assert desk.reported[-1] == lost
    assert desk.plug().is_grabbed
    desk.scanner.close()


def test_a_lost_scanner_stays_on_the_screen_until_it_is_back() -> None:
    board = Board()
    board.apply(ScannerChanged("left", is_ready=False, reason="No such device"))
    assert (board.last_reply, board.is_refusal) == (
        "Scanner left cannot be read: No such device",
        True,
    )
    assert list(board.lost_scanners) == ["left"]
    board.apply(ScannerChanged("left", is_ready=True))
    assert (board.last_reply, board.is_refusal) == ("Scanner left is ready.", False)
    assert not board.lost_scanners


def test_500_scans_of_two_scanners_in_pieces() -> None:
    """None is lost, split, or the other socket's, however the events come."""
    chance = random.Random(5)
    desks = {name: Desk(name, name) for name in "AB"}
    wanted = {name: [f"{name}Z{at:05}-x" for at in range(250)] for name in desks}
    left = {n: [e for text in wanted[n] for e in typed(text)] for n in desks}
    devices = {name: desk.plug() for name, desk in desks.items()}
    while any(left.values()):
        name = chance.choice([name for name in left if left[name]])
        count = chance.randrange(1, 200)
        devices[name].type(*left[name][:count])
        del left[name][:count]
        if chance.random() < 0.7:
            desks[name].scanner.step(0.0)
    for name, desk in desks.items():
        while True:
            before = len(desk.scans)
            desk.scanner.step(0.0)
            if len(desk.scans) == before:
                break
        assert desk.scans == [(text, name) for text in wanted[name]]
        assert desk.reported == [ScannerChanged(name, is_ready=True)]
        desk.scanner.close()


# -- where it is ----------------------------------------------------------------------------------


def test_a_scanner_is_found_by_its_place_on_the_usb(tmp_path: Path) -> None:
    """Two interfaces of one scanner, of which one types; another keyboard in the next socket."""
    keyboard = "1000000000007 ff9f207ac14057ff febeffdfffefffff fffffffffffffffe"
    plugged = ((10, "1-1.4", keyboard), (2, "1-1.4", "40000 0"), (3, "1-1.2", keyboard))
    for number, place, keys in plugged:
        device = tmp_path / "devices" / "usb1" / place / f"{place}:1.0" / f"input{number}"
        (device / f"event{number}" / "device" / "capabilities").mkdir(parents=True)
        (device / f"event{number}" / "device" / "capabilities" / "key").write_text(keys + "\n")
        (tmp_path / "class").mkdir(exist_ok=True)
        (tmp_path / "class" / f"event{number}").symlink_to(device / f"event{number}")
    found = {"1-1.4": "event10", "1-1.2": "event3"}
    for place, name in found.items():
        config = ScannerConfig(name="left", usb_path=place)
        assert input_device(config, tmp_path / "class") == Path("/dev/input") / name
    with pytest.raises(NoScanner, match=r"No scanner is plugged in at 1-1\."):
        input_device(ScannerConfig(name="left", usb_path="1-1."), tmp_path / "class")


@pytest.mark.skipif(os.name == "nt", reason="terminals of POSIX")
def test_a_serial_scanner_in_pieces_and_unplugged() -> None:
    master, slave = os.openpty()
    reported: list[StationEvent] = []
    scans: list[tuple[str, str]] = []
    config = ScannerConfig(name="right", port=os.ttyname(slave), socket="B")
    scanner = Scanner(config, lambda text, at: scans.append((text, at.socket)), reported.append)
    assert scanner.step(0.0)
    for piece in (b"W26", b"05002\r", b"\nW2605003\r\nW26", b"05004\t"):
        os.write(master, piece)
        scanner.step(5.0)
    assert scans == [("W2605002", "B"), ("W2605003", "B"), ("W2605004", "B")]
    os.close(master)
    assert not scanner.step(0.0)
    assert [event.is_ready for event in reported if isinstance(event, ScannerChanged)] == [
        True,
        False,
    ]
    os.close(slave)
    assert not scanner.step(0.0), "it is not there"


SOCKETS = '[[socket]]\nname = "A"\nmock = {}\n'


@each(
    "text, why",
    [
        ('name = "x"', "input, usb_path and port"),
        ('name = "x"\ninput = "/dev/a"\nport = "/dev/b"', "input, usb_path and port"),
        ('name = "x"\ninput = "/dev/a"\nsocket = "B"', "names the unknown socket 'B'"),
        ('name = "x"\nport = "/dev/a"\nbaudrate = 1', "from 300"),
        (
            'name = "x"\nport = "/dev/a"\n[[scanner]]\nname = "y"\nport = "/dev/a"',
            "two scanners have the same place",
        ),
        (
            'name = "x"\nport = "/dev/a"\n[[scanner]]\nname = "x"\nport = "/dev/b"',
            "two scanners have the same name",
        ),
    ],
)
def test_what_is_wrong_with_a_scanner_is_reported(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "sockets.toml"
    path.write_text(f"[[scanner]]\n{text}\n{SOCKETS}", "utf-8")
    with pytest.raises(UsageError) as refused:
        load_config(path)
    assert why in f"{refused.value} {refused.value.faults}"


# -- a scanner that is mounted at a socket --------------------------------------------------------


@pytest.fixture
def line(bench: Bench) -> LineBench:
    return LineBench(bench)


def scanner_at(socket: str) -> Source:
    return Source(f"scanner {socket}", socket)


def mounted(line: LineBench, text: str, socket: str) -> None:
    line.station.submit(text, scanner_at(socket))
    line.turn()


def test_its_labels_are_for_its_socket(line: LineBench) -> None:
    mounted(line, SERIAL, "B")
    mounted(line, OTHER, "A")
    assert line.of(ScanAccepted) == [
        ScanAccepted(SERIAL, "label", "B", "scanner B"),
        ScanAccepted(OTHER, "label", "A", "scanner A"),
    ]
    assert line.of(OperatorPrompted) == [], "no socket is named"
    line.arrive("A")
    line.arrive("B")
    runs = {run.socket: run.serial for run in line.of(RunStarted)}
    assert runs == {"A": OTHER, "B": SERIAL}


def test_it_leaves_alone_what_waits_of_another_scanner(line: LineBench) -> None:
    line.scan("SOCKET A")
    mounted(line, OTHER, "B")
    line.scan(SERIAL)
    line.arrive("A")
    line.arrive("B")
    runs = {run.socket: run.serial for run in line.of(RunStarted)}
    assert runs == {"A": SERIAL, "B": OTHER}


def test_it_states_where_a_label_goes_that_waited_for_its_card(bench: Bench) -> None:
    line = LineBench(bench, are_empty=False)
    line.arrive("A")
    line.arrive("B")
    line.scan(SERIAL)
    assert not line.of(RunStarted)
    mounted(line, SERIAL, "B")
    assert [run.socket for run in line.of(RunStarted)] == ["B"]
    bench.clock.go_on(200.0)
    line.turn()
    assert line.of(ScanRefused) == []


def test_a_label_that_it_sees_again_begins_nothing(line: LineBench) -> None:
    mounted(line, SERIAL, "A")
    mounted(line, SERIAL, "A")
    assert line.last(ScanRefused).code == "DOUBLE_SCAN"
    assert line.state("A") is SocketState.SCAN
    line.arrive("A")
    mounted(line, SERIAL, "A")
    assert line.last(ScanRefused).code == "UNIT_RUNNING"
    assert len(line.of(RunStarted)) == 1


def test_a_unit_that_has_passed_has_to_leave_first(line: LineBench) -> None:
    line.make("A", SERIAL)
    mounted(line, OTHER, "A")
    assert line.last(ScanRefused).code == "TAKE_OUT"
    assert line.state("A") is SocketState.PASS


def test_cards_and_nonsense_mean_the_same_at_every_scanner(line: LineBench) -> None:
    mounted(line, "SOCKET B", "A")
    mounted(line, SERIAL, "A")
    line.arrive("B")
    assert line.last(RunStarted).socket == "B"
    mounted(line, "NONSENSE", "A")
    assert line.last(ScanRefused).code == "WRONG_SERIAL"


def test_its_labels_are_not_the_pin_that_somebody_types(bench: Bench) -> None:
    line = LineBench(bench, crew=crew())
    mounted(line, SERIAL, "A")
    assert line.last(ScanRefused).code == "NOBODY"
    line.scan(REWORK)
    line.scan("REASON x")
    mounted(line, SERIAL, "A")
    line.scan(PIN)
    accepted = [(event.text, event.socket) for event in line.of(ScanAccepted)]
    assert accepted == [("Rea", ""), (SERIAL, "A"), ("REASON x", "")]


@pytest.mark.slow
def test_500_labels_at_the_speed_of_a_scanner_go_where_they_belong(bench: Bench) -> None:
    """Every one is answered, in its order and for its socket."""
    person = Person(name="Jo", code="BADGE-1", role=Role.OPERATOR)
    line = LineBench(bench, "ABCD", crew=Crew([person]))
    line.scan("BADGE-1")
    chance, wanted = random.Random(7), []
    for at in range(500):
        wanted.append((f"W2605{at:03}", chance.choice("ABCD")))
        label, socket = wanted[-1]
        line.station.submit(label, scanner_at(socket))
    line.turn()
    reported = [
        (event.text, event.socket) for event in line.of(ScanAccepted) if event.meaning == "label"
    ]
    assert reported == wanted
    last = {socket: label for label, socket in wanted}
    assert {name: line.station.line.sockets[name].label for name in "ABCD"} == last
