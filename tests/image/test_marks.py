"""Which targets an image names by itself: strong evidence counts, chance does not."""

from __future__ import annotations

import random
from pathlib import Path

from flasher.image.image import NEIGHBOURHOOD_SIZE, Image, named_targets
from flasher.image.load import load
from flasher.protocol.spec import BMS, OBC, TARGETS, WMC, Target
from tests.loops import each

SAMPLES = Path(__file__).parents[2] / "firmware_samples"
VERSION = b"V1r0r4_20220512"


@each("name, target", [("bms.hex", BMS), ("wmc.s19", WMC), ("obc.bin", OBC), ("obc.elf", OBC)])
def test_each_sample_names_its_target(name: str, target: Target) -> None:
    assert load(SAMPLES / name).named_targets == {target}


@each("target", TARGETS.values())
def test_both_names_and_the_update_text_name_a_target(target: Target) -> None:
    for name in (target.node.name, target.boot_name):
        assert named_targets(name.encode() + b"\0" + VERSION) == {target}
    assert named_targets(b"\x01" + target.update_text.encode() + b"\0") == {target}


@each(
    "data",
    [
        b"BMS\0" + VERSION,
        VERSION + b" for BMS",
        VERSION + b"BMS",  # a packed structure
        b"BMS" + VERSION,
        b"(BMS)" + bytes(NEIGHBOURHOOD_SIZE - 4) + VERSION,
        VERSION + bytes(NEIGHBOURHOOD_SIZE - 3) + b"BMS",
    ],
)
def test_a_name_before_or_after_a_version_counts(data: bytes) -> None:
    assert named_targets(data) == {BMS}


@each(
    "data",
    [
        b"",
        VERSION,
        b"BMS\0V1.0.0\0",  # no firmware version
        b"BMSX\0" + VERSION,
        b"XBMS\0" + VERSION,
        b"BMS_APP\0" + VERSION,
        b"7BMS\0" + VERSION,
        b"bms\0" + VERSION,
        b"BMS" + bytes(NEIGHBOURHOOD_SIZE - 2) + VERSION,
        VERSION + bytes(NEIGHBOURHOOD_SIZE - 2) + b"BMS",
        VERSION + bytes(NEIGHBOURHOOD_SIZE - 3) + b"BMSX",
        b"ABMS_UPD\0",
        b"BMS_UPDATE\0",
        b"bms_upd",
        b"HMI\0" + VERSION,
    ],
)
def test_anything_weaker_does_not_count(data: bytes) -> None:
    assert named_targets(data) == frozenset()


def test_an_image_with_texts_of_several_devices_names_them_all() -> None:
    both = b"WMC\0" + VERSION + bytes(200) + b"PBU\0V1r2r0_20221103\0"
    assert named_targets(both) == {WMC, OBC}
    assert named_targets(b"BMS\0" + VERSION + bytes(200) + b"\0WMC_UPD\0") == {BMS, WMC}


@each("distance, counts", [(61, True), (62, False)])
def test_the_last_byte_that_belongs_to_a_version(distance: int, *, counts: bool) -> None:
    assert bool(named_targets(VERSION + bytes(distance) + b"BMS")) is counts
    assert not named_targets(VERSION + bytes(60) + b"BMSX")
    assert not named_targets(VERSION + bytes(61) + b"BMSX")
    assert named_targets(bytes(3) + b"BMS" + bytes(50) + VERSION) == {BMS}


def test_random_code_names_nothing() -> None:
    code = random.Random(1).randbytes(1 << 20)
    assert named_targets(code) == frozenset()


def test_an_image_of_bytes_at_hand_knows_its_marks_too() -> None:
    assert Image.from_bytes(b"WMC\0" + VERSION).named_targets == {WMC}
