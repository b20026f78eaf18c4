"""Supervisor pages: runs, units, yield, times, images and audit trail from the records.

The query of an address becomes a page. Times are the server's local time; pages state the zone.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, time, timedelta
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from threading import Thread
from time import sleep
from typing import Any, Final, NamedTuple
from urllib.parse import urlencode

from flasher.errors import FlasherError, UsageError
from flasher.i18n import text
from flasher.report.base import Status
from flasher.report.chart import WIDTHS, histogram
from flasher.report.explain_page import status_of, story_context
from flasher.report.scale import figure_text
from flasher.station import codes
from flasher.station.certificate import (
    RUN_WORDS,
    UNIT_WORDS,
    limits_of,
    number,
    proven,
    render_certificate,
    sheet,
    verdict_of,
)
from flasher.station.certificate_check import check_certificate
from flasher.station.records import chain
from flasher.station.records.capability import VALUES_MIN
from flasher.station.records.errors import NotFoundError, RecordError, UnprovenError
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import (
    CLOCK_TOLERANCE,
    TORN_TRACE,
    TRACE,
    AttachmentFile,
    Measurement,
    RunDetails,
    RunFilter,
    RunId,
    RunState,
    StepName,
    UnitState,
    local_moment,
)
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import HOLDERS_COUNTED, By, Overview, Page
from flasher.station.records.rollup import Rollup
from flasher.station.records.store import Store
from flasher.station.records.yields import Span
from flasher.station.reports import Report, csv_text
from flasher.station.sealed import CERTIFICATE_MAX_SIZE
from flasher.station.shift_counts import DEFAULT_SHIFTS
from flasher.station.stories import explained
from flasher.trace.figures import Distribution
from flasher.trace.story import Story
from flasher.translation import Translator, translator
from flasher.web.charts import SERIES_MAX, lines, stacked_bars
from flasher.web.pages import page_text
from flasher.web.query_processes import RUN, Answer, Question

USUAL_DAYS: Final = 30
"""Default period of pages with figures: this number of days with runs."""
MEASURED_DAYS: Final = 1
"""Default period of measurements: no sums are kept of them."""
CAUSES_DRAWN: Final = 12
_HOURS_UP_TO: Final = timedelta(days=2)
_DAYS_UP_TO: Final = timedelta(days=62)
_WEEKS_UP_TO: Final = timedelta(days=430)
SPANS_MAX: Final = 400
YEARS: Final = range(2000, 2100)
"""Years of the times in a form. Periods around them are times too, with few enough shifts."""
CHECK: Final = "/certificate"
"""Path of the page that checks a certificate."""
UPLOADS: Final = {CHECK: CERTIFICATE_MAX_SIZE}
"""Maximum body size in bytes of pages that accept a file."""
_NAMES: Final = {
    "/runs": text("Runs"),
    "/units": text("Units"),
    "/yield": text("Yield and causes"),
    "/times": text("Times"),
    "/measurements": text("Measurements"),
    "/images": text("Images"),
    "/audit": text("Audit trail"),
    CHECK: text("Check a certificate"),
}
"""Titles in the menu."""
_SIGN_INS: Final = {"/sign-ins": text("Sign-ins")}
"""Title in the menu if people sign in."""
BY_WORDS: Final = {
    By.SOCKET: text("socket"),
    By.RECIPE: text("recipe"),
    By.LOT: text("lot"),
    By.SHIFT: text("shift"),
    By.STATION: text("station"),
}
_TWICE_MAX: Final = 5
"""Units that passed at two stations that the first page shows."""
PART_SIZE: Final = 2000
"""Rows of a spreadsheet file that are read at once."""
_CSV: Final = "text/csv; charset=utf-8"
_FILES: Final[dict[str, tuple[str, Callable[[Report], str]]]] = {
    "/runs.csv": (_CSV, Report.to_csv),
    "/runs.json": ("application/json", Report.to_json),
    "/runs.xml": ("application/xml", Report.to_junit),
}


class PartOfCauses(NamedTuple):
    """Row of the table of causes. `share`: cumulative share, from 0 to 1."""

    code: str
    meaning: str
    counts: tuple[int, ...]
    total: int
    share: float


@dataclass(frozen=True)
class SupervisorPages:
    """Renders the supervisor pages. `shifts`: local start times."""

    store: Store
    shifts: Sequence[time] = DEFAULT_SHIFTS
    now: Callable[[], datetime] = lambda: datetime.now().astimezone()

    @cached_property
    def overview(self) -> Overview:
        return Overview(self.store.database)

    def answer(self, question: Question) -> Answer:
        """Render a page; an error page if there is none."""
        try:
            return self.routes()[question.path](self, question)
        except NotFoundError as error:
            return self._trouble(question, 404, error)
        except (UsageError, UnprovenError) as error:
            return self._trouble(question, 400, error)
        except RecordError as error:
            return self._trouble(question, 503, error)

    @staticmethod
    def routes() -> Mapping[str, Callable[[Any, Question], Answer]]:
        """Methods by route."""
        return PAGES

    @property
    def names(self) -> Mapping[str, str]:
        """Titles in the menu, by path."""
        return _NAMES

    def _trouble(self, question: Question, status: int, error: FlasherError) -> Answer:
        return self._page(question, "trouble.html", http=status, error=error, path="")

    def _page(
        self, question: Question, template: str, *, http: int = 200, **context: Any
    ) -> Answer:
        translate = translator(question.language)
        shown = frame(question, self.now(), self.names) | context
        text = page_text(template, translate, question.token, outcomes=RUN_WORDS, **shown)
        return Answer(text.encode("utf-8", "backslashreplace"), status=http)

    # -- runs -------------------------------------------------------------------------------------

    def runs(self, question: Question) -> Answer:
        chosen = filter_of(question)
        page = self.overview.runs(chosen, cursor_of(question))
        return self._page(
            question,
            "runs.html",
            page=page,
            codes=list(codes.CODES),
            **self._choices(),
            released=self.store.read.released(),
            passed_twice=self.store.passed_twice(_TWICE_MAX),
            warning=Status.WARNING,
        )

    def file_of_runs(self, question: Question) -> Answer:
        media_type, make = _FILES[question.path]
        if make is Report.to_csv:
            page = self.overview.runs(filter_of(question), _oldest(question), PART_SIZE)
            released = self.store.read.released()
            return _part(question, page, [run.marked(released) for run in page.rows[::-1]])
        report = Report(self.store, filter_of(question))
        name = question.path.lstrip("/")
        return Answer(make(report).encode("utf-8"), media_type, file_name=name)

    def run(self, question: Question) -> Answer:
        """The page of the run's unit, at this run."""
        run = self.store.read.run(RunId(question.run)).run
        unit = {"serial": run.serial, "part": run.part, "before": str(run.run_id + 1)}
        return Answer(location=f"/units?{urlencode(unit)}")

    def trace(self, question: Question) -> Answer:
        details = self.store.read.run(RunId(question.run))
        found = self._story(details)
        if not isinstance(found, Story):
            raise NotFoundError(f"There is no story of run {question.run}.", cause=found)
        return self._page(
            question,
            "explain.html",
            path="/units",
            **story_context(found, translator(question.language)),
        )

    def _story(self, details: RunDetails) -> Story | str:
        for file in details.attachments:
            if _is_trace(file):
                return explained(self.store.files, file)
        return "it has no trace"

    # -- units ------------------------------------------------------------------------------------

    def units(self, question: Question) -> Answer:
        serial = question.fields.get("serial", "")
        parts = self.overview.parts(serial) if serial else ()
        if serial and not parts:
            return Answer(location=f"/runs?{urlencode({'search': serial})}")
        part = question.fields.get("part", "")
        if part not in parts:
            part = parts[0] if len(parts) == 1 else ""
        if not part:
            return self._page(question, "units.html", serial=serial, parts_found=parts)
        page = self.overview.life(serial, part, cursor_of(question))
        if not page.rows:
            raise NotFoundError(f"There is no such run of {serial}.")
        newest = self.overview.life(serial, part, PageCursor(), 1).rows[0]
        shown = page.rows[0]
        story = self._story(shown)
        state_status, state, _ = UNIT_WORDS[UnitState.after(newest.run.state)]
        return self._page(
            question,
            "unit.html",
            serial=serial,
            part=part,
            state=state,
            state_status=state_status,
            is_virtual=newest.run.is_virtual,
            is_over=newest.run.state is not RunState.RUNNING,
            page=page,
            shown=shown,
            released=self.store.read.released(),
            story=story if isinstance(story, Story) else None,
            no_story=story if isinstance(story, str) else "",
            drawn=None
            if isinstance(story, str)
            else story_context(story, translator(question.language)),
            story_status=status_of(story.verdict.cause) if isinstance(story, Story) else None,
            has_trace=lambda details: any(map(_is_trace, details.attachments)),
            limits_of=limits_of,
            verdict_of=verdict_of,
            number=number,
        )

    def certificate(self, question: Question) -> Answer:
        fields = question.fields
        life = self.store.read.unit(fields.get("serial", ""), fields.get("part"))
        now = datetime.now(UTC)
        made = sheet(life, now, proven(self.store, life, now))
        return self._page(question, "certificate.html", path="/units", **made)

    def file_of_certificate(self, question: Question) -> Answer:
        """Download of a certificate, to check it later."""
        fields = question.fields
        life = self.store.read.unit(fields.get("serial", ""), fields.get("part"))
        now = datetime.now(UTC)
        made = render_certificate(life, now, proven(self.store, life, now), question.language)
        name = re.sub(r"[^\w.-]", "_", life.serial, flags=re.ASCII)
        return Answer(made.encode("utf-8"), file_name=f"{name}.html")

    def check(self, question: Question) -> Answer:
        """Check whether an uploaded certificate is signed, unchanged, and of these records."""
        found = error = None
        if question.body.strip():
            try:
                found = check_certificate(self.store, question.body)
            except (UsageError, UnprovenError) as wrong:
                error = wrong
        return self._page(question, "check.html", found=found, error=error)

    # -- images -----------------------------------------------------------------------------------

    def images(self, question: Question) -> Answer:
        wanted, sha256 = question.fields.get("image", ""), question.fields.get("sha256", "")
        images = self.overview.images(wanted)
        if not sha256 and wanted and len({each.sha256 for each in images}) == 1:
            sha256 = images[0].sha256
        chosen = [each for each in self.overview.images(sha256) if each.sha256 == sha256]
        return self._page(
            question,
            "images.html",
            images=images,
            chosen=chosen[0] if chosen else None,
            page=self.overview.holders(sha256, cursor_of(question)) if chosen else None,
            count=self.overview.holder_count(sha256) if chosen else 0,
            counted_up_to=HOLDERS_COUNTED,
        )

    def file_of_holders(self, question: Question) -> Answer:
        sha256 = question.fields.get("sha256", "")
        page = self.overview.holders(sha256, _oldest(question), PART_SIZE)
        return _part(question, page, page.rows[::-1])

    # -- figures ----------------------------------------------------------------------------------

    def _choices(self) -> dict[str, Any]:
        """What the form of a filter offers."""
        return {
            "recipes": self.overview.recipes(),
            "sockets": self.overview.sockets(),
            "stations": self.store.read.stations(),
        }

    def _figured(self, question: Question, days: int = USUAL_DAYS) -> tuple[RunFilter, Span]:
        """Filter and period of a page with figures; by default the last `days`."""
        chosen = filter_of(question)
        # The newest run of the filter is the last of any period, or the period has none.
        last = None if chosen.until else self.overview.last_begin(replace(chosen, since=None))
        latest = self.now() + CLOCK_TOLERANCE
        if last is not None and last > latest:  # of a clock that was ahead
            last = self.overview.last_begin(replace(chosen, since=None, until=latest)) or last
        if last is not None and chosen.since is not None and last < chosen.since:
            last = None
        end = chosen.until or last or self.now()
        if chosen.until is None:
            end += timedelta(microseconds=1)
        begin = chosen.since or end - timedelta(days=days)
        begin = max(begin, self.store.figures_begin() or begin)
        return replace(chosen, since=begin, until=end), Span(begin, end)

    def yields(self, question: Question) -> Answer:
        chosen, span = self._figured(question)
        translate = translator(question.language)
        spans = list(spans_of(span))
        yields, whole = self.overview.yields(chosen, spans)
        rows = [(at, each) for at, each in zip(spans, yields, strict=True) if each.units]
        by = By(question.fields["by"]) if question.fields.get("by") in set(By) else By.SOCKET
        groups, causes = self._causes(chosen, span, by, translate)
        return self._page(
            question,
            "yield.html",
            span=span,
            rows=rows,
            name_of=_name_of,
            whole=whole,
            chart=lines(
                translate(text("Yield over time")),
                [_name_of(at).removeprefix(f"{span.end.astimezone():%Y-}") for at, _ in rows],
                {
                    "end": [100 * (each.yield_share or 0) for _, each in rows],
                    "first": [100 * (each.first_pass_share or 0) for _, each in rows],
                },
                " %",
            )
            if rows
            else "",
            by=by,
            by_words=BY_WORDS,
            groups=groups,
            causes=causes,
            causes_chart=stacked_bars(
                translate(text("Causes")),
                [row.code for row in causes[:CAUSES_DRAWN]],
                {
                    f"{at} {group}": [row.counts[at] for row in causes[:CAUSES_DRAWN]]
                    for at, group in enumerate(groups)
                },
            )
            if causes
            else "",
            **self._choices(),
        )

    def _causes(
        self, chosen: RunFilter, span: Span, by: By, translate: Translator
    ) -> tuple[list[str], list[PartOfCauses]]:
        """Names of the groups, and the codes by descending frequency."""
        shifts = list(shifts_of(span, self.shifts)) if by is By.SHIFT else []
        found = self.overview.causes(chosen, by, shifts)
        sizes: Counter[str] = sum(found.values(), Counter())
        groups = [name for name, _ in sizes.most_common()]
        kept = groups if len(groups) <= SERIES_MAX else groups[: SERIES_MAX - 1]
        has_others = len(kept) < len(groups)
        everything, so_far = sizes.total(), 0
        rows = []
        for code, counts in sorted(found.items(), key=lambda item: (-item[1].total(), item[0])):
            so_far += counts.total()
            shown = [counts[name] for name in sorted(kept)]
            if has_others:
                shown.append(counts.total() - sum(shown))
            meaning = codes.CODES[code].meaning if code in codes.CODES else ""
            share = so_far / everything
            rows.append(PartOfCauses(code, meaning, tuple(shown), counts.total(), share))
        names = [name or translate(text("no lot")) for name in sorted(kept)]
        return [*names, *([translate(text("others"))] if has_others else [])], rows

    def times(self, question: Question) -> Answer:
        chosen, span = self._figured(question)
        found = self.overview.step_times(chosen)
        order = {step.value: at for at, step in enumerate(StepName)}
        rows = [
            (
                name,
                Distribution.of(found[name]),
                {kind: histogram(found[name], width) for kind, width in WIDTHS.items()},
            )
            for name in sorted(found, key=lambda name: order.get(name.split()[0], 99))
        ]
        return self._page(
            question,
            "times.html",
            span=span,
            rows=rows,
            **self._choices(),
        )

    def measurements(self, question: Question) -> Answer:
        translate = translator(question.language)
        chosen, span = self._figured(question, MEASURED_DAYS)
        return self._page(
            question,
            "measurements.html",
            span=span,
            rows=self.store.read.capabilities(chosen),
            limits_of=lambda each: limits_of(
                Measurement(each.name, each.mean, each.unit, each.low, each.high)
            ),
            figure=lambda value: translate.numbers(figure_text(value)),
            values_min=VALUES_MIN,
            **self._choices(),
        )

    def file_of_measurements(self, question: Question) -> Answer:
        report = Report(self.store, self._figured(question, MEASURED_DAYS)[0])
        made = report.to_measurements_csv()
        return Answer(made.encode("utf-8"), _CSV, file_name="measurements.csv")

    # -- the audit trail --------------------------------------------------------------------------

    def audit(self, question: Question) -> Answer:
        page = self.overview.audit(
            cursor_of(question),
            event=question.fields.get("event"),
            since=moment_in(question, "from"),
            until=moment_in(question, "to"),
        )
        return self._page(
            question,
            "audit.html",
            page=page,
            events=chain.EVENTS,
            content_of=lambda row: ", ".join(_facts(row.data)),
        )


