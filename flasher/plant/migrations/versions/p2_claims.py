"""Claims of units, and PASSes of one unit at two stations."""

from alembic import op

revision = "2"
down_revision = "1"


def upgrade() -> None:
    op.execute("""
WITH passed AS (
    SELECT r.id, r.unit_id, r.is_virtual, c.station,
        row_number() OVER (PARTITION BY r.unit_id, r.is_virtual ORDER BY c.id) AS place
    FROM run r JOIN chain_row c ON c.run_id = r.id AND c.content IS NOT NULL
    WHERE r.state = 'PASS' AND r.kind IN ('production', 'recheck')
), first AS (
    INSERT INTO plant_pass (unit_id, is_virtual, run_id, station)
        SELECT unit_id, is_virtual, id, station FROM passed WHERE place = 1 RETURNING *
)
INSERT INTO plant_duplicate (run_id, first_run_id)
    SELECT p.id, f.run_id FROM passed p JOIN first f USING (unit_id, is_virtual)
    WHERE p.place > 1 AND p.station <> f.station;
""")
