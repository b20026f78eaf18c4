"""Ids of the rows that runs share, looked up once for each content."""

from alembic import op

revision = "11"
down_revision = "10"


def upgrade() -> None:
    op.execute("ALTER TABLE shared_part ADD COLUMN ids jsonb NOT NULL DEFAULT '{}'")
    op.execute("DROP FUNCTION plant_add_run(jsonb, jsonb)")  # a parameter has another name
