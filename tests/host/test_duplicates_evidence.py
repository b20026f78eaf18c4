"""What counts as evidence of a second device, dialogue by dialogue, up to the exact moment."""

from __future__ import annotations

from dataclasses import replace

from flasher.host.duplicates import DuplicateDetector
from flasher.protocol import catalogue
from flasher.protocol.catalogue import BY_KEY, Item
from flasher.protocol.contents import (
    BatteryStatus,
    CheckCode,
    RunningInformation,
    VersionInformation,
)
from flasher.protocol.fields import Content, WireText
from flasher.protocol.frame import Frame
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    GeneralFeedbackMessage,
    Nak,
    RequestTransfer,
    UpgradeMessage,
)
from flasher.protocol.spec import Command
from flasher.protocol.text import encode_text
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Damage, DamageReason, Message, encode
from tests.loops import each

TICK_S = 2**-10
"""The least time between two messages here; more than a link that doubles them takes."""
SPACING_S = 64 * TICK_S
SHORTEST_S, LONGEST_S = 48 * TICK_S, 80 * TICK_S
"""Between two announcements of one bootloader: documented, with a quarter of tolerance."""
TIMINGS = Timings(
    command_timeout_s=1024 * TICK_S,
    quiet_after_repeat_s=32 * TICK_S,
    boot_version_spacing_s=SPACING_S,
    leftover_boot_version_s=64 * TICK_S,
)
VERSION, RUNNING = BY_KEY[0x720, 0x1540], BY_KEY[0x720, 0x1010]
WRITTEN = BY_KEY[0x725, 0x5503]
"""The answer to each write."""
BATTERY = RunningInformation(40_000, -8, 8000, 9800, 22, 85, BatteryStatus(0), 98, bytes(4))
BOOT = BootVersion("BMS", "V1.2.3")
TWO_ANSWERED = "two devices answered"
CONFIRMED_TWICE = "one message was confirmed twice"
TOO_OFTEN = "packets were answered more often than they were sent"
BESIDE = "a bootloader announced itself while an application was running"
ALTERNATELY = "two bootloaders announced themselves alternately"


def version(serial: str = "W1", firmware: str = "V1r0r0_20220512") -> VersionInformation:
    texts = ("BM36", serial, "V1r2r0_20220512", firmware)
    return VersionInformation(*(WireText(encode_text(text, 16)) for text in texts))


class Watch:
    """A `DuplicateDetector` with the time; times are in ticks."""

    def __init__(self, timings: Timings = TIMINGS) -> None:
        self.duplicates = DuplicateDetector(timings)
        self.now = 512.0

    def wait(self, ticks: float) -> Watch:
        self.now += ticks * TICK_S
        return self

    def asks(self, item: Item = VERSION) -> Watch:
        self.duplicates.request_sent(item.key, self.now, item)
        return self

    def answers(self, content: Content | None = None, item: Item = VERSION) -> Watch:
        """A tick later."""
        self.now += TICK_S
        self.duplicates.received(catalogue.encode(item, content or version()), self.now)
        return self

    def sends(self, command: Command, packet: int = 0) -> Watch:
        self.now += TICK_S
        self.duplicates.upgrade_message_sent(command, self.now, packet)
        return self

    def hears(self, *rows: UpgradeMessage, can_id: int = 0x725) -> Watch:
        """Each a tick after the one before."""
        for row in rows:
            self.now += TICK_S
            self.duplicates.received(row.to_message(can_id), self.now)
        return self

    def announces(self, *ticks: float, boot: BootVersion = BOOT, can_id: int = 0x725) -> Watch:
        """Announcements, each so much later than what was before."""
        for each_ticks in ticks:
            self.wait(each_ticks)
            self.duplicates.received(boot.to_message(can_id), self.now)
        return self

    def sees(self, can_id: int, *, remote: bool = False) -> Watch:
        self.duplicates.frame_received(
            Frame(can_id, b"" if remote else b"\x05", is_remote=remote), self.now
        )
        return self

    def transfers(self, count: int = 0) -> Watch:
        """Up to the answer to packet `count`."""
        self.sends(Command.UPDATE).hears(RequestTransfer())
        for packet in range(1, count + 1):
            self.sends(Command.PACKET, packet).hears(Ack(packet))
        return self

    @property
    def evidence(self) -> str:
        return self.duplicates.evidence

    @property
    def ambiguous_queries(self) -> list[Item]:
        return self.duplicates.ambiguous_queries


