"""The bench without a page: what each order makes of it, and how upgrades end."""

from __future__ import annotations

import errno
import itertools
import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NoReturn

import pytest
from intelhex import IntelHex

from flasher import events
from flasher.cli.upgrade.bench_page import LastChoices
from flasher.errors import (
    BusError,
    ErrorCode,
    ImageError,
    InterruptedByUserError,
    NoAnswerError,
    RefusedError,
    TransferError,
    UsageError,
    WrongDeviceError,
)
from flasher.history import MOCK, Began, Flash, FlashHistory, Reached, latest_left_open
from flasher.host.event_text import progress_line
from flasher.host.verify import Level, Verdict, Verification
from flasher.i18n import Text, text, without_options
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.store import AREA_START
from flasher.protocol.contents import VersionInformation
from flasher.protocol.fields import WireText
from flasher.protocol.spec import BMS, WELLING, Target
from flasher.translation import translator
from flasher.web.bench import BenchController, Order
from flasher.web.bench_backup import back_up, find_areas
from flasher.web.bench_page import as_it_is_now, battery_answers, facts
from flasher.web.bench_state import Activity, BenchState, Done
from flasher.web.bench_watch import watch
from flasher.web.pages import page_text
from flasher.web.virtual_bike import BikeFault
from tests.end_to_end.stage import NEW, OLD, image_of
from tests.loops import each
from tests.web.bench_place import IMAGE, PACKETS, BenchPlace, order, write_manifest


@pytest.fixture
def place(tmp_path: Path) -> BenchPlace:
    return BenchPlace(tmp_path)


def _upgrade(state: BenchState) -> Order:
    assert state.target is not None
    assert state.offer is not None
    return order(BenchController.upgrade, state.selection)


def _chosen(
    place: BenchPlace, fault: BikeFault = BikeFault.NONE, target: str = "bms"
) -> BenchState:
    return place.do(
        order(BenchController.use_adapter, fault.value),
        order(BenchController.choose_target, target),
        order(BenchController.choose_image, IMAGE),
    )


def _done(place: BenchPlace, fault: BikeFault = BikeFault.NONE, target: str = "bms") -> Done:
    state = place.do(_upgrade(_chosen(place, fault, target)))
    assert state.trouble is None
    assert state.done is not None
    return state.done


def _version(done: Done, which: str) -> str:
    seen = getattr(done, which)
    answers = [each.answer for each in seen.readings]
    (version,) = (each for each in answers if isinstance(each, VersionInformation))
    return str(version.firmware_version)


# -- a good upgrade --------------------------------------------------------------------------------


def test_an_upgrade_makes_three_claims_and_shows_before_and_after(place: BenchPlace) -> None:
    done = _done(place)
    assert (done.is_transferred, done.is_completed, done.is_running) == (True, True, True)
    assert done.error is None
    assert done.packet == PACKETS
    assert (_version(done, "before"), _version(done, "after")) == (OLD, NEW)


def test_a_device_that_cannot_be_asked_is_not_reported_to_run_anything(place: BenchPlace) -> None:
    done = _done(place, target="wmc")
    assert (done.is_transferred, done.is_completed, done.is_running) == (True, True, None)


def test_it_is_kept_in_the_history_as_by_the_command(place: BenchPlace) -> None:
    before = len(FlashHistory().flashes()[0])
    _done(place)
    flashes, _ = FlashHistory().flashes()
    assert len(flashes) == before + 1
    assert flashes[-1].began.command == "flash"
    assert flashes[-1].began.is_virtual
    assert flashes[-1].ended is not None
    assert flashes[-1].ended.running_version == NEW


@pytest.mark.slow
def test_an_upgrade_that_the_history_cannot_take_is_reported(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert _done(place).warning == ""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "file"))
    done = _done(place)
    assert done.is_completed
    assert done.warning.startswith("no history in ")


@pytest.mark.slow
@each(
    "target, serial, words",
    [
        ("bms", "W2605777", "The unit W2605777 answers now, and W2605001 answered before"),
        ("bms", "", "The unit without serial number answers now, and W2605001 answered before"),
        ("wmc", "W2605777", "The BMS has the serial number W2605777, and had W2605001"),
    ],
)
def test_another_bike_than_the_one_shown_gets_nothing(
    target: str, serial: str, words: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    place = BenchPlace(tmp_path_factory.mktemp("place"))
    state = _chosen(place, BikeFault.EXCHANGED, target=target)
    bike = place.bikes._bikes[BikeFault.EXCHANGED.value]
    made = bike._device

    def other(target: Target) -> MockDevice:
        if target is not BMS:
            return made(target)
        profile = replace(DeviceProfile(), serial_number=serial)
        return MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile)

    bike._device = other  # type: ignore[method-assign]
    for socket in bike._places:
        socket.device = socket._made()
    state = place.do(_upgrade(state))
    error = state.trouble if state.done is None else state.done.error
    assert error is not None
    assert error.code is ErrorCode.NOT_FOR_DEVICE
    assert words in error.what
    assert not error.needs_rescue
    assert state.packet == 0
    assert state.done is None or state.done.result is None, "no user has cancelled it"


