"""Connects to a PostgreSQL server, with timeouts.

Needs the extra `plant`; imported only when a server is configured.
"""

from __future__ import annotations

import math
import time
from enum import IntEnum
from typing import Any, Final

import psycopg
from psycopg.pq import TransactionStatus
from sqlalchemy import URL, Connection, Engine, create_engine, event, text

STATEMENT_LIMIT_S: Final = 30.0
"""Time limit of the server for one statement, not counting waits for locks."""
SILENCE_LIMIT_S: Final = STATEMENT_LIMIT_S + 5.0
"""Silence after which a server is regarded as hung: its own limits have not worked."""
_DEAD_AFTER_S: Final = 25.0
"""Time after which a computer that lost power or network is detected: the first probe after 10 s,
two more, 5 s apart, and the timeout of the last."""
_PROBES: Final = {"keepalives_idle": 10, "keepalives_interval": 5, "keepalives_count": 3}


class ServerLock(IntEnum):
    """Advisory locks; each is one for a whole database."""

    HEADS = 7052
    """The table of chain heads is made."""
    SETUP = 7053
    """The tables of a plant are made or upgraded."""
    RETIRING = 7054
    """A retired month is deleted."""
    UNIT = 7055
    """A unit is claimed: seed of the hash of its part and serial number."""
    PUBLISHING = 7056
    """A recipe is published: its revision is compared with those that are published."""

    def hold(self, connection: Connection) -> None:
        """Wait for the lock; it ends with the transaction."""
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": self.value})


class _Connection(psycopg.Connection[Any]):
    """A connection that is closed if the server hangs. The server's own limits are shorter."""

    silence_limit_s = SILENCE_LIMIT_S

    def wait(self, gen: Any, interval: float = 0.1, timeout: float | None = None) -> Any:
        limit_s = self.silence_limit_s if timeout is None else timeout
        began = time.perf_counter()
        try:
            return super().wait(gen, interval, limit_s)
        except psycopg.OperationalError as error:
            # In a pipeline, an error of the server, too, comes while a statement is active.
            is_active = self.pgconn.transaction_status == TransactionStatus.ACTIVE
            waited_s = time.perf_counter() - began  # psycopg takes a coarser clock
            if error.sqlstate is not None or not is_active or waited_s < 0.9 * limit_s:
                raise
            self.pgconn.finish()  # the state of the connection is unknown
            raise psycopg.OperationalError(f"the server sent nothing for {limit_s:g} s") from None


def make_engine(url: URL, lock_timeout_s: float, statement_limit_s: float | None = None) -> Engine:
    """Create the engine of a server. Settings in the URL take precedence."""
    work_s = STATEMENT_LIMIT_S if statement_limit_s is None else statement_limit_s
    silence_s = SILENCE_LIMIT_S if statement_limit_s is None else statement_limit_s + 5.0
    settings = {
        # It compiles what it plans as long, for longer than these queries then take.
        "jit": "off",
        "timezone": "UTC",
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
        options = " ".join(f"-c {name}={value}" for name, value in settings.items())
        options = f"{options} {wanted.get('options', '')}".rstrip()
        made = _Connection.connect(**(usual | wanted | {"options": options}))
        made.silence_limit_s = lock_timeout_s + silence_s
        return made

    return engine
