"""The station: scans, sockets, claims, outcomes; and nothing is shown before it is saved."""

from __future__ import annotations

import sqlite3
from typing import Any, NoReturn

import pytest
from sqlalchemy import event

from flasher.errors import UsageError
from flasher.station.events import (
    LineResumed,
    LineStopped,
    OperatorPrompted,
    RecordNotSaved,
    RunEnded,
    RunStarted,
    ScanAccepted,
    ScanRefused,
    SocketChanged,
    SocketState,
    StepEnded,
    UnitArrived,
    UnitRemoved,
    WorkerFailed,
)
from flasher.station.line import IDENTIFY_S, REACH_S, READ_S
from flasher.station.messages import (
    AdapterDown,
    AdapterReady,
    Beat,
    JournalWrite,
    PresenceChanged,
    Stop,
    flash_value,
)
from flasher.station.records.errors import (
    DiskFullError,
    RecordsDamagedError,
    RecordsLockedError,
)
from flasher.station.records.model import (
    Measurement,
    RunId,
    RunKind,
    RunResult,
    RunState,
    StepName,
    UnitState,
    Verified,
    WriteId,
)
from flasher.station.records.queries import Records
from tests.station.factory import SERIAL, USUAL, Bench
from tests.station.line_bench import LineBench, tried

OTHER = "W2605003"
THIRD = "W2605004"


@pytest.fixture
def line(bench: Bench) -> LineBench:
    return LineBench(bench)


# -- a unit's way ---------------------------------------------------------------------------------


def test_a_unit_is_scanned_connected_run_and_shown(line: LineBench) -> None:
    line.scan(SERIAL)
    assert line.last(OperatorPrompted).text == f"Put {SERIAL} into socket A."
    line.arrive("A")
    assert line.state("A") is SocketState.RUNNING
    assert line.order("A").serial == SERIAL
    line.work("A")
    line.end("A")
    ended = line.last(RunEnded)
    assert (ended.run.state, ended.run.code) == (RunState.PASS, "OK")
    assert ended.action == "Take the unit out."
    assert line.state("A") is SocketState.PASS
    run = line.bench.store.read.run(ended.run.run_id)
    assert (run.run, run.targets) == (ended.run, ended.targets)
    assert [step.name for step in run.steps] == ["flash bms", "save"]
    assert line.bench.store.examine().problems == ()


def test_pass_is_on_disk_before_it_is_shown(line: LineBench, bench: Bench) -> None:
    """The very moment: a second look at the file, by somebody else, when the event comes."""
    found: list[str] = []

    def look(event: object) -> None:
        shows = isinstance(event, SocketChanged) and event.state is SocketState.PASS
        if shows or isinstance(event, RunEnded):
            with bench.outsider() as other:
                found.extend(row[0] for row in other.execute("SELECT state FROM run"))

    line.station._on_event = look
    line.make("A", SERIAL)
    assert found == ["PASS", "PASS"]


def test_the_unit_before_the_label_works_as_well(line: LineBench) -> None:
    line.arrive("B")
    assert line.state("B") is SocketState.SCAN
    line.scan(SERIAL)
    assert line.state("B") is SocketState.SCAN, "it may be the label of a unit on the table"
    line.scan("SOCKET B")
    assert line.state("B") is SocketState.RUNNING


def test_a_finished_unit_is_not_begun_again_and_its_removal_makes_room(line: LineBench) -> None:
    line.make("A", SERIAL)
    line.turn()
    line.arrive("A")
    assert line.state("A") is SocketState.PASS
    line.leave("A")
    assert line.state("A") is SocketState.EMPTY
    assert line.of(UnitRemoved) == [UnitRemoved("A")]


def test_the_next_label_waits_until_the_finished_unit_is_out(line: LineBench) -> None:
    line.make("A", SERIAL)
    line.scan("SOCKET A")
    assert line.last(ScanRefused).code == "TAKE_OUT"
    assert line.state("A") is SocketState.PASS
    line.leave("A")
    line.scan("SOCKET A")
    line.scan(OTHER)
    line.arrive("A")
    assert line.order("A").serial == OTHER


def test_steps_are_reported_when_they_are_saved(line: LineBench) -> None:
    line.make("A", SERIAL)
    assert [step.step for step in line.of(StepEnded)] == ["flash"]


