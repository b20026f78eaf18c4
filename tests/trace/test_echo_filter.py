"""Echoes of an adapter: a trace has a sent frame once."""

from __future__ import annotations

from flasher.bus.echoes import Echoes
from flasher.protocol.frame import Frame
from flasher.trace.taps import EchoFilter, FlightRecorder

OWN = Frame(0x752, b"\x01")
ANSWER = Frame(0x725, b"\x02")


def recorded(*frames: tuple[float, bool, Frame]) -> list[tuple[float, bool, Frame]]:
    flight, link = FlightRecorder(), Echoes()
    tap = EchoFilter(lambda: [flight])
    for now, sent, frame in frames:
        if sent:
            link.sent(frame)
        tap(frame if sent else link.mark(frame, now, is_rx=True), sent=sent, now=now)
    return [(entry.at_s, entry.sent, entry.frame) for entry in flight]


def test_an_echo_is_left_out_and_everything_else_stays() -> None:
    sent, answer = (1.0, True, OWN), (1.2, False, ANSWER)
    assert recorded(sent, (1.1, False, OWN), answer) == [sent, answer]


def test_each_sent_frame_has_one_echo_a_further_copy_is_somebody_elses() -> None:
    sent, copy = (1.0, True, OWN), (1.3, False, OWN)
    assert recorded(sent, (1.1, False, OWN), copy) == [sent, copy]
    twice = [sent, (1.05, True, OWN)]
    assert recorded(*twice, (1.1, False, OWN), (1.2, False, OWN)) == twice


def test_what_was_never_sent_is_no_echo() -> None:
    early = (0.5, False, OWN)
    assert recorded(early) == [early]
    other = (1.1, False, Frame(0x752, b"\x03"))
    assert recorded((1.0, True, OWN), other) == [(1.0, True, OWN), other]
