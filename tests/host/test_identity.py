"""Whether an image belongs into a device: every finding, with its verdict."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from flasher.events import CheckMade
from flasher.host.identity import (
    WAIVABLE,
    CheckResult,
    CheckVerdict,
    DeviceAnswers,
    Identity,
    IdentityCheck,
    judge_device,
    judge_image,
    new_version,
)
from flasher.host.table import Ending
from flasher.image.image import Image
from flasher.image.plausible import Cpu
from flasher.image.release import Release
from flasher.protocol.contents import BatteryStatus, RunningInformation, VersionInformation
from flasher.protocol.fields import WireText
from flasher.protocol.spec import BMS, OBC, WMC
from flasher.protocol.text import encode_text
from flasher.settings.manifest import release_of
from tests.firmware import VECTORS
from tests.loops import each

NEW, OLD = "V2r0r1_20260102", "V1r0r0_20220512"
IMAGE = replace(Image.from_bytes(VECTORS + bytes(64) + NEW.encode()), version=NEW)
NAMELESS = Image.from_bytes(VECTORS + bytes(64))
BATTERY = RunningInformation(40_000, -8, 8000, 9800, 22, 85, BatteryStatus(0), 98, bytes(4))


def release(**stated: object) -> Release:
    return replace(release_of(IMAGE, BMS), **stated)  # type: ignore[arg-type]


def seen(firmware: str = OLD, hardware: str = "V1r2r0_20220512") -> DeviceAnswers:
    texts = ("BM36", "W1", hardware, firmware)
    return DeviceAnswers(VersionInformation(*(WireText(encode_text(text, 16)) for text in texts)))


def verdicts(findings: Iterable[CheckResult]) -> list[tuple[IdentityCheck, CheckVerdict]]:
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
    assert verdicts(judge_image(image, BMS, identity)) == [(IdentityCheck.TARGET, verdict)]


HARDWARE, DOWNGRADE, SAME, PREVIOUS = (
    IdentityCheck.HARDWARE, IdentityCheck.DOWNGRADE,
    IdentityCheck.SAME_VERSION, IdentityCheck.PREVIOUS,
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
def test_what_the_device_reports_of_the_image(
    stated: dict[str, object] | None,
    device: DeviceAnswers,
    expected: dict[IdentityCheck, CheckVerdict],
) -> None:
    identity = Identity(None if stated is None else release(**stated))
    assert dict(verdicts(judge_device(IMAGE, BMS, identity, device))) == expected


def test_a_device_that_reports_no_version_cannot_be_compared_and_that_is_reported() -> None:
    found = list(judge_device(IMAGE, OBC, Identity(), DeviceAnswers()))
    assert len(found) == 1
    assert "the OBC's application reported no version" in found[0].text


@each(
    "change, expected",
    [
        ({}, {}),
        ({"mean_current_ma": -1000}, {}),
        ({"mean_current_ma": -1001}, {IdentityCheck.IN_USE: REFUSED}),
        ({"mean_current_ma": 3000}, {}),  # it is charged
        ({"state_of_charge_percent": 20}, {}),
        ({"state_of_charge_percent": 19}, {IdentityCheck.CHARGE: WARNED}),
        ({"mean_current_ma": -5000, "state_of_charge_percent": 5},
         {IdentityCheck.IN_USE: REFUSED, IdentityCheck.CHARGE: WARNED}),
        ({"state_of_charge_percent": 4}, {IdentityCheck.CHARGE: REFUSED}),
        ({"state_of_charge_percent": 0}, {IdentityCheck.CHARGE: REFUSED}),
        # Its charger keeps it on.
        ({"state_of_charge_percent": 0, "status": BatteryStatus.CHARGER_CONNECTED},
         {IdentityCheck.CHARGE: WARNED}),
    ],
)  # fmt: skip
def test_the_state_of_the_battery(
    change: dict[str, int], expected: dict[IdentityCheck, CheckVerdict]
) -> None:
    device = replace(seen(), running=replace(BATTERY, **change))  # type: ignore[arg-type]
    found = dict(verdicts(judge_device(IMAGE, BMS, Identity(), device)))
    assert {
        check: found[check]
        for check in (IdentityCheck.IN_USE, IdentityCheck.CHARGE)
        if check in found
    } == (expected)


def test_a_waived_check_is_reported_and_ends_nothing() -> None:
    refused = Identity().refusal(IdentityCheck.DOWNGRADE, "older")
    waived = Identity(waived=frozenset({IdentityCheck.DOWNGRADE})).refusal(
        IdentityCheck.DOWNGRADE, "older"
    )
    assert refused.ending is Ending.NOT_FOR_DEVICE
    assert "--allow-downgrade waives this" in refused.detail
    assert waived.ending is None
    assert waived.event.verdict == "waived"


def test_each_check_that_refuses_can_be_waived_and_no_other() -> None:
    assert set(WAIVABLE) == set(IdentityCheck) - {
        IdentityCheck.SAME_VERSION, IdentityCheck.WAY_BACK,
    }  # fmt: skip


def test_the_same_version_is_skipped_on_request_only() -> None:
    found = dict(verdicts(judge_device(IMAGE, BMS, Identity(skip_same_version=True), seen(NEW))))
    assert found[IdentityCheck.SAME_VERSION] is CheckVerdict.SKIPPED


def test_what_a_device_reports_is_shown_escaped() -> None:
    texts = (
        b"BM36.".ljust(16),
        b"W1.".ljust(16),
        b"\x1b[31mred\x07.".ljust(16),
        b"V\x1b[2J.".ljust(16),
    )
    device = DeviceAnswers(VersionInformation(*map(WireText, texts)))
    reported = [
        found.text
        for found in judge_device(IMAGE, BMS, Identity(release(hardware_versions=("V1*",))), device)
    ]
    assert reported
    assert not any("\x1b" in text or "\x07" in text for text in reported)


# -- every sentence, and what becomes of it -------------------------------------------------------


def judged(
    image: Image = IMAGE, identity: Identity | None = None, device: DeviceAnswers | None = None
) -> dict[IdentityCheck, CheckResult]:
    identity = identity or Identity()
    found = list(judge_image(image, BMS, identity))
    found += judge_device(image, BMS, identity, device or DeviceAnswers())
    assert len({each.check for each in found}) == len(found)
    return {each.check: each for each in found}


@each(
    "image, identity, verdict, text, detail",
    [
        (Image.from_bytes(b"PK\3\4" + bytes(60)), Identity(), REFUSED, "the image is a zip archive",
         "the image is a zip archive"),
        (Image.from_bytes(bytes(4) + VECTORS), Identity(), REFUSED, "no Cortex-M vector table",
         "--allow-implausible waives this, as does"),
        (Image.from_bytes(bytes(4) + VECTORS), Identity(cpu=Cpu.OTHER), UNKNOWN,
         "the profile names another processor", ""),
        (Image.from_bytes(b"PK\3\4" + bytes(60)), Identity(cpu=Cpu.OTHER), REFUSED, "zip", ""),
        (Image.from_bytes(bytes(4) + VECTORS),
         Identity(waived=frozenset({IdentityCheck.PLAUSIBLE})),
         CheckVerdict.WAIVED, "no Cortex-M vector table", ""),
    ],
)  # fmt: skip
def test_an_image_that_is_no_program_is_refused_and_why(
    image: Image, identity: Identity, verdict: CheckVerdict, text: str, detail: str
) -> None:
    found = judged(image, identity)[IdentityCheck.PLAUSIBLE]
    assert found.verdict is verdict
    assert text in found.text
    assert detail in found.detail
    assert (found.ending is Ending.IMPLAUSIBLE) is (verdict is REFUSED)
    assert IdentityCheck.TARGET in judged(image, identity), "the other checks are made all the same"


def test_a_manifest_vouches_for_its_very_bytes_only() -> None:
    odd = Image.from_bytes(bytes(4) + VECTORS)
    assert Identity(release_of(odd, BMS)).matches_bytes(odd)
    assert not Identity().matches_bytes(odd)
    assert not Identity(release()).matches_bytes(odd)
    found = judged(odd, Identity(release_of(odd, BMS)))[IdentityCheck.PLAUSIBLE]
    assert found.verdict is UNKNOWN
    assert found.text.endswith("the manifest was made for these very bytes")
    archive = Image.from_bytes(b"PK\3\4" + bytes(60))
    assert (
        judged(archive, Identity(release_of(archive, BMS)))[IdentityCheck.PLAUSIBLE].verdict
        is REFUSED
    )


def test_what_shows_that_the_image_is_for_the_target() -> None:
    assert judged()[IdentityCheck.TARGET].text.startswith(
        "no manifest, and the image names no device"
    )
    by_manifest = judged(IMAGE, Identity(release()))[IdentityCheck.TARGET]
    assert by_manifest.text == "by the manifest the image is for the BMS"
    named = Image.from_bytes(VECTORS + b"\0BMS_UPD\0")
    assert (
        judged(named)[IdentityCheck.TARGET].text
        == "by a name inside the image the image is for the BMS"
    )
    other = judged(IMAGE, Identity(release(target=WMC)))[IdentityCheck.TARGET]
    assert "is for the WMC, not the BMS" in other.detail
    assert other.ending is Ending.NOT_FOR_DEVICE
    assert other.waiver == "other-target"


@each(
    "stated, rules",
    [
        ({"hardware_versions": ("V1*",)}, "hardware"),
        ({"previous_from": OLD}, "the version that is replaced"),
        ({"hardware_versions": ("V1*",), "previous_except": (OLD,)},
         "hardware and the version that is replaced"),
    ],
)  # fmt: skip
def test_a_rule_that_a_silent_device_cannot_be_asked_for_refuses_it(
    stated: dict[str, object], rules: str
) -> None:
    found = judged(IMAGE, Identity(release(**stated)))[IdentityCheck.HARDWARE]
    assert found.text == (
        "the BMS's application reported no version: "
        f"the manifest's rule on {rules} cannot be checked"
    )
    assert found.verdict is REFUSED
    assert found.is_unchecked
    assert found.ending is Ending.UNCHECKED
    assert found.detail == f"{found.text}; --allow-hardware waives this"
    rescued = judged(IMAGE, Identity(release(**stated), reports_unchecked=True))[
        IdentityCheck.HARDWARE
    ]
    assert rescued.verdict is UNKNOWN
    assert rescued.text == f"{found.text}: goes on unchecked"
    assert rescued.ending is None


@each("waived", [IdentityCheck.HARDWARE, IdentityCheck.PREVIOUS])
def test_a_rule_is_waived_by_its_own_option_and_by_that_for_hardware(waived: IdentityCheck) -> None:
    both = release(hardware_versions=("V1*",), previous_from=OLD)
    for ruled in (replace(both, hardware_versions=()), replace(both, previous_from=None)):
        found = list(
            judge_device(IMAGE, BMS, Identity(ruled, frozenset({waived})), DeviceAnswers())
        )
        other_rule = waived is IdentityCheck.PREVIOUS and bool(ruled.hardware_versions)
        assert found[0].verdict is (REFUSED if other_rule else CheckVerdict.WAIVED)


def test_hardware_that_is_not_listed_is_named_with_the_list() -> None:
    fits = ("V1r3*", "V2*")
    found = judged(IMAGE, Identity(release(hardware_versions=fits)), seen())[IdentityCheck.HARDWARE]
    assert found.text == (
        "the device's hardware V1r2r0_20220512 is not in the manifest, which lists V1r3*, V2*"
    )
    assert found.ending is Ending.NOT_FOR_DEVICE
    assert not found.is_unchecked
    good = judged(IMAGE, Identity(release(hardware_versions=("V1*",))), seen())[
        IdentityCheck.HARDWARE
    ]
    assert good.text == "the manifest lists hardware V1r2r0_20220512"
    assert judged(device=seen())[IdentityCheck.HARDWARE].text == (
        "no manifest states which hardware the image fits"
    )


@each(
    "firmware, check, verdict, text",
    [
        (NEW, SAME, WARNED, f"the device already runs {NEW}"),
        (OLD, DOWNGRADE, PASSED, f"{NEW} is newer than {OLD}, which runs now"),
        ("V3r0r0_20260301", DOWNGRADE, REFUSED,
         f"{NEW} is older than V3r0r0_20260301, which runs now"),
        ("by hand", DOWNGRADE, UNKNOWN, f"by hand and {NEW} cannot be compared"),
    ],
)  # fmt: skip
def test_the_running_version_is_compared_with_the_new_one(
    firmware: str, check: IdentityCheck, verdict: CheckVerdict, text: str
) -> None:
    found = judged(device=seen(firmware))[check]
    assert found.verdict is verdict
    assert found.text.startswith(text)


def test_a_version_that_is_only_written_in_another_way_is_not_older() -> None:
    same = replace(IMAGE, version=NEW.replace("V2", "V02"))
    assert judged(same, device=seen(NEW))[DOWNGRADE].verdict is PASSED


def test_the_images_own_version_counts_before_the_manifests() -> None:
    named = replace(release_of(NAMELESS, BMS), firmware_version=NEW)
    assert new_version(NAMELESS, named) == NEW
    assert new_version(replace(IMAGE, version=OLD), named) == OLD
    assert new_version(NAMELESS, None) is None
    found = judged(NAMELESS, Identity(), seen())[DOWNGRADE]
    assert found.verdict is UNKNOWN
    assert found.text == f"the image names no version to compare with the running {OLD}"
    assert judged(NAMELESS, Identity(named), seen())[DOWNGRADE].verdict is PASSED


@each(
    "stated, text",
    [
        ({"previous_from": OLD}, f"the manifest lets {OLD} be replaced"),
        ({"previous_except": (OLD,)}, f"the device runs {OLD}: the manifest excludes it"),
        ({"previous_except": (OLD,), "previous_from": NEW},
         f"the device runs {OLD}: the manifest excludes it"),
        ({"previous_except": ("V1r0r9_20220901",), "previous_from": NEW},
         f"the device runs {OLD}: the manifest replaces {NEW} and newer"),
    ],
)  # fmt: skip
def test_the_rule_on_the_version_that_is_replaced(stated: dict[str, object], text: str) -> None:
    assert judged(IMAGE, Identity(release(**stated)), seen())[PREVIOUS].text == text


def test_a_battery_in_use_or_low_is_named_with_its_figures() -> None:
    device = replace(
        seen(), running=replace(BATTERY, mean_current_ma=-1500, state_of_charge_percent=7)
    )
    found = judged(device=device)
    assert found[IdentityCheck.IN_USE].text == "the battery gives 1500 mA, more than 1000 mA"
    assert found[IdentityCheck.IN_USE].ending is Ending.IN_USE
    assert (
        found[IdentityCheck.CHARGE].text == "the battery is at 7 %: charge it first, if it can wait"
    )
    assert found[IdentityCheck.CHARGE].ending is None
    assert found[IdentityCheck.CHARGE].waiver == ""
    assert found[IdentityCheck.CHARGE].detail == found[IdentityCheck.CHARGE].text
    empty = judged(identity=Identity(minimum_charge_percent=8), device=device)
    assert empty[IdentityCheck.CHARGE].detail == (
        "the battery is at 7 %, less than 8 %, and no charger is connected; --allow-low-charge "
        "waives this"
    )
    assert empty[IdentityCheck.CHARGE].ending is Ending.LOW_CHARGE
    limits = Identity(in_use_ma=1500, low_charge_percent=7)
    assert {IdentityCheck.IN_USE, IdentityCheck.CHARGE}.isdisjoint(
        judged(identity=limits, device=device)
    )


def test_the_same_version_ends_the_session_where_it_is_skipped() -> None:
    found = judged(identity=Identity(skip_same_version=True), device=seen(NEW))[SAME]
    assert found.ending is Ending.UP_TO_DATE
    assert found.event == CheckMade("same-version", "skipped", f"the device already runs {NEW}")


def test_only_the_battery_reports_its_state_even_without_a_version() -> None:
    device = DeviceAnswers(running=replace(BATTERY, mean_current_ma=-1500))
    assert judged(device=device)[IdentityCheck.IN_USE].verdict is REFUSED
    assert device.hardware_version is None
    assert device.firmware_version is None
