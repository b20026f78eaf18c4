"""`flasher mock` and `flasher conformance serve` in this process: a host in another thread talks to
them over a virtual bus.
"""

from __future__ import annotations

import _thread
import errno
import json
import os
import threading
import uuid
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import can
import pytest

from flasher import api
from flasher.bus.adapter import CanLink
from flasher.cli.bench import mock as mock_command
from flasher.cli.bench import serving
from flasher.driver import drive
from flasher.errors import BusError, ExitCode
from flasher.host.outcome import Outcome
from flasher.mock.variants import VARIANTS
from flasher.protocol.wire import Message, encode
from flasher.settings.device_model import describe_options
from tests.cli.conftest import Flasher, Run
from tests.firmware import VECTORS

IMAGE = VECTORS + bytes(range(240)) + b"and three bytes more than two packets"[:3]
QUICK = (
    "--set", "reset_delay_s=0.001", "--set", "erase_time_s=0", "--set", "program_time_s=0",
    "--set", "start_delay_s=0",
)  # fmt: skip


class Host:
    """What runs beside the mock; begins as soon as the mock listens."""

    def __init__(self) -> None:
        self.channel = uuid.uuid4().hex
        self.failure: BaseException | None = None
        self.outcomes: list[Outcome] = []
        self.mock_runs = False
        self._listens = threading.Event()
        self.has_done = threading.Event()
        self.ends_the_mock = True
        """The mock need not find out by itself that the tool is quiet."""
        self._thread = threading.Thread(target=self._run)
        self._does: Callable[[], object] = lambda: None

    def do(self, does: Callable[[], object]) -> None:
        """Do this in the thread."""
        self._does = does
        self._thread.start()

    def mock_listens(self) -> None:
        self.mock_runs = True
        self._listens.set()

    def join(self) -> None:
        self._listens.set()
        self._thread.join()

    def _run(self) -> None:
        self._listens.wait()
        try:
            self._does()
        except BaseException as failure:  # noqa: BLE001  raised again in the test
            self.failure = failure
            if self.mock_runs:
                self.interrupt()
        finally:
            self.has_done.set()

    # -- what it can do ---------------------------------------------------------------------------

    def upgrade(self, image: bytes = IMAGE, target: str = "bms") -> Outcome:
        """One upgrade from reset to the end."""
        plan = api.make_plan(api.Image.from_bytes(image), target)
        with api.connect(interface="virtual", channel=self.channel) as connection:
            outcome = connection.device(target).upgrade(plan).outcome
        self.outcomes.append(outcome)
        return outcome

    def upgrade_unverified(self) -> None:
        """One upgrade after which nothing is asked: for a mock that ends before it could answer."""
        plan = api.make_plan(api.Image.from_bytes(IMAGE), "bms")
        with api.connect(interface="virtual", channel=self.channel) as connection:
            connection.device().upgrade(plan, verify=api.Level.NONE)

    def hear(self, question: bytes, can_id: int, wanted: bytes) -> bytes:
        """Send the frames of a message, or listen only, until `wanted` was received on `can_id`."""
        heard = b""
        with can.Bus(interface="virtual", channel=self.channel, ignore_config=True) as bus:
            for start in range(0, len(question), 8):
                data = question[start : start + 8]
                bus.send(can.Message(arbitration_id=0x752, data=data, is_extended_id=False))
            while wanted not in heard:
                message = bus.recv(5.0)
                assert message is not None, f"received only {heard.hex(' ')}"
                if message.arbitration_id == can_id:
                    heard += bytes(message.data)
        return heard

    def interrupt(self) -> None:
        """Ctrl-C for the mock, which runs in the main thread."""
        _thread.interrupt_main()


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Iterator[Host]:
    beside = Host()

    def drive_and_tell(*arguments: Any, **options: Any) -> None:
        beside.mock_listens()
        try:
            drive(*arguments, **options)
        finally:
            beside.mock_runs = False

    monkeypatch.setattr(serving, "drive", drive_and_tell)
    is_quiet = mock_command._Tool.is_quiet

    def has_ended(tool: mock_command._Tool, now: float) -> bool:
        return (beside.ends_the_mock and beside.has_done.is_set()) or is_quiet(tool, now)

    # So that the mock sees sooner that it may end, and does not listen for a second tool.
    monkeypatch.setattr(mock_command._Tool, "is_quiet", has_ended)
    monkeypatch.setattr(mock_command, "_QUIET_S", 0.3)
    monkeypatch.setattr("flasher.driver.MAX_WAIT_S", 0.02)
    monkeypatch.setattr("flasher.host.identify.LISTEN_FIRST_S", 0.0)
    monkeypatch.setattr("flasher.host.runner.SECOND_DEVICE_WAIT_S", 0.0)
    yield beside
    if beside._thread.ident is not None:
        beside.join()
    if beside.failure is not None:
        raise beside.failure


