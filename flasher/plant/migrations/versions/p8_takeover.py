"""The last takeover of each station, whose audit row may be retired."""

from alembic import op

revision = "8"
down_revision = "7"


def upgrade() -> None:
    op.execute("""
ALTER TABLE plant_station ADD COLUMN takeover text NOT NULL DEFAULT '';
UPDATE plant_station p SET takeover = c.hash
    FROM (SELECT DISTINCT ON (station) station, hash FROM chain_row WHERE event = 'taken over'
        ORDER BY station, number DESC) c
    WHERE c.station = p.station;
""")
