"""Deliveries in the order in which their runs arrived."""

from alembic import op

revision = "9"
down_revision = "8"


def upgrade() -> None:
    op.execute("""
ALTER TABLE plant_delivery ADD COLUMN IF NOT EXISTS row_id bigint NOT NULL DEFAULT '0';
UPDATE plant_delivery d SET row_id = c.id FROM chain_row c
    WHERE (c.station, c.number) = (d.station, d.number);
DROP INDEX plant_delivery_open;
CREATE INDEX plant_delivery_open ON plant_delivery (state, receiver, row_id)
    WHERE state <> 'confirmed';
CREATE INDEX IF NOT EXISTS plant_delivery_by_row ON plant_delivery (row_id, receiver);
""")