Serve = Callable[..., Run]


@pytest.fixture
def serve(flasher: Flasher, host: Host) -> Serve:
    """Runs `flasher mock -t bms` on the host's channel until it ends."""

    def run(*words: str | Path, target: str = "bms", options: tuple[str, ...] = ()) -> Run:
        bus = ("-i", "virtual", "-c", host.channel)
        return flasher(*options, "mock", "-t", target, *QUICK, *words, *bus)

    return run


# -- serving --------------------------------------------------------------------------------------


def test_every_phase_of_an_upgrade_is_printed(serve: Serve, host: Host) -> None:
    host.do(host.upgrade)
    run = serve("--upgrades", "1")
    assert run.code == ExitCode.OK
    assert run.out.splitlines() == [
        "state:   application: version V1r0r0_20220512",
        "state:   restarting: reset",
        "state:   announcing: whole application",
        "state:   erasing: for 259 bytes in 3 packets",
        "state:   transfer",
        "packets: first of 3 stored",
        "packets: all 3 stored",
        "state:   checking: 259 bytes",
        f"image:   259 bytes, sha256 {sha256(IMAGE).hexdigest()}",
        "state:   starting: the new application",
        "state:   application: version unknown",
    ]
    assert run.err == f"BMS on virtual {host.channel}; Ctrl-C ends it\n"
    host.join()
    assert host.outcomes[0].ending is api.Ending.COMPLETED


@pytest.mark.parametrize("target", ["wmc", "bms", "obc"])
def test_each_target_is_served(serve: Serve, host: Host, target: str) -> None:
    host.do(lambda: host.upgrade(target=target))
    run = serve("--upgrades", "1", target=target)
    assert run.code == ExitCode.OK
    host.join()
    assert host.outcomes[0].ok


@pytest.mark.slow
def test_the_last_upgrade_can_be_verified_before_it_ends(serve: Serve, host: Host) -> None:
    results: list[api.Result] = []

    def upgrade() -> None:
        plan = api.make_plan(
            api.Image.from_bytes(VECTORS + b"V2r0r0_20260101".ljust(200, b"-")), "bms"
        )
        with api.connect(interface="virtual", channel=host.channel) as connection:
            results.append(connection.device().upgrade(plan, verify=api.Level.VERSION))

    host.ends_the_mock = False
    host.do(upgrade)
    assert serve("--upgrades", "1", "--set", "after_complete=restarts").code == ExitCode.OK
    host.join()
    assert results[0].ok
    assert results[0].running_version == "V2r0r0_20260101"


def test_it_ends_after_n_upgrades(serve: Serve, host: Host, tmp_path: Path) -> None:
    """EN-07: also to a smaller image."""
    images = [IMAGE * 2, IMAGE, VECTORS[:8]]

    def upgrade_all() -> None:
        for image in images:
            host.upgrade(image)

    host.do(upgrade_all)
    run = serve("--upgrades", "3", "--save-image", tmp_path / "out.bin")
    assert run.code == ExitCode.OK
    assert run.out.count("image:") == 3
    host.join()
    assert [outcome.ending for outcome in host.outcomes] == [api.Ending.COMPLETED] * 3
    assert (tmp_path / "out.bin").read_bytes() == VECTORS[:8]


def test_ctrl_c_ends_it_with_exit_code_0(serve: Serve, host: Host) -> None:
    host.do(host.interrupt)
    run = serve()
    assert run.code == ExitCode.OK
    assert "Ctrl-C ends it" in run.err