def test_the_next_bike_begins_with_nothing_of_the_last(place: BenchPlace) -> None:
    _done(place)
    state = place.do(BenchController.start_over)
    assert (state.done, state.bike, state.offer, state.adapter) == (None,) * 4
    assert len(state.adapters) == len(BikeFault)


# -- images ----------------------------------------------------------------------------------------


def test_only_images_that_fit_are_offered_and_the_others_state_why(place: BenchPlace) -> None:
    state = place.do(
        order(BenchController.use_adapter, BikeFault.NONE.value),
        order(BenchController.choose_target, "bms"),
    )
    assert [(each.name, type(each.refusal)) for each in state.offers] == [
        (IMAGE, type(None)),
        ("broken.hex", ImageError),
    ]
    state = place.do(order(BenchController.choose_image, "broken.hex"))
    assert isinstance(state.trouble, UsageError)
    assert state.offer is None


def test_an_image_for_other_hardware_is_not_offered_to_the_bike_that_answered(
    place: BenchPlace, tmp_path: Path
) -> None:
    write_manifest(tmp_path / IMAGE, "V1r2r0_*")
    assert _chosen(place).offer is not None
    state = place.do(
        order(BenchController.use_adapter, BikeFault.HARDWARE.value),
        order(BenchController.choose_target, "bms"),
    )
    refusals = {each.name: each.refusal for each in state.offers}
    assert isinstance(refusals[IMAGE], WrongDeviceError)


def test_a_dropped_image_is_offered_and_what_is_none_is_not_taken(place: BenchPlace) -> None:
    assert place.shelf.take("../../dropped.bin", image_of(3, NEW).data)
    for name in ("run.sh", ".bin", "", "a\nb.bin", "x" * 300 + ".bin"):
        assert place.shelf.take(name, b"x") is None, name
    state = place.do(
        order(BenchController.use_adapter, BikeFault.NONE.value),
        order(BenchController.choose_target, "bms"),
    )
    assert [each.name for each in state.offers if not each.refusal] == ["dropped.bin", IMAGE]


def test_a_name_is_shown_as_people_write_it_and_what_hides_is_not(
    place: BenchPlace, tmp_path: Path
) -> None:
    for name in ("固件 ü.bin", "a\u202eb.bin"):
        (tmp_path / name).write_bytes(image_of(3, NEW).data)
    state = place.do(
        order(BenchController.use_adapter, BikeFault.NONE.value),
        order(BenchController.choose_target, "bms"),
    )
    fitting = {each.name for each in state.offers if not each.refusal}
    assert fitting == {IMAGE, "固件 ü.bin", "a\\u202eb.bin"}
    for name in fitting:
        assert place.do(order(BenchController.choose_image, name)).offer is not None


def test_an_image_that_changed_since_it_was_chosen_is_not_sent(
    place: BenchPlace, tmp_path: Path
) -> None:
    state = _chosen(place)
    (tmp_path / IMAGE).write_bytes(image_of(PACKETS, OLD).data)
    state = place.do(_upgrade(state))
    assert isinstance(state.trouble, ImageError)
    assert state.done is None


@pytest.mark.slow
def test_an_order_from_a_page_that_was_not_up_to_date_sends_nothing(place: BenchPlace) -> None:
    shown = _chosen(place).selection
    image = order(BenchController.choose_image, IMAGE)
    target = order(BenchController.choose_target, "bms")
    for meanwhile in (
        (order(BenchController.keep_settings, "yes"),),
        (order(BenchController.choose_target, "wmc"), image),
        (order(BenchController.use_adapter, BikeFault.EXCHANGED.value), target, image),
        (
            order(BenchController.start_over, is_rescue=True),
            order(BenchController.use_adapter, BikeFault.NONE.value), target, image,
        ),
    ):  # fmt: skip
        _chosen(place)
        assert place.bench.state.selection == shown
        place.do(*meanwhile)
        state = place.do(order(BenchController.upgrade, shown))
        assert isinstance(state.trouble, UsageError)
        assert state.done is None
        place.do(BenchController.start_over)


