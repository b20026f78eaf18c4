"""Whether an image belongs into a device: every finding, with its verdict."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from flasher.host.identity import (
    WAIVABLE,
    Check,
    CheckResult,
    CheckVerdict,
    DeviceAnswers,
    Identity,
    judge_device,
    judge_image,
)
from flasher.host.table import Ending
from flasher.image.image import Image
from flasher.image.release import Release
from flasher.protocol.contents import RunningInformation, Status, VersionInformation
from flasher.protocol.fields import Text
from flasher.protocol.spec import BMS, OBC, WMC
from flasher.protocol.text import encode_text
from flasher.settings.manifest import release_of
from tests.firmware import VECTORS
from tests.loops import each

NEW, OLD = "V2r0r1_20260102", "V1r0r0_20220512"
IMAGE = replace(Image.from_bytes(VECTORS + bytes(64) + NEW.encode()), version=NEW)
NAMELESS = Image.from_bytes(VECTORS + bytes(64))
BATTERY = RunningInformation(40_000, -8, 8000, 9800, 22, 85, Status(0), 98, bytes(4))


def release(**stated: object) -> Release:
    return replace(release_of(IMAGE, BMS), **stated)  # type: ignore[arg-type]


def seen(firmware: str = OLD, hardware: str = "V1r2r0_20220512") -> DeviceAnswers:
    texts = ("BM36", "W1", hardware, firmware)
    return DeviceAnswers(VersionInformation(*(Text(encode_text(text, 16)) for text in texts)))


def verdicts(findings: Iterable[CheckResult]) -> list[tuple[Check, CheckVerdict]]:
    return [(found.check, found.verdict) for found in findings]


@each(
    "image, stated, verdict",
    [
        (NAMELESS, None, CheckVerdict.UNKNOWN),
        (IMAGE, {}, CheckVerdict.PASSED),
        (IMAGE, {"target": WMC}, CheckVerdict.REFUSED),
        (Image.from_bytes(VECTORS + b"\0BMS_UPD\0"), None, CheckVerdict.PASSED),
        (Image.from_bytes(VECTORS + b"\0OBC_UPD\0"), None, CheckVerdict.REFUSED),
        (Image.from_bytes(VECTORS + b"\0OBC_UPD\0"), {}, CheckVerdict.REFUSED),
        (Image.from_bytes(VECTORS + b"\0OBC_UPD\0BMS_UPD\0"), None, CheckVerdict.PASSED),
    ],
)
def test_the_target_of_an_image(
    image: Image, stated: dict[str, object] | None, verdict: CheckVerdict
) -> None:
    identity = Identity(None if stated is None else release(**stated))
    assert verdicts(judge_image(image, BMS, identity)) == [(Check.TARGET, verdict)]


HARDWARE, DOWNGRADE, SAME, PREVIOUS = (
    Check.HARDWARE, Check.DOWNGRADE, Check.SAME_VERSION, Check.PREVIOUS,
)  # fmt: skip
PASSED, UNKNOWN, REFUSED, WARNED = (
    CheckVerdict.PASSED, CheckVerdict.UNKNOWN, CheckVerdict.REFUSED, CheckVerdict.WARNED,
)  # fmt: skip


@each(
    "stated, device, expected",
    [
        (None, DeviceAnswers(), {HARDWARE: UNKNOWN}),
        (None, seen(), {HARDWARE: UNKNOWN, DOWNGRADE: PASSED}),
        (None, seen(NEW), {HARDWARE: UNKNOWN, SAME: WARNED}),
        (None, seen("V3r0r0_20260301"), {HARDWARE: UNKNOWN, DOWNGRADE: REFUSED}),
        (None, seen("V2r0r1_20260103"), {HARDWARE: UNKNOWN, DOWNGRADE: REFUSED}),
        (None, seen("by hand"), {HARDWARE: UNKNOWN, DOWNGRADE: UNKNOWN}),
        ({"hardware_versions": ("V1r2r0_*",)}, seen(), {HARDWARE: PASSED, DOWNGRADE: PASSED}),
        ({"hardware_versions": ("V1r3*", "V2*")}, seen(), {HARDWARE: REFUSED, DOWNGRADE: PASSED}),
        ({"hardware_versions": ("V1*",)}, seen(hardware=""), {HARDWARE: REFUSED,
                                                             DOWNGRADE: PASSED}),
        ({"previous_from": OLD}, seen(),
         {HARDWARE: UNKNOWN, PREVIOUS: PASSED, DOWNGRADE: PASSED}),
        ({"previous_from": "V1r0r1_20230101"}, seen(),
         {HARDWARE: UNKNOWN, PREVIOUS: REFUSED, DOWNGRADE: PASSED}),
        ({"previous_from": OLD}, seen("by hand"),
         {HARDWARE: UNKNOWN, PREVIOUS: REFUSED, DOWNGRADE: UNKNOWN}),
        ({"previous_except": (OLD,)}, seen(),
         {HARDWARE: UNKNOWN, PREVIOUS: REFUSED, DOWNGRADE: PASSED}),
    ],
)  # fmt: skip
def test_what_the_device_says_of_the_image(
    stated: dict[str, object] | None, device: DeviceAnswers, expected: dict[Check, CheckVerdict]
) -> None:
    identity = Identity(None if stated is None else release(**stated))
    assert dict(verdicts(judge_device(IMAGE, BMS, identity, device))) == expected


def test_a_device_that_tells_no_version_cannot_be_compared_and_that_is_said() -> None:
    found = list(judge_device(IMAGE, OBC, Identity(), DeviceAnswers()))
    assert len(found) == 1
    assert "the OBC's application does not tell its versions" in found[0].text


@each(
    "change, expected",
    [
        ({}, {}),
        ({"mean_current_ma": -1000}, {}),
        ({"mean_current_ma": -1001}, {Check.IN_USE: REFUSED}),
        ({"mean_current_ma": 3000}, {}),  # it is charged
        ({"state_of_charge_percent": 20}, {}),
        ({"state_of_charge_percent": 19}, {Check.CHARGE: WARNED}),
        ({"mean_current_ma": -5000, "state_of_charge_percent": 5},
         {Check.IN_USE: REFUSED, Check.CHARGE: WARNED}),
    ],
)  # fmt: skip
def test_the_state_of_the_battery(
    change: dict[str, int], expected: dict[Check, CheckVerdict]
) -> None:
    device = replace(seen(), running=replace(BATTERY, **change))  # type: ignore[arg-type]
    found = dict(verdicts(judge_device(IMAGE, BMS, Identity(), device)))
    assert {check: found[check] for check in (Check.IN_USE, Check.CHARGE) if check in found} == (
        expected
    )


def test_a_waived_check_is_told_and_ends_nothing() -> None:
    refused = Identity().refusal(Check.DOWNGRADE, "older")
    waived = Identity(waived=frozenset({Check.DOWNGRADE})).refusal(Check.DOWNGRADE, "older")
    assert refused.ending is Ending.NOT_FOR_DEVICE
    assert "--allow-downgrade waives this" in refused.detail
    assert waived.ending is None
    assert waived.event.verdict == "waived"


def test_each_check_that_refuses_can_be_waived_and_no_other() -> None:
    assert {Check.SAME_VERSION, Check.CHARGE}.isdisjoint(WAIVABLE)
    assert set(WAIVABLE) == set(Check) - {Check.SAME_VERSION, Check.CHARGE}


def test_the_same_version_is_skipped_on_request_only() -> None:
    found = dict(verdicts(judge_device(IMAGE, BMS, Identity(skip_same_version=True), seen(NEW))))
    assert found[Check.SAME_VERSION] is CheckVerdict.SKIPPED


def test_what_a_device_tells_is_shown_escaped() -> None:
    texts = (
        b"BM36.".ljust(16),
        b"W1.".ljust(16),
        b"\x1b[31mred\x07.".ljust(16),
        b"V\x1b[2J.".ljust(16),
    )
    device = DeviceAnswers(VersionInformation(*map(Text, texts)))
    said = [
        found.text
        for found in judge_device(IMAGE, BMS, Identity(release(hardware_versions=("V1*",))), device)
    ]
    assert said
    assert not any("\x1b" in text or "\x07" in text for text in said)
