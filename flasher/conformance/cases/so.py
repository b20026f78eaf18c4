"""SO: soak test. Runs only when selected by name, as it wears the flash."""

from __future__ import annotations

from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, WEAR, case
from flasher.conformance.results import CaseStopped, CheckOutcome

_FAILURES_MAX: Final = 10
"""Stop after this many failures to spare the device."""
_NAMED_MAX: Final = 20


@case(
    "SO-01",
    "many upgrades",
    clause="Welling 5.1, figure 2 (end); robustness, not in the document",
    stimulus=f"{WEAR['SO-01']} upgrades (--upgrades), to the second image and the good one in turn",
    expectation="each one succeeds without repeated messages, and its own application runs; "
    "failures are listed by number",
    requires={DESTRUCTIVE, LONG},
    limit_s=float("inf"),
)
def many_upgrades(bench: Bench) -> None:
    images = (bench.subject.second_image or bench.good_image, bench.good_image)
    if bench.subject.second_image is None:
        bench.unsupported("two images in turn", "the bench has no second good image")
    failed: list[int] = []
    done = 0
    while done < bench.upgrades and len(failed) < _FAILURES_MAX:
        done += 1
        with bench.step(f"upgrade {done}"):
            if _upgrade_once(bench, images[done % 2 == 0]):
                continue
            failed.append(done)
            image = bench.good_image
            rescued = bench.upgrade(image).ok or bench.upgrade(image, blind=True).ok
            if not (rescued and bench.application_runs()):
                bench.fail("the device can be upgraded afterwards", "it cannot")
                break
    named = ", ".join(map(str, failed[:_NAMED_MAX]))
    got = f"{done - len(failed)} of {done}" + (f"; failed: number {named}" if failed else "")
    bench.check(
        not failed and done == bench.upgrades, f"{bench.upgrades} upgrades, each one verified", got
    )
    bench.info(f"flash wear: the application was erased and written {done} times")


def _upgrade_once(bench: Bench, image: bytes) -> bool:
    """Upgrade to `image`, sending each message once. Drops checks that passed to keep a report of a
    thousand upgrades readable.
    """
    checks, begin = bench.judge.checks, len(bench.judge.checks)
    try:
        bench.start_transfer(len(image))
        bench.packets(image)
        bench.end_transfer()
        bench.check_image(image)
    except CaseStopped:
        pass
    known = {(one.outcome, one.expected) for one in checks[:begin]}
    found, checks[begin:] = checks[begin:], []
    for one in found:
        is_new = (one.outcome, one.expected) not in known
        is_untried = one.outcome is CheckOutcome.UNSUPPORTED
        if one.outcome is not CheckOutcome.PASS and (is_new or not is_untried):
            checks.append(one)
    return all(one.outcome is not CheckOutcome.FAIL for one in found)
