"""Badges, roles and PINs: who may do what, and no PIN is shown."""

from __future__ import annotations

import json
import logging
from functools import cache
from pathlib import Path

import pytest
from argon2 import PasswordHasher

from flasher.errors import UsageError
from flasher.station import pins
from flasher.station.attempts import PAUSE_S, TRIES_MAX
from flasher.station.board import Board
from flasher.station.events import (
    LineResumed,
    LineStopped,
    PinAwaited,
    PinEnded,
    RunStarted,
    ScanAccepted,
    ScanRefused,
    StationStarted,
)
from flasher.station.line import CheckPin
from flasher.station.messages import Stop
from flasher.station.operators import (
    HIDDEN,
    PIN_LIMIT_S,
    Crew,
    Person,
    Role,
    load_badges,
)
from flasher.station.pins import Pin
from flasher.station.records.model import AuditEvent
from flasher.station.socket import PAGE, Source
from tests.loops import each
from tests.station.factory import SERIAL, Bench
from tests.station.line_bench import LineBench

PIN = "470815"
WRONG = "111111"
OPERATOR, REWORK, SUPERVISOR = "BADGE-1", "BADGE-2", "BADGE-3"


@cache
def pin_hash() -> str:
    """A cheap one: the tests take no time for it."""
    return PasswordHasher(time_cost=1, memory_cost=8, parallelism=1).hash(PIN)


def crew(*, has_pins: bool = True) -> Crew:
    pin = pin_hash() if has_pins else ""
    return Crew(
        (
            Person(name="Jo", code=OPERATOR, role=Role.OPERATOR),
            Person(name="Rea", code=REWORK, role=Role.REWORK, pin=pin),
            Person(name="Sue", code=SUPERVISOR, role=Role.SUPERVISOR, pin=pin),
        )
    )


@pytest.fixture
def line(bench: Bench) -> LineBench:
    return LineBench(bench, crew=crew())


def audit(line: LineBench) -> list[tuple[str, dict[str, str]]]:
    with line.bench.outsider() as other:
        rows = other.execute("SELECT event, data FROM audit ORDER BY id").fetchall()
    return [(name, json.loads(data)) for name, data in rows]


def refusal(line: LineBench) -> str:
    return line.last(ScanRefused).code


# -- who works here -------------------------------------------------------------------------------


def test_a_badge_states_who_works_and_nothing_runs_before_it(line: LineBench) -> None:
    line.arrive("A")
    line.scan("SOCKET A")
    line.scan(SERIAL)
    assert refusal(line) == "NOBODY"
    line.scan(OPERATOR)
    assert line.last(ScanAccepted) == ScanAccepted("Jo", "badge")
    line.scan(SERIAL)
    run = line.bench.store.read.run(line.last(RunStarted).run_id).run
    assert (run.serial, run.operator) == (SERIAL, "Jo")
    _, data = next(row for row in audit(line) if row[0] == "operator")
    assert data == {"before": "", "now": "Jo", "role": "operator", "by": "Jo"}


def test_operator_is_refused_where_badges_name_the_operator(line: LineBench) -> None:
    line.scan(OPERATOR)
    line.scan("OPERATOR Ann")
    assert refusal(line) == "BADGES"
    assert line.station.line.operator == "Jo"


def test_a_badge_between_card_and_label_changes_nothing_about_them(bench: Bench) -> None:
    line = LineBench(bench, crew=crew())
    line.scan("SOCKET X")
    line.scan(OPERATOR)
    line.scan(SERIAL)
    assert refusal(line) == "NO_SOCKET", "the refused card holds on"


def test_the_code_of_a_badge_is_in_no_event(line: LineBench) -> None:
    line.scan(SUPERVISOR)
    assert not [each for each in line.events if SUPERVISOR in repr(each)]
    assert SUPERVISOR not in repr(audit(line))


