"""What is wrong with the records: the database, its runs, attachments and traces."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator
from typing import Final

from sqlalchemy import Connection, func, select

from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.station.records import schema
from flasher.station.records.database import Database
from flasher.station.records.details import details_of
from flasher.station.records.digests import NAMED, OWN, batches, digests_of
from flasher.station.records.errors import RecordError
from flasher.station.records.files import FileStore
from flasher.station.records.model import (
    TRACE,
    AttachmentFile,
    Examination,
    Problem,
    RunDetails,
    RunId,
    RunState,
)
from flasher.station.records.proof import contradictions, hear
from flasher.station.records.queries import run_records
from flasher.station.records.signing import KeptPlace
from flasher.station.records.trails import TrailsCheck
from flasher.trace.reader import read_trace

_RUNS_NAMED: Final = 5


class Examiner:
    """One examination of the records."""

    def __init__(self, database: Database, files: FileStore, place: KeptPlace) -> None:
        self._database = database
        self._files = files
        self._trails = TrailsCheck(place)
        self._traces = 0
        self._nameless = 0

    def examine(self, runs: Collection[RunId] | None = None) -> Examination:
        """Look at everything, and of the runs at these or at all."""
        with self._database.reading() as connection:
            problems = tuple(self._problems(connection, runs))
        trails = self._trails
        if self._nameless:
            trails.remarks.append(
                f"{self._nameless} PASS of devices that name no serial number: their traces do not"
                " tell which unit it was"
            )
        return Examination(
            problems,
            tuple(trails.remarks),
            tuple(trails.kept),
            tuple(trails.unkept),
            self._traces,
        )

    def _problems(
        self, connection: Connection, runs: Collection[RunId] | None
    ) -> Iterator[Problem]:
        if self._database.backend == "sqlite":
            yield from _sqlite_problems(connection)
        yield from self._trails.problems(connection)
        query = select(schema.run.c.id).order_by(schema.run.c.id)
        chosen = list(connection.execute(query).scalars())
        for run_id in sorted(
            (self._trails.claims.keys() | self._trails.endings.keys()) - set(chosen)
        ):
            yield Problem(f"run {run_id}", "it is missing: the audit trail knows it", (run_id,))
        if runs is not None:
            chosen = sorted(set(chosen) & set(runs))
        changed: dict[tuple[str, str], list[int]] = defaultdict(list)
        for batch in batches(chosen):
            yield from self._runs(connection, batch, changed)
        for (part, _), run_ids in changed.items():
            shown = ", ".join(map(str, run_ids[:_RUNS_NAMED]))
            more = f" and {len(run_ids) - _RUNS_NAMED} more" if len(run_ids) > _RUNS_NAMED else ""
            what = f"changed after it was recorded: {NAMED[part]}"
            yield Problem(f"{part} of run {shown}{more}", what, tuple(run_ids))
        yield from self._traces_used_twice(connection)

    # -- runs -------------------------------------------------------------------------------------

    def _runs(
        self, connection: Connection, run_ids: list[int], changed: dict[tuple[str, str], list[int]]
    ) -> Iterator[Problem]:
        for run_id, digests in digests_of(connection, run_ids).items():
            where = f"run {run_id}"
            claim, ending = (
                self._trails.claims.get(run_id, {}),
                self._trails.endings.get(run_id, {}),
            )
            if not claim and not ending:
                yield Problem(where, "the audit trail does not know it", (run_id,))
            wrong = {
                part: digests.get(part, "")
                for stated in (claim, ending)
                for part in stated
                if stated[part] != digests.get(part)
            }
            for part in wrong.keys() & NAMED.keys():
                changed[part, wrong[part]].append(run_id)
            own = [words for part, words in OWN.items() if part in wrong]
            if own:
                what = f"changed after it was recorded: {', '.join(own)}"
                yield Problem(where, what, (run_id,))
        yield from self._parts(connection, run_ids)

    def _parts(self, connection: Connection, run_ids: list[int]) -> Iterator[Problem]:
        """What the runs are, and their attachments."""
        try:
            found = tuple(details_of(connection, run_records(connection, run_ids)))
        except ValueError as error:  # a word or a time that no station writes
            if len(run_ids) > 1:
                for run_id in run_ids:
                    yield from self._parts(connection, [run_id])
            else:
                said = printable(f"{error!s:.100}")
                what = f"it cannot be read: {said}"
                yield Problem(f"run {run_ids[0]}", what, tuple(run_ids))
            return
        for details in found:
            run_id = details.run.run_id
            is_over = details.run.state is not RunState.RUNNING
            is_known = run_id in self._trails.claims or run_id in self._trails.endings
            if is_known and is_over != (run_id in self._trails.endings):
                what = "it is finished" if is_over else "it goes on"
                what += ", but the audit trail says otherwise"
                yield Problem(f"run {run_id}", what, (run_id,))
            yield from self._attachments(details)

    def _attachments(self, details: RunDetails) -> Iterator[Problem]:
        run = details.run
        traces = [
            file
            for file in details.attachments
            if file.kind == TRACE and file.sha256 == run.log_sha256
        ]
        for file in details.attachments:
            wrong = self._files.check(file.sha256)
            if wrong:
                where = f"run {run.run_id}, attachment {file.sha256}"
                yield Problem(where, wrong, (run.run_id,))
                if file in traces:
                    return
        if run.state is RunState.PASS:
            yield from self._trace(details, traces)

    def _trace(self, details: RunDetails, traces: list[AttachmentFile]) -> Iterator[Problem]:
        """Hold a PASS against its own trace."""
        run = details.run
        where = f"run {run.run_id}, PASS of {printable(run.serial)}"
        if not traces:
            yield Problem(where, "there is no trace to hold it against", (run.run_id,))
            return
        try:
            with self._files.named(traces[0]) as path:
                heard = hear((target.target for target in details.targets), read_trace(path))
        except (UsageError, RecordError) as error:
            what = f"its trace cannot be read: {error.cause or error.what}"
            yield Problem(where, what, (run.run_id,))
            return
        self._traces += 1
        self._nameless += not any(each.serial for each in heard.values())
        for what in contradictions(details, heard):
            yield Problem(where, f"its trace says otherwise: {what}", (run.run_id,))

    @staticmethod
    def _traces_used_twice(connection: Connection) -> Iterator[Problem]:
        run = schema.run.c
        query = (
            select(run.log_sha256)
            .where(run.state == RunState.PASS.value)
            .group_by(run.log_sha256)
            .having(func.count() > 1)
        )
        for sha256 in connection.execute(query).scalars().all():
            of_trace = select(run.id).where(run.log_sha256 == sha256).order_by(run.id)
            run_ids = tuple(connection.execute(of_trace).scalars())
            shown = ", ".join(map(str, run_ids[:_RUNS_NAMED]))
            yield Problem(f"runs {shown}", "they have one and the same trace", run_ids)


def _sqlite_problems(connection: Connection) -> Iterator[Problem]:
    for (found,) in connection.exec_driver_sql("PRAGMA integrity_check").all():
        if found != "ok":
            yield Problem("database", printable(str(found)))
    for row in connection.exec_driver_sql("PRAGMA foreign_key_check").all():
        yield Problem(f"table {row[0]}, row {row[1]}", f"it names a missing row of {row[2]}")
