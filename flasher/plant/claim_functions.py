# ruff: noqa: S608  all of this SQL is written here
"""SQL functions and rights for claims of units, so that two stations do not pass one unit.

A claim stays until its station sends the end of the run, or releases it because no run began. It
expires if its station does not renew it; from then on it refuses the unit nowhere, but the station
may have passed the unit, which `plant_claim` states. So a unit is reported as free only while no
run of it at another station can end with a PASS that is not here. The owner of the database can
release an expired claim; a run with it that arrives later is marked (`claim_list`), and its station
learns of it (`plant_released`).

A PC that was taken over may have passed units that it never sent: to the PC that continues the
station its claims are those of another station, and it can claim nothing.
"""

from __future__ import annotations

from typing import Final

from flasher.plant.functions import DEFINER, REFUSED
from flasher.station.records.model import PLANT_CLAIM, AuditEvent, RunKind, StepName
from flasher.station.records.server import ServerLock

NO_STATION: Final = "a station whose records were replaced"
"""In the place of the name of a station."""
_OPEN_MAX: Final = 1000
"""Claims of a station that have not expired; with 64 sockets it has a fraction of that."""
_LEASE_MAX_S: Final = 600

# Both had other arguments or results once.
_OLD: Final = """
DROP FUNCTION IF EXISTS plant_claim(text, text, text, boolean, text, double precision, text);
DROP FUNCTION IF EXISTS plant_claim(text, text, text, boolean, text, double precision);
DROP FUNCTION IF EXISTS plant_claims();
"""
_CLAIM: Final = f"""
CREATE OR REPLACE FUNCTION plant_claim(
    of_token text, of_part text, of_serial text, of_virtual boolean, at_socket text,
    lease_s double precision, of_records text, of_takeover text,
    OUT state text, OUT station text, OUT socket text, OUT at timestamptz, OUT run bigint
) LANGUAGE plpgsql {DEFINER} AS $$
DECLARE
    mine plant_station;
    other plant_claim;
    now timestamptz;
BEGIN
    PERFORM pg_advisory_xact_lock(
        hashtextextended(of_part || E'\\x1f' || of_serial, {ServerLock.UNIT:d}));
    -- After the lock: another PC may have taken the station over, and run the unit, meanwhile.
    SELECT * INTO mine FROM plant_station p WHERE p.role = session_user;
    IF mine.station IS NULL OR mine.records_id <> of_records THEN
        RAISE EXCEPTION 'foreign: station % sends from other records', coalesce(mine.name, '')
            USING ERRCODE = '{REFUSED}';
    ELSIF mine.takeover NOT IN ('', of_takeover) THEN
        RAISE EXCEPTION 'taken-over: another PC continues station %', mine.name
            USING ERRCODE = '{REFUSED}';
    END IF;
    now := clock_timestamp();
    -- Claims before runs: a claim goes when the end of its run comes.
    SELECT * INTO other FROM plant_claim c WHERE c.part = of_part AND c.serial = of_serial
        AND (c.station, c.takeover) <> (mine.station, of_takeover)
        ORDER BY c.expires_at DESC LIMIT 1;
    IF other.expires_at > now THEN
        state := 'running';
    ELSE
        SELECT 'passed', n.name, s.name, r.begun_at::timestamptz, c.run_number
            INTO state, station, socket, at, run
            FROM unit u JOIN run r ON r.unit_id = u.id
                JOIN (
                    SELECT o.run_id, o.station, o.run_number FROM chain_row o
                        WHERE o.content IS NOT NULL
                    UNION ALL SELECT k.run_id, k.station, k.run_number FROM kept_run k
                ) c ON c.run_id = r.id
                JOIN socket s ON s.id = r.socket_id JOIN station n ON n.id = s.station_id
            WHERE u.part = of_part AND u.serial = of_serial AND r.state = 'PASS'
                AND r.kind <> '{RunKind.GOLDEN}' AND r.is_virtual = of_virtual
                AND c.station <> mine.station
            ORDER BY r.id DESC LIMIT 1;
        IF state IS NULL AND other.token IS NOT NULL THEN
            state := 'unknown';
        END IF;
    END IF;
    IF state IN ('running', 'unknown') THEN
        socket := other.socket;
        at := other.claimed_at;
        station := coalesce((SELECT p.name FROM plant_station p WHERE p.station = other.station),
            '{NO_STATION}');
    END IF;
    IF state IS DISTINCT FROM 'running' THEN
        IF (SELECT count(*) FROM plant_claim c WHERE c.station = mine.station
                AND c.expires_at > now) >= {_OPEN_MAX} THEN
            RAISE EXCEPTION 'foreign: station % claims too many units', mine.name
                USING ERRCODE = '{REFUSED}';
        END IF;
        INSERT INTO plant_claim
                (token, station, part, serial, socket, claimed_at, expires_at, takeover)
            VALUES (of_token, mine.station, of_part, of_serial, at_socket, now,
                now + make_interval(secs => greatest(1, least(lease_s, {_LEASE_MAX_S}))),
                of_takeover);
    END IF;
END $$
"""

