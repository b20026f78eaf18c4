"""Tables of the plant's database: the stations' chains, what their rows refer to, and traces.

The runs are beside them in tables of the station's schema, so that reports and pages read both.
Only the function `plant_bring` fills those (`functions`); no station has a right to them. A run's
id there is the time of its begin in microseconds, or the next free number: the order of ids is the
order of runs, whenever a station could be reached.
"""

from __future__ import annotations

from typing import Final

from sqlalchemy import (
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    DateTime,
    Float,
    ForeignKey,
    Identity,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    PrimaryKeyConstraint,
    Table,
    Text,
    Uuid,
    func,
    text,
)
from sqlalchemy.dialects.postgresql import JSON, JSONB

from flasher.station.records import schema as station_schema

PLANT_SCHEMA: Final = "11"
"""The newest Alembic revision in `migrations.versions`."""
VERSION_TABLE: Final = "plant_version"
STATION_TABLES: Final = tuple(
    table
    for table in station_schema.metadata.sorted_tables
    if table is not station_schema.audit  # a view of `chain_row`
)

metadata: Final = MetaData()

plant_station: Final = Table(
    "plant_station",
    metadata,
    Column("role", Text, primary_key=True),
    Column("name", Text, nullable=False, unique=True),
    Column("records_id", Text),
    Column("station", Uuid, unique=True),
    Column("entered_at", DateTime(timezone=True)),
    Column("reported_at", DateTime(timezone=True)),
    Column("version", Text, nullable=False, server_default=""),
    Column("unsent", BigInteger),
    Column("oldest_unsent_at", Text),
    Column("clock_offset_s", Float),
    Column("disk_free_bytes", BigInteger),
    Column("refusal", Text, nullable=False, server_default=""),
    Column("other_refusal", Text, nullable=False, server_default=""),
    Column("other_reported_at", DateTime(timezone=True)),
    Column("takeover", Text, nullable=False, server_default=""),
)
"""A station that may send, by its role, and what it reported last. `station` identifies the chain
of a station in its records; it is set when the station first connects. `other_...`: report of a PC
that still runs as this station, although another one has taken it over. `takeover`: hash of the
audit row of the last takeover, which may be retired."""

chain_row: Final = Table(
    "chain_row",
    metadata,
    Column("id", BigInteger, Identity(always=True), unique=True, nullable=False),
    Column("station", Uuid, nullable=False),
    Column("number", BigInteger, nullable=False),
    Column("at", Text, nullable=False),
    Column("event", Text, nullable=False),
    Column("run_number", BigInteger),
    Column("data", Text, nullable=False),
    Column("previous_hash", Text, nullable=False),
    Column("hash", Text, nullable=False, unique=True),
    Column("signature", Text, nullable=False),
    Column("content", JSON),
    Column("arrived_at", DateTime(timezone=True), nullable=False, server_default=func.now()),
    Column("station_id", BigInteger),
    Column("run_id", BigInteger),
    PrimaryKeyConstraint("station", "number"),
    Index("chain_row_of_number", "station", "run_number"),
    Index("ix_chain_row_run_id", "run_id"),
    Index("chain_row_by_time", "station_id", "at"),
    Index("chain_row_by_event", "event", "id"),
)
"""The stations' audit rows as they were signed. `run_number` is the run's id at the station.
`content` of the end of a run: the rows of the run as JSON, whose digests the audit row states.
`station_id` and `run_id` are ids of this database, set by `plant_bring`."""

open_run: Final = Table(
    "open_run",
    metadata,
    Column("station", Uuid, nullable=False),
    Column("run_number", BigInteger, nullable=False),
    Column("content", JSON, nullable=False),
    PrimaryKeyConstraint("station", "run_number"),
)
"""Runs that were claimed and have not ended: their row, targets and unit, whose digests the audit
row of the claim states. A PC that takes the station over ends them."""

