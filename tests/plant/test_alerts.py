"""Checks of stations: what is an alert, what is in order, and what cannot be judged."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, time, timedelta

import pytest

from flasher.documents import as_json
from flasher.plant.activity import Activity, RecentRun, SocketRuns, activities
from flasher.plant.alerts import CheckKind, CheckState, alerts, judge, overviews
from flasher.plant.bounds import Bounds
from flasher.plant.central import Central
from flasher.plant.stations import StationStatus
from flasher.station.health import LITTLE_BYTES
from flasher.station.records.model import RunState, Units, utc_text
from tests.plant.factory import READER, Plant, Sender
from tests.zones import in_zone

NOW = datetime(2026, 5, 17, 12, 0, tzinfo=UTC)
GOOD = StationStatus(
    station="line-2", role="flasher_line_2", reported_at=NOW - timedelta(seconds=10), now=NOW,
    silent_s=10.0, version="1.0", head_number=4, head_hash="a" * 64, head_at=utc_text(NOW),
    unsent=0, oldest_unsent_at="", clock_offset_s=0.1, disk_free_bytes=10**11, refusal="",
    other_refusal="", other_reported_at=None,
)  # fmt: skip
BOUNDS = Bounds(repeats=3)
OK, UNKNOWN, ALERT = CheckState.OK, CheckState.UNKNOWN, CheckState.ALERT


def runs(*codes: str, age_s: float = 60.0) -> SocketRuns:
    """The last runs of socket A, newest first."""
    return SocketRuns(
        "A",
        tuple(
            RecentRun(
                100 - number,
                "W2605002",
                RunState.PASS if code == "OK" else RunState.FAIL,
                code,
                NOW - timedelta(seconds=age_s + number),
            )
            for number, code in enumerate(codes)
        ),
    )


BUSY = Activity(Units(20, 20), Units(40, 40), (runs("OK", "OK", "OK"),))


def state_of(
    kind: CheckKind, status: StationStatus = GOOD, activity: Activity = BUSY
) -> CheckState:
    found = judge(status, activity, BOUNDS)
    (check,) = (each for each in found.checks if each.kind is kind)
    return check.state


def test_a_station_at_work_is_in_order() -> None:
    found = judge(GOOD, BUSY, BOUNDS)
    assert {each.kind for each in found.checks} == set(CheckKind)
    assert {each.state for each in found.checks} == {OK}
    assert found.state is OK
    assert list(alerts([found])) == []


@pytest.mark.parametrize(
    ("kind", "changes", "state"),
    [
        (CheckKind.REFUSED, {"refusal": "forked: row 3"}, ALERT),
        (CheckKind.SILENT, {"silent_s": 300.0}, OK),
        (CheckKind.SILENT, {"silent_s": 300.1}, ALERT),
        (CheckKind.CLOCK, {"clock_offset_s": -5.0}, OK),
        (CheckKind.CLOCK, {"clock_offset_s": -5.1}, ALERT),
        (CheckKind.CLOCK, {"clock_offset_s": None}, UNKNOWN),
        (CheckKind.CLOCK, {"silent_s": 301.0}, UNKNOWN),
        (CheckKind.DISK, {"disk_free_bytes": LITTLE_BYTES}, OK),
        (CheckKind.DISK, {"disk_free_bytes": LITTLE_BYTES - 1}, ALERT),
        (CheckKind.DISK, {"disk_free_bytes": None}, UNKNOWN),
        (CheckKind.DISK, {"silent_s": 301.0}, UNKNOWN),
        (CheckKind.UNSENT, {"silent_s": 301.0}, UNKNOWN),
    ],
)
def test_bounds(kind: CheckKind, changes: dict[str, object], state: CheckState) -> None:
    assert state_of(kind, replace(GOOD, **changes)) is state  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("age_s", "offset_s", "silent_s", "state"),
    [
        (3600, 0.0, 10.0, OK),
        (3601, 0.0, 10.0, ALERT),
        (3601, -2.0, 10.0, OK),  # the station's clock is late: the row is younger
        (60, 0.0, 301.0, UNKNOWN),
        (3601, 0.0, 301.0, ALERT),
    ],
)
def test_rows_that_wait(age_s: int, offset_s: float, silent_s: float, state: CheckState) -> None:
    oldest = utc_text(NOW - timedelta(seconds=age_s))
    status = replace(
        GOOD, unsent=7, oldest_unsent_at=oldest, clock_offset_s=offset_s, silent_s=silent_s
    )
    assert state_of(CheckKind.UNSENT, status) is state


def test_a_station_that_never_connected_is_not_known() -> None:
    status = replace(
        GOOD, reported_at=None, silent_s=None, unsent=None, clock_offset_s=None,
        disk_free_bytes=None, oldest_unsent_at=None,
    )  # fmt: skip
    found = judge(status, Activity(), BOUNDS)
    assert {each.state for each in found.checks} == {UNKNOWN}
    assert found.state is UNKNOWN


@pytest.mark.parametrize(
    ("units", "passed", "state"),
    [(0, 0, UNKNOWN), (19, 0, UNKNOWN), (20, 18, OK), (20, 17, ALERT)],
)
def test_yield_needs_enough_units(units: int, passed: int, state: CheckState) -> None:
    activity = replace(BUSY, shift=Units(units, passed))
    assert state_of(CheckKind.YIELD, activity=activity) is state


@pytest.mark.parametrize(
    ("sockets", "state"),
    [
        ([runs("NO_ANSWER", "NO_ANSWER", "NO_ANSWER")], ALERT),
        ([runs("OK", "OK", "OK"), runs("REFUSED", "REFUSED", "REFUSED")], ALERT),
        ([runs("NO_ANSWER", "REFUSED", "NO_ANSWER")], OK),
        ([runs("NO_ANSWER", "NO_ANSWER", "OK")], OK),
        ([runs("NO_ANSWER", "NO_ANSWER")], UNKNOWN),
        ([runs("NO_ANSWER", "NO_ANSWER"), runs("OK", "OK", "OK")], OK),
        ([runs("NO_ANSWER", "NO_ANSWER", "NO_ANSWER", age_s=86_400.0)], UNKNOWN),
        ([], UNKNOWN),
    ],
)
def test_a_code_that_repeats(sockets: list[SocketRuns], state: CheckState) -> None:
    assert state_of(CheckKind.REPEATED, activity=replace(BUSY, sockets=tuple(sockets))) is state


def test_times_are_in_utc_in_whatever_time_zone_the_server_is(plant: Plant) -> None:
    with plant.connect() as owner:
        owner.execute(f"ALTER DATABASE {plant.database} SET timezone = 'Asia/Shanghai'".encode())
        owner.execute("UPDATE plant_station SET reported_at = '2026-05-17 12:00Z'")
    assert as_json(plant.status())["reported_at"] == "2026-05-17T12:00:00Z"


def test_yield_and_last_runs_are_those_of_each_station(plant: Plant, sender: Sender) -> None:
    """The bench begins at 9:00; the shift at 10:00."""
    other = plant.sender("line-3")
    sender.bench.make(RunState.FAIL, "W2605003")
    sender.bench.clock.go_on(7200)
    sender.bench.make(RunState.FAIL, "W2605002")
    sender.bench.make(RunState.PASS, "W2605002")
    sender.bench.make(RunState.FAIL, "W2605004", "B")
    other.bench.make(serial="W2605005")
    for each in (sender, other):
        each.send()
    other.close()
    with (
        in_zone("UTC"),
        closing(Central(plant.url(READER))) as central,
        central.reading() as connection,
    ):
        found = activities(connection, [time(10)], NOW, 2)
        night = activities(connection, [time(8)], NOW + timedelta(hours=13), 1)["line-3"]
        (two, three) = overviews(connection, BOUNDS, [time(6)], NOW)
    assert (found["line-2"].shift, found["line-2"].day) == (Units(2, 1), Units(3, 1))
    assert (found["line-3"].shift, found["line-3"].day) == (Units(), Units(1, 1, 1))
    assert as_json(found["line-3"])["day"]["passed"] == 1
    assert [len(each.runs) for each in found["line-2"].sockets] == [2, 1]
    last = found["line-2"].last_run
    assert last is not None
    assert (last.serial, last.code) == ("W2605004", "NO_ANSWER")
    assert (night.shift.units, night.day.units) == (1, 0)  # it began on the day before
    assert (two.status.station, three.status.station) == ("line-2", "line-3")
    checks = {each.kind: each.state for each in two.checks}
    assert checks[CheckKind.YIELD] is UNKNOWN
    assert checks[CheckKind.UNSENT] is OK


def test_runs_of_a_clock_that_was_a_year_ahead_hide_no_recent_ones(
    plant: Plant, sender: Sender
) -> None:
    bench = sender.bench
    right = bench.clock.now
    bench.clock.now += timedelta(days=365)
    for number in range(3):
        bench.make(serial=f"W260501{number}")
    bench.clock.now = right
    bench.store.release_clock("jo", "it was a year ahead")
    for number in range(3):
        bench.make(RunState.FAIL, f"W260500{number + 2}")
    sender.send()
    with (
        in_zone("UTC"),
        closing(Central(plant.url(READER))) as central,
        central.reading() as connection,
    ):
        found = activities(connection, [time(6), time(14)], NOW, 3)["line-2"]
    assert (found.shift, found.day) == (Units(3, 0), Units(3, 0))
    assert found.last_run is not None
    assert found.last_run.serial == "W2605004"
    assert state_of(CheckKind.REPEATED, activity=found) is ALERT
