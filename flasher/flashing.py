"""Runs a session on a connection, and looks after the adapter meanwhile.

An adapter that fails is opened again for as long as it may take, and the session begins another
attempt; a bus on which nobody acknowledges is told from a device that is silent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from flasher import events
from flasher.bus.health import LinkHealth, TroubleKind, bus_off_error
from flasher.bus.link import Clock, Link
from flasher.driver import Tap, drive
from flasher.errors import (
    BusError,
    FlasherError,
    InterruptedByUserError,
    NoAnswerError,
    TransmitBlockedError,
)
from flasher.host.outcome import AGAIN
from flasher.host.session import Result, Session
from flasher.protocol.frame import Frame

_WAS_OFF: Final = frozenset({TroubleKind.BUS_OFF, TroubleKind.RESTARTED})
_REOPEN_PAUSE_S: Final = 0.1
"""Between two tries to open a lost adapter again."""


def run_session(
    session: Session,
    link: Link,
    clock: Clock,
    *,
    adapter_return_s: float,
    taps: Sequence[Tap] = (),
    on_event: Callable[[object], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    hung_up: Callable[[], bool] | None = None,
) -> Result:
    """Run a session to its end, good or bad. `cancelled` ends it, `hung_up` only as long as the
    device was not told to erase its application: then nobody has to be there.

    A lost adapter is opened again for `adapter_return_s` while the session has an attempt left.
    Raises BusError, saying how far it had come and in what state the device is left, when the
    adapter fails for good or nobody on the bus acknowledges; InterruptedByUserError when the user
    interrupts a second time.
    """
    tell = on_event or (lambda _event: None)
    if hung_up is not None:
        cancelled = _unless_begun(session, cancelled or (lambda: False), hung_up)
    before = link.health()
    _check_bus(link, "before anything was sent", session, before)
    try:
        while True:
            try:
                watched = (*taps, _end_when_off(link))
                drive(session, link, clock, taps=watched, on_event=on_event, cancelled=cancelled)
                break
            except BusError as error:
                if not _came_back(error, session, link, clock, adapter_return_s, tell, cancelled):
                    raise
    except (BusError, InterruptedByUserError) as error:
        # The adapter does not know what it was used for.
        error.where = f"{session.standing}; {error.where}".removesuffix("; ")
        _say_what_is_left(error, session)
        raise
    except KeyboardInterrupt as interrupt:
        interrupted = InterruptedByUserError(
            "Interrupted at once.",
            where=session.standing,
            cause="it may have ended in the middle of a message",
            remedy=AGAIN,
        )
        _say_what_is_left(interrupted, session)
        raise interrupted from interrupt
    result = session.result
    silence = result.error()
    if isinstance(silence, NoAnswerError):
        _check_bus(link, silence.where, session, before)
    return result


def _end_when_off(link: Link) -> Tap:
    """A tap that raises BusError as soon as the adapter reports bus-off: what the device says until
    it is back is lost, and there is no use in waiting for it.
    """

    def look(frame: Frame, *, sent: bool, now: float) -> None:  # noqa: ARG001  of a tap
        if frame.is_error and link.is_off:
            raise bus_off_error(str(link))

    return look


def _unless_begun(
    session: Session, cancelled: Callable[[], bool], hung_up: Callable[[], bool]
) -> Callable[[], bool]:
    return lambda: cancelled() or (hung_up() and not session.has_begun_to_erase)


def _check_bus(link: Link, where: str, session: Session, before: LinkHealth) -> None:
    """Raise BusError when it is the bus that is silent, not the device, or when the adapter was
    off the bus since `before` and came back by itself: what was sent and said meanwhile is lost.
    """
    health, where = link.health(), f"{where}; {link}"
    error, trouble = health.error(where), health.last_trouble
    is_new = trouble is not before.last_trouble
    if error is None and is_new and trouble is not None and trouble.kinds & _WAS_OFF:
        error = bus_off_error(where, "The adapter was off the bus for a while.")
    if error is not None:
        _say_what_is_left(error, session)
        raise error


def _say_what_is_left(error: FlasherError, session: Session) -> None:
    left = session.device_left
    error.remedy = f"{error.remedy} State of the device: {left.value}.".lstrip()
    error.needs_rescue = left.needs_rescue


def _came_back(
    error: BusError,
    session: Session,
    link: Link,
    clock: Clock,
    wait_s: float,
    tell: Callable[[object], None],
    cancelled: Callable[[], bool] | None,
) -> bool:
    """Try to open a lost adapter again, within the overall deadline and until the user has enough.
    A bus that takes no frame is no lost adapter.
    """
    if isinstance(error, TransmitBlockedError) or not session.may_begin_again or not wait_s:
        return False
    tell(events.AdapterLost(error.what, wait_s))
    give_up_at = clock.now() + wait_s
    if session.deadline_at is not None:
        give_up_at = min(give_up_at, session.deadline_at)
    while True:
        if cancelled is not None and cancelled():
            raise InterruptedByUserError(
                "Interrupted while the adapter was away.",
                where=error.where,
                cause=error.what,
                remedy="Plug the adapter in, then run the same command again.",
            ) from error
        try:
            link.reopen()
        except BusError:
            if clock.now() >= give_up_at:
                return False
            clock.wait_until(min(give_up_at, clock.now() + _REOPEN_PAUSE_S))
        else:
            tell(events.AdapterBack())
            session.link_back(clock.now())
            return True
