"""BR: bring-up. Two plain upgrades before all other cases."""

from __future__ import annotations

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import BRING_UP, DESTRUCTIVE, case


@case(
    BRING_UP,
    "two plain upgrades",
    clause="Welling 5.1, figure 2 (begin); Welling 5.1, figure 2 (packets)",
    stimulus="two upgrades from the running application, as a tool does them, to the second good "
    "image where there is one, and back",
    expectation="both succeed, and their applications run",
    requires={DESTRUCTIVE},
)
def two_plain_upgrades(bench: Bench) -> None:
    good, second, _ = bench.firmware
    for image in (second or good, good):
        with bench.step("to the good image" if image is good else "to the second one"):
            bench.check_upgrade(image)
