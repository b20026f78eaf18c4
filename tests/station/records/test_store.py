"""What a station does with its records from claim to finish, and after its own death."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, time, timedelta
from typing import Any

import pytest

from flasher.errors import UsageError
from flasher.station.recipe import Golden
from flasher.station.records.claims import is_due
from flasher.station.records.errors import (
    ClaimRefusedError,
    NotFoundError,
    RecordError,
    Refusal,
    StationBusyError,
)
from flasher.station.records.model import (
    Order,
    RunFilter,
    RunId,
    RunKind,
    RunState,
    StepState,
    UnitState,
    Verified,
)
from flasher.station.records.tally import Totals
from flasher.station.shift_counts import ShiftCounts, shift_began
from tests.loops import each
from tests.station.factory import BMS_VERSION, SERIAL, USUAL, Bench
from tests.zones import in_zone

GOLDEN = '\n[golden]\nserial_numbers = ["W2600001"]\nevery_h = 8\n'


def refusal(bench: Bench, serial: str = SERIAL, socket: str = "A", **more: Any) -> Refusal:
    with pytest.raises(ClaimRefusedError) as caught:
        bench.claim(serial, socket, **more)
    assert caught.value.remedy
    return caught.value.refusal


def test_a_finished_run_states_what_was_done(bench: Bench) -> None:
    bench.make(lot="L1")
    life = bench.store.read.unit(SERIAL)
    assert life.state is UnitState.PASS
    (details,) = life.runs
    run = details.run
    assert (run.state, run.kind, run.lot, run.operator) == (
        RunState.PASS,
        RunKind.PRODUCTION,
        "L1",
        "jo",
    )
    assert (run.station, run.socket, run.recipe_revision) == ("line-2", "A", "4")
    assert run.recipe_sha256 == bench.recipe.sha256
    assert run.duration_s == 8.0
    assert run.begun_at == datetime(2026, 5, 17, 9, 0, tzinfo=UTC)
    assert run.ended_at == run.begun_at + timedelta(seconds=8)
    assert run.verified is Verified.VERSION
    (target,) = details.targets
    assert target.image_sha256 == bench.recipe.targets[0].image.sha256
    assert target.version == BMS_VERSION
    (write,) = details.writes
    assert (write.what, write.read_back) == ("flash", BMS_VERSION)
    (file,) = details.attachments
    assert file.sha256 == run.log_sha256
    assert bench.store.files.read(file.sha256) == (bench.folder / file.name).read_bytes()
    assert not bench.store.examine().problems


def test_no_step_begins_before_the_one_before_it(bench: Bench) -> None:
    """A virtual unit measures durations in its own time, which passes faster."""
    run_id = bench.claim().run_id
    for name, duration_s in (("flash", 8.0), ("verify", 20.0)):
        bench.clock.go_on(9.0)
        bench.store.step(run_id, name, StepState.PASS, duration_s=duration_s)
    with bench.outsider() as other:
        query = "SELECT begun_at, begun_monotonic_s FROM step ORDER BY position"
        begun = other.execute(query).fetchall()
    assert begun == sorted(begun)
    assert begun[0] == begun[1]


def test_tries_of_a_step_are_counted(bench: Bench) -> None:
    run_id = bench.claim().run_id
    for name in ("flash", "flash", "write", "flash"):
        bench.store.step(run_id, name, StepState.PASS, duration_s=1.0)
    steps = bench.store.read.run(run_id).steps
    assert [(s.position, s.name, s.try_number) for s in steps] == [
        (1, "flash", 1),
        (2, "flash", 2),
        (3, "write", 1),
        (4, "flash", 3),
    ]


def test_finishing_again_with_the_same_ending_is_no_error(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    ending = bench.ending()
    bench.store.finish(run_id, ending)
    bench.store.finish(run_id, ending)
    with pytest.raises(RecordError):
        bench.store.finish(run_id, bench.ending(RunState.FAIL, "X"))
    assert bench.store.read.run(run_id).run.state is RunState.PASS
    assert not bench.store.examine().problems


def test_a_clock_that_is_set_back_spoils_no_record(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    bench.clock.now -= timedelta(days=2)
    bench.store.finish(run_id, bench.ending())
    run = bench.store.read.run(run_id).run
    assert run.ended_at == run.begun_at
    assert run.duration_s == 8.0


def test_numbers_of_units_of_a_part_are_known(bench: Bench) -> None:
    bench.make(RunState.PASS, "W2605002")
    assert bench.store.read.known("BAT-36", ["W2605001", "W2605002"]) == {"W2605002"}
    assert bench.store.read.known("BAT-48", ["W2605002"]) == set()


def test_runs_and_units_that_are_not_there_are_named(bench: Bench) -> None:
    with pytest.raises(NotFoundError, match="no unit W1"):
        bench.store.read.unit("W1")
    with pytest.raises(NotFoundError, match="no run 7"):
        bench.store.read.run(RunId(7))
    with pytest.raises(NotFoundError, match="no run 7"):
        bench.store.finish(RunId(7), bench.ending())
    run_id = bench.claim().run_id
    bench.work(run_id)
    ending = bench.ending()
    object.__setattr__(ending, "verified", {"obc": Verified.VERSION})
    with pytest.raises(NotFoundError, match="target obc"):
        bench.store.finish(run_id, ending)


def test_a_serial_number_is_unique_for_its_part_only(bench: Bench) -> None:
    bench.make()
    bench.use(USUAL.replace('"BAT-36"', '"BAT-48"'))
    assert bench.claim().kind is RunKind.PRODUCTION
    assert len(bench.store.read.unit(SERIAL, "BAT-48").runs) == 1
    with pytest.raises(NotFoundError, match="several parts"):
        bench.store.read.unit(SERIAL)
    assert bench.store.read.unit(SERIAL, "BAT-36").state is UnitState.PASS


# -- who may be claimed ---------------------------------------------------------------------------


def test_a_unit_and_a_socket_run_once_at_a_time(bench: Bench) -> None:
    bench.claim()
    assert refusal(bench, socket="B") is Refusal.UNIT_RUNNING
    assert refusal(bench, "W2605003") is Refusal.SOCKET_BUSY
    assert bench.claim("W2605003", "B").kind is RunKind.PRODUCTION
    with pytest.raises(NotFoundError):
        bench.store.read.unit("W2605004")


def test_a_refused_claim_leaves_nothing(bench: Bench) -> None:
    bench.claim()
    refusal(bench, "W2605009", lot="L9")
    assert not bench.store.read.units("W2605009")


@pytest.mark.parametrize("rule", ["block", "verify-only", "reflash-with-reason"])
def test_a_unit_that_has_passed_is_treated_as_the_recipe_states(bench: Bench, rule: str) -> None:
    bench.make()
    bench.use(f'duplicate = "{rule}"\n' + USUAL)
    if rule == "block":
        assert refusal(bench) is Refusal.DUPLICATE
    elif rule == "verify-only":
        assert bench.claim().kind is RunKind.VERIFY_ONLY
    else:
        assert refusal(bench) is Refusal.REASON_NEEDED
        claim = bench.claim(reason="customer return")
        assert claim.kind is RunKind.REFLASH
        states = [details.run.state for details in bench.store.read.unit(SERIAL).runs]
        assert states == [RunState.PASS, RunState.RUNNING]


def test_a_unit_that_failed_is_simply_made_again(bench: Bench) -> None:
    bench.make(RunState.FAIL)
    assert bench.claim().kind is RunKind.PRODUCTION


@pytest.mark.parametrize("state", [RunState.ERROR, RunState.ABORTED])
def test_after_an_open_end_the_device_decides(bench: Bench, state: RunState) -> None:
    bench.make(state)
    assert bench.store.read.unit(SERIAL).state is UnitState.RECHECK
    assert bench.claim().kind is RunKind.RECHECK


def test_a_lot_takes_no_more_units_than_it_has(bench: Bench) -> None:
    bench.use(USUAL + "\n[lot]\nquantity_max = 2\nrequired = true\n")
    assert refusal(bench) is Refusal.LOT_NEEDED
    bench.make(lot="L1")
    bench.make(RunState.FAIL, "W2605003", lot="L1")  # takes no place
    bench.claim("W2605004", "A", lot="L1")  # takes one while it runs
    assert refusal(bench, "W2605005", "B", lot="L1") is Refusal.LOT_FULL
    assert bench.claim("W2605006", "B", lot="L2").kind is RunKind.PRODUCTION


@pytest.mark.slow
def test_a_golden_unit_has_to_pass_on_each_socket_and_counts_in_no_figure(bench: Bench) -> None:
    bench.use(USUAL + GOLDEN)
    assert refusal(bench) is Refusal.GOLDEN_DUE
    bench.make(RunState.FAIL, "W2600001")
    assert refusal(bench) is Refusal.GOLDEN_DUE
    bench.make(RunState.PASS, "W2600001")
    bench.make()
    assert refusal(bench, "W2605003", "B") is Refusal.GOLDEN_DUE
    bench.clock.go_on(8 * 3600)
    assert refusal(bench, "W2605003") is Refusal.GOLDEN_DUE
    bench.make(RunState.PASS, "W2600001")  # again and again
    bench.make(RunState.PASS, "W2605003")
    figures = bench.store.read.figures()
    assert (figures.runs, figures.units, figures.passed) == (2, 2, 2)


@pytest.mark.slow
def test_a_golden_unit_that_passed_while_the_clock_was_ahead_counts_for_no_later_unit(
    bench: Bench,
) -> None:
    bench.use(USUAL + GOLDEN)
    right = bench.clock.now
    bench.clock.now += timedelta(days=365)
    bench.make(RunState.PASS, "W2600001")
    bench.clock.now = right
    bench.store.release_clock("jo", "it was a year ahead")
    assert refusal(bench) is Refusal.GOLDEN_DUE
    bench.make(RunState.PASS, "W2600001")
    bench.clock.go_on(-60)  # network time
    bench.make()
    bench.clock.go_on(9 * 3600)
    assert refusal(bench, "W2605003") is Refusal.GOLDEN_DUE


def test_wrong_scans_and_a_changed_recipe_begin_nothing(bench: Bench) -> None:
    for scan in ("", "W1", "' OR 1=1 --", "W2605002\n", "\u0000", "x" * 5000):
        assert refusal(bench, scan) is Refusal.WRONG_SERIAL
    bench.recipe.path.write_text("# changed\n" + bench.recipe.content)
    assert refusal(bench) is Refusal.RECIPE_CHANGED
    assert not bench.store.read.table()


def test_a_run_needs_an_operator_and_a_socket(bench: Bench) -> None:
    with pytest.raises(UsageError, match="operator"):
        bench.store.claim(Order(SERIAL, "A", " "), bench.recipe)


def test_shifts_start_by_the_clock_on_the_wall() -> None:
    rule = Golden(serial_numbers=("G",), shift_starts=(time(6), time(22)))
    zone = datetime(2026, 5, 17, tzinfo=UTC).astimezone().tzinfo

    def at(day: int, hour: int) -> datetime:
        return datetime(2026, 5, day, hour, tzinfo=zone)

    assert shift_began(rule.shift_starts, at(17, 5)) == at(16, 22)
    assert shift_began(rule.shift_starts, at(17, 6)) == at(17, 6)
    assert is_due(rule, None, at(17, 5))
    assert not is_due(rule, at(16, 23), at(17, 5))
    assert is_due(rule, at(16, 23), at(17, 6))


@each(
    "zone, now, began, hour",
    [
        ("Europe/Berlin", "2026-03-29T03:30Z", "2026-03-28T21:00Z", "2026-03-29T03:00Z"),
        ("Europe/Berlin", "2026-03-29T04:00Z", "2026-03-29T04:00Z", "2026-03-29T04:00Z"),
        ("Europe/Berlin", "2026-10-25T00:30Z", "2026-10-24T20:00Z", "2026-10-25T00:00Z"),
        ("Europe/Berlin", "2026-10-25T01:30Z", "2026-10-24T20:00Z", "2026-10-25T01:00Z"),
        ("Europe/Berlin", "2026-10-25T04:59Z", "2026-10-24T20:00Z", "2026-10-25T04:00Z"),
        ("Australia/Lord_Howe", "2026-04-04T19:00Z", "2026-04-04T11:00Z", "2026-04-04T18:30Z"),
        ("Australia/Lord_Howe", "2026-10-03T18:00Z", "2026-10-03T11:30Z", "2026-10-03T18:00Z"),
    ],
)
def test_a_shift_begins_at_its_local_time_though_the_offset_changes_in_it(
    bench: Bench, zone: str, now: str, began: str, hour: str
) -> None:
    at, begin = datetime.fromisoformat(now), datetime.fromisoformat(began)
    run = next(iter(bench.store.read.table()), None) or bench.store.read.run(bench.make()).run
    with in_zone(zone):
        shifts = (time(6), time(22))
        assert shift_began(shifts, at) == begin
        rule = Golden(serial_numbers=("G",), shift_starts=shifts)
        assert not is_due(rule, begin, at)
        assert is_due(rule, begin - timedelta(minutes=1), at)
        counts = ShiftCounts(shifts)
        for moment in (begin, begin - timedelta(seconds=1), datetime.fromisoformat(hour)):
            counts.add(replace(run, serial=str(moment), ended_at=moment))
        figures = counts.output(at.astimezone())
    assert (figures.hour.good, figures.shift.good) == (1, 1 if began == hour else 2)


def test_a_golden_unit_counts_in_no_figure_of_a_shift(bench: Bench) -> None:
    run = bench.store.read.run(bench.make(RunState.FAIL)).run
    counts = ShiftCounts()
    counts.add(replace(run, kind=RunKind.GOLDEN))
    now = bench.clock.utc().astimezone()
    assert counts.output(now) == ShiftCounts().output(now)


def test_runs_that_are_later_than_the_clock_count_in_no_shift(bench: Bench) -> None:
    run = bench.store.read.run(bench.make()).run
    counts = ShiftCounts()
    now = bench.clock.utc().astimezone()
    counts.add(replace(run, serial="W2605003", ended_at=now + timedelta(days=365)))
    assert counts.output(now) == ShiftCounts().output(now)
    counts.add(replace(run, ended_at=now + timedelta(minutes=5)))  # the clock was set back
    assert counts.output(now).shift == (1, 0)


# -- the station dies -----------------------------------------------------------------------------


def test_runs_of_a_dead_station_are_interrupted_and_their_units_rechecked(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.store.intent(run_id, "bms", "flash", BMS_VERSION)
    bench.store.close()
    bench.store = bench.opened()
    assert bench.store.recover() == (run_id,)
    assert bench.store.recover() == ()
    details = bench.store.read.run(run_id)
    assert details.run.state is RunState.INTERRUPTED
    assert details.run.duration_s is None
    assert [write.verified_at for write in details.writes] == [None]
    assert bench.store.read.unit(SERIAL).state is UnitState.RECHECK
    assert bench.claim().kind is RunKind.RECHECK
    assert not bench.store.examine().problems


def test_another_station_s_runs_are_left_alone(bench: Bench) -> None:
    run_id = bench.claim().run_id
    with bench.opened("line-3") as other:
        assert other.recover() == ()
    assert bench.store.read.run(run_id).run.state is RunState.RUNNING


def test_a_station_exists_once_and_claims_only_after_it_looked_back(bench: Bench) -> None:
    with bench.opened(lock_timeout_s=0.02) as second:
        with pytest.raises(StationBusyError, match="already runs"):
            second.recover()
        with pytest.raises(RecordError, match="not the station"):
            second.claim(Order(SERIAL, "B", "jo"), bench.recipe)
    bench.store.close()
    bench.store = bench.opened()
    bench.store.recover()


def test_a_connection_lost_in_a_transaction_leaves_the_run_as_it_was(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    with bench.outsider() as lost:
        lost.execute("INSERT INTO operator (name) VALUES ('ghost')")
        lost.execute(
            "UPDATE run SET state = 'FAIL', code = 'X', ended_monotonic_s = 1e9,"
            " ended_at = '2026-05-17T09:00:00.000000Z'"
        )
    assert bench.store.read.run(run_id).run.state is RunState.RUNNING
    bench.store.finish(run_id, bench.ending())
    assert not bench.store.examine().problems


def test_totals_are_the_figures_of_all_runs_in_whatever_order_these_end(bench: Bench) -> None:
    bench.make(RunState.PASS, "W2605001")
    bench.clock.go_on(1)
    chosen = RunFilter(since=bench.clock.utc(), station=bench.store.station)
    totals = Totals(bench.store.database, chosen)

    def check(runs: int) -> None:
        found = totals.figures()
        assert (found, found.runs) == (bench.store.read.figures(chosen), runs)

    check(0)
    slow = bench.claim("W2605002").run_id
    bench.make(RunState.FAIL, "W2605003", "B")
    check(2)
    bench.work(slow)
    bench.store.finish(slow, bench.ending(trace=bench.traced("W2605002")))
    check(2)
    bench.make(RunState.PASS, "W2605003", "B")
    check(3)
    check(3)
    assert totals.figures().first_pass_share == 0.5
    bench.claim("W2605004")
    bench.store.end_unknown(())
    check(4)


@pytest.mark.slow
def test_threads_may_share_the_records(bench: Bench) -> None:
    bench.lock_timeout_s = 10.0
    bench.store.close()
    bench.store = bench.opened()
    bench.store.recover()

    def make(number: int) -> RunId:
        return bench.make(RunState.PASS, f"W260510{number}", f"socket {number}")

    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(make, range(4)))
    assert len(set(runs)) == 4
    assert bench.store.read.figures().passed == 4
    assert not bench.store.examine().problems


# -- figures --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_figures_distinguish_units_from_runs_and_first_tries_from_last(bench: Bench) -> None:
    bench.make(lot="L1")
    bench.make(RunState.FAIL, "W2605003", lot="L1", code="REFUSED")
    bench.make(RunState.PASS, "W2605003", lot="L1")
    bench.make(RunState.FAIL, "W2605004", lot="L2", code="REFUSED")
    bench.make(RunState.ERROR, "W2605005", lot="L2", code="ADAPTER")
    bench.make(RunState.PASS, "W2605005", lot="L2")
    figures = bench.store.read.figures()
    assert (figures.runs, figures.units, figures.passed, figures.first_passed) == (6, 4, 3, 2)
    assert figures.yield_share == 0.75
    assert figures.first_pass_share == 0.5
    assert list(figures.failures.items()) == [("REFUSED", 2), ("ADAPTER", 1)]
    assert figures.duration_median_s == 8.0
    lot = bench.store.read.figures(RunFilter(lot="L1"))
    assert (lot.runs, lot.units, lot.passed) == (3, 2, 2)
    since = bench.clock.now - timedelta(seconds=15)
    assert len(bench.store.read.table(RunFilter(since=since))) == 1
    assert len(bench.store.read.table(RunFilter(until=since))) == 5
    assert bench.store.read.figures(RunFilter(recipe="none")).yield_share is None


# -- virtual units ---------------------------------------------------------------------------------


def test_a_serial_number_is_never_that_of_a_real_and_a_virtual_unit(bench: Bench) -> None:
    bench.make(is_virtual=True)
    with pytest.raises(ClaimRefusedError) as caught:
        bench.claim()
    assert caught.value.refusal is Refusal.OTHER_NATURE
    assert bench.store.read.unit_kinds() == {True}


def test_a_virtual_golden_unit_proves_nothing_about_real_sockets(bench: Bench) -> None:
    bench.use(USUAL + GOLDEN)
    bench.make(serial="W2600001", is_virtual=True)
    assert bench.claim(is_virtual=True).kind is RunKind.PRODUCTION
    with pytest.raises(ClaimRefusedError) as caught:
        bench.claim("W2605003", "B")
    assert caught.value.refusal is Refusal.GOLDEN_DUE
