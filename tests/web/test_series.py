"""One bike after the other on the bench: which unit is taken or asked for, what ends it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path

import pytest

from flasher import events
from flasher.errors import BusError, ErrorCode, WrongDeviceError
from flasher.mock.faults import AtTime, PowerCut
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.procedures import DeviceInfo
from flasher.protocol.engine import Tap
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING, Target
from flasher.web.bench import BenchController
from flasher.web.bench_state import Activity, BenchState, Series, SeriesStep, UpgradeEnding
from flasher.web.series import SHOWN_S, take_next_bikes
from flasher.web.virtual_bike import BikeFault, VirtualBike
from tests.loops import each
from tests.web.bench_place import IMAGE, BenchPlace, order, write_manifest

pytestmark = pytest.mark.slow


class Session:
    """A series on a virtual bike; `at` is called once for each new step, and may stop it."""

    def __init__(self, place: BenchPlace, fault: BikeFault, target: str = "bms") -> None:
        self.place, self.bench = place, place.bench
        self.steps: list[Series] = []
        self.at: dict[SeriesStep, Callable[[], None]] = {}
        state = place.do(
            order(BenchController.use_adapter, fault.value),
            order(BenchController.choose_target, target),
            order(BenchController.choose_image, IMAGE),
        )
        assert state.offer is not None
        place.do(order(BenchController.upgrade, state.selection))
        put = self.bench.feed.put

        def seen(subject: str, state: BenchState, *, word: object) -> None:
            put(subject, state, word=word)
            series = state.series
            last = self.steps[-1] if self.steps else None
            if series is not None and (last is None or series.step is not last.step):
                self.steps.append(series)
                self.at.get(series.step, lambda: None)()

        self.bench.feed.put = seen  # type: ignore[method-assign]

    @property
    def bike(self) -> VirtualBike:
        adapter = self.bench.state.adapter
        assert adapter is not None
        return self.place.bikes._bikes[adapter.name]

    def run(self) -> BenchState:
        return self.place.do(take_next_bikes)

    @property
    def names(self) -> list[SeriesStep]:
        return [each.step for each in self.steps]

    def agree(self) -> None:
        """Agree to the question that is shown."""
        self.bench.agree(self.steps[-1].question)

    def stop_after(self, count: int) -> Callable[[], None]:
        """Stop as soon as so many upgrades have ended."""

        def at() -> None:
            if len(self.bench.state.session) >= count:
                self.bench.stop()

        return at


@pytest.fixture
def place(tmp_path: Path) -> BenchPlace:
    return BenchPlace(tmp_path)


def test_one_bike_after_the_other_is_shown_and_upgraded_until_stopped(place: BenchPlace) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    session.at[SeriesStep.REMOVAL] = session.stop_after(3)
    state = session.run()
    assert state.trouble is None
    assert state.series is None
    assert [each.serial for each in state.session] == ["W2605001", "W2605002", "W2605003"]
    assert (state.done_count, state.failed_count) == (3, 0)
    once = [
        SeriesStep.REMOVAL,
        SeriesStep.UNIT,
        SeriesStep.READING,
        SeriesStep.SHOWN,
        SeriesStep.UPGRADING,
    ]
    assert session.names == [*once, *once, SeriesStep.REMOVAL]
    shown = [each for each in session.steps if each.step is SeriesStep.SHOWN]
    assert [(each.serial, each.left_s) for each in shown] == [
        ("W2605002", SHOWN_S),
        ("W2605003", SHOWN_S),
    ]


def test_it_is_off_until_it_is_switched_on_and_needs_an_upgrade_that_succeeded(
    place: BenchPlace,
) -> None:
    assert place.bench.state.series is None
    trouble = place.do(take_next_bikes).trouble
    assert trouble is not None
    assert trouble.code is ErrorCode.USAGE


def test_a_unit_that_stays_is_never_upgraded_again(place: BenchPlace) -> None:
    session = Session(place, BikeFault.NONE)
    upgraded = len(place.bench.state.session)
    turns = 0

    def now() -> float:
        nonlocal turns
        turns += 1
        if turns > 3000:
            place.bench.stop()
        return 0.0

    place.bench.now = now
    state = session.run()
    assert session.names == [SeriesStep.REMOVAL]
    assert len(state.session) == upgraded


def _bounce(session: Session, off_s: float) -> None:
    """Take the power from all devices of the bike, and give it back."""
    for device in session.bike._devices.values():
        device.set(PowerCut(off_s), AtTime(session.bike._clock.now() + 1.0))


def test_the_same_unit_that_comes_back_is_upgraded_only_when_a_user_agrees(
    place: BenchPlace,
) -> None:
    session = Session(place, BikeFault.NONE)
    session.at[SeriesStep.REMOVAL] = lambda: (
        session.bench.stop() if len(session.steps) > 1 else _bounce(session, 5.0)
    )
    session.at[SeriesStep.ASKED] = session.agree
    state = session.run()
    assert SeriesStep.SHOWN not in session.names
    asked = next(each for each in session.steps if each.step is SeriesStep.ASKED)
    assert asked.why == "This unit was upgraded already in this series."
    assert [each.serial for each in state.session] == ["W2605001"] * 2


def test_a_contact_that_bounces_is_no_next_bike(place: BenchPlace) -> None:
    session = Session(place, BikeFault.NONE)
    session.at[SeriesStep.REMOVAL] = lambda: _bounce(session, 0.5)
    turns = 0

    def now() -> float:
        nonlocal turns
        turns += 1
        if turns > 3000:
            place.bench.stop()
        return 0.0

    place.bench.now = now
    session.run()
    assert session.names == [SeriesStep.REMOVAL]


def test_an_agreement_is_for_the_unit_that_was_shown(place: BenchPlace) -> None:
    session = Session(place, BikeFault.NONE)
    session.at[SeriesStep.REMOVAL] = lambda: _bounce(session, 5.0)
    session.bench.agree(1)  # before it was asked
    session.at[SeriesStep.ASKED] = session.bench.stop
    state = session.run()
    assert session.names[-1] is SeriesStep.ASKED
    assert len(state.session) == 1


def test_an_agreement_that_comes_late_is_not_for_the_next_unit(place: BenchPlace) -> None:
    session = Session(place, BikeFault.NONE)
    session.at[SeriesStep.REMOVAL] = lambda: _bounce(session, 5.0)
    asked: list[int] = []

    def ask() -> None:
        asked.append(session.steps[-1].question)
        if len(asked) == 1:
            _bounce(session, 5.0)
            return
        session.bench.agree(asked[0])

    turns = 0

    def now() -> float:
        nonlocal turns
        turns += len(asked) > 1
        if turns > 100:
            place.bench.stop()
        return 0.0

    place.bench.now = now
    session.at[SeriesStep.ASKED] = ask
    state = session.run()
    assert asked == [1, 2]
    assert session.names[-1] is SeriesStep.ASKED
    assert len(state.session) == 1


@each("target", ["wmc", "obc"])
def test_devices_without_a_query_are_distinguished_by_the_battery(
    target: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    session = Session(
        BenchPlace(tmp_path_factory.mktemp("place")), BikeFault.EXCHANGED, target=target
    )
    session.at[SeriesStep.REMOVAL] = session.stop_after(2)
    state = session.run()
    assert state.trouble is None
    assert [(each.target.name, each.serial) for each in state.session] == [
        (target, "W2605001"),
        (target, "W2605002"),
    ]


def test_a_unit_without_serial_number_is_asked_for(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    made = session.bike._device
    monkeypatch.setattr(
        session.bike, "_device", lambda target: _without_serial(made(target), target)
    )
    session.at[SeriesStep.ASKED] = session.bench.stop
    session.run()
    assert session.steps[-1].step is SeriesStep.ASKED
    assert "no serial number" in session.steps[-1].why


def _without_serial(device: MockDevice, target: Target) -> MockDevice:
    if target is not BMS:
        return device
    profile = replace(DeviceProfile(), serial_number="")
    return MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile)


def test_another_unit_than_the_one_shown_is_not_written_to(place: BenchPlace) -> None:
    session = Session(place, BikeFault.EXCHANGED)

    def exchange() -> None:
        for target in session.bike._devices:
            session.bike._bikes[target] += 7
        for socket in session.bike._places:
            socket.device = socket._made()

    session.at[SeriesStep.UPGRADING] = exchange
    session.at[SeriesStep.REMOVAL] = session.stop_after(2)
    state = session.run()
    failed = state.session[-1]
    assert failed.error is not None
    assert failed.error.code is ErrorCode.NOT_FOR_DEVICE
    assert "W2605010" in failed.error.what
    assert not failed.error.needs_rescue
    assert state.done is not None
    assert state.done.packet == 0


@each("target", ["bms", "wmc"])
def test_a_unit_taken_out_in_the_last_seconds_gets_nothing(
    target: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    place = BenchPlace(tmp_path_factory.mktemp("place"))
    session = Session(place, BikeFault.EXCHANGED, target=target)

    def take_out() -> None:
        if len([each for each in session.steps if each.step is SeriesStep.SHOWN]) == 1:
            for socket in session.bike._places:
                socket.due_at = session.bike._clock.now() + SHOWN_S - 1.0

    session.at[SeriesStep.SHOWN] = take_out
    session.at[SeriesStep.REMOVAL] = session.stop_after(2)
    state = session.run()
    assert [(each.serial, each.error) for each in state.session] == [
        ("W2605001", None),
        ("W2605003", None),
    ]


def test_a_unit_whose_adapter_was_lost_after_its_upgrade_is_not_upgraded_again(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    seen = place.bench.seen
    monkeypatch.setattr(session.bike, "ended", lambda: None)  # it stays

    def lost(target: Target, *taps: Tap) -> DeviceInfo:
        if place.bench.state.doing is Activity.LOOKING_AGAIN:
            place.bench.seen = seen  # type: ignore[method-assign]
            raise BusError("The adapter is gone.")
        return seen(target, *taps)

    place.bench.seen = lost  # type: ignore[method-assign]
    place.bench.pause = lambda duration_s: None  # type: ignore[method-assign]  # noqa: ARG005
    turns = 0

    def now() -> float:
        nonlocal turns
        turns += SeriesStep.ADAPTER in session.names
        if turns > 1000:
            place.bench.stop()
        return 0.0

    place.bench.now = now
    session.run()
    assert session.names[-2:] == [SeriesStep.ADAPTER, SeriesStep.REMOVAL]


def test_an_image_that_is_not_meant_for_the_unit_is_not_written(place: BenchPlace) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    write_manifest(place.shelf.folder / IMAGE, "V9r9r9_20990101")
    session.at[SeriesStep.REFUSED] = session.bench.stop
    state = session.run()
    assert session.names[-1] is SeriesStep.REFUSED
    left_out = state.session[-1]
    assert left_out.is_left_out
    assert left_out.error is not None
    assert left_out.error.code is ErrorCode.NOT_FOR_DEVICE
    assert (state.done_count, state.failed_count) == (1, 0)


def test_a_lost_adapter_is_awaited_and_the_series_goes_on(place: BenchPlace) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    unplugged = False

    def unplug() -> None:
        nonlocal unplugged
        if not unplugged:
            unplugged = True
            session.bike._bus.unplug()

    session.at[SeriesStep.UNIT] = unplug
    place.bench.pause = lambda duration_s: None  # type: ignore[method-assign]  # noqa: ARG005
    session.at[SeriesStep.UPGRADING] = session.bench.stop
    state = session.run()
    assert SeriesStep.ADAPTER in session.names
    assert session.names[-1] is SeriesStep.UPGRADING
    assert state.done is not None


def test_an_adapter_that_stays_away_ends_the_series(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    now_s = 0.0

    def pause(duration_s: float) -> None:
        nonlocal now_s
        now_s += duration_s

    place.bench.now = lambda: now_s
    place.bench.pause = pause  # type: ignore[method-assign]

    def gone(*_args: object, **_named: object) -> None:
        raise BusError("The adapter is gone.")

    monkeypatch.setattr(place.bikes, "connect", gone)
    monkeypatch.setattr(type(place.bench.feed), "is_followed", True)
    state = session.run()
    assert state.trouble is not None
    assert state.trouble.what == "The adapter is gone."
    assert state.series is None
    assert now_s >= 300


def test_an_adapter_on_which_sending_always_fails_ends_the_series(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    now_s = 0.0

    def pause(duration_s: float) -> None:
        nonlocal now_s
        now_s += duration_s
        if now_s > 400:
            place.bench.stop()

    def failing(_frame: Frame) -> None:
        raise BusError("The adapter does not send.")

    place.bench.now = lambda: now_s
    place.bench.pause = pause  # type: ignore[method-assign]
    monkeypatch.setattr(type(place.bench.feed), "is_followed", True)
    monkeypatch.setattr(session.bike._link, "send", failing)
    for socket in session.bike._places:
        socket.device, socket.due_at = None, inf
    state = session.run()
    assert state.trouble is not None
    assert state.trouble.what == "The adapter does not send."
    assert 300 <= now_s <= 302


def test_an_adapter_that_was_lost_again_later_is_awaited_as_long_again(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session(place, BikeFault.NONE)
    now_s, losses = 0.0, 0

    def pause(_duration_s: float) -> None:
        nonlocal now_s
        now_s += 200

    link = session.bike._link
    receive = link.receive
    received = 0

    def lost_after_some(deadline: float) -> Frame | None:
        nonlocal received, losses
        frame = receive(deadline)
        received += frame is not None
        if received == 5:
            received, losses = 0, losses + 1
            if losses == 4:
                place.bench.stop()
            session.bike._bus.unplug()
        return frame

    place.bench.now = lambda: now_s
    place.bench.pause = pause  # type: ignore[method-assign, assignment]
    monkeypatch.setattr(type(place.bench.feed), "is_followed", True)
    monkeypatch.setattr(link, "receive", lost_after_some)
    state = session.run()
    assert state.trouble is None
    assert losses == 4


def test_a_closed_page_ends_the_series(place: BenchPlace) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    turns = 0

    def now() -> float:
        nonlocal turns
        turns += 1
        return turns * 0.01

    place.bench.now = now
    state = session.run()
    assert state.trouble is not None
    assert state.trouble.what == "The page was closed: no further bike was taken."
    assert len(state.session) == 1


def test_a_file_that_comes_ends_the_series_loudly(place: BenchPlace) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    session.at[SeriesStep.UNIT] = lambda: place.bench.file_came(place.shelf.folder / IMAGE)
    state = session.run()
    assert state.trouble is not None
    assert "A file came" in state.trouble.what
    assert len(state.session) == 1


def _overwrite(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def test_a_unit_whose_upgrade_was_refused_is_not_called_upgraded(place: BenchPlace) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    upgrade = place.bikes.upgrade

    def refused(*_args: object, **_named: object) -> UpgradeEnding:
        error = WrongDeviceError("The charge is too low.", code=ErrorCode.NOT_FOR_DEVICE)
        return UpgradeEnding(None, error, None)

    def refuse() -> None:
        place.bikes.upgrade = refused  # type: ignore[method-assign]

    def again() -> None:
        place.bikes.upgrade = upgrade  # type: ignore[method-assign]
        if place.bench.state.failed_count:
            _bounce(session, 5.0)

    session.at[SeriesStep.UPGRADING] = refuse
    session.at[SeriesStep.REMOVAL] = again
    session.at[SeriesStep.ASKED] = session.bench.stop
    session.run()
    assert session.steps[-1].why == "The upgrade of this unit has failed in this series."


def test_an_image_that_was_exchanged_ends_the_series(place: BenchPlace) -> None:
    session = Session(place, BikeFault.EXCHANGED)
    path = place.shelf.folder / IMAGE
    data = path.read_bytes()
    session.at[SeriesStep.UNIT] = partial(_overwrite, path, data + bytes(64))
    state = session.run()
    assert state.trouble is not None
    assert "has changed since the first bike" in state.trouble.what


def test_a_unit_taken_out_in_its_upgrade_ends_the_series_with_its_rescue(
    place: BenchPlace,
) -> None:
    session = Session(place, BikeFault.EXCHANGED)

    def hold(event: object) -> None:
        if isinstance(event, events.PacketAcknowledged) and event.number == 5 and session.steps:
            for socket in session.bike._places:
                socket.due_at = session.bike._clock.now()

    place.bikes.hold = hold
    state = session.run()
    assert state.done is not None
    assert state.done.error is not None
    assert state.series is None
    assert state.failed_count == 1


@each("collides", [False, True])
def test_two_bikes_at_once_get_nothing_by_themselves(
    collides: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    session = Session(BenchPlace(tmp_path_factory.mktemp("place")), BikeFault.EXCHANGED)

    def add() -> None:
        profile = replace(DeviceProfile(), serial_number="W2605900")
        session.bike._bus._collides = collides
        session.bike._bus.attach(MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile))

    session.at[SeriesStep.READING] = add
    session.at[SeriesStep.REFUSED] = session.at[SeriesStep.ASKED] = session.bench.stop
    state = session.run()
    assert SeriesStep.UPGRADING not in session.names
    if collides:  # their answers destroy each other
        assert session.names[-1] is SeriesStep.ASKED
        return
    assert session.names[-1] is SeriesStep.REFUSED
    assert state.session[-1].is_left_out
    assert state.session[-1].error is not None
    assert state.session[-1].error.code is ErrorCode.TWO_DEVICES
