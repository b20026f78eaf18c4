"""Errors of records, mapped from those of SQLite, PostgreSQL and the disk.

After a `RecordError` of a write, nothing was saved and PASS must not be shown.
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from typing import ClassVar, Final

from sqlalchemy import exc

from flasher.errors import ErrorCode, ExitCode, FlasherError

NOT_SAVED: Final = "RECORD NOT SAVED"


class RecordError(FlasherError):
    """The records could not be read or written."""

    exit_code: ClassVar[ExitCode] = ExitCode.USAGE
    """As for a file that cannot be written: the user makes room or corrects a setting."""
    default_code: ClassVar[ErrorCode] = ErrorCode.RECORDS


class DiskFullError(RecordError):
    """The disk is full."""

    default_code = ErrorCode.RECORDS_NO_ROOM


class RecordsLockedError(RecordError):
    """Another program holds a lock on the database, longer than the timeout."""

    default_code = ErrorCode.RECORDS_LOCKED


class RecordsReadOnlyError(RecordError):
    """The database or its folder is read-only."""

    default_code = ErrorCode.RECORDS_READ_ONLY


class RecordsDamagedError(RecordError):
    """The database is corrupt, or the file is not a database."""

    default_code = ErrorCode.RECORDS_DAMAGED


class SchemaVersionError(RecordError):
    """The records were made by an older or a newer flasher."""

    default_code = ErrorCode.RECORDS_VERSION


class OldSchemaError(SchemaVersionError):
    """The records have an older schema, which this flasher can upgrade."""


class RuleBrokenError(RecordError):
    """A rule of the database refused a write that contradicts other records."""

    default_code = ErrorCode.RECORDS_RULE


class RecordsMovedError(RecordError):
    """The database file was moved while open: writes to it would be lost."""

    default_code = ErrorCode.RECORDS_MOVED


class NotFoundError(RecordError):
    """The unit or run does not exist."""

    default_code = ErrorCode.RECORDS_NOT_FOUND


class StationBusyError(RecordError):
    """Another process runs as this station."""

    default_code = ErrorCode.STATION_RUNNING


class KeyMissingError(RecordError):
    """The station cannot sign: its key is missing, or is not the key of its audit chain."""

    default_code = ErrorCode.STATION_KEY


class RecordsCutError(RecordError):
    """Audit rows of this station are missing: the records are an older copy, or were truncated."""

    default_code = ErrorCode.RECORDS_CUT


class UnprovenError(RecordError):
    """The records were changed, so no certificate is issued."""

    exit_code: ClassVar[ExitCode] = ExitCode.VERIFICATION
    default_code = ErrorCode.RECORDS_UNPROVEN


class Refusal(StrEnum):
    """Why a unit cannot be claimed."""

    UNIT_RUNNING = "UNIT_RUNNING"
    SOCKET_BUSY = "SOCKET_BUSY"
    DUPLICATE = "DUPLICATE"
    REASON_NEEDED = "REASON_NEEDED"
    LOT_FULL = "LOT_FULL"
    LOT_NEEDED = "LOT_NEEDED"
    GOLDEN_DUE = "GOLDEN_DUE"
    OTHER_NATURE = "OTHER_NATURE"
    """A real unit whose serial number is recorded as virtual, or the reverse."""
    WRONG_SERIAL = "WRONG_SERIAL"
    RECIPE_CHANGED = "RECIPE_CHANGED"
    RECIPE_NOT_TRUSTED = "RECIPE_NOT_TRUSTED"
    """The trust file no longer allows an image of the recipe."""
    RECIPE_WITHDRAWN = "RECIPE_WITHDRAWN"
    """The plant has withdrawn the recipe."""
    CLOCK = "CLOCK"
    """The computer's clock is earlier than the last record of this station."""
    CLOCK_OFFSET = "CLOCK_OFFSET"
    """The computer's clock differs from that of the plant's database, or that is not known."""
    NOT_CHECKED = "NOT_CHECKED"
    """The plant's database does not say whether the unit has passed at another station."""
    PLANT_REFUSED = "PLANT_REFUSED"
    """The plant answered that the unit may not be here, or did not answer."""


class ClaimRefusedError(FlasherError):
    """The unit may not be run now; nothing was recorded or changed."""

    exit_code: ClassVar[ExitCode] = ExitCode.USAGE
    default_code = ErrorCode.CLAIM_REFUSED

    def __init__(self, refusal: Refusal, what: str, *, remedy: str) -> None:
        super().__init__(what, remedy=remedy)
        self.refusal = refusal


