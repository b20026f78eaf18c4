"""Queries for the supervisor's pages: runs, audit trail, units with an image, yield over time.

The database counts, and the number of fetched rows is limited, however many runs exist.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from itertools import chain as joined
from typing import Annotated, Any, Final, Generic, TypeVar

from pydantic import BeforeValidator
from sqlalchemy import Connection, Select, and_, exists, func, or_, select
from sqlalchemy.sql.expression import ColumnElement

from flasher.station.records import schema
from flasher.station.records.chain import data_of
from flasher.station.records.database import Database
from flasher.station.records.filters import WITHOUT_CAUSE, counting
from flasher.station.records.model import (
    FLASH,
    Moment,
    RunDetails,
    RunFilter,
    RunId,
    RunRecord,
    RunState,
    StepState,
    Units,
    utc_moment,
    utc_text,
)
from flasher.station.records.newest import PageCursor, newest_runs
from flasher.station.records.queries import RUN_QUERY, details_of, valid
from flasher.station.records.rollup import (
    ALL_SPANS,
    Rest,
    Rollup,
    StepTimes,
    rounded_s,
)
from flasher.station.records.rows import beside_index
from flasher.station.records.yields import Span, units_in

PAGE_SIZE: Final = 50
LIFE_SIZE: Final = 10
IMAGES_MAX: Final = 100
HOLDERS_COUNTED: Final = 300
"""Count units of an image up to this number: they are scattered, and each costs a disk read."""
_Row = TypeVar("_Row")


@dataclass(frozen=True)
class Page(Generic[_Row]):
    """Rows of a page, newest first, with the cursors of the pages before and after."""

    rows: tuple[_Row, ...]
    older: PageCursor | None
    newer: PageCursor | None


@dataclass(frozen=True)
class ImageRecord:
    """An image that a run had to flash."""

    target: str
    name: str
    version: str
    sha256: str
    size_bytes: int


@dataclass(frozen=True)
class InstalledUnit:
    """A unit whose last transfer to a target was of a certain image."""

    serial: str
    part: str
    is_virtual: bool
    run_id: RunId
    state: RunState
    """State of the run with that transfer."""
    begun_at: Moment
    target: str
    is_confirmed: bool
    """The device confirmed the transfer; otherwise it may hold a part of the image, or none."""


class By(StrEnum):
    """Grouping of failures."""

    SOCKET = "socket"
    RECIPE = "recipe"
    LOT = "lot"
    SHIFT = "shift"
    STATION = "station"


@dataclass(frozen=True)
class AuditRow:
    """A row of the audit trail with its parsed data."""

    station: str
    number: int
    at: datetime
    event: str
    run_id: RunId | None
    data: Annotated[dict[str, Any], BeforeValidator(data_of)]
    hash: str


class Overview:
    """Queries of the pages. Every method raises RecordError if the records cannot be read."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._rollup = Rollup(database)

    def runs(self, chosen: RunFilter, cursor: PageCursor, size: int = PAGE_SIZE) -> Page[RunRecord]:
        run_id = schema.run.c.id
        with self._database.reading() as connection:
            found = newest_runs(connection, chosen, cursor, size + 1)
        return self._page(RunRecord, RUN_QUERY.where(run_id.in_(found)), run_id, cursor, size)

    def parts(self, serial: str) -> tuple[str, ...]:
        unit = schema.unit.c
        query = select(unit.part).where(unit.serial == serial).order_by(unit.part)
        with self._database.reading() as connection:
            return tuple(connection.execute(query).scalars())

    def life(
        self, serial: str, part: str, cursor: PageCursor, size: int = LIFE_SIZE
    ) -> Page[RunDetails]:
        run_id = schema.run.c.id
        with self._database.reading() as connection:
            last = newest_runs(connection, RunFilter(serial=serial, part=part), cursor, size + 1)
        query = select(run_id).where(run_id.in_(last))
        page = self._page(dict[str, Any], query, run_id, cursor, size)
        with self._database.reading() as connection:
            found = tuple(details_of(connection, run_id.in_([row["id"] for row in page.rows])))
        return Page(found[::-1], page.older, page.newer)

    def recipes(self) -> tuple[tuple[str, str], ...]:
        recipe = schema.recipe.c
        query = select(recipe.name, recipe.part).distinct().order_by(recipe.name, recipe.part)
        with self._database.reading() as connection:
            return tuple((name, part) for name, part in connection.execute(query))

    def sockets(self) -> tuple[str, ...]:
        name = schema.socket.c.name
        with self._database.reading() as connection:
            return tuple(connection.execute(select(name).distinct().order_by(name)).scalars())

    def last_begin(self, chosen: RunFilter) -> datetime | None:
        """Start time of the last run of a filter; None without runs."""
        run = schema.run.c
        with self._database.reading() as connection:
            last = newest_runs(connection, chosen, PageCursor(), 1)
            query = select(run.begun_at).where(run.id.in_(last))
            found = connection.execute(query).scalar_one_or_none()
        return None if found is None else utc_moment(found)

    # -- images -----------------------------------------------------------------------------------

    def images(self, wanted: str = "") -> tuple[ImageRecord, ...]:
        """Images whose name contains `wanted`, whose SHA-256 begins with it, or that have this
        version, newest first.
        """
        artifact = schema.artifact.c
        query = (
            select(
                artifact.target,
                artifact.name,
                artifact.version,
                artifact.sha256,
                artifact.size_bytes,
            )
            .order_by(artifact.id.desc())
            .limit(IMAGES_MAX)
        )
        if wanted:
            query = query.where(
                or_(
                    artifact.name.icontains(wanted, autoescape=True),
                    artifact.sha256.istartswith(wanted, autoescape=True),
                    artifact.version == wanted,
                )
            )
        with self._database.reading() as connection:
            return tuple(ImageRecord(**row) for row in connection.execute(query).mappings())

    def holders(
        self, sha256: str, cursor: PageCursor, size: int = PAGE_SIZE
    ) -> Page[InstalledUnit]:
        """A page of the units whose last transfer to a target was of this image."""
        query = _holders(self._artifacts(sha256))
        return self._page(InstalledUnit, query, schema.run_target.c.id, cursor, size)

    def holder_count(self, sha256: str) -> int:
        """Number of these units, counted up to `HOLDERS_COUNTED` plus one."""
        target_id = schema.run_target.c.id
        # In the order of the image's index, or a server would read the runs of all images.
        some = (
            _holders(self._artifacts(sha256))
            .with_only_columns(target_id, maintain_column_froms=True)
            .order_by(target_id.desc())
        )
        query = select(func.count()).select_from(some.limit(HOLDERS_COUNTED + 1).subquery())
        with self._database.reading() as connection:
            return int(connection.execute(query).scalar_one())

    def _artifacts(self, sha256: str) -> list[int]:
        """A query of its own: so the index of an image gives its runs in the order of a page."""
        query = select(schema.artifact.c.id).where(schema.artifact.c.sha256 == sha256)
        with self._database.reading() as connection:
            return list(connection.execute(query).scalars())

    # -- figures over time ------------------------------------------------------------------------

    def yields(self, chosen: RunFilter, spans: Sequence[Span]) -> tuple[list[Units], Units]:
        """Units of each of these consecutive spans, and of the whole period."""
        found: dict[int, Units] | None = None
        with self._rollup.rolled(chosen) as rolled:
            if rolled is not None:
                texts = [(utc_text(span.begin), utc_text(span.end)) for span in spans]
                found = rolled.units(texts)
        if found is None:
            whole = Span(spans[0].begin, spans[-1].end)
            with self._database.reading() as connection:
                found = {at: counts for (_, at), counts in units_in(connection, chosen, spans)}
                for _, counts in units_in(connection, chosen, [whole]):
                    found[ALL_SPANS] = counts
        in_spans = [found.get(place, Units()) for place in range(len(spans))]
        return in_spans, found.get(ALL_SPANS, Units())

    def causes(
        self, chosen: RunFilter, by: By, shifts: Sequence[tuple[Span, str]] = ()
    ) -> dict[str, Counter[str]]:
        """Number of runs without PASS, by code and group. `shifts` are for BY.SHIFT, in order."""
        run = schema.run.c
        found: dict[str, Counter[str]] = defaultdict(Counter)
        rest = Rest(chosen, [])
        with self._rollup.rolled(chosen) as rolled, self._database.reading() as connection:
            column, name_of = _group_of(connection, by, shifts)
            counts: Iterable[Any] = ()
            if rolled is not None:
                counts, rest = rolled.bad(column.name), rolled.tail
            # Without their indexes, by which all runs would be read.
            code, group = beside_index(run.code), beside_index(column)
            query = (
                counting(rest.chosen, code, group, func.count())
                .where(beside_index(run.state).not_in(WITHOUT_CAUSE), *rest.conditions)
                .group_by(code, group)
            )
            for failed, value, count in joined(counts, connection.execute(query)):
                name = name_of(value)
                if name is not None:
                    found[failed][name] += count
        return dict(found)

    def step_times(self, chosen: RunFilter) -> StepTimes:
        """Number of passed steps by name and duration (seconds with three digits, no finer than
        0.001).
        """
        step = schema.step.c
        rounded = rounded_s()
        found: StepTimes = defaultdict(Counter)
        rests = [Rest(chosen, [])]
        with self._rollup.rolled(chosen) as rolled:
            if rolled is not None:
                found, rests = rolled.step_times()
        for rest in rests:
            query = (
                counting(rest.chosen, step.name, rounded, func.count())
                # From the runs to their steps, and not through all steps.
                .join(schema.step, step.run_id == beside_index(schema.run.c.id))
                .where(step.state == StepState.PASS.value, *rest.conditions)
                .group_by(step.name, rounded)
            )
            with self._database.reading() as connection:
                for name, seconds, count in connection.execute(query):
                    found[name][float(seconds)] += count
        return dict(found)

    # -- the audit trail --------------------------------------------------------------------------

    def audit(
        self,
        cursor: PageCursor,
        *,
        event: str | None = None,
        since: datetime | None = None,
        until: datetime | None = None,
        size: int = PAGE_SIZE,
    ) -> Page[AuditRow]:
        """A page of the audit rows of all stations."""
        audit = schema.audit.c
        query = select(schema.audit, schema.station.c.name.label("station")).join_from(
            schema.audit, schema.station
        )
        if event is not None:
            query = query.where(audit.event == event)
        within = []
        if since is not None:
            within.append(audit.at >= utc_text(since))
        if until is not None:
            within.append(audit.at < utc_text(until))
        if within:
            # The index finds the times of a station; the order of ids gives the newest rows first.
            within.append(audit.station_id.in_(select(schema.station.c.id)))
            row_id = beside_index(audit.id)
            bounds = select(func.min(row_id), func.max(row_id)).where(*within)
            with self._database.reading() as connection:
                low, high = connection.execute(bounds).one()
            if low is None:
                return Page((), None, None)
            query = query.where(audit.id >= low, audit.id <= high, *within)
        return self._page(AuditRow, query, audit.id, cursor, size)

    def _page(
        self,
        kind: type[_Row],
        query: Select[Any],
        row_id: Any,
        cursor: PageCursor,
        size: int,
    ) -> Page[_Row]:
        query = cursor.of(query.add_columns(row_id.label("cursor_id")), row_id)
        with self._database.reading() as connection:
            rows = [dict(row) for row in connection.execute(query.limit(size + 1)).mappings()]
        has_more = len(rows) > size
        rows = rows[:size]
        ids = [row.pop("cursor_id") for row in rows]
        return page_of([valid(kind, row) for row in rows], ids, cursor, has_more=has_more)


