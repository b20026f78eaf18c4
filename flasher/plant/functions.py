# ruff: noqa: S608  all of this SQL is written here
"""SQL functions and rights of the plant's database.

A station may execute three functions and insert into three tables; it can read, change or delete
nothing. Every inserted audit row is checked here: its place in the chain, its hash, and the
digests of what it refers to. Signatures are checked by `flasher plant verify`, as PostgreSQL has no
function for them.
"""

from __future__ import annotations

from typing import Final

from flasher.plant.schema import OWN_PARTS, SHARED_PARTS
from flasher.station.records.chain import TAKEN_OVER

REFUSED: Final = "FL001"
"""SQLSTATE of a refused chain. The message begins with one of the `Refusal` words."""

_OWN: Final = ", ".join(f"'{name}'" for name in OWN_PARTS)
_SHARED: Final = ", ".join(f"'{name}'" for name in SHARED_PARTS)
DEFINER: Final = "SECURITY DEFINER SET search_path = public, pg_temp"

_MY_STATION: Final = f"""
CREATE OR REPLACE FUNCTION plant_my_station() RETURNS uuid LANGUAGE sql STABLE {DEFINER} AS $$
    SELECT station FROM plant_station WHERE role = session_user
$$
"""

_ENTER: Final = f"""
CREATE OR REPLACE FUNCTION plant_enter(
    of_records text, called text,
    OUT station uuid, OUT head_number bigint, OUT head_hash text, OUT now timestamptz
) LANGUAGE plpgsql {DEFINER} AS $$
DECLARE
    mine plant_station;
    wanted uuid := left(encode(sha256(convert_to(of_records || ' ' || called, 'UTF8')), 'hex'), 32);
BEGIN
    SELECT * INTO mine FROM plant_station p WHERE p.role = session_user FOR UPDATE;
    IF NOT FOUND OR mine.name <> called THEN
        RAISE EXCEPTION 'foreign: the user % is not the user of station %', session_user, called
            USING ERRCODE = '{REFUSED}';
    END IF;
    IF mine.station IS NULL THEN
        UPDATE plant_station p
            SET station = wanted, records_id = of_records, entered_at = now(),
                takeover = coalesce((SELECT c.hash FROM chain_row c WHERE c.station = wanted
                    AND c.event = '{TAKEN_OVER}' ORDER BY c.number DESC LIMIT 1), '')
            WHERE p.role = session_user;
    ELSIF mine.station <> wanted THEN
        RAISE EXCEPTION 'foreign: station % sends from other records, those with id %', called,
            mine.records_id USING ERRCODE = '{REFUSED}';
    END IF;
    station := wanted;
    now := clock_timestamp();
    SELECT c.number, c.hash INTO head_number, head_hash FROM chain_row c
        WHERE c.station = wanted ORDER BY c.number DESC LIMIT 1;
    head_number := coalesce(head_number, 0);
    head_hash := coalesce(head_hash, repeat('0', 64));
END $$
"""

_REPORT: Final = f"""
CREATE OR REPLACE FUNCTION plant_report(
    reporting text, is_unsent bigint, oldest text, offset_s double precision, free_bytes bigint,
    refused text
) RETURNS void LANGUAGE sql {DEFINER} AS $$
    UPDATE plant_station SET reported_at = clock_timestamp(), version = left(reporting, 100),
        unsent = is_unsent, oldest_unsent_at = left(oldest, 27), clock_offset_s = offset_s,
        disk_free_bytes = free_bytes, refusal = left(refused, 1000)
    WHERE role = session_user
$$
"""

_NAMED: Final = f"""
CREATE OR REPLACE FUNCTION plant_named(in_table text, names text[], key jsonb) RETURNS bigint
LANGUAGE plpgsql {DEFINER} AS $$
DECLARE
    found bigint;
    columns text := (SELECT string_agg(quote_ident(n), ', ') FROM unnest(names) n);
    same text := (SELECT string_agg(format('t.%1$I = k.%1$I', n), ' AND ') FROM unnest(names) n);
    find text := format('SELECT t.id FROM %1$I t, jsonb_populate_record(NULL::%1$I, $1) k WHERE ',
        in_table) || same;
BEGIN
    IF jsonb_typeof(key) <> 'object' THEN RETURN NULL; END IF;
    EXECUTE find INTO found USING key;
    IF found IS NULL THEN
        EXECUTE format('INSERT INTO %1$I (%2$s) SELECT %2$s FROM'
            ' jsonb_populate_record(NULL::%1$I, $1) ON CONFLICT DO NOTHING', in_table, columns)
            USING key;
        EXECUTE find INTO found USING key;
    END IF;
    RETURN found;
END $$
"""
"""Finds a row by its names in a table of the station's schema, or inserts it; returns its id."""

