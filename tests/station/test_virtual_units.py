"""Virtual units: who comes, what it is like, and that it behaves so."""

from __future__ import annotations

from collections import Counter
from itertools import islice
from pathlib import Path

import pytest

from flasher.bus.link import VirtualClock
from flasher.errors import UsageError
from flasher.station.adapters import resolve, worker_setups
from flasher.station.config import MockUnits, mock_config
from flasher.station.messages import PresenceChanged, VirtualUnits
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import Claim, RunId, RunKind, RunResult
from flasher.station.unit_run import UnitRun
from flasher.station.virtual_units import (
    Health,
    VirtualSocket,
    health_of,
    next_number,
    number_of_first,
    serial_numbers,
)
from tests.station.factory import DAY, HEAD, SERIAL_NUMBER, USUAL, make_recipe
from tests.station.unit_bench import WRITES, Notes

MIXED = MockUnits(bad=0.2, slow=0.1, dead=0.1, seed=5)


def test_the_same_seed_and_number_is_the_same_unit() -> None:
    serials = [f"W{number:07d}" for number in range(500)]
    first = [health_of(MIXED, serial) for serial in serials]
    assert first == [health_of(MIXED, serial) for serial in serials]
    counts = Counter(first)
    bad = counts[Health.REFUSES] + counts[Health.WRONG_HARDWARE]
    assert 60 < bad < 140
    assert 25 < counts[Health.DEAD] < 80
    assert 25 < counts[Health.SLOW] < 80


def test_numbers_follow_the_recipe_and_sockets_do_not_meet(tmp_path: Path) -> None:
    rule = make_recipe(tmp_path).recipe.serial_number
    one = list(islice(serial_numbers(rule, 1, 2), 20))
    two = list(islice(serial_numbers(rule, 2, 2), 20))
    assert one[:2] == ["W0000001", "W0000003"]
    assert len(set(one) | set(two)) == 40


@pytest.mark.parametrize(
    ("known", "number"),
    [((), 1), (("W0000001",), 2), (("W0000003", "W0000700"), 701), (("X", "W0020000"), 1)],
)
def test_the_next_number_comes_after_the_last_one_that_records_know(
    tmp_path: Path, known: tuple[str, ...], number: int
) -> None:
    rule = make_recipe(tmp_path).recipe.serial_number
    assert next_number(rule, set(known).intersection) == number


@pytest.mark.slow
def test_virtual_units_of_two_stations_of_a_plant_do_not_look_like_duplicates(
    tmp_path: Path,
) -> None:
    rule = make_recipe(tmp_path).recipe.serial_number
    first, second = (
        set(
            islice(
                serial_numbers(
                    rule, next_number(rule, frozenset().intersection, number_of_first(name)), 1
                ),
                50,
            )
        )
        for name in ("line-2", "line-3")
    )
    assert not first & second
    (after,) = islice(serial_numbers(rule, next_number(rule, first.intersection), 1), 1)
    assert after not in first


def test_check_digits_are_kept(tmp_path: Path) -> None:
    text = USUAL.replace(
        HEAD + SERIAL_NUMBER,
        HEAD + "[serial_number]\npattern = '[0-9]{8}'\n"
        'example = "12345674"\ncheck_digit = "luhn"\n',
    )
    rule = make_recipe(tmp_path, text).recipe.serial_number
    for serial in islice(serial_numbers(rule, 1, 1), 10):
        rule.read(serial)


def test_a_rule_without_room_is_reported(tmp_path: Path) -> None:
    text = USUAL.replace("W(?P<year>[0-9]{2})(?P<week>[0-9]{2})(?P<number>[0-9]{3})", "W2605002")
    rule = make_recipe(tmp_path, text).recipe.serial_number
    with pytest.raises(UsageError, match="no serial numbers"):
        list(serial_numbers(rule, 1, 3))


def run_one(folder: Path, wanted: Health) -> RunResult:
    """The run of a virtual unit that is so."""
    recipe = make_recipe(folder, USUAL + WRITES)
    socket = VirtualSocket(recipe, VirtualUnits(MIXED, speed=0))
    serial = next(s for n in range(999) if health_of(MIXED, s := f"W2605{n:03d}") is wanted)
    assert socket.arrive(serial) is wanted
    order = Claim(RunId(1), RunKind.PRODUCTION, serial, DAY)
    return UnitRun(order, recipe, socket.connection, Notes(), power=socket).run()


@pytest.mark.parametrize(
    ("health", "code"),
    [
        (Health.GOOD, "OK"),
        (Health.SLOW, "OK"),
        (Health.REFUSES, "REFUSED"),
        (Health.DEAD, "NO_ANSWER"),
    ],
)
def test_a_unit_behaves_as_it_is(tmp_path: Path, health: Health, code: str) -> None:
    assert run_one(tmp_path, health).code == code


def test_a_station_file_becomes_one_setup_a_socket(tmp_path: Path) -> None:
    recipe = make_recipe(tmp_path)
    config = mock_config(3, MIXED)
    setups = worker_setups(resolve(config.socket, ()), recipe, first_number=10)
    assert [setup.socket for setup in setups] == ["1", "2", "3"]
    numbers = {
        serial
        for setup in setups
        if setup.virtual is not None
        for serial in islice(
            serial_numbers(
                recipe.recipe.serial_number, setup.virtual.first_number, setup.virtual.number_step
            ),
            5,
        )
    }
    assert len(numbers) == 15
    assert min(numbers) == "W0000010"


