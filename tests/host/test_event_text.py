"""The lines and warnings that people read of an upgrade, and from which verbosity on."""

from __future__ import annotations

from flasher import events
from flasher.events import Phase
from flasher.host.event_text import progress_line, reason_text, warning_text
from tests.loops import each

LINES: list[tuple[object, int, str]] = [
    (events.PhaseEntered(Phase.TRANSFER, 2), 0, "transferring ..."),
    (
        events.AttemptStarted(2, "restarted"),
        0,
        "the device restarted: beginning again, attempt 2",
    ),
    (
        events.AttemptStarted(3, "link_back", 179.4),
        0,
        "the adapter was away for a while: beginning again, attempt 3 (179 s left)",
    ),
    (
        events.AttemptStarted(3, "link_back", 180.0),
        0,
        "the adapter was away for a while: beginning again, attempt 3 (3 min left)",
    ),
    (
        events.UpgradeLeftOpen("2026-05-17T08:30:00", "bms.hex", has_end=False),
        0,
        (
            "the upgrade of 2026-05-17 08:30:00 with bms.hex has no end: the device gets an update "
            "command if it stays silent"
        ),
    ),
    (
        events.UpgradeLeftOpen("2026-05-17T08:30:00", "bms.hex", has_end=True),
        0,
        (
            "the upgrade of 2026-05-17 08:30:00 with bms.hex left the device without an "
            "application: the device gets an update command if it stays silent"
        ),
    ),
    (events.BootVersionSeen("BMS", "V1.2.3"), 0, "boot version: BMS V1.2.3"),
    (events.CheckMade("hardware", "passed", "it fits"), 1, "check: passed: it fits"),
    (events.CheckMade("hardware", "unknown", "who knows"), 0, "check: unknown: who knows"),
    (events.AdapterBack(), 0, "the adapter is back"),
    (events.HostStalled(2.04), 1, "this computer paused for 2.0 s"),
    (events.Reported("leftover"), 1, "note: leftover"),
    (
        events.BytesDamaged(0x25, "bad_crc", bytes(range(30))),
        2,
        "bytes on 0x025 ignored: wrong CRC: " + bytes(range(24)).hex(" "),
    ),
]


@each("event, verbosity, line", LINES)
def test_an_event_has_a_line_from_its_verbosity_on(
    event: object, verbosity: int, line: str
) -> None:
    assert progress_line(event) == (line, verbosity)


@each("tries, verbosity", [(2, 1), (9, 1), (10, 0), (11, 1), (20, 0)])
def test_every_tenth_try_of_a_message_is_seen_by_everybody(tries: int, verbosity: int) -> None:
    again = "the device did not answer packet 7 in time: sending packet 7 again"
    event = events.MessageRepeated("packet 7", "packet_unanswered", tries)
    assert progress_line(event) == (f"{again}, try {tries}", verbosity)


@each("event", [events.PacketAcknowledged(1, 2, 1), events.MemoryRead(1, 2), object()])
def test_an_event_that_other_means_show_has_no_line(event: object) -> None:
    assert progress_line(event) is None


@each(
    "event, words",
    [
        (events.ShutdownHeard("BMS"), "the BMS sent the command SHUTDOWN: it switches off"),
        (
            events.ForeignQuery("read history"),
            "another tool asks the device (read history); the upgrade goes on. End that tool.",
        ),
        (
            events.AdapterLost("The adapter failed: unplugged.", 5.0),
            "The adapter failed: unplugged. Waiting 5 s for the adapter ...",
        ),
        (
            events.BusBlocked("No node acknowledges.", 240.0),
            "No node acknowledges. Trying on for 4 min: check power and contacts of the device.",
        ),
        (
            events.SecondToolAwaited("a reset", 2.0),
            (
                "another tool writes to the device (a reset). It has no application any more: "
                "beginning again when the other tool has been silent for 2 s."
            ),
        ),
        (events.CheckMade("low-charge", "warned", "charge it"), "charge it"),
        (events.CheckMade("hardware", "waived", "other hardware"), "other hardware"),
        (events.CheckMade("hardware", "passed", "it fits"), ""),
        (events.AdapterBack(), ""),
    ],
)
def test_what_no_one_should_miss_is_a_warning(event: object, words: str) -> None:
    assert warning_text(event) == words


def test_a_reason_names_what_is_sent_again() -> None:
    assert reason_text("end_refused", "end of transfer") == "the device refused the end of transfer"
