"""Upgrade of a whole bike on the bench: all devices of a set, one after the other, on one bus."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from flasher.bike import (
    in_safe_order,
    judge_bike,
    look_at_bike,
)
from flasher.errors import InterruptedByUserError
from flasher.host.options import serial_number
from flasher.i18n import text
from flasher.protocol.spec import BMS, Target
from flasher.web.bench import RESCUE, BenchController, advise, changed_error
from flasher.web.bench_state import Activity, Offer, SetDevice

_GO_ON: Final = text("Go on with the bike.")


def upgrade_bike(bench: BenchController, selection: str) -> None:
    """Check the whole bike, then upgrade the devices of the selected set in a safe order; begun
    again, it goes on where it stopped.

    Raises UsageError if the page was outdated, and FlasherError for what refuses the
    upgrade; the error of an upgrade that has begun is in its `done`.
    """
    chosen = bench.shown_offer(selection)
    offers = dict(chosen.parts)
    jobs = {target: job for target, (_, job) in bench.set_jobs(chosen.path).items()}
    if "".join(job.plan.image.sha256 for job in jobs.values()) != chosen.sha256:
        raise changed_error(chosen)
    bench.show(doing=Activity.LOOKING, compared=None)
    profiles = {target: bench.backend.profile(target) for target in jobs}
    try:
        with bench.connected() as connection:
            dialect = bench.backend.dialect
            found = look_at_bike(connection, dialect, profiles, cancelled=bench.cancelled)
            bench.check_same_bike(bench.state.battery)
            judge_bike(found, jobs, ())
            battery = serial_number(found.answers[BMS].version)
            kept = {
                each.target: each
                for each in bench.state.devices
                if _is_done(each, offers, battery) and each.target not in found.broken
            }
            order = in_safe_order(list(jobs), found.broken)
            devices = (
                kept.get(each, SetDevice(each, offers[each], None, battery)) for each in order
            )
            bench.show(done=None, devices=tuple(devices))
            for target in order:
                if target in kept:
                    continue
                bench.show(target=target, offer=offers[target])
                if bench.cancelled():
                    raise InterruptedByUserError(
                        text("The upgrade of the bike was stopped before its next device."),
                        remedy=text("The same button goes on with the next one."),
                    )
                try:
                    done = bench.carry_out(found.ready(jobs[target]), offers[target], battery)
                finally:  # also if the adapter is lost while the device is read after its upgrade
                    _ended(bench)
                if done.error is not None:
                    if not done.is_refused:
                        advise(done.error, _GO_ON, RESCUE)
                    return
    finally:
        bench.show(target=None, offer=chosen)


def _is_done(device: SetDevice, offers: Mapping[Target, Offer], battery: str) -> bool:
    """True if this device of this bike has this image, from the upgrade that is continued."""
    done, offer = device.done, offers.get(device.target)
    is_good = done is not None and done.error is None
    is_same = offer is not None and device.offer.sha256 == offer.sha256
    return is_good and is_same and bool(battery) and device.battery == battery


def _ended(bench: BenchController) -> None:
    """Keep the end of the last upgrade with its device."""
    done = bench.state.done
    devices = (
        replace(each, done=done) if done is not None and each.target is done.target else each
        for each in bench.state.devices
    )
    bench.show(devices=tuple(devices))