def test_without_a_table_the_station_reports_it_once(bench: Bench) -> None:
    line = LineBench(bench)
    board = Board()
    for event in line.events:
        board.apply(event)
    assert not line.last(StationStarted).has_badges
    assert not board.has_badges
    assert board.last_reply == "No badge table: operator names are not checked."
    line.scan("OPERATOR Ann")
    assert line.station.line.operator == "Ann"
    line.scan("123456")
    assert line.last(ScanRefused).text == "123456"


# -- roles ----------------------------------------------------------------------------------------

ALLOWED = {
    OPERATOR: set[str](),
    REWORK: {"REASON reworked", "ABORT A"},
    SUPERVISOR: {"REASON reworked", "ABORT A", "RESUME"},
}


@pytest.mark.slow
@each("badge", list(ALLOWED))
def test_an_override_needs_a_role_that_may(bench: Bench, badge: str) -> None:
    for command in sorted(ALLOWED[SUPERVISOR]):
        line = LineBench(bench, crew=crew(has_pins=False))
        line.scan(command)
        assert refusal(line) == "NOBODY"
        line.scan(badge)
        line.arrive("A")
        line.scan("SOCKET A")
        line.scan(SERIAL)
        line.station.line.stop("FULL", "Full.", "Make room.")
        before = len(line.of(ScanRefused))
        line.scan(command)
        if command in ALLOWED[badge]:
            assert len(line.of(ScanRefused)) == before
            name, data = audit(line)[-1]
            assert (name, data["by"]) == (command.split()[0].lower(), line.station.line.operator)
        else:
            assert refusal(line) == "NOT_ALLOWED"
        is_resumed = command == "RESUME" and badge == SUPERVISOR
        assert (line.of(LineResumed) != []) == is_resumed
        stops = [each for each in line.ports["A"].heard if isinstance(each, Stop)]
        assert (stops != []) == (command == "ABORT A" and badge != OPERATOR)
        line.station.close()
        line.station.store.recover()


def test_the_rest_is_for_everybody(line: LineBench) -> None:
    line.scan(OPERATOR)
    for command in ("LOT L17", "SOCKET A", "CANCEL", "FREE A"):
        line.scan(command)
    assert line.of(ScanRefused) == []


# -- PINs -----------------------------------------------------------------------------------------


def test_the_pin_lets_the_override_pass(line: LineBench) -> None:
    line.scan(REWORK)
    line.scan("REASON new cell")
    asked = line.last(PinAwaited)
    assert (asked.person, asked.text, asked.limit_s) == ("Rea", "REASON new cell", PIN_LIMIT_S)
    assert [name for name, _ in audit(line)][-1] == "operator", "nothing is done yet"
    line.scan(f" {PIN}\n")
    assert line.last(PinEnded) == PinEnded("Rea", is_right=True)
    assert line.last(ScanAccepted) == ScanAccepted("REASON new cell", "reason")
    assert audit(line)[-1] == ("reason", {"text": "new cell", "by": "Rea"})
    line.scan(SERIAL)
    line.arrive("A")
    assert line.last(RunStarted).serial == SERIAL


def test_a_stopped_line_goes_on_only_by_the_pin(line: LineBench) -> None:
    line.scan(SUPERVISOR)
    line.station.line.stop("FULL", "Full.", "Make room.")
    line.scan("RESUME")
    line.scan(WRONG)
    assert refusal(line) == "WRONG_PIN"
    assert line.station.line.stopped is not None
    line.scan(PIN)
    assert line.of(LineResumed) == [LineResumed()]


def test_what_changed_before_the_pin_came_is_looked_at_again(line: LineBench) -> None:
    line.scan(REWORK)
    line.arrive("A")
    line.scan("SOCKET A")
    line.scan(SERIAL)
    line.scan("ABORT A")
    line.work("A")
    line.end("A")
    line.scan(PIN)
    assert refusal(line) == "NOT_RUNNING"
    assert not [each for each in line.ports["A"].heard if isinstance(each, Stop)]