def frame(question: Question, now: datetime, names: Mapping[str, str] = _NAMES) -> dict[str, Any]:
    """Values of the frame that all supervisor pages share. `names`: titles in the menu."""
    return {
        "layout": "supervise.html",
        "menu": {**names} if question.sign_in is None else {**names, **_SIGN_INS},
        "path": question.path,
        "fields": question.fields,
        "here": _Addresses(question),
        "zone": _zone(now),
        "at": lambda moment: "" if moment is None else f"{moment.astimezone():%Y-%m-%d %H:%M:%S}",
        "sign_in": question.sign_in,
    }


Place = tuple[str, Path, KeyLocations]


def place_of(store: Store) -> Place:
    """Database URL, folder of files, and key locations of opened records."""
    url = store.database.location.url.render_as_string(hide_password=False)
    return url, store.files.folder, store.signer.key_locations


def open_supervisor(
    url: str,
    folder: Path,
    key_locations: KeyLocations,
    shifts: Sequence[time],
    kind: type[Store] = Store,
    make: Callable[[Store, Sequence[time]], SupervisorPages] = SupervisorPages,
    *,
    keeps_sums: bool = False,
) -> SupervisorPages:
    """Open records read-only. With `keeps_sums`, the daily sums are updated while this process
    runs. Raises as `Store.open`.
    """
    store = kind.open(
        url, station="pages", folder=folder, read_only=True, key_locations=key_locations
    )
    if keeps_sums:
        work = Rollup(store.database).keep_up
        now = partial(datetime.now, UTC)
        Thread(target=work, args=(now, sleep), name="sums", daemon=True).start()
    return make(store, shifts)


