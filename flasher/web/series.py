"""Series mode of the bench: one bike after the other, with the image of the last upgrade.

It waits until the upgraded unit is taken out and another one is connected, shows for some seconds
which unit gets which image, and upgrades it with all checks. It asks before it upgrades a unit that
may be one of the last ones, and ends after an upgrade that left a device to be rescued, when no
page shows it, and on Stop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import ceil
from typing import Final

from flasher.driver import drive
from flasher.errors import (
    BusError,
    ErrorCode,
    FlasherError,
    ImageError,
    InterruptedByUserError,
    UsageError,
)
from flasher.host.options import serial_number
from flasher.i18n import text
from flasher.procedures import two_devices_error
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS
from flasher.station.presence import PROBE_S
from flasher.web.bench import BenchController
from flasher.web.bench_state import Activity, Done, Offer, Series, SeriesStep
from flasher.web.unit_watch import UnitWatch

SHOWN_S: Final = 10
"""Time for which unit and image are shown before an upgrade starts."""
SETTLED_S: Final = 2.0
"""Time without a change after which a unit counts as connected: contacts bounce, and devices of a
bike announce themselves one after another."""
_SERIAL_WAIT_S: Final = SETTLED_S + 4 * PROBE_S
"""Time after which a unit that reports no serial number is taken to have none."""
PAGE_AWAY_S: Final = 5.0
"""Time without a page that shows the series, after which it ends; a reload takes less."""
ADAPTER_WAIT_S: Final = 300.0
"""Time for which a lost adapter may be away."""
_RETRY_S: Final = 1.0


def take_next_bikes(bench: BenchController) -> None:
    """Upgrade one bike after the other until stopped. Raises the FlasherError that ends it."""
    _SeriesRun(bench).run()


class _SeriesRun:
    def __init__(self, bench: BenchController) -> None:
        self._bench = bench
        state = bench.state
        done = state.done
        if done is None or done.error is not None or state.offer is None or state.target is None:
            raise UsageError(
                text("The next bike is taken after an upgrade that has succeeded."),
                remedy=text("Upgrade the first bike with the button."),
            )
        self._target, self._sha256, self._path = state.target, state.offer.sha256, state.offer.path
        bench.show(waived=frozenset(), is_rescue=False, compared=None)
        self._taken: dict[str, bool] = {}
        """Serial numbers of this series; True if the upgrade of the unit has succeeded."""
        self._lost_at: float | None = None
        """Time at which the adapter was lost; None if a message was received since then."""
        self._remember(done)
        self._watch: UnitWatch | None = None
        self._followed_at = bench.now()

    def _remember(self, done: Done) -> None:
        """Remember the unit of an upgrade, whose firmware may have changed its serial number."""
        seen = [each.version for each in (done.before, done.after) if each is not None]
        serials = set(filter(None, map(serial_number, seen)))
        self._is_last_known = bool(serials)
        self._taken |= dict.fromkeys(serials, done.error is None)

    def run(self) -> None:
        try:
            while not self._bench.cancelled():
                try:
                    with self._bench.connected() as connection:
                        self._use(connection.clock.speed)
                        while self._next():
                            pass
                        return
                except InterruptedByUserError:
                    if not self._bench.cancelled():
                        raise
                except BusError as error:
                    self._await_adapter(error)
        finally:
            self._bench.show(series=None)

    # -- one bike ----------------------------------------------------------------------------------

    def _next(self) -> bool:
        """Take one bike; False if the series was stopped."""
        watch = self._watched()
        self._show(SeriesStep.UNIT if watch.was_gone else SeriesStep.REMOVAL)
        if not self._run(self._is_another_there):
            return False
        changes = watch.changes
        self._show(SeriesStep.READING)
        bike = self._bench.seen(BMS, watch, self._received)
        if self._bench.cancelled():
            return False
        self._bench.show(bike=bike, done=None, checks=(), notes=())
        serial = serial_number(bike.version)
        offer = self._judged()
        refusal = offer.refusal
        if bike.survey.duplicates.evidence:
            refusal = two_devices_error(BMS, bike.survey.duplicates.evidence, "Nothing was sent.")
        if refusal is not None:
            self._bench.note_session(serial, offer, refusal)
            self._show(SeriesStep.REFUSED, serial=serial, refusal=refusal)
            return self._run(lambda _now: watch.changes != changes)
        running = str(getattr(bike.version, "firmware_version", ""))
        why = self._question(serial, running, offer)
        if why:
            question = self._bench.ask()
            self._show(SeriesStep.ASKED, serial=serial, running=running, why=why, question=question)
            if not self._run(lambda _now: watch.changes != changes or self._bench.is_agreed):
                return False
            if watch.changes != changes:
                return True
        elif not self._count_down(changes, serial, running):
            return False
        if serial:  # a unit that was just taken out does not answer any more
            answers = watch.answers
            if not self._run(lambda _now: watch.changes != changes or watch.answers > answers):
                return False
        if watch.changes != changes:
            return True
        return self._upgrade(serial, offer)

    def _question(self, serial: str, running: str, offer: Offer) -> str:
        """Reason to ask before this unit is upgraded; "" if there is none."""
        if not serial:
            return text("It reports no serial number: it may be the same unit as before.")
        if serial in self._taken:
            return (
                text("This unit was upgraded already in this series.")
                if self._taken[serial]
                else text("The upgrade of this unit has failed in this series.")
            )
        if not self._is_last_known:
            return text("The unit before it reported no serial number: this may be the same one.")
        if running and running == offer.version and self._target is BMS:
            return text("It runs the version of the image already.")
        return ""

    def _count_down(self, changes: int, serial: str, running: str) -> bool:
        watch = self._watched()
        ends_at: float | None = None

        def is_over(now: float) -> bool:
            nonlocal ends_at
            ends_at = now + SHOWN_S if ends_at is None else ends_at
            left_s = max(0, ceil(ends_at - now))
            series = self._bench.state.series
            if series is None or series.left_s != left_s:
                self._show(SeriesStep.SHOWN, serial=serial, running=running, left_s=left_s)
            return watch.changes != changes or now >= ends_at

        return self._run(is_over)

    def _upgrade(self, serial: str, offer: Offer) -> bool:
        bench = self._bench
        bench.show(offer=offer)
        self._show(SeriesStep.UPGRADING, serial=serial)
        try:
            bench.upgrade(bench.state.selection)
        finally:  # also if the adapter is lost while the unit is read after its upgrade
            done = bench.state.done
            if done is not None:
                self._remember(done)
                self._watched().start_over()
            self._followed_at = bench.now()
        assert done is not None  # noqa: S101  an upgrade that returns has ended
        error = done.error
        has_ended = isinstance(error, BusError | InterruptedByUserError)
        # The result has the error, and leads to the rescue.
        return error is None or not (error.needs_rescue or has_ended)

    def _judged(self) -> Offer:
        """Check the image against the unit that is connected now. Raises ImageError if the file is
        another one.
        """
        offer = self._bench.judged(self._path)
        if offer.refusal is None and offer.sha256 != self._sha256:
            raise ImageError(
                text("{name} has changed since the first bike.", name=offer.name),
                remedy=text("Choose the image again, and upgrade one bike with it first."),
            )
        return offer

    # -- the bus -----------------------------------------------------------------------------------

    def _use(self, speed: float) -> None:
        """Watch for units on a connection that was just opened."""
        if self._watch is None:
            targets = dict.fromkeys((BMS, self._target))
            profiles = [self._bench.backend.profile(each) for each in targets]
            self._watch = UnitWatch(profiles, speed)
        was_gone = self._watch.was_gone
        self._watch.start_over()
        self._watch.was_gone = was_gone

    def _watched(self) -> UnitWatch:
        assert self._watch is not None  # noqa: S101  made when the adapter was opened
        return self._watch

    def _run(self, is_enough: Callable[[float], bool]) -> bool:
        """Watch the unit until the condition holds; False if the series was stopped first."""
        with self._bench.connected() as connection:
            engine = self._watched().until(is_enough)
            drive(
                engine, connection.link, connection.clock,
                taps=(self._received,), cancelled=self._is_over,
            )  # fmt: skip
        return not self._bench.cancelled()

    def _is_another_there(self, now: float) -> bool:
        watch = self._watched()
        if watch.is_there is False:
            self._show(SeriesStep.UNIT)
        if not watch.is_there:
            return False
        settled_s = now - watch.unchanged_since
        if settled_s < SETTLED_S or (watch.serial is None and settled_s < _SERIAL_WAIT_S):
            return False
        is_other_serial = bool(watch.serial and self._taken) and watch.serial not in self._taken
        return watch.was_gone or is_other_serial

    def _is_over(self) -> bool:
        """True if the series was stopped. Raises InterruptedByUserError if no page shows it."""
        now = self._bench.now()
        if self._bench.feed.is_followed:
            self._followed_at = now
        elif now - self._followed_at > PAGE_AWAY_S:
            raise InterruptedByUserError(
                text("The page was closed: no further bike was taken."),
                remedy=text("Look at the list, and switch it on again for the next one."),
                code=ErrorCode.INTERRUPTED,
            )
        if self._bench.has_new_files:
            raise UsageError(
                text("A file came: no further bike was taken."),
                remedy=text("Choose the image, and upgrade one bike with it first."),
            )
        return self._bench.cancelled()

    def _received(self, frame: Frame, *, sent: bool, now: float) -> None:
        """Process a frame: an adapter that opens may still not work, one that receives does."""
        if not sent:
            self._lost_at = None

    def _await_adapter(self, error: FlasherError) -> None:
        """Wait before the adapter is tried again. Raises its error if it was away for too long."""
        now = self._bench.now()
        if self._lost_at is None:
            self._lost_at = now
        if now - self._lost_at > ADAPTER_WAIT_S:
            raise error
        self._show(SeriesStep.ADAPTER, refusal=error)
        self._is_over()
        self._bench.pause(_RETRY_S)

    def _show(self, step: SeriesStep, **facts: object) -> None:
        series = replace(Series(step), **facts)  # type: ignore[arg-type]
        if self._bench.state.series != series:
            self._bench.show(series=series, doing=Activity.SERIES)
