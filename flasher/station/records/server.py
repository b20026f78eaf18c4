"""Connects to records on a PostgreSQL server, with timeouts, and locks a station in the whole
plant.

Needs the extra `postgres`; imported only when a server is configured.
"""

from __future__ import annotations

import hashlib
import math
import threading
from typing import Any, Final

import psycopg
from psycopg.pq import TransactionStatus
from sqlalchemy import URL, Connection, Engine, create_engine, event, text
from sqlalchemy.exc import DBAPIError

from flasher.protocol.text import printable
from flasher.station.records.errors import LOCK_NOT_AVAILABLE, StationBusyError, mapped

STATEMENT_LIMIT_S: Final = 30.0
"""Time limit of the server for one statement, not counting waits for locks."""
SILENCE_LIMIT_S: Final = STATEMENT_LIMIT_S + 5.0
"""Silence after which a server is regarded as hung: its own limits have not worked."""
_DEAD_AFTER_S: Final = 25.0
"""Time after which a computer that lost power or network is detected and its locks are free: the
first probe after 10 s, two more, 5 s apart, and the timeout of the last."""
_PROBES: Final = {"keepalives_idle": 10, "keepalives_interval": 5, "keepalives_count": 3}


class _Connection(psycopg.Connection[Any]):
    """A connection that is closed if the server hangs. The server's own limits are shorter."""

    silence_limit_s = SILENCE_LIMIT_S

    def wait(self, gen: Any, interval: float = 0.1, timeout: float | None = None) -> Any:
        limit_s = self.silence_limit_s if timeout is None else timeout
        try:
            return super().wait(gen, interval, limit_s)
        except psycopg.OperationalError:
            if self.pgconn.transaction_status != TransactionStatus.ACTIVE:
                raise
            self.pgconn.finish()  # the state of the connection is unknown
            raise psycopg.OperationalError(f"the server sent nothing for {limit_s:g} s") from None


def make_engine(url: URL, lock_timeout_s: float, statement_limit_s: float | None = None) -> Engine:
    """Create the engine of a server. Limits in the URL take precedence."""
    work_s = STATEMENT_LIMIT_S if statement_limit_s is None else statement_limit_s
    silence_s = SILENCE_LIMIT_S if statement_limit_s is None else statement_limit_s + 5.0
    limits = {
        "lock_timeout": round(lock_timeout_s * 1000),
        "statement_timeout": round((lock_timeout_s + work_s) * 1000),
        **{f"tcp_{name}": value for name, value in _PROBES.items()},
    }
    usual: dict[str, Any] = {
        "connect_timeout": max(2, math.ceil(lock_timeout_s)),
        "application_name": "flasher",
        "tcp_user_timeout": round(_DEAD_AFTER_S * 1000),
        **_PROBES,
    }
    # pre_ping replaces stale connections: a restart of the server must not lose a record.
    engine = create_engine(url, isolation_level="READ COMMITTED", pool_pre_ping=True)

    @event.listens_for(engine, "do_connect")
    def connect(_dialect: Any, _record: Any, _args: Any, wanted: dict[str, Any]) -> Any:
        options = " ".join(f"-c {name}={value}" for name, value in limits.items())
        options = f"{options} {wanted.get('options', '')}".rstrip()
        made = _Connection.connect(**(usual | wanted | {"options": options}))
        made.silence_limit_s = lock_timeout_s + silence_s
        return made

    return engine


class ServerLock:
    """Lock that lets one process in the plant run as a station: held by a session of the server
    from `acquire` until `release` or the end of the process.
    """

    def __init__(self, engine: Engine, station: str, where: str) -> None:
        self._engine = engine
        self._station = station
        self._where = where
        self._session: Connection | None = None
        self.is_held = False
        """True if this process holds the lock."""
        self._mutex = threading.Lock()
        digest = hashlib.sha256(f"flasher station {station}".encode()).digest()
        self._key = int.from_bytes(digest[:8], "big", signed=True)

    def acquire(self) -> None:
        """Acquire the lock; waits for a process that was just killed, up to the lock timeout.
        Raises StationBusyError while another process holds it, RecordError.
        """
        with self._mutex, mapped(self._where, writes=True):
            if not self.is_held:
                self._session = self._locked()
                self.is_held = True

    def check(self) -> None:
        """Check the lock, and acquire it again if the server ended the session. Raises
        StationBusyError if another process has it now, RecordError.
        """
        with self._mutex, mapped(self._where, writes=True):
            if self.is_held and not self._is_alive():
                self._session = self._locked()

    def _is_alive(self) -> bool:
        session = self._session
        if session is None:
            return False
        try:
            session.execute(text("SELECT 1"))
        except DBAPIError:
            self._session = None
            session.invalidate()
            session.close()
            return False
        return True

    def release(self) -> None:
        with self._mutex:
            session, self._session, self.is_held = self._session, None, False
            if session is not None:
                session.close()

    def _locked(self) -> Connection:
        session = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        session.detach()  # closing it ends the session, and the lock with it
        try:
            session.execute(text("SELECT pg_advisory_lock(:key)"), {"key": self._key})
        except DBAPIError as error:
            holder = self._holder(session)
            session.close()
            if getattr(error.orig, "sqlstate", None) != LOCK_NOT_AVAILABLE:
                raise
            raise StationBusyError(
                f"Another process already runs the station {printable(self._station)}{holder}.",
                where=self._where,
                remedy="End that one, or give this station another name. The lock of a "
                f"computer that lost power is free after {_DEAD_AFTER_S:g} s.",
            ) from error
        except BaseException:
            session.close()
            raise
        return session

    def _holder(self, session: Connection) -> str:
        """Address of the client that holds the lock; "" if the server hides it from this user."""
        query = text(
            "SELECT host(client_addr) FROM pg_stat_activity JOIN pg_locks USING (pid)"
            " WHERE locktype = 'advisory' AND granted AND objsubid = 1"
            " AND classid::bigint = (:key >> 32) & 4294967295 AND objid::bigint = :key & 4294967295"
            " AND datname = current_database()"
        )
        try:
            address = session.execute(query, {"key": self._key}).scalar_one_or_none()
        except DBAPIError:
            return ""
        return f", on the computer {printable(address)}" if address else ""
