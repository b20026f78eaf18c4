"""Error frames, typed by hand from Linux's error.h and PCAN-Basic's table, and their sum."""

from __future__ import annotations

from flasher.bus.health import (
    LAYOUTS,
    BusTrouble,
    ControllerState,
    HealthKeeper,
    Layout,
    TroubleKind,
    decode_error_frame,
)
from flasher.errors import ExitCode
from flasher.protocol.frame import Frame
from flasher.wording import wording
from tests.loops import each

ORDINARY = Frame(0x725, b"\x01")


def error_frame(can_id: int, data: str = "00 00 00 00 00 00 00 00") -> Frame:
    return Frame(can_id, bytes.fromhex(data), is_error=True)


def linux(can_id: int, data: str = "00 00 00 00 00 00 00 00") -> BusTrouble:
    return decode_error_frame(error_frame(can_id, data))


LINUX = [
    (0x040, "00 00 00 00 00 00 00 00", TroubleKind.BUS_OFF, "bus-off"),
    (0x100, "00 00 00 00 00 00 00 00", TroubleKind.RESTARTED, "restarted"),
    (0x020, "00 00 00 00 00 00 00 00", TroubleKind.NOT_ACKNOWLEDGED, "no acknowledgement"),
    # Bus error on transmission, in the acknowledge slot.
    (0x088, "00 00 80 19 00 00 00 00", TroubleKind.NOT_ACKNOWLEDGED, "no acknowledgement"),
    (0x204, "00 20 00 00 00 00 80 00", TroubleKind.PASSIVE, "error-passive by sending"),
    (0x204, "00 10 00 00 00 00 00 80", TroubleKind.PASSIVE, "error-passive by receiving"),
    (0x204, "00 08 00 00 00 00 60 00", TroubleKind.WARNING, "error-warning by sending"),
    (0x204, "00 40 00 00 00 00 5F 00", TroubleKind.OTHER, "error-active again"),
    (0x002, "05 00 00 00 00 00 00 00", TroubleKind.OTHER, "arbitration lost"),
    (0x088, "00 00 04 00 00 00 00 00", TroubleKind.OTHER, "stuff error"),
    (0x008, "00 00 02 18 00 00 00 00", TroubleKind.OTHER, "form error"),
    (0x010, "00 00 00 00 07 00 00 00", TroubleKind.OTHER, "transceiver"),
    (0x001, "00 00 00 00 00 00 00 00", TroubleKind.OTHER, "timed out"),
    (0x004, "00 01 00 00 00 00 00 00", TroubleKind.OTHER, "receive buffer overflow"),
    # Bus-off is worse than what led to it.
    (0x244, "00 20 00 00 00 00 FF 00", TroubleKind.BUS_OFF, "bus-off"),
]


@each("can_id, data, kind, words", LINUX)
def test_linux_error_frames(can_id: int, data: str, kind: TroubleKind, words: str) -> None:
    trouble = linux(can_id, data)
    assert trouble.kind is kind
    assert words in trouble.words


def test_error_counters_are_reported_only_when_the_frame_has_them() -> None:
    assert (linux(0x204, "00 20 00 00 00 00 80 07").tx_errors) == 0x80
    assert (linux(0x204, "00 20 00 00 00 00 80 07").rx_errors) == 7
    # An older kernel fills them without the class bit.
    assert linux(0x004, "00 20 00 00 00 00 88 00").tx_errors == 0x88
    assert linux(0x040).tx_errors is None


PCAN = [
    (8, "00 19 00 08", TroubleKind.NOT_ACKNOWLEDGED, "no acknowledgement"),
    (4, "01 0A 09 00", TroubleKind.OTHER, "stuff error"),
    (1, "00 0A 00 80", TroubleKind.PASSIVE, "error-passive by sending"),
    (4, "01 0A 87 00", TroubleKind.PASSIVE, "error-passive by receiving"),
    (0, "00 00 00 60", TroubleKind.WARNING, "error-warning"),
    (0, "00 00 00 00", TroubleKind.OTHER, "error counters"),
]


