"""When a golden unit is due: a known good unit must pass on a socket before it goes on."""

from __future__ import annotations

from datetime import datetime, timedelta

from flasher.station.recipe import Golden


def is_due(rule: Golden, last_pass: datetime | None, now: datetime) -> bool:
    """True when a golden unit has to pass first. `last_pass` is when one last did on this socket.

    `now` has the time zone of the clock on the wall, in which the shifts start.
    """
    if last_pass is None:
        return True
    if rule.every_h is not None and now - last_pass >= timedelta(hours=rule.every_h):
        return True
    start = last_shift_start(rule, now)
    return start is not None and last_pass < start


def last_shift_start(rule: Golden, now: datetime) -> datetime | None:
    """When the shift that runs at `now` began; None where the rule names no shifts."""
    starts = [
        datetime.combine(now.date() - timedelta(days=days), start, now.tzinfo)
        for start in rule.shift_starts
        for days in (0, 1)
    ]
    return max((start for start in starts if start <= now), default=None)
