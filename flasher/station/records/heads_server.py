"""Stores chain heads in an append-only table of a PostgreSQL server.

Needs the extra `plant`; imported only when a server is configured.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, Final

from sqlalchemy import (
    BigInteger,
    Column,
    Connection,
    Index,
    MetaData,
    Select,
    Table,
    Text,
    inspect,
    select,
)

from flasher.station.records.database import Location
from flasher.station.records.errors import mapped
from flasher.station.records.heads import ChainHead
from flasher.station.records.server import ServerLock, make_engine
from flasher.station.records.signatures import SigningKey

_PATIENCE_S: Final = 5.0
_metadata: Final = MetaData()
kept_head: Final = Table(
    "kept_head",
    _metadata,
    Column("id", BigInteger, primary_key=True, autoincrement=True),
    Column("records_id", Text, nullable=False),
    Column("station", Text, nullable=False),
    Column("number", BigInteger, nullable=False),
    Column("at", Text, nullable=False),
    Column("hash", Text, nullable=False),
    Column("signature", Text, nullable=False),
    Column("key", Text, nullable=False),
    Index("kept_head_of_row", "records_id", "station", "number"),
    Index("kept_head_last", "records_id", "station", "id"),
)
_HEAD: Final = [kept_head.c[name] for name in ChainHead.__dataclass_fields__]
_RULES: Final = """\
CREATE FUNCTION kept_head_stays() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN RAISE EXCEPTION 'kept heads are neither changed nor deleted'; END $$;
CREATE TRIGGER kept_head_stays BEFORE UPDATE OR DELETE OR TRUNCATE ON kept_head
FOR EACH STATEMENT EXECUTE FUNCTION kept_head_stays();
"""


class ServerPlace:
    """A database of a PostgreSQL server in which chain heads are stored."""

    def __init__(self, location: Location) -> None:
        self.location = location
        self.shown = location.shown
        self._engine = make_engine(location.url, _PATIENCE_S)

    def of(self, station: str, records_id: str) -> ServerHeads:
        return ServerHeads(self, station, records_id)

    def stations(self, records_id: str) -> list[str]:
        query = select(kept_head.c.station).where(kept_head.c.records_id == records_id).distinct()
        with self.connected() as connection:
            return list(connection.execute(query).scalars()) if _is_there(connection) else []

    @contextmanager
    def connected(self, *, writes: bool = False) -> Iterator[Connection]:
        """A transaction in a new connection, as hours may pass between two. Raises RecordError."""
        try:
            with mapped(self.shown, writes=writes), self._engine.begin() as connection:
                yield connection
        finally:
            self._engine.dispose()


class ServerHeads:
    """Chain heads of one station in an append-only table."""

    def __init__(self, place: ServerPlace, station: str, records_id: str) -> None:
        self._place = place
        self._own = {"station": station, "records_id": records_id}

    def append(self, heads: Iterable[ChainHead], _key: SigningKey) -> None:
        """Insert heads; creates the table if needed. Raises RecordError."""
        with self._place.connected(writes=True) as connection:
            if not _is_there(connection):
                # Two stations may create the table at the same time.
                ServerLock.HEADS.hold(connection)
                if not _is_there(connection):
                    _metadata.create_all(connection)
                    connection.exec_driver_sql(_RULES)
            connection.execute(kept_head.insert(), [asdict(head) | self._own for head in heads])

    def last(self) -> ChainHead | None:
        query = self._query().order_by(kept_head.c.id.desc()).limit(1)
        return next(iter(self._heads(query)), None)

    def entries(self, after: int = 0) -> Iterator[ChainHead]:
        query = self._query().where(kept_head.c.number > after).order_by(kept_head.c.id)
        with self._place.connected() as connection:
            if _is_there(connection):
                with connection.execute(query.execution_options(yield_per=1000)) as result:
                    for row in result.mappings():
                        yield ChainHead(**row)

    def of_row(self, number: int) -> tuple[ChainHead, ...]:
        return tuple(self._heads(self._query().where(kept_head.c.number == number)))

    def _query(self) -> Select[Any]:
        return select(*_HEAD).filter_by(**self._own)

    def _heads(self, query: Select[Any]) -> list[ChainHead]:
        with self._place.connected() as connection:
            if not _is_there(connection):
                return []
            return [ChainHead(**row) for row in connection.execute(query).mappings()]


def _is_there(connection: Connection) -> bool:
    return inspect(connection).has_table(kept_head.name)