def asked(*, answers: int, item: Item = VERSION) -> Watch:
    watch = Watch().asks(item)
    for _ in range(answers):
        watch.answers(None if item is VERSION else BATTERY, item)
    return watch


def at(now: float) -> Watch:
    watch = Watch()
    watch.now = now
    return watch


# -- questions ------------------------------------------------------------------------------------


def test_a_question_with_two_answers_is_asked_again_and_decides_nothing_yet() -> None:
    assert asked(answers=1).ambiguous_queries == []
    watch = asked(answers=2)
    assert watch.ambiguous_queries == [VERSION]
    assert watch.evidence == ""
    assert asked(answers=5).evidence == "", "they are all in one round"
    watch.wait(100).asks().answers().answers()
    assert watch.evidence == TWO_ANSWERED


def test_a_round_with_one_answer_ends_the_doubt() -> None:
    watch = asked(answers=2).wait(100).asks().answers().wait(100).asks()
    assert watch.ambiguous_queries == []
    assert watch.answers().answers().evidence == ""
    assert watch.ambiguous_queries == [VERSION]


@each(
    "answers, ticks, is_same_round",
    [
        (2, 31, True),
        (2, 32, False),  # an answered question is over after the silence of a repetition
        (0, 1022, True),
        (0, 1023, False),  # one without an answer, when it is given up
    ],
)
def test_a_repetition_belongs_to_the_round_until_its_time_is_over(
    answers: int, ticks: int, *, is_same_round: bool
) -> None:
    watch = asked(answers=answers)
    if not answers:
        watch.wait(1)
    watch.wait(ticks).asks().answers().answers()
    if answers:
        # The third and fourth answer: to two copies in a round that was odd already, or to one.
        assert watch.evidence == ("" if is_same_round else TWO_ANSWERED)
    else:
        assert watch.ambiguous_queries == ([] if is_same_round else [VERSION])


def test_each_copy_of_a_question_may_have_its_answer() -> None:
    watch = Watch().asks().wait(200).asks().wait(200).asks().answers().answers().answers()
    assert watch.ambiguous_queries == []
    assert watch.answers().ambiguous_queries == [VERSION]


def test_a_question_that_is_half_answered_stays_open_until_it_is_given_up() -> None:
    watch = Watch().asks().wait(200).asks().answers().wait(100).asks()
    assert watch.answers().answers().ambiguous_queries == [], "three copies, three answers"


@each("ticks, counts", [(1023, True), (1024, False)])
def test_an_answer_counts_until_its_question_is_given_up(ticks: int, *, counts: bool) -> None:
    watch = asked(answers=1)
    watch.now = 512.0 + ticks * TICK_S
    assert watch.answers().ambiguous_queries == ([VERSION] if counts else [])


@each("apart_s, is_second", [(0.0002, False), (0.0003, True)])
def test_the_same_message_at_once_was_doubled_by_the_link(
    apart_s: float, *, is_second: bool
) -> None:
    """On the wire two messages take longer."""
    watch = at(-TICK_S).asks().answers()
    watch.duplicates.received(catalogue.encode(VERSION, version()), apart_s)
    assert watch.ambiguous_queries == ([VERSION] if is_second else [])
    watch = at(-2 * TICK_S).sends(Command.RESET).hears(GeneralFeedbackMessage())
    watch.duplicates.received(GeneralFeedbackMessage().to_message(0x725), apart_s)
    assert watch.evidence == (CONFIRMED_TWICE if is_second else "")


def test_two_versions_are_two_devices_and_the_fields_that_differ_are_named() -> None:
    watch = asked(answers=1).answers(version("W2"))
    assert watch.evidence == f"{TWO_ANSWERED}: serial number W1 / W2"
    watch.answers(version("W2")).answers(version("W1", "V9r0r0_20250101"))
    assert watch.evidence == (
        f"{TWO_ANSWERED}: serial number W1 / W2; firmware version V1r0r0_20220512 / V9r0r0_20250101"
    )
    assert watch.duplicates.contents == {
        VERSION.key: [version(), version("W2"), version("W1", "V9r0r0_20250101")]
    }


def test_values_that_change_are_no_second_device_but_distinguish_two() -> None:
    watch = Watch().asks(RUNNING).answers(BATTERY, RUNNING).wait(100)
    watch.asks(RUNNING).answers(replace(BATTERY, mean_current_ma=-9), RUNNING)
    assert watch.evidence == ""
    watch.asks().answers().answers(version("W2"))
    assert watch.evidence == f"{TWO_ANSWERED}: mean current -8 mA / -9 mA; serial number W1 / W2"


