"""Checks of each station of a plant: refused records, silence, backlog, yield, codes, clock, disk.

A check that cannot be judged is neither an alert nor in order. What a station reported itself is
known only while it reports.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, time, timedelta
from enum import StrEnum
from typing import Final

from sqlalchemy import Connection

from flasher.i18n import text
from flasher.plant.activity import Activity, activities
from flasher.plant.bounds import Bounds
from flasher.plant.stations import StationStatus, statuses
from flasher.protocol.text import printable
from flasher.station.records.model import RunState, utc_moment
from flasher.validation import json_keys


class CheckKind(StrEnum):
    """What is checked."""

    REFUSED = "refused"
    """The database refuses the station's audit trail."""
    SILENT = "silent"
    """The station has not reported."""
    UNSENT = "unsent"
    """Records wait at the station."""
    YIELD = "yield"
    """Units of the current shift that passed in their last run."""
    REPEATED = "repeated"
    """The last runs of a socket ended with the same code, and not with a PASS."""
    CLOCK = "clock"
    """The station's clock differs from the database's."""
    DISK = "disk"
    """Free disk space of the station."""


class CheckState(StrEnum):
    """Result of a check."""

    OK = "ok"
    UNKNOWN = "unknown"
    """It cannot be judged: no report, or too few runs."""
    ALERT = "alert"


@dataclass(frozen=True)
class StationCheck:
    """A check of a station."""

    kind: CheckKind
    state: CheckState
    text: str


@json_keys("status activity checks state")
@dataclass(frozen=True)
class StationOverview:
    """A station with its runs and checks."""

    status: StationStatus
    activity: Activity
    checks: tuple[StationCheck, ...]

    @property
    def state(self) -> CheckState:
        """The worst one of its checks."""
        return max((each.state for each in self.checks), key=_ORDER.index, default=CheckState.OK)


_ORDER: Final = (CheckState.OK, CheckState.UNKNOWN, CheckState.ALERT)


def overviews(
    connection: Connection, bounds: Bounds, shifts: Sequence[time], now: datetime
) -> list[StationOverview]:
    """All stations, by name. `now` gives the time zone of day and shift."""
    found = activities(connection, shifts, now, bounds.repeats)
    return [
        judge(status, found.get(status.station, Activity()), bounds)
        for status in statuses(connection)
    ]


def judge(status: StationStatus, activity: Activity, bounds: Bounds) -> StationOverview:
    """Check a station."""
    found = {
        CheckKind.REFUSED: _refused(status, bounds),
        CheckKind.SILENT: _silent(status, bounds),
        CheckKind.UNSENT: _unsent(status, bounds),
        CheckKind.YIELD: _yield(activity, bounds),
        CheckKind.REPEATED: _repeated(status.now, activity, bounds),
        CheckKind.CLOCK: _clock(status, bounds),
        CheckKind.DISK: _disk(status, bounds),
    }
    checks = tuple(StationCheck(kind, *judged) for kind, judged in found.items())
    return StationOverview(status, activity, checks)


_Judged = tuple[CheckState, str]


def _alert_if(is_alert: bool) -> CheckState:  # noqa: FBT001  it is the one argument
    return CheckState.ALERT if is_alert else CheckState.OK


def _refused(status: StationStatus, bounds: Bounds) -> _Judged:
    if status.refusal:
        reason = printable(status.refusal)
        return CheckState.ALERT, text("its records are refused: {reason}", reason=reason)
    if status.is_forked(bounds.silent_s):
        reason = printable(status.other_refusal)
        return CheckState.ALERT, text(
            "the records of another PC are refused: {reason}", reason=reason
        )
    if status.reported_at is None:
        return CheckState.UNKNOWN, text("has never connected")
    return CheckState.OK, text("its records are accepted")


def _silent(status: StationStatus, bounds: Bounds) -> _Judged:
    if status.silent_s is None:
        return CheckState.UNKNOWN, text("has never connected")
    seconds = status.silent_s
    if seconds > bounds.silent_s:
        sentence = text("silent for {duration}", duration=lasting(seconds))
        return CheckState.ALERT, sentence
    sentence = text("reported {duration} ago", duration=lasting(seconds))
    return CheckState.OK, sentence


