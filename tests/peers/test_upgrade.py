"""Both referees agree with each other on the way an upgrade goes."""

from __future__ import annotations

import itertools
import random

import pytest

from tests.loops import each

from .dialogue import IMAGE, TARGETS, assert_upgraded, upgrade
from .scripted_device import ScriptedDevice
from .scripted_host import HostScript, ScriptedHost
from .virtual_wire import FRAME_S, run
from .wording import WORDINGS, Frame, intact, literal


@each("target", TARGETS)
@each("size_bytes", [1, 127, 128, 129])
def test_an_upgrade_of_any_target_succeeds(target: str, size_bytes: int) -> None:
    image = random.Random(size_bytes).randbytes(size_bytes)
    host, device = upgrade(target=target, image=image)
    assert_upgraded(host, device, image)
    assert host.numbers("ack") == list(range(1, -(-size_bytes // 128) + 1))
    assert device.numbers("packet") == host.numbers("ack")


@pytest.mark.slow
def test_the_documents_image_of_78351_bytes_takes_613_packets() -> None:
    image = random.Random(78351).randbytes(78351)
    host, device = upgrade(image=image)
    assert_upgraded(host, device, image)
    assert device.numbers("packet") == list(range(1, 614))
    assert len(host.times("version")) == 1


def test_a_dialogue_has_the_documents_order() -> None:
    host, device = upgrade(image=b"\x01")
    assert [entry.what for entry in host.log] == [
        *("reset", "feedback", "version", "update", "request"),
        *("packet", "ack", "end", "complete", "complete"),
    ]
    assert [entry.what for entry in device.log if entry.kind == "received"] == [
        *("reset", "update", "packet", "end"),
    ]
    assert device.take_events() == device.log
    assert device.take_events() == []


def test_announcements_come_four_times_fifty_milliseconds_apart_then_the_application() -> None:
    host, device = upgrade(host=HostScript(update_on_version=99))
    reported = device.times("version", "sent")
    assert len(reported) == 4
    gaps_s = [later - sooner for sooner, later in itertools.pairwise(reported)]
    assert gaps_s == pytest.approx([0.05] * 3, abs=2 * FRAME_S)
    assert device.state == "application"
    assert host.outcome == "no boot version"


def test_a_device_without_application_keeps_announcing_until_it_is_upgraded() -> None:
    host, device = upgrade(
        host=HostScript(no_reset=True, update_on_version=9), has_application=False
    )
    assert_upgraded(host, device)
    assert len(host.times("version")) == 9


def test_after_power_up_a_device_announces_itself() -> None:
    device = ScriptedDevice("bms")
    device.power_on(0.0)
    host = ScriptedHost("bms", IMAGE, HostScript(no_reset=True))
    run(host, device, linger_s=1.0)
    assert_upgraded(host, device)


def test_a_second_upgrade_to_a_smaller_image_leaves_nothing_of_the_first() -> None:
    device = ScriptedDevice("bms")
    now = run(ScriptedHost("bms", IMAGE), device, linger_s=1.0)
    host = ScriptedHost("bms", b"small")
    run(host, device, start_s=now, linger_s=1.0)
    assert_upgraded(host, device, b"small")


def test_cancelling_ends_a_peer_at_a_message_boundary() -> None:
    device = ScriptedDevice("bms")
    for payload in literal(WORDINGS["bms"].reset):
        device.receive(Frame(0x752, payload), 0.0)
    assert device.next_frame(0.0).data.hex() == "55aa0c0555034143"
    device.frame_sent(0.0)
    device.cancel(0.0)
    done_in_the_midst = device.done
    assert device.next_frame(0.0).data.hex() == "4bb209fc46f0"
    device.frame_sent(0.0)
    assert (done_in_the_midst, device.done) == (False, True)
    assert device.deadline() is None


def test_the_bms_answers_its_version_before_and_after_theupgrade() -> None:
    query = [Frame(0x752, payload) for payload in literal("55AA11023300FDA6 627CF0")]
    device = ScriptedDevice("bms")
    texts = []
    now = 0.0
    for _ in range(2):
        for frame in query:
            device.receive(frame, now)
        reported = b""
        while (frame := device.next_frame(now)) is not None:
            assert frame.can_id == 0x720
            reported += frame.data
            device.frame_sent(now)
        assert intact(0x720, reported)
        texts.append(reported[6 + 48 : 6 + 64])
        now = run(ScriptedHost("bms", IMAGE), device, start_s=now, linger_s=1.0)
    assert texts == [b"V1r2r2_20220401.", b"V1r2r3_20220512."]
