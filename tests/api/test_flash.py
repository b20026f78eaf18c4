"""`flasher.flash` and its halves: results, typed errors, events, and what is closed when."""

from __future__ import annotations

import dataclasses
import random
import re
import subprocess
import sys
import textwrap
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import can
import pytest

import flasher
from flasher import api, errors, events
from flasher.bus.health import HealthKeeper, LinkHealth
from flasher.bus.link import MonotonicClock, VirtualClock
from flasher.bus.simulated import Disturbance, SimulatedBus
from flasher.errors import BusError, ExitCode, FlasherError, UsageError
from flasher.host.options import UpgradeOptions
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol import contents
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, MOTINOVA, OBC, WELLING, WMC
from flasher.protocol.timing import Timings
from flasher.wording import wording
from tests.firmware import VECTORS
from tests.loops import each

DATA = VECTORS + random.Random(31).randbytes(284)
IMAGE = flasher.Image.from_bytes(DATA)
Connect = Callable[..., AbstractContextManager[api.Connection]]


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Makes the mock of `flash` take no time; what is put in are more options for it."""
    more: dict[str, Any] = {"speed": 0.0}
    real: Connect = api.connect_mock

    def connect(*arguments: Any, **options: Any) -> AbstractContextManager[api.Connection]:
        return real(*arguments, **(options | more))

    monkeypatch.setattr(api, "connect_mock", connect)
    return more


# -- the good way ---------------------------------------------------------------------------------


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("target", ["wmc", "mc", "bms", "obc", "PBU", BMS])
def test_the_whole_job_is_one_call(tmp_path: Path, target: Any) -> None:
    path = tmp_path / "firmware.bin"
    path.write_bytes(DATA)
    outcome = flasher.flash(path, target, mock=True).outcome
    assert outcome.ok
    assert outcome.ending is flasher.Ending.COMPLETED
    assert outcome.device_left is flasher.DeviceLeft.NEW
    assert outcome.error() is None
    assert outcome.total_packets == outcome.statistics.packets_acknowledged == 3
    assert outcome.target is api.as_target(target)


@pytest.mark.usefixtures("at_once")
@each("slept_s, unobserved_s", [(60.0, 60.0), (0.1, 0.0)])
def test_an_upgrade_in_which_this_computer_was_suspended_was_not_observed(
    monkeypatch: pytest.MonkeyPatch, slept_s: float, unobserved_s: float
) -> None:
    total_s = iter([5.0, 5.0 + slept_s])
    monkeypatch.setattr("flasher.procedures.suspended_s", lambda: next(total_s))
    done = flasher.flash(IMAGE, "bms", mock=True)
    assert done.ok
    assert done.outcome.unobserved_s == pytest.approx(unobserved_s)


@pytest.mark.usefixtures("at_once")
def test_a_computer_suspended_before_anything_was_sent_leaves_nothing_unobserved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    total_s = 5.0
    monkeypatch.setattr("flasher.procedures.suspended_s", lambda: total_s)

    def sleep_while_it_listens(event: object) -> None:
        nonlocal total_s
        if isinstance(event, events.PhaseEntered) and event.phase is events.Phase.LISTEN:
            total_s += 60.0

    done = flasher.flash(IMAGE, "bms", mock=True, on_event=sleep_while_it_listens)
    assert done.ok
    assert done.outcome.unobserved_s == 0.0


@pytest.mark.usefixtures("at_once")
def test_a_path_may_be_text_and_an_image_may_be_loaded_before(tmp_path: Path) -> None:
    path = tmp_path / "firmware.bin"
    path.write_bytes(DATA)
    assert flasher.flash(str(path), "bms", mock=True).ok
    assert flasher.flash(flasher.load(path), "bms", mock=True).ok


@pytest.mark.usefixtures("at_once")
def test_events_arrive_in_order_while_it_runs() -> None:
    seen: list[object] = []
    flasher.flash(IMAGE, "bms", mock=True, on_event=seen.append)
    assert [event.phase for event in seen if isinstance(event, events.PhaseEntered)] == [
        events.Phase.LISTEN,
        events.Phase.IDENTIFY,
        events.Phase.RESET,
        events.Phase.BOOT,
        events.Phase.UPDATE,
        events.Phase.TRANSFER,
        events.Phase.END,
    ]
    assert [event for event in seen if isinstance(event, events.PacketAcknowledged)] == [
        events.PacketAcknowledged(number, 3, 1) for number in (1, 2, 3)
    ]
    assert events.BootVersionSeen("BMS", "V1.0.0") in seen


@pytest.mark.slow
def test_the_mock_takes_the_time_of_a_real_bus_unless_set_otherwise() -> None:
    began = time.perf_counter()
    outcome = flasher.flash(IMAGE, "bms", mock=True).outcome
    assert time.perf_counter() - began >= outcome.statistics.duration_s * 0.99
    assert outcome.statistics.transfer_s is not None
    assert outcome.statistics.transfer_s >= 3 * 0.009


@pytest.mark.parametrize("speed", [-1.0, float("nan")])
def test_a_speed_at_which_time_does_not_pass_is_refused(speed: float) -> None:
    with (
        pytest.raises(UsageError, match="it is 0 or more"),
        flasher.connect_mock("bms", speed=speed),
    ):
        pass


def test_what_the_device_model_reports_can_be_watched() -> None:
    seen: list[object] = []
    with flasher.connect_mock("bms", speed=0, on_event=seen.append) as connection:
        assert connection.device().upgrade(flasher.make_plan(IMAGE, "bms")).ok
    assert events.ImageStored(300, IMAGE.sha256) in seen


def test_two_upgrades_on_one_connection() -> None:
    plan = flasher.make_plan(IMAGE, "bms")
    with flasher.connect_mock("bms", speed=0) as connection:
        assert [connection.device().upgrade(plan).ok for _ in range(2)] == [True, True]


def test_taps_see_the_traffic_of_an_upgrade() -> None:
    ids: set[tuple[int, bool]] = set()
    times: list[float] = []

    def tap(frame: Frame, *, sent: bool, now: float) -> None:
        ids.add((frame.can_id, sent))
        times.append(now)

    with flasher.connect_mock("bms", speed=0) as connection:
        connection.device().upgrade(flasher.make_plan(IMAGE, "bms"), taps=[tap])
    assert ids == {(0x752, True), (0x725, False), (0x720, False)}
    assert times == sorted(times)


# -- bad endings ----------------------------------------------------------------------------------


HURRIED = Timings(ack_timeout_s=0.01, packet_tries=2)

BAD_ENDINGS: list[tuple[str, dict[str, Any], UpgradeOptions, type[FlasherError], ExitCode]] = [
    ("NO_BOOT_VERSION", {"reset_delay_s": 60.0}, UpgradeOptions(),
     errors.NoAnswerError, ExitCode.NO_ANSWER),
    ("NO_REQUEST", {"erase_time_s": 60.0}, UpgradeOptions(),
     errors.NoAnswerError, ExitCode.NO_ANSWER),
    ("NO_REQUEST", {"largest_image_bytes": 299}, UpgradeOptions(),
     errors.NoAnswerError, ExitCode.NO_ANSWER),
    ("UNHEARING", {"largest_image_bytes": 299, "has_application": False}, UpgradeOptions(),
     errors.NoAnswerError, ExitCode.NO_ANSWER),
    ("WRONG_DEVICE", {"boot_version": "absurd"}, UpgradeOptions(),
     errors.WrongDeviceError, ExitCode.WRONG_DEVICE),
    ("PACKET_FAILED", {"program_time_s": 60.0}, UpgradeOptions(),
     errors.TransferError, ExitCode.TRANSFER),
    ("PACKET_FAILED", {"program_time_s": 0.5}, UpgradeOptions(timings=HURRIED),
     errors.TransferError, ExitCode.TRANSFER),
    ("RESTARTED", {"pause_in_transfer": "announces", "transfer_timeout_s": 0.01},
     UpgradeOptions(packet_gap_s=0.3, attempts=2), errors.TransferError, ExitCode.TRANSFER),
    ("REFUSED", {"image_checksum": "crc32"}, UpgradeOptions(),
     errors.RefusedError, ExitCode.REFUSED),
    ("OUT_OF_TIME", {"reset_delay_s": 2.0}, UpgradeOptions(timeout_s=1.0),
     errors.NoAnswerError, ExitCode.NO_ANSWER),
    ("OUT_OF_TIME", {"program_time_s": 0.4}, UpgradeOptions(timeout_s=1.0),
     errors.TransferError, ExitCode.TRANSFER),
]  # fmt: skip


@pytest.mark.parametrize(("ending", "choices", "options", "kind", "code"), BAD_ENDINGS)
def test_each_bad_ending_is_raised_as_its_own_error_with_its_exit_code(
    at_once: dict[str, Any],
    ending: str,
    choices: dict[str, Any],
    options: UpgradeOptions,
    kind: type[FlasherError],
    code: ExitCode,
) -> None:
    choices = dict(choices)
    at_once["has_application"] = choices.pop("has_application", True)
    at_once["profile"] = DeviceProfile(**choices)
    with pytest.raises(FlasherError) as caught:
        flasher.flash(IMAGE, "bms", mock=True, options=options)
    assert type(caught.value) is kind
    assert caught.value.exit_code == code
    assert wording(flasher.Ending[ending]) in caught.value.what
    assert caught.value.where
    assert caught.value.cause
    assert "State of the device:" in caught.value.remedy


def simulated(
    disturbance: Disturbance | None = None, **choices: Any
) -> tuple[api.Connection, MockDevice]:
    """A connection to a device on a bus that disturbs."""
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock, disturbance)
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=DeviceProfile(**choices))
    bus.attach(device)
    return api.Connection(bus.link(), clock, "simulated"), device


def lose_complete(frame: Frame, _now: float) -> list[Frame]:
    """The device's final answer is lost."""
    return [] if frame.data[4:6] == bytes.fromhex("C502") else [frame]


