"""What a trace is explained to mean: one trace for every cause, written as messages with times."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from flasher.events import Phase
from flasher.protocol.frame import Frame
from flasher.trace.explain import explain
from flasher.trace.source import explain_path
from flasher.trace.story import Cause, PacketRun, Step, StepKind, Story
from tests.loops import each
from tests.peers.wording import READ

from .tape import Tape

NEW = b"V1r2r3_20260517"
OLD = b"V1r2r2_20220401"
ACK_BEGINS = Frame(0x725, bytes.fromhex("55AA0C04C2020700"))
"""The first of the two frames of ACK 7 of a BMS."""


def printed(tape: Tape, until: float | None = None) -> Story:
    return explain(tape, source="trace", until=until)


def with_version(tape: Tape) -> Tape:
    """An upgrade of one packet that holds a version."""
    return tape.to_request().packet(1, 1, b"\x00\x00" + NEW).ack(1).end()


def interleaved(tape: Tape) -> Tape:
    """Two tools send a packet at once, frame by frame."""
    words = tape.to_packet(4).packet_wire(4, 10, b""), tape.packet_wire(9, 10, b"")
    for start in range(0, len(words[0]), 8):
        for wire in words:
            tape.frame(Frame(0x752, wire[start : start + 8]))
    return tape.wait(0.5)


def refused(tape: Tape, times: int) -> Tape:
    for _ in range(times):
        tape.packet(7).nak(7)
    return tape


def unanswered(tape: Tape, times: int) -> Tape:
    for _ in range(times):
        tape.packet(7).wait(0.5)
    return tape


def misanswered(tape: Tape, times: int, answer: Callable[[Tape], object]) -> Tape:
    for _ in range(times):
        answer(tape.packet(7).wait(0.01))
        tape.wait(0.5)
    return tape


def asked(tape: Tape, times: int) -> Tape:
    for _ in range(times):
        tape.wait(0.2).tool(0x1540, b"", READ)
    return tape


def repeatedly(tape: Tape, bursts: int) -> Tape:
    for _ in range(bursts):
        tape.wait(0.2).boot().wait(0.05).boot()
    return tape


CAUSES: list[tuple[str, Callable[[Tape], object], Cause, Phase | None, int | None]] = [
    ("complete", lambda t: t.to_end().complete(), Cause.COMPLETED, Phase.END, None),
    (
        "version after complete",
        lambda t: with_version(t).complete().wait(0.3).version(NEW),
        Cause.COMPLETED,
        Phase.CONFIRM,
        None,
    ),
    (
        "another version",
        lambda t: with_version(t).complete().wait(0.3).version(OLD),
        Cause.OTHER_VERSION,
        Phase.CONFIRM,
        None,
    ),
    (
        "announces itself for good after complete",
        lambda t: repeatedly(t.to_end().complete(), 8),
        Cause.IN_BOOTLOADER,
        Phase.END,
        None,
    ),
    (
        "restarts twice after complete",
        lambda t: asked(t.to_end().complete().wait(0.2).boot().wait(1.1).boot(), 10),
        Cause.COMPLETED,
        Phase.END,
        None,
    ),
    (
        "announces itself once after complete, on its way to the application",
        lambda t: repeatedly(t.to_end().complete(), 1),
        Cause.COMPLETED,
        Phase.END,
        None,
    ),
    (
        "starts its application after a long announcement",
        lambda t: repeatedly(with_version(t).complete(), 8).wait(0.3).version(NEW),
        Cause.COMPLETED,
        Phase.CONFIRM,
        None,
    ),
    (
        "only the version answers",
        lambda t: with_version(t).wait(1).version(NEW),
        Cause.CONFIRMED_BY_VERSION,
        Phase.CONFIRM,
        None,
    ),
    ("resets", lambda t: t.version(OLD).reset(5), Cause.NO_BOOT_VERSION, Phase.RESET, None),
    ("dead bus", lambda t: t.reset().error(9), Cause.NOBODY_ACKNOWLEDGES, Phase.RESET, None),
    ("only feedback", lambda t: t.reset().feedback(), Cause.RESET_IGNORED, Phase.BOOT, None),
    ("no request", lambda t: t.to_boot().update(), Cause.NO_REQUEST, Phase.UPDATE, None),
    (
        "announces on",
        lambda t: t.to_boot().update().wait(0.4).boot().wait(0.05).boot(),
        Cause.UPDATE_NOT_TAKEN,
        Phase.UPDATE,
        None,
    ),
    (
        "the application answers the update command",
        lambda t: t.to_boot().update().feedback(),
        Cause.UPDATE_NOT_TAKEN,
        Phase.UPDATE,
        None,
    ),
    (
        "wrong device",
        lambda t: t.reset().feedback().boot(name=b"WMC"),
        Cause.WRONG_DEVICE,
        Phase.BOOT,
        None,
    ),
    (
        "two devices",
        lambda t: t.reset().feedback().boot(b"V1.0.0").boot(b"V2.0.0"),
        Cause.TWO_DEVICES,
        Phase.BOOT,
        None,
    ),
    (
        "two devices of one version",
        lambda t: t.to_request().packet(1).ack(1).ack(1).packet(2).ack(2).ack(2)
        .packet(3).ack(3).ack(3).packet(4).wait(1),
        Cause.TWO_DEVICES,
        Phase.TRANSFER,
        4,
    ),
    ("NAKs", lambda t: refused(t.to_packet(7), 5), Cause.PACKET_REFUSED, Phase.TRANSFER, 7),
    (
        "ACKs of another byte order",
        lambda t: misanswered(t.to_packet(7), 5, lambda tape: tape.ack(7 << 8)),
        Cause.PACKET_ANSWERED_OTHERWISE,
        Phase.TRANSFER,
        7,
    ),
    (
        "general feedback in the place of ACK",
        lambda t: misanswered(t.to_packet(7), 5, lambda tape: tape.feedback()),
        Cause.PACKET_ANSWERED_OTHERWISE,
        Phase.TRANSFER,
        7,
    ),
    (
        "dead after a packet, after which it confirmed the one before",
        lambda t: unanswered(t.to_packet(6).packet(6).ack(6).packet(7).feedback(), 5),
        Cause.PACKET_UNANSWERED,
        Phase.TRANSFER,
        7,
    ),
    ("no ACK", lambda t: unanswered(t.to_packet(7), 5), Cause.PACKET_UNANSWERED, Phase.TRANSFER, 7),
    (
        "damage",
        lambda t: t.to_packet(7).packet(7).wait(0.5).damaged_packet(7).wait(0.5)
        .damaged_packet(7).wait(0.5),
        Cause.PACKET_DAMAGED,
        Phase.TRANSFER,
        7,
    ),
    (
        "restart",
        lambda t: t.to_packet(7).packet(7).wait(0.1).boot().wait(0.05).boot(),
        Cause.DEVICE_RESTARTED,
        Phase.TRANSFER,
        7,
    ),
    (
        "restart and no second request",
        lambda t: t.to_packet(7).packet(7).wait(0.1).boot().update().wait(5),
        Cause.DEVICE_RESTARTED,
        Phase.TRANSFER,
        7,
    ),
    (
        "dead after a packet",
        lambda t: unanswered(t.to_packet(7), 5).reset(5),
        Cause.PACKET_UNANSWERED,
        Phase.TRANSFER,
        7,
    ),
    ("two tools", interleaved, Cause.SECOND_TOOL, Phase.TRANSFER, 3),
    (
        "a reset out of nothing",
        lambda t: t.to_packet(7).reset().packets(7, 8).wait(1),
        Cause.SECOND_TOOL,
        Phase.TRANSFER,
        8,
    ),
    (
        "an update command out of nothing",
        lambda t: t.to_packet(7).update().packets(7, 8).wait(1),
        Cause.SECOND_TOOL,
        Phase.TRANSFER,
        8,
    ),
    (
        "a question in the middle",
        lambda t: t.to_packet(7).tool(0x3300, b"", READ).packets(7, 8).wait(1),
        Cause.SECOND_TOOL,
        Phase.TRANSFER,
        8,
    ),
    (
        "shutdown",
        lambda t: unanswered(t.to_packet(7).shutdown(), 5),
        Cause.SHUTDOWN,
        Phase.TRANSFER,
        7,
    ),
    (
        "error frames",
        lambda t: unanswered(t.to_packet(7).error(5), 2),
        Cause.BUS_TROUBLE,
        Phase.TRANSFER,
        7,
    ),
    (
        "the tool stops",
        lambda t: t.to_packet(7).wait(3).version(OLD),
        Cause.TOOL_STOPPED,
        Phase.TRANSFER,
        6,
    ),
    ("cut off", lambda t: t.to_packet(7), Cause.RECORDING_ENDS, Phase.TRANSFER, 6),
    ("cut off in a packet", lambda t: t.to_packet(7).packet(7), Cause.RECORDING_ENDS,
     Phase.TRANSFER, 7),
    ("cut off in an answer", lambda t: t.to_packet(7).packet(7).frame(ACK_BEGINS),
     Cause.RECORDING_ENDS, Phase.TRANSFER, 7),
    ("cut off after one reset", lambda t: t.version(OLD).reset(), Cause.RECORDING_ENDS,
     Phase.RESET, None),
    ("refused at the end", lambda t: t.to_end().nak(10).end().nak(10), Cause.REFUSED,
     Phase.END, None),
    ("no final answer", lambda t: t.to_end().wait(10).end(), Cause.UNCONFIRMED, Phase.END, None),
    ("early complete", lambda t: t.to_packet(7).complete(), Cause.COMPLETE_TOO_EARLY,
     Phase.TRANSFER, 6),
    ("queries", lambda t: t.tool(0x3300, b"", READ).version(OLD), Cause.QUERIES_ONLY, None, None),
    ("announcements", lambda t: t.boot().boot(), Cause.QUERIES_ONLY, None, None),
    ("foreign", lambda t: t.frame(Frame(0x123, b"\x01")), Cause.FOREIGN_ONLY, None, None),
    ("nothing", lambda t: t, Cause.EMPTY, None, None),
]  # fmt: skip


@pytest.mark.slow
@each(
    "write, cause, phase, packet",
    [row[1:] for row in CAUSES],
)
def test_every_cause_is_named_with_its_phase_and_packet(
    write: Callable[[Tape], object], cause: Cause, phase: Phase | None, packet: int | None
) -> None:
    tape = Tape()
    write(tape)
    verdict = printed(tape).verdict
    assert (verdict.cause, verdict.phase, verdict.packet) == (cause, phase, packet), verdict.text
    assert verdict.text.endswith(".")
    assert bool(verdict.remedy) is not cause.is_good
    assert "{" not in verdict.remedy + verdict.likely


def test_the_table_holds_every_cause() -> None:
    only_in_bundles = {Cause.TOOL_ENDED}
    assert {row[2] for row in CAUSES} == set(Cause) - only_in_bundles


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".csv"])
def test_every_format_reports_the_same(suffix: str, tmp_path: Path) -> None:
    tape = refused(Tape().to_packet(7), 5)
    story = explain_path(tape.save(tmp_path / f"trace{suffix}"))
    assert (story.verdict.cause, story.verdict.packet) == (Cause.PACKET_REFUSED, 7)
    assert story.format == suffix[1:]
    assert story.frames == len(tape.frames)
    measured, exact = story.upgrades[0].link, printed(tape).upgrades[0].link
    assert measured is not None
    assert exact is not None
    assert measured.transfer_s == pytest.approx(exact.transfer_s, abs=2e-6)
    assert measured.device_answer is not None
    assert exact.device_answer is not None
    assert measured.device_answer.median_s == pytest.approx(exact.device_answer.median_s, abs=2e-6)


def test_the_bytes_of_the_documents_are_understood(tmp_path: Path) -> None:
    """A candump of a whole upgrade of one packet, but for the packet typed from the document."""
    packet = Tape().packet(1, 1, b"\x01" * 128).frames
    lines = [
        "(100.000000) can0 752#55AA160742055245", "(100.000500) can0 752#534554A41DA484F0",
        "(100.002000) can0 725#55AA0C0555034143", "(100.002500) can0 725#4BB209FC46F0",
        "(100.052000) can0 725#55AA0C0BC109424D", "(100.052500) can0 725#5356312E322E33E6",
        "(100.053000) can0 725#57D854F0",
        "(100.054000) can0 752#55AA160DA10B424D", "(100.054500) can0 752#535F555044800000",
        "(100.055000) can0 752#00DB7167A3F0",
        "(100.100000) can0 725#55AA0C04C4020000", "(100.100500) can0 725#337142F8F0",
        *(f"(100.{110000 + 500 * n}) can0 752#{frame.data.hex().upper()}"
          for n, (_, frame) in enumerate(packet)),
        "(100.125000) can0 725#55AA0C04C2020100", "(100.125500) can0 725#0027EA05F0",
        "(100.126000) can0 752#55AA1603A401042C", "(100.126500) can0 752#3D8A98F0",
        "(100.130000) can0 725#55AA0C04C5020000", "(100.130500) can0 725#DBD514FDF0",
    ]  # fmt: skip
    path = tmp_path / "typed.log"
    path.write_text("\n".join(lines) + "\n")
    story = explain_path(path)
    (upgrade,) = story.upgrades
    assert upgrade.verdict.cause is Cause.COMPLETED
    assert (upgrade.target, upgrade.image_size_bytes, upgrade.total_packets) == ("BMS", 128, 1)
    assert upgrade.boot_version == "BMS V1.2.3"
    titles = [step.title for step in upgrade.steps if isinstance(step, Step)]
    assert titles == [
        "reset", "general feedback", "boot version", "update command", "request transfer",
        "end of transfer", "complete",
    ]  # fmt: skip
    assert [span.phase for span in upgrade.phases] == [
        Phase.RESET, Phase.BOOT, Phase.UPDATE, Phase.TRANSFER, Phase.END,
    ]  # fmt: skip
    assert story.started_at is None
    assert upgrade.packets[0].answer_s == pytest.approx(0.125500 - 0.118500)


def test_good_packets_are_one_line_and_the_bad_one_has_its_own() -> None:
    tape = Tape().to_packet(4).packet(4).nak(4).packet(4).ack(4).packets(5, 10).end().complete()
    (upgrade,) = printed(tape).upgrades
    lines = upgrade.steps[5:-2]
    runs = [(line.first, line.last) for line in lines if isinstance(line, PacketRun)]
    assert runs == [(1, 3), (4, 10)]
    assert [line.title for line in lines if isinstance(line, Step)] == ["packet", "NAK"]
    assert upgrade.packets[3].tries == 2
    assert upgrade.packets[3].naks == 1
    assert upgrade.link is not None
    assert (upgrade.link.repetitions, upgrade.link.naks) == (1, 1)


def test_every_message_is_a_line_when_everything_is_wanted() -> None:
    tape = Tape().to_end().complete()
    (upgrade,) = explain(tape, source="", everything=True).upgrades
    assert len(upgrade.steps) == 5 + 20 + 2
    assert not any(isinstance(line, PacketRun) for line in upgrade.steps)


@pytest.mark.slow
def test_long_trouble_is_cut_in_the_middle_and_counted() -> None:
    tape = refused(Tape().to_packet(7), 700)
    (upgrade,) = printed(tape).upgrades
    assert len(upgrade.steps) == 1000
    assert upgrade.steps_left_out == 1400 + 6 - 1000


def test_several_upgrades_and_targets_are_distinguished() -> None:
    tape = Tape("bms").to_end().nak(10).end().nak(10).wait(20)
    wmc = Tape("wmc")
    wmc.now, wmc.frames = tape.now, tape.frames
    wmc.to_end().complete()
    again = Tape("bms")
    again.now, again.frames = wmc.now + 30, tape.frames
    story = printed(again.to_end().complete())
    assert [(one.target, one.verdict.cause) for one in story.upgrades] == [
        ("BMS", Cause.REFUSED),
        ("WMC", Cause.COMPLETED),
        ("BMS", Cause.COMPLETED),
    ]
    assert story.verdict.cause is Cause.COMPLETED


def test_the_last_upgrade_of_each_target_makes_the_verdict() -> None:
    tape = Tape().to_end().complete().wait(20).reset(5)
    assert printed(tape).verdict.cause is Cause.NO_BOOT_VERSION


def test_an_update_command_into_silence_is_an_attempt_as_flash_counts_it() -> None:
    """R26; resets and update commands that repeat each other within an attempt are none."""
    tape = Tape().to_packet(5).packet(5).wait(0.6).packet(5).wait(0.6)
    tape.reset(5).wait(5.2).reset(5).wait(10.0)
    tape.update().request().packets(1, 10).end().complete()
    (upgrade,) = printed(tape).upgrades
    assert upgrade.attempts == 4
    tape = Tape().reset(5).feedback().boot().update().wait(0.05).boot().update().request()
    (upgrade,) = printed(tape.packets(1, 10).end().complete()).upgrades
    assert upgrade.attempts == 1


def test_a_restart_that_was_overcome_is_a_remark_and_an_attempt() -> None:
    tape = Tape().to_packet(7).packet(7).wait(0.1).boot().update().wait(0.02).request()
    (upgrade,) = printed(tape.packets(1, 10).end().complete()).upgrades
    assert upgrade.verdict.cause is Cause.COMPLETED
    assert upgrade.attempts == 2
    assert upgrade.remarks == ("the device restarted in the transfer once",)
    assert [span.attempt for span in upgrade.phases] == [1, 1, 1, 1, 2, 2, 2]
    assert [packet.attempt for packet in upgrade.packets] == [1] * 7 + [2] * 10


def test_announcements_just_before_the_update_command_belong_to_the_upgrade() -> None:
    tape = Tape().boot().wait(0.05).boot().update().wait(0.02).request().packets(1, 10)
    (upgrade,) = printed(tape.end().complete()).upgrades
    assert upgrade.boot_version == "BMS V1.2.3"
    assert upgrade.begin_s == pytest.approx(0.0)


def test_a_bus_that_was_listened_to_longer_shows_more_than_its_last_frame() -> None:
    tape = Tape().to_packet(7)
    assert printed(tape, until=tape.now + 5).verdict.cause is Cause.TOOL_STOPPED


def test_the_next_unit_of_a_series_does_not_judge_the_one_before() -> None:
    tape = Tape()
    for serial in (b"W1", b"W2", b"W3"):
        tape.tool(0x3300, b"", READ).version(OLD, serial).wait(0.1)
        with_version(tape).complete().wait(0.3).tool(0x3300, b"", READ).version(NEW, serial)
        tape.wait(40)
    story = printed(tape.tool(0x3300, b"", READ).version(OLD, b"W4"))
    assert [upgrade.verdict.cause for upgrade in story.upgrades] == [Cause.COMPLETED] * 3
    assert [upgrade.running_version for upgrade in story.upgrades] == [NEW.decode()] * 3
    assert all(upgrade.end_s - upgrade.begin_s < 1 for upgrade in story.upgrades)
    assert [upgrade.remarks for upgrade in story.upgrades] == [()] * 3


@pytest.mark.parametrize("begins", [Tape().version(OLD, b"W1"), Tape().reset().version(OLD, b"W1")])
def test_a_version_answer_of_another_unit_is_no_verification(begins: Tape) -> None:
    (upgrade,) = printed(with_version(begins).complete().wait(0.3).version(NEW, b"W2")).upgrades
    assert upgrade.verdict.cause is Cause.COMPLETED
    assert upgrade.running_version is None
    assert upgrade.remarks == ("another unit answers after the end: serial number W2, not W1",)


def test_a_unit_that_falls_back_later_is_still_judged_by_its_last_answer() -> None:
    tape = with_version(Tape().version(OLD)).complete().wait(0.3).version(NEW).wait(5).version(OLD)
    assert printed(tape).verdict.cause is Cause.OTHER_VERSION


def test_hostile_texts_come_out_escaped() -> None:
    story = printed(Tape().reset().feedback().boot(b"\x1b[2J\r\n"))
    assert story.verdict.cause is Cause.WRONG_DEVICE
    assert r"\x1b[2J\r\n" in story.verdict.text
    assert all(char.isprintable() for char in story.verdict.text + str(story.upgrades))


def test_silence_and_error_frames_are_steps() -> None:
    tape = Tape().to_boot().update().wait(3).error(4).request()
    (upgrade,) = printed(tape).upgrades
    kinds = [(step.kind, step.title) for step in upgrade.steps if isinstance(step, Step)]
    assert (StepKind.ERROR_FRAMES, "error frames") in kinds
    assert (StepKind.GAP, "silence") in kinds


def test_others_are_reported_by_id_and_name() -> None:
    tape = Tape().to_end().complete().version(NEW)
    tape.frame(Frame(0x1FFFF, b"\x01", is_extended=True)).frame(Frame(0x123, b"\x01"))
    talkers = {talker.can_id: talker for talker in printed(tape).talkers}
    assert set(talkers) == {0x720, 0x1FFFF, 0x123}
    assert talkers[0x720].name == "BMS > all"
    assert talkers[0x1FFFF].is_extended


def test_the_load_is_that_of_the_bits_on_the_wire() -> None:
    tape = Tape()
    for _ in range(2003):
        tape.frame(Frame(0x123, bytes.fromhex("AA" * 8)))
    bus = printed(tape).bus
    assert bus.duration_s == pytest.approx(1.001, abs=1e-4)
    assert bus.load == pytest.approx(2003 * 111 / 250_000, rel=0.03)
    assert bus.peak_load == pytest.approx(bus.load, rel=0.02)


def test_a_trace_with_displays_and_no_upgrade_has_the_other_dialects_rate() -> None:
    tape = Tape().message(0x742, READ, 0x5000, b"")
    assert printed(tape).bitrate_bps == 125_000
    assert explain(tape, source="", bitrate_bps=500_000).bitrate_bps == 500_000


def test_times_that_go_back_count_as_the_same() -> None:
    tape = Tape().to_end().complete()
    tape.frames[30:] = [(at - 10, frame) for at, frame in tape.frames[30:]]
    assert printed(tape).verdict.cause is Cause.COMPLETED


def test_a_file_that_was_cut_off_is_explained_up_to_there(tmp_path: Path) -> None:
    path = Tape().to_packet(7).save(tmp_path / "killed.log")
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.index(b"752#", len(whole) // 2)])
    story = explain_path(path)
    assert story.verdict.cause is Cause.RECORDING_ENDS
    assert story.damage.startswith("after frame ")
    assert explain_path(Tape().to_boot().save(tmp_path / "whole.log")).damage == ""
