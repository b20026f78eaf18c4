"""What a station's views show: the board made of events, the table, keys, files of scans."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from argon2 import PasswordHasher
from rich.console import Console

from flasher.cli.documents import to_json
from flasher.cli.output import Output
from flasher.cli.station.documents import LINES
from flasher.cli.station.run import _Session
from flasher.cli.station.scans import LineReader, ScanFile, Typing
from flasher.cli.station.views import Lines, Table, draw
from flasher.documents import SCHEMA_VERSION
from flasher.errors import UsageError
from flasher.station.board import Board
from flasher.station.events import (
    FiguresChanged,
    LabelPrinted,
    LineStopped,
    OperatorPrompted,
    Progressed,
    RecipeChanged,
    RunStarted,
    ScanAccepted,
    ScanRefused,
    SocketChanged,
    SocketState,
    StationEvent,
    StationStarted,
    StepStarted,
    UnitArrived,
    WorkerFailed,
)
from flasher.station.records.model import Figures, RunId, RunKind, RunRecord, RunState, StepName
from flasher.station.socket import Occupancy, Socket
from tests.cli.conftest import Flasher
from tests.cli.station_threads import ThreadPort
from tests.cli.test_schema import hold
from tests.cli.test_schema import sample as sample_of
from tests.cli.test_station import FAST, WRITE
from tests.loops import each
from tests.schema_document import SCHEMA
from tests.station.factory import USUAL, write_recipe
from tests.station.line_inputs import RECORD, saved

FIGURES = Figures(3, 2, 1, 3, {RunState.PASS: 2, RunState.FAIL: 1}, {"REFUSED": 1}, 4.8, 5.5)


def ended(
    outcome: RunState = RunState.FAIL, code: str = "REFUSED", serial: str = "W2"
) -> Iterator[StationEvent]:
    text = "No. Put it aside."
    yield saved("1", outcome, "Put it aside.", code=code, serial=serial, text=text)
    yield SocketChanged("1", SocketState(outcome.value), serial, "Put it aside.")


def board_of(*more: StationEvent, sockets: int = 4) -> Board:
    board = Board()
    names = tuple(str(number + 1) for number in range(sockets))
    started = StationStarted("line-2", "Battery [b]", "4", "BAT-36", names, ())
    states = (SocketChanged(name, SocketState.EMPTY) for name in names)
    for event in (started, *states, *more):
        board.apply(event)
    return board


def drawn(board: Board, *, width: int = 80, height: int = 24, typed: str = "") -> list[str]:
    console = Console(width=width, height=height, file=io.StringIO(), color_system=None)
    with console.capture() as capture:
        console.print(draw(board, console, typed))
    return capture.get().splitlines()


# -- the table -------------------------------------------------------------------------------------


def test_a_row_shows_socket_state_serial_number_step_percent_and_time_left() -> None:
    board = board_of(
        SocketChanged("2", SocketState.RUNNING, "W2605002"),
        StepStarted("2", "W2605002", StepName.FLASH, 2, "bms"),
        Progressed("2", "W2605002", StepName.FLASH, 0.419, 61.6, "bms"),
    )
    (row,) = [line for line in drawn(board) if "W2605002" in line]
    assert row.split() == [
        "2",
        "RUNNING",
        "W2605002",
        "flash",
        "bms",
        "try",
        "2",
        "41",
        "%",
        "62",
        "s",
    ]


def test_a_fail_shows_its_code_and_what_to_do_until_the_unit_is_out() -> None:
    board = board_of(*ended())
    lines = drawn(board)
    at = next(number for number, line in enumerate(lines) if "FAIL" in line)
    assert lines[at].split() == ["1", "FAIL", "W2", "REFUSED"]
    assert lines[at + 1].strip() == "Put it aside."
    assert "Put it aside." in next(line for line in drawn(board, width=160) if "FAIL" in line)
    board.apply(SocketChanged("1", SocketState.EMPTY))
    assert not any("REFUSED" in line or "aside" in line for line in drawn(board))


def test_every_state_is_a_colour_and_a_word() -> None:
    console = Console(width=80, height=24, file=io.StringIO(), color_system="standard",
                      force_terminal=True)  # fmt: skip
    plain = {}
    for state in SocketState:
        board = board_of(SocketChanged("1", state, "W2"), sockets=1)
        with console.capture() as capture:
            console.print(draw(board, console))
        (row,) = [line for line in capture.get().splitlines() if "W2" in line]
        assert state.value in row
        plain[state] = row.partition(state.value)[0]
    assert plain[SocketState.PASS] != plain[SocketState.FAIL]


def test_totals_stand_below_with_first_pass_yield_and_failures_by_cause() -> None:
    text = "\n".join(drawn(board_of(FiguresChanged(FIGURES))))
    assert "3 units: 2 passed, 1 failed; yield 66.6 %, first pass 33.3 %; median 4.80 s" in text
    assert "REFUSED 1" in text


def test_a_stopped_line_a_refused_scan_and_what_is_typed_are_shown() -> None:
    board = board_of(
        ScanRefused("X", "WRONG_SERIAL", "It is none.", "Scan the label."),
        LineStopped("RECORD_NOT_SAVED", "The disk is full.", "Make room."),
    )
    text = "\n".join(drawn(board, typed="W26", width=120))
    assert "LINE STOPPED  RECORD_NOT_SAVED: The disk is full. Make room. Then scan RESUME." in text
    assert "X: It is none. Scan the label." in text
    assert "scan> W26_" in text


def test_what_is_shown_comes_escaped_and_is_no_markup() -> None:
    board = board_of(ScanAccepted("[red]\x1b[2J", "label"), OperatorPrompted("1", "a\x1bb"))
    text = "\n".join(drawn(board))
    assert "\x1b" not in text
    assert "[red]" in text
    assert "Battery [b]" in text


@pytest.mark.slow
@each("width", [40, 60, 80, 120, 200])
@each("height", [12, 24, 60])
@each("sockets", [1, 4, 16, 64])
def test_it_never_exceeds_the_window(width: int, height: int, sockets: int) -> None:
    board = board_of(*ended(serial="W" * 64), FiguresChanged(FIGURES), sockets=sockets)
    board.apply(LineStopped("X", "Y " * 80, "Z"))
    board.apply(ScanRefused("X" * 64, "CODE", "why " * 60, "remedy"))
    lines = drawn(board, width=width, height=height)
    assert len(lines) <= height
    assert all(len(line) <= width for line in lines)


def test_rows_do_not_move_while_states_change() -> None:
    before = [line[:2] for line in drawn(board_of())]
    after = [line[:2] for line in drawn(board_of(*ended()))]
    assert [line for line in after[:10] if line.strip()] == [
        line for line in before[:10] if line.strip()
    ]


# -- the board -------------------------------------------------------------------------------------


def test_the_last_run_of_a_unit_counts() -> None:
    board = board_of(*ended(), *ended(RunState.PASS, "OK"), *ended(serial="W3"))
    assert [each.serial for each in board.bad_units] == ["W3"]


def test_labels_without_a_socket_wait_until_their_run_begins() -> None:
    board = board_of(ScanAccepted("W2", "label"), ScanAccepted("W3", "label"))
    assert set(board.waiting) == {"W2", "W3"}
    board.apply(RunStarted("1", "W2", RunId(1), RunKind.PRODUCTION))
    assert set(board.waiting) == {"W3"}
    board.apply(ScanAccepted("CANCEL", "cancel"))
    assert not board.waiting


def test_what_to_do_with_a_label_comes_after_it() -> None:
    board = board_of(OperatorPrompted("", "Scan the socket."), ScanAccepted("W2", "label"))
    assert board.last_reply == "W2: label. Scan the socket."
    board.apply(ScanAccepted("SOCKET 1", "socket", "1"))
    assert board.last_reply == "SOCKET 1: socket"


def test_the_label_of_a_virtual_unit_is_shown_to_be_typed() -> None:
    board = board_of(
        UnitArrived("1", "it came", "W7"),
        SocketChanged("1", SocketState.SCAN, "", "Scan it."),
        sockets=64,
    )
    for height in (12, 60):  # also where there is no room for what to do
        assert any("W7" in line for line in drawn(board, width=60, height=height))


def test_what_to_do_for_a_stopped_line_is_never_cut_off() -> None:
    stop = LineStopped("RECORD_NOT_SAVED", "The disk is full, " * 20, "Make room on this disk.")
    for width in (40, 80):
        text = " ".join(" ".join(drawn(board_of(stop), width=width, height=24)).split())
        assert "Make room on this disk. Then scan RESUME." in text


def test_a_socket_that_is_not_started_again_is_broken() -> None:
    board = board_of(WorkerFailed("1", "it ended", 1.0))
    assert not board.broken
    board.apply(WorkerFailed("1", "the recipe changed", None))  # type: ignore[arg-type, unused-ignore]
    assert board.broken == {"1": "the recipe changed"}
    board.apply(RecipeChanged("1", "Battery 36 V", "5", "BP", "ab" * 32))
    assert not board.broken, "its process is started with the other recipe"


# -- keys and files --------------------------------------------------------------------------------


def test_keys_become_scans() -> None:
    scans: list[str] = []
    typing = Typing(scans.append)
    typing.feed("W26x\x7f05")
    assert typing.text == "W2605"
    typing.feed("\x1b[A002\r\n\n  \nRES\x15RESUME\n")
    assert scans == ["W2605002", "RESUME"]
    assert typing.text == ""


def test_a_pipe_is_read_to_its_end() -> None:
    scans: list[str] = []
    reader = LineReader(io.StringIO("W2\n\nRESUME\n"), scans.append)
    reader.read()
    assert reader.is_at_end
    assert [scan.strip() for scan in scans] == ["W2", "RESUME"]


def socket_view(name: str, *, is_there: bool = True, sees_units: bool = True) -> Socket:
    occupancy = Occupancy.THERE if is_there else Occupancy.EMPTY
    return Socket(name, out_of_service=None, sees_units=sees_units, occupancy=occupancy)


def worked_off(
    scans: list[str],
    sockets: list[Socket],
    borne: dict[str, str],
    exchanged: Collection[str] = (),
    turns: int = 1,
) -> list[str]:
    """What is submitted in so many turns."""
    submitted: list[str] = []
    file = ScanFile(scans, [socket.name for socket in sockets], submitted.append)
    for _ in range(turns):
        file.turn(sockets, borne, exchanged)
    return submitted


def test_a_label_goes_to_the_next_socket_in_which_a_unit_waits() -> None:
    lines = [socket_view("A", is_there=False), socket_view("B")]
    assert worked_off(["W1", "W2"], lines, {}) == ["SOCKET B", "W1"]
    assert worked_off(["W1"], lines[:1], {}) == []


def test_a_label_goes_to_the_socket_that_is_named_before_it() -> None:
    lines = [socket_view("A", is_there=False), socket_view("B")]
    assert worked_off(["socket a", "W1"], lines, {}) == []
    assert worked_off(["SOCKET B", "W1"], lines, {}) == ["SOCKET B", "W1"]


def test_a_virtual_unit_gets_its_own_label() -> None:
    lines = [socket_view("A"), socket_view("B")]
    assert worked_off(["W1", "W2"], lines[1:], {"A": "W1", "B": "W2"}) == ["SOCKET B", "W2"]
    assert worked_off(["W1", "W2"], lines, {"A": "V1", "B": "V2"}) == ["SOCKET A", "W1"]


def test_a_virtual_unit_that_was_exchanged_in_its_run_is_scanned_when_it_comes_back() -> None:
    lines = [socket_view("A", is_there=False), socket_view("B")]
    assert worked_off(["W2"], lines, {"B": "W1"}, {"W1"}) == ["SOCKET B", "W1"]
    refused = worked_off(["W2"], lines, {"B": "W1"}, {"W1"}, turns=9)
    assert refused == ["SOCKET B", "W1"] * 3 + ["SOCKET B", "W2"], "not without end"


def test_commands_keep_their_place_between_labels() -> None:
    lines = [socket_view("A")]
    assert worked_off(["LOT 7", "W1"], lines, {}) == ["LOT 7"]
    assert worked_off(["W1", "LOT 7", "W2"], lines, {"A": "W2"}) == ["SOCKET A", "W1"]


def test_sockets_that_see_no_units_take_no_file() -> None:
    blind = socket_view("A", sees_units=False)
    with pytest.raises(UsageError, match="can detect whether"):
        worked_off(["W1"], [blind], {})


# -- the whole, on a terminal ----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="terminals of POSIX")
def test_on_a_terminal_the_table_is_refreshed_and_the_summary_stays(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    master, slave = os.openpty()
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    for name, value in {"TERM": "xterm-256color", "COLUMNS": "100", "LINES": "30"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", ThreadPort)
    monkeypatch.setattr("flasher.cli.station.views.REFRESH_S", 0.0)
    recipe = write_recipe(tmp_path, USUAL + WRITE)
    words = ("--mock-sockets", "2", "--units", "2", "--mock-bad", "0", *FAST)
    with os.fdopen(slave, "r") as keys:
        monkeypatch.setattr(sys, "stdin", keys)
        monkeypatch.setattr(sys, "stdout", screen)
        os.write(master, b"NONSENSE\n")
        run = flasher("station", "run", "--recipe", recipe, *words)
    os.close(master)
    assert run.code == 0
    shown, _, behind = screen.getvalue().rpartition("\x1b[?1049l")
    assert "\x1b[?1049h" in shown
    assert "RUNNING" in shown
    assert "PASS" in shown
    assert "NONSENSE" in shown, "what is typed is a scan"
    assert "2 units: 2 passed, 0 failed; yield 100 %" in behind


def test_lines_answer_who_asks_for_a_label_again(capsys: pytest.CaptureFixture[str]) -> None:
    view = Lines(Output())
    for is_reprint in (False, True):
        view(LabelPrinted("", "W2605002", is_reprint))
    assert capsys.readouterr().out.split(maxsplit=1)[1:] == ["The label of W2605002 was printed.\n"]


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="terminals of POSIX")
@pytest.mark.parametrize("more", [(), ("--lines",)])
def test_a_pin_is_not_shown_on_the_terminal(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, more: tuple[str, ...]
) -> None:
    master, slave = os.openpty()
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", ThreadPort)
    monkeypatch.setattr("flasher.cli.station.views.REFRESH_S", 0.0)
    badges = tmp_path / "badges.toml"
    pin = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1).hash("470815")
    person = f'name = "Sue"\ncode = "BADGE-1"\nrole = "supervisor"\npin = "{pin}"\n'
    badges.write_text(f"[[person]]\n{person}", "utf-8")
    script: list[tuple[Callable[[_Session], bool], bytes]] = [
        (lambda _: True, b"BADGE-1\n"),
        (lambda session: "badge" in session.view.board.last_reply, b"REASON x\n"),
        (lambda session: bool(session.view.board.pin_of), b"4708"),
        (lambda session: session.view.typed == "****", b"15\n"),
    ]

    def turn(session: _Session) -> None:
        """Each is typed when the one before was understood."""
        real_turn(session)
        if script and script[0][0](session):
            os.write(master, script.pop(0)[1])
        if session.view.board.last_reply == "REASON x: reason":
            session.station.stop()

    real_turn = _Session.turn
    monkeypatch.setattr(_Session, "turn", turn)
    recipe = write_recipe(tmp_path, USUAL + WRITE)
    words = ("--mock-sockets", "1", "--badges", badges, "--mock-bad", "0", *FAST, *more)
    with os.fdopen(slave, "r") as keys:
        monkeypatch.setattr(sys, "stdin", keys)
        monkeypatch.setattr(sys, "stdout", screen)
        flasher("station", "run", "--recipe", recipe, *words)
        echoed = b""
        os.set_blocking(master, False)
        with suppress(BlockingIOError):
            echoed = os.read(master, 4096)
    os.close(master)
    assert not script
    assert "4708" not in screen.getvalue()
    assert b"4708" not in echoed


# -- JSON ------------------------------------------------------------------------------------------


def sample(hint: Any) -> Any:
    """A value of the type that a field of a station's event has."""
    hint = getattr(hint, "__supertype__", hint)
    if hint is Figures:
        return FIGURES
    if hint is RunRecord:
        return RECORD
    if hint is bool:
        return True
    options = get_args(hint)
    if type(None) in options:
        return None
    if options and Ellipsis in options:
        return (sample(options[0]),) * 2
    return tuple(map(sample, options)) if options else sample_of(hint)