_IDS: Final = f"""
CREATE OR REPLACE FUNCTION plant_ids_of(of_station bigint, part text, content jsonb) RETURNS jsonb
LANGUAGE plpgsql {DEFINER} AS $$
BEGIN
    RETURN CASE part
        WHEN 'station' THEN to_jsonb(plant_named('station', '{{name}}', content))
        WHEN 'socket' THEN to_jsonb(plant_named('socket', '{{station_id,name}}',
            content || jsonb_build_object('station_id', of_station)))
        WHEN 'operator' THEN to_jsonb(plant_named('operator', '{{name}}', content))
        WHEN 'lot' THEN to_jsonb(plant_named('lot', '{{part,name}}', content))
        WHEN 'recipe' THEN to_jsonb(plant_named('recipe', '{{name,revision,part,sha256,content,'
            'verification_required,allow_completed_not_read_back}}', content))
        WHEN 'artifacts' THEN (SELECT jsonb_agg(
            plant_named('artifact', '{{target,name,version,sha256,size_bytes}}', each) ORDER BY at)
            FROM jsonb_array_elements(content) WITH ORDINALITY AS x(each, at))
    END;
END $$
"""
"""Returns the id of a shared part in its table, or those of several artifacts."""

_ADD_RUN: Final = f"""
CREATE OR REPLACE FUNCTION plant_add_run(own jsonb, ids jsonb) RETURNS bigint
LANGUAGE plpgsql {DEFINER} AS $$
DECLARE
    r run := jsonb_populate_record(NULL::run, own->'run');
BEGIN
    r.socket_id := ids->>'socket';
    r.operator_id := ids->>'operator';
    r.lot_id := ids->>'lot';
    r.recipe_id := ids->>'recipe';
    SELECT id INTO r.unit_id FROM unit
        WHERE part = own->'unit'->>'part' AND serial = own->'unit'->>'serial';
    IF r.unit_id IS NULL THEN
        INSERT INTO unit (part, serial) VALUES (own->'unit'->>'part', own->'unit'->>'serial')
            ON CONFLICT (part, serial) DO UPDATE SET serial = excluded.serial  -- of now
            RETURNING id INTO r.unit_id;
    END IF;
    r.id := floor(extract(epoch FROM r.begun_at::timestamptz) * 1000000);
    LOOP
        INSERT INTO run SELECT r.* ON CONFLICT (id) DO NOTHING;
        EXIT WHEN FOUND;
        r.id := r.id + 1;
    END LOOP;
    INSERT INTO run_target (run_id, artifact_id, position, target, required, reached)
        SELECT r.id, (ids->'artifacts'->>(at - 1)::int)::bigint, t.position, t.target, t.required,
            t.reached
        FROM jsonb_array_elements(own->'targets') WITH ORDINALITY AS x(each, at),
            jsonb_populate_record(NULL::run_target, each) t ORDER BY at;
    WITH s AS (SELECT * FROM jsonb_populate_recordset(NULL::step, own->'steps')),
        added AS (
            INSERT INTO step (run_id, position, name, try_number, state, code, text, begun_at,
                begun_monotonic_s, duration_s)
            SELECT r.id, position, name, try_number, state, code, text, begun_at,
                begun_monotonic_s, duration_s FROM s ORDER BY position
            RETURNING step.id, step.position
        )
    INSERT INTO measurement (step_id, name, value, unit, low, high, text, expected)
        SELECT added.id, m.name, m.value, m.unit, m.low, m.high, m.text, m.expected
        FROM jsonb_populate_recordset(NULL::measurement, own->'measurements') m
            JOIN s ON s.id = m.step_id JOIN added ON added.position = s.position ORDER BY m.id;
    INSERT INTO device_write (run_id, target, what, value, intended_at, intended_monotonic_s,
            verified_at, read_back)
        SELECT r.id, target, what, value, intended_at, intended_monotonic_s, verified_at, read_back
        FROM jsonb_populate_recordset(NULL::device_write, own->'writes') ORDER BY id;
    INSERT INTO attachment (run_id, kind, name, sha256, size_bytes)
        SELECT r.id, kind, name, sha256, size_bytes
        FROM jsonb_populate_recordset(NULL::attachment, own->'attachments') ORDER BY id;
    RETURN r.id;
END $$
"""
"""Adds a run to the tables of the station's schema; returns its id there."""