def test_a_final_answer_that_never_comes_is_unconfirmed_not_done() -> None:
    connection, device = simulated(lose_complete, repeated_end="silence", start_delay_s=1000.0)
    outcome = connection.device().upgrade(flasher.make_plan(IMAGE, "bms")).outcome
    error = outcome.error()
    assert isinstance(error, errors.UnconfirmedError)
    assert error.exit_code == ExitCode.UNCONFIRMED
    assert outcome.device_left is flasher.DeviceLeft.UNKNOWN
    assert device.stored_image == DATA


@each(
    "claimed, ending",
    [
        ("V2r0r0_20260101", flasher.Ending.CONFIRMED_BY_VERSION),
        ("V3r0r0_20260301", flasher.Ending.OTHER_VERSION),
    ],
)
def test_the_version_decides_when_the_final_answer_is_lost(
    claimed: str, ending: flasher.Ending
) -> None:
    connection, device = simulated(lose_complete, repeated_end="silence")
    image = flasher.Image.from_bytes(DATA[:16] + b"V2r0r0_20260101\x00" + DATA)
    plan = flasher.make_plan(dataclasses.replace(image, version=claimed), "bms")
    outcome = connection.device().upgrade(plan).outcome
    error = outcome.error()
    assert outcome.ending is ending
    assert outcome.running_version == "V2r0r0_20260101"
    assert device.stored_image == image.data
    if ending is flasher.Ending.OTHER_VERSION:
        assert isinstance(error, errors.VerificationError)
        assert error.exit_code == ExitCode.VERIFICATION
    else:
        assert error is None


