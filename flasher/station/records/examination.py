"""`verify`: examines schema, audit trails, runs, attachments and traces of the records."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final

from pydantic import ValidationError
from sqlalchemy import Connection, func, or_, select

from flasher.errors import FlasherError, UsageError
from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.chain import NAMED, OWN, contents_of
from flasher.station.records.database import Database, records_id_of
from flasher.station.records.errors import RecordError
from flasher.station.records.examined import Examined, ExaminedChain
from flasher.station.records.files import FileStore
from flasher.station.records.heads import ChainHead, Checkpoint, HeadsFault
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import (
    TRACE,
    AttachmentFile,
    Examination,
    KeptHeads,
    Problem,
    RunDetails,
    RunExamination,
    RunId,
    RunState,
    utc_text,
)
from flasher.station.records.places import PATIENCE_S, Place, call_all
from flasher.station.records.proof import contradictions, traces_of_targets
from flasher.station.records.queries import details_of_content, is_whole
from flasher.station.records.rows import KEYS, batches, grouped
from flasher.station.records.triggers import fingerprint_of, stated_differences
from flasher.trace.reader import read_trace

_RUNS_NAMED: Final = 5
_HASH_BYTES: Final = 32
_CACHE_KB: Final = 256 * 1024
_BRIEFLY_S: Final = 0.5
"""Time limit for places of heads when a page examines one run."""
_USED: Final = {
    schema.unit: schema.run.c.unit_id,
    schema.lot: schema.run.c.lot_id,
    schema.operator: schema.run.c.operator_id,
    schema.recipe: schema.run.c.recipe_id,
    schema.socket: schema.run.c.socket_id,
    schema.artifact: schema.run_target.c.artifact_id,
}
"""Tables whose rows only runs add, and the columns that refer to them."""
Progress = Callable[[int, int], None]
"""Callback with the amount done and the total."""


@dataclass
class ExaminedTrail(ExaminedChain):
    """One station's chain while it is examined. `rows` and `hash` are those that an earlier
    examination covered; the rest is that of all rows so far.
    """

    station: str = field(kw_only=True)
    hashes: bytearray = field(default_factory=bytearray)
    """Hashes of later rows, packed as bytes: a plant has millions."""

    @property
    def end(self) -> int:
        """Number of the last row."""
        return self.rows + len(self.hashes) // _HASH_BYTES

    def add(self, row_hash: str) -> None:
        try:
            found = bytes.fromhex(row_hash)
        except ValueError:
            found = b""
        self.hashes += found if len(found) == _HASH_BYTES else bytes(_HASH_BYTES)

    def hash_of(self, number: int) -> str | None:
        """Hash of a row; None if this examination did not read it."""
        at = number - self.rows
        if not 1 <= at <= self.end - self.rows:
            return None
        return self.hashes[(at - 1) * _HASH_BYTES : at * _HASH_BYTES].hex()


@dataclass(frozen=True)
class _PlaceHeads:
    """Chain heads of a place, read before the records."""

    place: Place
    is_elsewhere: bool
    lasts: Mapping[str, ChainHead]
    """Last head of each station."""


class Examiner:
    """Examines the records once."""

    def __init__(
        self,
        database: Database,
        files: FileStore,
        key_locations: KeyLocations,
        progress: Progress = lambda _done, _total: None,
        since: Examined | None = None,
    ) -> None:
        """`since`: an earlier examination to continue, unless its records have changed."""
        self._database = database
        self._files = files
        self._keeping = key_locations
        self._progress = progress
        self._done = self._total = 0
        self._remarks: list[str] = []
        self._kept: list[KeptHeads] = []
        self._unkept: list[str] = []
        self._unreached: list[str] = []
        self._since = since
        self._trails_found: list[ExaminedTrail] = []
        self.examined: Examined | None = None
        """State for the next examination; None until this one is done, or if it found a problem."""
        self._traces = 0
        self._nameless = 0

    def examine(self, now: datetime) -> Examination:
        """Examine all records, or those after `since`. Raises RecordError."""
        with self._database.reading() as connection:
            records_id = records_id_of(connection)
            names = list(connection.execute(select(schema.station.c.name)).scalars())
        # Heads are read before the records, to which a station may add rows meanwhile.
        kept = list(self._reach(records_id, names))
        with self._database.reading() as connection:
            if self._since is not None and not _is_as_examined(connection, self._since):
                self._remarks.append(
                    f"records that were examined on {self._since.at[:10]} have changed: everything"
                    " is examined again"
                )
                self._since = None
            problems = tuple(self._problems(connection, records_id, kept))
            if not problems:
                self.examined = self._examined_part(connection, records_id, now)
        self._remark_nameless()
        return Examination(
            problems,
            tuple(self._remarks),
            tuple(self._kept),
            tuple(self._unkept),
            self._traces,
            tuple(self._unreached),
            None if self._since is None else self._since.at,
        )

    def _remark_nameless(self) -> None:
        if self._nameless:
            self._remarks.append(
                f"{self._nameless} PASS of devices that report no serial number: their traces do"
                " not identify the unit"
            )

    def _problems(
        self,
        connection: Connection,
        records_id: str,
        kept: list[_PlaceHeads],
    ) -> Iterator[Problem]:
        since = self._since
        run, audit = schema.run.c, schema.audit.c
        some_runs = select(run.id).order_by(run.id)
        if since is not None:
            some_runs = some_runs.where(or_(run.id > since.run, run.id.in_(since.unfinished)))
        chosen = list(connection.execute(some_runs).scalars())
        rows = connection.execute(select(func.count()).select_from(schema.audit)).scalar_one()
        before = 0 if since is None else sum(each.rows for each in since.chains.values())
        self._total = rows - before + len(chosen)
        self._add_progress(
            0
        )  # shows the bar: what comes first takes minutes where there are many runs
        if since is None:
            yield from _sqlite_problems(connection)
        yield from self._trails(connection, records_id, kept)
        gone = select(audit.run_id).outerjoin(schema.run, run.id == audit.run_id).distinct()
        gone = gone.where(audit.run_id.is_not(None), run.id.is_(None)).order_by(audit.run_id)
        if since is not None:
            gone = gone.where(audit.run_id > since.run)
        for run_id in connection.execute(gone).scalars():
            yield Problem(
                text("run {run_id}", run_id=run_id),
                "it is missing, but the audit trail has it",
                (run_id,),
            )
        changed: dict[tuple[str, str], list[int]] = defaultdict(list)
        for some in batches(chosen):
            stated, contents = _run_digests(connection, some), contents_of(connection, some)
            yield from self._contents(contents, stated, changed)
        yield from _shared(changed)
        yield from _unused(connection)
        yield from same_traces(connection)

    def _examined_part(self, connection: Connection, records_id: str, now: datetime) -> Examined:
        run = schema.run.c
        last, count = connection.execute(select(func.max(run.id), func.count(run.id))).one()
        running = select(run.id).where(run.state == RunState.RUNNING.value)
        chains = {}
        for each in filter(lambda trail: trail.end, self._trails_found):
            known = {name: getattr(each, name) for name in ExaminedChain.__dataclass_fields__}
            last_hash = chain.hash_at(connection, each.station, each.end) or ""
            known |= {"rows": each.end, "hash": last_hash, "key": each.keys[-1]}
            chains[each.station] = ExaminedChain(**known)
        return Examined(
            utc_text(now),
            records_id,
            chains,
            last or 0,
            count,
            tuple(connection.execute(running).scalars()),
            tuple(self._remarks),
        )

    def _add_progress(self, count: int) -> None:
        self._done += count
        self._progress(self._done, self._total)

    # -- kept heads -------------------------------------------------------------------------------

    def _reach(
        self,
        records_id: str,
        names: list[str],
        limit_s: float = PATIENCE_S,
        *,
        is_all: bool = True,
    ) -> Iterator[_PlaceHeads]:
        """Read the last heads of all places that can be reached; with `is_all`, those of unknown
        stations too. Raises RecordError, UsageError for the place beside the key.
        """

        def lasts(place: Place) -> dict[str, ChainHead]:
            others = place.stations(records_id) if is_all else ()
            every = dict.fromkeys([*names, *others])
            found = {name: place.of(name, records_id).last() for name in every}
            return {name: head for name, head in found.items() if head is not None}

        beside = self._keeping.beside_key
        if beside.folder.is_dir():
            yield _PlaceHeads(beside, is_elsewhere=False, lasts=lasts(beside))
        places = self._keeping.elsewhere
        asked = [lambda place=place: lasts(place) for place in places]
        for place, found in zip(places, call_all(asked, limit_s), strict=True):
            if isinstance(found, FlasherError):
                self._unreached.append(f"{place.shown}: {found.cause or found.what}")
            else:
                yield _PlaceHeads(place, is_elsewhere=True, lasts=found)

    def _compare(
        self, connection: Connection, trail: ExaminedTrail, each: _PlaceHeads, records_id: str
    ) -> Iterator[Problem]:
        """Compare a chain with the heads that a place stores of it."""
        shown, place = printable(trail.station), each.place.shown
        last = each.lasts.get(trail.station)
        if last is None:
            if each.is_elsewhere and trail.end:
                yield Problem(f"heads of {shown}", f"no head of these records is stored in {place}")
            return
        first, end = trail.first.get(place, 0), 0
        wrong: list[tuple[int, ChainHead]] = []
        heads = each.place.of(trail.station, records_id)
        # The hash of the last examined row covers all rows before it.
        begin = last if first else next(e for e in heads.entries() if isinstance(e, ChainHead))
        for head in (begin, last):
            if head.number <= trail.rows:
                if chain.hash_at(connection, trail.station, head.number) == head.hash:
                    first, end = first or head.number, max(end, head.number)
                else:
                    wrong.append((0, head))
        accepted_at: dict[int, int] = {}
        is_younger = False
        """True after the last head that existed before the records were read."""
        for index, entry in enumerate(heads.entries(after=trail.rows)):
            if not isinstance(entry, ChainHead):
                yield from _segment_faults(trail, place, entry)
            elif trail.hash_of(entry.number) == entry.hash:
                first, end = first or entry.number, max(end, entry.number)
                if entry.number in trail.restored:
                    accepted_at[entry.number] = index
            elif entry.number > trail.rows and not is_younger:
                wrong.append((index, entry))
            is_younger = is_younger or entry == last
        held = _without_accepted(trail, wrong, accepted_at)
        yield from _differences(trail, place, held)
        numbers = [*([first] if first else []), *(head.number for head in held)]
        if numbers:
            trail.first[place] = min(numbers)
            end = max(end, *numbers)
            self._kept.append(
                KeptHeads(trail.station, place, min(numbers), end, trail.end, each.is_elsewhere)
            )

    # -- audit trails -----------------------------------------------------------------------------

    def _trails(
        self, connection: Connection, records_id: str, kept: list[_PlaceHeads]
    ) -> Iterator[Problem]:
        """Check all audit trails, and compare them with their stored heads."""
        found = fingerprint_of(connection)
        names = list(connection.execute(select(schema.station.c.name)).scalars())
        others = [name for each in kept for name in each.lasts]
        for name in dict.fromkeys([*names, *others]):
            trail = _continued_trail(name, self._since)
            query = chain.rows_after(name, trail.rows).execution_options(yield_per=1000)
            self._trails_found.append(trail)
            with connection.execute(query) as rows:
                yield from self._chain(trail, rows.mappings(), records_id)
            for each in kept:
                yield from self._compare(connection, trail, each, records_id)
            if trail.end and not any(
                kept.is_elsewhere and kept.station == name for kept in self._kept
            ):
                self._unkept.append(name)
        stated = [(each.version, each.schema) for each in self._trails_found if each.end]
        for thing, what in stated_differences(stated, found):
            yield Problem(f"schema, {printable(thing)}", what)

    def _chain(
        self,
        trail: ExaminedTrail,
        rows: Iterable[Mapping[Any, Any]],
        records_id: str,
    ) -> Iterator[Problem]:
        """Check the rows of one chain after `trail.end`, in order. Yields problems and fills in
        `trail`.
        """
        key = trail.keys[-1] if trail.keys else ""
        end = chain.ChainEnd(trail.end, trail.hash_of(trail.end) or trail.hash, key)
        shown = printable(trail.station)
        for expected, row in enumerate(rows, trail.end + 1):
            where = f"audit row {expected} of {shown}"
            data = chain.data_of(row["data"])
            faults = end.add(row)
            yield from (Problem(where, each.value) for each in faults)
            following = chain.key_of(row["event"], data)
            if following is not None:
                trail.keys.append(following)
            trail.add(row["hash"])
            self._add_progress(1)
            if chain.RowFault.CHANGED in faults:
                continue  # its content is not trusted
            if _table(data.get("schema")):
                trail.version, trail.schema = data.get("version"), data["schema"]
            if row["event"] in chain.LOSSES:
                lost = chain.lost_of(data)
                trail.restored[expected] = lost.start, lost.stop - 1
            self._add_remarks(shown, row, data)
            for what in _contradictions(trail.station, records_id, row["event"], data):
                yield Problem(where, what)

    # -- one run ----------------------------------------------------------------------------------

    def examine_run(self, run_id: RunId) -> RunExamination:
        """Examine one run and its audit rows without reading all records. Raises RecordError."""
        with self._database.reading() as connection:
            records_id = records_id_of(connection)
            names = connection.execute(
                select(schema.station.c.name)
                .join_from(schema.audit, schema.station)
                .where(schema.audit.c.run_id == run_id)
                .distinct()
            )
            kept = list(self._reach(records_id, list(names.scalars()), _BRIEFLY_S, is_all=False))
        with self._database.reading() as connection:
            rows = connection.execute(
                select(schema.audit, schema.station.c.name)
                .join_from(schema.audit, schema.station)
                .where(schema.audit.c.run_id == run_id)
                .order_by(schema.audit.c.id)
            )
            ending: Mapping[Any, Any] | None = None
            problems: list[Problem] = []
            for row in rows.mappings().all():
                where = f"audit row {row['number']} of {printable(row['name'])}"
                problems += (Problem(where, what) for what in _row_faults(connection, row))
                if row["event"] in chain.ENDINGS:
                    ending = row
            stated = _run_digests(connection, [run_id])
            changed: dict[tuple[str, str], list[int]] = defaultdict(list)
            contents = contents_of(connection, [run_id])
            problems += self._contents(contents, stated, changed)
            problems += _shared(changed)
            places = []
            if ending is not None:
                problems += _schema_of(connection, ending["name"])
                for each in kept:
                    found = list(_head_faults(connection, each, ending, records_id))
                    problems += (Problem(*what) for what in found if what)
                    if not found:
                        places.append(each)
        since = self._since
        is_examined = (
            since is not None
            and ending is not None
            and ending["name"] in since.chains
            and ending["number"] <= since.chains[ending["name"]].rows
        )
        return RunExamination(
            tuple(problems),
            tuple(each.place.shown for each in places if each.is_elsewhere),
            any(not each.is_elsewhere for each in places),
            since.at if since is not None and is_examined else None,
        )

    def _add_remarks(self, shown: str, row: Mapping[Any, Any], data: Mapping[str, Any]) -> None:
        """Add remarks about decisions of operators that an intact row records."""
        decision = f"{row['at'][:10]} by {printable(str(data.get('by')))}"
        match row["event"]:
            case chain.KEY_LOST:
                self._remarks.append(f"{shown}: the key was declared lost on {decision}")
            case chain.RESTORED:
                lost = chain.lost_of(data)
                self._remarks.append(
                    f"{shown}: rows {lost.start} to {lost.stop - 1} of an earlier chain were given"
                    f" up as lost on {decision}"
                )
            case chain.TAKEN_OVER:
                computer = printable(str(data.get("computer")))
                self._remarks.append(f"{shown}: {computer} took the station over on {decision}")
            case chain.BRANCH:
                self._remarks.append(
                    f"{shown}: rows {data.get('first')} to {data.get('last')} of another PC were"
                    f" brought in on {decision}"
                )
            case chain.CLOCK:
                self._remarks.append(f"{shown}: the clock was released on {decision}")

    # -- runs -------------------------------------------------------------------------------------

    def _digests(
        self,
        run_id: int,
        digests: Mapping[str, str],
        stated: RunDigests,
        changed: dict[tuple[str, str], list[int]],
    ) -> Iterator[Problem]:
        """Compare a run with its digests in the audit trail. `changed` collects shared rows."""
        where = text("run {run_id}", run_id=run_id)
        if not stated.is_known:
            yield Problem(where, "the audit trail does not have it", (run_id,))
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

    def _contents(
        self,
        contents: Mapping[int, Mapping[str, Any]],
        stated: Mapping[int, RunDigests],
        changed: dict[tuple[str, str], list[int]],
    ) -> Iterator[Problem]:
        """Check runs whose rows are already read."""
        for run_id, digests in chain.digests_in(contents).items():
            yield from self._digests(run_id, digests, stated[run_id], changed)
        for run_id, content in contents.items():
            if not is_whole(content):
                continue  # its digests already differ
            try:
                details = details_of_content(content, content["recipe"])
            except ValidationError as error:
                (first, *_) = error.errors()
                value = printable(f"{first['input']!r:.80} as {first['loc'][-1]}")
                yield Problem(
                    text("run {run_id}", run_id=run_id), f"it cannot be read: {value}", (run_id,)
                )
                continue
            self._add_progress(1)
            is_over = details.run.state is not RunState.RUNNING
            if stated[run_id].is_known and is_over != bool(stated[run_id].ending):
                what = "it is finished, but active in the audit trail"
                if not is_over:
                    what = "it is active, but finished in the audit trail"
                yield Problem(text("run {run_id}", run_id=run_id), what, (run_id,))
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
        """Compare a PASS with its own bus trace."""
        run = details.run
        where = f"run {run.run_id}, PASS of {printable(run.serial)}"
        if not traces:
            yield Problem(where, "it has no trace to compare it with", (run.run_id,))
            return
        try:
            with self._files.temporary_copy(traces[0]) as path:
                traces_by_target = traces_of_targets(
                    (target.target for target in details.targets), read_trace(path)
                )
        except (UsageError, RecordError) as error:
            what = f"its trace cannot be read: {error.cause or error.what}"
            yield Problem(where, what, (run.run_id,))
            return
        self._traces += 1
        self._nameless += not any(each.serial for each in traces_by_target.values())
        for what in contradictions(details, traces_by_target):
            yield Problem(where, f"its trace contradicts it: {what}", (run.run_id,))


def _is_as_examined(connection: Connection, since: Examined) -> bool:
    """True if the examined rows still exist, by their number and the last hash of each chain."""
    if records_id_of(connection) != since.records:
        return False
    audit, run = schema.audit.c, schema.run.c
    for name, each in since.chains.items():
        count = (
            select(func.count())
            .select_from(schema.audit.join(schema.station))
            .where(schema.station.c.name == name, audit.number <= each.rows)
        )
        if chain.hash_at(connection, name, each.rows) != each.hash:
            return False
        if connection.execute(count).scalar_one() != each.rows:
            return False
    runs = select(func.count()).where(run.id <= since.run)
    return bool(connection.execute(runs).scalar_one() == since.runs)


def _continued_trail(name: str, since: Examined | None) -> ExaminedTrail:
    """The state of a station's chain at the end of the last examination."""
    each = None if since is None else since.chains.get(name)
    return ExaminedTrail(**vars(deepcopy(each or ExaminedChain())), station=name)