def test_eight_different_answers_are_kept() -> None:
    watch = Watch().asks(RUNNING)
    for current_ma in range(10):
        watch.answers(replace(BATTERY, mean_current_ma=current_ma), RUNNING)
    kept = watch.duplicates.contents[RUNNING.key]
    assert [getattr(each, "mean_current_ma", None) for each in kept] == list(range(8))


def test_an_answer_of_another_size_counts_and_is_not_read() -> None:
    watch = asked(answers=1).wait(1)
    watch.duplicates.received(Message(*VERSION.key[:1], 0x0C, VERSION.key[1], b"\1"), watch.now)
    assert watch.ambiguous_queries == [VERSION]
    assert watch.duplicates.contents[VERSION.key] == [version()]


def test_a_write_that_is_confirmed_twice_is_two_devices_at_once() -> None:
    watch = Watch().asks(WRITTEN).hears(GeneralFeedbackMessage())
    assert watch.evidence == ""
    assert watch.hears(GeneralFeedbackMessage()).evidence == CONFIRMED_TWICE
    assert watch.ambiguous_queries == [WRITTEN]


def test_a_question_of_somebody_else_has_an_answer_of_its_own() -> None:
    display = Message(0x732, 0x11, 0x5100, b"")
    watch = asked(answers=1)
    watch.duplicates.received(display, watch.now)
    assert watch.answers().ambiguous_queries == []
    assert watch.answers().ambiguous_queries == [VERSION]
    other_mode = display._replace(mode=0x16)
    watch = asked(answers=1)
    watch.duplicates.received(other_mode, watch.now)
    assert watch.answers().ambiguous_queries == [VERSION], "that was no question"


def test_what_no_one_asked_for_is_no_answer() -> None:
    watch = Watch().answers().answers()
    assert watch.ambiguous_queries == []
    assert watch.duplicates.contents == {}


def garbled(message: Message, *, doubled: bool = False) -> Damage:
    data = encode(message)
    data = data[:8] * 2 + data[8:] if doubled else data[:16] + b"\0" * 8
    return Damage(message.can_id, DamageReason.BAD_CRC, data)


@each(
    "damage, counts",
    [
        (garbled(catalogue.encode(VERSION, version())), True),
        (garbled(catalogue.encode(VERSION, version()), doubled=True), False),
        (garbled(catalogue.encode(RUNNING, BATTERY)), False),
        (Damage(0x720, DamageReason.INCOMPLETE, encode(catalogue.encode(VERSION, version()))[:8]),
         True),
        (Damage(0x725, DamageReason.JUNK, encode(catalogue.encode(VERSION, version()))), False),
    ],
)  # fmt: skip
def test_an_answer_that_was_begun_counts_unless_its_frame_was_doubled(
    damage: Damage, *, counts: bool
) -> None:
    watch = asked(answers=1).wait(1)
    watch.duplicates.received(damage, watch.now)
    assert watch.ambiguous_queries == ([VERSION] if counts else [])


def test_a_confirmation_that_was_spoilt_counts() -> None:
    watch = Watch().sends(Command.RESET).hears(GeneralFeedbackMessage()).wait(1)
    watch.duplicates.received(garbled(GeneralFeedbackMessage().to_message(0x725)), watch.now)
    assert watch.evidence == CONFIRMED_TWICE
    watch = Watch().announces(0).sends(Command.RESET).wait(1)
    watch.duplicates.received(garbled(GeneralFeedbackMessage().to_message(0x725)), watch.now)
    assert watch.duplicates.application_beside
    watch = Watch().sends(Command.RESET).hears(GeneralFeedbackMessage()).wait(1)
    watch.duplicates.received(garbled(Ack(1).to_message(0x725)), watch.now)
    assert watch.evidence == ""


def test_an_update_command_ends_all_questions() -> None:
    """Another application will answer."""
    watch = asked(answers=2).sends(Command.UPDATE).wait(100).asks().answers(version("W2"))
    assert watch.answers(version("W2")).evidence == ""
    assert watch.ambiguous_queries == [VERSION]


# -- before the transfer --------------------------------------------------------------------------


def test_each_reset_may_be_confirmed_once() -> None:
    watch = Watch().sends(Command.RESET).sends(Command.RESET)
    assert watch.hears(GeneralFeedbackMessage(), GeneralFeedbackMessage()).evidence == ""
    assert watch.hears(GeneralFeedbackMessage()).evidence == CONFIRMED_TWICE