def test_a_unit_that_failed_may_be_scanned_again_where_it_is(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.end("A", RunState.FAIL, "NO_ANSWER")
    assert line.state("A") is SocketState.FAIL
    line.scan(SERIAL)
    assert "If it is still there, scan SOCKET A" in line.last(OperatorPrompted).text
    line.scan("SOCKET A")
    assert line.state("A") is SocketState.RUNNING


def test_a_unit_that_has_just_passed_is_not_scanned_again(line: LineBench) -> None:
    line.make("A", SERIAL)
    line.scan(SERIAL)
    assert line.last(ScanRefused).code == "JUST_PASSED"


# -- which socket ---------------------------------------------------------------------------------


def test_two_waiting_units_need_a_chosen_socket(line: LineBench) -> None:
    line.arrive("A")
    line.arrive("B")
    line.scan(SERIAL)
    asked = f"Scan the card of the socket that {SERIAL} is in, or goes into."
    assert line.last(OperatorPrompted).text == asked
    line.scan("socket b")
    assert line.order("B").serial == SERIAL
    assert line.state("A") is SocketState.SCAN


def test_a_label_that_is_scanned_while_sockets_start_goes_to_no_unit(bench: Bench) -> None:
    """Two units wait, only the label of B's is scanned: the first one to be detected is A's."""
    line = LineBench(bench, are_empty=False)
    line.scan(OTHER)
    refused = line.last(ScanRefused)
    assert refused.code == "STARTING"
    line.arrive("A")
    line.arrive("B")
    assert line.of(RunStarted) == []
    line.scan("SOCKET B")
    line.scan(OTHER)
    assert line.order("B").serial == OTHER


def test_silence_is_no_empty_socket(bench: Bench) -> None:
    """A unit that sleeps in A would take the label of one that is still on the table."""
    line = LineBench(bench, are_empty=False)
    for socket in "AB":
        line.fall_silent(socket)
        assert line.state(socket) is SocketState.SILENT
    line.scan(SERIAL)
    assert line.last(OperatorPrompted).text.startswith("Scan the card of the socket")
    line.arrive("A")
    assert line.of(RunStarted) == []


def test_a_unit_that_states_its_own_number_needs_no_card(line: LineBench) -> None:
    line.arrive("A")
    line.arrive("B", OTHER)
    line.scan(OTHER)
    assert line.order("B").serial == OTHER


def test_a_unit_in_another_socket_than_named_is_not_begun(line: LineBench) -> None:
    line.scan(SERIAL)
    assert line.last(OperatorPrompted).text == f"Put {SERIAL} into socket A."
    line.arrive("B")
    reported = line.last(OperatorPrompted)
    assert reported.socket == "B"
    assert reported.text.startswith(f"Wrong socket: {SERIAL} goes into socket A.")
    assert line.of(RunStarted) == []
    line.scan("SOCKET B")
    line.scan(SERIAL)
    assert line.order("B").serial == SERIAL, "what the message says is accepted"


def test_another_unit_in_the_named_socket_is_not_begun(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A", OTHER)
    assert line.of(RunStarted) == []
    assert line.text("A").startswith(f"The unit in it reports {OTHER}.")
    line.leave("A")
    line.arrive("A", SERIAL)
    assert line.last(RunStarted).serial == SERIAL


def test_a_label_is_dropped_when_the_unit_that_came_to_its_named_socket_is_exchanged(
    line: LineBench,
) -> None:
    line.scan(SERIAL)
    line.bench.clock.go_on(3.0)
    for number in (1, 2):  # the second one announces itself before the first one has answered
        came = PresenceChanged(is_there=True, how="boot version", is_power_up=True, number=number)
        line.say("A", came)
    line.say("A", PresenceChanged(is_there=True, how="traffic", serial="", number=3))
    assert line.of(RunStarted) == []
    assert line.last(ScanRefused).code == "UNIT_CHANGED"
    line.scan("CANCEL")
    assert line.last(ScanRefused).code == "UNIT_CHANGED"


def test_a_label_is_dropped_when_the_unit_that_came_to_its_named_socket_leaves(
    line: LineBench,
) -> None:
    line.scan(SERIAL)
    line.bench.clock.go_on(3.0)
    line.say("A", PresenceChanged(is_there=True, how="boot version", is_power_up=True, number=1))
    line.fall_silent("A")
    assert line.last(ScanRefused).code == "FORGOTTEN"
    line.arrive("A")
    assert line.of(RunStarted) == []


def test_a_unit_that_was_there_before_its_socket_was_named_is_not_begun(line: LineBench) -> None:
    line.scan(SERIAL)
    line.say("A", PresenceChanged(is_there=True, how="traffic", serial=""))
    assert line.last(ScanRefused).code == "FORGOTTEN"
    assert line.of(RunStarted) == []


@pytest.mark.parametrize(
    ("unobserved_s", "refusals"),
    [(0.0, []), (0.9, []), (1.1, ["NOT_OBSERVED"]), (4.0, ["NOT_OBSERVED"])],
)
def test_a_unit_that_came_unobserved_may_have_been_there_before_its_socket_was_named(
    line: LineBench, unobserved_s: float, refusals: list[str]
) -> None:
    line.scan(SERIAL)
    line.bench.clock.go_on(REACH_S + 1.0)
    came = PresenceChanged(is_there=True, how="traffic", serial="", unobserved_s=unobserved_s)
    line.say("A", came)
    assert [each.code for each in line.of(ScanRefused)] == refusals
    line.bench.clock.go_on(IDENTIFY_S)
    line.turn()
    assert len(line.of(RunStarted)) == (not refusals)


def test_a_unit_that_does_not_identify_itself_needs_the_card_of_its_socket(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A", None)
    line.bench.clock.go_on(2.9)
    line.turn()
    assert line.of(ScanRefused) == []
    line.bench.clock.go_on(0.1)
    line.turn()
    refused = line.last(ScanRefused)
    assert (refused.text, refused.code, refused.socket) == (SERIAL, "NOT_IDENTIFIED", "A")
    assert refused.remedy == "Scan SOCKET A, then the label."
    assert line.of(RunStarted) == []
    line.scan("SOCKET A")
    line.scan(SERIAL)
    assert line.last(RunStarted).serial == SERIAL


def test_a_label_without_its_unit_is_forgotten(line: LineBench) -> None:
    line.scan(SERIAL)
    for _ in range(13):  # processes beat meanwhile
        line.bench.clock.go_on(9.5)
        for port in line.ports.values():
            port.reported.append(Beat())
        line.turn()
    assert line.last(ScanRefused).code == "FORGOTTEN"
    line.arrive("A")
    assert line.of(RunStarted) == []


@pytest.mark.parametrize("are_read_late", [False, True])
@pytest.mark.parametrize("is_exchanged", [False, True])
@pytest.mark.parametrize("sockets", ["A", "AB"])
def test_scans_that_waited_while_their_unit_was_exchanged_are_refused(
    bench: Bench, sockets: str, is_exchanged: bool, are_read_late: bool
) -> None:
    """The station stalls, because of its disk or as a whole: scans and reports come at
    once.
    """
    line = LineBench(bench, sockets)
    line.arrive("A")
    line.station.timer = bench.clock.monotonic_s
    line.turn()
    scans = (["SOCKET A"] if len(sockets) > 1 else []) + [SERIAL]
    for scan in () if are_read_late else scans:
        line.station.submit(scan)
    bench.clock.go_on(3.0)
    if is_exchanged:
        line.ports["A"].reported += [
            PresenceChanged(is_there=False, number=1),
            PresenceChanged(is_there=True, how="traffic", serial="", number=2),
        ]
    line.turn()
    bench.clock.go_on(0.1)
    for scan in scans if are_read_late else ():
        line.scan(scan)
    refused = [(event.text, event.code) for event in line.of(ScanRefused)]
    assert bool(line.of(RunStarted)) != is_exchanged
    if is_exchanged:
        assert refused[0] == (scans[0], "NOT_OBSERVED")
        assert refused[-1][0] == SERIAL
        bench.clock.go_on(1.0)
        line.turn()
        for scan in scans:
            line.scan(scan)
    assert [event.serial for event in line.of(RunStarted)] == [SERIAL]


def test_a_card_is_for_the_next_label_only(line: LineBench) -> None:
    line.scan("SOCKET B")
    line.scan("HELLO")
    assert line.last(ScanRefused).code == "WRONG_SERIAL"
    line.scan(SERIAL)
    assert line.last(ScanRefused).code == "NO_SOCKET"
    line.bench.clock.go_on(READ_S)
    line.scan(SERIAL)
    assert line.last(OperatorPrompted).text == f"Put {SERIAL} into socket A."


def test_a_process_that_dies_takes_the_waiting_label_with_it_and_no_pass(line: LineBench) -> None:
    line.make("A", SERIAL)
    line.scan(OTHER)
    assert line.last(OperatorPrompted).text == f"Put {OTHER} into socket B."
    line.ports["A"].is_gone = line.ports["B"].is_gone = True
    line.turn()
    assert line.last(ScanRefused).text == OTHER
    line.bench.clock.go_on(1.5)
    line.turn()
    for socket in "AB":
        line.say(socket, AdapterReady(sees_units=True))
    line.arrive("A", SERIAL)
    line.arrive("B")
    assert line.state("A") is SocketState.PASS
    assert len(line.of(RunStarted)) == 1


def test_the_unit_of_an_interrupted_run_is_asked_for_where_it_was(bench: Bench) -> None:
    bench.claim(socket="B")
    line = LineBench(bench)
    assert line.text("B") == f"{SERIAL} was interrupted here: scan its label and SOCKET B."
    line.scan(SERIAL)
    assert "If it is still there, scan SOCKET B" in line.last(OperatorPrompted).text
    line.arrive("A")
    assert line.of(RunStarted) == []
    line.scan("SOCKET B")
    assert line.order("B").kind is RunKind.RECHECK, "also where it is silent"


def test_green_goes_when_a_unit_that_has_passed_falls_silent_in_its_next_answer(
    line: LineBench,
) -> None:
    line.make("A", SERIAL)
    line.fall_silent("A")
    assert line.state("A") is SocketState.EMPTY


def test_green_goes_when_it_may_be_another_unit(line: LineBench) -> None:
    line.make("A", SERIAL)
    line.arrive("A", "")
    line.fall_silent("A")
    assert line.state("A") is SocketState.PASS, "it may sleep"
    line.arrive("A", "")
    assert line.state("A") is SocketState.SCAN
    assert line.text("A").startswith(f"It was off or silent after PASS of {SERIAL}")


def test_a_socket_out_of_service_is_that(line: LineBench) -> None:
    line.say("A", AdapterDown("no such device"))
    line.scan(SERIAL)
    assert line.last(OperatorPrompted).text == f"Put {SERIAL} into socket B."
    line.scan("CANCEL")
    line.say("B", AdapterDown("no such device"))
    line.scan(SERIAL)
    assert line.last(ScanRefused).code == "SOCKET_BROKEN"


def test_what_a_person_does_is_audited(line: LineBench, bench: Bench) -> None:
    for text in ("OPERATOR Kim", "REASON reworked", "HELLO"):
        line.scan(text)
    with bench.outsider() as other:
        rows = other.execute("SELECT event, data FROM audit ORDER BY id").fetchall()
    events = [row[0] for row in rows]
    assert events[-3:] == ["operator", "reason", "refused scan"]
    assert "WRONG_SERIAL" in rows[-1][1]


def test_events_carry_the_time_in_utc(line: LineBench) -> None:
    assert {event.at for event in line.events} == {"2026-05-17T09:00:00.000Z"}


def test_a_socket_may_be_chosen_first(line: LineBench) -> None:
    line.scan("SOCKET B")
    line.scan(SERIAL)
    assert line.state("B") is SocketState.SCAN
    line.arrive("B")
    assert line.order("B").serial == SERIAL


def test_a_unit_that_is_not_seen_is_run_after_a_while_where_a_person_put_it(
    line: LineBench,
) -> None:
    line.scan("SOCKET B")
    line.scan(SERIAL)
    line.bench.clock.go_on(4.0)
    line.turn()
    assert line.state("B") is SocketState.SCAN
    line.say("B", AdapterReady(sees_units=True))
    line.bench.clock.go_on(2.0)
    line.turn()
    assert line.state("B") is SocketState.RUNNING


def test_where_units_cannot_be_seen_the_scan_begins(bench: Bench) -> None:
    line = LineBench(bench, "A", sees_units=False)
    line.scan(SERIAL)
    assert line.state("A") is SocketState.RUNNING
    line.work("A")
    line.end("A")
    line.scan("FREE A")
    assert line.state("A") is SocketState.EMPTY


# -- wrong scans ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("HELLO", "WRONG_SERIAL"),
        ("", "NOT_UNDERSTOOD"),
        ("W26\x1b05002", "NOT_UNDERSTOOD"),
        ("SOCKET", "NOT_UNDERSTOOD"),
        ("SOCKET Z", "NO_SUCH_SOCKET"),
        ("ABORT A", "NOT_RUNNING"),
        ("RESUME", "NOT_STOPPED"),
    ],
)
def test_a_wrong_scan_changes_nothing_and_states_what_to_do(
    line: LineBench, text: str, code: str
) -> None:
    line.scan(text)
    refused = line.last(ScanRefused)
    assert refused.code == code
    assert refused.remedy.endswith(".")
    assert {view.state for view in line.station.line.sockets.values()} == {SocketState.EMPTY}


def test_a_label_for_a_refused_socket_goes_to_no_other(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.arrive("B")
    line.scan("SOCKET A")
    line.scan(OTHER)
    assert line.last(ScanRefused).code == "NO_SOCKET"
    assert line.state("B") is SocketState.SCAN
    line.scan("SOCKET B")
    line.scan(OTHER)
    assert line.order("B").serial == OTHER


def test_a_double_scan_is_one_scan(line: LineBench) -> None:
    line.scan(SERIAL)
    line.scan(SERIAL)
    assert line.last(ScanRefused).code == "DOUBLE_SCAN"
    line.arrive("A")
    assert line.state("A") is SocketState.RUNNING
    line.scan(SERIAL)
    assert line.last(ScanRefused).code == "UNIT_RUNNING"


def test_a_second_label_waits_for_the_first(line: LineBench) -> None:
    line.scan(SERIAL)
    line.scan(OTHER)
    assert line.last(ScanRefused).code == "LABEL_WAITS"
    line.scan("CANCEL")
    line.scan(OTHER)
    assert line.last(ScanAccepted).text == OTHER


def test_a_scan_during_a_run_is_for_the_next_socket(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.scan(OTHER)
    line.scan("SOCKET A")
    assert line.last(ScanRefused).code == "SOCKET_BUSY"
    line.arrive("B")
    assert line.order("B").serial == OTHER


def test_the_same_unit_cannot_be_in_two_sockets(line: LineBench) -> None:
    line.scan("SOCKET A")
    line.scan(SERIAL)
    line.scan("SOCKET B")
    line.scan(SERIAL)
    assert line.last(ScanRefused).code == "DOUBLE_SCAN"
    assert line.state("B") is SocketState.EMPTY


def test_a_unit_that_passed_before_is_refused_by_the_records(line: LineBench) -> None:
    line.make("A", SERIAL)
    line.leave("A")
    line.scan(SERIAL)
    line.arrive("A")
    refused = line.last(ScanRefused)
    assert (refused.code, refused.socket) == ("DUPLICATE", "A")
    assert line.state("A") is SocketState.SCAN
    assert line.text("A") == f"{refused.reason} {refused.remedy}"
    line.fall_silent("A")
    line.arrive("A")
    assert line.text("A") == "Scan the label of the unit and SOCKET A.", "it was about another"
    line.scan("SOCKET A")
    line.scan(OTHER)
    assert line.state("A") is SocketState.RUNNING


def test_a_recipe_that_was_changed_stops_the_line(line: LineBench) -> None:
    line.bench.recipe.path.write_text("changed", encoding="utf-8")
    line.scan(SERIAL)
    line.arrive("A")
    assert line.last(LineStopped).code == "RECIPE_CHANGED"
    assert line.state("B") is SocketState.STOPPED
    assert line.bench.store.read.table() == []


def test_a_person_aborts_a_run(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.scan("ABORT A")
    assert line.ports["A"].heard[-1] == Stop()
    line.end("A", RunState.ABORTED, "OPERATOR_ABORT")
    assert line.state("A") is SocketState.RECHECK


# -- records that cannot be written ---------------------------------------------------------------


def hold(bench: Bench) -> sqlite3.Connection:
    """Somebody else holds the database."""
    other = sqlite3.connect(bench.path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    return other


def test_an_outcome_that_cannot_be_saved_is_never_green(line: LineBench, bench: Bench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.work("A")
    other = hold(bench)
    line.end("A")
    assert line.of(RunEnded) == []
    assert line.state("A") is SocketState.ERROR
    assert line.last(RecordNotSaved).serial == SERIAL
    assert "RECORD NOT SAVED" in line.last(LineStopped).reason
    assert line.state("B") is SocketState.STOPPED
    line.scan(OTHER)
    assert line.last(ScanRefused).code == "LINE_STOPPED"
    line.scan("RESUME")
    assert line.last(ScanRefused).code == "STILL_NOT_SAVED"
    other.execute("ROLLBACK")
    line.scan("RESUME")
    assert line.last(RunEnded).run.state is RunState.PASS
    assert line.state("A") is SocketState.PASS
    assert line.of(LineResumed)
    other.close()


def test_an_outcome_that_cannot_be_read_back_is_not_green_before_it_is(
    line: LineBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.work("A")

    def unreadable(_records: Records, run_id: RunId) -> NoReturn:
        raise RecordsDamagedError(f"Run {run_id} cannot be read.")

    with monkeypatch.context() as patched:
        patched.setattr(Records, "run", unreadable)
        line.end("A")
    assert line.of(RunEnded) == []
    assert line.state("A") is SocketState.ERROR
    assert "cannot be read" in line.last(RecordNotSaved).reason
    line.scan("RESUME")
    assert line.last(RunEnded).run.state is RunState.PASS
    assert line.state("A") is SocketState.PASS
    assert [run.state for run in line.bench.store.read.table()] == [RunState.PASS], "saved once"
    assert line.bench.store.examine().problems == ()


@pytest.mark.parametrize("operation", ["intent", "verified", "step"])
@pytest.mark.parametrize("kind", [DiskFullError, RecordsLockedError])
def test_a_run_of_which_a_part_is_not_saved_cannot_pass(
    line: LineBench,
    bench: Bench,
    monkeypatch: pytest.MonkeyPatch,
    operation: str,
    kind: type[DiskFullError],
) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    with monkeypatch.context() as patch:

        def fail(*_args: object, **_kwargs: object) -> None:
            raise kind("RECORD NOT SAVED: no room.", remedy="Make room.")

        patch.setattr(bench.store, operation, fail)
        replies = [
            line.ask("A", JournalWrite("bms", "flash", "V1")),
            line.ask("A", JournalWrite("bms", "flash", "V1", WriteId(1), "V1")),
            line.ask("A", tried(StepName.FLASH)),
        ]
    assert [bool(reply.error) for reply in replies].count(True) >= 1
    # Even a process that would claim a PASS does not get one.
    line.end("A")
    ended = line.last(RunEnded)
    assert (ended.run.state, ended.run.code) == (RunState.ERROR, "RECORD_NOT_SAVED")
    assert line.state("A") is SocketState.RECHECK
    assert line.station.line.stopped is not None


def test_a_full_disk_under_a_run_is_never_green(line: LineBench, bench: Bench) -> None:
    """Not a made-up error: SQLite may take no further page."""
    line.scan(SERIAL)
    line.arrive("A")
    line.work("A")

    def no_room(connection: Any, _record: object) -> None:
        connection.execute("PRAGMA max_page_count = 1")

    engine = bench.store.database.engine
    event.listen(engine, "connect", no_room)
    bench.store.database.close()
    # A database with room left in its last page saves some more, and then no more.
    for _ in range(200):
        if line.ask("A", JournalWrite("bms", "flash", "V" * 200)).error:
            break
    line.end("A")
    assert SocketState.PASS not in {view.state for view in line.station.line.sockets.values()}
    assert all(ended.run.state is not RunState.PASS for ended in line.of(RunEnded))
    assert "disk is full" in line.last(LineStopped).reason
    event.remove(engine, "connect", no_room)
    bench.store.database.close()
    line.scan("RESUME")
    assert line.last(RunEnded).run.code == "RECORD_NOT_SAVED"
    assert bench.store.read.unit(SERIAL).state is UnitState.RECHECK


def test_a_claim_that_cannot_be_saved_begins_nothing(line: LineBench, bench: Bench) -> None:
    other = hold(bench)
    line.scan(SERIAL)
    line.arrive("A")
    other.close()
    assert line.ports["A"].heard == []
    assert line.state("A") is SocketState.STOPPED


def test_what_cannot_be_audited_stops_the_line_once_and_resume_states_the_truth(
    line: LineBench, bench: Bench
) -> None:
    other = hold(bench)
    line.scan("HELLO")
    assert line.of(RecordNotSaved)
    assert len(line.of(LineStopped)) == 1
    line.scan("RESUME")
    assert line.last(ScanRefused).code == "STILL_NOT_SAVED"
    assert line.of(LineResumed) == []
    other.close()
    line.scan("RESUME")
    assert len(line.of(LineResumed)) == 1
    line.scan(SERIAL)
    line.arrive("A")
    assert line.state("A") is SocketState.RUNNING


def test_a_claim_that_was_saved_although_it_seemed_lost_keeps_no_unit_from_being_run(
    line: LineBench, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that ends the connection in the very commit."""
    real = bench.store.claim

    def claim(*args: Any, **kwargs: Any) -> None:
        real(*args, **kwargs)
        raise RecordsLockedError("RECORD NOT SAVED: the server is gone.", remedy="Wait for it.")

    with monkeypatch.context() as patch:
        patch.setattr(bench.store, "claim", claim)
        line.scan(SERIAL)
        line.arrive("A")
    assert line.of(RunStarted) == []
    assert line.station.line.stopped is not None
    line.scan("RESUME")
    line.scan(SERIAL)
    line.scan("SOCKET A")
    assert line.order("A").kind is RunKind.RECHECK
    line.work("A")
    line.end("A")
    assert line.last(RunEnded).run.state is RunState.PASS


def test_a_trace_that_is_not_what_was_written_is_no_pass(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.work("A")
    line.trace("A")
    line.say("A", RunResult(RunState.PASS, "OK", "", 1.0, {"bms": Verified.VERSION}, "0" * 64))
    assert line.last(RunEnded).run.code == "TRACE_NOT_SAVED"


def test_a_pass_that_the_records_know_better_is_none(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.ask("A", JournalWrite("bms", "flash", "V1"))  # never verified
    line.end("A")
    ended = line.last(RunEnded)
    assert (ended.run.state, ended.run.code) == (RunState.ERROR, "INTERNAL")
    assert line.state("A") is SocketState.RECHECK


# -- processes and adapters -----------------------------------------------------------------------


def test_a_process_that_dies_costs_its_own_run_and_no_other(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.scan(OTHER)
    line.arrive("B")
    line.ports["A"].is_gone = True
    line.turn()
    assert line.last(RunEnded).run.code == "PROCESS_DIED"
    assert line.bench.store.read.unit(SERIAL).state is UnitState.RECHECK
    assert line.state("B") is SocketState.RUNNING
    line.work("B")
    line.end("B")
    assert line.state("B") is SocketState.PASS


def test_a_process_that_hangs_is_ended_and_started_again(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    hanging = line.ports["A"]
    line.bench.clock.go_on(9.0)
    line.say("B", AdapterReady(sees_units=True))
    line.bench.clock.go_on(2.0)
    line.turn()
    assert hanging.killed == 1
    assert line.last(RunEnded).run.code == "PROCESS_HUNG"
    assert line.last(WorkerFailed).restart_in_s == 1.0
    line.bench.clock.go_on(1.5)
    line.turn()
    assert line.ports["A"] is not hanging
    line.say("A", AdapterReady(sees_units=True))
    line.arrive("A")
    line.scan(SERIAL)
    line.scan("SOCKET A")
    assert line.order("A").kind is RunKind.RECHECK


def test_a_process_that_cannot_work_is_not_started_again(line: LineBench) -> None:
    line.ports["A"].reported.append(AdapterDown("The recipe was changed.", is_final=True))
    line.ports["A"].is_gone = True
    line.turn()
    line.bench.clock.go_on(5.0)
    line.turn()
    assert line.last(WorkerFailed) == WorkerFailed("A", "The recipe was changed.", None)
    assert line.state("A") is SocketState.ERROR


def test_an_unplugged_adapter_is_shown_and_comes_back(line: LineBench) -> None:
    line.say("A", AdapterDown("no such device"))
    assert line.state("A") is SocketState.ERROR
    line.scan("SOCKET A")
    assert line.last(ScanRefused).code == "SOCKET_BROKEN"
    line.say("A", AdapterReady(sees_units=True))
    assert line.state("A") is SocketState.STARTING, "what is in it now is not known yet"
    line.leave("A")
    assert line.state("A") is SocketState.EMPTY


def test_a_trace_that_is_not_saved_stops_the_line(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.work("A")
    line.end("A", RunState.ERROR, "TRACE_NOT_SAVED")
    assert line.last(LineStopped).code == "TRACE_NOT_SAVED"
    assert line.state("A") is SocketState.RECHECK
    line.scan("W2605003")
    assert line.last(ScanRefused).code == "LINE_STOPPED"
    line.scan("RESUME")
    assert line.of(LineResumed)


def test_a_new_process_does_not_take_a_finished_unit_for_a_new_one(line: LineBench) -> None:
    line.make("A", SERIAL)
    line.ports["A"].is_gone = True
    line.turn()
    line.bench.clock.go_on(1.5)
    line.turn()
    line.say("A", AdapterReady(sees_units=True))
    line.arrive("A", SERIAL)
    assert line.state("A") is SocketState.PASS
    assert len(line.of(UnitArrived)) == 1


def test_green_goes_in_an_outage_in_which_a_unit_can_be_exchanged(line: LineBench) -> None:
    line.make("A", SERIAL)
    line.say("A", AdapterDown("no such device"))
    line.bench.clock.go_on(2.0)
    line.turn()
    assert line.state("A") is SocketState.PASS
    line.say("A", AdapterDown("its process ended"))
    line.bench.clock.go_on(1.5)
    line.turn()
    assert line.state("A") is SocketState.ERROR


# -- start and end --------------------------------------------------------------------------------


def test_what_a_dead_station_left_is_found_at_the_start(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.store.intent(run_id, "bms", "flash", "V1")
    line = LineBench(bench)
    line.scan(SERIAL)
    line.scan("SOCKET A")
    assert bench.store.read.run(run_id).run.state is RunState.INTERRUPTED
    assert line.order("A").kind is RunKind.RECHECK


def test_what_an_interrupted_run_flashed_and_read_back_is_given_to_the_next(bench: Bench) -> None:
    run_id = bench.claim().run_id
    target = bench.recipe.targets[0]
    write = bench.store.intent(
        run_id, "bms", "flash", flash_value(target.version, target.image.sha256)
    )
    bench.store.verified(write, target.version)
    line = LineBench(bench)
    line.scan(SERIAL)
    line.scan("SOCKET A")
    assert line.order("A").flashed_before == {"bms"}


def test_a_flash_before_the_unit_may_have_changed_is_not_relied_on(bench: Bench) -> None:
    line = LineBench(bench)
    line.scan(SERIAL)
    line.arrive("A")
    run_id = line.order("A").run_id
    target = bench.recipe.targets[0]
    value = flash_value(target.version, target.image.sha256)
    bench.store.verified(bench.store.intent(run_id, "bms", "flash", value), target.version)
    line.end("A", RunState.ERROR, "UNIT_CHANGED")
    line.scan(SERIAL)
    line.scan("SOCKET A")
    again = line.order("A")
    assert again.run_id != run_id
    assert (again.kind, again.flashed_before) == (RunKind.RECHECK, frozenset())


def test_a_station_that_ends_stops_its_runs_and_saves_them(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.station.abort_all()
    line.turn()
    assert any(message == Stop() for message in line.ports["A"].heard)
    line.end("A", RunState.ABORTED, "OPERATOR_ABORT")
    line.station.close()
    assert line.last(RunEnded).run.state is RunState.ABORTED


def test_labels_of_virtual_units_may_scan_themselves(bench: Bench) -> None:
    line = LineBench(bench, scans_labels=True)
    line.say("A", PresenceChanged(is_there=True, how="a virtual unit arrived", label=SERIAL))
    assert line.state("A") is SocketState.RUNNING
    line.say("B", PresenceChanged(is_there=True, how="a virtual unit arrived", label=SERIAL))
    assert line.last(ScanRefused).code == "UNIT_RUNNING"


def test_labels_that_came_while_the_line_was_stopped_scan_themselves_after_it(
    bench: Bench,
) -> None:
    line = LineBench(bench, scans_labels=True)
    line.say("A", PresenceChanged(is_there=True, how="a virtual unit arrived", label=SERIAL))
    line.work("A")
    other = hold(bench)
    line.end("A")
    line.say("B", PresenceChanged(is_there=True, how="a virtual unit arrived", label=OTHER))
    assert line.last(ScanRefused).code == "LINE_STOPPED"
    other.close()
    line.scan("RESUME")
    assert line.state("A") is SocketState.PASS
    assert line.state("B") is SocketState.RUNNING


def test_figures_follow_the_runs(line: LineBench) -> None:
    line.make("A", SERIAL)
    figures = line.station.figures
    assert (figures.units, figures.passed, figures.first_passed) == (1, 1, 1)


def test_who_looks_on_cannot_stop_the_line(line: LineBench) -> None:
    def fall(_event: object) -> None:
        raise RuntimeError("a web page fell over")

    line.station._on_event = fall
    line.make("A", SERIAL)
    assert line.state("A") is SocketState.PASS


def test_a_reason_is_for_its_label_alone(bench: Bench) -> None:
    bench.use(USUAL.replace('revision = "4"', 'revision = "4"\nduplicate = "reflash-with-reason"'))
    for serial in (SERIAL, OTHER):
        bench.make(serial=serial)
    line = LineBench(bench)
    line.scan("SOCKET B")
    line.scan(OTHER)
    line.scan("REASON customer return")
    line.scan("SOCKET A")
    line.scan(SERIAL)
    line.arrive("B")
    assert line.last(ScanRefused).code == "REASON_NEEDED"
    line.arrive("A")
    assert line.last(RunStarted).serial == SERIAL
    assert bench.store.read.unit(SERIAL).runs[-1].run.reason == "customer return"


def test_cause_and_action_are_two_sentences(line: LineBench, bench: Bench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    line.end("A", RunState.FAIL, "LIMIT")
    reported = bench.store.read.unit(SERIAL).runs[-1].run.text
    assert reported.startswith("what happened. Put the unit aside")


def test_real_sockets_refuse_records_of_virtual_units(bench: Bench) -> None:
    bench.make(is_virtual=True)
    with pytest.raises(UsageError, match="hold virtual units"):
        LineBench(bench)


@pytest.mark.parametrize("reason", ["", "new label printed"])
def test_what_must_not_change_is_held_over_a_fail_but_not_for_a_reworked_unit(
    line: LineBench, reason: str
) -> None:
    for model in ("BM36", "destroyed"):
        if reason:
            line.scan(f"REASON {reason}")
        line.scan(SERIAL)
        if model == "BM36":
            line.arrive("A")
        else:
            line.scan("SOCKET A")
        known = dict(line.order("A").known_before)
        read = (Measurement("before bms model", text=model),)
        line.ask("A", tried(StepName.CHECK), read)
        line.ask("A", JournalWrite("bms", "flash", "V1"))
        line.end("A", RunState.FAIL, "TRANSFER_FAILED")
    assert known == ({} if reason else {"bms model": "BM36"})


def test_what_is_not_saved_is_reported_in_one_line(line: LineBench, bench: Bench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    away = bench.path.with_name("away.sqlite")
    bench.path.rename(away)
    line.end("A")
    assert line.state("A") is SocketState.ERROR
    noted = line.last(RecordNotSaved)
    assert "\n" not in noted.reason
    assert noted.remedy not in noted.reason
    away.rename(bench.path)
    line.scan("RESUME")
    assert line.station.line.stopped is None


def test_a_pass_of_a_first_run_that_flashed_nothing_is_none(line: LineBench) -> None:
    line.scan(SERIAL)
    line.arrive("A")
    read = (Measurement("bms version", text="V1"),)
    line.ask("A", tried(StepName.VERIFY), read)
    line.end("A")
    ended = line.last(RunEnded)
    assert (ended.run.state, ended.run.code) == (RunState.ERROR, "INTERNAL")
    assert "every target flashed" in ended.run.text or "forbids" in ended.run.text
