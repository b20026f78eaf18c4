# ruff: noqa: S608  all of this SQL is written here
"""How long questions take over a plant's database of a million runs, and how fast runs are added:

    python -m tests.benchmarks.plant_million --folder /tmp/million [--runs 1000000] [--more 2000]

The folder holds a PostgreSQL server that waits for its disk; it is filled once, and measured again
by each call. The runs are rows that the server copies from one run that a real station sent: 30
stations of 4 sockets, 10,000 runs a day up to now, every tenth unit bad at first, 8 steps, 3
measurements and 2 writes each. They are handed over to two receivers: one refused the first 200
runs, the last tenth waits for the other. Their audit rows have the right size, but are not signed,
and there are no traces. `--more` runs are then sent by the forwarder of a station of its own.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import psycopg

from flasher.plant.central import Central
from flasher.plant.forwarder import Forwarder
from flasher.plant.setup import create_database, role_of, setup
from flasher.plant.store import PlantStore
from flasher.station.records.keys import KeyLocations
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import Overview
from flasher.station.records.rollup import Rollup
from flasher.station.shift_counts import DEFAULT_SHIFTS
from flasher.web.plant import PlantPages
from flasher.web.query_processes import Question
from flasher.web.supervisor import open_supervisor
from tests.benchmarks.bulk_records import RUNS_A_DAY as RUNS_A_DAY_OF_ONE
from tests.benchmarks.bulk_records import fill
from tests.station.factory import Bench, _begun_records
from tests.station.postgres import find_programs, running_server

STATIONS = 30
SOCKETS = "ABCD"
RUNS_A_DAY = 10_000

_COPIED = """
CREATE TEMPORARY TABLE t AS SELECT * FROM run WHERE state = 'PASS' ORDER BY id DESC LIMIT 1;
CREATE TEMPORARY TABLE made AS SELECT g,
    -- of two runs, the second one repeats a bad first one
    g - (g % 10 = 1)::int AS unit, g % 10 = 0 AS bad,
    ((g / 2) % {sockets}) + 1 AS place,
    now() - (({runs} - g) * interval '{every_s} s') AS at
    FROM generate_series(1, {runs}) g;
INSERT INTO station (id, name) SELECT 100 + n, 'hall-' || n FROM generate_series(1, {stations}) n;
INSERT INTO socket (id, station_id, name) SELECT 1000 + n, 100 + (n - 1) / {of_one} + 1,
    substr('ABCD', (n - 1) % {of_one} + 1, 1) FROM generate_series(1, {sockets}) n;
INSERT INTO plant_station (role, name, records_id, station, entered_at, reported_at, version,
    unsent, oldest_unsent_at, clock_offset_s, disk_free_bytes)
    SELECT 'flasher_hall_' || n, 'hall-' || n, md5(n::text), md5('s' || n)::uuid, now(), now(),
    '1.0', 0, '', 0.1, 50000000000 FROM generate_series(1, {stations}) n;
INSERT INTO unit (id, part, serial) SELECT 1000 + g, 'BAT-36', 'M' || lpad(g::text, 9, '0')
    FROM made WHERE unit = g;
INSERT INTO run (id, unit_id, socket_id, recipe_id, lot_id, operator_id, kind, is_virtual, reason,
    state, code, text, begun_at, begun_monotonic_s, ended_at, ended_monotonic_s,
    verification_required, allow_completed_not_read_back, verification_reached, log_sha256)
    SELECT floor(extract(epoch FROM m.at) * 1000000), 1000 + m.unit, 1000 + m.place, t.recipe_id,
    t.lot_id, t.operator_id, t.kind, t.is_virtual, t.reason,
    CASE WHEN m.bad THEN 'FAIL' ELSE 'PASS' END, CASE WHEN m.bad THEN 'NO_ANSWER' ELSE 'OK' END,
    '', to_char(m.at AT TIME ZONE 'UTC', 'YYYY-MM-DD"T"HH24:MI:SS.US"Z"'), t.begun_monotonic_s,
    to_char((m.at + interval '13 s') AT TIME ZONE 'UTC', 'YYYY-MM-DD"T"HH24:MI:SS.US"Z"'),
    t.ended_monotonic_s, t.verification_required, t.allow_completed_not_read_back,
    CASE WHEN NOT m.bad THEN t.verification_reached END,
    encode(sha256(convert_to('m' || m.g, 'UTF8')), 'hex') FROM made m, t ORDER BY m.g;
CREATE TEMPORARY TABLE new AS SELECT r.id, r.log_sha256, r.socket_id, row_number() OVER (ORDER BY
    r.id) AS g FROM run r WHERE socket_id > 1000;