def _row_faults(connection: Connection, row: Mapping[Any, Any]) -> Iterator[str]:
    """Faults of one audit row."""
    number, name = row["number"] - 1, row["name"]
    before = chain.hash_at(connection, name, number) if number else chain.GENESIS
    key = chain.key_in_force(connection, name, row["number"])
    return (each.value for each in chain.ChainEnd(number, before or "", key or "").add(row))


def _schema_of(connection: Connection, name: str) -> Iterator[Problem]:
    """Compare the schema with the last one that a station's chain records."""
    rows = chain.rows_without_run(connection, name, (chain.BEGUN, chain.MIGRATED))
    data = chain.data_of(rows[-1].data) if rows else {}
    if data.get("version") == schema.SCHEMA_VERSION:
        stated = [(data.get("version"), _table(data.get("schema")))]
        for thing, what in stated_differences(stated, fingerprint_of(connection)):
            yield Problem(f"schema, {printable(thing)}", what)


def _head_faults(
    connection: Connection, each: _PlaceHeads, row: Mapping[Any, Any], records_id: str
) -> Iterator[tuple[str, str] | None]:
    """Compare an audit row and the end of its chain with the heads of a place. Yields problems, and
    None if the place lacks this head; nothing if it has it.
    """
    name, number, place = row["name"], row["number"], each.place.shown
    last = each.lasts.get(name)
    if last is None:
        yield None
        return
    where = f"audit trail of {printable(name)}"
    if chain.hash_at(connection, name, last.number) != last.hash:
        lost = chain.accepted_losses(connection, name)
        if not any(last.number in some for some in lost):
            yield (
                where,
                f"row {last.number} of {last.at} is stored in {place}, but missing here",
            )
    heads = each.place.of(name, records_id).of_row(number)
    if any(head.hash == row["hash"] for head in heads):
        return
    yield None
    if heads and not any(number in some for some in chain.accepted_losses(connection, name)):
        yield where, f"row {number} is not the one that is stored in {place}"