def test_units_come_and_go(tmp_path: Path) -> None:
    recipe = make_recipe(tmp_path)
    socket = VirtualSocket(recipe, VirtualUnits(MockUnits(), speed=0, count=1))
    assert socket.step() is None
    socket.clock.wait_until(1.0)
    came = socket.step()
    assert came is not None
    assert came.label == socket.serial
    assert list(socket.devices) == [target.name for target in recipe.targets]
    socket.run_ended()
    socket.clock.wait_until(2.0)
    gone = socket.step()
    assert gone is not None
    assert not gone.is_there
    assert not socket.devices
    socket.clock.wait_until(10.0)
    assert socket.step() is None


def test_a_unit_has_its_label_inside_where_the_recipe_writes_no_number(tmp_path: Path) -> None:
    recipe = make_recipe(tmp_path, USUAL)
    socket = VirtualSocket(recipe, VirtualUnits(MockUnits(), speed=0))
    socket.arrive("W2605002")
    order = Claim(RunId(1), RunKind.PRODUCTION, "W2605002", DAY)
    result = UnitRun(order, recipe, socket.connection, Notes(), power=socket).run()
    assert result.code == "OK", result.text


# -- units that are put elsewhere -----------------------------------------------------------------


def run_in(
    socket: VirtualSocket, recipe: LoadedRecipe, serial: str, notes: Notes | None = None
) -> RunResult:
    order = Claim(RunId(1), RunKind.PRODUCTION, serial, DAY)
    result = UnitRun(order, recipe, socket.connection, notes or Notes(), power=socket).run()
    socket.run_ended()
    return result


def test_a_unit_keeps_what_is_in_it_wherever_it_is_put(tmp_path: Path) -> None:
    recipe, clock = make_recipe(tmp_path, USUAL + WRITES), VirtualClock()
    one, other = (VirtualSocket(recipe, VirtualUnits(MockUnits()), clock) for _ in range(2))
    one.arrive("W2605002")
    assert run_in(one, recipe, "W2605002").code == "OK"
    unit = one.take_out()
    assert unit is not None
    assert (one.serial, dict(one.devices)) == ("", {})
    image = unit.devices["bms"].stored_image
    assert image is not None
    other.put(unit)
    assert (other.serial, other.devices["bms"].device.stored_image) == ("W2605002", image)
    clock.wait_until(clock.now() + 1.0)
    wrong = run_in(other, recipe, "W2605003")
    assert wrong.code == "WRONG_UNIT", "it bears the number that the first run wrote"


def test_a_mislabelled_unit_reports_another_number_than_its_paper(tmp_path: Path) -> None:
    for text in (USUAL, USUAL + WRITES):
        recipe = make_recipe(tmp_path, text)
        socket = VirtualSocket(recipe, VirtualUnits(MockUnits(mislabelled=1.0), speed=0))
        socket.arrive("W2605002")
        assert run_in(socket, recipe, "W2605002").code == "WRONG_UNIT"


def until_something(socket: VirtualSocket) -> PresenceChanged:
    for _ in range(100):
        socket.clock.wait_until(socket.clock.now() + 0.5)
        if change := socket.step():
            return change
    raise AssertionError("no unit comes or goes")


def test_a_computer_that_is_slow_accuses_no_virtual_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 20 times, 20 ms of this computer would be 0.4 s on the bus."""
    real_s = 100.0

    def pass_time(seconds: float = 0.02) -> None:
        nonlocal real_s
        real_s += seconds

    monkeypatch.setattr("flasher.bus.link.time.perf_counter", lambda: real_s)
    monkeypatch.setattr("flasher.bus.link.time.sleep", pass_time)
    recipe = make_recipe(tmp_path, USUAL + WRITES)
    socket = VirtualSocket(recipe, VirtualUnits(MockUnits(exchanged=1.0), speed=20, count=2))
    notes = Notes(on_note=pass_time)
    one = until_something(socket).label
    assert run_in(socket, recipe, one, notes).code == "UNIT_CHANGED"
    other = until_something(socket).label
    assert run_in(socket, recipe, other, notes).code == "OK"
    assert not until_something(socket).is_there
    assert until_something(socket).label == one
    result = run_in(socket, recipe, one, notes)
    assert result.code == "OK", result.text


def test_a_unit_that_is_exchanged_in_its_run_comes_back_as_it_was(tmp_path: Path) -> None:
    recipe = make_recipe(tmp_path, USUAL + WRITES)
    socket = VirtualSocket(recipe, VirtualUnits(MockUnits(exchanged=1.0), speed=0, count=2))
    one = until_something(socket).label
    first = socket.unit
    result = run_in(socket, recipe, one)
    assert result.code == "UNIT_CHANGED", result.text
    change = until_something(socket)
    assert change.is_power_up
    assert change.label not in ("", one)
    assert socket.devices["bms"].device.stored_image is not None, "nothing was sent to it"
    assert run_in(socket, recipe, change.label).code == "OK", "no third one to exchange it for"
    assert not until_something(socket).is_there
    assert until_something(socket).label == one
    assert first is not None
    assert socket.unit is first
    assert first.devices["bms"].stored_image is None, "torn, as it was pulled out"
    assert run_in(socket, recipe, one).code == "OK"


def test_a_unit_is_exchanged_once_however_many_others_there_are(tmp_path: Path) -> None:
    recipe = make_recipe(tmp_path, USUAL + WRITES)
    socket = VirtualSocket(recipe, VirtualUnits(MockUnits(exchanged=0.5), speed=0))
    codes: dict[str, list[str]] = {}
    while not any(len(each) > 1 for each in codes.values()):
        change = until_something(socket)
        if change.is_there:
            codes.setdefault(change.label, []).append(run_in(socket, recipe, change.label).code)
    assert ["UNIT_CHANGED", "OK"] in codes.values()