def test_a_confirmation_before_anything_was_sent_is_somebody_elses() -> None:
    watch = Watch().hears(GeneralFeedbackMessage(), GeneralFeedbackMessage()).sends(Command.RESET)
    assert watch.hears(GeneralFeedbackMessage()).evidence == ""


@each("after_ticks, application_beside", [(79, True), (80, False)])
def test_a_reset_that_is_confirmed_while_a_bootloader_announces_itself(
    after_ticks: int, *, application_beside: bool
) -> None:
    """A bootloader does not know the reset."""
    watch = Watch().announces(0).sends(Command.RESET).wait(after_ticks - 1)
    assert watch.duplicates.announces(0x725, watch.now)
    assert not watch.duplicates.announces(0x720, watch.now)
    watch.hears(GeneralFeedbackMessage())
    assert watch.duplicates.application_beside is application_beside
    assert (
        watch.wait(500)
        .sends(Command.RESET)
        .hears(GeneralFeedbackMessage())
        .duplicates.application_beside
        is False
    )


def test_it_stays_so_until_the_next_reset_or_update_command() -> None:
    assert not Watch().duplicates.application_beside
    for command in (Command.RESET, Command.UPDATE):
        watch = Watch().announces(0).sends(Command.RESET).hears(GeneralFeedbackMessage()).wait(500)
        assert (
            watch.sends(Command.END_OF_TRANSFER)
            .hears(GeneralFeedbackMessage())
            .duplicates.application_beside
        )
        watch.sends(command)
        assert not watch.duplicates.application_beside
    watch.announces(1).hears(GeneralFeedbackMessage())
    assert not watch.duplicates.application_beside, "a bootloader may confirm the update command"


def test_an_announcement_counts_since_the_last_reset_or_update_command() -> None:
    for command in (Command.RESET, Command.UPDATE):
        watch = Watch()
        assert not watch.duplicates.has_announced(0x725)
        assert watch.announces(0).duplicates.has_announced(0x725)
        assert not watch.duplicates.has_announced(0x720)
        assert not watch.sends(command).duplicates.has_announced(0x725)
        assert watch.announces(9).duplicates.has_announced(0x725)
    watch.sends(Command.PACKET, 1)
    assert watch.duplicates.has_announced(0x725)


@each("apart, overlap", [(47, True), (48, False), (64, False)])
def test_two_announcements_nearer_than_one_bootloader_sends_them(
    apart: int, *, overlap: bool
) -> None:
    watch = Watch().announces(0)
    assert not watch.duplicates.overlap(0x725)
    watch.announces(apart)
    assert watch.duplicates.overlap(0x725) is overlap
    assert not watch.duplicates.overlap(0x720)
    assert not watch.announces(64).duplicates.overlap(0x725), "the last two are compared"


def test_two_boot_versions_are_two_bootloaders() -> None:
    newer = BootVersion("BMS", "V1.2.4")
    watch = Watch().announces(0).announces(10, boot=newer)
    expected = "bootloaders announced BMS V1.2.3 and BMS V1.2.4"
    assert watch.evidence == expected
    watch = Watch().announces(0).sends(Command.UPDATE).announces(10, boot=newer)
    assert watch.evidence == expected, "an update command changes no bootloader"
    watch = Watch().announces(0).sends(Command.RESET).announces(10, boot=newer)
    assert watch.evidence == "", "another device may be connected now"
    assert Watch().announces(0).announces(10, boot=newer, can_id=0x711).evidence == ""


@each(
    "before, after, can_id, remote, evidence",
    [
        (10, 54, 0x720, False, BESIDE),
        (80, 1, 0x720, False, BESIDE),
        (1, 80, 0x720, False, BESIDE),
        (81, 1, 0x720, False, ""),  # it had ended, or begins
        (1, 81, 0x720, False, ""),
        (0, 64, 0x720, False, ""),
        (64, 0, 0x720, False, ""),
        (10, 54, 0x725, False, ""),  # a bootloader speaks to the tool
        (10, 54, 0x710, False, ""),  # another node's
        (10, 54, 0x720, True, ""),
    ],
)
def test_an_application_that_sends_between_two_announcements(
    before: int, after: int, can_id: int, *, remote: bool, evidence: str
) -> None:
    watch = Watch().announces(0).wait(before).sees(can_id, remote=remote).announces(after)
    assert watch.evidence == evidence


