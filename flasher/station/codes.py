"""Result codes of runs, each with its outcome, meaning and the operator's action.

The records store codes: the meaning of a code never changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from flasher.host.table import Ending
from flasher.i18n import text
from flasher.station.records.model import RunState

_NEXT: Final = text("Take the unit out.")
_REPAIR: Final = text("Put the unit aside as bad, with this code on its tag.")
_TECHNICIAN: Final = text("Call the technician; the unit has no verdict.")


class Code(NamedTuple):
    """A result code. `may_retry` is False if another try cannot help or could do harm."""

    name: str
    outcome: RunState
    meaning: str
    action: str
    may_retry: bool = True


def _fail(name: str, meaning: str, action: str = _REPAIR, *, may_retry: bool = True) -> Code:
    return Code(name, RunState.FAIL, meaning, action, may_retry)


def _error(name: str, meaning: str, action: str = _TECHNICIAN, *, may_retry: bool = False) -> Code:
    return Code(name, RunState.ERROR, meaning, action, may_retry)


OK: Final = Code(
    "OK", RunState.PASS, text("done and verified as the recipe requires"), _NEXT, may_retry=False
)
OPERATOR_ABORT: Final = Code(
    "OPERATOR_ABORT",
    RunState.ABORTED,
    text("a person stopped the run"),
    text("Scan the unit again to finish it."),
    may_retry=False,
)

# -- the unit -------------------------------------------------------------------------------------

NO_ANSWER: Final = _fail(
    "NO_ANSWER",
    text("the unit does not answer"),
    text("Check its plug and its key, then scan it again."),
)
WRONG_HARDWARE: Final = _fail(
    "WRONG_HARDWARE",
    text("the hardware is not one that the recipe lists"),
    text("Put the unit aside: it belongs to another recipe."),
    may_retry=False,
)
OLD_VERSION: Final = _fail(
    "OLD_VERSION",
    text("the version that runs now must not be replaced by this one"),
    text("Put the unit aside: it belongs to another recipe."),
    may_retry=False,
)
OLD_RELEASE: Final = _fail(
    "OLD_RELEASE",
    text("the unit has received a newer release than this one"),
    text("Put the unit aside: it needs a recipe with the newest release."),
    may_retry=False,
)
IN_USE: Final = _fail(
    "IN_USE", text("the battery supplies current"), text("Switch its loads off, then scan again.")
)
LOW_CHARGE: Final = _fail(
    "LOW_CHARGE",
    text("the battery is nearly empty"),
    text("Charge it, or connect its charger, then scan again."),
)
NOT_FOR_DEVICE: Final = _fail(
    "NOT_FOR_DEVICE",
    text("the image is not meant for this device, or its bootloader is not the right one"),
    text("Put the unit aside: it belongs to another recipe."),
    may_retry=False,
)
NO_BOOTLOADER: Final = _fail("NO_BOOTLOADER", text("its bootloader does not announce itself"))
ERASE_FAILED: Final = _fail("ERASE_FAILED", text("the bootloader does not begin the transfer"))
TRANSFER_FAILED: Final = _fail("TRANSFER_FAILED", text("the transfer failed"))
REFUSED: Final = _fail("REFUSED", text("the device refused the image at the end"), may_retry=False)
UNCONFIRMED: Final = _fail("UNCONFIRMED", text("the bootloader did not send its final answer"))
OTHER_VERSION: Final = _fail(
    "OTHER_VERSION", text("the device runs another version than the image")
)
NOT_RUNNING: Final = _fail("NOT_RUNNING", text("the new application does not answer"))
IN_BOOTLOADER: Final = _fail(
    "IN_BOOTLOADER", text("a bootloader keeps announcing itself and no application answers")
)
MEMORY_DIFFERS: Final = _fail("MEMORY_DIFFERS", text("the memory differs from the image"))
WRITE_FAILED: Final = _fail("WRITE_FAILED", text("the device does not confirm a write"))
WRITE_DIFFERS: Final = _fail("WRITE_DIFFERS", text("a field reads back differently than written"))
CHANGED: Final = _fail("CHANGED", text("a field that must not change has changed"), may_retry=False)
UNCHANGED_UNKNOWN: Final = _fail(
    "UNCHANGED_UNKNOWN",
    text("a field that must not change could not be read before the first write"),
    text("Put the unit aside: nothing was written, but it has no application to read from."),
    may_retry=False,
)
LIMIT: Final = _fail("LIMIT", text("a measurement is out of its limits"))
TOO_SLOW: Final = _fail("TOO_SLOW", text("a step took longer than the recipe allows"))
NO_RESTART: Final = _fail("NO_RESTART", text("the device did not restart"))

# -- the station ----------------------------------------------------------------------------------

WRONG_UNIT: Final = _error(
    "WRONG_UNIT",
    text("the unit's own serial number is not the one on the label"),
    text("Compare label and unit: scan the label of the unit that is in the socket."),
)
NO_CARD: Final = _error(
    "NO_CARD",
    text(
        "the unit cannot identify itself, and its label was scanned without the card of its socket"
    ),
    text("Scan the card of the socket that the unit is in, then the label again."),
)
UNIT_CHANGED: Final = _error(
    "UNIT_CHANGED",
    text("the unit in the socket may be another one than at the beginning of the run"),
    text("Put the unit of this label into the socket, and scan the label again."),
)
NOT_OBSERVED: Final = _error(
    "NOT_OBSERVED",
    text(
        "the computer stalled or its adapter was away, and the station could not observe whether"
        " the unit stayed in the socket"
    ),
    text("Scan the unit again; it has no verdict."),
)
TWO_DEVICES: Final = _error(
    "TWO_DEVICES",
    text("two devices of one kind answer"),
    text("Connect one unit to this socket only."),
)
SECOND_TOOL: Final = _error(
    "SECOND_TOOL",
    text("another tool sends on the bus"),
    text("Disconnect the other tool, then scan again."),
)
BUS: Final = _error(
    "BUS",
    text("the adapter or the bus failed"),
    text("Check the plugs of adapter and unit, then scan again."),
    may_retry=True,
)
POWER: Final = _error("POWER", text("the power command failed"), may_retry=True)
CANNOT_VERIFY: Final = _error(
    "CANNOT_VERIFY",
    text("a target has no version query: only a new flash can verify it"),
)
RECIPE: Final = _error("RECIPE", text("the recipe does not fit its own images or this unit"))
NOT_TRUSTED: Final = _error(
    "NOT_TRUSTED", text("the trust file of this computer does not allow the image")
)
RECORD_NOT_SAVED: Final = _error("RECORD_NOT_SAVED", text("the records could not be written"))
TRACE_NOT_SAVED: Final = _error(
    "TRACE_NOT_SAVED", text("the trace of the bus could not be written")
)
PROCESS_DIED: Final = _error(
    "PROCESS_DIED",
    text("the process of the socket ended"),
    text("Scan the unit again; it has no verdict."),
)
PROCESS_HUNG: Final = _error(
    "PROCESS_HUNG",
    text("the process of the socket hung"),
    text("Scan the unit again; it has no verdict."),
)
INTERNAL: Final = _error("INTERNAL", text("an internal error: a bug of flasher"))

CODES: Final[Mapping[str, Code]] = {
    value.name: value for value in tuple(globals().values()) if isinstance(value, Code)
}
"""All codes by name."""

OF_ENDING: Final[Mapping[Ending, Code]] = {
    Ending.UNCONFIRMED: UNCONFIRMED,
    Ending.OTHER_VERSION: OTHER_VERSION,
    Ending.REFUSED: REFUSED,
    Ending.NO_BOOT_VERSION: NO_BOOTLOADER,
    Ending.NO_ANNOUNCEMENT: NO_BOOTLOADER,
    Ending.NO_REQUEST: ERASE_FAILED,
    Ending.UNHEARING: ERASE_FAILED,
    Ending.WRONG_DEVICE: NOT_FOR_DEVICE,
    Ending.BOOT_TOO_OLD: NOT_FOR_DEVICE,
    Ending.NOT_FOR_DEVICE: NOT_FOR_DEVICE,
    Ending.NOT_TRUSTED: NOT_TRUSTED,
    Ending.IMPLAUSIBLE: NOT_FOR_DEVICE,
    Ending.TWO_DEVICES: TWO_DEVICES,
    Ending.IN_USE: IN_USE,
    Ending.LOW_CHARGE: LOW_CHARGE,
    Ending.SECOND_TOOL: SECOND_TOOL,
    Ending.PACKET_FAILED: TRANSFER_FAILED,
    Ending.RESTARTED: TRANSFER_FAILED,
    Ending.BROKEN_PROTOCOL: TRANSFER_FAILED,
    Ending.OUT_OF_TIME: TOO_SLOW,
    Ending.CANCELLED: OPERATOR_ABORT,
    Ending.UP_TO_DATE: RECIPE,
}
"""Codes of failed upgrades, by the upgrade's ending."""
NEED_POWER_CYCLE: Final = frozenset({NO_BOOTLOADER, ERASE_FAILED, TRANSFER_FAILED})
"""Codes after which a power cycle may reach the bootloader again."""
OF_ANOTHER: Final = frozenset({UNIT_CHANGED.name, NOT_OBSERVED.name})
"""Names of codes after which another unit may be in the socket."""
OF_SILENCE: Final = frozenset({NO_ANSWER, NOT_RUNNING, WRITE_FAILED, NO_BOOTLOADER, NO_RESTART})
"""Codes of a unit that stopped answering."""
