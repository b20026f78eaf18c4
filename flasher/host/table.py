"""State table of an upgrade, tool's side: action and next states for every event (appendix 3).

An event is a received message or an expired timer. `TABLE[state][event]` names the action, a method
of `flasher.host.upgrade.UpgradeStage`, and all states and endings to which it may lead. Guards (is
it the current packet, is a try left) and readings (R1 to R28) are in the actions. A missing pair is
a bug. The state diagram in the documentation is drawn from this table.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final, NamedTuple


class UpgradeState(Enum):
    """States of an upgrade on the tool's side; the value is the name in the documentation."""

    __hash__ = object.__hash__  # Enum's own runs Python code at each look-up

    RESETTING = "resetting"
    AWAITING_BOOT = "awaiting boot version"
    WATCHING = "watching the announcements"
    AWAITING_REQUEST = "awaiting request transfer"
    TRANSFERRING = "transferring"
    SETTLING = "settling"
    ENDING = "ending"
    CONFIRMING = "confirming"
    YIELDING = "yielding to another tool"
    STOPPING = "stopping"
    DONE = "done"


class UpgradeEvent(Enum):
    """Events of an upgrade; the value is the name in diagrams."""

    __hash__ = object.__hash__

    FEEDBACK = "general feedback"
    BOOT_VERSION = "boot version"
    REQUEST = "request transfer"
    ACK = "ACK"
    NAK = "NAK"
    COMPLETE = "complete"
    VERSION = "version of the application"
    UNEXPECTED = "message that has no place here"

    RESET_UNANSWERED = "reset not answered"
    BOOT_MISSING = "no boot version in time"
    WATCHED = "only one bootloader announces itself"
    REQUEST_MISSING = "no request transfer in time"
    PACKET_UNANSWERED = "packet not answered"
    QUIET = "no answer to a copy came any more"
    END_UNANSWERED = "end of transfer not answered, or its announcements stopped"
    VERSION_UNANSWERED = "version not answered"
    TOOL_QUIET = "the other tool is silent"

    TWO_DEVICES = "what one device does not send"
    LINK_BACK = "the adapter was lost and is back"
    SECOND_TOOL = "a second tool sends"
    OUT_OF_TIME = "overall deadline"
    CANCEL = "cancelled by the user"


class Ending(Enum):
    """Endings of an upgrade."""

    COMPLETED = "completed"
    CONFIRMED_BY_VERSION = "confirmed_by_version"
    UNCONFIRMED = "unconfirmed"
    OTHER_VERSION = "other_version"
    REFUSED = "refused"
    NO_BOOT_VERSION = "no_boot_version"
    NO_ANNOUNCEMENT = "no_announcement"
    NO_REQUEST = "no_request"
    UNHEARING = "unhearing"
    WRONG_DEVICE = "wrong_device"
    BOOT_TOO_OLD = "boot_too_old"
    TWO_DEVICES = "two_devices"
    NOT_FOR_DEVICE = "not_for_device"
    NOT_TRUSTED = "not_trusted"
    IMPLAUSIBLE = "implausible"
    UNCHECKED = "unchecked"
    IN_USE = "in_use"
    LOW_CHARGE = "low_charge"
    UP_TO_DATE = "up_to_date"
    SECOND_TOOL = "second_tool"
    PACKET_FAILED = "packet_failed"
    RESTARTED = "restarted"
    BROKEN_PROTOCOL = "broken_protocol"
    OUT_OF_TIME = "out_of_time"
    CANCELLED = "cancelled"


class Reason(Enum):
    """Reason why a message or the whole upgrade is repeated."""

    PACKET_REFUSED = "packet_refused"
    PACKET_UNANSWERED = "packet_unanswered"
    PACKET_GIVEN_UP = "packet_given_up"
    """The tries of a packet are exhausted, an attempt is left."""
    REQUEST_AGAIN = "request_again"
    """Request transfer came again before ACK 1."""
    REQUEST_LATE = "request_late"
    """Request transfer came during the transfer."""
    REQUEST_GIVEN_UP = "request_given_up"
    """Request transfer did not come in time, an attempt is left."""
    RESTARTED = "restarted"
    """The device sent a boot version, so it restarted."""
    BOOT_GIVEN_UP = "boot_given_up"
    """A device that received an update command sent no boot version, an attempt is left."""
    BOOT_SILENT = "boot_silent"
    """The device sent neither boot version nor feedback for the erase limit; it gets an update
    command."""
    END_REFUSED = "end_refused"
    """The device answered end of transfer by NAK for the first time."""
    END_UNANSWERED = "end_unanswered"
    SECOND_TOOL = "second_tool"
    """Another tool wrote to the device and is silent now."""
    LINK_BACK = "link_back"
    """The adapter was lost and opened again."""
    QUERY_UNANSWERED = "query_unanswered"


