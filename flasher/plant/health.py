"""Checks for the operator page whether a station's records reach the plant."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from textwrap import shorten
from typing import Final

from flasher.errors import FlasherError
from flasher.i18n import text
from flasher.plant.forwarder import ForwarderState, load_state
from flasher.plant.process import RETRY_MAX_S
from flasher.protocol.text import printable
from flasher.station.health import HealthCheck
from flasher.station.records.model import utc_moment

STALE_S: Final = 4 * RETRY_MAX_S
"""Age of the last attempt after which the process that sends is regarded as dead."""
_REASON_MAX: Final = 120
"""Characters on the operator page."""


def checks(
    folder: Path, station: str, now: datetime, clock_offset_max_s: float
) -> tuple[HealthCheck, ...]:
    """Check the state that a station's forwarder wrote into the folder of the records' files."""
    try:
        state = load_state(folder, station)
    except FlasherError as error:
        return (HealthCheck(text("plant"), is_good=False, text=error.what),)
    return _sending(state, now), _clock(state.clock_offset_s, clock_offset_max_s)


def _clock(offset_s: float | None, most_s: float) -> HealthCheck:
    name = text("plant's clock")
    if offset_s is None:
        return HealthCheck(name, is_good=False, text=text("not compared yet"))
    sentence = text("this computer's differs by {seconds:+.1f} s", seconds=offset_s)
    return HealthCheck(name, is_good=abs(offset_s) <= most_s, text=sentence)


def _sending(state: ForwarderState, now: datetime) -> HealthCheck:
    name = text("plant")
    if state.refusal:
        sentence = text("REFUSED by the plant: {reason}", reason=printable(state.refusal))
    elif not state.at or abs((now - utc_moment(state.at)).total_seconds()) > STALE_S:
        sentence = text("the process that sends to the plant does not report")
    elif state.fault:
        sentence = text(
            "{count} rows wait: sending to the plant failed: {reason}",
            count=state.unsent,
            reason=shorten(printable(state.fault), _REASON_MAX, placeholder="..."),
        )
    else:
        return HealthCheck(name, is_good=True, text=text("sent to the plant"))
    return HealthCheck(name, is_good=False, text=sentence)
