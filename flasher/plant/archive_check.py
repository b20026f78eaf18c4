"""Examines a file of retired records: audit trails, signatures, runs, traces, kept rows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from uuid import UUID

from pydantic import ValidationError
from sqlalchemy import Connection, select

from flasher.i18n import text
from flasher.plant.archive import ArchivedChain, ArchiveReader, Manifest, Rows
from flasher.plant.schema import OWN_PARTS, SHARED_PARTS, kept_run
from flasher.protocol.text import printable
from flasher.station.records import chain
from flasher.station.records.database import Database
from flasher.station.records.examination import ExaminedTrail, Examiner, RunDigests
from flasher.station.records.files import FileStore
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import Problem, RunDetails, RunId, WriteId
from flasher.station.records.queries import details_of_content, is_whole

_NOTHING: Final = object()


@dataclass(frozen=True)
class ExaminedArchive:
    """Result of an examination of a file."""

    problems: tuple[Problem, ...]
    manifest: Manifest
    sha256: str
    size_bytes: int
    keys: Mapping[UUID, tuple[str, ...]]
    """Public keys up to the last row, by chain."""
    runs: int
    traces: int
    """PASS that were compared with their traces."""


@dataclass
class Assembled:
    """Runs that ended in some audit rows, by their number at the station."""

    contents: dict[int, dict[str, Any]]
    stated: dict[int, RunDigests]
    incomplete: set[int]
    """Runs that lack a part."""


def assembled(rows: Sequence[Mapping[Any, Any]], parts: Mapping[str, Any]) -> Assembled:
    """Put the parts of runs together, as the station signed them."""
    found = Assembled({}, defaultdict(RunDigests), set())
    for row in rows:
        number = row["run_number"]
        digests = chain.data_of(row["data"]).get("digests", {})
        if row["event"] == chain.CLAIMED:
            found.stated[number].claim = digests
        if row["content"] is None:
            continue
        found.stated[number].ending = digests
        named = {name: parts.get(digests.get(name, ""), _NOTHING) for name in SHARED_PARTS}
        own = {name: row["content"].get(name) for name in OWN_PARTS}
        if any(each is _NOTHING for each in named.values()) or None in own.values():
            found.incomplete.add(number)
            continue
        content = own | named
        content[chain.CLAIM] = chain.claim_of({"run": own["run"], "targets": own["targets"]})
        found.contents[number] = content
    return found


def without_ids(content: Mapping[str, Any]) -> RunDetails:
    """A run, to be compared with the same one under other ids."""
    details = details_of_content(content, content["recipe"])
    return replace(
        details,
        run=replace(details.run, run_id=RunId(0)),
        writes=tuple(replace(each, write_id=WriteId(0)) for each in details.writes),
    )


def differing(
    connection: Connection,
    run_ids: Mapping[int, int],
    contents: Mapping[int, Any],
    missing: str,
    compared: Callable[[RunDetails], RunDetails] = lambda details: details,
) -> Iterator[Problem]:
    """Compare what reports and pages read with what the stations signed. `run_ids`: ids in the
    database by the run's number at the station; `compared`: the part of a run that has to be equal.
    """
    shown = chain.contents_of(connection, run_ids.values())
    for number, run_id in run_ids.items():
        found = shown.get(run_id)
        if found is None or not is_whole(found):
            what = missing
        elif _is_changed(found, contents[number], compared):
            what = "what reports and pages show differs from what the station signed"
        else:
            continue
        yield Problem(text("run {run_id}", run_id=number), what)


def _is_changed(
    shown: Mapping[str, Any],
    signed: Mapping[str, Any],
    compared: Callable[[RunDetails], RunDetails],
) -> bool:
    if _shared(shown) != _shared(signed):
        return True
    try:
        found = without_ids(shown)
    except ValidationError:  # a value that no station writes
        return True
    return compared(found) != compared(without_ids(signed))


def _shared(content: Mapping[str, Any]) -> list[Any]:
    """Recipe and images as a whole: of a run, pages and filters show more than `RunDetails` has."""
    rows = [content["recipe"], *content["artifacts"]]
    return [each and {**each, "id": None} for each in rows]


def _as_kept(details: RunDetails) -> RunDetails:
    """What stays of a retired run."""
    targets = tuple(replace(each, signature=None) for each in details.targets)
    return replace(details, targets=targets, steps=(), attachments=())


class _Traces(FileStore):
    """The traces of some rows of a file."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.data: Mapping[str, bytes] = {}

    def _stored(self, sha256: str) -> bytes | None:
        return self.data.get(sha256)