def _is_stale(status: StationStatus, bounds: Bounds) -> bool:
    return status.silent_s is None or status.silent_s > bounds.silent_s


def _unsent(status: StationStatus, bounds: Bounds) -> _Judged:
    if status.unsent and status.oldest_unsent_at:
        # By the station's clock, as the time of the record.
        here = status.now + timedelta(seconds=status.clock_offset_s or 0.0)
        age_s = (here - utc_moment(status.oldest_unsent_at)).total_seconds()
        sentence = text(
            "{count} rows wait, the oldest for {duration}",
            count=status.unsent,
            duration=lasting(max(age_s, 0.0)),
        )
        if age_s > bounds.unsent_s:
            return CheckState.ALERT, sentence
        if not _is_stale(status, bounds):
            return CheckState.OK, sentence
    if _is_stale(status, bounds) or status.unsent is None:
        return CheckState.UNKNOWN, text("not known while it is silent")
    return CheckState.OK, text("everything is sent")


def _yield(activity: Activity, bounds: Bounds) -> _Judged:
    shift = activity.shift
    if shift.units < bounds.units_min:
        sentence = text(
            "too few units in this shift: {count} of {least}",
            count=shift.units,
            least=bounds.units_min,
        )
        return CheckState.UNKNOWN, sentence
    sentence = text(
        "{passed} of {units} units of this shift passed", passed=shift.passed, units=shift.units
    )
    return _alert_if(100 * shift.passed < bounds.yield_min_percent * shift.units), sentence


def _repeated(now: datetime, activity: Activity, bounds: Bounds) -> _Judged:
    """The worst socket."""
    since = now - timedelta(seconds=bounds.repeats_within_s)
    found = []
    has_enough = False
    for socket in activity.sockets:
        last = [run for run in socket.runs if run.begun_at >= since][: bounds.repeats]
        if len(last) < bounds.repeats:
            continue
        has_enough = True
        codes = {run.code for run in last if run.state is not RunState.PASS}
        if len(codes) == 1 and all(run.state is not RunState.PASS for run in last):
            found.append(f"{socket.name} {codes.pop()}")
    if found:
        sentence = text(
            "the last {count} runs ended alike: {sockets}",
            count=bounds.repeats,
            sockets=printable(", ".join(found)),
        )
        return CheckState.ALERT, sentence
    if not has_enough:
        sentence = text("no socket has {count} recent runs", count=bounds.repeats)
        return CheckState.UNKNOWN, sentence
    return CheckState.OK, text("no code repeats")


def _clock(status: StationStatus, bounds: Bounds) -> _Judged:
    if status.clock_offset_s is None or _is_stale(status, bounds):
        return CheckState.UNKNOWN, text("not known while it is silent")
    sentence = text("its clock differs by {seconds:+.1f} s", seconds=status.clock_offset_s)
    return _alert_if(abs(status.clock_offset_s) > bounds.clock_s), sentence


def _disk(status: StationStatus, bounds: Bounds) -> _Judged:
    if status.disk_free_bytes is None or _is_stale(status, bounds):
        return CheckState.UNKNOWN, text("not known while it is silent")
    sentence = text("{size:.1f} GiB free", size=status.disk_free_bytes / 1024**3)
    return _alert_if(status.disk_free_bytes < bounds.disk_bytes), sentence


def lasting(seconds: float) -> str:
    """A duration in its largest unit."""
    for limit, size, name in ((120, 1, "s"), (7200, 60, "min"), (172_800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / size:.0f} {name}"
    return f"{seconds / 86_400:.0f} d"


def alerts(stations: Iterable[StationOverview]) -> Iterator[tuple[str, StationCheck]]:
    """All alerts, with the names of their stations."""
    for each in stations:
        for check in each.checks:
            if check.state is CheckState.ALERT:
                yield each.status.station, check
