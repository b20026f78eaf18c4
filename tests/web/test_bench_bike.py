"""The whole bike on the bench page: a set of images, one verdict, and again after a failure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flasher import events
from flasher.api import DeviceInfo
from flasher.errors import BusError, ErrorCode
from flasher.jobs import Job
from flasher.protocol.engine import Tap
from flasher.protocol.spec import BMS, Target
from flasher.web.bench import BenchController
from flasher.web.bench_bike import upgrade_bike
from flasher.web.bench_state import Activity, Adapter, BenchState, UpgradeEnding
from flasher.web.virtual_bike import BikeFault
from tests.end_to_end.stage import NEW, image_of
from tests.loops import each
from tests.web.bench_place import BenchPlace, order, write_manifest

NAMES = ("obc", "wmc", "bms")
SET = "bike.toml"


def write_set(folder: Path, names: tuple[str, ...] = NAMES, version: str = NEW) -> Path:
    """A set with an image of its own for each device."""
    tables = []
    for packets, name in enumerate(names, 4):
        (folder / f"{name}.bin").write_bytes(image_of(packets, version, packets).data)
        tables.append(f'[[target]]\ntarget = "{name}"\nimage = "{name}.bin"\n')
    path = folder / SET
    path.write_text("\n".join(tables))
    return path


@pytest.fixture
def place(tmp_path: Path) -> BenchPlace:
    write_set(tmp_path)
    return BenchPlace(tmp_path)


def chosen(place: BenchPlace, fault: BikeFault = BikeFault.NONE) -> BenchState:
    return place.do(
        order(BenchController.use_adapter, fault.value),
        BenchController.choose_bike,
        order(BenchController.choose_image, SET),
    )


def upgraded(place: BenchPlace) -> BenchState:
    return place.do(lambda bench: upgrade_bike(bench, bench.state.selection))


def outcome(state: BenchState) -> dict[str, str]:
    return {
        device.target.name: "not begun"
        if device.done is None
        else "failed"
        if device.done.error
        else "up to date"
        if device.done.result is not None and device.done.result.outcome.nothing_to_do
        else "done"
        for device in state.devices
    }


@pytest.mark.slow
def test_all_devices_are_upgraded_one_after_the_other_with_the_battery_last(
    place: BenchPlace,
) -> None:
    state = chosen(place)
    assert state.offer is not None
    assert [target.name for target, _ in state.offer.parts] == ["obc", "wmc", "bms"]
    state = upgraded(place)
    assert state.trouble is None
    assert outcome(state) == {"obc": "done", "wmc": "done", "bms": "done"}
    assert list(outcome(state)) == ["obc", "wmc", "bms"]
    assert not state.is_sure, "OBC and WMC cannot be asked what they run"
    assert [entry.target.name for entry in state.session] == ["obc", "wmc", "bms"]
    assert state.target is None
    assert state.offer is not None
    assert state.offer.name == SET


@pytest.mark.slow
def test_after_a_stop_it_goes_on_with_the_device_where_it_stopped(place: BenchPlace) -> None:
    chosen(place)

    def stop(event: object) -> None:
        if isinstance(event, events.PacketAcknowledged) and place.bench.state.target is not None:
            name = place.bench.state.target.name
            if name == "wmc" and event.number == 2:
                place.bench.stop()

    place.bikes.hold = stop
    state = upgraded(place)
    assert outcome(state) == {"obc": "done", "wmc": "failed", "bms": "not begun"}
    assert state.done is not None
    assert state.done.error is not None
    assert state.done.error.code is ErrorCode.INTERRUPTED
    assert "Go on with the bike." in state.done.error.remedy
    place.bikes.hold = lambda _event: None
    place.bench._stop.clear()
    state = upgraded(place)
    assert state.trouble is None
    assert set(outcome(state).values()) == {"done"}
    assert [entry.target.name for entry in state.session] == ["obc", "wmc", "wmc", "bms"]
    chosen(place)
    assert outcome(upgraded(place)) == {"obc": "done", "wmc": "done", "bms": "up to date"}


def test_stop_between_two_devices_leaves_the_next_one_alone(place: BenchPlace) -> None:
    chosen(place)
    ended = place.bikes._bikes[BikeFault.NONE.value]
    ended.ended = place.bench.stop  # type: ignore[method-assign]
    state = upgraded(place)
    assert outcome(state) == {"obc": "done", "wmc": "not begun", "bms": "not begun"}
    assert state.trouble is not None
    assert state.trouble.code is ErrorCode.INTERRUPTED


def _exchange(place: BenchPlace) -> None:
    """Connect the next bike in place of the one that is connected."""
    bike = place.bikes._bikes[BikeFault.EXCHANGED.value]
    bike._bikes = dict.fromkeys(bike._bikes, bike._bikes[BMS])
    for socket in bike._places:
        socket.device = socket._made()


@pytest.mark.slow
def test_another_bike_than_the_one_shown_gets_nothing(place: BenchPlace) -> None:
    chosen(place, BikeFault.EXCHANGED)
    _exchange(place)
    state = upgraded(place)
    assert state.trouble is not None
    assert state.trouble.code is ErrorCode.NOT_FOR_DEVICE
    assert "W2605002" in state.trouble.what
    assert state.session == ()
    state = place.do(BenchController.look)
    assert state.offer is None, "the images are checked again for the bike that was found"
    place.do(BenchController.choose_bike, order(BenchController.choose_image, SET))
    assert set(outcome(upgraded(place)).values()) == {"done"}


@pytest.mark.slow
def test_another_bike_begins_again_and_the_first_one_goes_on(place: BenchPlace) -> None:
    chosen(place, BikeFault.EXCHANGED)
    bike = place.bikes._bikes[BikeFault.EXCHANGED.value]
    bike.ended = place.bench.stop  # type: ignore[method-assign]
    upgraded(place)
    place.bench._stop.clear()
    bike.ended = lambda: None  # type: ignore[method-assign]
    first = [socket.device for socket in bike._places]
    _exchange(place)
    state = upgraded(place)
    assert state.trouble is not None
    assert state.trouble.code is ErrorCode.NOT_FOR_DEVICE
    assert outcome(state) == {"obc": "done", "wmc": "not begun", "bms": "not begun"}
    for socket, device in zip(bike._places, first, strict=True):
        socket.device = device
    state = upgraded(place)
    assert set(outcome(state).values()) == {"done"}
    assert [entry.target.name for entry in state.session] == ["obc", "wmc", "bms"]
    _exchange(place)
    place.do(
        BenchController.look,
        BenchController.choose_bike,
        order(BenchController.choose_image, SET),
    )
    state = upgraded(place)
    assert set(outcome(state).values()) == {"done"}
    assert [entry.target.name for entry in state.session[3:]] == ["obc", "wmc", "bms"]


@pytest.mark.slow
def test_a_battery_exchanged_in_the_last_moment_gets_nothing(place: BenchPlace) -> None:
    chosen(place, BikeFault.EXCHANGED)
    upgrade = place.bikes.upgrade

    def exchanged(adapter: Adapter, job: Job, *args: Any, **named: Any) -> UpgradeEnding:
        if job.plan.target is BMS:
            _exchange(place)
        return upgrade(adapter, job, *args, **named)

    place.bikes.upgrade = exchanged  # type: ignore[method-assign]
    bike = place.bikes._bikes[BikeFault.EXCHANGED.value]
    bike.ended = lambda: None  # type: ignore[method-assign]
    state = upgraded(place)
    assert outcome(state) == {"obc": "done", "wmc": "done", "bms": "failed"}
    assert state.done is not None
    assert state.done.error is not None
    assert state.done.error.code is ErrorCode.NOT_FOR_DEVICE
    assert not state.done.error.needs_rescue
    assert state.done.packet == 0


@pytest.mark.slow
def test_an_adapter_lost_after_the_last_device_leaves_no_device_as_not_begun(
    place: BenchPlace,
) -> None:
    chosen(place)
    seen = place.bench.seen

    def lost(target: Target, *taps: Tap) -> DeviceInfo:
        if place.bench.state.doing is Activity.LOOKING_AGAIN:
            raise BusError("The adapter is gone.")
        return seen(target, *taps)

    place.bench.seen = lost  # type: ignore[method-assign]
    state = upgraded(place)
    assert state.trouble is not None
    assert set(outcome(state).values()) == {"done"}


def test_a_set_of_another_version_than_it_states_is_refused_before_anything_is_sent(
    place: BenchPlace,
) -> None:
    path = place.shelf.folder / SET
    path.write_text(path.read_text() + 'firmware_version = "V9r9r9_20990101"\n')
    state = place.do(
        order(BenchController.use_adapter, BikeFault.NONE.value), BenchController.choose_bike
    )
    offer = next(offer for offer in state.offers if offer.name == SET)
    assert offer.refusal is not None
    assert offer.refusal.code is ErrorCode.MANIFEST
    assert place.do(order(BenchController.choose_image, SET)).trouble is not None


def test_the_bike_is_judged_as_a_whole_before_the_first_device(place: BenchPlace) -> None:
    write_manifest(place.shelf.folder / "bms.bin", "V9r9r9_20990101")
    chosen(place)
    state = upgraded(place)
    assert state.trouble is not None
    assert state.trouble.code is ErrorCode.NOT_FOR_DEVICE
    assert state.devices == ()
    assert state.session == ()


def test_a_bike_that_is_off_is_reported(place: BenchPlace) -> None:
    chosen(place, BikeFault.OFF)
    state = upgraded(place)
    assert state.trouble is not None
    assert state.trouble.code in (ErrorCode.NOBODY_HEARD, ErrorCode.NO_ANSWER)


def test_another_battery_before_the_next_device_ends_it(place: BenchPlace) -> None:
    chosen(place, BikeFault.EXCHANGED)
    bike = place.bikes._bikes[BikeFault.EXCHANGED.value]

    def exchange() -> None:  # at the end of each upgrade
        for socket in bike._places:
            socket.device = socket._made()

    bike.ended = exchange  # type: ignore[method-assign]
    state = upgraded(place)
    assert outcome(state) == {"obc": "done", "wmc": "not begun", "bms": "not begun"}
    assert state.trouble is not None
    assert state.trouble.code is ErrorCode.NOT_FOR_DEVICE
    assert "W2605002" in state.trouble.what


def test_a_dropped_set_is_selected_with_its_images(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    place = BenchPlace(tmp_path_factory.mktemp("place"))
    place.do(order(BenchController.use_adapter, BikeFault.NONE.value), BenchController.choose_bike)
    made = tmp_path_factory.mktemp("made")
    write_set(made)
    for path in sorted(made.iterdir()):
        stored = place.shelf.take(path.name, path.read_bytes())
        assert stored is not None
        place.bench.file_came(stored)
    state = place.do(BenchController.take_files)
    assert state.offer is None or state.offer.name == SET


def test_an_image_that_changed_after_it_was_chosen_is_not_written(place: BenchPlace) -> None:
    chosen(place)
    write_set(place.shelf.folder, ("obc", "bms", "wmc"))
    state = upgraded(place)
    assert state.trouble is not None
    assert "has changed since it was chosen" in state.trouble.what
    assert state.session == ()


@each("name", ["flasher.toml", "new.bin.toml"])
def test_profiles_and_manifests_are_no_sets(
    name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    place = BenchPlace(tmp_path_factory.mktemp("place"))
    (place.shelf.folder / name).write_text("")
    assert name not in [path.name for path in place.shelf.sets()]