def _shared(changed: Mapping[tuple[str, str], list[int]]) -> Iterator[Problem]:
    """Problems of changed rows that several runs refer to."""
    for (part, _), run_ids in changed.items():
        shown = ", ".join(map(str, run_ids[:_RUNS_NAMED]))
        more = f" and {len(run_ids) - _RUNS_NAMED} more" if len(run_ids) > _RUNS_NAMED else ""
        what = f"changed after it was recorded: {NAMED[part]}"
        yield Problem(f"{part} of run {shown}{more}", what, tuple(run_ids))


def same_traces(connection: Connection) -> Iterator[Problem]:
    run = schema.run.c
    of_pass = select(run.log_sha256).where(run.state == RunState.PASS.value)
    twice = of_pass.group_by(run.log_sha256).having(func.count() > 1)
    for sha256 in connection.execute(twice).scalars().all():
        with_it = select(run.id).where(run.log_sha256 == sha256).order_by(run.id)
        same = tuple(connection.execute(with_it).scalars())
        shown = ", ".join(map(str, same[:_RUNS_NAMED]))
        yield Problem(f"runs {shown}", "they have the same trace", same)


_AUDIT_OF_RUNS: Final = (
    select(schema.audit).where(schema.audit.c.run_id.in_(KEYS)).order_by(schema.audit.c.id)
)