@each("can_id, data, kind, words", PCAN)
def test_pcan_error_frames(can_id: int, data: str, kind: TroubleKind, words: str) -> None:
    trouble = decode_error_frame(error_frame(can_id, data), Layout.PCAN)
    assert trouble.kind is kind
    assert words in trouble.words
    counters = bytes.fromhex(data)
    assert (trouble.rx_errors, trouble.tx_errors) == (counters[2], counters[3])


@each("layout", list(Layout))
@each("data", ["", "FF", "FF FF FF FF FF FF FF FF"])
def test_odd_error_frames_are_no_error_of_ours(layout: Layout, data: str) -> None:
    """socketcand sends one byte, a vendor's firmware what it likes."""
    for can_id in (0, 0x7FF):
        assert decode_error_frame(error_frame(can_id, data), layout).words


def test_a_back_end_without_a_documented_layout_is_not_guessed_at() -> None:
    assert "kvaser" not in LAYOUTS
    trouble = decode_error_frame(error_frame(0x040), Layout.UNKNOWN)
    assert trouble.kind is TroubleKind.OTHER


# -- what they add up to --------------------------------------------------------------------------


def keeper(*frames: Frame, sent: int = 0) -> HealthKeeper:
    kept = HealthKeeper(Layout.SOCKETCAN)
    kept.sent = sent
    for frame in frames:
        kept.count_frame(frame)
    return kept


PASSIVE = error_frame(0x204, "00 20 00 00 00 00 80 00")
NO_ACK = error_frame(0x0A8, "00 00 80 19 00 00 00 00")
BUS_OFF = error_frame(0x040)


@each("evidence", [PASSIVE, NO_ACK])
def test_frames_sent_and_nothing_received_but_that_evidence_is_no_acknowledgement(
    evidence: Frame,
) -> None:
    health = keeper(evidence, sent=2).health()
    assert health.not_acknowledged
    error = health.error("socketcan can0")
    assert error is not None
    assert error.exit_code == ExitCode.BUS
    assert "No node on the bus acknowledges: 2 frames" in error.what
    assert "the adapter reports" in error.cause
    assert error.where == "socketcan can0"


def test_a_queue_that_stays_full_is_evidence_too() -> None:
    kept = keeper(sent=10)
    kept.is_blocked = True
    error = kept.health().error()
    assert error is not None
    assert "queue stays full" in error.cause


def test_silence_alone_proves_nothing() -> None:
    """A device that is off, on an adapter that reports nothing, or on vcan."""
    health = keeper(sent=2).health()
    assert not health.not_acknowledged
    assert health.error() is None
    assert health.state is ControllerState.UNKNOWN


def test_whoever_received_a_frame_has_somebody_on_the_bus() -> None:
    assert not keeper(ORDINARY, PASSIVE, sent=2).health().not_acknowledged


def test_an_error_frame_is_not_received_traffic() -> None:
    health = keeper(PASSIVE, PASSIVE, ORDINARY).health()
    assert (health.frames_received, health.error_frames) == (1, 2)


def test_the_state_follows_the_error_frames() -> None:
    kept = keeper()
    states = []
    restarted = error_frame(0x100)
    active_again = error_frame(0x204, "00 40 00 00 00 00 00 00")
    for frame in (PASSIVE, BUS_OFF, restarted, PASSIVE, active_again):
        kept.count_frame(frame)
        states.append(wording(kept.state))
    assert states == [
        "error-passive", "bus-off", "error-active", "error-passive", "error-active"
    ]  # fmt: skip


def test_bus_off_is_a_failure_whatever_was_sent() -> None:
    error = keeper(BUS_OFF).health().error("here")
    assert error is not None
    assert error.where == "here"
    assert "bus-off" in error.cause


def test_what_the_adapter_reports_itself_counts_more_than_error_frames() -> None:
    health = keeper(PASSIVE).health(ControllerState.BUS_OFF, 248, 3)
    assert health.state is ControllerState.BUS_OFF
    assert (health.tx_errors, health.rx_errors) == (248, 3)


def test_counters_of_the_last_error_frame_are_kept() -> None:
    health = keeper(PASSIVE, BUS_OFF).health()
    assert (health.tx_errors, health.rx_errors) == (0x80, 0)


def test_reset_forgets_everything() -> None:
    kept = keeper(BUS_OFF, ORDINARY, sent=3)
    kept.reset()
    assert kept.health() == HealthKeeper(Layout.SOCKETCAN).health()