def test_wrong_pins_are_limited_and_the_limit_ends(line: LineBench, bench: Bench) -> None:
    line.scan(REWORK)
    line.scan("REASON x")
    for _ in range(TRIES_MAX):
        line.scan(WRONG)
    assert refusal(line) == "PIN_LOCKED"
    assert line.last(PinEnded) == PinEnded("Rea", is_right=False)
    assert line.last(ScanRefused).remedy == "Wait 60 s, then scan it again."
    bench.clock.go_on(PAUSE_S - 0.1)
    line.scan("REASON x")
    assert refusal(line) == "PIN_LOCKED", "no PIN is asked for"
    line.scan(PIN)
    assert line.last(ScanRefused).text == HIDDEN
    assert "reason" not in [name for name, _ in audit(line)]
    bench.clock.go_on(0.1)
    line.scan("REASON x")
    line.scan(PIN)
    assert line.last(ScanAccepted).meaning == "reason"


def test_each_pause_is_longer_until_a_pin_is_right(line: LineBench, bench: Bench) -> None:
    line.scan(REWORK)
    for pause_s in (PAUSE_S, 2 * PAUSE_S):
        line.scan("REASON x")
        for _ in range(TRIES_MAX):
            line.scan(WRONG)
        assert line.last(ScanRefused).remedy == f"Wait {pause_s:g} s, then scan it again."
        bench.clock.go_on(pause_s)
    for _ in range(3 * TRIES_MAX):
        line.scan("REASON x")
        line.scan(PIN)
        assert line.last(ScanAccepted).text == "REASON x"


def test_who_guesses_at_a_page_does_not_stop_that_person_at_a_scanner(
    line: LineBench, bench: Bench
) -> None:
    pages = [Source(f"{PAGE}{number}") for number in range(3)]
    scanner = Source("scanner left")

    def scan(text: str, source: Source) -> None:
        line.station.submit(text, source)
        line.turn()

    line.scan(REWORK)
    scan("REASON x", pages[0])
    for number in range(TRIES_MAX):
        scan(WRONG, pages[number % 3])  # a browser can begin any number of sessions
    assert refusal(line) == "PIN_LOCKED"
    for page in pages:
        scan("REASON x", page)
        assert refusal(line) == "PIN_LOCKED"
    scan("REASON x", scanner)
    checked = line.checker.done
    for page in pages:
        scan(PIN, page)
        assert (refusal(line), line.last(ScanRefused).text) == ("PIN_LOCKED", HIDDEN)
    assert line.checker.done == checked == TRIES_MAX
    scan(PIN, scanner)
    assert line.last(ScanAccepted).text == "REASON x"
    bench.clock.go_on(PAUSE_S)
    scan("REASON y", scanner)
    scan(PIN, pages[0])
    assert line.last(ScanAccepted).text == "REASON y"


@pytest.mark.slow
def test_a_pin_is_checked_beside_the_line_and_what_follows_waits(
    line: LineBench, bench: Bench
) -> None:
    line.scan(REWORK)
    line.scan("REASON new cell")
    line.checker.holds = True
    for text in (WRONG, PIN, "LOT L9"):
        line.station.submit(text)
    line.turn()
    assert len(line.checker.waiting) == 1, "one at a time"
    line.arrive("A")  # the line goes on
    assert line.of(ScanRefused) == []
    line.checker.go_on()
    line.turn()
    assert refusal(line) == "WRONG_PIN"
    assert len(line.checker.waiting) == 1
    bench.clock.go_on(PIN_LIMIT_S)
    line.turn()
    assert line.of(PinEnded) == [], "it came in time"
    line.checker.go_on()
    line.turn()
    assert line.of(PinEnded) == [PinEnded("Rea", is_right=True)]
    assert line.last(ScanAccepted).text == "LOT L9"
    assert line.checker.done == 2


def test_what_a_person_does_at_a_page_is_in_the_trail_after_a_turn(line: LineBench) -> None:
    line.station.note(AuditEvent.SIGN_IN, {"name": "Sue"})
    line.turn()
    line.station.note(AuditEvent.SIGN_OUT, {"name": "Sue"})
    line.station.close()
    assert audit(line)[-2:] == [("sign-in", {"name": "Sue"}), ("sign-out", {"name": "Sue"})]