@dataclass
class RunDigests:
    """Digests of a run that the audit trail records."""

    claim: Mapping[str, str] = field(default_factory=dict)
    """Digests at the claim."""
    ending: Mapping[str, str] = field(default_factory=dict)
    """Digests at the end."""

    @property
    def is_known(self) -> bool:
        return bool(self.claim or self.ending)


def _run_digests(connection: Connection, run_ids: list[int]) -> dict[int, RunDigests]:
    """Digests in the intact audit rows of these runs."""
    found: dict[int, RunDigests] = defaultdict(RunDigests)
    for run_id, rows in grouped(connection, _AUDIT_OF_RUNS, "run_id", run_ids).items():
        for row in rows:
            digests = _table(chain.data_of(row["data"]).get("digests"))
            if not digests or row["hash"] != chain.row_hash(row):
                continue
            if row["event"] == chain.CLAIMED:
                found[run_id].claim = digests
            elif row["event"] in chain.ENDINGS:
                found[run_id].ending = digests
    return found


def _segment_faults(
    trail: ExaminedTrail, place: str, entry: Checkpoint | HeadsFault
) -> Iterator[Problem]:
    shown = printable(trail.station)
    if isinstance(entry, HeadsFault):
        yield Problem(f"heads of {shown}, {entry.where}", entry.what)
    elif entry.key not in trail.keys:
        where = f"heads of {shown}, segment {entry.segment} in {place}"
        yield Problem(where, "it is not signed with a key of the station")