shared_part: Final = Table(
    "shared_part",
    metadata,
    Column("station", Uuid, nullable=False),
    Column("sha256", Text, nullable=False),
    Column("content", Text, nullable=False),
    Column("ids", JSONB, nullable=False, server_default="{}"),
    PrimaryKeyConstraint("station", "sha256"),
    CheckConstraint(
        "sha256 = encode(sha256(convert_to(content, 'UTF8')), 'hex')", name="part_is_whole"
    ),
)
"""Rows that many runs of a station refer to (recipe, operator, images) by their digest.
`ids`: the rows of each part in the station's tables; `plant_bring` finds them once."""

trace: Final = Table(
    "trace",
    metadata,
    Column("sha256", Text, primary_key=True),
    Column("data", LargeBinary, nullable=False),
    CheckConstraint("sha256 = encode(sha256(data), 'hex')", name="trace_is_whole"),
)
"""Attachments of runs, once each."""

plant_claim: Final = Table(
    "plant_claim",
    metadata,
    Column("token", Text, primary_key=True),
    Column("station", Uuid, nullable=False),
    Column("part", Text, nullable=False),
    Column("serial", Text, nullable=False),
    Column("socket", Text, nullable=False),
    Column("claimed_at", DateTime(timezone=True), nullable=False),
    Column("expires_at", DateTime(timezone=True), nullable=False),
    Column("takeover", Text, nullable=False, server_default=""),
    Index("claim_of_unit", "part", "serial"),
    Index("claim_of_station", "station", "expires_at"),
)
"""Claims of units by stations whose run has not arrived (`claim_functions`). `takeover` is the hash
of the audit row with which the claiming PC took the station over."""

released_claim: Final = Table(
    "released_claim",
    metadata,
    Column("token", Text, primary_key=True),
    Column("station", Uuid, nullable=False),
    Column("part", Text, nullable=False),
    Column("serial", Text, nullable=False),
    Column("socket", Text, nullable=False),
    Column("claimed_at", DateTime(timezone=True), nullable=False),
    Column("reason", Text, nullable=False),
    Column(
        "released_at",
        DateTime(timezone=True),
        nullable=False,
        server_default=func.clock_timestamp(),
    ),
    Column("released_by", Text, nullable=False, server_default=text("session_user")),
    Column("run_id", BigInteger),
)
"""Claims that the owner of the database released, since their station does not return. `run_id` is
the run, if it arrived after all: it counts as one whose duplicates were not checked."""

plant_pass: Final = Table(
    "plant_pass",
    metadata,
    Column("unit_id", BigInteger, nullable=False),
    Column("is_virtual", Boolean, nullable=False),
    Column("run_id", BigInteger, nullable=False),
    Column("station", Uuid, nullable=False),
    PrimaryKeyConstraint("unit_id", "is_virtual"),
)
"""The first PASS of a unit that arrived. Its key lets two that arrive together meet."""

plant_duplicate: Final = Table(
    "plant_duplicate",
    metadata,
    Column("run_id", BigInteger, primary_key=True, autoincrement=False),
    Column("first_run_id", BigInteger, nullable=False),
)
"""A PASS of a unit of which another station's PASS had arrived."""

released_file: Final = Table(
    "released_file",
    metadata,
    Column("sha256", Text, primary_key=True),
    Column("data", LargeBinary, nullable=False),
    CheckConstraint("sha256 = encode(sha256(data), 'hex')", name="file_is_whole"),
)
"""Files of recipes that the plant gives out (recipes, images, manifests, profiles), once each."""

released_recipe: Final = Table(
    "released_recipe",
    metadata,
    Column("digest", Text, primary_key=True),
    Column("manifest", Text, nullable=False),
    Column("name", Text, nullable=False),
    Column("revision", Text, nullable=False),
    Column("part", Text, nullable=False),
    CheckConstraint(
        "digest = encode(sha256(convert_to(manifest, 'UTF8')), 'hex')", name="recipe_is_whole"
    ),
)
"""A recipe with its files (`flasher.station.given_recipes`). `name`, `revision` and `part` are for
people; stations read them from the recipe itself."""

