"""Records of a station: begins, writes, steps and ends of runs, each on disk on return.

    store = Store.open("records.sqlite", station="line-2", clock=SystemClock())
    store.recover()
    claim = store.claim(Order(serial, "A", "jo"), recipe)
    write = store.intent(claim.run_id, "bms", "flash", "V1r0r4_20220512")
    ... the act ...
    store.verified(write, "V1r0r4_20220512")
    store.step(claim.run_id, "flash", StepState.PASS, ...)
    trace = store.files.add("trace", path)
    store.finish(claim.run_id, RunResult(RunState.PASS, "OK", ...))   # only now show PASS

Whatever raises RecordError has saved nothing; a run that could not be finished stays RUNNING, and
`finish` may be tried again with the same ending. Threads may share a store that is in a file: every
operation has a connection of its own, and writers wait for each other.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

from sqlalchemy import func, select, update

from flasher.errors import FlasherError
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records import chain, schema
from flasher.station.records.chain import Trail, digests_of
from flasher.station.records.claims import Claiming, check_order, check_signatures
from flasher.station.records.database import (
    Database,
    Location,
    StationLock,
    locate_records,
    make_backup,
    open_database,
)
from flasher.station.records.errors import (
    NotFoundError,
    OldSchemaError,
    RecordError,
    RuleBrokenError,
)
from flasher.station.records.examination import Examiner, Progress
from flasher.station.records.examined import Examined, load_examined, save_examined
from flasher.station.records.files import FileStore
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import (
    DEFAULT_LOCK_TIMEOUT_S,
    OUTCOMES,
    AttachmentFile,
    AuditEvent,
    Backup,
    Claim,
    Examination,
    Measurement,
    Order,
    PassedTwice,
    RunExamination,
    RunId,
    RunResult,
    RunState,
    StationClock,
    StepState,
    WriteId,
    utc_text,
)
from flasher.station.records.queries import Records
from flasher.station.records.rows import insert
from flasher.station.records.signing import Signer
from flasher.station.records.upgrade import upgrade

_USUAL: Final = KeyLocations()
_ONLY_FINITE = "only finite numbers can be recorded"


class SystemClock:
    """Clocks of this computer."""

    def utc(self) -> datetime:
        return datetime.now(UTC)

    def monotonic_s(self) -> float:
        return time.perf_counter()


class Store:
    """The records of a station. Open with `Store.open`; a context manager."""

    located: Callable[[str, Path | None], Location] = staticmethod(locate_records)
    """Finds the records that `open` is given."""
    opened: Callable[..., Database] = staticmethod(open_database)
    """Opens and checks them."""

    def __init__(
        self,
        database: Database,
        station: str,
        clock: StationClock,
        key_locations: KeyLocations = _USUAL,
    ) -> None:
        self.database = database
        self.station = station
        self.files = FileStore(database.location.folder)
        self.signer = Signer(database, station, clock.utc, key_locations)
        self.read = Records(database)
        self._clock = clock
        self._lock = StationLock(station, database.location.folder)

    @classmethod
    def open(  # noqa: PLR0913  each setting of the records
        cls,
        url: str,
        *,
        station: str,
        clock: StationClock | None = None,
        folder: Path | None = None,
        lock_timeout_s: float = DEFAULT_LOCK_TIMEOUT_S,
        create: bool = True,
        read_only: bool = False,
        key_locations: KeyLocations = _USUAL,
        report: Callable[[str], None] = lambda _text: None,
    ) -> Self:
        """Open records in an SQLite file, which is created with `create`.

        `folder` holds the attachments (by default beside the file). A file with an older
        schema is upgraded after a backup (`upgrade`). `read_only` changes nothing, not even the
        journal. `report` is called with a sentence before a long operation. Raises UsageError for
        an invalid location, SchemaVersionError, RecordError.
        """
        clock = clock or SystemClock()
        location = cls.located(url, folder)
        opened = partial(
            cls.opened,
            location,
            clock.utc(),
            lock_timeout_s=lock_timeout_s,
            create=create and not read_only,
            read_only=read_only,
        )
        try:
            database = opened()
        except OldSchemaError:
            if read_only:
                raise
            report(f"Records of an older flasher: copies, then changes {location.shown} (minutes).")
            upgrade(
                location,
                choose=lambda _: station,
                key_locations=key_locations,
                now=clock.utc,
                lock_timeout_s=lock_timeout_s,
            )
            database = opened()
        return cls(database, station, clock, key_locations)

    def close(self) -> None:
        """Close the database and release the station lock."""
        self.signer.close()
        self._lock.release()
        self.database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    # -- beginning --------------------------------------------------------------------------------

    def become_station(self) -> None:
        """Acquire the station lock: only this process may append to the station's chain. Raises
        StationBusyError, KeyMissingError, RecordsCutError, RecordError.
        """
        self._lock.acquire()
        self.signer.begin()

    def recover(self) -> tuple[RunId, ...]:
        """Acquire the station lock and end runs that a dead process left RUNNING; call it once at
        start.

        These runs become INTERRUPTED and keep their traces; their units become RECHECK. Raises
        StationBusyError, KeyMissingError, RecordsCutError, RecordError.
        """
        self.become_station()
        self.files.sweep(self._clock.utc())
        return self.end_unknown(())

    def end_unknown(self, known: Collection[RunId]) -> tuple[RunId, ...]:
        """End runs of this station that are RUNNING but not `known`: a dead process left them, or a
        claim was saved although it seemed to fail. They become INTERRUPTED. Raises RecordError.
        """
        now = self._clock.utc()
        with self.signer.writing() as trail:
            left = trail.connection.execute(
                select(schema.run.c.id)
                .join_from(schema.run, schema.socket)
                .join(schema.station)
                .where(
                    schema.run.c.state == RunState.RUNNING.value,
                    schema.station.c.name == self.station,
                )
                .order_by(schema.run.c.id)
            ).scalars()
            found = tuple(RunId(run_id) for run_id in left if run_id not in known)
            for run_id in found:
                _end_run(
                    trail,
                    run_id,
                    self.files.add_spooled(run_id),
                    now,
                    state=RunState.INTERRUPTED.value,
                    code="STATION_DIED",
                    text="The station ended before this run did. The unit has to be checked.",
                )
        for run_id in found:
            self.files.forget_spooled(run_id)
        return found

    def claim(self, order: Order, recipe: LoadedRecipe) -> Claim:
        """Start a run of a unit if every rule allows it; otherwise nothing is recorded. Raises
        ClaimRefusedError, RecordError (also before `recover`).
        """
        now = self._clock.utc()
        order = check_order(order, recipe, now)
        signatures = check_signatures(recipe)
        # One claim at a time: two must not take the last place of a lot.
        with self.signer.writing() as trail:
            return Claiming(trail, order, recipe, signatures, now).begin(self._clock.monotonic_s())

    def passed_twice(self, _limit: int) -> Sequence[PassedTwice]:
        """The newest units that passed at two stations: none, as one station refuses them."""
        return ()

    # -- while it runs ----------------------------------------------------------------------------

    def intent(self, run_id: RunId, target: str, what: str, value: str) -> WriteId:
        """Record an irreversible action before it is done. On disk on return."""
        with self.database.writing() as connection:
            write_id = insert(
                connection,
                schema.device_write,
                run_id=run_id,
                target=target,
                what=what,
                value=value,
                intended_at=utc_text(self._clock.utc()),
                intended_monotonic_s=self._clock.monotonic_s(),
            )
        return WriteId(write_id)

    def verified(self, write_id: WriteId, read_back: str | None) -> None:
        """Record that the action is done. `read_back` is the value that the device reports now;
        None if it only confirmed ("completed, not read back"). On disk on return.
        """
        table = schema.device_write
        with self.database.writing() as connection:
            done = connection.execute(
                update(table)
                .where(table.c.id == write_id)
                .values(verified_at=utc_text(self._clock.utc()), read_back=read_back)
            )
            if done.rowcount != 1:
                raise NotFoundError(f"There is no write {write_id}.")

    def step(
        self,
        run_id: RunId,
        name: str,
        state: StepState,
        *,
        duration_s: float,
        code: str = "",
        text: str = "",
        measurements: Sequence[Measurement] = (),
    ) -> None:
        """Record one try of a step that has just ended. Tries are counted by step name.

        Raises RuleBrokenError for a PASS with a measurement out of its limits.
        """
        for each in measurements:
            numbers = (each.value, each.low, each.high)
            if not all(math.isfinite(number) for number in numbers if number is not None):
                raise RuleBrokenError(f"{each.name}: {_ONLY_FINITE}.", where=f"run {run_id}")
        ended_s = self._clock.monotonic_s()
        table = schema.step.c
        counted = select(
            func.coalesce(func.max(table.position), 0),
            func.count().filter(table.name == name),
            func.max(table.begun_monotonic_s),
        ).where(table.run_id == run_id)
        with self.database.writing() as connection:
            position, tries, before_s = connection.execute(counted).one()
            # Virtual units measure a duration in their own time.
            begun_s = max(ended_s - duration_s, -math.inf if before_s is None else before_s)
            step_id = insert(
                connection,
                schema.step,
                run_id=run_id,
                position=position + 1,
                name=name,
                try_number=tries + 1,
                state=state.value,
                code=code,
                text=text,
                begun_at=utc_text(self._clock.utc() - timedelta(seconds=ended_s - begun_s)),
                begun_monotonic_s=begun_s,
                duration_s=duration_s,
            )
            for each in measurements:
                insert(connection, schema.measurement, step_id=step_id, **asdict(each))

    # -- ending -----------------------------------------------------------------------------------

    def finish(self, run_id: RunId, ending: RunResult, *, gets_label: bool = False) -> None:
        """Save the end of a run in one transaction. Only after it returns may PASS be shown.
        `gets_label`: the station prints a label for a PASS.

        May be called again with the same ending after an error. Raises RuleBrokenError for an
        unproven PASS (verification below the recipe's, no trace, a failed step, an unverified
        write, a missing file), RecordError if nothing was saved.
        """
        if ending.outcome not in OUTCOMES:
            raise RuleBrokenError(
                f"{ending.outcome.value} is not an end of a run.", where=f"run {run_id}"
            )
        for file in ending.attachments:
            wrong = self.files.check(file.sha256)
            if wrong:
                raise RuleBrokenError(f"{file.name}: {wrong}", where=f"run {run_id}")
        now = self._clock.utc()
        run, target = schema.run.c, schema.run_target.c
        saved = select(run.state, run.code, run.text, run.log_sha256).where(run.id == run_id)
        with self.signer.writing() as trail:
            connection = trail.connection
            found = connection.execute(saved).one_or_none()
            if found is None:
                raise NotFoundError(f"There is no run {run_id}.")
            if found == (ending.outcome.value, ending.code, ending.text, ending.trace_sha256):
                return
            for name, level in ending.verified.items():
                changed = connection.execute(
                    update(schema.run_target)
                    .where(target.run_id == run_id, target.target == name)
                    .values(reached=int(level))
                )
                if changed.rowcount != 1:
                    raise NotFoundError(f"There is no target {name} of run {run_id}.")
            levels = select(target.reached).where(target.run_id == run_id)
            reached = list(connection.execute(levels).scalars())
            _end_run(
                trail,
                run_id,
                ending.attachments,
                now,
                state=ending.outcome.value,
                code=ending.code,
                text=ending.text,
                ended_monotonic_s=self._clock.monotonic_s(),
                # The weakest of all targets.
                verification_reached=None if not reached or None in reached else min(reached),
                log_sha256=ending.trace_sha256,
                gets_label=gets_label and ending.outcome is RunState.PASS,
            )

    def note(self, event: AuditEvent, data: Mapping[str, Any], run_id: RunId | None = None) -> None:
        """Append an action of a person to the audit trail, on disk. Raises RecordError."""
        with self.signer.writing() as trail:
            trail.append(self._clock.utc(), event.value, data, run_id)

    # -- maintenance ------------------------------------------------------------------------------

    def backup(self, path: Path) -> Backup:
        """Copy the SQLite database while the station runs, check the copy, and copy the attachments
        to `NAME.files` beside it. Raises RecordError.
        """
        return make_backup(self.database, self.files, path)

    def examine(
        self, *, incremental: bool = False, progress: Progress = lambda _done, _total: None
    ) -> Examination:
        """Examine all records; with `incremental`, only those after the last examination.

        Stores its result beside the keys of this user. Raises RecordError.
        """
        self.signer.wait_for_copies()
        note, remarks = self._examined()
        since = note if incremental else None
        examiner = Examiner(self.database, self.files, self.signer.key_locations, progress, since)
        found = examiner.examine(self._clock.utc())
        if examiner.examined is not None:
            try:
                save_examined(*self._examined_files, examiner.examined)
            except RecordError as error:
                remarks += (f"the next examination starts from the beginning: {error.what}",)
        return replace(found, remarks=(*remarks, *found.remarks))

    def figures_begin(self) -> datetime | None:
        """Start of the period that figures can cover; None if they cover all runs."""
        return None

    def examine_run(self, run_id: RunId) -> RunExamination:
        """Examine one run without reading all records. Raises RecordError."""
        note, _ = self._examined()
        key_locations = self.signer.key_locations
        return Examiner(self.database, self.files, key_locations, since=note).examine_run(run_id)

    @property
    def _examined_files(self) -> tuple[Path, Path]:
        return self.signer.key_locations.examined_files(self.signer.records_id)

    def _examined(self) -> tuple[Examined | None, tuple[str, ...]]:
        """State of the last examination, and remarks about it."""
        try:
            return load_examined(*self._examined_files), ()
        except FlasherError as error:
            return None, (f"{error.what} Everything is examined.",)

    def release_clock(self, operator: str, reason: str) -> None:
        """Record that the clock is right although later times are recorded."""
        self.become_station()
        with self.signer.writing() as trail:
            trail.append(self._clock.utc(), chain.CLOCK, {"by": operator, "reason": reason})

    def accept_restored(self, operator: str, reason: str) -> int:
        """Accept an older copy of the records; returns the number of missing audit rows."""
        self._lock.acquire()
        return self.signer.accept_restored(operator, reason)

    def rotate_key(self, operator: str) -> None:
        self.become_station()
        self.signer.rotate(operator)

    def replace_lost_key(self, operator: str, reason: str) -> None:
        """Replace a lost key with a new one. Raises UsageError if it is not lost."""
        self._lock.acquire()
        self.signer.replace_lost(operator, reason)


def _end_run(
    trail: Trail,
    run_id: int,
    attached: Iterable[AttachmentFile],
    now: datetime,
    *,
    gets_label: bool = False,
    **values: Any,
) -> None:
    """End a run, with its attachments and a signed audit row."""
    connection, run = trail.connection, schema.run
    for file in attached:
        insert(connection, schema.attachment, run_id=run_id, **asdict(file))
    begun_at = connection.execute(select(run.c.begun_at).where(run.c.id == run_id)).scalar_one()
    # A clock that was set back does not make a run end before it began.
    ended_at = max(utc_text(now), begun_at)
    connection.execute(update(run).where(run.c.id == run_id).values(ended_at=ended_at, **values))
    interrupted = values["state"] == RunState.INTERRUPTED.value
    event = chain.INTERRUPTED if interrupted else chain.FINISHED
    data = {"state": values["state"], "digests": digests_of(connection, [run_id])[run_id]}
    due = {chain.LABEL_DUE: True} if gets_label else {}
    trail.append(now, event, {**data, **due}, run_id)
