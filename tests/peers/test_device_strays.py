"""The scripted device strays exactly as set, and a plain host gets through or names it."""

from __future__ import annotations

import pytest

from tests.loops import each

from .dialogue import IMAGE, assert_upgraded, upgrade
from .scripted_device import DeviceScript, ScriptedDevice
from .scripted_host import HostScript, Limits, ScriptedHost
from .virtual_wire import run
from .wording import WORDINGS, Frame, literal


@each(
    "script",
    [
        DeviceScript(no_feedback=True),
        DeviceScript(versions_lost=frozenset({1, 2, 3})),
        DeviceScript(bad_version_text=b"\x1b[2J\r\n"),
        DeviceScript(wrong_name=True),
        DeviceScript(request_twice=True),
        DeviceScript(leftover_version=True),
        DeviceScript(drop_ack=frozenset({5})),
        DeviceScript(drop_ack=frozenset(range(1, 11))),
        DeviceScript(nak={7: 2, 1: 4}),
        DeviceScript(late_ack={4: 0.2}),
        DeviceScript(stale_ack=frozenset({3, 10})),
        DeviceScript(future_ack=frozenset({3})),
        DeviceScript(complete_at=4),
        DeviceScript(end_nak=1),
        DeviceScript(foreign_frames=True),
    ],
)
def test_a_stray_that_the_documents_allow_for_is_overcome(script: DeviceScript) -> None:
    host, device = upgrade(script)
    assert_upgraded(host, device)


@each(
    "script, outcome",
    [
        (DeviceScript(deaf_to_reset=True), "no boot version"),
        (DeviceScript(versions_lost=frozenset({1, 2, 3, 4})), "no boot version"),
        (DeviceScript(no_request=True), "no request transfer"),
        (DeviceScript(deaf_to_updates=1), "no request transfer"),
        (DeviceScript(silent_after=0), "no answer to packet 1"),
        (DeviceScript(silent_after=6), "no answer to packet 7"),
        (DeviceScript(nak={7: 5}), "no answer to packet 7"),
        (DeviceScript(restart_at=5), "no answer to packet 5"),
        (DeviceScript(end_nak=2), "refused"),
        (DeviceScript(lose_complete=3), "no complete"),
    ],
)
def test_a_stray_that_cannot_be_overcome_is_named(script: DeviceScript, outcome: str) -> None:
    host, _ = upgrade(script)
    assert host.outcome == outcome


def test_lost_versions_are_just_these() -> None:
    host, device = upgrade(
        DeviceScript(versions_lost=frozenset({1, 3})), HostScript(update_on_version=2)
    )
    assert_upgraded(host, device)
    assert host.times("version") == pytest.approx([0.083, 0.183], abs=0.005)


def test_a_version_that_changes_within_a_burst_counts_as_another_one() -> None:
    host, device = upgrade(DeviceScript(version_changes=True), HostScript(update_on_version=2))
    assert_upgraded(host, device)
    assert len(device.times("version", "sent")) == 2


def test_acks_are_dropped_doubled_and_late_where_set() -> None:
    host, device = upgrade(
        DeviceScript(
            drop_ack=frozenset({2}),
            double_ack=frozenset({10}),
            stale_ack=frozenset({4}),
            future_ack=frozenset({6}),
            late_ack={8: 0.25},
        )
    )
    assert_upgraded(host, device)
    assert host.numbers("ack") == [1, 2, 3, 3, 4, 5, 7, 6, 7, 8, 9, 10, 10]
    assert device.numbers("packet") == [1, 2, 2, 3, 4, 5, 6, 7, 8, 9, 10]
    packet_8, packet_9 = device.times("packet")[8:10]
    assert packet_9 - packet_8 == pytest.approx(0.25, abs=0.02)


def test_an_answer_can_be_ack_and_nak_for_one_packet() -> None:
    host, device = upgrade(DeviceScript(nak_then_ack=frozenset({2}), ack_then_nak=frozenset({10})))
    assert device.image == IMAGE
    assert device.numbers("nak", "sent") == [2, 10]
    assert host.numbers("nak")[0] == 2


def test_a_repeated_packet_may_be_answered_with_the_next_ones_nak() -> None:
    script = DeviceScript(nak_next_on_repeat=True)
    host, device = upgrade(script, HostScript(repeat=frozenset({3})))
    assert_upgraded(host, device)
    assert host.asides == {"repeat 3": [("nak", 4)]}


def test_a_device_that_restarts_has_no_application_and_announces_for_ever() -> None:
    host, device = upgrade(DeviceScript(restart_at=5))
    assert device.state == "announcing"
    assert len(host.times("version")) > 20
    assert not device.completed


def test_request_in_the_midst_is_reported_once_and_nothing_is_stored_twice() -> None:
    host, device = upgrade(DeviceScript(request_at=4))
    assert_upgraded(host, device)
    assert len(host.times("request")) == 2
    assert device.numbers("packet").count(4) == 2


def test_a_lost_final_answer_is_given_again_while_the_bootloader_is_there() -> None:
    host, device = upgrade(DeviceScript(lose_complete=1), start_s=60.0)
    assert host.outcome == "complete"
    assert len(device.times("end")) == 2


def test_announcements_after_the_final_answer_come_as_often_as_set() -> None:
    host, device = upgrade(DeviceScript(lose_complete=9, announce_after_complete=6))
    assert host.outcome == "no complete"
    assert len(host.times("version")) == 1 + 6
    assert device.updates_taken == 1
    assert device.state == "application"


def test_an_update_command_while_the_new_application_starts_would_erase_it() -> None:
    device = ScriptedDevice("bms", DeviceScript(lose_complete=1), start_s=60.0)
    now = run(ScriptedHost("bms", IMAGE, limits=Limits(end_tries=1)), device)
    for payload in literal(WORDINGS["bms"].update_128):
        device.receive(Frame(0x752, payload), now)
    assert device.updates_taken == 2
    assert not device.completed


def test_an_image_that_fails_its_check_is_refused_at_the_end() -> None:
    host, device = upgrade(image_check=lambda image: image[:1] != IMAGE[:1])
    assert host.outcome == "refused"
    assert not device.completed


def test_foreign_frames_are_of_every_kind_and_never_payload_of_the_dialogue() -> None:
    seen: list[Frame] = []
    device = ScriptedDevice("wmc", DeviceScript(foreign_frames=True))
    host = ScriptedHost("wmc", b"\x01")

    def watch(frame: Frame) -> bool:
        seen.append(frame)
        return True

    run(host, device, linger_s=1.0, passes=watch)
    assert_upgraded(host, device, b"\x01")
    assert {0x720, 0x712} <= {frame.can_id for frame in seen}
    assert any(frame.is_extended for frame in seen)
    assert any(frame.is_remote for frame in seen)
    assert any(frame.is_error for frame in seen)
    assert [frame for frame in seen if not frame.is_payload]