@pytest.mark.slow
@each("event", LINES)
def test_every_event_is_as_described(event: Any) -> None:
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    made = event(**{name: sample(hint) for name, hint in get_type_hints(event).items()})
    line = {"schema": SCHEMA_VERSION, **to_json(made)}
    hold(schema, f"line.{event.__name__}", json.loads(json.dumps(line)))


# -- what must not be taken for something else -----------------------------------------------------


def test_virtual_units_are_named_in_the_title_and_beside_their_pass() -> None:
    board = Board()
    board.apply(StationStarted("line-2", "Battery", "4", "P", ("1", "2"), (), ("2",)))
    for name in ("1", "2"):
        board.apply(SocketChanged(name, SocketState.PASS, f"W{name}"))
    lines = drawn(board)
    assert lines[0].startswith("VIRTUAL UNITS in 2, no products. line-2")
    assert [line.split()[1:] for line in lines if "PASS" in line] == [
        ["PASS", "W1"],
        ["PASS", "W2", "virtual", "unit"],
    ]


def test_saving_is_drawn_before_the_disk_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    view = Table(Output(), now=lambda: 0.0)
    drawn_states: list[SocketState] = []

    def update(*_args: object, **_more: object) -> None:
        drawn_states.extend(row.state for row in view.board.rows.values())

    monkeypatch.setattr(view._live, "update", update)
    view(StationStarted("line-2", "Battery", "4", "P", ("1",), ()))
    view(SocketChanged("1", SocketState.RUNNING, "W1"))
    view(SocketChanged("1", SocketState.SAVING, "W1"))
    assert drawn_states[-1] is SocketState.SAVING
