"""The PC that claims a unit, by the takeover with which it continued the station."""

from alembic import op

revision = "7"
down_revision = "6"


def upgrade() -> None:
    op.execute("ALTER TABLE plant_claim ADD COLUMN IF NOT EXISTS takeover text NOT NULL DEFAULT ''")
