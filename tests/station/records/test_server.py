"""Records on a PostgreSQL server: what hangs ends in time, and stations keep out of each other."""

from __future__ import annotations

import os
import signal
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psycopg
import pytest

from flasher.station.records import server
from flasher.station.records.errors import (
    ClaimRefusedError,
    RecordError,
    RecordsLockedError,
    Refusal,
    StationBusyError,
)
from flasher.station.records.model import AuditEvent, Claim, Order, RunState
from flasher.station.records.store import Store
from tests.station.factory import SERIAL, USUAL, Bench
from tests.station.postgres import Server
from tests.station.records.test_rules import refused

pytestmark = pytest.mark.slow


@pytest.fixture
def bench(server_bench: Bench) -> Bench:
    return server_bench


# -- limits ---------------------------------------------------------------------------------------


def test_records_that_another_session_holds_are_waited_for_and_then_an_error(bench: Bench) -> None:
    with bench.opened("line-9", lock_timeout_s=0.05) as store:
        store.recover()
        with bench.outsider() as holder:
            holder.execute("LOCK TABLE audit")
            with pytest.raises(RecordsLockedError):
                store.note(AuditEvent.RESUME, {})
            holder.execute("LOCK TABLE alembic_version")
            with pytest.raises(RecordsLockedError):
                bench.opened("line-9", lock_timeout_s=0.05)
        store.note(AuditEvent.RESUME, {})


def test_a_statement_does_not_take_longer_than_its_limit(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "STATEMENT_LIMIT_S", 0.05)
    with (
        bench.opened(lock_timeout_s=0.05) as store,
        pytest.raises(RecordsLockedError),
        store.database.reading() as connection,
    ):
        connection.exec_driver_sql("SELECT pg_sleep(20)")


def test_a_server_that_hangs_is_given_up_and_used_again_when_it_works(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "SILENCE_LIMIT_S", 0.3)
    with bench.opened("line-9", lock_timeout_s=0.1) as store:
        store.recover()
        sessions = []
        with pytest.raises(RecordError, match="cannot be reached") as caught:  # noqa: PT012  SIM117
            with store.database.writing() as connection:
                sessions.append(connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one())
                os.kill(sessions[0], signal.SIGSTOP)
                connection.exec_driver_sql("SELECT 1")
        os.kill(sessions[0], signal.SIGCONT)
        assert "sent nothing for 0.4 s" in caught.value.cause
    bench.store.note(AuditEvent.RESUME, {})


def test_a_server_that_is_not_there_or_says_nothing_is_an_error(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        url = f"postgresql://jo@127.0.0.1:{port}/records"
        began = time.perf_counter()
        with pytest.raises(RecordError, match="cannot be reached"):
            Store.open(url, station="x", folder=tmp_path, lock_timeout_s=0.1)
        assert time.perf_counter() - began < 10.0
    with pytest.raises(RecordError, match="cannot be reached") as caught:
        Store.open(url, station="x", folder=tmp_path)
    assert "refused" in caught.value.cause
    assert "network" in caught.value.remedy


def test_a_server_that_was_started_again_costs_no_record(bench: Bench, postgres: Server) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    with postgres.connect() as other:
        other.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
            " WHERE application_name = 'flasher'"
        )
    bench.store.finish(run_id, bench.ending())
    assert bench.store.read.run(run_id).run.state is RunState.PASS
    with bench.opened(lock_timeout_s=0.05) as second, pytest.raises(StationBusyError):
        second.recover()  # the lock was taken again, too


# -- stations -------------------------------------------------------------------------------------


def test_another_computer_with_this_station_s_name_ends_no_run_of_it(
    bench: Bench, tmp_path: Path
) -> None:
    run_id = bench.claim().run_id
    elsewhere = Store.open(
        str(bench.url), station="line-2", folder=tmp_path / "elsewhere", lock_timeout_s=0.02
    )
    with elsewhere, pytest.raises(StationBusyError, match="line-2, on the computer 127"):
        elsewhere.recover()
    assert bench.store.read.run(run_id).run.state is RunState.RUNNING
    bench.store.close()
    bench.store = bench.opened()
    assert bench.store.recover() == (run_id,)


def test_a_station_that_lost_its_name_to_another_writes_no_more(
    bench: Bench, postgres: Server
) -> None:
    with bench.opened("line-7", lock_timeout_s=0.05) as first:
        first.recover()
        with bench.opened("line-7") as second:
            with postgres.connect() as admin:
                admin.execute(
                    "SELECT pg_terminate_backend(pid) FROM pg_locks"
                    " WHERE locktype = 'advisory' AND granted"
                )
            second.recover()
            with pytest.raises(StationBusyError):
                first.claim(Order(SERIAL, "A", "jo"), bench.recipe)
            assert second.claim(Order(SERIAL, "A", "jo"), bench.recipe).serial == SERIAL


def test_of_two_stations_that_claim_one_unit_one_gets_it(bench: Bench) -> None:
    bench.use(USUAL + "\n[lot]\nquantity_max = 5\n")
    stations = [bench.opened(name) for name in ("line-3", "line-4", "line-5", "line-6")]
    for store in stations:
        store.recover()

    def claims(store: Store) -> list[Claim | Refusal]:
        said: list[Claim | Refusal] = []
        for number in range(10):
            try:
                order = Order(f"W26051{number:02}", f"{number}", "jo", "L1")
                said.append(store.claim(order, bench.recipe))
            except ClaimRefusedError as error:
                said.append(error.refusal)
        return said

    with ThreadPoolExecutor(len(stations)) as pool:
        said = list(pool.map(claims, stations))
    for store in stations:
        store.close()
    every = [each for some in said for each in some]
    begun = [each.serial for each in every if isinstance(each, Claim)]
    assert len(begun) == len(set(begun)) == 5  # each unit once, and no more than the lot takes
    refusals = {each for each in every if isinstance(each, Refusal)}
    assert refusals <= {Refusal.UNIT_RUNNING, Refusal.LOT_FULL}
    assert not bench.store.examine().problems


def test_who_reads_sees_one_moment_while_others_write(bench: Bench) -> None:
    with bench.store.database.reading() as connection:
        count = "SELECT count(*) FROM audit"
        before = connection.exec_driver_sql(count).scalar_one()
        bench.make()
        assert connection.exec_driver_sql(count).scalar_one() == before


# -- rules ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", ["audit", "run CASCADE", "schema_info", "attachment"])
def test_no_table_is_emptied(bench: Bench, table: str) -> None:
    with bench.outsider() as other:
        assert "not deleted" in refused(other, f"TRUNCATE {table}")


def test_a_table_of_a_session_s_own_stands_before_no_record(bench: Bench) -> None:
    bench.make()
    with bench.outsider() as other:
        other.execute("CREATE TEMPORARY TABLE run AS SELECT id, 'RUNNING' AS state FROM run")
        assert "immutable" in refused(other, "UPDATE public.run_target SET reached = 2")
        assert isinstance(other, psycopg.Connection)
