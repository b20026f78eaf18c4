"""Claims that were released because their station does not return."""

from alembic import op

revision = "10"
down_revision = "9"


def upgrade() -> None:
    op.execute("""
CREATE TABLE released_claim (
    token text NOT NULL,
    station uuid NOT NULL,
    part text NOT NULL,
    serial text NOT NULL,
    socket text NOT NULL,
    claimed_at timestamptz NOT NULL,
    reason text NOT NULL,
    released_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    released_by text NOT NULL DEFAULT session_user,
    run_id bigint,
    PRIMARY KEY (token)
);
""")