class AssembledExaminer(Examiner):
    """Examines runs that were put together from their parts."""

    _runs = 0
    """Number of runs that were examined."""

    def _assembled(self, found: Assembled) -> Iterator[Problem]:
        for number in found.incomplete:
            yield Problem(text("run {run_id}", run_id=number), "a part of it is missing")
        changed: dict[tuple[str, str], list[int]] = defaultdict(list)
        yield from self._contents(found.contents, found.stated, changed)
        for (part, _), of_runs in changed.items():
            what = f"changed after it was recorded: {chain.NAMED[part]}"
            yield Problem(text("run {run_id}", run_id=of_runs[0]), what)
        self._runs += len(found.contents)


class ArchiveExaminer(AssembledExaminer):
    """Examines a file once. `chains`: what it has to contain."""

    def __init__(
        self,
        database: Database,
        path: Path,
        chains: Sequence[ArchivedChain],
        progress: Callable[[int, int], None],
    ) -> None:
        self._traces_of_rows = _Traces(database.location.folder)
        super().__init__(database, self._traces_of_rows, KeyLocations(), progress)
        self._path = path
        self._chains = {each.station: each for each in chains}
        self._total = sum(each.last - each.first + 1 for each in chains)
        self._claims: dict[tuple[UUID, int], Mapping[str, str]] = {}

    def examine_file(self) -> ExaminedArchive:
        """Raises RecordError if the file cannot be read."""
        reader = ArchiveReader(self._path)
        shown = printable(self._path.name)
        trails = {
            station: ExaminedTrail(
                each.first - 1, each.previous_hash, keys=list(each.keys), station=each.name
            )
            for station, each in self._chains.items()
        }
        problems: list[Problem] = []
        with self._database.reading() as connection, closing(reader.read()) as all_rows:
            for rows in all_rows:
                trail = trails.get(rows.station)
                if trail is None:
                    problems.append(Problem(shown, f"it has the chain {rows.station}, too"))
                    continue
                signed = [row | {"run_id": row["run_number"]} for row in rows.rows]
                records_id = self._chains[rows.station].records_id
                problems += self._chain(trail, signed, records_id)
                problems += self._of_rows(connection, rows)
        manifest = reader.manifest
        assert manifest is not None  # noqa: S101  or read has raised
        for station, each in self._chains.items():
            trail = trails[station]
            if (trail.end, trail.hash_of(trail.end)) != (each.last, each.hash):
                what = f"the chain of {printable(each.name)} does not end with row {each.last}"
                problems.append(Problem(shown, what))
        if set(manifest.chains) != set(self._chains.values()):
            problems.append(Problem(shown, "its manifest states other chains"))
        return ExaminedArchive(
            tuple(replace(each, where=f"{shown}, {each.where}", runs=()) for each in problems),
            manifest,
            reader.sha256,
            reader.size_bytes,
            {station: tuple(trail.keys) for station, trail in trails.items()},
            self._runs,
            self._traces,
        )

    def _of_rows(self, connection: Connection, rows: Rows) -> Iterator[Problem]:
        self._traces_of_rows.data = rows.traces
        found = assembled(rows.rows, rows.parts)
        for number, stated in found.stated.items():
            if stated.claim:  # its run may end in a later batch, or a later file
                self._claims[rows.station, number] = stated.claim
            if stated.ending:
                stated.claim = self._claims.pop((rows.station, number), {})
        yield from self._assembled(found)
        yield from self._kept_runs(connection, rows.station, found.contents)

    def _kept_runs(
        self, connection: Connection, station: UUID, contents: Mapping[int, Any]
    ) -> Iterator[Problem]:
        """Compare what stayed in the database with the file."""
        query = select(kept_run.c.run_number, kept_run.c.run_id).where(
            kept_run.c.file == self._path.name,
            kept_run.c.station == station,
            kept_run.c.run_number.in_(contents),
        )
        kept = {row.run_number: row.run_id for row in connection.execute(query)}
        missing = "the database does not have the last run of its unit"
        yield from differing(connection, kept, contents, missing, _as_kept)