def test_the_folder_of_images_is_chosen_and_remembered(place: BenchPlace, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "other.bin").write_bytes(image_of(3, NEW).data)
    state = place.do(
        order(BenchController.use_adapter, BikeFault.NONE.value),
        order(BenchController.choose_target, "bms"),
        order(BenchController.use_folder, str(other)),
    )
    assert [each.name for each in state.offers] == ["other.bin"]
    assert LastChoices().kept("images") == str(other)
    for wrong in (
        "", str(other / "other.bin"), "/no/such/folder", "~no_such_user/x", "a" * 5000, "\0",
    ):  # fmt: skip
        state = place.do(order(BenchController.use_folder, wrong))
        assert isinstance(state.trouble, UsageError)
        assert place.shelf.folder == other


def test_a_folder_that_may_not_be_listed_is_not_chosen(
    place: BenchPlace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_folder: Path) -> NoReturn:
        raise PermissionError(errno.EACCES, "Permission denied")

    state = place.do(order(BenchController.use_adapter, BikeFault.NONE.value))
    with monkeypatch.context() as patch:
        patch.setattr(Path, "iterdir", refuse)
        state = place.do(order(BenchController.use_folder, str(tmp_path)))
    assert isinstance(state.trouble, UsageError)
    assert "Permission denied" in state.trouble.what


# -- checks that are waived ------------------------------------------------------------------------


def test_a_check_that_refused_is_waived_for_this_image_and_is_in_the_record(
    place: BenchPlace, tmp_path: Path
) -> None:
    write_manifest(tmp_path / IMAGE, "V1r2r0_*")
    place.do(
        order(BenchController.use_adapter, BikeFault.HARDWARE.value),
        order(BenchController.choose_target, "bms"),
    )
    state = place.do(order(BenchController.waive, IMAGE, "hardware"))
    assert state.offer is not None
    assert state.offer.waived == ("hardware",)
    done = place.do(_upgrade(state)).done
    assert done is not None
    assert done.is_completed
    assert ("hardware", "waived") in {(each.check, each.verdict) for each in done.checks}
    assert FlashHistory().flashes()[0][-1].began.waived == "hardware"
    state = place.do(
        BenchController.start_over,
        order(BenchController.use_adapter, BikeFault.HARDWARE.value),
        order(BenchController.choose_target, "bms"),
    )
    assert IMAGE not in {each.name for each in state.offers if not each.refusal}


def test_only_the_check_that_refused_can_be_waived(place: BenchPlace, tmp_path: Path) -> None:
    write_manifest(tmp_path / IMAGE, "V1r2r0_*")
    place.do(
        order(BenchController.use_adapter, BikeFault.HARDWARE.value),
        order(BenchController.choose_target, "bms"),
    )
    for ordered in (
        order(BenchController.waive, IMAGE, "downgrade"),
        order(BenchController.waive, "broken.hex", ""),
        order(BenchController.waive, "no", "hardware"),
    ):
        state = place.do(ordered)
        assert isinstance(state.trouble, UsageError)
        assert (state.offer, state.waived) == (None, frozenset())


def test_a_check_that_refused_in_the_upgrade_is_waived_after_it(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    riding = partial(DeviceProfile, battery_use="riding")
    monkeypatch.setattr("flasher.web.virtual_bike.DeviceProfile", riding)
    done = _done(place)
    assert isinstance(done.error, WrongDeviceError)
    assert done.error.waiver == "in-use"
    state = place.do(order(BenchController.waive, IMAGE, "in-use"))
    done = place.do(_upgrade(state)).done or done
    assert done.is_completed


# -- bad ends --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("language", "text"),
    [
        ("en", "the adapter was away or this computer suspended for 1.5 s"),
        ("de", "1,5 s lang war der Adapter weg oder dieser Rechner im Ruhezustand"),
        ("zh", "适配器断开或本计算机休眠了 1.5 s"),
    ],
)
def test_time_in_which_the_adapter_was_away_is_a_claim_of_its_own(
    place: BenchPlace, language: str, text: str
) -> None:
    done = _done(place)
    assert done.result is not None
    away = replace(done.result, outcome=replace(done.result.outcome, unobserved_s=1.5))
    translate = translator(language)
    for shown, is_shown in ((done, False), (replace(done, result=away), True)):
        sheet = page_text(
            "bench_sheet.html",
            translate,
            "",
            upgrades=[(shown, [], [])],
            waivers={},
            is_saved=True,
        )
        assert (text in sheet) == is_shown