def _without_accepted(
    trail: ExaminedTrail, wrong: list[tuple[int, ChainHead]], accepted_at: Mapping[int, int]
) -> list[ChainHead]:
    """Differing heads without those of rows that an operator accepted as lost."""
    return [
        head
        for index, head in wrong
        if not any(
            first <= head.number <= last and index < accepted_at.get(number, index + 1)
            for number, (first, last) in trail.restored.items()
        )
    ]


def _differences(trail: ExaminedTrail, place: str, held: list[ChainHead]) -> Iterator[Problem]:
    """Problems of heads that differ from the chain."""
    where = f"audit trail of {printable(trail.station)}"
    missing = [head for head in held if head.number > trail.end]
    other = [head for head in held if head.number <= trail.end]
    if missing:
        last = max(missing, key=lambda head: head.number)
        yield Problem(
            where,
            f"it ends at row {trail.end}, but row {last.number} of {last.at} is"
            f" stored in {place}: its end was cut off, or this is an older copy",
        )
    if other:
        first = min(other, key=lambda head: head.number)
        yield Problem(
            where,
            f"row {first.number} of {first.at} is not the one that is stored in {place}: the"
            " chain was replaced",
        )


def _unused(connection: Connection) -> Iterator[Problem]:
    """Rows that no run refers to, although stations add them only for a run."""
    for table, naming in _USED.items():
        # A join, since a server would search a list of NOT IN (...) for each row.
        query = select(table).outerjoin(naming.table, naming == table.c.id).where(naming.is_(None))
        for row in connection.execute(query.order_by(table.c.id).limit(_RUNS_NAMED)).mappings():
            name = row.get("serial") or row.get("name")
            yield Problem(
                f"{table.name} {printable(str(name))}", "no run refers to it: it was added"
            )


