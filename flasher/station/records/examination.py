"""The examination of records: schema, audit trails, runs, attachments and traces."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from pydantic import ValidationError
from sqlalchemy import Connection, func, select

from flasher.errors import FlasherError, UsageError
from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.chain import NAMED, OWN, digests_of
from flasher.station.records.database import Database
from flasher.station.records.errors import RecordError
from flasher.station.records.files import FileStore
from flasher.station.records.heads import Fault, Head
from flasher.station.records.keys import Keeping
from flasher.station.records.model import (
    TRACE,
    AttachmentFile,
    Examination,
    KeptHeads,
    Problem,
    RunDetails,
    RunId,
    RunState,
)
from flasher.station.records.places import PATIENCE_S, Place, patiently
from flasher.station.records.proof import contradictions, traces_of_targets
from flasher.station.records.queries import details_of
from flasher.station.records.rows import batches, grouped
from flasher.station.records.signatures import is_signed
from flasher.station.records.triggers import fingerprint_of, stated_differences
from flasher.trace.reader import read_trace

_RUNS_NAMED: Final = 5
_HASH_BYTES: Final = 32
_USED: Final = {
    schema.unit: schema.run.c.unit_id,
    schema.lot: schema.run.c.lot_id,
    schema.operator: schema.run.c.operator_id,
    schema.recipe: schema.run.c.recipe_id,
    schema.socket: schema.run.c.socket_id,
    schema.artifact: schema.run_target.c.artifact_id,
}
"""Rows that are made for a run only, and where it names them."""
Progress = Callable[[int, int], None]
"""Is called with how much is done, and how much there is to do."""


@dataclass
class _Trail:
    """What was found along the chain of one station."""

    station: str
    hashes: bytearray = field(default_factory=bytearray)
    """Of the rows from the first on; as bytes, since a plant has millions."""
    restored: dict[int, range] = field(default_factory=dict)
    """Rows that give up others, and which."""
    keys: set[str] = field(default_factory=set)

    @property
    def end(self) -> int:
        """The number of the last row."""
        return len(self.hashes) // _HASH_BYTES

    def add(self, row_hash: str) -> None:
        try:
            found = bytes.fromhex(row_hash)
        except ValueError:
            found = b""
        self.hashes += found if len(found) == _HASH_BYTES else bytes(_HASH_BYTES)

    def hash_of(self, number: int) -> str | None:
        """The hash of a row; None where there is no such row."""
        if not 1 <= number <= self.end:
            return None
        return self.hashes[(number - 1) * _HASH_BYTES : number * _HASH_BYTES].hex()


@dataclass(frozen=True)
class _Kept:
    """A place of heads, as it was before the records were read."""

    place: Place
    is_elsewhere: bool
    lasts: Mapping[str, Head]
    """The last head of each station."""


class Examiner:
    """One examination of the records."""

    def __init__(
        self,
        database: Database,
        files: FileStore,
        keeping: Keeping,
        progress: Progress = lambda _done, _total: None,
    ) -> None:
        self._database = database
        self._files = files
        self._keeping = keeping
        self._progress = progress
        self._done = self._total = 0
        self._remarks: list[str] = []
        self._kept: list[KeptHeads] = []
        self._unkept: list[str] = []
        self._unreached: list[str] = []
        self._stated: list[tuple[object, Mapping[str, str]]] = []
        """The last statement of each chain about the schema, with its version."""
        self._traces = 0
        self._nameless = 0

    def examine(self, runs: Collection[RunId] | None = None) -> Examination:
        """Examine everything; of the runs these, or all."""
        with self._database.reading() as connection:
            records_id = connection.execute(select(schema.schema_info.c.records_id)).scalar_one()
            names = list(connection.execute(select(schema.station.c.name)).scalars())
        # Before the records are read: a station may add rows, and their heads, meanwhile.
        kept = list(self._reach(records_id, names))
        with self._database.reading() as connection:
            problems = tuple(self._problems(connection, records_id, kept, runs))
        if self._nameless:
            self._remarks.append(
                f"{self._nameless} PASS of devices that name no serial number: their traces do not"
                " tell which unit it was"
            )
        return Examination(
            problems,
            tuple(self._remarks),
            tuple(self._kept),
            tuple(self._unkept),
            self._traces,
            tuple(self._unreached),
        )

    def _problems(
        self,
        connection: Connection,
        records_id: str,
        kept: list[_Kept],
        runs: Collection[RunId] | None,
    ) -> Iterator[Problem]:
        if self._database.backend == "sqlite":
            yield from _sqlite_problems(connection)
        run, audit = schema.run.c, schema.audit.c
        there = list(connection.execute(select(run.id).order_by(run.id)).scalars())
        chosen = there if runs is None else sorted(set(there) & set(runs))
        rows = connection.execute(select(func.count()).select_from(schema.audit)).scalar_one()
        self._total = rows + len(chosen)
        yield from self._trails(connection, records_id, kept)
        gone = select(audit.run_id).outerjoin(schema.run, run.id == audit.run_id).distinct()
        gone = gone.where(audit.run_id.is_not(None), run.id.is_(None)).order_by(audit.run_id)
        for run_id in connection.execute(gone).scalars():
            yield Problem(f"run {run_id}", "it is missing: the audit trail knows it", (run_id,))
        changed: dict[tuple[str, str], list[int]] = defaultdict(list)
        for some in batches(chosen):
            stated = _stated(connection, some)
            for run_id, digests in digests_of(connection, some).items():
                yield from self._digests(run_id, digests, stated[run_id], changed)
            yield from self._runs(connection, some, stated)
        for (part, _), run_ids in changed.items():
            shown = ", ".join(map(str, run_ids[:_RUNS_NAMED]))
            more = f" and {len(run_ids) - _RUNS_NAMED} more" if len(run_ids) > _RUNS_NAMED else ""
            what = f"changed after it was recorded: {NAMED[part]}"
            yield Problem(f"{part} of run {shown}{more}", what, tuple(run_ids))
        yield from _unused(connection)
        of_pass = select(run.log_sha256).where(run.state == RunState.PASS.value)
        twice = of_pass.group_by(run.log_sha256).having(func.count() > 1)
        for sha256 in connection.execute(twice).scalars().all():
            with_it = select(run.id).where(run.log_sha256 == sha256).order_by(run.id)
            same = tuple(connection.execute(with_it).scalars())
            shown = ", ".join(map(str, same[:_RUNS_NAMED]))
            yield Problem(f"runs {shown}", "they have one and the same trace", same)

    def _did(self, count: int) -> None:
        self._done += count
        self._progress(self._done, self._total)

    # -- kept heads -------------------------------------------------------------------------------

    def _reach(
        self, records_id: str, names: list[str], limit_s: float = PATIENCE_S
    ) -> Iterator[_Kept]:
        """The places of heads that can be reached. Raises RecordError, UsageError for the one
        beside the key.
        """

        def lasts(place: Place) -> dict[str, Head]:
            every = dict.fromkeys([*names, *place.stations(records_id)])
            found = {name: place.of(name, records_id).last() for name in every}
            return {name: head for name, head in found.items() if head is not None}

        beside = self._keeping.beside_key
        if beside.folder.is_dir():
            yield _Kept(beside, is_elsewhere=False, lasts=lasts(beside))
        places = self._keeping.elsewhere
        asked = [lambda place=place: lasts(place) for place in places]
        for place, found in zip(places, patiently(asked, limit_s), strict=True):
            if isinstance(found, FlasherError):
                self._unreached.append(f"{place.shown}: {found.cause or found.what}")
            else:
                yield _Kept(place, is_elsewhere=True, lasts=found)

    def _compare(self, trail: _Trail, each: _Kept, records_id: str) -> Iterator[Problem]:
        """Compare a chain with the heads that a place keeps of it."""
        shown, place = printable(trail.station), each.place.shown
        last = each.lasts.get(trail.station)
        if last is None:
            if each.is_elsewhere and trail.end:
                yield Problem(f"heads of {shown}", f"none of these records is kept in {place}")
            return
        first = end = 0
        is_younger = False
        """True after the last head that was there before the records were read."""
        wrong: list[tuple[int, Head]] = []
        given_up_at: dict[int, int] = {}
        for index, entry in enumerate(each.place.of(trail.station, records_id).entries()):
            if isinstance(entry, Fault):
                yield Problem(f"heads of {shown}, {entry.where}", entry.what)
            elif isinstance(entry, Head):
                if trail.hash_of(entry.number) == entry.hash:
                    first, end = first or entry.number, max(end, entry.number)
                    if entry.number in trail.restored:
                        given_up_at[entry.number] = index
                elif not is_younger:
                    wrong.append((index, entry))
                is_younger = is_younger or entry == last
            elif entry.key not in trail.keys:
                where = f"heads of {shown}, segment {entry.segment} in {place}"
                yield Problem(where, "it is not signed with a key of the station")
        held = [
            head
            for index, head in wrong
            if not any(
                head.number in lost and index < given_up_at.get(number, index + 1)
                for number, lost in trail.restored.items()
            )
        ]
        yield from _differences(trail, place, held)
        if first or held:
            numbers = [each.number for each in held]
            self._kept.append(
                KeptHeads(
                    trail.station,
                    place,
                    min([*numbers, *([first] if first else [])]),
                    max([end, *numbers]),
                    trail.end,
                    each.is_elsewhere,
                )
            )

    # -- audit trails -----------------------------------------------------------------------------

    def _trails(
        self, connection: Connection, records_id: str, kept: list[_Kept]
    ) -> Iterator[Problem]:
        """Go through all audit trails, and compare them with the heads that are kept of them."""
        found = fingerprint_of(connection)
        names = list(connection.execute(select(schema.station.c.name)).scalars())
        others = [name for each in kept for name in each.lasts]
        for name in dict.fromkeys([*names, *others]):
            query = (
                select(schema.audit)
                .join_from(schema.audit, schema.station)
                .where(schema.station.c.name == name)
                .order_by(schema.audit.c.number)
                .execution_options(yield_per=1000)
            )
            trail = _Trail(name)
            with connection.execute(query) as rows:
                yield from self._chain(trail, rows.mappings(), records_id)
            for each in kept:
                yield from self._compare(trail, each, records_id)
            if trail.end and not any(
                kept.is_elsewhere and kept.station == name for kept in self._kept
            ):
                self._unkept.append(name)
        for thing, what in stated_differences(self._stated, found):
            yield Problem(f"schema, {printable(thing)}", what)

    def _chain(
        self,
        trail: _Trail,
        rows: Iterable[Mapping[Any, Any]],
        records_id: str,
    ) -> Iterator[Problem]:
        """Go along one chain; fills what was found of it."""
        before, key = chain.GENESIS, None
        stated: tuple[object, Mapping[str, str]] = (None, {})
        shown = printable(trail.station)
        for expected, row in enumerate(rows, 1):
            where = f"audit row {expected} of {shown}"
            data = chain.data_of(row["data"])
            if row["previous_hash"] != before or row["number"] != expected:
                yield Problem(where, "the chain is broken: the row before it is missing or changed")
            is_whole = row["hash"] == chain.row_hash(row)
            if not is_whole:
                yield Problem(where, "it was changed after it was written")
            following = chain.key_of(row["event"], data)
            if following is not None and row["event"] != chain.KEY_ROTATED:
                key = following  # which signs itself
            if key is None or not is_signed(row["hash"], row["signature"], key):
                yield Problem(where, "it is not signed with the key of the station")
            if following is not None:
                key = following
                trail.keys.add(key)
            before = row["hash"]
            trail.add(before)
            self._did(1)
            if not is_whole:
                continue  # what it says counts for nothing
            if _table(data.get("schema")):
                stated = data.get("version"), _table(data.get("schema"))
            if row["event"] == chain.RESTORED:
                trail.restored[expected] = chain.lost_of(data)
            self._take_row(shown, row, data)
            for what in _contradictions(trail.station, records_id, row["event"], data):
                yield Problem(where, what)
        if trail.end:
            self._stated.append(stated)

    def _take_row(self, shown: str, row: Mapping[Any, Any], data: Mapping[str, Any]) -> None:
        """Note what a person should know of an intact row."""
        said = f"{row['at'][:10]} by {printable(str(data.get('by')))}"
        match row["event"]:
            case chain.KEY_LOST:
                self._remarks.append(f"{shown}: the key was declared lost on {said}")
            case chain.RESTORED:
                lost = chain.lost_of(data)
                self._remarks.append(
                    f"{shown}: rows {lost.start} to {lost.stop - 1} of an earlier chain were given"
                    f" up as lost on {said}"
                )
            case chain.CLOCK:
                self._remarks.append(f"{shown}: the clock was released on {said}")

    # -- runs -------------------------------------------------------------------------------------

    def _digests(
        self,
        run_id: int,
        digests: Mapping[str, str],
        stated: _Stated,
        changed: dict[tuple[str, str], list[int]],
    ) -> Iterator[Problem]:
        """Compare a run with what the trails vouch for; `changed` collects what several share."""
        where = f"run {run_id}"
        if not stated.is_known:
            yield Problem(where, "the audit trail does not know it", (run_id,))
        wrong = {
            part: digests.get(part, "")
            for each in (stated.claim, stated.ending)
            for part in each
            if each[part] != digests.get(part)
        }
        for part in wrong.keys() & NAMED.keys():
            changed[part, wrong[part]].append(run_id)
        own = [words for part, words in OWN.items() if part in wrong]
        if own:
            what = f"changed after it was recorded: {', '.join(own)}"
            yield Problem(where, what, (run_id,))

    def _runs(
        self, connection: Connection, run_ids: list[int], stated: Mapping[int, _Stated]
    ) -> Iterator[Problem]:
        """Check that the runs can be read, and their attachments."""
        try:
            found = tuple(details_of(connection, schema.run.c.id.in_(run_ids)))
        except ValidationError as error:
            if len(run_ids) > 1:
                for run_id in run_ids:
                    yield from self._runs(connection, [run_id], stated)
            else:
                (first, *_) = error.errors()
                said = printable(f"{first['input']!r:.80} as {first['loc'][-1]}")
                yield Problem(f"run {run_ids[0]}", f"it cannot be read: {said}", tuple(run_ids))
            return
        for details in found:
            run_id = details.run.run_id
            is_over = details.run.state is not RunState.RUNNING
            self._did(1)
            if stated[run_id].is_known and is_over != bool(stated[run_id].ending):
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
        """Check a PASS against its own trace."""
        run = details.run
        where = f"run {run.run_id}, PASS of {printable(run.serial)}"
        if not traces:
            yield Problem(where, "there is no trace to hold it against", (run.run_id,))
            return
        try:
            with self._files.named(traces[0]) as path:
                heard = traces_of_targets(
                    (target.target for target in details.targets), read_trace(path)
                )
        except (UsageError, RecordError) as error:
            what = f"its trace cannot be read: {error.cause or error.what}"
            yield Problem(where, what, (run.run_id,))
            return
        self._traces += 1
        self._nameless += not any(each.serial for each in heard.values())
        for what in contradictions(details, heard):
            yield Problem(where, f"its trace says otherwise: {what}", (run.run_id,))


@dataclass
class _Stated:
    """The digests that the audit trails state for a run."""

    claim: Mapping[str, str] = field(default_factory=dict)
    """At its claim."""
    ending: Mapping[str, str] = field(default_factory=dict)
    """And at its end."""

    @property
    def is_known(self) -> bool:
        return bool(self.claim or self.ending)


def _stated(connection: Connection, run_ids: list[int]) -> dict[int, _Stated]:
    """What intact audit rows state for these runs."""
    found: dict[int, _Stated] = defaultdict(_Stated)
    query = select(schema.audit).order_by(schema.audit.c.id)
    for run_id, rows in grouped(connection, query, schema.audit.c.run_id, run_ids).items():
        for row in rows:
            digests = _table(chain.data_of(row["data"]).get("digests"))
            if not digests or row["hash"] != chain.row_hash(row):
                continue
            if row["event"] == chain.CLAIMED:
                found[run_id].claim = digests
            elif row["event"] in chain.ENDINGS:
                found[run_id].ending = digests
    return found


def _differences(trail: _Trail, place: str, held: list[Head]) -> Iterator[Problem]:
    """What heads tell that are not those of the chain."""
    where = f"audit trail of {printable(trail.station)}"
    missing = [head for head in held if head.number > trail.end]
    other = [head for head in held if head.number <= trail.end]
    if missing:
        last = max(missing, key=lambda head: head.number)
        yield Problem(
            where,
            f"it ends at row {trail.end}, but row {last.number} of {last.at} is"
            f" kept in {place}: its end was cut off, or this is an older copy",
        )
    if other:
        first = min(other, key=lambda head: head.number)
        yield Problem(
            where,
            f"row {first.number} of {first.at} is not the one that is kept in {place}: the"
            " chain was made anew",
        )


def _unused(connection: Connection) -> Iterator[Problem]:
    """Rows that no station adds without a run."""
    for table, naming in _USED.items():
        query = select(table).where(table.c.id.not_in(select(naming).where(naming.is_not(None))))
        for row in connection.execute(query.order_by(table.c.id).limit(_RUNS_NAMED)).mappings():
            name = row.get("serial") or row.get("name")
            yield Problem(f"{table.name} {printable(str(name))}", "it was added: no run names it")


def _contradictions(
    name: str, records_id: str, event: str, data: Mapping[str, Any]
) -> Iterator[str]:
    """Where an intact row does not fit these records."""
    if event == chain.BEGUN and data.get("records") != records_id:
        yield "the chain is that of other records"
    if event == chain.BEGUN and data.get("station") != name:
        yield f"the chain is that of the station {printable(str(data.get('station')))}"
    if event == chain.MIGRATED:
        found = data.get("problems")
        for what in found if isinstance(found, list) else ():
            yield f"found at the migration: {printable(str(what))}"


def _table(value: Any) -> Mapping[str, str]:
    return value if isinstance(value, dict) else {}


def _sqlite_problems(connection: Connection) -> Iterator[Problem]:
    for (found,) in connection.exec_driver_sql("PRAGMA integrity_check").all():
        if found != "ok":
            yield Problem("database", printable(str(found)))
    for row in connection.exec_driver_sql("PRAGMA foreign_key_check").all():
        yield Problem(f"table {row[0]}, row {row[1]}", f"it names a missing row of {row[2]}")
