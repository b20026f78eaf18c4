"""Runs one case to its end, whatever that is, and says what a report tells about it."""

from __future__ import annotations

from typing import NamedTuple

from flasher.conformance.bench import Bench
from flasher.conformance.cases.elsewhere import NOT_IMPLEMENTED
from flasher.conformance.model import (
    CASES,
    Case,
    CaseLimitReached,
    CaseStopped,
    DeviceCrashed,
    RunStopped,
    Status,
    Unsupported,
)
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.report import CaseText
from flasher.errors import BusError


class Verdict(NamedTuple):
    """What came of a case; `stop` is why the whole run has to end with it, mostly empty."""

    status: Status
    note: str = ""
    stop: str = ""


def execute(case: Case, bench: Bench) -> Verdict:
    """Run a case; nothing that it does gets out of here."""
    try:
        case.run(bench)
    except CaseStopped:
        return Verdict(bench.findings.status())
    except Unsupported as ended:
        failed = bench.findings.status() is Status.FAIL
        return Verdict(Status.FAIL if failed else Status.UNSUPPORTED, str(ended))
    except RunStopped as ended:
        return Verdict(Status.NOT_RUN, str(ended), str(ended))
    except (CaseLimitReached, DeviceCrashed) as ended:
        bench.check(False, "the case comes to its end", ended)  # noqa: FBT003
        return Verdict(Status.FAIL, str(ended))
    except BusError as error:
        return Verdict(Status.ERROR, error.what, f"the adapter failed in {case.id}: {error.what}")
    except Exception as error:  # noqa: BLE001  a bug of one case must not hide the others
        return Verdict(Status.ERROR, f"the case itself failed: {type(error).__name__}: {error}")
    status = bench.findings.status()
    return Verdict(status, "the case judged nothing" if status is Status.ERROR else "")


def case_text(case_id: str, profile: ConformanceProfile) -> CaseText:
    """What a report says about a case, implemented or not."""
    case = CASES.get(case_id)
    deviation = profile.deviations.get(case_id, "")
    group = case_id.partition("-")[0]
    if case is None:
        why = NOT_IMPLEMENTED[case_id]
        return CaseText(case_id, group, why, "", "", "", (), {}, deviation)
    return CaseText(
        case_id,
        group,
        case.title,
        case.clause,
        case.stimulus,
        case.expectation,
        tuple(sorted(need.value for need in case.requires)),
        {key: profile.choice(key) for key in case.choices},
        deviation,
    )