def test_a_cancelled_upgrade_is_an_outcome_that_states_what_is_left() -> None:
    acknowledged: list[object] = []

    def note(event: object) -> None:
        if isinstance(event, events.PacketAcknowledged):
            acknowledged.append(event)

    connection, model = simulated()
    device = connection.device()
    outcome = device.upgrade(IMAGE, on_event=note, cancelled=lambda: bool(acknowledged)).outcome
    error = outcome.error()
    assert outcome.ending is flasher.Ending.CANCELLED
    assert isinstance(error, errors.InterruptedByUserError)
    assert error.exit_code == ExitCode.INTERRUPTED
    assert outcome.device_left is flasher.DeviceLeft.NO_APPLICATION
    assert model.stored_image is None


# -- connections ----------------------------------------------------------------------------------


class FakeLink:
    """An adapter that counts how often it is closed, and may fail."""

    bit_rate = None
    channel = "0"

    def __init__(self, failure: Exception | None = None) -> None:
        self.closed = 0
        self.failure = failure

    def __str__(self) -> str:
        return "fake 0"

    def send(self, frame: Frame) -> None:
        if self.failure is not None:
            raise self.failure

    def receive(self, deadline: float) -> Frame | None:
        return None

    def drain(self) -> int:
        return 0

    def reopen(self) -> None:
        raise BusError("the adapter is not back")

    is_off = False
    is_physical = True

    def health(self) -> LinkHealth:
        return HealthKeeper().health()

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeLink]:
    link = FakeLink()
    monkeypatch.setattr("flasher.bus.adapter.open_adapter", lambda *_args, **_options: link)
    yield link
    assert link.closed == 1