@pytest.mark.slow
def test_the_device_outlives_an_adapter_that_is_lost_and_comes_back(
    serve: Serve, host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an upgrade before and one after it."""
    real, tries = CanLink.reopen, iter([True, True, False])
    is_lost, was_noticed = threading.Event(), threading.Event()
    receive = CanLink.receive

    def receive_or_fail(link: CanLink, deadline: float) -> Any:
        if is_lost.is_set() and threading.current_thread() is threading.main_thread():
            is_lost.clear()
            was_noticed.set()
            raise BusError("The adapter has left the bus.")
        return receive(link, deadline)

    def reopen(link: CanLink) -> None:
        if next(tries):
            raise BusError("The adapter cannot be used: it is bus-off.", remedy="Start it.")
        real(link)

    def upgrade_twice() -> None:
        host.upgrade()
        is_lost.set()
        assert was_noticed.wait(5.0)
        host.upgrade()

    monkeypatch.setattr(CanLink, "receive", receive_or_fail)
    monkeypatch.setattr(CanLink, "reopen", reopen)
    monkeypatch.setattr(serving, "_REOPEN_S", 0.01)
    host.do(upgrade_twice)
    run = serve("--upgrades", "2")
    assert run.code == ExitCode.OK
    assert "warning: The adapter has left the bus. Waiting for the adapter" in run.err
    assert run.err.count("not yet: The adapter cannot be used: it is bus-off. Start it.") == 1
    assert "the adapter is back" in run.err
    assert [outcome.error() for outcome in host.outcomes] == [None, None]


def test_ctrl_c_ends_the_wait_for_a_lost_adapter(
    serve: Serve, host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_link: CanLink, *_: object) -> None:
        host.interrupt()
        raise BusError("It is gone.")

    monkeypatch.setattr(CanLink, "receive", fail)
    monkeypatch.setattr(CanLink, "reopen", fail)
    monkeypatch.setattr(serving, "_REOPEN_S", 0.01)
    assert serve().code == ExitCode.OK


def test_json_is_one_document_a_line_and_the_last_has_the_exit_code(
    serve: Serve, host: Host, tmp_path: Path
) -> None:
    host.do(host.upgrade)
    run = serve("--upgrades", "1", "--json", "--save-image", tmp_path / "out.bin")
    *happened, last = [json.loads(line) for line in run.out.splitlines()]
    assert (last["ok"], last["exit_code"], last["images"]) == (True, 0, 1)
    assert happened[0]["event"] == "DeviceStateEntered"
    assert happened[0]["state"] == "application"
    (stored,) = [document for document in happened if document["event"] == "ImageStored"]
    assert stored["size_bytes"] == len(IMAGE)
    assert stored["sha256"] == sha256(IMAGE).hexdigest()
    assert all(document["text"] for document in happened)


def test_quiet_prints_what_happens_but_not_that_it_listens(serve: Serve, host: Host) -> None:
    host.do(host.interrupt)
    run = serve(options=("-q",))
    assert run.err == ""
    assert run.out.startswith("state:")


def test_damage_and_refusals_are_reported(serve: Serve, host: Host) -> None:
    """A reset whose checksum is wrong, then one whose text is."""
    damaged = bytes.fromhex("55AA16074205 5245534554 00000000 F0")
    wrong = encode(Message(0x752, 0x16, 0x4205, b"RESEX"))

    def disturb() -> None:
        with can.Bus(interface="virtual", channel=host.channel, ignore_config=True) as bus:
            for wire in (damaged, wrong):
                for start in range(0, len(wire), 8):
                    data = wire[start : start + 8]
                    bus.send(can.Message(arbitration_id=0x752, data=data, is_extended_id=False))
        host.upgrade()

    host.do(disturb)
    run = serve("--upgrades", "1")
    assert run.code == ExitCode.OK
    (line,) = [line for line in run.out.splitlines() if line.startswith("damage:")]
    assert line.startswith("damage:  0x752: ")
    assert "55 aa 16 07" in line
    (line,) = [line for line in run.out.splitlines() if line.startswith("note:")]
    assert line.startswith("note:    malformed message 4205")


# -- --save-image ---------------------------------------------------------------------------------


def test_the_saved_image_is_what_was_sent_byte_for_byte(
    serve: Serve, host: Host, tmp_path: Path
) -> None:
    out = tmp_path / "out.bin"
    out.write_bytes(b"an older and longer image" * 100)
    host.do(host.upgrade)
    run = serve("--upgrades", "1", "--save-image", out)
    assert run.code == ExitCode.OK
    assert f"saved:   {out}" in run.out
    assert out.read_bytes() == IMAGE
    assert list(tmp_path.iterdir()) == [out]


def test_a_folder_that_does_not_exist_is_refused_before_anything_is_served(
    serve: Serve, tmp_path: Path
) -> None:
    run = serve("--save-image", tmp_path / "no" / "out.bin")
    assert run.code == ExitCode.USAGE
    assert "cannot be written: its folder does not exist" in run.err
    assert "--save-image" in run.err
    assert run.out == ""


def test_a_folder_in_the_place_of_the_file_is_refused_too(serve: Serve, tmp_path: Path) -> None:
    run = serve("--save-image", tmp_path)
    assert run.code == ExitCode.USAGE
    assert "it is a folder" in run.err


@pytest.mark.parametrize("failing", ["open", "replace"])
def test_a_disk_that_fills_up_leaves_the_old_file_and_no_half_one(
    serve: Serve, host: Host, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    real_open = Path.open

    def fail(path: Path, *others: Any, **named: Any) -> Any:
        if path.suffix != ".part":
            return real_open(path, *others, **named)
        if failing == "open":
            with real_open(path, "wb") as file:
                file.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    out = tmp_path / "out.bin"
    out.write_bytes(b"old")
    monkeypatch.setattr(Path, failing, fail)
    host.do(host.upgrade_unverified)
    run = serve("--upgrades", "1", "--save-image", out)
    monkeypatch.undo()
    assert run.code == ExitCode.USAGE
    assert f"{out} cannot be written: No space left on device" in run.err
    assert "Traceback" not in run.err
    assert out.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [out]


def test_a_folder_that_vanishes_meanwhile_is_one_message(
    serve: Serve, host: Host, tmp_path: Path
) -> None:
    folder = tmp_path / "results"
    folder.mkdir()

    def upgrade_without_folder() -> None:
        folder.rmdir()
        folder.write_text("now a file")
        host.upgrade_unverified()

    host.do(upgrade_without_folder)
    run = serve("--upgrades", "1", "--save-image", folder / "out.bin")
    assert run.code == ExitCode.USAGE
    assert run.err.count("error:") == 1
    assert "Traceback" not in run.err


def test_a_link_stays_a_link_and_its_target_is_written(
    serve: Serve, host: Host, tmp_path: Path
) -> None:
    real, link = tmp_path / "real.bin", tmp_path / "link.bin"
    real.write_bytes(b"old")
    try:
        link.symlink_to(real)
    except OSError as error:
        pytest.skip(f"no links here: {error}")
    host.do(host.upgrade)
    assert serve("--upgrades", "1", "--save-image", link).code == ExitCode.OK
    assert link.is_symlink()
    assert real.read_bytes() == IMAGE


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_a_named_pipe_is_written_into_and_not_replaced(
    serve: Serve, host: Host, tmp_path: Path
) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        host.do(host.upgrade)
        assert serve("--upgrades", "1", "--save-image", pipe).code == ExitCode.OK
        assert os.read(reader, 4096) == IMAGE
    finally:
        os.close(reader)
    assert pipe.is_fifo()


# -- the device -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_without_an_application_it_announces_itself_until_it_is_upgraded(
    serve: Serve, host: Host
) -> None:
    """R14."""

    def hear_and_upgrade() -> None:
        # Header, mode 0C, length 11, boot version: more of them than the one burst of four.
        announcement = bytes.fromhex("55AA0C0BC109")
        heard = host.hear(b"", 0x725, b"BMS")
        while heard.count(announcement) < 6:
            heard += host.hear(b"", 0x725, b"BMS")
        host.upgrade()

    host.do(hear_and_upgrade)
    run = serve("--no-app", "--upgrades", "1")
    assert run.code == ExitCode.OK
    assert run.out.startswith("state:   announcing: no application\n")
    assert "image:" in run.out


def test_a_choice_changes_the_device(serve: Serve, host: Host) -> None:
    host.do(host.upgrade)
    run = serve("--set", "boot_version=V7.8.9", "--upgrades", "1")
    assert run.code == ExitCode.OK
    host.join()
    assert host.outcomes[0].boot_version == "BMS V7.8.9"


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ("boot_verson=V1.0.0", ("boot_verson", "Did you mean boot_version?")),
        ("window_s=soon", ("window_s cannot be 'soon'", "0.05")),
        ("window_s=-1", ("window_s cannot be '-1'", "a number from 0 on")),
        ("bad_packet=nak", ("bad_packet cannot be 'nak'", "nak_expected")),
        ("page_size_bytes=100", ("page_size_bytes is a multiple of 128",)),
        ("boot_version=V1", ("6 ASCII characters",)),
        ("window_s", ("--set window_s: write KEY=VALUE",)),
    ],
)
def test_a_choice_that_makes_no_sense_is_wrong_usage_and_the_message_names_one_that_does(
    serve: Serve, choice: str, words: tuple[str, ...]
) -> None:
    run = serve("--set", choice)
    assert run.code == ExitCode.USAGE
    assert all(word in run.err for word in words), run.err
    assert "Traceback" not in run.err


def test_help_lists_every_choice_with_its_values(flasher: Flasher) -> None:
    text = flasher("mock", "--help").out
    for key, values, summary in describe_options():
        assert f"  {key:<24} {values}\n      {summary}\n" in text + "\n"


@pytest.mark.parametrize("words", [("--upgrades", "0"), ("-t", "hmi"), ("--no-such-option",)])
def test_wrong_usage_is_exit_code_2(serve: Serve, words: tuple[str, ...]) -> None:
    assert serve(*words).code == ExitCode.USAGE


def test_no_adapter_is_exit_code_4(flasher: Flasher) -> None:
    run = flasher("mock", "-t", "bms")
    assert run.code == ExitCode.BUS
    assert "-i socketcan -c can0" in run.err


# -- wrong devices --------------------------------------------------------------------------------


def test_a_variant_is_served_and_named(serve: Serve, host: Host) -> None:
    """RS-01 once: the tool hears the announcements, but never the general feedback."""
    host.do(host.upgrade)
    run = serve("--upgrades", "1", "--variant", "no-feedback")
    assert run.code == ExitCode.OK
    assert run.err == (
        "BMS that is wrong (RS-01: restarts at a reset without general feedback) "
        f"on virtual {host.channel}; Ctrl-C ends it\n"
    )
    host.join()
    assert host.outcomes[0].ok


def test_a_variant_is_as_wrong_as_its_description(serve: Serve, host: Host) -> None:
    """RS-04: a reset with another text is confirmed."""
    wrong = encode(Message(0x752, 0x16, 0x4205, b"RESEX"))

    def reset() -> None:
        host.hear(wrong, 0x725, b"ACK")
        host.interrupt()

    host.do(reset)
    run = serve("--variant", "resets-at-any-text")
    assert run.code == ExitCode.OK
    assert "state:   restarting: reset" in run.out


def test_a_variant_takes_the_choices_of_set_and_keeps_its_own(serve: Serve, host: Host) -> None:
    """EN-04: an image without a checksum, refused by a right device of that choice, is taken."""
    host.do(host.upgrade)
    run = serve("--upgrades", "1", "--variant", "ignores-image-checksum", "--no-app")
    assert run.code == ExitCode.OK
    assert "state:   announcing: no application" in run.out


def test_variants_are_listed_with_their_clauses_without_target_or_adapter(flasher: Flasher) -> None:
    run = flasher("mock", "--list-variants")
    assert run.code == ExitCode.OK
    lines = run.out.splitlines()
    assert len(lines) == len(VARIANTS)
    assert all(len(line) <= 120 for line in lines)
    assert "no-crc-check                  CR-01  accepts a message with any CRC" in lines


def test_the_list_of_variants_is_a_json_document(flasher: Flasher) -> None:
    document = flasher("mock", "--list-variants", "--json").document
    assert document["ok"]
    assert [row["name"] for row in document["variants"]] == list(VARIANTS)
    assert {
        "name": "no-crc-check",
        "clause": "CR-01",
        "also": list(VARIANTS["no-crc-check"].also),
        "summary": "accepts a message with any CRC",
        "upgrade_works": True,
    } in document["variants"]


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (("--variant", "no-crc"), "no variant 'no-crc' of the device model"),
        (("--variant", "no-crc"), "Did you mean no-crc-check?"),
        (("--variant", "no-feedback", "--system"), "--variant and --system do not go together"),
    ],
)
def test_a_variant_that_cannot_be_served_is_wrong_usage(
    serve: Serve, words: tuple[str, ...], reported: str
) -> None:
    run = serve(*words)
    assert run.code == ExitCode.USAGE
    assert reported in run.err


def test_without_a_target_it_is_wrong_usage(flasher: Flasher) -> None:
    run = flasher("mock", "-i", "virtual", "-c", "x")
    assert run.code == ExitCode.USAGE
    assert "-t/--target is required" in run.err


# -- the other dialect ----------------------------------------------------------------------------


def test_in_the_motinova_dialect_the_application_answers_at_its_own_bit_rate(
    serve: Serve, host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The document cancelled the upgrade but kept the reset: the model says what it adds."""
    rates: list[int] = []
    real_bus: Callable[..., can.BusABC] = can.Bus

    def record(**config: Any) -> can.BusABC:
        rates.append(int(config.get("bitrate", 0)))
        return real_bus(**config)

    def ask() -> None:
        # Chapter 3: 752 R 3300, the version information; answered on 720 with 15 40.
        host.hear(bytes.fromhex("55AA11023300FDA6627CF0"), 0x720, b"V1r0r0_20220512")
        host.interrupt()

    monkeypatch.setattr("can.Bus", record)
    host.do(ask)
    run = serve("--dialect", "motinova")
    assert run.code == ExitCode.OK
    assert rates[0] == 125_000
    assert "the MOTINOVA document has no upgrade" in run.err


# -- a compiled bootloader -------------------------------------------------------------------------


@pytest.fixture
def serve_bootloader(flasher: Flasher, host: Host) -> Callable[[str], Run]:
    """Runs `flasher conformance serve -t bms` on the host's channel until it is interrupted."""

    def run(subject: str) -> Run:
        bus = ("-i", "virtual", "-c", host.channel)
        return flasher("conformance", "serve", "-t", "bms", "--subject", subject, *bus)

    return run


@pytest.mark.slow
def test_a_compiled_bootloader_is_upgraded_by_the_flash_host(
    serve_bootloader: Callable[[str], Run], host: Host
) -> None:
    image = VECTORS + b"V2r0r1_20240131".ljust(200, b"-")
    plan = api.make_plan(api.Image.from_bytes(image), "bms")
    results: list[api.Result] = []

    def upgrade() -> None:
        with api.connect(interface="virtual", channel=host.channel) as connection:
            results.append(connection.device().upgrade(plan, verify=api.Level.VERSION))
        host.interrupt()

    host.do(upgrade)
    run = serve_bootloader("tests.peers.python_bootloader:PythonBootloader")
    assert run.code == ExitCode.OK
    assert [line for line in run.out.splitlines() if line.startswith("state:")] == [
        "state:   bootloader: power on",
        "state:   application: version V2r0r1_20240131",
    ]
    assert run.err.endswith(f" as BMS on virtual {host.channel}; Ctrl-C ends it\n")
    host.join()
    assert results[0].ok
    assert results[0].running_version == "V2r0r1_20240131"


def test_a_bootloader_that_crashes_is_reported_once_and_starts_again(
    serve_bootloader: Callable[[str], Run], host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts = iter(range(3))

    def interrupt_at_last() -> None:
        if next(starts, None) is None:
            host.interrupt()

    monkeypatch.setattr(host, "mock_listens", interrupt_at_last)
    run = serve_bootloader("tests.conformance.wrong_bootloaders:EndsAtOnce")
    assert run.code == ExitCode.OK
    assert run.out.count("state:   bootloader: reset\n") >= 2
    assert run.err.splitlines()[1:] == [
        "warning: the bootloader ended with status 3 in flasher_dut_start; the device restarts"
    ]


@pytest.mark.parametrize("words", [(), ("-t", "bms"), ("--subject", "boot")])
def test_a_served_bootloader_needs_a_target_and_a_subject(
    flasher: Flasher, words: tuple[str, ...]
) -> None:
    run = flasher("conformance", "serve", *words, "-i", "virtual", "-c", "none")
    assert run.code == ExitCode.USAGE
    assert "-t/--target and --subject are required" in run.err