def page_of(
    rows: Sequence[_Row], ids: Sequence[int], cursor: PageCursor, *, has_more: bool
) -> Page[_Row]:
    """Page of rows with these ids, which are in the order of `PageCursor.of`. `has_more`: the
    query found more of them.
    """
    has_older, has_newer = has_more, cursor.before is not None
    if cursor.after is not None:
        rows, ids = rows[::-1], ids[::-1]
        has_older, has_newer = True, has_more
    return Page(
        tuple(rows),
        PageCursor(before=ids[-1]) if ids and has_older else None,
        PageCursor(after=ids[0]) if ids and has_newer else None,
    )


def _group_of(
    connection: Connection, by: By, shifts: Sequence[tuple[Span, str]]
) -> tuple[ColumnElement[Any], Callable[[Any], str | None]]:
    """Column to group runs by, and a function for the name of its values (None: no group)."""
    run = schema.run.c
    if by is By.SHIFT:
        begins = [utc_text(span.begin) for span, _ in shifts]
        ends = [utc_text(span.end) for span, _ in shifts]

        def shift_of(begun_at: str) -> str | None:
            at = bisect_right(begins, begun_at) - 1
            return shifts[at][1] if at >= 0 and begun_at < ends[at] else None

        return run.begun_at, shift_of
    recipe, socket, station = schema.recipe.c, schema.socket.c, schema.station.c
    # Sockets of several stations have the same names.
    several = connection.execute(select(station.id).limit(2)).all()[1:]
    of_socket = select(socket.id, *([station.name] if several else []), socket.name)
    column, query = {
        By.SOCKET: (run.socket_id, of_socket.join_from(schema.socket, schema.station)),
        By.STATION: (
            run.socket_id,
            select(socket.id, station.name).join_from(schema.socket, schema.station),
        ),
        By.RECIPE: (run.recipe_id, select(recipe.id, recipe.name, recipe.revision)),
        By.LOT: (run.lot_id, select(schema.lot.c.id, schema.lot.c.name)),
    }[by]
    names: dict[int | None, str] = {None: ""}
    names |= {row_id: ", ".join(parts) for row_id, *parts in connection.execute(query)}
    return column, names.get


