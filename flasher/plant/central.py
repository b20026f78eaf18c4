"""Connects to the plant's database."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Final

from sqlalchemy import Connection, text
from sqlalchemy.exc import DBAPIError

from flasher.errors import ErrorCode, UsageError
from flasher.plant.functions import REFUSED
from flasher.plant.schema import PLANT_SCHEMA, VERSION_TABLE
from flasher.protocol.text import printable
from flasher.station.records.database import Database, Location, locate
from flasher.station.records.errors import RuleBrokenError, mapped

LOCK_TIMEOUT_S: Final = 10.0
_NAME_ONE: Final = (
    "Name postgresql://USER@HOST/NAME; in a password, @ is written %40 and / is written %2F."
)


_OWNS: Final = text(
    "SELECT pg_has_role(current_user, relowner, 'USAGE'), pg_get_userbyid(relowner)"
    " FROM pg_class WHERE oid = 'chain_row'::regclass"
)


class Refusal(StrEnum):
    """Why the plant refuses a station's chain."""

    FORKED = "forked"
    """Two chains continue the same row: records were copied, or restored and written again."""
    EDITED = "edited"
    """Rows do not have the hash or the digests that the chain states."""
    REPLAYED = "replayed"
    """The station's records end before the plant's: an older copy."""
    INCOMPLETE = "incomplete"
    """A row is missing in between."""
    TAKEN_OVER = "taken-over"
    """Another PC continues the station."""
    FOREIGN = "foreign"
    """The chain belongs to another station, user or records."""

    @property
    def remedy(self) -> str:
        if self is Refusal.TAKEN_OVER:
            return (
                "End the station on this PC. What it has recorded since then: flasher station"
                " bring-in, on the other PC. To take the station back: flasher station take-over."
            )
        if self is Refusal.FOREIGN:
            return (
                "If the station has new records: flasher plant init --renew STATION --database"
                " URL. Else give this station its own user."
            )
        return (
            "Find out who changed or copied the records (flasher station verify). Units that this"
            " station passes are not in the plant's records until then."
        )


class ChainRefusedError(RuleBrokenError):
    """The plant's database refused a station's chain. Nothing was stored."""

    def __init__(self, refusal: Refusal, detail: str, *, where: str) -> None:
        super().__init__(
            f"The plant refuses this station's audit trail, {refusal.value}: {printable(detail)}.",
            where=where,
            remedy=refusal.remedy,
        )
        self.refusal = refusal
        self.text = f"{refusal.value}: {detail}"


def plant_location(url: str) -> Location:
    """Parse the URL of a plant's database, which it names. Raises UsageError."""
    try:
        location = locate(url, Path())
    except UsageError as error:
        error.remedy = _NAME_ONE
        raise
    if location.url.get_backend_name() != "postgresql":
        raise UsageError(
            f"{location.shown} is not a PostgreSQL database.",
            remedy=_NAME_ONE,
        )
    if not location.url.database:
        raise UsageError("The URL names no database.", remedy="Add /NAME to it, such as /flasher.")
    return location


class Central(Database):
    """The plant's database, with statements for its owner and its stations. Each method raises
    RecordError, ChainRefusedError.
    """

    def __init__(
        self,
        url: str,
        *,
        database: str | None = None,
        statement_limit_s: float | None = None,
        lock_timeout_s: float = LOCK_TIMEOUT_S,
    ) -> None:
        location = plant_location(url)
        if database is not None:
            location = replace(location, url=location.url.set(database=database))
        super().__init__(location, lock_timeout_s, statement_limit_s=statement_limit_s)

    @property
    def shown(self) -> str:
        """URL for messages, without a password."""
        return self.location.shown

    def check_schema(self) -> None:
        """Check that the tables are those of this flasher. Raises UsageError, RecordError."""
        with self.reading() as connection:
            found = schema_of(connection, self.shown)
        if found != PLANT_SCHEMA:
            raise _other_schema(
                found,
                self.shown,
                cause="an older flasher made its tables",
                remedy="The owner of the database runs flasher plant init --database URL, which"
                " upgrades them.",
            )

    def check_owner(self, what: str) -> None:
        """Check that this user owns the tables. `what` only the owner may do. Raises UsageError."""
        with self.reading() as connection:
            is_owner, owner = connection.execute(_OWNS).one()
        if not is_owner:
            raise UsageError(
                f"Only the owner of the plant's database may {what}.",
                where=self.shown,
                remedy=f"Use the user {printable(owner)}.",
            )

    @contextmanager
    def outside_transaction(self) -> Iterator[Connection]:
        """Connect in autocommit mode, for what a transaction cannot do."""
        with self._mapped(writes=True), self.engine.connect() as connection:
            yield connection.execution_options(isolation_level="AUTOCOMMIT")

    @contextmanager
    def _mapped(self, *, writes: bool) -> Iterator[None]:
        begin = f"The plant's database cannot be {'written' if writes else 'read'}"
        with mapped(self.shown, writes=writes, begin=begin):
            try:
                yield
            except DBAPIError as error:
                if getattr(error.orig, "sqlstate", None) != REFUSED:
                    raise
                message = getattr(error.orig.diag, "message_primary", "")  # type: ignore[union-attr]
                word, _, detail = message.partition(": ")
                raise ChainRefusedError(Refusal(word), detail, where=self.shown) from error


@contextmanager
def open_central(url: str) -> Iterator[Central]:
    """Open a plant's database for a command that knows its tables. A station, which knows only
    its functions, opens `Central` itself: it goes on when the database is upgraded first. Raises
    UsageError, RecordError.
    """
    with closing(Central(url)) as central:
        central.check_schema()
        yield central


def schema_of(connection: Connection, where: str) -> str:
    """Schema of a plant's tables: this flasher's or an older one. Raises UsageError for a newer
    one.
    """
    query = text(f"SELECT version_num FROM {VERSION_TABLE}")  # noqa: S608  a constant
    found = str(connection.execute(query).scalar_one())
    if not found.isdecimal() or int(found) > int(PLANT_SCHEMA):
        raise _other_schema(
            found,
            where,
            cause="a newer flasher made its tables",
            remedy="Update flasher on this computer to the version that made them.",
        )
    return found


def _other_schema(found: str, where: str, *, cause: str, remedy: str) -> UsageError:
    return UsageError(
        f"The plant's database has schema {printable(found)}; this flasher has schema"
        f" {PLANT_SCHEMA}.",
        where=where,
        cause=cause,
        remedy=remedy,
        code=ErrorCode.RECORDS_VERSION,
    )