def test_the_adapter_is_closed_at_the_end(fake: FakeLink) -> None:
    with flasher.connect() as connection:
        assert connection.link is fake
        assert connection.name == "fake 0"
        assert fake.closed == 0


@pytest.mark.usefixtures("fake")
def test_the_adapter_is_closed_when_the_block_fails() -> None:
    with pytest.raises(ZeroDivisionError), flasher.connect():
        raise ZeroDivisionError


@pytest.mark.slow
def test_the_adapter_is_closed_when_it_fails_itself(fake: FakeLink) -> None:
    fake.failure = BusError("unplugged.", where="fake 0", remedy="Plug it in.")
    with pytest.raises(BusError) as caught:
        flasher.flash(IMAGE, "bms", interface="fake")
    assert caught.value.where.endswith("fake 0")
    assert caught.value.remedy.startswith(
        "Plug it in. State of the device: this run erased nothing"
    )


@pytest.mark.usefixtures("fake")
def test_the_adapter_is_closed_when_the_event_handler_fails() -> None:
    def fail(_event: object) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        flasher.flash(IMAGE, "bms", interface="fake", on_event=fail)


@pytest.mark.usefixtures("fake")
def test_the_clock_of_an_adapter_is_the_monotonic_one() -> None:
    with flasher.connect() as connection:
        before = time.perf_counter()
        assert before <= connection.clock.now() <= time.perf_counter()
        connection.clock.wait_until(before - 1.0)


class Babbling(FakeLink):
    """A bus on which there is always another frame of somebody else."""

    def __init__(self) -> None:
        super().__init__()
        self.received = 0

    def receive(self, deadline: float) -> Frame | None:
        self.received += 1
        return Frame(0x001, b"babble")


@pytest.mark.slow
def test_a_babbling_bus_keeps_an_upgrade_neither_from_its_deadline_nor_from_being_cancelled() -> (
    None
):
    """CO-01, SE-01."""
    link = Babbling()
    connection = api.Connection(link, MonotonicClock(), "babbling")
    plan = flasher.make_plan(IMAGE, "bms")
    began = time.perf_counter()
    outcome = connection.device().upgrade(plan, options=UpgradeOptions(timeout_s=0.1)).outcome
    assert outcome.ending is flasher.Ending.OUT_OF_TIME
    outcome = connection.device().upgrade(plan, cancelled=lambda: True).outcome
    assert outcome.ending is flasher.Ending.CANCELLED
    assert time.perf_counter() - began < 2.0
    assert link.received > 10_000


def test_python_cans_keywords_and_the_dialects_bit_rate_reach_the_adapter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[dict[str, Any]] = []
    open_bus: Callable[..., can.BusABC] = can.Bus

    def record(**config: Any) -> can.BusABC:
        seen.append(config)
        return open_bus(**config)

    monkeypatch.setattr("can.Bus", record)
    monkeypatch.setattr("can.util.load_file_config", lambda *_args: {})
    monkeypatch.setattr("can.util.load_environment_config", lambda *_args: {})
    channel = uuid.uuid4().hex
    for dialect in (WELLING, "motinova"):
        with flasher.connect(dialect, interface="virtual", channel=channel) as connection:
            assert connection.name == f"virtual {channel}"
    assert [config["bitrate"] for config in seen] == [250_000, 125_000]


# -- names ----------------------------------------------------------------------------------------


def test_targets_and_dialects_go_by_name_or_as_themselves() -> None:
    assert api.as_target("MC") is api.as_target(WMC) is WMC
    assert api.as_target("pbu") is OBC
    assert api.as_dialect("Motinova") is api.as_dialect(MOTINOVA) is MOTINOVA


