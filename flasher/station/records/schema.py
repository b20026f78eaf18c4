"""Tables of the records, with the rules for one row or one index; `triggers` has the others.

A change needs a new `SCHEMA_VERSION` and a module in `migrations.versions`. Times are UTC texts of
constant length (`model.utc_text`); durations come from the monotonic clock.
"""

from __future__ import annotations

from typing import Any, Final

from sqlalchemy import (
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    PrimaryKeyConstraint,
    SmallInteger,
    String,
    Table,
    Text,
    UniqueConstraint,
    text,
)

from flasher.station.records.model import RunKind, RunState, StepState, Verified

SCHEMA_VERSION: Final = 3

metadata: Final = MetaData()

_LEVELS: Final = f"BETWEEN {min(Verified)} AND {max(Verified)}"
_UTC_SIZE: Final = 27
_SHA256_SIZE: Final = 64
_SIGNATURE_SIZE: Final = 88
"""Characters: 64 bytes in base64."""


def _key() -> Column[int]:
    # SQLite assigns ids only in an INTEGER column.
    return Column("id", BigInteger().with_variant(Integer, "sqlite"), primary_key=True)


def _foreign_key(table: str, *, nullable: bool = False, index: bool = False) -> Column[int]:
    return Column(
        f"{table}_id",
        BigInteger().with_variant(Integer, "sqlite"),
        ForeignKey(f"{table}.id", ondelete="RESTRICT"),
        nullable=nullable,
        index=index,
    )


def _table(name: str, *columns: Any) -> Table:
    return Table(name, metadata, _key(), *columns)


def _text(name: str, size: int = 200) -> Column[str]:
    return Column(name, String(size), nullable=False)


def _utc(name: str, *, nullable: bool = False) -> Column[str]:
    return Column(name, String(_UTC_SIZE), nullable=nullable)


def _sha256(name: str, *, nullable: bool = False) -> Column[str]:
    return Column(name, String(_SHA256_SIZE), nullable=nullable)


def _one_of(column: str, words: Any) -> CheckConstraint:
    allowed = ", ".join(f"'{word.value}'" for word in words)
    return CheckConstraint(f"{column} IN ({allowed})", name=f"{column}_is_known")


schema_info: Final = Table(
    "schema_info",
    metadata,
    Column("version", Integer, primary_key=True, autoincrement=False),
    _utc("created_at"),
    _text("records_id", 32),
)
"""`records_id` identifies these records and their copies. `version` makes a flasher older than
Alembic refuse them."""

alembic_version: Final = Table(
    "alembic_version",
    metadata,
    Column("version_num", String(32), nullable=False),
    PrimaryKeyConstraint("version_num", name="alembic_version_pkc"),
)
"""Revision of the schema in `migrations.versions`, as Alembic stores it."""

station: Final = _table("station", _text("name"), UniqueConstraint("name"))

socket: Final = _table(
    "socket", _foreign_key("station"), _text("name"), UniqueConstraint("station_id", "name")
)

operator: Final = _table("operator", _text("name"), UniqueConstraint("name"))

artifact: Final = _table(
    "artifact",
    _text("target", 16),
    _text("name"),
    _text("version", 64),
    _sha256("sha256"),
    Column("size_bytes", BigInteger, nullable=False),
    UniqueConstraint("target", "sha256", "name"),
    CheckConstraint("length(sha256) = 64", name="sha256_is_whole"),
)

recipe: Final = _table(
    "recipe",
    _text("name"),
    _text("revision", 64),
    _text("part"),
    _sha256("sha256"),
    Column("content", Text, nullable=False),
    Column("verification_required", SmallInteger, nullable=False),
    Column("allow_completed_not_read_back", Boolean, nullable=False),
    UniqueConstraint("sha256"),
    CheckConstraint("length(sha256) = 64", name="sha256_is_whole"),
    CheckConstraint(f"verification_required {_LEVELS}", name="level_is_known"),
)

lot: Final = _table("lot", _text("part"), _text("name"), UniqueConstraint("part", "name"))

unit: Final = _table(
    "unit",
    _text("part"),
    _text("serial"),
    UniqueConstraint("part", "serial"),
    Index("unit_by_serial", "serial"),
    CheckConstraint("serial <> '' AND part <> ''", name="unit_has_a_name"),
)