def test_an_application_is_compared_with_the_announcements_next_to_it() -> None:
    assert Watch().announces(0, 64, 64).wait(10).sees(0x720).announces(54).evidence == BESIDE
    assert Watch().announces(0).wait(81).sees(0x720).announces(1, 64).evidence == ""


def test_an_application_that_is_restarted_into_its_bootloader_is_one() -> None:
    assert Watch().sees(0x720).announces(1).announces(64).evidence == ""
    assert Watch().announces(0, 64).wait(1).sees(0x720).evidence == ""
    watch = Watch().announces(0).sends(Command.RESET).wait(1).sees(0x720).announces(1)
    assert watch.evidence == ""


@each(
    "ticks, evidence",
    [
        ((0, 20, 44, 20), ALTERNATELY),
        ((0, 20, 44, 20, 44, 20), ALTERNATELY),
        ((0, 64, 20, 44, 20, 44), ALTERNATELY),
        ((0, 16, 64, 16), ALTERNATELY),  # two rounds of 80 ticks: the longest
        ((0, 16, 65, 16), ""),
        ((0, 16, 32, 16), ""),  # uneven by no more than the tolerance
        ((0, 15, 33, 15), ALTERNATELY),  # two rounds of 48 ticks: the shortest
        ((0, 15, 32, 16), ""),
        ((0, 32, 32, 32, 32, 32, 32), ""),  # one that is twice as fast as documented
        ((0, 64, 32, 32, 32), ALTERNATELY),  # unless it was seen to be slower
        ((0, 48, 32, 32, 32), ALTERNATELY),
        ((0, 80, 32, 32, 32), ALTERNATELY),
        ((0, 47, 32, 32, 32), ""),
        ((0, 81, 32, 32, 32), ""),
        ((0, 64, 64, 64, 64), ""),
        ((0, 20, 44), ""),
    ],
)
def test_two_bootloaders_that_announce_themselves_alternately(
    ticks: tuple[int, ...], evidence: str
) -> None:
    assert Watch().announces(*ticks).evidence == evidence


def test_announcements_before_a_reset_are_not_compared() -> None:
    assert Watch().announces(0, 20, 44).sends(Command.RESET).announces(19).evidence == ""


def test_bootloaders_that_alternate_are_two_also_where_neither_receives_an_update_command() -> None:
    watch = Watch().announces(0, 44, 20).sends(Command.UPDATE).announces(43, 20)
    assert watch.evidence == ALTERNATELY


def test_one_boot_version_that_the_line_doubles_is_no_second_bootloader() -> None:
    assert Watch().announces(0, 64, 1, 63, 64).evidence == ""
    assert Watch().announces(0, 64, 1, 63, 1).evidence == ALTERNATELY


@each("early", [2, 20, 47])
def test_one_that_begins_its_burst_anew_at_each_update_command_is_one(early: int) -> None:
    watch = Watch().announces(0, 64)
    for _ in range(3):
        watch.sends(Command.UPDATE).announces(early - 1, 64)
    assert watch.evidence == ""


# -- the transfer ---------------------------------------------------------------------------------


@each("has_paused, evidence", [(True, ""), (False, TOO_OFTEN)])
def test_a_refusal_of_the_part_before_a_pause_of_this_computer_is_no_second_answer(
    has_paused: bool, evidence: str
) -> None:
    watch = Watch().transfers(1)
    for packet in (2, 3, 4):
        if has_paused:
            watch.duplicates.message_dropped()
        watch.hears(Nak(packet)).sends(Command.PACKET, packet).hears(Ack(packet))
    assert watch.evidence == evidence


def test_a_pause_excuses_one_refusal_only() -> None:
    watch = Watch().transfers(1)
    watch.duplicates.message_dropped()
    watch.hears(Nak(2)).sends(Command.PACKET, 2).hears(Ack(2))
    for packet in (3, 4, 5):
        watch.hears(Nak(packet)).sends(Command.PACKET, packet).hears(Ack(packet))
    assert watch.evidence == TOO_OFTEN