def _holders(artifacts: Sequence[int]) -> Select[Any]:
    """Runs that made the last transfer to a target of their unit, with one of these images."""
    run, target = schema.run.c, schema.run_target
    write, later_write = schema.device_write.c, schema.device_write.alias()
    later = schema.run.alias()
    of_run = and_(write.run_id == run.id, write.target == target.c.target, write.what == FLASH)
    confirmed_at = (
        select(write.verified_at)
        .where(of_run)
        .order_by(write.id.desc())
        .limit(1)
        .correlate(schema.run, target)
        .scalar_subquery()
    )
    overwritten = (
        select(later.c.id)
        .join(later_write, later_write.c.run_id == later.c.id)
        .where(
            later.c.unit_id == run.unit_id,
            later.c.id > run.id,
            later_write.c.target == target.c.target,
            later_write.c.what == FLASH,
        )
        .correlate(schema.run, target)
    )
    return (
        select(
            schema.unit.c.serial,
            schema.unit.c.part,
            run.is_virtual,
            run.id.label("run_id"),
            run.state,
            run.begun_at,
            target.c.target,
            confirmed_at.is_not(None).label("is_confirmed"),
        )
        .join_from(target, schema.run, target.c.run_id == run.id)
        .join(schema.unit, run.unit_id == schema.unit.c.id)
        .where(target.c.artifact_id.in_(artifacts))
        .where(exists(select(write.id).where(of_run).correlate(schema.run, target)))
        .where(~exists(overwritten))
    )
