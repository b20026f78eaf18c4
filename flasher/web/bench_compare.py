"""Comparison on the bench: whether a device runs the chosen image, as long as it is connected."""

from __future__ import annotations

import logging
from typing import Final

from flasher import events
from flasher.api import compare as compare_device
from flasher.driver import drive
from flasher.errors import FlasherError, UsageError
from flasher.host.verify import Level, Verdict, possible_levels
from flasher.i18n import text
from flasher.station.presence import TargetWatcher
from flasher.web.bench import BenchController
from flasher.web.bench_state import Activity, Compared
from flasher.web.unit_watch import UnitWatch

_LOG: Final = logging.getLogger("flasher.web")


def compare(bench: BenchController) -> None:
    """Compare what the device runs with the chosen image. Nothing is written or reset."""
    target, offer = bench.state.target, bench.state.offer
    if target is None or offer is None:
        raise UsageError("No image is chosen.", remedy="Choose the one to compare with.")
    job = bench.job(offer.path, target)
    if Level.VERSION not in possible_levels(target, job.options):
        raise UsageError(
            text("The documents give no query for what the {node} runs.", node=target.node.name),
            remedy=text("See the history of this computer: it has each upgrade."),
        )

    def happened(event: object) -> None:
        if isinstance(event, events.MemoryRead):
            bench.show(compared_bytes=event.read_bytes)

    profile = bench.backend.profile(target)
    unit = TargetWatcher(profile)
    bench.show(doing=Activity.COMPARING, compared=None, compared_bytes=0)
    with bench.connected() as connection:
        bench.check_same_bike(bench.state.battery)
        device = connection.device(target, dialect=bench.backend.dialect, profile=profile)
        found, unread = compare_device(
            device, job.plan, job.options,
            cancelled=bench.cancelled, on_event=happened, taps=(unit,),
        )  # fmt: skip
    error = found.error(target, is_after_upgrade=False)
    if error is not None:
        is_silent = found.verdict is Verdict.NO_ANSWER
        error.remedy = (
            text("Wake the device with its key, then compare again.")
            if is_silent
            else text("Upgrade it with this image, or choose the one that it should run.")
        )
    bench.show(compared=Compared(offer, found, unread, error, unit.serial))


def watch_compared(bench: BenchController) -> None:
    """Keep a comparison only as long as the unit stays connected, until the next order."""
    target, compared = bench.state.target, bench.state.compared
    if compared is None or target is None:
        return

    def is_needed() -> bool:
        bench.feed.beat()
        return not bench.is_wanted

    try:
        with bench.connected() as connection:
            unit = UnitWatch([bench.backend.profile(target)], connection.clock.speed)

            def is_another(_now: float) -> bool:
                if compared.serial is None:  # it was silent
                    return unit.serial is not None
                is_other = unit.serial is not None and unit.serial != compared.serial
                return unit.is_there is False or unit.changes > 1 or is_other

            drive(
                unit.until(is_another), connection.link, connection.clock,
                cancelled=lambda: not is_needed(),
            )  # fmt: skip
    except FlasherError:
        _LOG.info("the compared unit is no longer observed", exc_info=True)
    if is_needed():
        bench.show(compared=None)
