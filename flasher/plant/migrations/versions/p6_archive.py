"""Files with retired records."""

from alembic import op

revision = "6"
down_revision = "5"


def upgrade() -> None:
    op.execute("""
CREATE TABLE archive_file (
    name text NOT NULL,
    month text NOT NULL,
    sha256 text NOT NULL,
    size_bytes bigint NOT NULL,
    written_at timestamptz NOT NULL,
    PRIMARY KEY (name)
);
CREATE TABLE archive_chain (
    station uuid NOT NULL,
    last bigint NOT NULL,
    first bigint NOT NULL,
    name text NOT NULL,
    records_id text NOT NULL,
    previous_hash text NOT NULL,
    hash text NOT NULL,
    keys json NOT NULL,
    file text NOT NULL,
    PRIMARY KEY (station, last)
);
CREATE TABLE kept_run (
    run_id bigint NOT NULL,
    station uuid NOT NULL,
    run_number bigint NOT NULL,
    file text NOT NULL,
    PRIMARY KEY (run_id)
);
CREATE INDEX kept_run_of_file ON kept_run (file, station, run_number);
CREATE INDEX attachment_by_sha256 ON attachment (sha256);
""")