PAGES: Final[Mapping[str, Callable[[SupervisorPages, Question], Answer]]] = {
    "/runs": SupervisorPages.runs,
    **dict.fromkeys(_FILES, SupervisorPages.file_of_runs),
    f"/runs/{RUN}": SupervisorPages.run,
    f"/runs/{RUN}/trace": SupervisorPages.trace,
    "/units": SupervisorPages.units,
    "/units/certificate": SupervisorPages.certificate,
    "/units/certificate.html": SupervisorPages.file_of_certificate,
    CHECK: SupervisorPages.check,
    "/images": SupervisorPages.images,
    "/images.csv": SupervisorPages.file_of_holders,
    "/yield": SupervisorPages.yields,
    "/times": SupervisorPages.times,
    "/measurements": SupervisorPages.measurements,
    "/measurements.csv": SupervisorPages.file_of_measurements,
    "/audit": SupervisorPages.audit,
}
"""Methods by route."""


# -- from the form ---------------------------------------------------------------------------------


def filter_of(question: Question) -> RunFilter:
    """Parse the filter of a form. Raises UsageError for an invalid time or outcome."""
    fields = question.fields
    outcome = fields.get("outcome")
    if outcome is not None and outcome not in set(RunState):
        raise UsageError("There is no such outcome.", remedy="Choose one of the form.")
    return RunFilter(
        lot=fields.get("lot"),
        recipe=fields.get("recipe"),
        since=moment_in(question, "from"),
        until=moment_in(question, "to"),
        serial=fields.get("serial"),
        part=fields.get("part"),
        search=fields.get("search"),
        state=None if outcome is None else RunState(outcome),
        code=fields.get("code"),
        socket=fields.get("socket"),
        station=fields.get("station"),
    )


