# ruff: noqa: S608  all of this SQL is written here
"""SQL functions for the takeover of a station by another PC, and for its active runs."""

from __future__ import annotations

from typing import Final

from flasher.plant.functions import DEFINER

_TAKEN_OVER: Final = f"""
CREATE OR REPLACE FUNCTION plant_taken_over(
    OUT number bigint, OUT hash text, OUT at text, OUT data text
) RETURNS SETOF record LANGUAGE sql STABLE {DEFINER} AS $$
    SELECT c.number, p.takeover, c.at, c.data FROM plant_station p
        LEFT JOIN chain_row c ON c.hash = p.takeover
        WHERE p.role = session_user AND p.takeover <> ''
$$
"""
"""The last takeover of the station that asks. Of one that was retired the hash is left."""

_REPORT: Final = f"""
CREATE OR REPLACE FUNCTION plant_report_other(refused text) RETURNS void
LANGUAGE sql {DEFINER} AS $$
    UPDATE plant_station SET other_refusal = left(refused, 1000),
        other_reported_at = clock_timestamp() WHERE role = session_user
$$
"""
"""Report of a PC that was taken over: it leaves the report of the station as it is."""

CLOSE: Final = f"""
CREATE OR REPLACE FUNCTION plant_close() RETURNS trigger LANGUAGE plpgsql {DEFINER} AS $$
BEGIN
    DELETE FROM open_run WHERE station = NEW.station AND run_number = NEW.run_number;
    RETURN NULL;
END $$
"""

FUNCTIONS: Final = (_TAKEN_OVER, _REPORT, CLOSE)
ONCE: Final = """
CREATE TRIGGER plant_close AFTER INSERT ON chain_row FOR EACH ROW
    WHEN (NEW.event IN ('finished', 'interrupted')) EXECUTE FUNCTION plant_close();
ALTER TABLE open_run ENABLE ROW LEVEL SECURITY;
CREATE POLICY open_run_of_own_station ON open_run FOR INSERT
    WITH CHECK (station = (SELECT plant_my_station()));
"""
"""Statements for a new database."""


def rights(stations: str, readers: str) -> str:
    """Statements that give two roles their rights, after those of `functions`; names are quoted."""
    return f"""
GRANT EXECUTE ON FUNCTION plant_taken_over(), plant_report_other(text) TO {stations};
GRANT INSERT ON open_run TO {stations};
DROP POLICY IF EXISTS open_run_is_read ON open_run;
CREATE POLICY open_run_is_read ON open_run FOR SELECT TO {readers} USING (true);
"""