class UpgradeTransition(NamedTuple):
    """Action of an event in a state, and its possible next states and endings."""

    action: str
    leads_to: tuple[UpgradeState | Ending, ...]
    """Next states and endings besides the same state, which is always possible."""


def _do(action: str, *leads_to: UpgradeState | Ending) -> UpgradeTransition:
    return UpgradeTransition(action, leads_to)


IGNORED: Final = _do("ignore")
REPORTED: Final = _do("report")
_Row = dict[UpgradeEvent, UpgradeTransition]
_S, _E, _X = UpgradeState, UpgradeEvent, Ending

_OF_THE_DEVICE: Final = (
    _E.BOOT_VERSION, _E.REQUEST, _E.ACK, _E.NAK, _E.COMPLETE, _E.UNEXPECTED
)  # fmt: skip
_EVERYWHERE: Final[_Row] = {
    # Messages that are not expected.
    **dict.fromkeys(_OF_THE_DEVICE, REPORTED),
    _E.FEEDBACK: IGNORED,
    _E.TWO_DEVICES: _do("end_for_two_devices", _X.TWO_DEVICES),
    _E.LINK_BACK: _do("begin_again", _S.RESETTING),
    _E.SECOND_TOOL: _do("yield_or_end", _S.YIELDING, _X.SECOND_TOOL),
    _E.OUT_OF_TIME: _do(
        "end_out_of_time",
        _X.OUT_OF_TIME, _X.PACKET_FAILED, _X.RESTARTED, _X.NO_REQUEST, _X.NO_BOOT_VERSION,
        _X.NO_ANNOUNCEMENT, _X.UNHEARING, _X.SECOND_TOOL,
    ),
    _E.CANCEL: _do("end_cancelled", _X.CANCELLED),
}  # fmt: skip
_TAKE_BOOT: Final = _do("take_boot", _S.WATCHING, _X.WRONG_DEVICE, _X.BOOT_TOO_OLD, _X.UNCHECKED)
_ANSWERED: Final = _do(
    "take_answer", _S.TRANSFERRING, _S.SETTLING, _S.ENDING, _S.RESETTING, _X.PACKET_FAILED
)
_REQUESTED: Final = _do(
    "take_late_request",
    _S.TRANSFERRING, _S.SETTLING, _S.WATCHING, _S.RESETTING, _X.RESTARTED, _X.PACKET_FAILED,
)  # fmt: skip
_ANNOUNCED: Final = _do("take_boot_in_transfer", _S.WATCHING, _X.WRONG_DEVICE, _X.RESTARTED)
_END_REFUSED: Final = _do("take_end_nak", _S.ENDING, _X.REFUSED)
_COMPLETED: Final = _do("complete", _X.COMPLETED, _X.BROKEN_PROTOCOL)