run: Final = _table(
    "run",
    _foreign_key("unit"),
    _foreign_key("socket"),
    _foreign_key("recipe"),
    _foreign_key("lot", nullable=True),
    _foreign_key("operator"),
    _text("kind", 16),
    Column("is_virtual", Boolean, nullable=False),
    Column("reason", Text, nullable=False),
    _text("state", 16),
    _text("code", 64),
    Column("text", Text, nullable=False),
    _utc("begun_at"),
    Column("begun_monotonic_s", Float, nullable=False),
    _utc("ended_at", nullable=True),
    Column("ended_monotonic_s", Float, nullable=True),
    # Copied from the recipe, so that a CHECK of one row can use it.
    Column("verification_required", SmallInteger, nullable=False),
    Column("allow_completed_not_read_back", Boolean, nullable=False),
    Column("verification_reached", SmallInteger, nullable=True),
    _sha256("log_sha256", nullable=True),
    Index("run_of_unit", "unit_id", "id"),
    # Each index gives its newest runs (`newest`).
    Index("run_of_socket", "socket_id", "id"),
    Index("run_of_recipe", "recipe_id", "id"),
    Index("run_of_lot", "lot_id", "id"),
    Index("run_by_state", "state", "id"),
    Index("run_by_code", "code", "id"),
    Index("run_by_kind", "kind", "socket_id"),
    Index("run_by_nature", "is_virtual"),
    Index("run_by_begin", "begun_at"),
    _one_of("state", RunState),
    _one_of("kind", RunKind),
    CheckConstraint("(state = 'RUNNING') = (ended_at IS NULL)", name="finished_has_an_end"),
    CheckConstraint(
        "state IN ('RUNNING', 'INTERRUPTED') OR ended_monotonic_s IS NOT NULL",
        name="finished_has_a_duration",
    ),
    CheckConstraint(
        "ended_monotonic_s IS NULL OR ended_monotonic_s >= begun_monotonic_s",
        name="time_goes_forward",
    ),
    CheckConstraint(
        "state <> 'PASS' OR (ended_at IS NOT NULL AND log_sha256 IS NOT NULL"
        " AND length(log_sha256) = 64)",
        name="pass_has_an_end_and_a_log",
    ),
    CheckConstraint(
        "state <> 'PASS' OR (verification_reached IS NOT NULL"
        " AND verification_reached >= verification_required)",
        name="pass_is_verified",
    ),
    CheckConstraint(
        f"state <> 'PASS' OR allow_completed_not_read_back"
        f" OR verification_reached > {int(Verified.COMPLETED)}",
        name="pass_is_read_back",
    ),
    CheckConstraint(f"verification_reached {_LEVELS}", name="reached_is_known"),
    CheckConstraint(f"verification_required {_LEVELS}", name="required_is_known"),
    CheckConstraint("state = 'RUNNING' OR code <> ''", name="finished_has_a_code"),
    CheckConstraint("kind <> 'reflash' OR reason <> ''", name="reflash_has_a_reason"),
)

_RUNNING: Final = text("state = 'RUNNING'")
# Partial: only SQLite and PostgreSQL have them here.
for _name, _column in (
    ("one_running_run_per_unit", run.c.unit_id),
    ("one_running_run_per_socket", run.c.socket_id),
):
    Index(_name, _column, unique=True, sqlite_where=_RUNNING, postgresql_where=_RUNNING)

run_target: Final = _table(
    "run_target",
    _foreign_key("run"),
    _foreign_key("artifact"),
    Column("position", SmallInteger, nullable=False),
    _text("target", 16),
    Column("required", SmallInteger, nullable=False),
    Column("reached", SmallInteger, nullable=True),
    UniqueConstraint("run_id", "target"),
    Index("target_with_image", "artifact_id", "id"),
    CheckConstraint(f"required {_LEVELS} AND reached {_LEVELS}", name="levels_are_known"),
)

step: Final = _table(
    "step",
    _foreign_key("run"),
    Column("position", Integer, nullable=False),
    _text("name", 32),
    Column("try_number", Integer, nullable=False),
    _text("state", 16),
    _text("code", 64),
    Column("text", Text, nullable=False),
    _utc("begun_at"),
    Column("begun_monotonic_s", Float, nullable=False),
    Column("duration_s", Float, nullable=False),
    UniqueConstraint("run_id", "position"),
    _one_of("state", StepState),
    CheckConstraint("duration_s >= 0 AND try_number >= 1", name="step_is_possible"),
)

measurement: Final = _table(
    "measurement",
    _foreign_key("step", index=True),
    _text("name"),
    Column("value", Float, nullable=True),
    _text("unit", 16),
    Column("low", Float, nullable=True),
    Column("high", Float, nullable=True),
    Column("text", Text, nullable=True),
    Column("expected", Text, nullable=True),
    CheckConstraint("(value IS NULL) <> (text IS NULL)", name="number_or_text"),
)

device_write: Final = _table(
    "device_write",
    _foreign_key("run", index=True),
    _text("target", 16),
    _text("what", 64),
    Column("value", Text, nullable=False),
    _utc("intended_at"),
    Column("intended_monotonic_s", Float, nullable=False),
    _utc("verified_at", nullable=True),
    Column("read_back", Text, nullable=True),
    CheckConstraint("read_back IS NULL OR verified_at IS NOT NULL", name="read_back_is_verified"),
)

attachment: Final = _table(
    "attachment",
    _foreign_key("run", index=True),
    _text("kind", 32),
    _text("name"),
    _sha256("sha256"),
    Column("size_bytes", BigInteger, nullable=False),
    UniqueConstraint("run_id", "kind", "name"),
    CheckConstraint("length(sha256) = 64", name="sha256_is_whole"),
)

audit: Final = _table(
    "audit",
    _foreign_key("station"),
    Column("number", BigInteger, nullable=False),
    _utc("at"),
    _text("event", 32),
    _foreign_key("run", nullable=True, index=True),
    Column("data", Text, nullable=False),
    _sha256("previous_hash"),
    _sha256("hash"),
    _text("signature", _SIGNATURE_SIZE),
    UniqueConstraint("station_id", "number"),
    UniqueConstraint("station_id", "previous_hash"),
    UniqueConstraint("hash"),
    Index("audit_by_time", "station_id", "at"),
    Index("audit_by_event", "event", "id"),
)
"""Append-only, one hash chain per station: each row's hash covers the row and the previous hash,
and is signed with the station's key (`chain`)."""