@each(
    "ticks_after_request, sends, what",
    [
        (66, 65, "a bootloader announced itself"),
        (66, 64, ""),  # a packet left too soon after the request: a leftover of the announcements
        (66, 0, ""),  # nothing was sent since the request: it may have waited in this computer
    ],
)
def test_a_device_that_announces_itself_has_no_transfer_any_more(
    ticks_after_request: int, sends: int, what: str
) -> None:
    watch = Watch().sends(Command.UPDATE).hears(RequestTransfer())
    if sends:
        watch.wait(sends - 1).sends(Command.PACKET, 1).wait(ticks_after_request - sends)
    watch.announces(1).hears(Ack(1))
    assert watch.evidence == (f"{what}, yet packet 1 was acknowledged" if what else "")


def test_one_that_announces_itself_after_the_end_is_restarting() -> None:
    watch = Watch().transfers(1).wait(100).sends(Command.END_OF_TRANSFER).announces(1)
    assert watch.hears(Complete()).evidence == ""
    watch = Watch().transfers(1).wait(100).sends(Command.PACKET, 2).announces(1)
    assert watch.hears(Complete()).evidence == (
        "a bootloader announced itself, yet the transfer was completed"
    )


def test_an_answer_that_was_doubled_in_an_earlier_attempt_is_not_counted_again() -> None:
    watch = Watch().sends(Command.UPDATE).hears(RequestTransfer()).sends(Command.PACKET, 1)
    watch.hears(Ack(1), Ack(1)).transfers(2)
    assert watch.evidence == ""


def test_an_update_command_begins_another_transfer() -> None:
    watch = Watch().transfers(1).wait(100).sends(Command.PACKET, 2).announces(1)
    watch.transfers(1)
    assert watch.evidence == ""
    watch = Watch().transfers(1).sends(Command.UPDATE).hears(RequestTransfer())
    watch.sends(Command.PACKET, 1)
    assert watch.hears(Ack(1)).evidence == "", "no ACK came before the second request"


def test_request_transfer_after_an_ack_is_another_devices_only_if_the_transfer_goes_on() -> None:
    watch = Watch().transfers(0).hears(RequestTransfer()).sends(Command.PACKET, 1)
    assert watch.hears(Ack(1)).evidence == "", "before the first ACK it is a repetition"
    watch = watch.hears(RequestTransfer())
    assert watch.evidence == ""
    watch.sends(Command.PACKET, 2).hears(Ack(2))
    assert watch.evidence == "request transfer came again, yet packet 2 was acknowledged"


@each("row", [RequestTransfer(), Ack(1), Nak(1)])
def test_who_goes_on_after_the_end_is_another_device(row: UpgradeMessage) -> None:
    going_on = "one device continued a transfer that another one had completed"
    watch = Watch().transfers(1).sends(Command.END_OF_TRANSFER).hears(Complete())
    assert watch.evidence == ""
    assert watch.hears(row).evidence == going_on
    watch = Watch().transfers(1).sends(Command.PACKET, 2).hears(Complete(), row)
    assert watch.evidence != going_on, "end of transfer was not sent"
    watch = Watch().transfers(1).sends(Command.END_OF_TRANSFER).hears(Complete())
    assert watch.transfers(0).hears(row).evidence != going_on, "another transfer"


@each("apart_s, is_second", [(0.001, False), (0.002, False), (0.003, True)])
def test_one_packet_with_two_acks_is_two_devices_where_they_are_clearly_apart(
    apart_s: float, *, is_second: bool
) -> None:
    watch = at(-4 * TICK_S).transfers(1)
    assert watch.now == 0.0
    watch.duplicates.received(Ack(1).to_message(0x725), apart_s)
    expected = "packet 1 was acknowledged more often than it was sent"
    assert watch.evidence == (expected if is_second else "")


def test_each_copy_of_a_packet_may_have_its_ack_in_any_attempt() -> None:
    watch = Watch().transfers(0).sends(Command.PACKET, 1).sends(Command.PACKET, 1)
    watch.transfers(0).sends(Command.PACKET, 1)
    for _ in range(3):
        watch.wait(9).hears(Ack(1))
    assert watch.evidence == ""
    assert watch.wait(9).hears(Ack(1)).evidence != ""


def odd(watch: Watch, packet: int) -> Watch:
    """A packet with an ACK and a NAK."""
    return watch.sends(Command.PACKET, packet).hears(Nak(packet), Ack(packet))


def test_two_packets_near_each_other_with_two_answers_are_two_devices() -> None:
    watch = odd(Watch().transfers(1), 2)
    assert watch.evidence == ""
    assert odd(watch, 3).evidence == "", "one of them is half forgotten"
    assert odd(watch, 4).evidence == TOO_OFTEN