@pytest.mark.parametrize(
    ("fault", "error", "claims"),
    [
        (BikeFault.POWER, TransferError, (False, False, None)),
        (BikeFault.PULLED, BusError, (None, None, None)),
        (BikeFault.SECOND_TOOL, BusError, (False, False, None)),
        (BikeFault.REFUSES, RefusedError, (True, False, None)),
    ],
)
def test_a_bad_end_states_what_happened_and_claims_no_more_than_is_known(
    place: BenchPlace, fault: BikeFault, error: type[Exception], claims: tuple[bool | None, ...]
) -> None:
    done = _done(place, fault)
    assert type(done.error) is error
    assert (done.is_transferred, done.is_completed, done.is_running) == claims
    assert done.error is not None
    assert done.error.needs_rescue
    assert "State of the device:" in done.error.remedy
    assert "command" not in done.error.remedy
    assert done.bundle is not None
    assert done.bundle.is_dir()
    if fault is not BikeFault.REFUSES:
        rescued = place.do(BenchController.rescue_it, lambda bench: _upgrade(bench.state)(bench))
        assert rescued.done is not None
        assert rescued.done.error is None, "the fault is over"


def test_a_bootloader_that_announces_itself_instead_runs_no_new_version(place: BenchPlace) -> None:
    done = _done(place)
    assert done.result is not None
    for verdict, is_running in ((Verdict.IN_BOOTLOADER, False), (Verdict.NO_ANSWER, None)):
        verification = Verification(Level.VERSION, verdict)
        result = replace(done.result, verification=verification)
        assert replace(done, result=result).is_running is is_running


def test_a_bad_end_is_reported_in_the_language_of_the_page(place: BenchPlace) -> None:
    error = _done(place, BikeFault.POWER).error
    assert error is not None
    assert "Rescue this device." in error.remedy
    german = translator("de")
    assert german(error.what).startswith("BMS: ein Paket wurde nicht bestätigt")
    assert german(error.where) == "wird übertragen, Paket 8 von 20, Versuch 3"
    assert "Dieses Gerät retten." in german(error.remedy)
    assert "Zustand des Geräts: seine Anwendung" in german(error.remedy)


@pytest.mark.slow
def test_a_device_whose_upgrade_failed_is_rescued_with_the_same_image(place: BenchPlace) -> None:
    _done(place, BikeFault.POWER)
    state = place.do(BenchController.rescue_it)
    assert state.is_rescue
    assert state.offer is not None
    asked: list[float] = []
    place.bikes.hold = lambda _: asked.extend(
        [place.bench.state.power_cycle_s] if place.bench.state.power_cycle_s else []
    )
    done = place.do(_upgrade(state)).done
    assert done is not None
    assert asked[0] == 60.0
    assert (done.is_completed, done.is_running) == (True, True)
    assert place.bench.state.power_cycle_s is None


def test_a_unit_that_is_rescued_is_not_taken_for_the_one_before(place: BenchPlace) -> None:
    done = _done(place, BikeFault.POWER)
    assert done.before is not None
    state = place.do(BenchController.rescue_it)
    assert state.bike is not None
    version = state.bike.version
    assert isinstance(version, VersionInformation)
    other = replace(version, serial_number=WireText(b"W2605777"))
    readings = tuple(
        replace(each, answer=other) if each.answer is version else each
        for each in state.bike.readings
    )
    place.bench.show(bike=replace(state.bike, readings=readings))
    rescued = place.do(_upgrade(place.bench.state)).done
    assert rescued is not None
    assert rescued.before is None
    assert rescued.after is not None
    assert place.bench.state.session[-1].serial == "W2605001"


def test_the_wait_for_a_lost_adapter_is_counted_down(place: BenchPlace) -> None:
    seen: list[int | None] = []
    put = place.bench.feed.put

    def watched(subject: str, state: BenchState, *, word: object) -> None:
        put(subject, state, word=word)
        if seen[-1:] != [state.adapter_left_s]:
            seen.append(state.adapter_left_s)

    place.bench.feed.put = watched  # type: ignore[method-assign]
    assert isinstance(_done(place, BikeFault.PULLED).error, BusError)
    assert seen == [None, 5, 4, 3, 2, 1, None]


@pytest.mark.slow
def test_the_wait_for_the_power_is_counted_down(tmp_path: Path) -> None:
    ticks = itertools.count(0.0, 0.25)
    place = BenchPlace(tmp_path, lambda: next(ticks))
    seen: list[int] = []
    put = place.bench.feed.put

    def watched(subject: str, state: BenchState, *, word: object) -> None:
        put(subject, state, word=word)
        seen.extend([state.power_cycle_left_s(state.now_s)] * (state.power_cycle_s is not None))

    place.bench.feed.put = watched  # type: ignore[method-assign]
    _done(place, BikeFault.POWER)
    place.do(_upgrade(place.do(BenchController.rescue_it)))
    assert seen[0] in (59, 60)
    assert len(set(seen)) > 5
    assert seen == sorted(seen, reverse=True)