recipe_event: Final = Table(
    "recipe_event",
    metadata,
    Column("id", BigInteger, Identity(always=True), primary_key=True),
    Column("at", DateTime(timezone=True), nullable=False, server_default=func.clock_timestamp()),
    Column("by", Text, nullable=False, server_default=text("session_user")),
    Column("what", Text, nullable=False),
    Column("digest", Text, ForeignKey("released_recipe.digest"), nullable=False, index=True),
    Column("station", Text, ForeignKey("plant_station.name")),
    Column("socket", Text),
    Column("reason", Text, nullable=False, server_default=""),
    CheckConstraint("what IN ('published', 'withdrawn')", name="event_is_known"),
)
"""Who gave a recipe to which sockets of which station (null: all), or withdrew it. The newest row
counts."""

plant_receiver: Final = Table(
    "plant_receiver",
    metadata,
    Column("name", Text, primary_key=True),
    Column("since", DateTime(timezone=True), nullable=False, server_default=func.now()),
    Column("stopped_at", DateTime(timezone=True)),
)
"""A system that receives the runs which arrive from `since` on. Its address and password are in the
file of `flasher plant deliver`."""

plant_delivery: Final = Table(
    "plant_delivery",
    metadata,
    Column("receiver", Text, nullable=False),
    Column("station", Uuid, nullable=False),
    Column("number", BigInteger, nullable=False),
    Column("state", Text, nullable=False, server_default="waiting"),
    Column("attempts", Integer, nullable=False, server_default="0"),
    Column("sent_at", DateTime(timezone=True)),
    Column("answered_at", DateTime(timezone=True)),
    Column("answer", Text, nullable=False, server_default=""),
    Column("job", BigInteger, nullable=False),
    Column("row_id", BigInteger, nullable=False, server_default="0"),
    PrimaryKeyConstraint("receiver", "station", "number"),
    Index("plant_delivery_by_row", "row_id", "receiver"),
    Index(
        "plant_delivery_open",
        "state",
        "receiver",
        "row_id",
        postgresql_where=text("state <> 'confirmed'"),
    ),
)
"""A run, by its row in the station's chain, and how far its hand-over to a receiver has come.
`sent_at` and `answer` belong to the last attempt; `job` is Procrastinate's; `row_id` is the id of
the row in `chain_row`, in the order of arrival (0: it was retired before this column came)."""

plant_queue: Final = Table("plant_queue", metadata, Column("migration", Text, primary_key=True))
"""The last of Procrastinate's own migrations that its tables have."""

archive_file: Final = Table(
    "archive_file",
    metadata,
    Column("name", Text, primary_key=True),
    Column("month", Text, nullable=False),
    Column("sha256", Text, nullable=False),
    Column("size_bytes", BigInteger, nullable=False),
    Column("written_at", DateTime(timezone=True), nullable=False),
)
"""A file with the records of a month that `flasher plant retire` took out of this database."""

archive_chain: Final = Table(
    "archive_chain",
    metadata,
    Column("station", Uuid, nullable=False),
    Column("last", BigInteger, nullable=False),
    Column("first", BigInteger, nullable=False),
    Column("name", Text, nullable=False),
    Column("records_id", Text, nullable=False),
    Column("previous_hash", Text, nullable=False),
    Column("hash", Text, nullable=False),
    Column("keys", JSON, nullable=False),
    Column("file", Text, nullable=False),
    PrimaryKeyConstraint("station", "last"),
)
"""The audit rows `first` to `last` of a chain are in a file: the hashes before and after them, and
the public keys up to the last row."""

kept_run: Final = Table(
    "kept_run",
    metadata,
    Column("run_id", BigInteger, primary_key=True, autoincrement=False),
    Column("station", Uuid, nullable=False),
    Column("run_number", BigInteger, nullable=False),
    Column("file", Text, nullable=False),
    Index("kept_run_of_file", "file", "station", "run_number"),
)
"""A retired run that stays, because it is the last one of its unit, or made its last transfer: the
run itself, its targets and its writes. All of it is in the file."""

OWN_PARTS: Final = (
    "run", "unit", "targets", "steps", "measurements", "writes", "attachments",
)  # fmt: skip
"""Parts of a run in `chain_row.content`."""
SHARED_PARTS: Final = ("station", "socket", "operator", "lot", "recipe", "artifacts")
"""Parts of a run in `shared_part`."""