TABLE: Final[Mapping[UpgradeState, _Row]] = {
    _S.RESETTING: _EVERYWHERE | {
        _E.FEEDBACK: _do("await_boot", _S.AWAITING_BOOT),
        _E.BOOT_VERSION: _TAKE_BOOT,
        # A bootloader does not know the reset (R18): continue.
        _E.RESET_UNANSWERED: _do("repeat_reset", _S.RESETTING, _S.AWAITING_BOOT),
    },
    _S.AWAITING_BOOT: _EVERYWHERE | {
        _E.BOOT_VERSION: _TAKE_BOOT,
        _E.BOOT_MISSING: _do(
            "miss_boot", _S.AWAITING_BOOT, _S.RESETTING, _S.AWAITING_REQUEST,
            _X.NO_BOOT_VERSION, _X.NO_ANNOUNCEMENT, _X.PACKET_FAILED,
        ),
        _E.LINK_BACK: _do("wait_or_begin_again", _S.AWAITING_BOOT, _S.RESETTING),
    },
    # The update command erases: wait briefly for a second bootloader before sending it (R27).
    _S.WATCHING: _EVERYWHERE | {
        _E.BOOT_VERSION: _do("watch_on", _X.WRONG_DEVICE),
        _E.FEEDBACK: _do("watch_on", _S.AWAITING_BOOT),
        _E.WATCHED: _do("answer_boot", _S.AWAITING_REQUEST, _S.RESETTING),
        _E.LINK_BACK: _do("wait_or_begin_again", _S.AWAITING_BOOT, _S.RESETTING),
    },
    # Silence is not answered (R2): the device may be erasing.
    _S.AWAITING_REQUEST: _EVERYWHERE | {
        _E.BOOT_VERSION: _do(
            "answer_boot_again", _S.AWAITING_REQUEST, _S.RESETTING,
            _X.WRONG_DEVICE, _X.UNHEARING, _X.UNCHECKED,
        ),
        _E.REQUEST: _do("send_first_packet", _S.TRANSFERRING),
        _E.REQUEST_MISSING: _do(
            "miss_request", _S.AWAITING_REQUEST, _S.RESETTING, _S.AWAITING_BOOT,
            _X.NO_REQUEST, _X.NO_BOOT_VERSION, _X.PACKET_FAILED, _X.UNHEARING,
        ),
        _E.LINK_BACK: _do("await_request_or_begin_again", _S.AWAITING_REQUEST, _S.RESETTING),
    },
    _S.TRANSFERRING: _EVERYWHERE | {
        _E.ACK: _ANSWERED,
        _E.NAK: _ANSWERED,
        _E.PACKET_UNANSWERED: _do(
            "miss_answer", _S.TRANSFERRING, _S.RESETTING, _X.PACKET_FAILED
        ),
        _E.REQUEST: _REQUESTED,
        _E.BOOT_VERSION: _ANNOUNCED,
        _E.COMPLETE: _do("end_broken", _X.BROKEN_PROTOCOL),
        # A device that already stored the packet answers it again (R10).
        _E.LINK_BACK: _do("resend_packet", _S.TRANSFERRING),
    },
    # A packet was sent more than once, and not every copy is answered: wait, or one late answer
    # would double every later packet (R10).
    _S.SETTLING: _EVERYWHERE | {
        _E.ACK: _ANSWERED,
        _E.NAK: _ANSWERED,
        _E.QUIET: _do(
            "settle", _S.TRANSFERRING, _S.ENDING, _S.RESETTING, _X.PACKET_FAILED
        ),
        _E.REQUEST: _REQUESTED,
        _E.BOOT_VERSION: _ANNOUNCED,
        _E.COMPLETE: _do("end_broken", _X.BROKEN_PROTOCOL),
        _E.LINK_BACK: _do("await_quiet", _S.SETTLING),
    },
    # No boot version is answered from here on: an update command would erase a good image (R11).
    _S.ENDING: _EVERYWHERE | {
        _E.ACK: IGNORED,
        _E.NAK: _END_REFUSED,
        _E.COMPLETE: _COMPLETED,
        _E.END_UNANSWERED: _do("miss_end", _S.ENDING, _S.CONFIRMING, _X.UNCONFIRMED),
        _E.BOOT_VERSION: _do("take_boot_after_end", _S.WATCHING, _X.RESTARTED),
        # Every packet is acknowledged: only the end is missing.
        _E.LINK_BACK: _do("resend_end", _S.ENDING),
    },
    _S.CONFIRMING: _EVERYWHERE | {
        _E.ACK: IGNORED,
        _E.NAK: _END_REFUSED,
        _E.COMPLETE: _COMPLETED,
        _E.VERSION: _do(
            "judge_version", _X.CONFIRMED_BY_VERSION, _X.OTHER_VERSION, _X.UNCONFIRMED
        ),
        _E.VERSION_UNANSWERED: _do("miss_version", _S.CONFIRMING, _X.UNCONFIRMED),
        _E.BOOT_VERSION: _do("take_boot_after_end", _S.WATCHING, _X.RESTARTED),
        _E.LINK_BACK: _do("query_version", _S.CONFIRMING),
    },
    # Send nothing, whatever the device answers to the other tool.
    _S.YIELDING: _EVERYWHERE | dict.fromkeys(_OF_THE_DEVICE, IGNORED) | {
        _E.TOOL_QUIET: _do("take_turn", _S.RESETTING),
        _E.LINK_BACK: _do("yield_on", _S.YIELDING),
    },
    # The outcome is known; finish a partly sent message, and ignore everything received.
    _S.STOPPING: {},
    _S.DONE: {},
}  # fmt: skip

TIMERS: Final[Mapping[UpgradeState, UpgradeEvent]] = {
    _S.RESETTING: _E.RESET_UNANSWERED,
    _S.AWAITING_BOOT: _E.BOOT_MISSING,
    _S.WATCHING: _E.WATCHED,
    _S.AWAITING_REQUEST: _E.REQUEST_MISSING,
    _S.TRANSFERRING: _E.PACKET_UNANSWERED,
    _S.SETTLING: _E.QUIET,
    _S.ENDING: _E.END_UNANSWERED,
    _S.CONFIRMING: _E.VERSION_UNANSWERED,
    _S.YIELDING: _E.TOOL_QUIET,
}
"""Event of each state's timer."""
