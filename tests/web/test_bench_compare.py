"""The bench page's "Is this what runs?": the chosen image compared with the device."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest

from flasher.errors import BusError, ErrorCode, ExitCode
from flasher.host.verify import Verdict
from flasher.web.bench import BenchController
from flasher.web.bench_compare import compare, watch_compared
from flasher.web.bench_state import BenchState
from flasher.web.virtual_bike import BikeFault, VirtualBike
from tests.loops import each
from tests.web.bench_place import IMAGE, BenchPlace, order


@pytest.fixture
def place(tmp_path: Path) -> BenchPlace:
    return BenchPlace(tmp_path)


def chosen(place: BenchPlace, fault: BikeFault = BikeFault.NONE, target: str = "bms") -> BenchState:
    return place.do(
        order(BenchController.use_adapter, fault.value),
        order(BenchController.choose_target, target),
        order(BenchController.choose_image, IMAGE),
    )


def upgraded(place: BenchPlace) -> BenchState:
    state = chosen(place)
    assert state.offer is not None
    done = place.do(order(BenchController.upgrade, state.selection)).done
    assert done is not None
    assert done.error is None
    return place.do(
        order(BenchController.choose_target, "bms"), order(BenchController.choose_image, IMAGE)
    )


def test_another_version_than_the_image_is_reported_and_nothing_is_sent_to_change_it(
    place: BenchPlace,
) -> None:
    chosen(place)
    state = place.do(compare)
    assert state.trouble is None
    assert state.compared is not None
    assert state.compared.verification.verdict is Verdict.VERSION_OTHER
    assert state.compared.memory_not_compared == "the version decides already"
    error = state.compared.error
    assert error is not None
    assert error.exit_code is ExitCode.VERIFICATION
    assert "flasher" not in error.remedy
    assert "--" not in error.remedy
    again = place.do(BenchController.look)
    assert again.bike is not None
    assert again.bike.version is not None
    assert str(again.bike.version.firmware_version) == state.compared.verification.running_version
    assert again.compared is None, "it belonged to the bike before"


def test_another_battery_than_the_one_shown_is_not_compared(place: BenchPlace) -> None:
    chosen(place, BikeFault.EXCHANGED)
    bike = place.bikes._bikes[BikeFault.EXCHANGED.value]
    for socket in bike._places:
        socket.device = socket._made()
    state = place.do(compare)
    assert state.compared is None
    assert state.trouble is not None
    assert state.trouble.code is ErrorCode.NOT_FOR_DEVICE


def test_the_image_that_runs_is_confirmed(place: BenchPlace) -> None:
    upgraded(place)
    compared = place.do(compare).compared
    assert compared is not None
    assert compared.error is None
    assert compared.is_sure
    assert compared.memory_not_compared == "a raw binary has no addresses"


def test_an_upgrade_makes_the_comparison_void(place: BenchPlace) -> None:
    state = chosen(place)
    place.do(compare)
    assert state.offer is not None
    done = place.do(order(BenchController.upgrade, state.selection))
    assert done.compared is None


@each("target", ["wmc", "obc"])
def test_a_device_without_a_version_query_cannot_be_compared(
    target: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    place = BenchPlace(tmp_path_factory.mktemp("place"))
    chosen(place, target=target)
    state = place.do(compare)
    assert state.compared is None
    assert state.trouble is not None
    assert "no query for what the" in state.trouble.what


def test_a_device_in_its_bootloader_is_no_match(place: BenchPlace) -> None:
    state = chosen(place, BikeFault.POWER)
    assert state.offer is not None
    place.do(order(BenchController.upgrade, state.selection))
    place.do(
        order(BenchController.choose_target, "bms"), order(BenchController.choose_image, IMAGE)
    )
    state = place.do(compare)
    assert state.compared is not None
    assert state.compared.error is not None
    assert state.compared.error.code in (ErrorCode.IN_BOOTLOADER, ErrorCode.NO_ANSWER)
    assert not state.compared.is_sure


def test_without_an_image_nothing_is_compared(place: BenchPlace) -> None:
    state = place.do(compare)
    assert state.trouble is not None
    assert state.trouble.what == "No image is chosen."
    assert state.trouble.exit_code is ExitCode.USAGE


def test_stop_ends_it_without_a_verdict(place: BenchPlace) -> None:
    chosen(place)
    place.bench.stop()
    state = place.do(compare)
    assert state.compared is None or state.compared.error is not None
    assert state.is_idle


def _compared_and_then(place: BenchPlace, act: Callable[[BenchPlace], None]) -> BenchState:
    """The state when the bench has watched the compared unit, and `act` was done meanwhile."""
    chosen(place, BikeFault.EXCHANGED)
    assert place.do(compare).compared is not None
    act(place)
    watch_compared(place.bench)
    return place.bench.state


def test_a_comparison_is_void_when_the_bike_is_exchanged(place: BenchPlace) -> None:
    state = _compared_and_then(place, lambda place: _bike(place).ended())
    assert state.compared is None
    assert state.offer is not None, "the choice stays"


def test_a_comparison_is_void_when_another_unit_answers_at_once(place: BenchPlace) -> None:
    def exchange(place: BenchPlace) -> None:
        for socket in _bike(place)._places:
            socket.device = socket._made()

    assert _compared_and_then(place, exchange).compared is None


def test_a_comparison_is_void_when_the_adapter_is_lost(place: BenchPlace) -> None:
    def unplug(place: BenchPlace) -> None:
        def gone(*_args: object, **_named: object) -> NoReturn:
            raise BusError("The adapter is gone.")

        place.bikes.connect = gone  # type: ignore[method-assign]

    assert _compared_and_then(place, unplug).compared is None


def _order_the_next(place: BenchPlace) -> None:
    assert place.bench.order(BenchController.look)


def test_a_comparison_stays_until_the_next_order(place: BenchPlace) -> None:
    state = _compared_and_then(place, _order_the_next)
    assert state.compared is not None
    assert state.trouble is None


def _bike(place: BenchPlace) -> VirtualBike:
    return place.bikes._bikes[BikeFault.EXCHANGED.value]


def test_a_silent_device_stays_reported_as_silent(place: BenchPlace) -> None:
    chosen(place, BikeFault.OFF)
    assert place.do(compare).compared is not None
    turns = 0

    def beat() -> None:
        nonlocal turns
        turns += 1
        if turns > 100:
            place.bench.order(BenchController.look)

    place.bench.feed.beat = beat  # type: ignore[method-assign]
    watch_compared(place.bench)
    assert place.bench.state.compared is not None
