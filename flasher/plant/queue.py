# ruff: noqa: S608  all of this SQL is written here
"""The queue of runs for the plant's other systems: Procrastinate's tables, and SQL functions.

The transaction that brings a run also brings a job for each receiver (`plant_hand_over`). Jobs with
the same lock are done one after another, oldest first, also when one has to wait for its next
attempt: a receiver gets the runs of a unit in the order in which they arrived. No job has a
`queueing_lock`: together with `lock` it stops a queue whose worker died.
"""

from __future__ import annotations

from importlib import resources
from importlib.util import find_spec
from typing import Final

from sqlalchemy import Connection, text

from flasher.plant.functions import DEFINER

TASK: Final = "flasher.deliver"

_ENQUEUE: Final = f"""
CREATE OR REPLACE FUNCTION plant_enqueue(to_receiver text, of_station uuid, of_number bigint)
RETURNS void LANGUAGE plpgsql {DEFINER} AS $$
DECLARE
    last_job bigint;
    status text;
    of_unit text;
    of_row bigint;
BEGIN
    SELECT job INTO last_job FROM plant_delivery d
        WHERE (d.receiver, d.station, d.number) = (to_receiver, of_station, of_number) FOR UPDATE;
    SELECT j.status INTO status FROM procrastinate_jobs j WHERE id = last_job FOR UPDATE;
    IF status = 'doing' THEN
        RETURN;  -- it is being sent
    ELSIF status = 'todo' THEN
        UPDATE procrastinate_jobs SET scheduled_at = NULL WHERE id = last_job;
        RETURN;
    END IF;
    SELECT part || ' ' || serial, c.id INTO of_unit, of_row FROM chain_row c
        JOIN run ON run.id = c.run_id JOIN unit ON unit.id = run.unit_id
        WHERE (c.station, c.number) = (of_station, of_number);
    IF NOT FOUND THEN
        RETURN;
    END IF;
    SELECT unnest(procrastinate_defer_jobs_v1(ARRAY[ROW(
        to_receiver, '{TASK}', 0, to_receiver || ' ' || of_unit, NULL,
        jsonb_build_object('receiver', to_receiver, 'station', of_station, 'number', of_number),
        NULL)::procrastinate_job_to_defer_v1])) INTO last_job;
    INSERT INTO plant_delivery (receiver, station, number, job, row_id)
        VALUES (to_receiver, of_station, of_number, last_job, of_row)
        ON CONFLICT (receiver, station, number) DO UPDATE SET job = last_job, state = 'waiting';
END $$
"""
"""Hands a run over as soon as possible, also one that was settled before."""

_HAND_OVER: Final = f"""
CREATE OR REPLACE FUNCTION plant_hand_over() RETURNS trigger LANGUAGE plpgsql {DEFINER} AS $$
BEGIN
    PERFORM plant_enqueue(name, NEW.station, NEW.number) FROM plant_receiver
        WHERE stopped_at IS NULL;
    RETURN NULL;
END $$
"""

_TRIGGER: Final = """
CREATE OR REPLACE TRIGGER plant_hand_over AFTER INSERT ON chain_row FOR EACH ROW
    WHEN (NEW.content IS NOT NULL) EXECUTE FUNCTION plant_hand_over()
"""

FUNCTIONS: Final = (_ENQUEUE, _HAND_OVER, _TRIGGER)


def rights(deliverers: str, readers: str) -> str:
    """Statements that give a role (quoted) the rights of `flasher plant deliver`."""
    return f"""
REVOKE ALL ON ALL TABLES IN SCHEMA public FROM {deliverers};
REVOKE ALL ON ALL SEQUENCES IN SCHEMA public FROM {deliverers};
REVOKE ALL ON ALL FUNCTIONS IN SCHEMA public FROM {deliverers};
GRANT {readers} TO {deliverers};
GRANT INSERT, UPDATE ON plant_receiver TO {deliverers};
GRANT UPDATE (state, attempts, sent_at, answered_at, answer) ON plant_delivery TO {deliverers};
GRANT EXECUTE ON FUNCTION plant_enqueue(text, uuid, bigint) TO {deliverers};
DO $$
DECLARE
    each text;
BEGIN
    FOR each IN SELECT oid::regclass FROM pg_class WHERE relname LIKE 'procrastinate\\_%'
        AND relkind = 'r' AND relnamespace = 'public'::regnamespace
    LOOP
        EXECUTE 'GRANT SELECT, INSERT, UPDATE, DELETE ON ' || each || ' TO {deliverers}';
    END LOOP;
    FOR each IN SELECT oid::regclass FROM pg_class WHERE relname LIKE 'procrastinate\\_%'
        AND relkind = 'S' AND relnamespace = 'public'::regnamespace
    LOOP
        EXECUTE 'GRANT USAGE ON SEQUENCE ' || each || ' TO {deliverers}';
    END LOOP;
    FOR each IN SELECT oid::regprocedure FROM pg_proc WHERE proname LIKE 'procrastinate\\_%'
        AND pronamespace = 'public'::regnamespace
    LOOP
        EXECUTE 'GRANT EXECUTE ON FUNCTION ' || each || ' TO {deliverers}';
    END LOOP;
END $$;
"""


def statements(connection: Connection) -> list[str]:
    """Statements that create Procrastinate's tables, or bring them up to date; none where the extra
    `handover` is not installed. Without receivers nothing needs them.
    """
    if find_spec("procrastinate") is None:
        return []
    schema = resources.files("procrastinate.sql") / "schema.sql"
    folder = resources.files("procrastinate.sql") / "migrations"
    names = sorted(each.name for each in folder.iterdir() if each.name.endswith(".sql"))
    has = connection.execute(text("SELECT migration FROM plant_queue")).scalar_one_or_none()
    if has is None:
        made = [schema.read_text(encoding="utf-8")]
    else:
        made = [(folder / name).read_text(encoding="utf-8") for name in names if name > has]
    return [*made, f"DELETE FROM plant_queue; INSERT INTO plant_queue VALUES ('{names[-1]}')"]
