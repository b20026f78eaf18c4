"""The examination of records: schema, audit trails, runs, attachments and traces."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, Final

from pydantic import ValidationError
from sqlalchemy import Connection, func, select

from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.chain import NAMED, OWN, digests_of
from flasher.station.records.database import Database
from flasher.station.records.errors import RecordError
from flasher.station.records.files import FileStore
from flasher.station.records.heads import Fault, Head, HeadsFile
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
from flasher.station.records.proof import contradictions, traces_of_targets
from flasher.station.records.queries import details_of
from flasher.station.records.rows import batches
from flasher.station.records.signatures import is_signed
from flasher.station.records.triggers import fingerprint_of, stated_differences
from flasher.trace.reader import read_trace

_RUNS_NAMED: Final = 5


class Examiner:
    """One examination of the records."""

    def __init__(self, database: Database, files: FileStore, keeping: Keeping) -> None:
        self._database = database
        self._files = files
        self._keeping = keeping
        self._remarks: list[str] = []
        self._kept: list[KeptHeads] = []
        self._unkept: list[str] = []
        self._stated: list[tuple[object, Mapping[str, str]]] = []
        """The last statement of each chain about the schema, with its version."""
        self._claims: dict[int, Mapping[str, str]] = {}
        """The digests that the chains state for each run, at its claim."""
        self._endings: dict[int, Mapping[str, str]] = {}
        """And at its end."""
        self._traces = 0
        self._nameless = 0

    def examine(self, runs: Collection[RunId] | None = None) -> Examination:
        """Examine everything; of the runs these, or all."""
        with self._database.reading() as connection:
            problems = tuple(self._problems(connection, runs))
        if self._nameless:
            self._remarks.append(
                f"{self._nameless} PASS of devices that name no serial number: their traces do not"
                " tell which unit it was"
            )
        return Examination(
            problems, tuple(self._remarks), tuple(self._kept), tuple(self._unkept), self._traces
        )

    def _problems(
        self, connection: Connection, runs: Collection[RunId] | None
    ) -> Iterator[Problem]:
        if self._database.backend == "sqlite":
            yield from _sqlite_problems(connection)
        yield from self._trails(connection)
        run = schema.run.c
        there = list(connection.execute(select(run.id).order_by(run.id)).scalars())
        for run_id in sorted((self._claims.keys() | self._endings.keys()) - set(there)):
            yield Problem(f"run {run_id}", "it is missing: the audit trail knows it", (run_id,))
        chosen = there if runs is None else sorted(set(there) & set(runs))
        changed: dict[tuple[str, str], list[int]] = defaultdict(list)
        for some in batches(chosen):
            for run_id, digests in digests_of(connection, some).items():
                yield from self._digests(run_id, digests, changed)
            yield from self._runs(connection, some)
        for (part, _), run_ids in changed.items():
            shown = ", ".join(map(str, run_ids[:_RUNS_NAMED]))
            more = f" and {len(run_ids) - _RUNS_NAMED} more" if len(run_ids) > _RUNS_NAMED else ""
            what = f"changed after it was recorded: {NAMED[part]}"
            yield Problem(f"{part} of run {shown}{more}", what, tuple(run_ids))
        of_pass = select(run.log_sha256).where(run.state == RunState.PASS.value)
        twice = of_pass.group_by(run.log_sha256).having(func.count() > 1)
        for sha256 in connection.execute(twice).scalars().all():
            with_it = select(run.id).where(run.log_sha256 == sha256).order_by(run.id)
            same = tuple(connection.execute(with_it).scalars())
            shown = ", ".join(map(str, same[:_RUNS_NAMED]))
            yield Problem(f"runs {shown}", "they have one and the same trace", same)

    # -- audit trails -----------------------------------------------------------------------------

    def _trails(self, connection: Connection) -> Iterator[Problem]:
        """Go through all audit trails, and hold them against the heads that are kept of them."""
        records_id = connection.execute(select(schema.schema_info.c.records_id)).scalar_one()
        found = fingerprint_of(connection)
        names = list(connection.execute(select(schema.station.c.name)).scalars())
        kept_of = self._keeping.kept_heads(records_id, names)
        for name in dict.fromkeys([*names, *kept_of]):
            rows = connection.execute(
                select(schema.audit)
                .join_from(schema.audit, schema.station)
                .where(schema.station.c.name == name)
                .order_by(schema.audit.c.number)
            )
            hashes: dict[int, str] = {}
            restored: dict[int, range] = {}
            keys: set[str] = set()
            yield from self._chain(name, rows.mappings(), records_id, hashes, restored, keys)
            yield from self._heads(name, kept_of.get(name), hashes, restored, keys)
        for thing, what in stated_differences(self._stated, found):
            yield Problem(f"schema, {printable(thing)}", what)

    def _chain(
        self,
        name: str,
        rows: Iterable[Mapping[Any, Any]],
        records_id: str,
        hashes: dict[int, str],
        restored: dict[int, range],
        keys: set[str],
    ) -> Iterator[Problem]:
        """Go along one chain; fills the hashes of its rows, and which heads were given up."""
        before, key = chain.GENESIS, None
        stated: tuple[object, Mapping[str, str]] = (None, {})
        shown = printable(name)
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
            key = following or key
            keys |= {following} if following else set()
            before, hashes[expected] = row["hash"], row["hash"]
            if not is_whole:
                continue  # what it says counts for nothing
            if _table(data.get("schema")):
                stated = data.get("version"), _table(data.get("schema"))
            if row["event"] == chain.RESTORED:
                restored[expected] = _lost(data)
            self._take_row(shown, row, data)
            for what in _contradictions(name, records_id, row["event"], data):
                yield Problem(where, what)
        if hashes:
            self._stated.append(stated)

    def _take_row(self, shown: str, row: Mapping[Any, Any], data: Mapping[str, Any]) -> None:
        """Note what an intact row vouches for, and what a person should know of it."""
        said = f"{row['at'][:10]} by {printable(str(data.get('by')))}"
        digests = _table(data.get("digests")) if row["run_id"] is not None else {}
        match row["event"]:
            case chain.KEY_LOST:
                self._remarks.append(f"{shown}: the key was declared lost on {said}")
            case chain.RESTORED:
                lost = _lost(data)
                self._remarks.append(
                    f"{shown}: rows {lost.start} to {lost.stop - 1} of an earlier chain were given"
                    f" up as lost on {said}"
                )
            case chain.CLOCK:
                self._remarks.append(f"{shown}: the clock was released on {said}")
            case chain.CLAIMED if digests:
                self._claims[row["run_id"]] = digests
            case ending if ending in chain.ENDINGS and digests:
                self._endings[row["run_id"]] = digests

    def _heads(
        self,
        name: str,
        kept: HeadsFile | None,
        hashes: Mapping[int, str],
        restored: Mapping[int, range],
        keys: set[str],
    ) -> Iterator[Problem]:
        """Compare a chain with its kept heads."""
        shown = printable(name)
        place = printable(str(self._keeping.heads_folder))
        if kept is None:
            if hashes:
                self._unkept.append(name)
                if self._keeping.heads is not None:
                    yield Problem(f"heads of {shown}", f"none of these records is kept in {place}")
            return
        heads = []
        for entry in kept.entries():
            if isinstance(entry, Head):
                heads.append(entry)
            elif isinstance(entry, Fault):
                yield Problem(f"heads of {shown}, {entry.where}", entry.what)
            elif entry.key not in keys:
                where = f"heads of {shown}, segment {entry.segment} in {place}"
                yield Problem(where, "it is not signed with a key of the station")
        held = _counting(heads, hashes, restored)
        missing = [head for head in held if head.number not in hashes]
        other = [head for head in held if hashes.get(head.number, head.hash) != head.hash]
        if missing:
            last = max(missing, key=lambda head: head.number)
            yield Problem(
                f"audit trail of {shown}",
                f"it ends at row {max(hashes, default=0)}, but row {last.number} of {last.at} is"
                f" kept in {place}: its end was cut off, or this is an older copy",
            )
        if other:
            first = min(other, key=lambda head: head.number)
            yield Problem(
                f"audit trail of {shown}",
                f"row {first.number} of {first.at} is not the one that is kept in {place}: the"
                " chain was made anew",
            )
        if held:
            numbers = [head.number for head in held]
            path = self._keeping.heads_folder
            self._kept.append(KeptHeads(name, path, min(numbers), max(numbers)))

    # -- runs -------------------------------------------------------------------------------------

    def _digests(
        self, run_id: int, digests: Mapping[str, str], changed: dict[tuple[str, str], list[int]]
    ) -> Iterator[Problem]:
        """Hold a run against what the trails vouch for; `changed` collects what several share."""
        where = f"run {run_id}"
        stated = (self._claims.get(run_id, {}), self._endings.get(run_id, {}))
        if not any(stated):
            yield Problem(where, "the audit trail does not know it", (run_id,))
        wrong = {
            part: digests.get(part, "")
            for each in stated
            for part in each
            if each[part] != digests.get(part)
        }
        for part in wrong.keys() & NAMED.keys():
            changed[part, wrong[part]].append(run_id)
        own = [words for part, words in OWN.items() if part in wrong]
        if own:
            what = f"changed after it was recorded: {', '.join(own)}"
            yield Problem(where, what, (run_id,))

    def _runs(self, connection: Connection, run_ids: list[int]) -> Iterator[Problem]:
        """Check that the runs can be read, and their attachments."""
        try:
            found = tuple(details_of(connection, schema.run.c.id.in_(run_ids)))
        except ValidationError as error:
            if len(run_ids) > 1:
                for run_id in run_ids:
                    yield from self._runs(connection, [run_id])
            else:
                (first, *_) = error.errors()
                said = printable(f"{first['input']!r:.80} as {first['loc'][-1]}")
                yield Problem(f"run {run_ids[0]}", f"it cannot be read: {said}", tuple(run_ids))
            return
        for details in found:
            run_id = details.run.run_id
            is_over = details.run.state is not RunState.RUNNING
            is_known = run_id in self._claims or run_id in self._endings
            if is_known and is_over != (run_id in self._endings):
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


def _counting(
    heads: list[Head], hashes: Mapping[int, str], restored: Mapping[int, range]
) -> list[Head]:
    """The heads without those that a person gave up, when older records were put back."""
    given_up: set[int] = set()
    for number, lost in restored.items():
        given_up_at = len(heads)
        for index, head in enumerate(heads):
            if (head.number, head.hash) == (number, hashes[number]):
                given_up_at = index
        earlier = enumerate(heads[:given_up_at])
        given_up |= {index for index, head in earlier if head.number in lost}
    return [head for index, head in enumerate(heads) if index not in given_up]


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


def _lost(data: Mapping[str, Any]) -> range:
    """The rows that a person gave up; none where it is not said."""
    first, last = data.get("lost_from"), data.get("lost_to")
    if isinstance(first, int) and isinstance(last, int):
        return range(first, last + 1)
    return range(0)


def _sqlite_problems(connection: Connection) -> Iterator[Problem]:
    for (found,) in connection.exec_driver_sql("PRAGMA integrity_check").all():
        if found != "ok":
            yield Problem("database", printable(str(found)))
    for row in connection.exec_driver_sql("PRAGMA foreign_key_check").all():
        yield Problem(f"table {row[0]}, row {row[1]}", f"it names a missing row of {row[2]}")
