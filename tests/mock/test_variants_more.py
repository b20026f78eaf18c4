"""As `test_variants`, for the variants that came later: those of `more_tx` and `more_en`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest

from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.variants import VARIANTS, make, more_en, more_tx
from flasher.protocol.spec import BMS, WELLING
from tests.mock import test_variants as first
from tests.mock.bench import image_of
from tests.mock.test_variants import (
    FIRST,
    IMAGE,
    OTHER,
    SECOND,
    Act,
    answers_in_transfer,
    damaged,
)
from tests.mock.tool import Tool, packet_wire
from tests.peers.wording import READ, WRITE, build

MORE = [variant.name for module in (more_tx, more_en) for variant in module.VARIANTS]
ACTS: dict[str, tuple[Act, object, object]] = {}
PROFILE = DeviceProfile(application_area_bytes=128 * 1024)
END = build(0x752, WRITE, 0xA401, b"\x04")
UNKNOWN = build(0x752, READ, 0x6F00, b"")
BEYOND_64K = image_of(64 * 1024 + 200)


def does(variant: str, *, right: object, wrong: object) -> Callable[[Act], Act]:
    def keep(act: Act) -> Act:
        ACTS[variant] = (act, right, wrong)
        return act

    return keep


does("repeat-unanswered", right=["ack 2"], wrong=[])(answers_in_transfer(SECOND, stored=2))
does("total-looked-at-once", right=["nak 2"], wrong=["ack 2"])(
    answers_in_transfer(packet_wire(2, IMAGE, total=6), stored=1)
)
does("believes-second-early-end", right=["nak 2", "nak 2"], wrong=["nak 2", "complete"])(
    answers_in_transfer(END, END, stored=1)
)


@does("damage-ends-transfer", right=["ack 1"], wrong=[])
def a_packet_after_a_damaged_one(tool: Tool) -> object:
    tool.transfer(IMAGE)
    for wire in (damaged(FIRST), FIRST):
        tool.put_wire(wire)
        tool.run(0.01)
    return tool.heard("ack")


@does("older-overwrites", right=(["ack 1"], True), wrong=(["ack 1"], False))
def an_older_packet_with_other_data(tool: Tool) -> object:
    tool.transfer(IMAGE, 2)
    tool.packet(1, OTHER)
    return tool.heard(), tool.device.readback(128) == IMAGE[:128]


@does("sixteen-bit-offsets", right=True, wrong=False)
def an_image_beyond_64_kib(tool: Tool) -> object:
    tool.transfer(BEYOND_64K)
    tool.run(0.2)
    for number in range(1, 514):
        tool.packet(number, BEYOND_64K)
    return tool.device.readback(128) == BEYOND_64K[:128]


@does("runs-new-application-once", right=["720 1540"], wrong=[])
def a_restart_after_an_upgrade(tool: Tool) -> object:
    tool.upgrade(IMAGE)
    tool.reset()
    tool.run(1.0)
    return tool.asks_version()


@does("second-end-refused", right=["complete"], wrong=["nak 5"])
def the_end_of_transfer_again(tool: Tool) -> object:
    tool.transfer(IMAGE, 5)
    tool.end()
    tool.heard()
    tool.end()
    return tool.heard()


@does("refusal-is-final", right=1, wrong=0)
def an_update_command_after_a_refused_image(tool: Tool) -> object:
    assert tool.upgrade(IMAGE) == ["nak 5"]
    tool.run(2.0)
    tool.update(600)
    tool.run(0.03)
    return len(tool.heard("request"))


@does("size-rounds-to-small", right=0, wrong=1)
def a_size_of_nearly_2_to_the_32(tool: Tool) -> object:
    tool.boot()
    tool.update(0xFFFF_FFFF)
    tool.run(0.03)
    return len(tool.heard("request"))


@does("any-message-is-life", right=True, wrong=False)
def useless_messages_in_a_pause(tool: Tool) -> object:
    tool.transfer(IMAGE, 1)
    for _ in range(10):
        tool.put_wire(UNKNOWN)
        tool.run(0.6)
    return bool(tool.heard("version"))


@pytest.mark.parametrize("name", MORE)
def test_a_variant_does_wrong_what_the_right_device_does_right(name: str) -> None:
    act, right, wrong = ACTS[name]
    variant = VARIANTS[name]
    chosen = dataclasses.replace(PROFILE, **variant.profile)  # type: ignore[arg-type]
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=chosen)
    assert act(Tool(device)) == right
    assert act(Tool(make(name, BMS, bitrate_bps=WELLING.bitrate_bps, profile=PROFILE))) == wrong


def test_every_variant_is_shown_to_be_wrong() -> None:
    assert set(VARIANTS) - set(MORE) <= set(first.ACTS)
    assert set(ACTS) == set(MORE)