_BRING: Final = f"""
CREATE OR REPLACE FUNCTION plant_bring() RETURNS trigger LANGUAGE plpgsql {DEFINER} AS $$
DECLARE
    mine plant_station;
    head chain_row;
    stated jsonb;
    own jsonb;
    ids jsonb := '{{}}';
    part text;
    body text;
    known jsonb;
    refusal text;
BEGIN
    SELECT * INTO mine FROM plant_station WHERE role = session_user FOR UPDATE;
    IF mine.station IS DISTINCT FROM NEW.station OR NEW.station IS NULL THEN
        RAISE EXCEPTION 'foreign: the user % does not send this chain', session_user
            USING ERRCODE = '{REFUSED}';
    END IF;
    SELECT * INTO head FROM chain_row WHERE station = NEW.station ORDER BY number DESC LIMIT 1;
    IF NEW.number <= head.number THEN
        IF EXISTS (SELECT FROM chain_row c WHERE c.station = NEW.station
                AND c.number = NEW.number AND c.hash = NEW.hash) THEN
            RETURN NULL;  -- it was sent before
        END IF;
        refusal := format('forked: row %s is here with another hash', NEW.number);
    ELSIF NEW.number <> coalesce(head.number, 0) + 1 THEN
        refusal := format('incomplete: row %s does not follow row %s', NEW.number,
            coalesce(head.number, 0));
    ELSIF NEW.previous_hash <> coalesce(head.hash, repeat('0', 64)) THEN
        refusal := format('forked: row %s does not continue the chain', NEW.number);
    ELSIF NEW.hash <> encode(sha256(convert_to(
            '["' || NEW.previous_hash || '",' || NEW.number || ',' || to_json(NEW.at) || ','
            || to_json(NEW.event) || ',' || coalesce(NEW.run_number::text, 'null') || ','
            || to_json(NEW.data) || ']', 'UTF8')), 'hex') THEN
        refusal := format('edited: row %s does not have its hash', NEW.number);
    ELSIF NEW.number = 1 AND (NEW.event <> 'begun' OR NEW.data::jsonb->>'station' <> mine.name
            OR NEW.data::jsonb->>'records' <> mine.records_id) THEN
        refusal := 'foreign: the chain begins with another station or other records';
    ELSIF (NEW.content IS NOT NULL) <> (NEW.event IN ('finished', 'interrupted')) THEN
        refusal := format('edited: row %s has not the content of its kind', NEW.number);
    END IF;
    IF refusal IS NOT NULL THEN
        RAISE EXCEPTION '%', refusal USING ERRCODE = '{REFUSED}';
    END IF;
    NEW.arrived_at := clock_timestamp();
    SELECT id INTO NEW.station_id FROM station WHERE name = mine.name;
    NEW.station_id := coalesce(NEW.station_id,
        plant_named('station', '{{name}}', jsonb_build_object('name', mine.name)));
    IF NEW.event = '{TAKEN_OVER}' THEN
        UPDATE plant_station SET takeover = NEW.hash WHERE role = session_user;
    END IF;
    IF NEW.content IS NULL THEN
        IF NEW.run_number IS NOT NULL THEN
            SELECT run_id INTO NEW.run_id FROM chain_row WHERE station = NEW.station
                AND run_number = NEW.run_number AND content IS NOT NULL;
        END IF;
        RETURN NEW;
    END IF;
    IF EXISTS (SELECT FROM chain_row WHERE station = NEW.station
            AND run_number = NEW.run_number AND content IS NOT NULL) THEN
        RAISE EXCEPTION 'edited: run % ended twice', NEW.run_number USING ERRCODE = '{REFUSED}';
    END IF;
    stated := NEW.data::jsonb->'digests';
    FOREACH part IN ARRAY ARRAY[{_OWN}] LOOP
        body := (NEW.content->part)::text;
        IF body IS NULL OR encode(sha256(convert_to(body, 'UTF8')), 'hex')
                IS DISTINCT FROM stated->>part THEN
            RAISE EXCEPTION 'edited: % of run %, row %', part, NEW.run_number, NEW.number
                USING ERRCODE = '{REFUSED}';
        END IF;
    END LOOP;
    own := NEW.content::jsonb;
    FOR part, body, known IN SELECT wanted, s.content, s.ids->wanted
        FROM unnest(ARRAY[{_SHARED}]) wanted LEFT JOIN shared_part s
        ON s.station = NEW.station AND s.sha256 = stated->>wanted
    LOOP
        IF body IS NULL THEN
            RAISE EXCEPTION 'edited: % of run %, row %', part, NEW.run_number, NEW.number
                USING ERRCODE = '{REFUSED}';
        END IF;
        IF known IS NULL THEN
            known := coalesce(plant_ids_of(NEW.station_id, part, body::jsonb), 'null');
            UPDATE shared_part s SET ids = s.ids || jsonb_build_object(part, known)
                WHERE s.station = NEW.station AND s.sha256 = stated->>part;
        END IF;
        ids := ids || jsonb_build_object(part, known);
    END LOOP;
    IF (own->'run'->>'id')::bigint <> NEW.run_number OR own->'run'->>'state' = 'RUNNING'
            OR (ids->>'station')::bigint IS DISTINCT FROM NEW.station_id THEN
        RAISE EXCEPTION 'edited: row % is not of run %', NEW.number, NEW.run_number
            USING ERRCODE = '{REFUSED}';
    END IF;
    NEW.run_id := plant_add_run(own, ids);
    UPDATE chain_row SET run_id = NEW.run_id
        WHERE station = NEW.station AND run_number = NEW.run_number;
    RETURN NEW;
END $$
"""
"""Checks an audit row before it is inserted, and adds its run to the tables of runs."""