def _contradictions(
    name: str, records_id: str, event: str, data: Mapping[str, Any]
) -> Iterator[str]:
    """Contradictions between an intact audit row and these records."""
    if event == chain.BEGUN and data.get("records") != records_id:
        yield "the chain is that of other records"
    if event == chain.BEGUN and data.get("station") != name:
        yield f"the chain is that of the station {printable(str(data.get('station')))}"
    if event == chain.MIGRATED:
        found = data.get("problems")
        for what in found if isinstance(found, list) else ():
            yield f"found at the upgrade: {printable(str(what))}"


def _table(value: Any) -> Mapping[str, str]:
    return value if isinstance(value, dict) else {}


def _sqlite_problems(connection: Connection) -> Iterator[Problem]:
    # Each row is looked up in each index, among them those of hashes, in no order: with SQLite's
    # own cache of 2 MB nearly every look-up reads a page again.
    usual = connection.exec_driver_sql("PRAGMA cache_size").scalar_one()
    connection.exec_driver_sql(f"PRAGMA cache_size = -{_CACHE_KB}")
    damage = connection.exec_driver_sql("PRAGMA integrity_check").scalars().all()
    connection.exec_driver_sql(f"PRAGMA cache_size = {usual}")
    for found in damage:
        if found != "ok":
            yield Problem("database", printable(str(found)))
    for row in connection.exec_driver_sql("PRAGMA foreign_key_check").all():
        yield Problem(f"table {row[0]}, row {row[1]}", f"it refers to a missing row of {row[2]}")