def moment_in(question: Question, name: str) -> datetime | None:
    """Parse a time of a form. Raises UsageError."""
    text = question.fields.get(name)
    if text is None:
        return None
    moment = None
    with suppress(ValueError, OverflowError):
        moment = local_moment(datetime.fromisoformat(text))
    if moment is None or moment.year not in YEARS:
        first, last = YEARS[0], YEARS[-1]
        raise UsageError(
            f"{text!a:.40} is not a time of the years {first} to {last}.",
            remedy="Write 2026-05-17 or 2026-05-17T06:00.",
        )
    return moment


def _oldest(question: Question) -> PageCursor:
    """Start of a part of a file; the first part starts at the oldest row."""
    return PageCursor(after=cursor_of(question).after or 0)


def _part(question: Question, page: Page[Any], rows: Sequence[object]) -> Answer:
    """A part of a spreadsheet file; the first part has the column names."""
    name = {"/images.csv": "units.csv"}.get(question.path, question.path.lstrip("/"))
    heads = [] if "after" in question.fields else [*map(vars, rows[:1])]
    text = csv_text([*heads, *(vars(row).values() for row in rows)])
    after = "" if page.newer is None else str(page.newer.after)
    return Answer(text.encode("utf-8"), _CSV, file_name=name, after=after)


