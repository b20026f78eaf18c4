"""State table of an upgrade on the device's side: action and next state for every event.

A received message or an expired timer becomes a `BootloaderEvent` (see `model`, which also applies
the profile's choices). `TABLE[state][event]` names the action, a method of
`flasher.mock.model.MockDevice`, and the next state. A missing pair is a bug. The state diagram in
the documentation is drawn from this table.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final, NamedTuple


class BootloaderState(Enum):
    """States of the device model; the value is the name in the documentation."""

    __hash__ = object.__hash__  # Enum's own runs Python code at each look-up

    OFF = "off"
    APPLICATION = "application"
    RESTARTING = "restarting"
    ANNOUNCING = "announcing"
    ERASING = "erasing"
    TRANSFER = "transfer"
    PROGRAMMING = "programming"
    CHECKING = "checking"
    STARTING = "starting"
    REFUSED = "refused"


class BootloaderEvent(Enum):
    """Classified message or expired timer; the value is the name in diagrams."""

    __hash__ = object.__hash__

    # Messages.
    RESET = "reset"
    RESET_IGNORED = "reset that the bootloader ignores"
    QUERY = "query or write of the application"
    UPGRADE_IN_APPLICATION = "upgrade message for the running application"
    UPDATE = "update command"
    UPDATE_AGAIN = "update command repeated"
    UPDATE_REFUSED = "update command that is refused"
    PACKET_NEXT = "packet that is next"
    PACKET_REPEATED = "packet stored last"
    PACKET_OLDER = "packet stored before"
    PACKET_BAD = "damaged or impossible packet"
    END_WHOLE = "end of transfer, image right"
    END_WRONG = "end of transfer, image checksum wrong"
    END_EARLY = "end of transfer, packets missing"
    END_AGAIN = "end of transfer repeated"
    OUT_OF_TURN = "packet or end of transfer out of turn"
    NO_CONCERN = "message of no concern"
    # Timers.
    RESTART_DUE = "restart delay over"
    ANNOUNCEMENT_DUE = "announcement due"
    WINDOW_OVER = "window over, application whole"
    FLASH_DONE = "flash operations done"
    PAUSE_OVER = "pause too long"
    HOLD_OVER = "refusal held"
    START_DUE = "start delay over"
    START_BY_RESTART_DUE = "start delay over, starts through the bootloader"
    # Power.
    POWER_CUT = "power cut"
    POWER_ON = "power on"


_S, _E = BootloaderState, BootloaderEvent


class BootloaderTransition(NamedTuple):
    """Action of an event in a state, and the next state (None for the same)."""

    action: str
    state: BootloaderState | None = None


IGNORED: Final = BootloaderTransition("ignore")
_Row = dict[BootloaderEvent, BootloaderTransition]

_POWERED: Final[_Row] = {
    _E.POWER_CUT: BootloaderTransition("switch_off", _S.OFF),
    _E.POWER_ON: IGNORED,
}
_HEARING: Final[_Row] = _POWERED | dict.fromkeys((_E.RESET, _E.QUERY, _E.NO_CONCERN), IGNORED)
_IN_SESSION: Final[_Row] = _HEARING | {
    _E.RESET_IGNORED: IGNORED,
    _E.UPDATE_REFUSED: BootloaderTransition("refuse_update"),
}
_IN_BOOTLOADER: Final[_Row] = _IN_SESSION | {_E.OUT_OF_TURN: IGNORED}
_RESTARTED: Final = BootloaderTransition("restart", _S.RESTARTING)
_ERASED: Final = BootloaderTransition("erase", _S.ERASING)
_BOOTED: Final = BootloaderTransition("boot", _S.ANNOUNCING)

TABLE: Final[Mapping[BootloaderState, _Row]] = {
    # No power, no reception.
    _S.OFF: {_E.POWER_ON: _RESTARTED, _E.POWER_CUT: IGNORED},
    # Nothing here erases (UP-03).
    _S.APPLICATION: _HEARING | {
        _E.RESET: BootloaderTransition("confirm_reset", _S.RESTARTING),
        _E.QUERY: BootloaderTransition("answer"),
        _E.UPGRADE_IN_APPLICATION: BootloaderTransition("send_feedback"),
    },
    # Receives nothing: a second reset does not restart it twice (RS-02).
    _S.RESTARTING: _POWERED | {_E.RESTART_DUE: _BOOTED},
    # Announces and listens, then listens for the window.
    _S.ANNOUNCING: _IN_BOOTLOADER | {
        _E.RESET: _RESTARTED,
        _E.UPDATE: _ERASED,
        _E.ANNOUNCEMENT_DUE: BootloaderTransition("announce"),
        _E.WINDOW_OVER: BootloaderTransition("start", _S.APPLICATION),
    },
    _S.ERASING: _IN_BOOTLOADER | {
        _E.RESET: _RESTARTED,
        _E.UPDATE: _ERASED,
        _E.UPDATE_AGAIN: IGNORED,
        _E.FLASH_DONE: BootloaderTransition("request", _S.TRANSFER),
    },
    _S.TRANSFER: _IN_SESSION | {
        _E.RESET: _RESTARTED,
        _E.UPDATE: _ERASED,
        _E.UPDATE_AGAIN: BootloaderTransition("request"),
        _E.PACKET_NEXT: BootloaderTransition("store", _S.PROGRAMMING),
        _E.PACKET_REPEATED: BootloaderTransition("answer_repeated"),
        _E.PACKET_OLDER: BootloaderTransition("answer_older"),
        _E.PACKET_BAD: BootloaderTransition("answer_bad"),
        _E.END_EARLY: BootloaderTransition("refuse_end"),
        _E.END_WHOLE: BootloaderTransition("record", _S.CHECKING),
        _E.END_WRONG: BootloaderTransition("refuse_end", _S.REFUSED),
        _E.PAUSE_OVER: _BOOTED,
    },
    _S.PROGRAMMING: _IN_BOOTLOADER | {
        _E.RESET: _RESTARTED,
        _E.UPDATE: _ERASED,
        _E.FLASH_DONE: BootloaderTransition("acknowledge", _S.TRANSFER),
    },
    _S.CHECKING: _IN_BOOTLOADER | {
        _E.RESET: _RESTARTED,
        _E.END_AGAIN: IGNORED,
        _E.FLASH_DONE: BootloaderTransition("complete", _S.STARTING),
    },
    # On its way to the application: an update command would erase what was just completed.
    _S.STARTING: _IN_BOOTLOADER | {
        _E.END_AGAIN: BootloaderTransition("complete_again"),
        _E.START_DUE: BootloaderTransition("start", _S.APPLICATION),
        _E.START_BY_RESTART_DUE: _BOOTED,
    },
    # Repeats its answer for a host that asks once more (R6), then can be rescued (EN-04).
    _S.REFUSED: _IN_BOOTLOADER | {
        _E.RESET: _RESTARTED,
        _E.UPDATE: _ERASED,
        _E.END_AGAIN: BootloaderTransition("refuse_end_again"),
        _E.HOLD_OVER: _BOOTED,
    },
}  # fmt: skip