def test_an_image_that_the_device_has_refused_is_not_chosen_for_its_rescue(
    place: BenchPlace,
) -> None:
    _done(place, BikeFault.REFUSES)
    state = place.do(BenchController.rescue_it)
    assert state.offers
    assert state.offer is None


def test_a_bike_that_was_interrupted_before_is_rescued_from_the_start(place: BenchPlace) -> None:
    state = place.do(
        order(BenchController.start_over, is_rescue=True),
        order(BenchController.use_adapter, BikeFault.NO_APPLICATION.value),
        order(BenchController.choose_target, "obc"),
        order(BenchController.choose_image, IMAGE),
    )
    done = place.do(_upgrade(state)).done
    assert done is not None
    assert done.is_completed


def test_a_bike_that_is_off_is_reported_as_off(place: BenchPlace) -> None:
    assert isinstance(
        place.do(order(BenchController.use_adapter, BikeFault.OFF.value)).trouble, NoAnswerError
    )


# -- one thing at a time ---------------------------------------------------------------------------


def _at_packet(number: int, do: Callable[[], None]) -> Callable[[object], None]:
    def hold(event: object) -> None:
        if isinstance(event, events.PacketAcknowledged) and event.number == number:
            do()

    return hold


@pytest.mark.parametrize("end", [BenchController.stop, BenchController.close])
def test_who_stops_it_learns_in_which_state_the_device_is_left(
    place: BenchPlace, end: Callable[[BenchController], None]
) -> None:
    place.bikes.hold = _at_packet(7, lambda: end(place.bench))
    done = _done(place)
    assert isinstance(done.error, InterruptedByUserError)
    assert done.error.needs_rescue
    assert "its application is erased, half written or not accepted" in done.error.remedy
    assert done.packet in (7, 8)


def test_a_terminal_that_is_gone_does_not_end_an_upgrade(place: BenchPlace) -> None:
    place.bikes.hold = _at_packet(7, lambda: place.bench.close(ends_upgrade=False))
    assert _done(place).error is None


def test_while_it_does_something_it_takes_no_other_order(place: BenchPlace) -> None:
    assert place.bench.order(BenchController.find_adapters)
    assert not place.bench.order(BenchController.start_over)


@pytest.mark.parametrize(
    "ordered",
    [
        BenchController.look,
        BenchController.judge,
        watch,
        find_areas,
        order(back_up, ""),
        order(BenchController.choose_target, "bms"),
        order(BenchController.use_adapter, "none"),
        BenchController.rescue_it,
        order(BenchController.upgrade, ""),
        order(BenchController.waive, IMAGE, "hardware"),
    ],
)
def test_an_order_out_of_turn_is_refused_in_words(place: BenchPlace, ordered: Order) -> None:
    state = place.do(ordered)
    assert isinstance(state.trouble, UsageError)
    assert state.trouble.remedy
    assert state.doing is Activity.NOTHING


# -- looking closer --------------------------------------------------------------------------------