def test_a_nak_counts_before_the_ack_and_after_it() -> None:
    watch = Watch().transfers(0)
    for packet in (1, 2, 3):
        watch.sends(Command.PACKET, packet).hears(Ack(packet), Nak(packet))
    assert watch.evidence == TOO_OFTEN


@each("good, evidence", [(16, TOO_OFTEN), (18, "")])
def test_what_was_odd_is_forgotten_slowly(good: int, evidence: str) -> None:
    """Three packets of twenty are too many."""
    watch = odd(odd(Watch().transfers(0), 1), 2)
    for packet in range(3, 3 + good):
        watch.sends(Command.PACKET, packet).hears(Ack(packet))
    assert odd(watch, 3 + good).evidence == evidence


def test_a_refusal_of_the_image_is_no_answer_to_a_packet() -> None:
    watch = Watch()
    for _ in range(3):
        watch.transfers(2).sends(Command.END_OF_TRANSFER).hears(Nak(2))
    assert watch.evidence == ""


@each("number", [0, 2, 3])
def test_end_of_transfer_may_be_acknowledged_as_often_as_it_was_sent(number: int) -> None:
    watch = Watch().transfers(2)
    for _ in range(2):
        watch.sends(Command.END_OF_TRANSFER).wait(9).hears(Ack(number))
    assert watch.evidence == ""


def test_an_ack_of_end_of_transfer_is_no_second_answer_to_a_packet() -> None:
    watch = odd(odd(Watch().transfers(1), 2), 2)
    for _ in range(3):
        watch.sends(Command.END_OF_TRANSFER).wait(9).hears(Ack(3))
    assert watch.evidence == ""


def test_a_second_ack_of_the_last_packet_beside_that_of_the_end_is_another_devices() -> None:
    too_often = "packet {} was acknowledged more often than it was sent"
    watch = Watch().transfers(2).sends(Command.END_OF_TRANSFER).wait(9).hears(Ack(2))
    assert watch.wait(9).hears(Ack(2)).evidence == too_often.format(2)
    watch = Watch().transfers(1).sends(Command.END_OF_TRANSFER).wait(9).hears(Ack(1))
    assert watch.evidence == too_often.format(1)


def test_a_packet_is_odd_once_and_only_when_each_copy_has_its_ack() -> None:
    watch = odd(Watch().transfers(0), 1).hears(*[Nak(1)] * 9)
    assert watch.evidence == ""
    watch = Watch().transfers(0)
    for packet in range(1, 6):
        watch.sends(Command.PACKET, packet).hears(Nak(packet), Nak(packet))
        watch.sends(Command.PACKET, packet).hears(Ack(packet))
    assert watch.evidence == "", "a line that spoils frames makes several NAKs of one copy"
    watch = Watch().transfers(0)
    for packet in range(1, 6):
        watch.sends(Command.PACKET, packet).hears(Ack(packet), Ack(packet))
    assert watch.evidence == TOO_OFTEN


def test_unanswered_packets_of_an_earlier_attempt_do_not_hide_a_second_ack() -> None:
    watch = Watch().transfers(0)
    for packet in range(1, 9):
        watch.sends(Command.PACKET, packet)
    watch.transfers(0)
    for packet in (21, 22):
        watch.sends(Command.PACKET, packet).hears(Ack(packet))
    watch.sends(Command.PACKET, 23).wait(4).hears(Ack(22))
    assert watch.evidence == "packet 22 was acknowledged more often than it was sent"


def test_a_new_attempt_forgets_the_naks_but_not_what_was_odd() -> None:
    watch = odd(Watch().transfers(0), 1).sends(Command.UPDATE).hears(RequestTransfer())
    for packet in range(1, 6):
        watch.sends(Command.PACKET, packet).hears(Ack(packet))
    assert watch.evidence == ""
    again = odd(odd(Watch().transfers(0), 1).transfers(0), 1)
    assert again.evidence == TOO_OFTEN, "it is odd in each attempt"
    watch = Watch().transfers(1).hears(Ack(1)).transfers(0)
    assert watch.sends(Command.PACKET, 1).hears(Nak(1)).evidence == "", "a NAK alone"
    watch = Watch().transfers(1)
    for _ in range(3):
        watch.sends(Command.UPDATE).hears(Nak(1), RequestTransfer())
        watch.sends(Command.PACKET, 1).hears(Ack(1))
    assert watch.evidence == "", "a late NAK of the attempt before"
    watch = Watch().transfers(0)
    for packet in (1, 2, 3):
        watch.sends(Command.PACKET, packet).hears(Nak(packet))
    watch.transfers(0)
    for packet in (1, 2, 3):
        for _ in range(2):
            watch.hears(Ack(packet))
            watch.sends(Command.PACKET, packet)
    assert watch.evidence == ""