INSERT INTO run_target (run_id, artifact_id, position, target, required, reached)
    SELECT n.id, (SELECT min(id) FROM artifact) + (n.g > {runs} * 0.9)::int, o.position, o.target,
    o.required, o.reached FROM new n, run_target o WHERE o.run_id = (SELECT id FROM t)
    ORDER BY n.id;
CREATE TEMPORARY TABLE s AS SELECT *, row_number() OVER (ORDER BY position) AS k FROM step
    WHERE run_id = (SELECT id FROM t);
INSERT INTO step (id, run_id, position, name, try_number, state, code, text, begun_at,
    begun_monotonic_s, duration_s) SELECT 1000000 + n.g * 8 + s.k, n.id, s.position, s.name,
    s.try_number, s.state, s.code, s.text, s.begun_at, s.begun_monotonic_s,
    s.duration_s * (0.8 + 0.4 * random()) FROM new n, s;
INSERT INTO measurement (step_id, name, value, unit, low, high)
    SELECT 1000000 + n.g * 8 + s.k, m.name, 36.2 + (random() + random() + random() - 1.5), m.unit,
    m.low, m.high FROM new n, s JOIN measurement m ON m.step_id = s.id;
INSERT INTO device_write (run_id, target, what, value, intended_at, intended_monotonic_s,
    verified_at, read_back) SELECT n.id, w.target, w.what, w.value, w.intended_at,
    w.intended_monotonic_s, w.verified_at, w.read_back FROM new n, device_write w
    WHERE w.run_id = (SELECT id FROM t);
INSERT INTO attachment (run_id, kind, name, sha256, size_bytes) SELECT n.id, a.kind, a.name,
    n.log_sha256, a.size_bytes FROM new n, attachment a WHERE a.run_id = (SELECT id FROM t);
INSERT INTO chain_row (station, number, at, event, run_number, data, previous_hash, hash, signature,
    content, station_id, run_id) SELECT md5('s' || (n.socket_id - 1001) / {of_one} + 1)::uuid,
    n.g * 2 + k.is_end, c.at, c.event, n.g, c.data, repeat('0', 64),
    encode(sha256(convert_to(n.g || c.event, 'UTF8')), 'hex'), c.signature, c.content,
    100 + (n.socket_id - 1001) / {of_one} + 1, n.id
    FROM new n, chain_row c, LATERAL (SELECT (c.event <> 'claimed')::int AS is_end) k
    WHERE c.run_id = (SELECT id FROM t);
INSERT INTO plant_receiver (name) VALUES ('mes'), ('broker');
INSERT INTO plant_delivery (receiver, station, number, state, attempts, sent_at, answered_at,
    answer, job, row_id) SELECT 'mes', c.station, c.number,
    CASE WHEN c.run_number <= 200 THEN 'refused' ELSE 'confirmed' END, 1, now(), now(),
    'HTTP 200', c.id, c.id FROM chain_row c JOIN new n ON n.id = c.run_id
    WHERE c.content IS NOT NULL;
INSERT INTO plant_delivery (receiver, station, number, state, job, row_id) SELECT 'broker',
    c.station, c.number, CASE WHEN c.run_number > {runs} * 0.9 THEN 'waiting' ELSE 'confirmed' END,
    c.id, c.id FROM chain_row c JOIN new n ON n.id = c.run_id WHERE c.content IS NOT NULL;
"""
_INDEXES = """
SELECT indexname, indexdef FROM pg_indexes WHERE schemaname = 'public'
    AND indexname NOT IN (SELECT conname FROM pg_constraint)
"""
"""Made again after the rows, which takes less time."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--more", type=int, default=2000)
    parser.add_argument("--sums", action="store_true", help="make the daily sums of the pages")
    options = parser.parse_args()
    programs = find_programs()
    if programs is None:
        raise SystemExit("PostgreSQL is not installed.")
    options.folder.mkdir(exist_ok=True)
    with running_server(programs, kept=options.folder, is_durable=True) as server:
        url = f"postgresql://postgres@127.0.0.1:{server.port}/plant"
        if create_database(url):
            _fill(url, options.runs)
        setup(url, (), datetime.now(UTC))
        if options.more:
            _send(url, options.more)
        _measure(url, options.folder / "desk", with_sums=options.sums)