def test_what_is_sent_on_the_bus_is_shown_until_it_is_stopped(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    place.do(order(BenchController.use_adapter, BikeFault.HARDWARE.value))
    looks: list[BenchState] = []

    def put(_subject: str, state: BenchState, **_: object) -> None:
        looks.append(state)
        if state.watched is not None and state.watched.messages > 10:
            place.bench.stop()

    monkeypatch.setattr(place.bench.feed, "put", put)
    state = place.do(watch)
    assert state.trouble is None
    assert state.watched is not None
    assert {each.doing for each in looks} == {Activity.WATCHING, Activity.NOTHING}
    rows = {each.seen.marked_title: each.seen for each in state.watched.board}
    running = rows["running information"]
    assert running.route == "BMS > all"
    assert {"voltage", "state of charge"} <= {each.label for each in running.fields}
    assert any(each.seen.is_trouble for each in state.watched.board)  # the fault of this bike
    assert place.do(order(BenchController.use_adapter, BikeFault.NONE.value)).watched is None


def test_the_bus_is_watched_in_the_time_of_its_messages(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    place.do(order(BenchController.use_adapter, BikeFault.NONE.value))
    put = place.bench.feed.put

    def stop_after_a_minute(subject: str, state: BenchState, *, word: object) -> None:
        put(subject, state, word=word)
        if state.watched is not None and state.watched.since_s >= 60:
            place.bench.stop()

    monkeypatch.setattr(place.bench.feed, "put", stop_after_a_minute)
    watched = place.do(watch).watched
    assert watched is not None
    row = watched.board[0]
    assert row.rate_hz is not None
    assert watched.since_s == pytest.approx(row.count / row.rate_hz, rel=0.1)


def test_a_bus_that_fails_while_it_is_watched_is_reported(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    place.do(order(BenchController.use_adapter, BikeFault.NONE.value))
    monkeypatch.setattr("flasher.web.bench_watch.drive", _lost)
    state = place.do(watch)
    assert isinstance(state.trouble, BusError)
    assert state.doing is Activity.NOTHING


def _lost(*_: object, **__: object) -> None:
    raise BusError("The adapter is gone.")


def test_another_battery_than_the_one_shown_is_not_saved(place: BenchPlace) -> None:
    place.do(order(BenchController.use_adapter, BikeFault.EXCHANGED.value))
    for socket in place.bikes._bikes[BikeFault.EXCHANGED.value]._places:
        socket.device = socket._made()
    state = place.do(order(back_up, ""))
    assert state.saved is None
    assert isinstance(state.trouble, WrongDeviceError)


@pytest.mark.slow
def test_memory_and_answers_are_saved_to_a_file_as_by_the_command(place: BenchPlace) -> None:
    state = place.do(order(BenchController.use_adapter, BikeFault.NONE.value), find_areas)
    assert state.areas is not None
    (area,) = state.areas  # new.bin has no addresses, and broken.hex is no image
    saved = place.do(order(back_up, area.source)).saved
    assert saved is not None
    assert saved.path.parent.name == "backups"
    assert saved.path.name.startswith("bms-W2605001-")
    assert saved.names_running_version
    with zipfile.ZipFile(saved.path) as archive:
        assert set(archive.namelist()) == {"backup.json", "memory.hex"}
    assert place.bench.state.saved_bytes == area.size_bytes
    assert place.bench.state.areas is None


def test_the_addresses_of_a_backup_may_be_those_of_an_image(
    place: BenchPlace, tmp_path: Path
) -> None:
    image = IntelHex()
    image.frombytes(image_of(3, NEW).data, offset=0x0800_4000)
    image.write_hex_file(str(tmp_path / "running.hex"))
    state = place.do(order(BenchController.use_adapter, BikeFault.NONE.value), find_areas)
    assert [each.start for each in state.areas or ()] == [AREA_START, 0x0800_4000]
    state = place.do(order(back_up, (state.areas or ())[1].source))
    assert state.saved is not None
    assert state.saved.area is not None
    assert state.saved.area.source.endswith("running.hex")


def test_a_backup_without_memory_states_what_is_not_in_it(place: BenchPlace) -> None:
    saved = place.do(
        order(BenchController.use_adapter, BikeFault.NONE.value), order(back_up, "")
    ).saved
    assert saved is not None
    assert (saved.area, saved.names_running_version) == (None, None)
    assert "memory" in saved.missing


def test_nothing_is_saved_of_a_battery_that_is_silent_or_where_nothing_can_be_written(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    state = place.do(order(BenchController.use_adapter, BikeFault.OFF.value), order(back_up, ""))
    assert isinstance(state.trouble, NoAnswerError)
    assert state.saved is None
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "file"))
    state = place.do(order(BenchController.use_adapter, BikeFault.NONE.value), order(back_up, ""))
    assert isinstance(state.trouble, UsageError)
    assert state.saved is None


def test_what_the_battery_reported_is_shown_in_the_words_of_the_command(place: BenchPlace) -> None:
    state = place.do(order(BenchController.use_adapter, BikeFault.NONE.value))
    found = dict(battery_answers(state))
    assert found["faults"] == [("faults", "none received")]
    assert ("cycles", "12") in found["history"]
    assert "not answered" not in found
    ((_, faults),) = dict(
        battery_answers(place.do(order(BenchController.use_adapter, BikeFault.HARDWARE.value)))
    )["faults"]
    assert faults == "over discharge protection"
    assert translator("de")(faults) == "Schutz: Tiefentladung"


def test_the_upgrade_that_has_no_end_is_among_the_notes(place: BenchPlace) -> None:
    place.bench._happened(events.UpgradeLeftOpen("2026-05-17T10:31:02+02:00", "a.hex", False))
    (note,) = place.bench.state.notes
    assert "2026-05-17 10:31:02+02:00 with a.hex has no end" in note


# -- files that come while an image is selected ---------------------------------------------------


def _drop(place: BenchPlace, name: str, data: bytes) -> BenchState:
    path = place.shelf.take(name, data)
    assert path is not None
    place.bench.file_came(path)
    return place.do(BenchController.take_files)


def test_the_file_that_came_last_replaces_the_selected_image(place: BenchPlace) -> None:
    _chosen(place)
    state = _drop(place, "newer.bin", image_of(PACKETS + 1, NEW).data)
    assert state.offer is not None
    assert state.offer.name == "newer.bin"


@pytest.mark.slow
@each(
    "name, data",
    [
        ("tiny.bin", bytes(range(16))),
        ("page.bin", b"<!doctype html><title>404</title>\n" * 9),
        ("motor.bin", image_of(PACKETS, NEW).data + b"\0WMC V1r0r4_20220512\0"),
        ("broken.s19", b"S1"),
    ],
)
def test_a_file_that_is_refused_takes_the_selected_image_away_and_states_why(
    name: str, data: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    place = BenchPlace(tmp_path_factory.mktemp("place"))
    _chosen(place)
    state = _drop(place, name, data)
    assert state.offer is None
    assert state.trouble is not None


def test_a_manifest_that_comes_later_keeps_the_image_that_was_chosen(place: BenchPlace) -> None:
    _drop(place, "dropped.bin", image_of(PACKETS + 1, NEW).data)
    _chosen(place)
    state = _drop(place, "dropped.bin.toml", b"format = 1\n")
    assert state.offer is not None
    assert state.offer.name == IMAGE


def test_a_dropped_image_hides_the_one_of_its_name_in_the_folder(place: BenchPlace) -> None:
    _chosen(place)
    other = image_of(PACKETS + 1, NEW)
    state = _drop(place, IMAGE, other.data)
    assert state.offer is not None
    assert state.offer.sha256 == other.sha256
    assert [each.name for each in state.offers].count(IMAGE) == 1


def test_an_order_given_while_a_file_comes_sends_nothing(place: BenchPlace) -> None:
    upgrade = _upgrade(_chosen(place))
    path = place.shelf.take("newer.bin", image_of(PACKETS + 1, NEW).data)
    assert path is not None
    place.bench.file_came(path)
    state = place.do(upgrade)
    assert isinstance(state.trouble, UsageError)
    assert state.done is None


def test_a_file_for_a_failed_upgrade_is_the_one_that_rescues(place: BenchPlace) -> None:
    state = place.do(_upgrade(_chosen(place, BikeFault.POWER)))
    assert state.done is not None
    assert state.done.error is not None
    _drop(place, "newer.bin", image_of(PACKETS + 1, NEW).data)
    assert place.bench.state.done is not None, "its result stays on the page"
    state = place.do(BenchController.rescue_it)
    assert state.offer is not None
    assert state.offer.name == "newer.bin"


# -- what the page shows --------------------------------------------------------------------------


def test_after_an_upgrade_the_page_shows_the_new_version_as_the_bikes(place: BenchPlace) -> None:
    before = place.do(order(BenchController.use_adapter, BikeFault.NONE.value))
    assert OLD in dict(facts(as_it_is_now(before))).values()
    _done(place)
    shown = as_it_is_now(place.bench.state)
    assert NEW in dict(facts(shown)).values()
    assert OLD not in str(battery_answers(shown))
    done = place.bench.state.done
    assert done is not None
    unknown = replace(place.bench.state, done=replace(done, after=None))
    assert facts(as_it_is_now(unknown)) == []


def test_an_unfinished_upgrade_is_offered_with_its_adapter_device_and_image(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = image_of(PACKETS, NEW)
    began = Began(
        at="2026-05-17T10:31:02+02:00", command="flash", target="bms", is_virtual=False,
        adapter=BikeFault.NONE.value, image=IMAGE, image_sha256=image.sha256,
        image_size_bytes=image.size_bytes, image_version=NEW,
    )  # fmt: skip
    flash = Flash(began, None, reached=Reached("transfer", 12))
    monkeypatch.setattr(place.bikes, "unfinished", lambda: flash)
    state = place.do(BenchController.find_adapters)
    assert state.unfinished is flash
    state = place.do(BenchController.rescue_unfinished)
    assert state.is_rescue
    assert state.target is BMS
    assert state.offer is not None
    assert state.offer.sha256 == image.sha256


def test_the_latest_upgrade_without_an_end_is_found_until_its_device_has_an_application(
    tmp_path: Path,
) -> None:
    history = FlashHistory(tmp_path / "history.jsonl")
    began = Began(
        at="2026-05-17T10:31:02+02:00", command="flash", target="bms", is_virtual=False,
        adapter="socketcan can0", image="a.hex", image_sha256="0" * 64, image_size_bytes=1,
        image_version=None,
    )  # fmt: skip
    assert latest_left_open(history.flashes()[0]) is None
    name = history.begin(began)
    history.reached(name, Reached("transfer", 3))
    flashes = [replace(each, is_running=False) for each in history.flashes()[0]]
    assert latest_left_open(flashes) is flashes[0]
    virtual = [replace(each, began=replace(began, adapter=MOCK)) for each in flashes]
    assert latest_left_open(virtual) is None


@each("code", ["de", "zh"])
def test_no_english_is_left_in_a_step_that_a_page_shows_in_another_language(code: str) -> None:
    translate = translator(code)
    steps = (
        events.AttemptStarted(2, "restarted", 100.0),
        *(events.PhaseEntered(phase, 1) for phase in events.Phase),
        events.UpgradeLeftOpen("2026-05-17T10:31:02+02:00", "a.hex", False),
        events.UpgradeLeftOpen("2026-05-17T10:31:02+02:00", "a.hex", True),
        events.HostStalled(2.5),
        events.AdapterBack(),
    )
    for step in steps:
        line = progress_line(step)
        assert line is not None
        shown = translate(line[0])
        assert not re.search(r"\b(the|again|device|for|is|has|waiting)\b", shown), shown
    assert "2,5" in translate(progress_line(events.HostStalled(2.5))[0]) or code == "zh"  # type: ignore[index]


@each("name, data", [("tiny.bin", bytes(range(16))), ("motor.bin", b"")])
def test_an_error_on_the_page_names_no_option_of_the_command_line(
    name: str, data: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    place = BenchPlace(tmp_path_factory.mktemp("place"))
    _chosen(place)
    image = image_of(PACKETS, NEW).data + b"\0WMC V1r0r4_20220512\0"
    trouble = _drop(place, name, data or image).trouble
    assert trouble is not None
    assert "--allow-" in trouble.what, "the command line names it"
    shown = without_options(trouble.what), without_options(trouble.remedy)
    assert "--" not in "".join(shown)
    assert all(shown)
    assert shown[0].endswith(")."), "the brackets stay whole"


def test_a_silent_bus_has_something_to_do_on_the_page(place: BenchPlace) -> None:
    trouble = place.do(order(BenchController.use_adapter, BikeFault.OFF.value)).trouble
    assert trouble is not None
    assert without_options(trouble.remedy) == "Switch the system on."


@pytest.mark.slow
def test_after_a_rescue_no_check_denies_that_the_battery_reports_its_version(
    place: BenchPlace,
) -> None:
    _done(place, BikeFault.POWER)
    place.do(BenchController.rescue_it)
    done = place.do(_upgrade(place.bench.state)).done
    assert done is not None
    assert done.is_running
    assert not any("does not report" in made.text for made in done.checks)


def test_a_message_without_options_is_the_same_and_one_of_options_alone_is_empty() -> None:
    assert without_options("Wake it. Look again.") == "Wake it. Look again."
    assert without_options("Wake it. Or add --force.") == "Wake it."
    joined = Text("{a} {b}", {"a": text("Wake it."), "b": text("--force sends it.")})
    assert without_options(joined) == "Wake it."
    assert isinstance(without_options(joined), Text), "it can be translated"
    assert without_options("Allow more time with --timeout.") == ""


# -- settings --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_settings_are_kept_when_a_user_chooses_so(place: BenchPlace) -> None:
    state = _chosen(place)
    assert state.keeps_settings is False, "as the profile has it"
    assert not [made for made in _done(place).checks if made.check == "settings"]
    _chosen(place)
    state = place.do(order(BenchController.keep_settings, "yes"))
    done = place.do(_upgrade(state)).done
    assert done is not None
    assert done.error is None
    found = [made.text for made in done.checks if made.check == "settings"]
    assert found[0].startswith("the settings are saved: `flasher backup restore /")
    assert found[-1] == "7 of 7 settings read as before"


def test_the_profile_decides_first_whether_settings_are_kept(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    profile = place.bikes.profile(BMS)
    monkeypatch.setattr(place.bikes, "profile", lambda _: replace(profile, keep_settings=True))
    assert _chosen(place).keeps_settings is True
    assert place.do(order(BenchController.keep_settings, "no")).keeps_settings is False
    assert _chosen(place, target="wmc").keeps_settings is None, "the documents give none"


def test_of_a_whole_bike_the_profile_decides_too(
    place: BenchPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert place.do(
        order(BenchController.use_adapter, BikeFault.NONE.value), BenchController.choose_bike
    ).keeps_settings is False  # fmt: skip
    profile = place.bikes.profile(BMS)
    monkeypatch.setattr(place.bikes, "profile", lambda _: replace(profile, keep_settings=True))
    assert place.do(BenchController.choose_bike).keeps_settings is True
