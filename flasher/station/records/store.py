"""The records of a station: few operations, each on disk when it returns, or an error.

    store = Store.open("records.sqlite", station="line-2", clock=SystemClock())
    store.recover()
    claim = store.claim(serial, "A", recipe, operator="jo")
    write = store.intent(claim.run_id, "bms", "flash", "V1r0r4_20220512")
    ... the act ...
    store.verified(write, "V1r0r4_20220512")
    store.step(claim.run_id, StepName.FLASH, StepState.PASS, ...)
    trace = store.add_file("trace", path)
    store.finish(claim.run_id, Ending(RunState.PASS, "OK", "", ...))   # only now show PASS

Whatever raises RecordError has saved nothing; a run that could not be finished stays RUNNING, and
`finish` may be tried again with the same ending. Threads may share a store that is in a file: every
operation has a connection of its own, and writers wait for each other.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from sqlalchemy import select, update

from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records import chain, queries, schema
from flasher.station.records.backup import make_backup
from flasher.station.records.claims import begin_run, make_order
from flasher.station.records.database import (
    DEFAULT_LOCK_TIMEOUT_S,
    Database,
    locate,
    open_database,
)
from flasher.station.records.errors import RuleBrokenError
from flasher.station.records.examination import Examiner
from flasher.station.records.files import FileStore
from flasher.station.records.model import (
    OUTCOMES,
    AttachmentFile,
    AuditEvent,
    Backup,
    Claim,
    Clock,
    Ending,
    Examination,
    Measurement,
    Problem,
    RunId,
    RunState,
    StepState,
    WriteId,
    utc_text,
)
from flasher.station.records.rows import (
    add_attachments,
    add_ending,
    add_step,
    end_run,
    insert,
    is_saved,
    one_row,
    weakest,
)
from flasher.station.records.signing import Keeping, Signer

_USUAL: Final = Keeping()
_ONLY_FINITE = "a number that is no number cannot be recorded"


class SystemClock:
    """The computer's own clocks."""

    def utc(self) -> datetime:
        """Now, in UTC."""
        return datetime.now(UTC)

    def monotonic_s(self) -> float:
        """Seconds since some start."""
        return time.monotonic()