def _measure(url: str, folder: Path, *, with_sums: bool) -> None:
    pages = open_supervisor(url, folder, KeyLocations(), DEFAULT_SHIFTS, PlantStore, PlantPages)
    with closing(pages.store), psycopg.connect(url, autocommit=True) as admin:
        query = "SELECT count(*), pg_size_pretty(pg_database_size(current_database())) FROM run"
        ((runs, size),) = admin.execute(query.encode()).fetchall()
        print(f"{runs:,} runs, {size}", flush=True)
        overview = Overview(pages.store.database)
        for image in overview.images():
            what = f"units of the image {image.sha256[:8]}, 1,000 of {{}}"
            took_s, found = _timed(partial(overview.holders, image.sha256, PageCursor(), 1000))
            print(f"{took_s:7.3f} s  {what.format(len(found.rows))}", flush=True)
        if with_sums:
            sums, began_s = Rollup(pages.store.database), time.perf_counter()
            sums.add(datetime.now(UTC) - timedelta(hours=1))  # the audit rows have settled since
            while sums.add(datetime.now(UTC)):
                pass
            print(f"{time.perf_counter() - began_s:7.1f} s  daily sums made", flush=True)
        of_one = {"station": "hall-7"}
        for path, fields in (
            ("/stations", {}), ("/yield", {}), ("/yield", of_one),
            ("/yield", {"from": "2020-01-01"}), ("/images", {}), ("/runs", {}),
            ("/runs", of_one), ("/times", {}), ("/measurements", {}),
            ("/measurements", of_one), ("/audit", {}), ("/deliveries", {}),
            ("/deliveries", {"state": "refused"}), ("/deliveries", {"state": "waiting"}),
            ("/deliveries", {"to": f"{datetime.now(UTC) - timedelta(days=50):%Y-%m-%d}"}),
        ):  # fmt: skip
            question = Question(path, fields)
            first_s, _ = _timed(partial(pages.answer, question))
            took_s, answer = _timed(partial(pages.answer, question))
            print(
                f"{took_s:7.3f} s  {answer.status} {path} {fields or ''} (first {first_s:.3f} s)",
                flush=True,
            )
            assert answer.status in (200, 503), answer.body


def _timed(ask: Callable[[], Any]) -> tuple[float, Any]:
    began_s = time.perf_counter()
    found = ask()
    return time.perf_counter() - began_s, found


def _fill(url: str, runs: int) -> None:
    setup(url, (), datetime.now(UTC))
    _send(url, 100)
    values = {
        "runs": runs, "every_s": 86400 / RUNS_A_DAY, "stations": STATIONS,
        "of_one": len(SOCKETS), "sockets": STATIONS * len(SOCKETS),
    }  # fmt: skip
    with psycopg.connect(url, autocommit=True) as admin:
        admin.execute("SET session_replication_role = replica")
        admin.execute("SET synchronous_commit = off")
        indexes = admin.execute(_INDEXES).fetchall()
        for name, _ in indexes:
            admin.execute(f"DROP INDEX {name}".encode())
        for statement in (*_COPIED.format(**values).split(";\n"), *(made for _, made in indexes)):
            began_s = time.perf_counter()
            if statement.strip():
                admin.execute(statement.encode())
                took_s = time.perf_counter() - began_s
                print(f"{took_s:6.1f} s  {statement.strip().splitlines()[0][:70]}", flush=True)
        for table in ("station", "socket", "unit", "step"):
            serial = f"pg_get_serial_sequence('{table}', 'id')"
            admin.execute(f"SELECT setval({serial}, max(id)) FROM {table}".encode())
        admin.execute("VACUUM ANALYZE")


def _send(url: str, runs: int) -> None:
    """Send runs of a station with new records, by the product's own sender."""
    role = role_of("line-2")
    setup(url, ["line-2"], datetime.now(UTC), renewed=["line-2"])
    with psycopg.connect(url, autocommit=True) as admin:
        admin.execute(f"ALTER ROLE {role} PASSWORD 'x'".encode())
    first_day = datetime.now(UTC) - timedelta(days=runs / RUNS_A_DAY_OF_ONE)
    with tempfile.TemporaryDirectory() as folder:
        _begun_records.cache_clear()  # records of their own, not a copy
        bench = Bench(Path(folder))
        bench.make(lot="L1")
        fill(bench, runs, min(runs, 500), first_day)
        central = Central(url.replace("postgres@", f"{role}:x@"))
        forwarder = Forwarder(
            bench.opened().database, bench.store.files, central, "line-2", bench.clock
        )
        with closing(forwarder):
            began_s, own_s = time.perf_counter(), time.process_time()
            while forwarder.forward():
                pass
            took_s, own_s = time.perf_counter() - began_s, time.process_time() - own_s
            server_s = _cpu_s(url, role)
        if forwarder.error is not None:
            raise forwarder.error
        bench.store.close()
    print(
        f"{runs:,} runs sent: {runs / took_s:,.0f} runs/s; CPU a run: {own_s / runs * 1000:.1f} ms"
        f" of the forwarder, {server_s / runs * 1000:.1f} ms of the server",
        flush=True,
    )


def _cpu_s(url: str, role: str) -> float:
    """CPU time of the server's processes for a role."""
    with psycopg.connect(url) as admin:
        query = "SELECT pid FROM pg_stat_activity WHERE usename = %s"
        pids = [pid for (pid,) in admin.execute(query, [role])]
    ticks = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
