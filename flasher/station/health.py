"""Checks the health of a station: records, labels, scanners, free disk space and clock."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from flasher.i18n import text
from flasher.station.board import Board, few

LITTLE_BYTES: Final = 500 * 1024 * 1024
"""Less free disk space than this is reported."""
CLOCK_SHIFT_MAX_S: Final = 5.0
"""Greatest change of UTC relative to the monotonic clock since the start of the station."""
CERTIFICATE_LEFT: Final = timedelta(days=30)
"""A certificate that expires sooner is reported."""
LOOK_EVERY_S: Final = 5.0


@dataclass(frozen=True)
class HealthCheck:
    """Name, verdict and text of one check of the station."""

    name: str
    is_good: bool
    text: str
    """Result for people."""


def certificate_checks(ends_at: datetime | None, now: datetime) -> tuple[HealthCheck, ...]:
    """Check the certificate of the pages, which ends at `ends_at`; nothing if it is good."""
    if ends_at is None or ends_at - now >= CERTIFICATE_LEFT:
        return ()
    date = f"{ends_at:%Y-%m-%d}"
    sentence = text("expires on {date}: renew it, then start this again", date=date)
    if ends_at <= now:
        sentence = text("expired on {date}: renew it, then start this again", date=date)
    return (HealthCheck(text("certificate"), is_good=False, text=sentence),)


class HealthWatch:
    """Checks the health of a station; disk and clock every `LOOK_EVERY_S`.

    `folder`: the files of the records; `utc` and `monotonic_s`: the clocks; `unkept` returns the
    places that lack the last chain heads. `more` makes further checks, with those of the disk.
    """

    def __init__(
        self,
        folder: Path,
        utc: Callable[[], datetime],
        monotonic_s: Callable[[], float],
        unkept: Callable[[], Collection[str]] = tuple,
        more: Callable[[], Collection[HealthCheck]] = tuple,
    ) -> None:
        self._more = more
        self._unkept = unkept
        self._folder = folder
        self._utc = utc
        self._monotonic_s = monotonic_s
        self._offset_s = utc().timestamp() - monotonic_s()
        self._looked_at = float("-inf")
        self._seen: tuple[HealthCheck, ...] = ()

    def look(self, board: Board) -> tuple[HealthCheck, ...]:
        """Run all checks."""
        now = self._monotonic_s()
        if now - self._looked_at >= LOOK_EVERY_S:
            self._looked_at = now
            self._seen = (*self._more(), self._disk(), self._clock())
        sentence = board.records_fault or text("every run is saved")
        checks = [HealthCheck(text("records"), is_good=not board.records_fault, text=sentence)]
        if board.unprinted:
            checks.append(HealthCheck(text("labels"), is_good=False, text=board.unprinted_words))
        if board.lost_scanners:
            sentence = text("cannot be read: {names}", names=few(board.lost_scanners))
            checks.append(HealthCheck(text("scanners"), is_good=False, text=sentence))
        if unkept := self._unkept():
            sentence = text("not stored yet in: {names}", names=few(unkept))
            checks.append(HealthCheck(text("heads"), is_good=False, text=sentence))
        return (*checks, *self._seen)

    def _disk(self) -> HealthCheck:
        try:
            free = shutil.disk_usage(self._folder).free
        except OSError as error:
            return HealthCheck(text("disk"), is_good=False, text=error.strerror or str(error))
        sentence = text("{size:.1f} GiB free", size=free / 1024**3)
        return HealthCheck(text("disk"), is_good=free >= LITTLE_BYTES, text=sentence)

    def _clock(self) -> HealthCheck:
        shift_s = self._utc().timestamp() - self._monotonic_s() - self._offset_s
        if abs(shift_s) <= CLOCK_SHIFT_MAX_S:
            return HealthCheck(text("clock"), is_good=True, text=text("not set since the start"))
        sentence = text("set by {seconds:+.0f} s since the start", seconds=shift_s)
        return HealthCheck(text("clock"), is_good=False, text=sentence)