class Store:
    """The records. Open with `Store.open`; a context manager."""

    def __init__(
        self, database: Database, station: str, clock: Clock, keeping: Keeping = _USUAL
    ) -> None:
        self.database = database
        self.station = station
        self.files = FileStore(database.location.folder)
        self.signer = Signer(database, station, clock.utc, keeping)
        self.read = queries.Records(database)
        self._clock = clock
        self._lock = database.station_lock(station)

    @classmethod
    def open(
        cls,
        url: str,
        *,
        station: str,
        clock: Clock | None = None,
        folder: Path | None = None,
        lock_timeout_s: float = DEFAULT_LOCK_TIMEOUT_S,
        create: bool = True,
        read_only: bool = False,
        keeping: Keeping = _USUAL,
    ) -> Self:
        """The records at an SQLAlchemy URL, or in an SQLite file; made when they are not there and
        `create` is true. `folder` holds the attachments (beside an SQLite file by default).
        `read_only` changes nothing, not even the journal.

        Raises UsageError for a place that cannot be, SchemaVersionError, or another RecordError.
        """
        clock = clock or SystemClock()
        location = locate(url, folder)
        database = open_database(
            location,
            clock.utc(),
            lock_timeout_s=lock_timeout_s,
            create=create and not read_only,
            read_only=read_only,
        )
        return cls(database, station, clock, keeping)

    def close(self) -> None:
        """Close the database and let another process be the station."""
        self._lock.release()
        self.database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    # -- beginning --------------------------------------------------------------------------------

    def become_station(self) -> None:
        """Let this process, and no other, write the station's chain.

        Raises StationBusyError; KeyMissingError, RecordsCutError; another RecordError.
        """
        self._lock.acquire()
        self.signer.begin()

    def recover(self) -> tuple[RunId, ...]:
        """Become the station (one process at a time), and end what a dead one left running: these
        runs become INTERRUPTED, with the traces that they left; their units RECHECK. Call it once
        at start.

        Raises StationBusyError; KeyMissingError, RecordsCutError; another RecordError.
        """
        self.become_station()
        self.files.sweep(self._clock.utc())
        return self.end_unknown(())

    def end_unknown(self, known: Collection[RunId]) -> tuple[RunId, ...]:
        """End runs of this station that go on in the records and are none of the `known` ones: a
        dead station left them, or their claim was saved although it seemed lost. They become
        INTERRUPTED. Raises RecordError.
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
                add_attachments(trail.connection, run_id, self.files.add_spooled(run_id))
                end_run(
                    trail,
                    run_id,
                    now,
                    state=RunState.INTERRUPTED.value,
                    code="STATION_DIED",
                    text="The station ended before this run did. The unit has to be checked.",
                )
        for run_id in found:
            self.files.forget_spooled(run_id)
        return found

    def claim(
        self,
        serial: str,
        socket: str,
        recipe: LoadedRecipe,
        operator: str,
        *,
        lot: str = "",
        reason: str = "",
        is_virtual: bool = False,
    ) -> Claim:
        """Begin a run of a unit, when every rule allows it; nothing is recorded when not.

        Raises ClaimRefusedError, RecordError (before `recover` too).
        """
        now = self._clock.utc()
        order = make_order(
            serial, socket, recipe, operator, lot, reason, now, is_virtual=is_virtual
        )
        # One claim at a time, of all stations: two must not find the last place of a lot free.
        with self.signer.writing("claims") as trail:
            return begin_run(trail, order, now, self._clock.monotonic_s())

    # -- while it runs ----------------------------------------------------------------------------

    def intent(self, run_id: RunId, target: str, what: str, value: str) -> WriteId:
        """Note, on disk, an act that cannot be taken back, before it is done."""
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
        """Note, on disk, that the act is done. `read_back` is what the device says now; None where
        it only confirmed ("completed, not read back").
        """
        table = schema.device_write
        with self.database.writing() as connection:
            done = connection.execute(
                update(table)
                .where(table.c.id == write_id)
                .values(verified_at=utc_text(self._clock.utc()), read_back=read_back)
            )
            one_row(done.rowcount, f"write {write_id}")

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
        """Record one try of a step that has just ended. Tries are counted by name.

        Raises RuleBrokenError for a PASS with a measurement out of its limits.
        """
        for each in measurements:
            numbers = (each.value, each.low, each.high)
            if not all(math.isfinite(number) for number in numbers if number is not None):
                raise RuleBrokenError(f"{each.name}: {_ONLY_FINITE}.", where=f"run {run_id}")
        ended_s = self._clock.monotonic_s()
        with self.database.writing() as connection:
            add_step(
                connection,
                run_id,
                str(name),
                measurements,
                state=state.value,
                code=code,
                text=text,
                begun_at=utc_text(self._clock.utc() - timedelta(seconds=duration_s)),
                begun_monotonic_s=ended_s - duration_s,
                duration_s=duration_s,
            )

    def add_file(self, kind: str, path: Path) -> AttachmentFile:
        """Store a file by its hash, for an `Ending` to name; on disk when it returns."""
        return self.files.add(kind, path)

    # -- ending -----------------------------------------------------------------------------------

    def finish(self, run_id: RunId, ending: Ending) -> None:
        """Save how a run ended, in one transaction. Only after it returned may PASS be shown.

        May be called again with the same ending after an error. Raises RuleBrokenError for a PASS
        that is not one (not verified as the recipe asks, no log, a step or a write open, a file
        that is not stored), RecordError when it was not saved.
        """
        if ending.state not in OUTCOMES:
            raise RuleBrokenError(f"{ending.state.value} is no outcome.", where=f"run {run_id}")
        for file in ending.attachments:
            wrong = self.files.check(file.sha256)
            if wrong:
                raise RuleBrokenError(f"{file.name}: {wrong}", where=f"run {run_id}")
        now = self._clock.utc()
        with self.signer.writing() as trail:
            if is_saved(trail.connection, run_id, ending):
                return
            add_ending(trail.connection, run_id, ending)
            end_run(
                trail,
                run_id,
                now,
                state=ending.state.value,
                code=ending.code,
                text=ending.text,
                ended_monotonic_s=self._clock.monotonic_s(),
                verification_reached=weakest(trail.connection, run_id),
                log_sha256=ending.log_sha256,
            )

    def note(self, event: AuditEvent, data: Mapping[str, Any], run_id: RunId | None = None) -> None:
        """Add what a person did to the audit trail; on disk when it returns. `data` holds what
        JSON can hold. Raises RecordError.
        """
        with self.signer.writing() as trail:
            trail.append(self._clock.utc(), event.value, data, run_id)

    def correct(self, run_id: RunId, operator: str, text: str) -> None:
        """Add a remark to a finished run, which itself never changes."""
        with self.signer.writing() as trail:
            queries.state_of(trail.connection, run_id)
            data = {"by": operator, "text": text}
            trail.append(self._clock.utc(), "correction", data, run_id)

    # -- care -------------------------------------------------------------------------------------

    def backup(self, path: Path) -> Backup:
        """A consistent copy of the database while the station runs, checked, whole or not there;
        the attachments are copied beside it as `NAME.files`. SQLite only. Raises RecordError.
        """
        return make_backup(self.database, self.files, path)

    def verify(self) -> tuple[Problem, ...]:
        """Everything that is not as it has to be: database, audit trail, runs, attachments."""
        return self.examine().problems

    def examine(self, runs: Collection[RunId] | None = None) -> Examination:
        """What holds of the records and what does not, with the reasons; of these runs, or of all.

        Raises RecordError when they cannot be read.
        """
        return Examiner(self.database, self.files, self.signer.place).examine(runs)

    def release_clock(self, operator: str, reason: str) -> None:
        """Note that the clock is right, though records of a later time are there."""
        self.become_station()
        with self.signer.writing() as trail:
            trail.append(self._clock.utc(), chain.CLOCK, {"by": operator, "reason": reason})

    def accept_restored(self, operator: str, reason: str) -> int:
        """Go on with an older copy of the records; how many audit rows it lacks."""
        self._lock.acquire()
        return self.signer.accept_restored(operator, reason)

    def rotate_key(self, operator: str) -> None:
        """Sign with a new key from now on."""
        self.become_station()
        self.signer.rotate(operator)

    def replace_lost_key(self, operator: str, reason: str) -> None:
        """Go on with a new key, since the one before is gone. Raises UsageError when it is not."""
        self._lock.acquire()
        self.signer.replace_lost(operator, reason)
