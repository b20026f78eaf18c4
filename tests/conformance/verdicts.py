"""Verdicts of the suite on the mock and on wrong devices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import flasher.conformance.cases  # noqa: F401  registers the cases
from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import CASES, Case, group_of, why_unsupported
from flasher.conformance.firmware import Firmware
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock, variant_maker
from flasher.conformance.profile import ConformanceProfile, Value
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import execute

SMALL_AREA = {"application_area_bytes": 34 * 1024, "page_size_bytes": 1024}
"""272 packets: enough for all images up to 64 KiB, and quick to fill; images of whole sectors have
half the usual size.
"""


def verdicts(
    cases: Sequence[str],
    variant: str | None = None,
    *,
    target: str = "bms",
    states: Mapping[str, Value] | None = None,
    with_second_image: bool = True,
    with_power: bool = True,
    **choices: Any,
) -> dict[str, CaseVerdict]:
    """Verdict on each case of a device with these choices or of this variant.

    The profile states the device's choices, changed by `states`.
    """
    profile = replace(MOCK_PROFILE, **(SMALL_AREA | choices))
    make_device = None if variant is None else variant_maker(variant)
    subject = MockSubject(target, profile=profile, make_device=make_device)
    if not with_second_image:
        subject.second_image = None
        subject.firmware = Firmware(subject.good_image, None)
    if not with_power:
        subject.has_power = False
    # A variant includes choices of its own.
    stated = profile_of_mock(subject.device.profile)
    judged_by = replace(stated, given={**stated.given, **(states or {})})
    return {case_id: _verdict(CASES[case_id], subject, judged_by) for case_id in cases}


def _verdict(case: Case, subject: MockSubject, profile: ConformanceProfile) -> CaseVerdict:
    """Like a run of this case alone, without the restore afterwards."""
    if why_unsupported(case, subject, profile):
        return CaseVerdict.UNSUPPORTED
    bench = Bench(
        subject, profile, limit_s=case.limit_with(profile, subject), seed=f"1/{case.id}/1"
    )
    _put_image(subject)
    bench.wait(1.0)
    bench.forget()
    return execute(case, bench).verdict


def _put_image(subject: MockSubject) -> None:
    """Write the image directly to flash, without frames."""
    image, store = subject.good_image, subject.device.store
    subject.power(on=False)
    if store.image() != image:
        for operation in store.erasing(len(image)):
            if operation.data is None:
                store.flash.erase_page(operation.address)
        store.load(image)
    subject.power(on=True)


def not_passed(*cases: str, **kwargs: Any) -> list[str]:
    """Cases that did not pass."""
    found = verdicts(cases, **kwargs)
    return [case_id for case_id, status in found.items() if status is not CaseVerdict.PASS]


def cases_of(group: str) -> list[str]:
    """The cases of a group."""
    return [case_id for case_id, case in CASES.items() if group_of(case_id) == group]
