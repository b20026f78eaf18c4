# ruff: noqa: S608  the statements of these tests are written here
"""The rules of the records are in the database: another program cannot break them either."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from flasher.station.records.errors import RuleBrokenError
from flasher.station.records.model import (
    Measurement,
    RunId,
    RunResult,
    RunState,
    StepState,
    Verified,
)
from flasher.station.records.schema import metadata
from flasher.station.records.triggers import RULES
from tests.station.factory import BMS_VERSION, Bench

SHA = "a" * 64


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Records with one run that goes on; what is refused leaves them as they are."""
    made = Bench(tmp_path_factory.mktemp("running"))
    made.claim()
    yield made
    made.store.close()


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Records with one run that passed, with a row in every table."""
    made = Bench(tmp_path_factory.mktemp("finished"))
    run_id = made.claim().run_id
    made.work(run_id)
    measured = [Measurement("u", 36.5, "V", 30.0, 42.0)]
    made.store.step(run_id, "check", StepState.PASS, duration_s=1.0, measurements=measured)
    made.store.finish(run_id, made.ending())
    yield made
    made.store.close()


def refused(connection: Any, *statements: str) -> str:
    """What the database says when it refuses the last of some statements."""
    for statement in statements[:-1]:
        connection.execute(statement)
    with pytest.raises(sqlite3.IntegrityError) as caught:
        connection.execute(statements[-1])
    connection.rollback()
    return str(caught.value)


INSERT_RUN = (
    "INSERT INTO run SELECT 99, {unit}, {socket}, recipe_id, lot_id, operator_id, kind, is_virtual,"
    " reason, '{state}', '', '', begun_at, begun_monotonic_s, NULL, NULL,"
    " {required}, allow_completed_not_read_back, NULL, NULL FROM run LIMIT 1"
)


def test_two_runs_of_one_unit_or_socket_cannot_run_at_once(running: Bench) -> None:
    others = (
        "INSERT INTO unit VALUES (99, 'BAT-36', 'W2600099')",
        "INSERT INTO socket VALUES (99, 1, 'Z')",
    )
    same_unit = INSERT_RUN.format(unit="unit_id", socket="99", state="RUNNING", required=1)
    same_socket = INSERT_RUN.format(unit="99", socket="socket_id", state="RUNNING", required=1)
    for statement, what in ((same_unit, "unit"), (same_socket, "socket")):
        with running.outsider() as other:
            reported = refused(other, *others, statement)
        assert f"run.{what}_id" in reported or f"one_running_run_per_{what}" in reported


@pytest.mark.parametrize(
    ("state", "required", "why"), [("PASS", 1, "begins RUNNING"), ("RUNNING", 0, "its recipe")]
)
def test_a_run_is_not_born_finished_nor_with_an_easier_verification(
    finished: Bench, state: str, required: int, why: str
) -> None:
    statement = INSERT_RUN.format(
        unit="unit_id", socket="socket_id", state=state, required=required
    )
    with finished.outsider() as other:
        assert why in refused(other, statement)


ENDED = (
    "UPDATE run SET state = 'PASS', code = 'OK', ended_at = '2026-05-17T09:00:00.000000Z',"
    " ended_monotonic_s = 1e9, verification_reached = {reached}, log_sha256 = {log}"
)


@pytest.mark.parametrize(
    ("statement", "why"),
    [
        (ENDED.format(reached="1", log="NULL"), "PASS needs|pass_has_an_end_and_a_log"),
        (ENDED.format(reached="1", log="'abc'"), "PASS needs|pass_has"),
        (ENDED.format(reached="NULL", log=f"'{SHA}'"), "PASS needs|pass_is_verified"),
        (ENDED.format(reached="0", log=f"'{SHA}'"), "PASS needs|pass_is_verified"),
        (ENDED.format(reached="1", log=f"'{SHA}'"), "PASS needs"),
        ("UPDATE run SET state = 'PASS'", "PASS needs|finished_has"),
        ("UPDATE run SET state = 'FAIL', code = 'X'", "finished_has"),
        ("UPDATE run SET state = 'GREEN'", "state_is_known|finished_has"),
        ("UPDATE run SET verification_required = 0", "claimed with is final"),
        ("UPDATE run SET unit_id = 2", "claimed with is final"),
        ("UPDATE run_target SET required = 0", "claimed with is final"),
        ("DELETE FROM run", "not deleted"),
    ],
)
def test_a_running_run_cannot_be_made_what_it_is_not(
    running: Bench, statement: str, why: str
) -> None:
    with running.outsider() as other:
        reported = refused(other, statement)
    assert any(each in reported for each in why.split("|")), reported


@pytest.mark.parametrize(
    ("reached", "log", "why"),
    [
        ("1", "NULL", "pass_has_an_end_and_a_log"),
        ("1", "'abc'", "pass_has_an_end_and_a_log"),
        ("NULL", f"'{SHA}'", "pass_is_verified"),
        ("0", f"'{SHA}'", "pass_is_verified"),
        ("7", f"'{SHA}'", "reached_is_known"),
    ],
)
def test_the_rules_of_one_row_hold_without_triggers(
    running: Bench, reached: str, log: str, why: str
) -> None:
    with running.outsider() as other:
        other.execute("BEGIN")
        for rule in RULES:
            other.execute(f"DROP TRIGGER {rule.name}")
        assert why in refused(other, ENDED.format(reached=reached, log=log))


def ending_with(bench: Bench, **changes: object) -> RunResult:
    """A good ending with changes."""
    good = bench.ending()
    return RunResult(**{**good.__dict__, **changes})


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda b: ending_with(b, verified={}), "verified"),
        (lambda b: ending_with(b, verified={"bms": Verified.COMPLETED}), "verified"),
        (lambda b: ending_with(b, trace_sha256=None), "log"),
        (lambda b: ending_with(b, trace_sha256=SHA), "log attached"),
        (lambda b: ending_with(b, attachments=()), "log attached"),
        (lambda b: ending_with(b, code=""), "finished_has_a_code"),
    ],
)
def test_a_false_pass_is_not_saved(
    bench: Bench, spoil: Callable[[Bench], RunResult], why: str
) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    with pytest.raises(RuleBrokenError, match="RECORD NOT SAVED") as caught:
        bench.store.finish(run_id, spoil(bench))
    assert why in caught.value.cause
    details = bench.store.read.run(run_id)
    assert details.run.state is RunState.RUNNING
    assert not details.attachments  # nothing of the transaction was kept
    bench.store.finish(run_id, bench.ending())  # and it can still be ended truly


def test_a_pass_needs_the_last_try_of_every_step_and_every_write(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    bench.store.step(run_id, "verify", StepState.FAIL, duration_s=1.0)
    with pytest.raises(RuleBrokenError) as caught:
        bench.store.finish(run_id, bench.ending())
    assert "last try" in caught.value.cause
    bench.store.step(run_id, "verify", StepState.PASS, duration_s=1.0)
    write = bench.store.intent(run_id, "bms", "model", "X")
    with pytest.raises(RuleBrokenError) as caught:
        bench.store.finish(run_id, bench.ending())
    assert "every write" in caught.value.cause
    again = bench.store.intent(run_id, "bms", "model", "X")
    bench.store.verified(again, "X")
    bench.store.finish(run_id, bench.ending())
    assert write != again


def test_a_pass_without_any_step_is_none(bench: Bench) -> None:
    run_id = bench.claim().run_id
    with pytest.raises(RuleBrokenError):
        bench.store.finish(run_id, bench.ending())


@pytest.mark.parametrize(
    "measured",
    [
        Measurement("u", 29.9, "V", 30.0, 42.0),
        Measurement("u", 42.1, "V", 30.0, 42.0),
        Measurement("u", -1.0, low=0.0),
        Measurement("hw", text="A", expected="B"),
        Measurement("nothing"),
        Measurement("both", 1.0, text="x"),
        Measurement("u", float("nan"), low=0.0),
        Measurement("u", 1.0, high=float("inf")),
    ],
)
def test_a_step_does_not_pass_with_a_measurement_out_of_limits(
    running: Bench, measured: Measurement
) -> None:
    run_id = RunId(1)
    with pytest.raises(RuleBrokenError):
        running.store.step(run_id, "check", StepState.PASS, duration_s=1.0, measurements=[measured])
    assert not running.store.read.run(run_id).steps


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE run SET text = 'x'",
        "UPDATE run SET state = 'RUNNING', ended_at = NULL",
        "UPDATE run SET operator_id = 1, code = 'OK2'",
        "DELETE FROM run",
        "UPDATE step SET state = 'PASS'",
        "DELETE FROM step",
        (
            "INSERT INTO step SELECT 99, run_id, 99, name, 1, state, code, text, begun_at,"
            " begun_monotonic_s, duration_s FROM step LIMIT 1"
        ),
        (
            "INSERT INTO measurement SELECT 99, step_id, name, value, unit, low, high, text,"
            " expected FROM measurement LIMIT 1"
        ),
        "UPDATE measurement SET value = 36",
        "DELETE FROM measurement",
        "UPDATE device_write SET value = 'x'",
        "UPDATE device_write SET read_back = 'x'",
        "DELETE FROM device_write",
        "INSERT INTO attachment SELECT 99, run_id, 'x', 'x', sha256, 1 FROM attachment LIMIT 1",
        f"UPDATE attachment SET sha256 = '{SHA}'",
        "DELETE FROM attachment",
        "UPDATE run_target SET reached = 2",
        "DELETE FROM run_target",
        "UPDATE recipe SET content = ''",
        "DELETE FROM recipe",
        f"UPDATE artifact SET sha256 = '{SHA}'",
        "UPDATE unit SET serial = 'X'",
        "DELETE FROM unit",
        "DELETE FROM operator",
        "UPDATE audit SET data = '{}'",
        "DELETE FROM audit",
        f"INSERT INTO audit VALUES (99, 1, 9, 'x', 'x', NULL, '', '{SHA}', '{SHA}', 'x')",
        "INSERT INTO unit SELECT 99, part, serial FROM unit",
        "INSERT INTO station SELECT 99, name FROM station",
        "UPDATE operator SET name = 'X'",
        "UPDATE socket SET name = 'X'",
        "UPDATE station SET name = 'X'",
    ],
)
def test_what_is_finished_stays_as_it_is(finished: Bench, statement: str) -> None:
    with finished.outsider() as other:
        refused(other, statement)


@pytest.mark.parametrize(
    "statement",
    [
        # Another program does not ask for the triggers of what REPLACE deletes.
        "INSERT INTO unit VALUES (1, 'BAT-36', 'X')",
        "INSERT INTO operator VALUES (1, 'X')",
        INSERT_RUN.replace("99", "id").format(
            unit="unit_id", socket="socket_id", state="RUNNING", required=1
        ),
    ],
)
def test_nothing_is_replaced(finished: Bench, statement: str) -> None:
    with finished.outsider() as other:
        refused(other, statement.replace("INSERT", "INSERT OR REPLACE"))


def test_a_unit_is_real_or_virtual_and_its_nature_is_final(finished: Bench) -> None:
    virtual = INSERT_RUN.replace("is_virtual", "TRUE").format(
        unit="unit_id", socket="socket_id", state="RUNNING", required=1
    )
    with finished.outsider() as other:
        assert "never both" in refused(other, virtual)
        refused(other, "UPDATE run SET is_virtual = TRUE")


def test_replacing_a_row_is_deleting_it(bench: Bench) -> None:
    bench.make()
    with pytest.raises(RuleBrokenError), bench.store.database.writing() as connection:
        connection.exec_driver_sql("INSERT OR REPLACE INTO unit VALUES (1, 'BAT-36', 'X')")


def test_an_intent_is_verified_once_and_only_while_its_run_goes_on(bench: Bench) -> None:
    run_id = bench.claim().run_id
    write = bench.store.intent(run_id, "bms", "flash", BMS_VERSION)
    bench.store.verified(write, BMS_VERSION)
    with pytest.raises(RuleBrokenError):
        bench.store.verified(write, "another")
    open_write = bench.store.intent(run_id, "bms", "model", "X")
    bench.store.finish(run_id, bench.ending(RunState.FAIL, "X"))
    with pytest.raises(RuleBrokenError):
        bench.store.verified(open_write, "X")
    with pytest.raises(RuleBrokenError):
        bench.store.intent(run_id, "bms", "model", "X")
    with pytest.raises(RuleBrokenError):
        bench.store.step(run_id, "late", StepState.PASS, duration_s=0.0)


def test_the_rules_have_names_of_their_own_and_stand_on_tables() -> None:
    names = [rule.name for rule in RULES]
    assert len(set(names)) == len(names)
    assert {rule.table for rule in RULES} <= set(metadata.tables)
