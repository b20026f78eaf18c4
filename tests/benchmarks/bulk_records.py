# ruff: noqa: S608  names of tables and columns of our own
"""Records of a large plant, written in bulk: past the rules of the database, but with the digests,
the chain, the signatures and the kept heads that a station makes.

The records have to be open and hold one run, made by the station itself: all others are like it.
Eight sockets, lots of 2,500 units, three images, two recipes, three shifts a day, 1,667 runs a day,
every ninth unit bad at first. The last runs have traces, if asked for.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from typing import Any, Final, Protocol

from sqlalchemy import Connection, Table, select

from flasher.protocol.spec import BMS
from flasher.station.records import chain, schema
from flasher.station.records.chain import CLAIM, CLAIM_PARTS, canonical, digest
from flasher.station.records.heads import ChainHead
from flasher.station.records.model import RunState, utc_text
from flasher.station.records.signatures import SigningKey
from tests.station.factory import BMS_VERSION, IMAGES, Bench
from tests.station.traces import run_messages, write_trace

SOCKETS: Final = tuple("ABCDEFGH")
CODES: Final = ("NO_ANSWER", "REFUSED", "WRONG_HARDWARE", "TRANSFER_FAILED", "OTHER_VERSION")
STEPS: Final = (
    ("connect", 0.4), ("identify", 0.1), ("check", 0.2), ("flash", 9.0), ("write", 0.6),
    ("restart", 2.1), ("verify", 0.9), ("save", 0.05),
)  # fmt: skip
RUNS_A_DAY: Final = 1667
RUNS_A_LOT: Final = 2500
FIRST_DAY: Final = datetime(2026, 5, 18, tzinfo=UTC)
"""After the run of the station itself."""
_BATCH: Final = 5000
_TOOK_S: Final = sum(seconds for _, seconds in STEPS)
_Row = dict[str, Any]


def fill(bench: Bench, runs: int, traces: int = 0, first_day: datetime = FIRST_DAY) -> None:
    """Make it `runs` runs from `first_day` on, the last `traces` of them with a trace."""
    store = bench.store
    with store.database.engine.connect() as connection, _bulk(connection) as rows:
        made = _Plant(bench, connection, rows, runs, traces, first_day)
        made.name_things()
        for run_id in range(2, runs + 1):
            made.add_run(run_id)
            if run_id % _BATCH == 0:
                made.write()
        made.write()
        made.check()


class _Rows(Protocol):
    """Takes rows, many at a time."""

    def __call__(self, table: Table, rows: list[_Row]) -> None: ...


@contextmanager
def _bulk(connection: Connection) -> Iterator[_Rows]:
    """Writes rows past triggers and durability; they are in force again afterwards."""
    driver: Any = connection.connection.dbapi_connection
    rules = driver.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
    for pragma in ("foreign_keys = 0", "synchronous = 0", "cache_size = -500000"):
        driver.execute(f"PRAGMA {pragma}")
    driver.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    driver.execute("PRAGMA journal_mode = OFF")
    connection.begin()
    for name, _ in rules:
        driver.execute(f"DROP TRIGGER {name}")

    def write(table: Table, rows: list[_Row]) -> None:
        names = [column.name for column in table.columns]
        marks = ", ".join("?" * len(names))
        driver.executemany(
            f"INSERT INTO {table.name} ({', '.join(names)}) VALUES ({marks})",
            ([row[name] for name in names] for row in rows),
        )

    yield write
    for _, statement in rules:
        driver.execute(statement)
    connection.commit()
    driver.execute("PRAGMA journal_mode = WAL")
    connection.invalidate()


class _Plant:
    """Rows of many runs, with the end of the chain."""

    def __init__(
        self,
        bench: Bench,
        connection: Connection,
        write: _Rows,
        runs: int,
        traces: int,
        first_day: datetime,
    ) -> None:
        self._first_day = first_day
        self._bench, self._connection, self._write = bench, connection, write
        self._runs, self._traces = runs, traces
        self._chance = random.Random(7)
        self._rows: dict[str, list[_Row]] = {}
        self._heads: list[ChainHead] = []
        self._digests: dict[tuple[str, int], str] = {}
        signer = bench.store.signer
        key = SigningKey.load(signer.key_file)
        assert key is not None
        self._key = key
        self._heads_file = signer.heads_file
        last = self._last(schema.audit)
        self._audit_id, self._number, self._before = last["id"], last["number"], last["hash"]
        self._run, self._unit = self._last(schema.run), self._last(schema.unit)
        self._target = self._last(schema.run_target)
        self._next = {
            table.name: self._last(table)["id"] + 1
            for table in (schema.step, schema.device_write, schema.attachment)
        }
        self._next["measurement"] = 1
        self._was_bad = False

    def _last(self, table: Table) -> _Row:
        query = select(table).order_by(table.c.id.desc()).limit(1)
        return dict(self._connection.execute(query).mappings().one())

    def _add(self, table: Table, **row: Any) -> _Row:
        self._rows.setdefault(table.name, []).append(row)
        return row

    def _id(self, table: str) -> int:
        found: int = self._next[table]
        self._next[table] = found + 1
        return found

    def name_things(self) -> None:
        """Sockets, recipes, images and lots; the digest of each is made once."""
        station, recipe = self._last(schema.station), self._last(schema.recipe)
        image, lot = self._last(schema.artifact), self._last(schema.lot)
        operator = self._last(schema.operator)
        sockets = [self._last(schema.socket)]
        for number, name in enumerate(SOCKETS[1:], 2):
            sockets.append(self._add(schema.socket, id=number, station_id=1, name=name))
        other = self._add(schema.recipe, **{**recipe, "id": 2, "revision": "5", "sha256": "5" * 64})
        images = [image]
        for number, name in ((2, "next"), (3, "pilot")):
            named = {"id": number, "name": f"{name}.bin", "sha256": f"{number}" * 64}
            images.append(self._add(schema.artifact, **{**image, **named}))
        lots = [
            lot,
            *(
                self._add(schema.lot, id=number + 1, part=recipe["part"], name=f"L{number:03}")
                for number in range(1, self._runs // RUNS_A_LOT + 1)
            ),
        ]
        for name, rows in (
            ("station", [station]), ("recipe", [recipe, other]), ("operator", [operator]),
            ("socket", sockets), ("lot", lots),
        ):  # fmt: skip
            for row in rows:
                self._digests[name, row["id"]] = digest(row)
        for row in images:
            self._digests["artifacts", row["id"]] = digest([row])

    def add_run(self, run_id: int) -> None:
        if not self._was_bad:
            number = self._unit["id"] + 1
            self._unit = self._add(
                schema.unit, id=number, part=self._unit["part"], serial=f"W{number:07}"
            )
        bad = not self._was_bad and self._chance.random() < 0.11
        self._was_bad = bad
        at = self._first_day + timedelta(days=run_id / RUNS_A_DAY)
        share = run_id / self._runs
        trace = self._trace(run_id) if run_id > self._runs - self._traces else None
        sha256 = f"{run_id:064x}" if trace is None else trace[0]
        begun_s = run_id * 20.0
        run = self._add(schema.run, **{
            **self._run, "id": run_id, "unit_id": self._unit["id"],
            "socket_id": 1 + run_id % len(SOCKETS), "recipe_id": 1 + (share > 0.6),
            "lot_id": 1 + run_id // RUNS_A_LOT,
            "state": (RunState.FAIL if bad else RunState.PASS).value,
            "code": self._chance.choices(CODES, (50, 25, 12, 8, 5))[0] if bad else "OK",
            "begun_at": utc_text(at), "begun_monotonic_s": begun_s,
            "ended_at": utc_text(at + timedelta(seconds=_TOOK_S)),
            "ended_monotonic_s": begun_s + _TOOK_S, "log_sha256": sha256,
            "verification_reached": None if bad else 1,
        })  # fmt: skip
        image = 3 if run_id % 250 == 0 else 1 + (share > 0.6)
        if trace is not None:
            image = 1  # the one that the trace carries
        target = self._add(schema.run_target, **{
            **self._target, "id": run_id, "run_id": run_id, "artifact_id": image,
            "reached": None if bad else 1,
        })  # fmt: skip
        size = 900 if trace is None else trace[1]
        file = self._add(
            schema.attachment, id=self._id("attachment"), run_id=run_id, kind="trace",
            name="t.log.gz", sha256=sha256, size_bytes=size,
        )  # fmt: skip
        parts = self._parts(run_id, utc_text(at), bad=bad)
        claim = {name: value for name, value in run.items() if name not in chain.OUTCOME}
        digests = {
            "run": digest(run),
            CLAIM: digest([claim, [{**target, "reached": None}]]),
            "unit": digest(self._unit),
            "socket": self._digests["socket", run["socket_id"]],
            "station": self._digests["station", 1],
            "operator": self._digests["operator", 1],
            "recipe": self._digests["recipe", run["recipe_id"]],
            "lot": self._digests["lot", run["lot_id"]],
            "artifacts": self._digests["artifacts", image],
            "targets": digest([target]),
            "attachments": digest([file]),
            **parts,
        }
        claimed = {
            "serial": self._unit["serial"],
            "digests": {name: digests[name] for name in CLAIM_PARTS},
        }
        self._append(run["begun_at"], chain.CLAIMED, claimed, run_id)
        finished = {"state": run["state"], "digests": digests}
        self._append(run["ended_at"], chain.FINISHED, finished, run_id)

    def _parts(self, run_id: int, at: str, *, bad: bool) -> dict[str, str]:
        steps, measured, writes = [], [], []
        for position, (name, seconds) in enumerate(STEPS, 1):
            failed = bad and name == "verify"
            step = self._add(
                schema.step, id=self._id("step"), run_id=run_id, position=position, name=name,
                try_number=1, state="FAIL" if failed else "PASS", code="", text="", begun_at=at,
                begun_monotonic_s=0.0, duration_s=seconds * self._chance.lognormvariate(0, 0.2),
            )  # fmt: skip
            steps.append(step)
            if name in ("identify", "check", "verify"):
                row = self._add(
                    schema.measurement, id=self._id("measurement"), step_id=step["id"],
                    name="voltage", value=36.2, unit="V", low=30.0, high=42.0, text=None,
                    expected=None,
                )  # fmt: skip
                measured.append({**row, "run_id": run_id})
        for what, value in (("flash", BMS_VERSION), ("serial-number", self._unit["serial"])):
            open_ = bad and what == "flash"
            writes.append(
                self._add(
                    schema.device_write,
                    id=self._id("device_write"),
                    run_id=run_id,
                    target="bms",
                    what=what,
                    value=value,
                    intended_at=at,
                    intended_monotonic_s=0.0,
                    verified_at=None if open_ else at,
                    read_back=None,
                )
            )
        return {
            "steps": digest(steps),
            "measurements": digest(measured),
            "writes": digest(writes),
        }

    def _trace(self, run_id: int) -> tuple[str, int]:
        serial = self._unit["serial"]
        reported = run_messages(serial, BMS_VERSION, IMAGES[BMS], written=serial)
        path = write_trace(
            self._bench.folder / "run.log.gz", reported, at_s=1_779_000_000.0 + run_id
        )
        file = self._bench.store.files.add("trace", path)
        path.unlink()
        return file.sha256, file.size_bytes

    def _append(self, at: str, event: str, data: _Row, run_id: int) -> None:
        self._audit_id, self._number = self._audit_id + 1, self._number + 1
        row: _Row = {
            "number": self._number, "at": at, "event": event, "run_id": run_id,
            "data": canonical(data), "previous_hash": self._before,
        }  # fmt: skip
        self._before = chain.row_hash(row)
        signature = self._key.sign(self._before)
        self._add(
            schema.audit, **row, id=self._audit_id, station_id=1, hash=self._before,
            signature=signature,
        )  # fmt: skip
        head = ChainHead("line-2", self._number, at, self._before, signature, self._key.public)
        self._heads.append(head)

    def write(self) -> None:
        for table in schema.metadata.sorted_tables:
            if self._rows.get(table.name):
                self._write(table, self._rows.pop(table.name))
        self._heads_file.append(self._heads, self._key)
        self._heads.clear()

    def check(self) -> None:
        """Compare a run with what a station makes of its rows."""
        ending = select(schema.audit.c.data).where(
            schema.audit.c.run_id == self._runs, schema.audit.c.event == chain.FINISHED
        )
        stated = chain.data_of(self._connection.execute(ending).scalar_one())["digests"]
        found = chain.digests_of(self._connection, [self._runs])[self._runs]
        assert stated == found, {name for name in found if found[name] != stated.get(name)}