_RENEW: Final = f"""
CREATE OR REPLACE FUNCTION plant_renew(tokens text[], lease_s double precision)
RETURNS void LANGUAGE sql {DEFINER} AS $$
    UPDATE plant_claim SET expires_at = clock_timestamp()
            + make_interval(secs => greatest(1, least(lease_s, {_LEASE_MAX_S})))
        WHERE token = ANY(tokens) AND station = plant_my_station()
$$
"""

_RELEASE: Final = f"""
CREATE OR REPLACE FUNCTION plant_release(tokens text[]) RETURNS void LANGUAGE sql {DEFINER} AS $$
    DELETE FROM plant_claim WHERE token = ANY(tokens) AND station = plant_my_station()
$$
"""

_CLAIMS: Final = f"""
CREATE OR REPLACE FUNCTION plant_claims()
RETURNS TABLE (token text, part text, serial text, takeover text)
LANGUAGE sql STABLE {DEFINER} AS $$
    SELECT token, part, serial, takeover FROM plant_claim WHERE station = plant_my_station()
$$
"""
"""Claims of the station itself, and of PCs that were this station before a takeover."""

_RELEASED: Final = f"""
CREATE OR REPLACE FUNCTION plant_released() RETURNS TABLE (token text, part text, serial text)
LANGUAGE sql STABLE {DEFINER} AS $$
    SELECT c.token, c.part, c.serial FROM released_claim c
            JOIN chain_row e ON e.station = c.station AND e.run_id = c.run_id
        WHERE c.station = plant_my_station() AND e.content IS NOT NULL AND NOT EXISTS (
            SELECT FROM chain_row o WHERE o.station = c.station AND o.run_id = c.run_id
                AND o.event = '{AuditEvent.CLAIM_RELEASED}')
$$
"""
"""Claims of the station that were released before the end of their run arrived, until its audit
trail has that, or the run is retired."""

_END: Final = f"""
CREATE OR REPLACE FUNCTION plant_end_claims() RETURNS trigger LANGUAGE plpgsql {DEFINER} AS $$
DECLARE
    ended run;
    of_token text;
BEGIN
    SELECT m.text INTO of_token FROM step s JOIN measurement m ON m.step_id = s.id
        WHERE s.run_id = NEW.run_id AND s.position = 1 AND s.name = '{StepName.PLANT}'
            AND m.name = '{PLANT_CLAIM}';
    IF FOUND THEN
        DELETE FROM plant_claim WHERE station = NEW.station AND token = of_token;
        UPDATE released_claim SET run_id = NEW.run_id
            WHERE station = NEW.station AND token = of_token;
    END IF;
    SELECT * INTO ended FROM run WHERE id = NEW.run_id;
    IF ended.state = 'PASS' AND ended.kind IN ('{RunKind.PRODUCTION}', '{RunKind.RECHECK}') THEN
        INSERT INTO plant_pass (unit_id, is_virtual, run_id, station)
            VALUES (ended.unit_id, ended.is_virtual, ended.id, NEW.station) ON CONFLICT DO NOTHING;
        IF NOT FOUND THEN
            INSERT INTO plant_duplicate (run_id, first_run_id)
                SELECT ended.id, p.run_id FROM plant_pass p WHERE p.unit_id = ended.unit_id
                    AND p.is_virtual = ended.is_virtual AND p.station <> NEW.station;
        END IF;
    END IF;
    RETURN NULL;
END $$
"""
"""Ends the claim of a run that was sent, and compares its PASS with those of other stations."""

_TRIGGER: Final = """
DROP TRIGGER IF EXISTS plant_end_claims ON chain_row;
CREATE TRIGGER plant_end_claims AFTER INSERT ON chain_row FOR EACH ROW
    WHEN (NEW.content IS NOT NULL) EXECUTE FUNCTION plant_end_claims();
"""

FUNCTIONS: Final = (_OLD, _CLAIM, _RENEW, _RELEASE, _CLAIMS, _RELEASED, _END, _TRIGGER)


def rights(stations: str) -> str:
    """Statement that gives the role of all stations its rights; the name is quoted."""
    return f"""
GRANT EXECUTE ON FUNCTION
    plant_claim(text, text, text, boolean, text, double precision, text, text),
    plant_renew(text[], double precision), plant_release(text[]), plant_claims(), plant_released()
    TO {stations};
"""