def test_an_ack_for_a_packet_that_was_never_sent_is_as_good_as_a_nak() -> None:
    watch = Watch().transfers(1)
    for packet in (2, 3, 4):
        watch.sends(Command.PACKET, packet).hears(Ack(packet), Ack(99))
    assert watch.evidence == TOO_OFTEN
    watch = Watch().transfers(1)
    for packet in (2, 3, 4):
        watch.sends(Command.PACKET, packet).hears(Ack(99), Ack(packet))
    assert watch.evidence == TOO_OFTEN


def test_eight_packets_are_remembered_and_those_without_an_ack_longest() -> None:
    """An ACK for one that is forgotten counts as a NAK of the packet in work."""
    watch = Watch().transfers(8).wait(9).hears(Ack(1))
    assert watch.evidence == "packet 1 was acknowledged more often than it was sent"
    watch = Watch().transfers(9).wait(9).hears(Ack(1))
    assert watch.evidence == ""
    watch = Watch().transfers(0).sends(Command.PACKET, 1)
    for packet in range(2, 30):
        watch.sends(Command.PACKET, packet).hears(Ack(packet))
    assert watch.hears(Ack(1)).evidence == "", "late, and not odd"
    assert watch.wait(9).hears(Ack(1)).evidence != ""
    watch = Watch().transfers(0)
    for packet in range(1, 10):
        watch.sends(Command.PACKET, packet)
    watch.hears(*(Ack(packet) for packet in range(2, 10)))
    assert watch.evidence == ""
    watch.wait(9).hears(Ack(8))
    assert watch.evidence == "packet 8 was acknowledged more often than it was sent"


@each(
    "packets, is_odd",
    [
        ("+++++----", False),
        ("+++++-----", True),  # five in a row are no chance
        ("-----++++", False),
        ("-----+++++", True),
        ("++++-----+++", False),
        ("----+++++---", False),
        ("++++-" * 6, False),  # feedbacks that a bad line has lost
        ("+-----+-----", False),
        ("+++++-+-----", True),
    ],
)
def test_feedbacks_that_begin_or_end_in_a_transfer_are_another_devices(
    packets: str, *, is_odd: bool
) -> None:
    """Each packet with an ACK: + also with a general feedback."""
    watch = Watch().sends(Command.RESET).hears(GeneralFeedbackMessage()).transfers(0)
    for number, kind in enumerate(packets, 1):
        watch.sends(Command.PACKET, number)
        watch.hears(*[GeneralFeedbackMessage()] * (kind == "+"), Ack(number))
    mixed = "some packets were confirmed by general feedback, others were not"
    assert watch.evidence == (mixed if is_odd else "")


def test_in_the_transfer_one_feedback_too_many_is_an_odd_answer() -> None:
    watch = Watch().transfers(0)
    watch.sends(Command.PACKET, 1).hears(*[GeneralFeedbackMessage()] * 3)
    assert watch.evidence == "", "one for the update command, one for the packet, and one odd"
    watch.hears(GeneralFeedbackMessage())
    assert watch.evidence == TOO_OFTEN


def test_what_was_seen_first_is_what_is_reported() -> None:
    watch = Watch().sends(Command.RESET).hears(GeneralFeedbackMessage(), GeneralFeedbackMessage())
    assert watch.announces(1).announces(1, boot=BootVersion("BMS", "V9.9.9")).evidence == (
        CONFIRMED_TWICE
    )


def test_rows_of_a_transfer_before_any_update_command_are_somebody_elses() -> None:
    watch = Watch().hears(RequestTransfer(), Ack(1), Nak(1), Ack(1), Complete(), Ack(2))
    assert watch.evidence == ""


def test_a_check_code_that_another_node_asks_for_has_its_answer() -> None:
    code = BY_KEY[0x720, 0x170C]
    watch = Watch()
    for _ in range(2):
        watch.wait(100)
        watch.duplicates.received(Message(0x712, 0x11, 0x3200, b""), watch.now)
        watch.answers(CheckCode(bytes(12)), code)
    assert watch.ambiguous_queries == []
    assert watch.answers(CheckCode(bytes(12)), code).ambiguous_queries == [code]