_Kind = tuple[type[RecordError], str, str]
"""Error class, cause and remedy."""
_MAKE_ROOM: Final = "Make room on the disk, then retry."
_LET_WRITE: Final = "Let this user write the file and its folder."
_LAST_BACKUP: Final = "Stop. Keep the {}, and continue with the last backup."
_UNKNOWN: Final[_Kind] = (
    RecordError,
    "the database failed",
    "Check it, then start the station again.",
)
_RULE: Final[_Kind] = (
    RuleBrokenError,
    "a rule of the database forbids it",
    "This is a fault of the station: keep its log, and report it.",
)
_SQLITE: Final[dict[int, _Kind]] = {
    sqlite3.SQLITE_FULL: (DiskFullError, "the disk is full", _MAKE_ROOM),
    sqlite3.SQLITE_BUSY: (
        RecordsLockedError,
        "another program holds the database",
        "End the program that holds it (a backup, a viewer, a second station), then retry.",
    ),
    sqlite3.SQLITE_LOCKED: (
        RecordsLockedError,
        "the database is locked",
        "End the program that holds it, then retry.",
    ),
    sqlite3.SQLITE_READONLY: (RecordsReadOnlyError, "the database is read-only", _LET_WRITE),
    sqlite3.SQLITE_CANTOPEN: (
        RecordsReadOnlyError,
        "the database cannot be opened",
        "Check that its folder exists and that this user may write there.",
    ),
    sqlite3.SQLITE_CORRUPT: (
        RecordsDamagedError,
        "the database is damaged",
        _LAST_BACKUP.format("file"),
    ),
    sqlite3.SQLITE_NOTADB: (
        RecordsDamagedError,
        "the file is not a database",
        "Name the right file, or continue with the last backup.",
    ),
    sqlite3.SQLITE_IOERR: (
        RecordError,
        "the disk cannot be read or written",
        "Check the disk; do not continue before it works.",
    ),
    sqlite3.SQLITE_CONSTRAINT: _RULE,
}
"""By the primary error code of SQLite."""

LOCK_NOT_AVAILABLE: Final = "55P03"
_NO_SERVER: Final[_Kind] = (
    RecordError,
    "the database server cannot be reached, or ended the connection",
    "Check the server, the network, and in the URL host, port, user, password and database.",
)
_TURNED_AWAY: Final[_Kind] = (
    RecordError,
    "the database server refuses the connection",
    "Check in the URL user, password and database, and at the server pg_hba.conf.",
)
_TOO_SLOW: Final[_Kind] = (
    RecordsLockedError,
    "the database server did not finish in time",
    "Find what delays it (pg_stat_activity shows it), then retry.",
)
_NO_TABLES: Final[_Kind] = (
    RecordError,
    "a table is not in the database",
    "Name the right database, or run flasher plant init, which makes or updates the tables.",
)
"""Undefined table or function."""
_POSTGRESQL: Final[dict[str, _Kind]] = {
    "": _NO_SERVER,
    "08": _NO_SERVER,
    "23": _RULE,
    "28": _TURNED_AWAY,
    "25006": (
        RecordsReadOnlyError,
        "the database is read-only",
        "Name the server that may be written, not its copy.",
    ),
    "40": _TOO_SLOW,
    "42501": (
        RecordsReadOnlyError,
        "this user of the database lacks the right",
        "Use a user that has it. After an update of flasher, run flasher plant init again.",
    ),
    "53": (
        DiskFullError,
        "the disk of the database server is full",
        "Make room on it, then retry.",
    ),
    **dict.fromkeys(("42P01", "42883"), _NO_TABLES),
    LOCK_NOT_AVAILABLE: (
        RecordsLockedError,
        "another program holds the database",
        "End the program that holds it (pg_stat_activity shows it), then retry.",
    ),
    "57": _NO_SERVER,
    "57014": _TOO_SLOW,
    "58": (DiskFullError, "the database server cannot write", "Check its disk, then retry."),
    "XX": (RecordsDamagedError, "the database is damaged", _LAST_BACKUP.format("database")),
}
"""By SQLSTATE or its first two digits; "" if the server did not answer."""
_SYSTEM: Final[dict[int, _Kind]] = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), (DiskFullError, "", _MAKE_ROOM)),
    **dict.fromkeys(
        (errno.EACCES, errno.EPERM, errno.EROFS), (RecordsReadOnlyError, "", _LET_WRITE)
    ),
}


def _state_of(original: object) -> str:
    """SQLSTATE of an error of psycopg. One of connecting has none, but its connection knows whether
    the server asked for a password, and its text has the server's answer.
    """
    state: str = getattr(original, "sqlstate", None) or ""
    connection = getattr(original, "pgconn", None)
    if not state and connection is not None:
        asked = connection.needs_password or connection.used_password
        if asked or "FATAL:" in str(original):
            return "28"
    return state


@contextmanager
def mapped(where: str, *, writes: bool, begin: str = "") -> Iterator[None]:
    """Map errors of the block to RecordErrors. `where` names the database in messages, which start
    with `begin`.
    """
    error: Exception
    cause = ""
    try:
        yield
    except (exc.SQLAlchemyError, sqlite3.Error) as found:
        original = getattr(found, "orig", None) or found
        if isinstance(found, exc.DBAPIError) and not isinstance(original, sqlite3.Error):
            state = _state_of(original)
            chosen = _POSTGRESQL.get(state) or _POSTGRESQL.get(state[:2], _UNKNOWN)
        else:
            code = getattr(original, "sqlite_errorcode", None) or 0
            chosen = _SQLITE.get(code & 0xFF, _UNKNOWN)
        kind, why, remedy = chosen
        message = getattr(getattr(original, "diag", None), "message_primary", None) or str(original)
        cause, error = " ".join(message.split()), found
    except OSError as found:
        usual = (RecordError, "", "Check the disk and the rights of the folder.")
        kind, _, remedy = _SYSTEM.get(found.errno or 0, usual)
        why, error = found.strerror or type(found).__name__, found
    else:
        return
    begin = begin or (NOT_SAVED if writes else "The records cannot be read")
    raise kind(f"{begin}: {why}.", where=where, cause=cause, remedy=remedy) from error
