"""WMC, OBC and HMI: what they ask, how often, and how they shut down; byte by byte."""

from __future__ import annotations

import pytest

from flasher.mock.clients import ClientApplication
from flasher.mock.machine import Unit
from flasher.mock.model import MockDevice
from flasher.protocol.spec import MOTINOVA, OBC, WELLING, WMC, Dialect, Node, Target
from flasher.protocol.timing import DEFAULT_TIMINGS
from tests.loops import each
from tests.mock.talk import READ, REPORT, START_S, WRITE, Talk

FIVE = [0.0, 0.2, 0.4, 0.6, 0.8]
HANDSHAKE = (0x712, READ, 0x3009, b"HANDSHAKE")
READY = (0x721, REPORT, 0x3005, b"READY")
SHUTDOWN = (0x720, REPORT, 0x1308, b"SHUTDOWN")
# Every answer of a BMS that is asked for here, by its command; the content does not matter.
ANSWERS = {
    0x3100: (0x720, REPORT, 0x160C, bytes(12)),
    0x3200: (0x720, REPORT, 0x170C, bytes(12)),
    0x3300: (0x720, REPORT, 0x1410, bytes(16)),
    0x5000: (0x720, REPORT, 0x1010, bytes(16)),
    0x5100: (0x720, REPORT, 0x1540, bytes(64)),
    0x5200: (0x720, REPORT, 0x1410, bytes(16)),
    0x5300: (0x720, REPORT, 0x1120, bytes(32)),
}


def node(which: Node, dialect: Dialect = WELLING) -> Talk:
    talker = ClientApplication(which, dialect)
    return Talk(Unit(talker, bitrate_bps=dialect.bitrate_bps, timings=DEFAULT_TIMINGS))


def unit_of(talk: Talk) -> Unit:
    assert isinstance(talk.engine, Unit)
    return talk.engine


def questions(talk: Talk) -> list[tuple[int, int, int, bytes]]:
    return [heard[1:] for heard in talk.take()]


def answer_all(talk: Talk, duration_s: float) -> list[tuple[float, int]]:
    """Answer every question 10 ms later; the times and commands that were asked."""
    asked = []
    end_s = talk.now + duration_s
    while talk.now < end_s:
        talk.run(0.01)
        for heard in talk.take():
            asked.append((heard.at_s - START_S, heard.command))
            if heard[1:] == HANDSHAKE:
                talk.put(*READY)
            else:
                talk.put(*ANSWERS[heard.command])
    return asked


def test_an_application_without_a_machine_cannot_talk() -> None:
    with pytest.raises(LookupError, match="runs on a machine"):
        _ = ClientApplication(Node.WMC, WELLING).port


# -- questions ------------------------------------------------------------------------------------


def test_the_wmc_repeats_its_handshake_every_200_ms_for_1_s_and_after_a_pause_again() -> None:
    talk = node(Node.WMC)
    talk.run(3.95)
    heard = talk.take()
    assert {one[1:] for one in heard} == {HANDSHAKE}
    expected_s = [*FIVE, *(2.0 + at_s for at_s in FIVE)]
    assert [one.at_s - START_S for one in heard] == pytest.approx(expected_s)


def test_after_its_handshake_the_wmc_reads_id_check_code_and_design_once() -> None:
    talk = node(Node.WMC)
    talk.run(0.25)
    assert questions(talk) == [HANDSHAKE] * 2
    for answer, question in [
        (READY, 0x3100),
        (ANSWERS[0x3100], 0x3200),
        (ANSWERS[0x3200], 0x3300),
    ]:
        talk.put(*answer)
        assert questions(talk) == [(0x712, READ, question, b"")]
    talk.put(*ANSWERS[0x3300])
    talk.run(60.0)
    assert questions(talk) == []


def test_an_answer_to_something_else_ends_no_question() -> None:
    talk = node(Node.WMC)
    talk.run(0.1)
    talk.take()
    for stray in [*ANSWERS.values(), (0x720, REPORT, 0x3005, b"READY"), (0x721, *READY[1:3], b"")]:
        if len(stray[3]) == stray[2] & 0xFF:
            talk.put(*stray)
    talk.put(0x721, WRITE, 0x3005, b"READY")
    assert questions(talk) == []
    talk.run(0.2)
    assert questions(talk) == [HANDSHAKE]


@each("dialect", [WELLING, MOTINOVA])
def test_the_obc_reads_version_design_and_cells_then_running_information_every_second(
    dialect: Dialect,
) -> None:
    asked = answer_all(node(Node.OBC, dialect), 5.5)
    assert [command for _, command in asked] == [0x5100, 0x5200, 0x5300] + [0x5000] * 6
    times_s = [at_s for at_s, _ in asked[4:]]
    assert times_s == pytest.approx([1.0, 2.0, 3.0, 4.0, 5.0], abs=0.001)


