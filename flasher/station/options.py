"""What may be set of a station, and whether its sockets and its records belong together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.errors import UsageError
from flasher.station.line import ARRIVAL_LIMIT_S, SCAN_LIMIT_S
from flasher.station.supervisor import HANG_S

_APART: Final = (
    "Keep records of virtual units in a database of their own; --mix-virtual has them in one."
)


@dataclass(frozen=True)
class StationOptions:
    """What may be set; the defaults are for a line with people."""

    arrival_limit_s: float = ARRIVAL_LIMIT_S
    scan_limit_s: float = SCAN_LIMIT_S
    """Both as `flasher.station.line.Line` has them."""
    hang_s: float = HANG_S
    end_limit_s: float = 30.0
    """How long runs may take to end when the station is ended."""
    scans_labels: bool = False
    """Virtual units are scanned by themselves."""
    mixes_virtual: bool = False
    """Real and virtual units may share the records; one serial number is never both."""


def check_natures(known: frozenset[bool], own: frozenset[bool], options: StationOptions) -> None:
    """Whether sockets may use records that know virtual units (True), real ones (False); `own`:
    the same of the sockets.

    Raises UsageError: a PASS of a virtual unit must not be taken for one of a product.
    """
    if options.mixes_virtual or len(own | known) < len((True, False)):
        return
    if len(own) > 1:
        what = "Some sockets of this station have adapters, others have virtual units."
    elif True in own:
        what = "These records hold real units, and this station has virtual ones."
    else:
        what = "These records hold virtual units, and this station has adapters."
    raise UsageError(what, remedy=_APART)
