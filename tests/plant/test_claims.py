"""Two stations, one unit, any timing: at most one PASS without a mark."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any, NoReturn

import pytest

from flasher.errors import UsageError
from flasher.plant.alerts import CheckKind, CheckState, overviews
from flasher.plant.bounds import Bounds
from flasher.plant.central import Central
from flasher.plant.claim_list import (
    ClaimFilter,
    claims_of,
    release,
    releases_of,
)
from flasher.plant.claims import LEASE_S, PlantClaims, _Own
from flasher.plant.deliveries import document_of
from flasher.plant.retire import Retirement
from flasher.plant.setup import role_of, setup
from flasher.station.gate import Gate
from flasher.station.records.errors import ClaimRefusedError, RecordError, Refusal
from flasher.station.records.model import (
    CHECKED,
    RELEASED_MARK,
    Admission,
    AuditEvent,
    Claim,
    Order,
    RunId,
    RunState,
)
from flasher.station.shift_counts import DEFAULT_SHIFTS
from flasher.web.query_processes import Question
from tests.loops import sample
from tests.plant.claims_world import Centre, Claimed, Station, World, _Claims
from tests.plant.factory import COURIER, READER, Plant, Sender
from tests.station.factory import HEAD, SERIAL, SERIAL_NUMBER, USUAL
from tests.station.postgres import OWNER

SEEDS = 1500


@pytest.mark.slow
def test_no_order_of_events_passes_a_unit_twice_without_a_mark() -> None:
    met: Counter[str] = Counter()
    for seed in range(SEEDS):
        world = World(seed)
        world.run()
        world.settle()
        for station in world.stations:
            for run in station.runs:
                met["marked" if run.is_marked else "checked"] += run.state == "PASS"
                met["interrupted"] += run.state == "INTERRUPTED"
    assert min(met["marked"], met["checked"], met["interrupted"]) > SEEDS // 20, met


@pytest.mark.slow
def test_nothing_stays_claimed_after_all_runs_were_sent() -> None:
    for seed in range(200):
        world = World(seed)
        world.run()
        world.settle()
        assert not world.centre.claims, (seed, world.log)


class _ExpiredIsFree(Centre):
    """The mistake of a lock that only expires."""

    def claim(self, *asked: Any) -> str | None:
        found = super().claim(*asked)
        return None if found == "unknown" else found


class _GoneAtTheEnd(Centre):
    """The mistake to forget a claim when it is not renewed."""

    def claim(self, *asked: Any) -> str | None:
        for old, each in list(self.claims.items()):
            if each.expires_at <= self.clock.now:
                del self.claims[old]
        return super().claim(*asked)


class _RunsBeforeClaims(Centre):
    """The mistake not to look for a PASS."""

    def claim(self, *asked: Any) -> str | None:
        found = super().claim(*asked)
        return None if found == "passed" else found


class _ReleasedIsForgotten(Centre):
    """The mistake not to mark a run that arrives after its claim was released."""

    def release_expired(self) -> None:
        super().release_expired()
        self.released.clear()


class _StationIsOnePC(Centre):
    """The mistake to take claims of a PC that was taken over for those of the PC that goes on."""

    def is_own(self, claim: Claimed, station: str, takeover: str) -> bool:
        return claim.station == station


class _NoTakeover(Centre):
    """The mistake to let a PC that was taken over claim units."""

    def claim(self, *asked: Any) -> str | None:
        self.takeovers.clear()
        return super().claim(*asked)


class _ReleasesAll(Station):
    """The mistake to release claims of other PCs of the station, of whose runs nothing is known."""

    class claims_of(_Claims):  # noqa: N801
        def _read(self) -> _Own:
            every = {each.takeover for each in self._of.link.centre.claims.values()}
            return replace(super()._read(), known=frozenset(every))


class _CountsBranches(Station):
    """The mistake to count what was brought in, whichever PC it came from."""

    class claims_of(_Claims):  # noqa: N801
        def _read(self) -> _Own:
            of, centre = self._of, self._of.link.centre
            own = super()._read()
            takeovers = int(of.takeover.partition(" ")[2] or 0) and len(centre.takeovers)
            if len(of.brought) < takeovers:
                return own
            return replace(own, known=frozenset({c.takeover for c in centre.claims.values()}))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("centre", "station"),
    [
        (_ExpiredIsFree, Station),
        (_GoneAtTheEnd, Station),
        (_RunsBeforeClaims, Station),
        (_StationIsOnePC, Station),
        (_NoTakeover, Station),
        (_ReleasedIsForgotten, Station),
        (Centre, _ReleasesAll),
        (Centre, _CountsBranches),
    ],
)
def test_a_planted_mistake_is_found(centre: type[Centre], station: type[Station]) -> None:
    def search() -> None:
        for seed in range(SEEDS):
            World(seed, centre, station).run()

    with pytest.raises(AssertionError, match="run"):
        search()


# -- with PostgreSQL -------------------------------------------------------------------------------


class Line:
    """A station with its claims; everything in its own turn, as the test calls it."""

    def __init__(self, plant: Plant, station: str, sender: Sender | None = None) -> None:
        self.sender = sender or plant.sender(station)
        self.bench = self.sender.bench
        self.start()

    def start(self) -> None:
        """A new process."""
        earlier: PlantClaims | None = getattr(self, "claims", None)
        if earlier is not None:
            earlier.close()
        role = role_of(self.sender.station)
        self.claims = PlantClaims(
            Central(self.sender.plant.url(role), lock_timeout_s=1.0, statement_limit_s=1.0),
            self.bench.store.database,
            self.sender.station,
            self.bench.clock,
            is_kept=False,
        )
        recipe, clock = self.bench.recipe.recipe, self.bench.clock
        self.gate = Gate(recipe, self.claims, None, clock.monotonic_s, start=lambda work: work())

    def asked(self, serial: str = SERIAL, reason: str = "") -> Admission:
        self.gate.ask(Order(serial, "A", "jo", reason=reason))
        ((_, admission),) = self.gate.take()
        return admission

    def claim(self, serial: str = SERIAL, reason: str = "") -> Claim:
        admission = self.asked(serial, reason)
        order = Order(serial, "A", "jo", reason=reason, admission=admission)
        try:
            return self.bench.store.claim(order, self.bench.recipe)
        except ClaimRefusedError:
            self.gate.dropped(admission)
            self.claims.tend()
            raise

    def end(self, claim: Claim, state: RunState = RunState.PASS) -> RunId:
        self.bench.work(claim.run_id)
        code = "OK" if state is RunState.PASS else "NO_ANSWER"
        ending = self.bench.ending(state, code, self.bench.traced(claim.serial))
        self.bench.store.finish(claim.run_id, ending)
        return claim.run_id

    def lose_the_server(self) -> None:
        self.claims._central.close()
        self.claims._central = Central("postgresql://x@127.0.0.1:1/plant")

    def close(self) -> None:
        self.claims.close()
        self.sender.close()


@pytest.fixture
def lines(plant: Plant) -> Iterator[tuple[Line, Line]]:
    both = Line(plant, "line-2"), Line(plant, "line-3")
    yield both
    for each in both:
        each.close()


def expire(plant: Plant) -> None:
    with plant.connect() as owner:
        owner.execute(f"UPDATE plant_claim SET expires_at = now() - {LEASE_S} * '1s'::interval")  # noqa: S608


def refused(line: Line, reason: str = "") -> ClaimRefusedError:
    with pytest.raises(ClaimRefusedError) as caught:
        line.claim(reason=reason)
    return caught.value


def duplicates(line: Line, run_id: RunId) -> str | None:
    return line.bench.store.read.run(run_id).run.duplicates


def test_two_stations_and_one_unit(plant: Plant, lines: tuple[Line, Line]) -> None:
    here, there = lines
    claim = here.claim()
    error = refused(there)
    assert error.refusal is Refusal.UNIT_RUNNING
    assert "socket A of line-2" in error.what
    here.end(claim)
    assert refused(there).refusal is Refusal.UNIT_RUNNING  # its end has not arrived
    here.sender.send()
    error = refused(there)
    assert error.refusal is Refusal.DUPLICATE
    assert f"socket A of line-2, at 2026-05-17 09:00:00 UTC (its run {claim.run_id})" in error.what
    assert duplicates(here, claim.run_id) == "checked"
    assert plant.rows("SELECT * FROM plant_claim") == []


def test_a_claim_that_expires_marks_the_run_of_the_other_station(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    here, there = lines
    stalled = here.claim()
    expire(plant)
    second = there.claim()
    assert second.unchecked.startswith("line-2 claimed it at 20")
    runs = [(here, here.end(stalled)), (there, there.end(second))]
    found = [duplicates(*each) for each in runs]
    assert found[0] == "checked"
    assert str(found[1]).startswith("not checked: line-2 claimed it")
    for each in lines:
        each.sender.send()
    assert plant.rows("SELECT * FROM plant_claim") == []
    assert plant.rows("SELECT count(*) FROM plant_duplicate") == [(1,)]


def test_a_claim_is_renewed_while_the_run_lasts_and_not_after_it(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    here, there = lines
    claim = here.claim()
    expire(plant)
    here.claims.tend()
    assert refused(there).refusal is Refusal.UNIT_RUNNING
    here.end(claim)
    here.gate.ended(Admission(*plant.rows("SELECT token FROM plant_claim")[0]))
    expire(plant)
    here.claims.tend()
    assert there.asked().doubt


def test_a_station_whose_first_contact_was_rolled_back_states_its_records_again(
    lines: tuple[Line, Line], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the plant refuses all its claims as those of a foreign station until it starts again."""

    def lose(_connection: object, _clock: object) -> NoReturn:
        raise RecordError("the server ended")

    here, _ = lines
    with monkeypatch.context() as patch:
        patch.setattr("flasher.plant.claims._compared", lose)
        here.claims.tend()
    here.claims.tend()
    assert duplicates(here, here.end(here.claim())) == "checked"