FUNCTIONS: Final = (_MY_STATION, _ENTER, _REPORT, _NAMED, _IDS, _ADD_RUN, _BRING)

_GUARDED: Final = ("chain_row", "shared_part", "trace", "plant_station")
"""Tables with row level security."""
ONCE: Final = f"""
CREATE TRIGGER plant_bring BEFORE INSERT ON chain_row FOR EACH ROW EXECUTE FUNCTION plant_bring();
-- One station that states a wrong name for a hash must not hinder another one.
ALTER TABLE artifact DROP CONSTRAINT artifact_target_sha256_name_key;
CREATE UNIQUE INDEX artifact_as_stated ON artifact (sha256, target, name, version, size_bytes);
ALTER TABLE recipe DROP CONSTRAINT recipe_sha256_key;
CREATE UNIQUE INDEX recipe_as_stated ON recipe (sha256, name, revision, part,
    verification_required, allow_completed_not_read_back, md5(content));
CREATE INDEX attachment_by_sha256 ON attachment (sha256);
CREATE VIEW audit AS SELECT id, station_id, number, at, event, run_id, data, previous_hash, hash,
    signature FROM chain_row;
{"".join(f"ALTER TABLE {table} ENABLE ROW LEVEL SECURITY;" for table in _GUARDED)}
CREATE POLICY chain_row_of_own_station ON chain_row FOR INSERT
    WITH CHECK (station = (SELECT plant_my_station()));
CREATE POLICY part_of_own_station ON shared_part FOR INSERT
    WITH CHECK (station = (SELECT plant_my_station()));
CREATE POLICY trace_of_a_station ON trace FOR INSERT
    WITH CHECK ((SELECT plant_my_station()) IS NOT NULL);
"""
"""Statements for a new database."""


def rights(database: str, stations: str, readers: str) -> str:
    """Statements that give two roles exactly their rights; names are quoted."""
    policies = "".join(
        f"DROP POLICY IF EXISTS {table}_is_read ON {table};"
        f"CREATE POLICY {table}_is_read ON {table} FOR SELECT TO {readers} USING (true);"
        for table in _GUARDED
    )
    both = f"{stations}, {readers}"
    return f"""
REVOKE ALL ON SCHEMA public FROM PUBLIC;
REVOKE ALL ON DATABASE {database} FROM PUBLIC;
GRANT CONNECT ON DATABASE {database} TO {both};
GRANT USAGE ON SCHEMA public TO {both};
REVOKE ALL ON ALL TABLES IN SCHEMA public FROM PUBLIC, {both};
REVOKE ALL ON ALL SEQUENCES IN SCHEMA public FROM PUBLIC, {both};
REVOKE ALL ON ALL FUNCTIONS IN SCHEMA public FROM PUBLIC, {both};
GRANT EXECUTE ON FUNCTION plant_my_station(), plant_enter(text, text),
    plant_report(text, bigint, text, double precision, bigint, text) TO {stations};
GRANT INSERT (station, number, at, event, run_number, data, previous_hash, hash, signature, content)
    ON chain_row TO {stations};
GRANT INSERT (station, sha256, content) ON shared_part TO {stations};
GRANT INSERT ON trace TO {stations};
GRANT SELECT ON ALL TABLES IN SCHEMA public TO {readers};
{policies}
"""