def test_the_hmi_reads_version_and_design_then_cells_every_five_seconds() -> None:
    talk = node(Node.HMI, MOTINOVA)
    asked = []
    for _ in range(1200):
        talk.run(0.01)
        for heard in talk.take():
            assert (heard.can_id, heard.mode, heard.data) == (0x742, READ, b"")
            asked.append(heard.command)
            answers = {0x5000: 0x5100, 0x5100: 0x5200, 0x5200: 0x5300}
            talk.put(*ANSWERS[answers[heard.command]])
    assert asked == [0x5000, 0x5100, 0x5200, 0x5200, 0x5200]


def test_a_question_in_vain_is_given_up_after_1_s_and_the_next_one_asked() -> None:
    talk = node(Node.OBC)
    talk.run(2.9)
    heard = talk.take()
    assert [one.command for one in heard] == [0x5100] * 5 + [0x5200] * 5 + [0x5300] * 5


def test_a_question_that_waits_for_its_turn_is_not_asked_twice() -> None:
    talk = node(Node.OBC)
    talk.run(60.0)
    talk.take()
    asked = answer_all(talk, 1.1)
    assert [command for _, command in asked].count(0x5000) <= 2


def test_a_bus_that_takes_nothing_gets_one_copy_once_it_does() -> None:
    talk = node(Node.WMC)
    talk.accepts_frames = False
    talk.run(10.0)
    talk.accepts_frames = True
    assert questions(talk) == [HANDSHAKE]


# -- shutdown -------------------------------------------------------------------------------------


@each(
    "which, dialect, reported",
    [
        (
            Node.WMC,
            WELLING,
            [(0x710, REPORT, 0x1305, b"READY"), (0x710, REPORT, 0x1808, b"SHUTDOWN")],
        ),
        (Node.WMC, MOTINOVA, [(0x710, REPORT, 0x1305, b"READY")]),
        (Node.OBC, WELLING, [(0x730, REPORT, 0x1405, b"READY")]),
        (Node.OBC, MOTINOVA, [(0x730, REPORT, 0x1405, b"READY")]),
        (Node.HMI, MOTINOVA, [(0x740, REPORT, 0x1305, b"READY")]),
    ],
)
def test_shutdown_is_answered_with_ready_and_the_wmc_sends_goodbye_in_the_older_dialect(
    which: Node, dialect: Dialect, reported: list[tuple[int, int, int, bytes]]
) -> None:
    talk = node(which, dialect)
    talk.run(0.1)
    talk.take()
    talk.put(*SHUTDOWN)
    assert questions(talk) == reported
    # Each announcement asks anew, the goodbye is sent once.
    talk.put(*SHUTDOWN)
    assert questions(talk) == reported[:1]
    talk.run(60.0)
    assert questions(talk) == []


def test_what_is_no_shutdown_of_the_bms_is_not_answered() -> None:
    talk = node(Node.OBC)
    talk.run(0.1)
    talk.take()
    talk.put(0x710, REPORT, 0x1808, b"SHUTDOWN")
    talk.put(0x720, REPORT, 0x1308, b"SHUTDOWM")
    talk.put(0x720, WRITE, 0x1308, b"SHUTDOWN")
    assert questions(talk) == []


def test_power_that_comes_back_begins_the_questions_anew() -> None:
    talk = node(Node.WMC)
    talk.put(*SHUTDOWN)
    talk.run(1.0)
    talk.take()
    unit = unit_of(talk)
    unit.power_cut(talk.now)
    assert not unit.has_power
    talk.put(*SHUTDOWN)
    talk.run(5.0)
    assert questions(talk) == []
    assert unit.deadline() is None
    unit.power_on(talk.now)
    unit.power_on(talk.now)
    talk.run(0.1)
    assert questions(talk) == [HANDSHAKE]


# -- as an application of a device that can be upgraded -------------------------------------------


@each("target", [WMC, OBC])
def test_the_application_talks_and_the_bootloader_does_not(target: Target) -> None:
    talker = ClientApplication(target.node, WELLING)
    talk = Talk(MockDevice(target, bitrate_bps=250_000, application=talker))
    talk.run(0.1)
    (first,) = talk.take()
    assert first.can_id == 0x702 | target.node.value << 4
    talk.put(target.request_id, WRITE, 0x4205, b"RESET")
    assert [heard.command for heard in talk.take()] == [0x5503]
    talk.run(0.39)
    assert {heard.command for heard in talk.take()} == {0xC109}
    talk.put(*SHUTDOWN)
    assert talk.take() == []
    talk.run(0.1)
    assert [heard.command for heard in talk.take()] == [first.command]