def test_a_check_that_fails_is_no_right_pin(line: LineBench) -> None:
    line.scan(REWORK)
    line.scan("REASON x")
    line.checker.holds = True
    line.scan(PIN)
    checked, _ = line.checker.waiting.popleft()
    checked.set_exception(MemoryError())
    line.turn()
    assert refusal(line) == "WRONG_PIN"


def test_the_lock_is_of_one_person_and_survives_another_badge(line: LineBench) -> None:
    line.scan(REWORK)
    line.scan("REASON x")
    for _ in range(TRIES_MAX):
        line.scan(WRONG)
    line.scan(SUPERVISOR)
    line.scan("REASON x")
    line.scan(PIN)
    assert line.last(ScanAccepted).meaning == "reason"
    line.scan(REWORK)
    line.scan("REASON x")
    assert refusal(line) == "PIN_LOCKED"


def test_the_tries_are_not_given_back_by_asking_again(line: LineBench) -> None:
    line.scan(REWORK)
    for _ in range(TRIES_MAX - 1):
        line.scan("REASON x")
        line.scan(WRONG)
        line.scan("CANCEL")
        assert refusal(line) == "CANCELLED"
    line.scan("REASON x")
    line.scan(WRONG)
    assert refusal(line) == "PIN_LOCKED"


def test_a_pin_that_does_not_come_is_not_waited_for(line: LineBench, bench: Bench) -> None:
    line.scan(REWORK)
    line.scan("REASON x")
    bench.clock.go_on(PIN_LIMIT_S - 0.1)
    line.turn()
    assert line.of(PinEnded) == []
    bench.clock.go_on(0.1)
    line.turn()
    assert line.last(PinEnded) == PinEnded("Rea", is_right=False)
    assert line.last(ScanRefused).text == "REASON x"
    line.scan(PIN)
    assert line.last(ScanRefused).text == HIDDEN, "it came too late, and is not shown"


@pytest.mark.slow
@each("text", [SERIAL, OPERATOR, "SOCKET A", "RESUME", "", "12", "1" * 13, "no digits"])
def test_what_is_no_pin_is_neither_tried_nor_shown_nor_done(bench: Bench, text: str) -> None:
    line = LineBench(bench, crew=crew())
    line.scan(REWORK)
    line.scan("REASON x")
    for _ in range(TRIES_MAX + 1):
        line.scan(text)
    assert (line.last(ScanRefused).text, refusal(line)) == (HIDDEN, "NO_PIN")
    line.scan(PIN)
    assert line.last(ScanAccepted).text == "REASON x"
    assert line.station.line.operator == "Rea"


