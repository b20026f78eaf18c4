"""Connections to a plant's server: what hangs ends in time."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import closing

import psycopg
import pytest

from flasher.plant.central import Central
from flasher.station.records import server
from flasher.station.records.errors import RecordError, RecordsLockedError
from tests.plant.factory import Plant
from tests.station.postgres import OWNER

pytestmark = pytest.mark.slow


@pytest.fixture
def central(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> Iterator[Central]:
    monkeypatch.setattr(server, "SILENCE_LIMIT_S", 0.3)
    with closing(Central(plant.url(OWNER), lock_timeout_s=0.1)) as made:
        yield made


def test_a_table_that_another_session_holds_is_waited_for_and_then_an_error(
    central: Central, plant: Plant
) -> None:
    with plant.server.connect(plant.database) as holder:
        holder.execute("LOCK TABLE chain_row")
        with pytest.raises(RecordsLockedError), central.writing() as connection:
            connection.exec_driver_sql("LOCK TABLE chain_row")
    with central.writing() as connection:
        connection.exec_driver_sql("LOCK TABLE chain_row")


def test_a_statement_does_not_take_longer_than_its_limit(plant: Plant) -> None:
    url = plant.url(OWNER)
    with (
        closing(Central(url, lock_timeout_s=0.05, statement_limit_s=0.05)) as central,
        pytest.raises(RecordsLockedError),
        central.reading() as connection,
    ):
        connection.exec_driver_sql("SELECT pg_sleep(20)")


def test_a_server_that_hangs_is_given_up_and_used_again_when_it_works(
    central: Central,
) -> None:
    sessions = []
    with pytest.raises(RecordError, match="cannot be reached") as caught:  # noqa: PT012  SIM117
        with central.writing() as connection:
            sessions.append(connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one())
            os.kill(sessions[0], signal.SIGSTOP)
            connection.exec_driver_sql("SELECT 1")
    os.kill(sessions[0], signal.SIGCONT)
    assert "sent nothing for 0.4 s" in caught.value.cause
    with central.writing() as connection:
        connection.exec_driver_sql("SELECT 1")


@pytest.mark.parametrize(
    "error",
    [
        psycopg.errors.LockNotAvailable("canceling statement due to lock timeout"),
        psycopg.errors.PipelineAborted("pipeline aborted"),
    ],
)
def test_an_error_while_a_statement_of_a_pipeline_is_active_is_no_silence(
    plant: Plant, error: psycopg.Error
) -> None:
    def receiving() -> Iterator[None]:
        yield from ()
        raise error

    with closing(server._Connection.connect(plant.url(OWNER))) as connection:
        connection.pgconn.send_query(b"SELECT pg_sleep(0.01)")
        with pytest.raises(psycopg.Error) as caught:
            connection.wait(receiving())
        assert caught.value is error
        assert not connection.closed


def test_a_server_that_is_not_there_or_sends_nothing_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        url = f"postgresql://jo@127.0.0.1:{port}/records"
        began = time.perf_counter()
        with (
            closing(Central(url, lock_timeout_s=0.1)) as central,
            pytest.raises(RecordError, match="cannot be reached"),
            central.reading(),
        ):
            pass
        assert time.perf_counter() - began < 10.0
    with closing(Central(url)) as central, pytest.raises(RecordError) as caught, central.reading():
        pass
    assert "refused" in caught.value.cause
    assert "network" in caught.value.remedy
