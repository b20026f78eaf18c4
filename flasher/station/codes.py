"""Result codes of runs, each with its outcome, meaning and the operator's action.

The records store codes: the meaning of a code never changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final

from flasher.host.table import Ending
from flasher.i18n import text
from flasher.station.records.model import RunState

_NEXT: Final = text("Take the unit out.")
_REPAIR: Final = text("Put the unit aside as bad, with this code on its tag.")
_TECHNICIAN: Final = text("Call the technician; the unit has no verdict.")
_Values = tuple[RunState, str, str, bool]
"""Outcome, meaning, action, and `may_retry`."""


def _fail(meaning: str, action: str = _REPAIR, *, may_retry: bool = True) -> _Values:
    return RunState.FAIL, meaning, action, may_retry


def _error(meaning: str, action: str = _TECHNICIAN, *, may_retry: bool = False) -> _Values:
    return RunState.ERROR, meaning, action, may_retry


class Code(Enum):
    """A result code. `may_retry` is False if another try cannot help or could do harm."""

    def __init__(self, *values: *_Values) -> None:
        self.outcome, self.meaning, self.action, self.may_retry = values

    OK = RunState.PASS, text("done and verified as the recipe requires"), _NEXT, False
    OPERATOR_ABORT = (
        RunState.ABORTED,
        text("a person stopped the run"),
        text("Scan the unit again to finish it."),
        False,
    )

    # -- the unit ---------------------------------------------------------------------------------

    NO_ANSWER = _fail(
        text("the unit does not answer"), text("Check its plug and its key, then scan it again.")
    )
    WRONG_HARDWARE = _fail(
        text("the hardware is not one that the recipe lists"),
        text("Put the unit aside: it belongs to another recipe."),
        may_retry=False,
    )
    OLD_VERSION = _fail(
        text("the version that runs now must not be replaced by this one"),
        text("Put the unit aside: it belongs to another recipe."),
        may_retry=False,
    )
    OLD_RELEASE = _fail(
        text("the unit has received a newer release than this one"),
        text("Put the unit aside: it needs a recipe with the newest release."),
        may_retry=False,
    )
    IN_USE = _fail(
        text("the battery supplies current"), text("Switch its loads off, then scan again.")
    )
    LOW_CHARGE = _fail(
        text("the battery is nearly empty"),
        text("Charge it, or connect its charger, then scan again."),
    )
    NOT_FOR_DEVICE = _fail(
        text("the image is not meant for this device, or its bootloader is not the right one"),
        text("Put the unit aside: it belongs to another recipe."),
        may_retry=False,
    )
    NO_BOOTLOADER = _fail(text("its bootloader does not announce itself"))
    ERASE_FAILED = _fail(text("the bootloader does not begin the transfer"))
    TRANSFER_FAILED = _fail(text("the transfer failed"))
    REFUSED = _fail(text("the device refused the image at the end"), may_retry=False)
    UNCONFIRMED = _fail(text("the bootloader did not send its final answer"))
    OTHER_VERSION = _fail(text("the device runs another version than the image"))
    NOT_RUNNING = _fail(text("the new application does not answer"))
    IN_BOOTLOADER = _fail(text("a bootloader keeps announcing itself and no application answers"))
    MEMORY_DIFFERS = _fail(text("the memory differs from the image"))
    WRITE_FAILED = _fail(text("the device does not confirm a write"))
    WRITE_DIFFERS = _fail(text("a field reads back differently than written"))
    CHANGED = _fail(text("a field that must not change has changed"), may_retry=False)
    UNCHANGED_UNKNOWN = _fail(
        text("a field that must not change could not be read before the first write"),
        text("Put the unit aside: nothing was written, but it has no application to read from."),
        may_retry=False,
    )
    LIMIT = _fail(text("a measurement is out of its limits"))
    TOO_SLOW = _fail(text("a step took longer than the recipe allows"))
    NO_RESTART = _fail(text("the device did not restart"))

    # -- the station ------------------------------------------------------------------------------

    WRONG_UNIT = _error(
        text("the unit's own serial number is not the one on the label"),
        text("Compare label and unit: scan the label of the unit that is in the socket."),
    )
    NO_CARD = _error(
        text(
            "the unit cannot identify itself, and its label was scanned without the card of its"
            " socket"
        ),
        text("Scan the card of the socket that the unit is in, then the label again."),
    )
    UNIT_CHANGED = _error(
        text("the unit in the socket may be another one than at the beginning of the run"),
        text("Put the unit of this label into the socket, and scan the label again."),
    )
    NOT_OBSERVED = _error(
        text(
            "the computer stalled or its adapter was away, and the station could not observe"
            " whether the unit stayed in the socket"
        ),
        text("Scan the unit again; it has no verdict."),
    )
    TWO_DEVICES = _error(
        text("two devices of one kind answer"), text("Connect one unit to this socket only.")
    )
    SECOND_TOOL = _error(
        text("another tool sends on the bus"), text("Disconnect the other tool, then scan again.")
    )
    BUS = _error(
        text("the adapter or the bus failed"),
        text("Check the plugs of adapter and unit, then scan again."),
        may_retry=True,
    )
    POWER = _error(text("the power command failed"), may_retry=True)
    CANNOT_VERIFY = _error(text("a target has no version query: only a new flash can verify it"))
    RECIPE = _error(text("the recipe does not fit its own images or this unit"))
    NOT_TRUSTED = _error(text("the trust file of this computer does not allow the image"))
    RECORD_NOT_SAVED = _error(text("the records could not be written"))
    TRACE_NOT_SAVED = _error(text("the trace of the bus could not be written"))
    PROCESS_DIED = _error(
        text("the process of the socket ended"), text("Scan the unit again; it has no verdict.")
    )
    PROCESS_HUNG = _error(
        text("the process of the socket hung"), text("Scan the unit again; it has no verdict.")
    )
    INTERNAL = _error(text("an internal error: a bug of flasher"))


CODES: Final[Mapping[str, Code]] = Code.__members__
"""All codes by name."""

OF_ENDING: Final[Mapping[Ending, Code]] = {
    Ending.UNCONFIRMED: Code.UNCONFIRMED,
    Ending.OTHER_VERSION: Code.OTHER_VERSION,
    Ending.REFUSED: Code.REFUSED,
    Ending.NO_BOOT_VERSION: Code.NO_BOOTLOADER,
    Ending.NO_ANNOUNCEMENT: Code.NO_BOOTLOADER,
    Ending.NO_REQUEST: Code.ERASE_FAILED,
    Ending.UNHEARING: Code.ERASE_FAILED,
    Ending.WRONG_DEVICE: Code.NOT_FOR_DEVICE,
    Ending.BOOT_TOO_OLD: Code.NOT_FOR_DEVICE,
    Ending.NOT_FOR_DEVICE: Code.NOT_FOR_DEVICE,
    Ending.NOT_TRUSTED: Code.NOT_TRUSTED,
    Ending.IMPLAUSIBLE: Code.NOT_FOR_DEVICE,
    Ending.TWO_DEVICES: Code.TWO_DEVICES,
    Ending.IN_USE: Code.IN_USE,
    Ending.LOW_CHARGE: Code.LOW_CHARGE,
    Ending.SECOND_TOOL: Code.SECOND_TOOL,
    Ending.PACKET_FAILED: Code.TRANSFER_FAILED,
    Ending.RESTARTED: Code.TRANSFER_FAILED,
    Ending.BROKEN_PROTOCOL: Code.TRANSFER_FAILED,
    Ending.OUT_OF_TIME: Code.TOO_SLOW,
    Ending.CANCELLED: Code.OPERATOR_ABORT,
    Ending.UP_TO_DATE: Code.RECIPE,
}
"""Codes of failed upgrades, by the upgrade's ending."""
NEED_POWER_CYCLE: Final = frozenset({Code.NO_BOOTLOADER, Code.ERASE_FAILED, Code.TRANSFER_FAILED})
"""Codes after which a power cycle may reach the bootloader again."""
OF_ANOTHER: Final = frozenset({Code.UNIT_CHANGED.name, Code.NOT_OBSERVED.name})
"""Names of codes after which another unit may be in the socket."""
OF_SILENCE: Final = frozenset(
    {Code.NO_ANSWER, Code.NOT_RUNNING, Code.WRITE_FAILED, Code.NO_BOOTLOADER, Code.NO_RESTART}
)
"""Codes of a unit that stopped answering."""