def test_unknown_names_are_wrong_usage_and_the_known_ones_are_named() -> None:
    with pytest.raises(UsageError, match="no target 'cdl'; targets are wmc, bms, obc"):
        flasher.flash(IMAGE, "cdl", mock=True)
    with pytest.raises(UsageError, match="no dialect 'latin'; dialects are welling, motinova"):
        flasher.flash(IMAGE, "bms", dialect="latin", mock=True)
    with pytest.raises(UsageError, match="no dialect"), flasher.connect("latin"):
        pass


def test_a_dialect_without_an_upgrade_is_refused_before_anything_is_opened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr("flasher.bus.adapter.open_adapter")
    with pytest.raises(UsageError, match="MOTINOVA dialect has no upgrade") as caught:
        flasher.flash(IMAGE, "bms", dialect="motinova", interface="virtual")
    assert caught.value.exit_code == ExitCode.USAGE


def test_a_bad_image_is_refused_before_anything_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("flasher.bus.adapter.open_adapter")
    (tmp_path / "empty.bin").write_bytes(b"")
    with pytest.raises(errors.ImageError) as caught:
        flasher.flash(tmp_path / "empty.bin", "bms", interface="virtual")
    assert caught.value.exit_code == ExitCode.IMAGE


# -- the tour in the package's docstring ----------------------------------------------------------


@pytest.mark.slow
def test_the_examples_of_the_tour_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As printed, with a mock in the place of the adapter."""
    tour = flasher.__doc__ or ""
    examples = [
        textwrap.dedent(block) for block in re.findall(r"(?:^    .+\n)+", tour, re.MULTILINE)
    ]
    assert len(examples) == 6
    opened: list[dict[str, Any]] = []
    real: Connect = api.connect_mock

    def connect(_dialect: object = None, **bus: Any) -> AbstractContextManager[api.Connection]:
        opened.append(bus)
        return real("bms", speed=0)

    monkeypatch.setattr(api, "connect", connect)
    monkeypatch.setattr(flasher, "connect", connect)
    monkeypatch.chdir(tmp_path)
    sample = Path(__file__).parents[2] / "firmware_samples" / "bms.hex"
    Path("firmware.hex").write_bytes(sample.read_bytes())
    monkeypatch.setattr(api, "connect_mock", lambda *given: real(*given, speed=0.0))
    names: dict[str, Any] = {"flasher": flasher}
    for example in examples:
        exec(example, names)  # noqa: S102  our own documentation
    reported = capsys.readouterr().out
    assert "PacketAcknowledged(number=613, total=613, tries=1)" in reported
    assert re.search(r"^613 [\d.]+$", reported, re.MULTILINE)
    assert "Ending.COMPLETED DeviceLeft.NEW None" in reported
    assert [bus["interface"] for bus in opened] == ["socketcan", "pcan", "socketcan"]


def test_everything_that_the_tour_exports_is_there() -> None:
    assert [name for name in flasher.__all__ if not hasattr(flasher, name)] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["contents", "errors", "events"])
def test_its_modules_are_there_before_anything_was_called(name: str) -> None:
    program = f"import flasher; flasher.{name}"
    subprocess.run([sys.executable, "-c", program], check=True)


# -- the battery's own data -----------------------------------------------------------------------


def test_a_program_reads_and_writes_what_the_battery_states_of_itself() -> None:
    with flasher.connect_mock("bms", speed=0) as connection:
        running = connection.device().read("running-information")
        assert isinstance(running, contents.RunningInformation)
        assert 30_000 < running.voltage_mv < 45_000
        written = connection.device().write("user-string-1", "checked")
        assert written.error() is None
        text = connection.device().read("user-string-1")
        assert isinstance(text, contents.UserString)
        assert str(text.text) == "checked"
        assert len(connection.device().read_memory(0x0800_8000, 0x0800_8010)) == 16


def test_what_only_the_manufacturer_writes_needs_a_word() -> None:
    with (
        flasher.connect_mock("bms", speed=0) as connection,
        pytest.raises(errors.UsageError, match="manufacturer"),
    ):
        connection.device().write("serial-number", "W2605002")
