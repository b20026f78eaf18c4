"""The rest of the catalogue: what software cannot do, and what concerns the host alone."""

from __future__ import annotations

from typing import Final

NOT_IMPLEMENTED: Final[dict[str, str]] = {}
"""Case of the bootloader to the reason why it cannot be run; reported as unsupported."""

HOST_CASES: Final = (
    *("RS-06", "RS-07", "RS-08", "RS-09"),
    "UP-07",
    *("TX-09", "TX-10", "TX-11"),
    *("EN-03", "EN-05", "EN-06"),
    *("TM-01", "TM-03", "TM-04"),
    *("BU-03", "BU-04", "BU-05"),
    "PW-03",
    "SE-02",
    "CO-03",
)
"""Cases of the host: they run against flasher's own host, in the project's tests."""