def test_two_stations_without_the_server_both_pass_with_a_mark(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    runs = []
    for each in lines:
        each.lose_the_server()
        claim = each.claim()
        assert claim.unchecked
        runs.append((each, each.end(claim)))
    assert all(str(duplicates(*each)).startswith("not checked: ") for each in runs)
    for each in lines:
        each.sender.send()
    assert plant.rows("SELECT count(*) FROM plant_duplicate") == [(1,)]


def test_a_station_whose_records_were_replaced_claims_nothing(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    """It ran on while an administrator let new records send under its name."""
    here, there = lines
    here.claim()
    setup(plant.url(), (), datetime.now(UTC), renewed=["line-2"])
    with plant.connect(role_of("line-2")) as other:
        other.execute("SELECT plant_enter('other records', 'line-2')")
    assert "foreign" in here.asked("W2605005").doubt
    doubt = "a station whose records were replaced"
    assert doubt in refused(there).what
    expire(plant)
    assert there.claim().unchecked.startswith(doubt)


def test_a_copied_pc_passes_no_unit_of_the_other_one_without_a_mark(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    """Two PCs with the name, the key and the records of one station."""
    here, _ = lines
    here.end(here.claim("W2605004"))
    here.sender.send()
    copied = Sender(plant, "line-2", plant.folder / "copied")
    copied.end()
    copied.bench.store.close()
    with closing(sqlite3.connect(here.bench.path)) as source:
        copied.bench.path.unlink()
        with closing(sqlite3.connect(copied.bench.path)) as target:
            source.backup(target)
    shutil.copytree(here.bench.keys, copied.bench.keys, dirs_exist_ok=True)
    copied.bench.store = copied.bench.opened()
    copied.bench.store.recover()
    copied.start()
    other = Line(plant, "line-2", copied)
    here.end(here.claim())
    here.sender.send()
    with closing(other):
        assert other.asked().doubt.endswith("replayed: the plant has row 6, the station does not")
        other.end(other.claim("W2605005"))
        other.claims.tend()
        assert "forked" in other.asked().doubt
        other.sender.forwarder.forward()
        here.sender.forwarder.forward()
        with closing(Central(plant.url(READER))) as central, central.reading() as connection:
            (found, _) = overviews(connection, Bounds(), DEFAULT_SHIFTS, datetime.now(UTC))
        states = {each.kind: each.state for each in found.checks}
        assert states[CheckKind.REFUSED] is CheckState.ALERT


def test_a_server_that_is_away_is_asked_once(lines: tuple[Line, Line]) -> None:
    here, _ = lines
    url = here.sender.plant.url(role_of("line-2"))
    here.lose_the_server()
    here.asked()
    here.claims._central = Central(url)
    assert "not checked" not in here.asked().doubt
    assert here.asked().doubt  # not asked again before the thread has reached it
    here.claims.tend()
    assert not here.asked().doubt


def test_the_recipe_blocks_what_cannot_be_checked(lines: tuple[Line, Line]) -> None:
    here, _ = lines
    here.bench.use(HEAD + USUAL.removeprefix(HEAD) + '\n[plant]\nunchecked = "block"\n')
    here.start()
    here.lose_the_server()
    assert refused(here).refusal is Refusal.NOT_CHECKED


def test_a_station_without_a_plant_does_not_run_a_recipe_that_needs_one(
    lines: tuple[Line, Line],
) -> None:
    here, _ = lines
    here.bench.use(USUAL + '\n[plant]\nunchecked = "block"\n')
    with pytest.raises(ClaimRefusedError, match="belongs to no plant"):
        here.bench.claim()


def test_a_station_that_died_before_the_run_began_releases_its_claim(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    here, there = lines
    here.asked()
    expire(plant)
    here.start()
    here.claims.tend()
    assert plant.rows("SELECT * FROM plant_claim") == []
    assert not there.claim().unchecked


def test_a_claim_whose_run_is_recorded_is_not_released(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    here, there = lines
    here.end(here.claim())
    here.start()
    here.claims.tend()
    expire(plant)
    assert there.asked().doubt


def test_a_claim_whose_run_was_lost_with_the_disk_is_not_released(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    here, there = lines
    bench = here.bench
    copy = bench.folder / "backup.sqlite"
    bench.store.backup(copy)
    here.end(here.claim())
    bench.store.close()
    here.sender.end()
    for path in bench.folder.glob("records.sqlite*"):
        if path.is_file():
            path.unlink()
    copy.replace(bench.path)
    bench.store = bench.opened()
    bench.store.signer.accept_restored("jo", "the disk is new")
    bench.store.recover()
    here.start()
    here.claims.tend()
    expire(plant)
    assert there.asked().doubt.startswith("line-2 claimed it")


@pytest.mark.parametrize(
    ("rule", "kind"), [("verify-only", "verify-only"), ("reflash-with-reason", "reflash")]
)
def test_the_recipe_decides_about_a_pass_elsewhere(
    plant: Plant, lines: tuple[Line, Line], rule: str, kind: str
) -> None:
    here, there = lines
    here.end(here.claim())
    here.sender.send()
    text = HEAD + f'duplicate = "{rule}"\n' + SERIAL_NUMBER + USUAL.partition(SERIAL_NUMBER)[2]
    there.bench.use(text)
    there.start()
    claim = there.claim(reason="new image")
    assert (claim.kind.value, claim.unchecked) == (kind, "")
    there.end(claim)
    there.sender.send()
    assert plant.rows("SELECT * FROM plant_duplicate") == []  # the recipe asked for it


def test_the_clock_is_compared_and_the_recipe_stops(lines: tuple[Line, Line]) -> None:
    here, _ = lines
    here.bench.use(USUAL + '\n[plant]\nclock = "stop"\nclock_offset_max_s = 2.0\n')
    here.start()
    error = refused(here)
    assert error.refusal is Refusal.CLOCK_OFFSET  # not known
    assert "not compared" in error.what
    # refused() has compared them: the clock of the tests shows another year.
    error = refused(here)
    assert error.refusal is Refusal.CLOCK_OFFSET
    assert "the recipe allows 2 s" in error.what


def test_the_model_of_the_virtual_stations_answers_like_postgresql(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    """Random questions, ends and expiries; the database and the model give equal answers."""
    for seed in range(sample(1, 3)):
        chosen = random.Random(seed)
        serial = f"W260510{seed}"
        model = Centre(lines[0].bench.clock)
        open_runs: dict[Line, tuple[Claim, str]] = {}
        for _ in range(20):
            line = chosen.choice(lines)
            name = line.sender.station
            if chosen.random() < 0.25:
                expire(plant)
                for each in model.claims.values():
                    each.expires_at = each.at - timedelta(seconds=1)
            elif line in open_runs:
                claim, token = open_runs.pop(line)
                state = chosen.choice((RunState.PASS, RunState.FAIL))
                line.end(claim, state)
                line.sender.send()
                is_pass = state is RunState.PASS
                model.end(name, token, serial, claim.run_id, is_pass=is_pass)
            else:
                admission = line.asked(serial)
                expected = model.claim(name, admission.claim, serial, LEASE_S)
                found = admission.elsewhere
                assert (found and found.state.value) == expected
                order = Order(serial, "A", "jo", admission=admission)
                try:
                    claim = line.bench.store.claim(order, line.bench.recipe)
                except ClaimRefusedError:
                    line.gate.dropped(admission)
                    line.claims.tend()
                    model.release(name, [admission.claim])
                else:
                    open_runs[line] = claim, admission.claim
        for line, (claim, _) in open_runs.items():
            line.end(claim, RunState.FAIL)
            line.sender.send()


# -- a station that does not return ----------------------------------------------------------------


ENDS = "SELECT station, number FROM chain_row WHERE content IS NOT NULL"


def released(plant: Plant, **chosen: str) -> int:
    with closing(Central(plant.url())) as central:
        return release(central, ClaimFilter(**chosen), "its disk is broken")


def test_a_run_that_arrives_after_its_claim_was_released_is_marked(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    gone, other = lines
    run = gone.end(gone.claim())
    expire(plant)
    doubt = other.asked()
    assert doubt.elsewhere is not None, "its station may have passed it"
    other.gate.dropped(doubt)
    other.claims.tend()
    assert released(plant, station="line-2", serial=SERIAL) == 1
    claim = other.claim()
    assert claim.unchecked == ""
    other.end(claim)
    other.sender.send()
    with closing(plant.store()) as store:
        (first,) = store.read.table()
        gone.sender.send()
        runs = {each.station: each for each in store.read.table()}
        (twice,) = store.passed_twice(100)
    assert (first.duplicates, runs["line-3"].duplicates) == (CHECKED, CHECKED)
    assert runs["line-2"].duplicates == twice.second.duplicates == RELEASED_MARK
    assert twice.first.duplicates == CHECKED
    with plant.pages() as pages:
        shown = pages.answer(Question("/runs")).body.decode()
        assert shown.count("<small>duplicates not checked</small>") == 2, "in both tables"
        unit = pages.answer(Question("/units", {"serial": SERIAL, "part": "BAT-36"})).body.decode()
        assert unit.count(RELEASED_MARK) == 1
        assert pages.answer(Question("/runs.csv")).body.decode().count(RELEASED_MARK) == 1
    ((arrived,),) = plant.rows("SELECT run_id FROM released_claim")
    assert arrived == runs["line-2"].run_id
    with closing(Central(plant.url(READER))) as central, central.reading() as connection:
        (old,) = releases_of(connection, ClaimFilter())
        documents = [
            document_of(connection, station, number).run.run for station, number in plant.rows(ENDS)
        ]
        assert claims_of(connection, ClaimFilter()) == []
    marks = {each.station: each.duplicates for each in documents}
    assert marks == {"line-2": RELEASED_MARK, "line-3": CHECKED}, "as receivers get them"
    facts = (old.station, old.serial, old.reason, old.released_by, old.run_id, old.outcome)
    assert facts == ("line-2", SERIAL, "its disk is broken", OWNER, arrived, "PASS")
    assert run == gone.bench.store.read.table()[0].run_id


def test_a_station_records_that_the_claim_of_its_run_was_released(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    gone, _ = lines
    run = gone.end(gone.claim())
    second = gone.claim("W2605003")
    expire(plant)
    assert released(plant, station="line-2") == 2
    gone.claims.tend()
    assert gone.gate.take_released() == set(), "the plant has not the end of the run"
    gone.sender.send()
    gone.claims.tend()
    assert gone.gate.take_released() == {run}
    gone.bench.store.note(AuditEvent.CLAIM_RELEASED, {}, run)
    assert gone.bench.store.read.released() == {run}
    gone.sender.send()
    gone.claims.tend()
    assert gone.gate.take_released() == set(), "the plant knows that it knows"
    gone.end(second)
    gone.sender.send()
    gone.claims.tend()
    assert gone.gate.take_released() == {second.run_id}
    gone.bench.store.note(AuditEvent.CLAIM_RELEASED, {}, second.run_id)
    gone.sender.send()
    with closing(Central(plant.url())) as central:
        list(Retirement(central, plant.folder / "archive").retire("2026-06"))
    gone.claims.tend()
    assert gone.gate.take_released() == set(), "its audit row is retired"


def test_a_station_claims_at_a_plant_that_does_not_yet_state_released_claims(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    with plant.connect() as owner:
        owner.execute("DROP FUNCTION plant_released")
    lines[0].claim()
    expire(plant)
    lines[0].claims.tend()
    assert refused(lines[1]).refusal is Refusal.UNIT_RUNNING, "the claim was renewed"
    assert lines[0].asked("W2605003").unchecked == ""
    assert lines[0].gate.take_released() == set()


def test_a_claim_that_is_renewed_is_not_released(plant: Plant, lines: tuple[Line, Line]) -> None:
    lines[0].claim()
    with pytest.raises(UsageError, match="nothing was released"):
        released(plant, station="line-2")
    expire(plant)
    lines[0].claims.tend()
    with pytest.raises(UsageError, match="nothing was released"):
        released(plant, station="line-2")
    expire(plant)
    with pytest.raises(UsageError, match="nothing was released"):
        released(plant, station="line-3")
    assert plant.rows("SELECT count(*) FROM plant_claim") == [(1,)]


def test_a_release_and_its_renewal_at_the_same_moment(
    plant: Plant, lines: tuple[Line, Line]
) -> None:
    lines[0].claim()
    expire(plant)
    with plant.connect() as renewal:  # not committed yet
        renewal.execute("UPDATE plant_claim SET expires_at = now() + interval '1 min'")
        with ThreadPoolExecutor() as pool:
            release_ = pool.submit(released, plant, serial=SERIAL)
            waits = "SELECT count(*) FROM pg_locks WHERE NOT granted"
            while plant.rows(waits) == [(0,)] and not release_.done():
                pass
            renewal.commit()
            with pytest.raises(UsageError, match="nothing was released"):
                release_.result()
    assert plant.rows("SELECT count(*) FROM plant_claim") == [(1,)]


@pytest.mark.parametrize("role", [READER, COURIER])
def test_only_the_owner_releases_claims(plant: Plant, lines: tuple[Line, Line], role: str) -> None:
    lines[0].claim()
    expire(plant)
    with (
        closing(Central(plant.url(role))) as central,
        pytest.raises(UsageError, match="Only the owner of the plant's database may release"),
    ):
        release(central, ClaimFilter(serial=SERIAL), "x")
    assert plant.rows("SELECT count(*) FROM plant_claim") == [(1,)]