def test_a_pin_is_in_no_event_record_log_or_repr(
    line: LineBench, bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    line.scan(REWORK)
    line.scan(PIN)  # before it is asked for
    line.scan("REASON x")
    line.scan(WRONG)
    line.scan(PIN)
    line.scan(PIN)  # once too often
    reported = [repr(each) for each in line.events] + [repr(CheckPin(Pin(PIN), "hash"))]
    for secret in (PIN, WRONG):
        assert secret not in "\n".join(reported)
        assert secret not in caplog.text
        files = [path for path in bench.folder.rglob("*") if path.is_file()]
        assert all(secret.encode() not in path.read_bytes() for path in files)


def test_a_serial_number_of_the_recipe_is_shown_although_it_is_digits(bench: Bench) -> None:
    text = bench.recipe.recipe.serial_number
    assert text.example == SERIAL
    bench.use(
        bench.recipe.content.replace(
            "'W(?P<year>[0-9]{2})(?P<week>[0-9]{2})(?P<number>[0-9]{3})'", "'[0-9]{8}'"
        ).replace(SERIAL, "26050002")
    )
    line = LineBench(bench, crew=crew())
    line.scan(OPERATOR)
    line.scan("26050002")
    line.scan("26050002")
    assert (line.last(ScanRefused).text, refusal(line)) == ("26050002", "DOUBLE_SCAN")


# -- real and virtual units in one place ----------------------------------------------------------


def test_a_supervisor_has_to_allow_virtual_units_among_real_ones(bench: Bench) -> None:
    bench.make(serial="W2605099", is_virtual=True)
    line = LineBench(bench, mixes_virtual=True, crew=crew())
    assert line.last(LineStopped).code == "VIRTUAL_MIXED"
    line.scan(REWORK)
    line.scan("RESUME")
    assert refusal(line) == "NOT_ALLOWED"
    line.scan(SUPERVISOR)
    line.scan("RESUME")
    line.scan(PIN)
    assert line.station.line.stopped is None
    assert audit(line)[-1] == ("resume", {"code": "VIRTUAL_MIXED", "by": "Sue"})


def test_records_of_one_kind_need_no_permission(bench: Bench) -> None:
    bench.make()
    assert LineBench(bench, mixes_virtual=True, crew=crew()).station.line.stopped is None


# -- the table ------------------------------------------------------------------------------------

USUAL = f"""\
[[person]]
name = "Jo"
code = "{OPERATOR}"
role = "operator"

[[person]]
name = "Sue"
code = "{SUPERVISOR}"
role = "supervisor"
pin = "PIN_HASH"
"""


def loaded(bench: Bench, text: str) -> tuple[Person, ...]:
    path = bench.folder / "badges.toml"
    path.write_text(text.replace("PIN_HASH", pin_hash()), "utf-8")
    return load_badges(path, bench.recipe.recipe.serial_number)


def test_a_table_is_read(bench: Bench) -> None:
    jo, sue = loaded(bench, USUAL)
    assert (jo.name, jo.code, jo.role, jo.pin) == ("Jo", OPERATOR, Role.OPERATOR, "")
    assert pins.is_right(Pin(PIN), sue.pin)
    assert not pins.is_right(Pin(WRONG), sue.pin)
    assert pin_hash() not in repr(sue)


@each(
    "old, new, why",
    [
        (f'"{OPERATOR}"', f'"{SUPERVISOR}"', "two badges have the same code"),
        ('"Jo"', '"Sue"', "two people have the same name"),
        (f'"{OPERATOR}"', f'"{SERIAL}"', "could be a label"),
        (f'"{OPERATOR}"', '"W9999000"', "could be a label"),
        (f'"{OPERATOR}"', '"RESUME"', "is a command"),
        (f'"{OPERATOR}"', '"LOT 17"', "is a command"),
        (f'"{OPERATOR}"', '"LOT"', "cannot be scanned"),
        (f'"{OPERATOR}"', '" B1"', "cannot be scanned"),
        (f'"{OPERATOR}"', f'"{"B" * 65}"', "cannot be scanned"),
        ('"operator"', '"boss"', "operator, rework, supervisor"),
        ('"PIN_HASH"', '"470815"', "flasher station pin makes one"),
        ('"PIN_HASH"', "470815", "flasher station pin makes one"),
        ("argon2id$v=19$m=8,", "argon2i$v=19$m=8,", "flasher station pin makes one"),
        ("m=8,", "m=4000000,", "takes too long"),
        ("t=1,", "t=400,", "takes too long"),
        ("role =", "roles =", "Did you mean"),
        (USUAL, "", "person"),
    ],
)
def test_what_is_wrong_with_a_table_is_reported(bench: Bench, old: str, new: str, why: str) -> None:
    whole = USUAL if old in USUAL else USUAL.replace("PIN_HASH", pin_hash())
    assert old in whole
    with pytest.raises(UsageError) as refused:
        loaded(bench, whole.replace(old, new, 1))
    reported = f"{refused.value} {refused.value.remedy} {refused.value.faults}"
    assert why in reported
    assert "470815" not in reported, "somebody wrote the PIN itself"


def test_a_missing_table_is_reported(bench: Bench) -> None:
    with pytest.raises(UsageError, match="badge"):
        load_badges(Path("nowhere.toml"), bench.recipe.recipe.serial_number)


@pytest.mark.slow
def test_a_hash_is_made_as_the_library_recommends() -> None:
    made = pins.hash_of(Pin(PIN))
    pins.check_hash(made)
    assert pins.is_right(Pin(PIN), made)