def cursor_of(question: Question) -> PageCursor:
    """Parse the page of a list."""
    return PageCursor(id_in(question, "before"), id_in(question, "after"))


def id_in(question: Question, name: str) -> int | None:
    """Parse the id of a row. None if it is none."""
    text = question.fields.get(name, "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 19 else None


class _Addresses:
    """Builds addresses of pages with the fields of the current form."""

    def __init__(self, question: Question) -> None:
        self._fields = {
            name: value
            for name, value in question.fields.items()
            if name not in ("before", "after")
        }

    def with_cursor(self, path: str, cursor: PageCursor | None = None, **more: str) -> str:
        """Address of the same list from a cursor on."""
        fields = self._fields | more
        if cursor is not None and cursor.before is not None:
            fields["before"] = str(cursor.before)
        if cursor is not None and cursor.after is not None:
            fields["after"] = str(cursor.after)
        return f"{path}?{urlencode(fields)}" if fields else path

    def of(self, path: str, **fields: object) -> str:
        """Address of another page in the same language."""
        lang = {"lang": self._fields["lang"]} if "lang" in self._fields else {}
        return f"{path}?{urlencode(fields | lang)}" if fields or lang else path


# -- spans of time ---------------------------------------------------------------------------------


def spans_of(whole: Span) -> Iterator[Span]:
    """Hours, days, weeks or months in local time, the finest that fit into a chart."""
    length = whole.end - whole.begin
    begin = whole.begin.astimezone()
    midnight = datetime.combine(begin, time())
    if length <= _HOURS_UP_TO:
        at = begin.replace(minute=0, second=0, microsecond=0, tzinfo=None)
        starts = (at + timedelta(hours=count) for count in range(SPANS_MAX))
    elif length <= _DAYS_UP_TO:
        starts = (midnight + timedelta(days=count) for count in range(SPANS_MAX))
    elif length <= _WEEKS_UP_TO:
        monday = midnight - timedelta(days=midnight.weekday())
        starts = (monday + timedelta(weeks=count) for count in range(SPANS_MAX))
    else:
        starts = (
            midnight.replace(
                year=midnight.year + (midnight.month - 1 + count) // 12,
                month=(midnight.month - 1 + count) % 12 + 1,
                day=1,
            )
            for count in range(SPANS_MAX)
        )
    yield from _between(map(local_moment, starts), whole.end)


def _between(starts: Iterable[datetime], end: datetime) -> Iterator[Span]:
    """Spans from each start to the next, up to the one that contains `end`."""
    before: datetime | None = None
    for start in starts:
        if start == before:
            continue  # an hour that summer time leaves out
        if before is not None:
            yield Span(before, start)
            if start >= end:
                return
        before = start


def shifts_of(whole: Span, shifts: Sequence[time]) -> Iterator[tuple[Span, str]]:
    """Shifts of a period, each with its start time as name."""
    day = datetime.combine(whole.begin.astimezone(), time()) - timedelta(days=1)
    days = (whole.end - whole.begin).days + 3
    starts = [
        datetime.combine(day + timedelta(days=count), each)
        for count in range(days)
        for each in sorted(shifts)
    ]
    for begin, end in pairwise(starts):
        span = Span(local_moment(begin), local_moment(end))
        if span.end > whole.begin and span.begin < whole.end:
            yield span, f"{begin:%H:%M}"


def _name_of(span: Span) -> str:
    begin = span.begin.astimezone()
    if span.end - span.begin < timedelta(hours=20):
        return f"{begin:%m-%d %H:%M}"
    return f"{begin:%Y-%m-%d}"


def _zone(now: datetime) -> str:
    offset = f"{now:%z}"
    return f"{now.tzname()} (UTC{offset[:3]}:{offset[3:5]})"


# -- words -----------------------------------------------------------------------------------------


def _is_trace(file: AttachmentFile) -> bool:
    return file.kind in (TRACE, TORN_TRACE)


def _facts(data: dict[str, Any]) -> Iterator[str]:
    """Content of an audit row as texts, without digests."""
    for name, value in data.items():
        if name == "digests" or value in ("", None):
            continue
        if isinstance(value, dict | list):
            yield f"{name}: {len(value)}"
        else:
            yield f"{name}: {value}"
