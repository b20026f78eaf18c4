"""What a service program asks a device on an open connection: read, write, memory, info, scan.

Blocking functions with typed results. `connection` is what `flasher.connect` and
`flasher.connect_mock` give. Every function takes the keywords of `Manner` as well, and raises
BusError when the adapter fails and InterruptedByUserError when `cancelled` said so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol, TypedDict, Unpack

from flasher.bus.link import Clock, Link
from flasher.driver import Tap, drive
from flasher.errors import BusError, InterruptedByUserError, NoAnswerError
from flasher.host.identify import LISTEN_FIRST_S
from flasher.host.items import Readable, find, readable
from flasher.host.query import Query, Request
from flasher.host.read import MemoryRead
from flasher.host.survey import Survey
from flasher.host.write import WritePlan, Written, plan_write
from flasher.protocol.catalogue import Item
from flasher.protocol.engine import Engine
from flasher.protocol.fields import Content
from flasher.protocol.spec import BMS, WELLING, Dialect, Target
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings

INFO_LISTEN_S: Final = 0.5
"""Long enough to hear faults twice, which come every 200 ms while there are any (5.1)."""
INFO_LISTEN_ONLY_S: Final = 3.0
"""For devices that cannot be asked: their polls come about once a second."""
SCAN_LISTEN_S: Final = 1.0


class Opened(Protocol):
    """An open way to a bus, with the clock that belongs to it."""

    @property
    def link(self) -> Link:
        """Sends and receives frames."""
        ...

    @property
    def clock(self) -> Clock:
        """The clock of the link's deadlines."""
        ...


class Manner(TypedDict, total=False):
    """How it is done; every key may be left out."""

    timings: Timings
    taps: Sequence[Tap]
    on_event: Callable[[object], None] | None
    cancelled: Callable[[], bool] | None
    has_listened: bool
    """The caller has just listened for another tool itself."""


def listen_first(
    connection: Opened, *, dialect: Dialect = WELLING, **manner: Unpack[Manner]
) -> None:
    """Listen for `LISTEN_FIRST_S`, as everybody does who asks: a question in the middle of another
    tool's packet spoils it. Raises BusError when another tool speaks.
    """
    if not manner.get("has_listened"):
        _check_alone(_survey(connection, (), LISTEN_FIRST_S, dialect, manner))


def _check_alone(survey: Survey) -> None:
    if survey.other_tool_heard:
        raise BusError(
            "Another tool speaks on this bus; nothing is asked or written now.",
            where="while listening first",
            cause="an upgrade or a test is under way",
            remedy="Wait until it has ended. flasher monitor listens without asking.",
        )


# -- asking ---------------------------------------------------------------------------------------


def query(
    connection: Opened, request: Request, *, dialect: Dialect = WELLING, **manner: Unpack[Manner]
) -> Content:
    """Ask one question; returns the content of the answer. Raises NoAnswerError."""
    listen_first(connection, dialect=dialect, **manner)
    asked = Query(request, bitrate_bps=dialect.bitrate_bps, timings=_timings(manner))
    _drive(asked, connection, manner)
    _check_cancelled(asked.cancelled and asked.answer is None)
    if asked.answer is None:
        raise _no_answer(asked)
    return asked.answer


def read(
    connection: Opened,
    name: str,
    target: Target = BMS,
    *,
    dialect: Dialect = WELLING,
    **manner: Unpack[Manner],
) -> Content:
    """Read an item by name ("version-information"); the content is a dataclass of
    `flasher.protocol.contents`. "model" and "serial-number" give the version information, which
    holds them. Raises UsageError for a name that is not there, and NoAnswerError.
    """
    item = find(name, readable(target, dialect), target, "read").item
    return query(connection, Request(item), dialect=dialect, **manner)


def read_memory(
    connection: Opened,
    start: int,
    end: int,
    *,
    dialect: Dialect = WELLING,
    **manner: Unpack[Manner],
) -> bytes:
    """The bytes from `start` up to `end` (exclusive, R5) of the BMS. Raises UsageError for an
    impossible range, NoAnswerError when a piece is not answered.
    """
    listen_first(connection, dialect=dialect, **manner)
    reading = MemoryRead(start, end, bitrate_bps=dialect.bitrate_bps, timings=_timings(manner))
    _drive(reading, connection, manner)
    _check_cancelled(not reading.complete and reading.cancelled)
    if not reading.complete:
        error = _no_answer(reading.queries[-1])
        error.where = f"memory at 0x{start + len(reading.data):08X}"
        error.cause = "the address is outside of what the device shows, or it went away"
        raise error
    return reading.data


def _no_answer(asked: Query) -> NoAnswerError:
    item = asked.request.item
    node = item.receiver.name if item.receiver else "bus"
    misfit = asked.misfit
    if misfit is None:
        cause = "it is off, asleep or not connected, it speaks the other dialect, or it is an older"
        cause += " device that does not know the question"
    else:
        cause = f"it answers in another form: {misfit.command:04X} with {len(misfit.data)} bytes"
        cause += f", not {asked.request.answer_item.command:04X}"
    return NoAnswerError(
        f"The {node} did not answer {item.title!r}.",
        where=f"message {item.name}, sent {asked.tries} times",
        cause=cause,
        remedy="See who is on the bus with flasher scan; wake the device with its key.",
    )


# -- writing --------------------------------------------------------------------------------------


def old_content(connection: Opened, plan: WritePlan, **manner: Unpack[Manner]) -> Content | None:
    """What the device holds now; None when there is no query for it. Raises NoAnswerError."""
    read_back = plan.writable.read_back
    if read_back is None:
        return None
    try:
        return query(connection, Request(read_back.item), dialect=plan.dialect, **manner)
    except NoAnswerError as error:
        error.remedy = f"Nothing was written. {error.remedy}"
        raise


def carry_out(
    connection: Opened, plan: WritePlan, old: Content | None, **manner: Unpack[Manner]
) -> Written:
    """Write, wait for general feedback, read back. What went wrong stands in the result.

    Raises BusError, before anything is written, when another tool speaks. `cancelled` is not asked
    any more: a write that was begun is looked after, it takes seconds.
    """
    manner["cancelled"] = None
    listen_first(connection, dialect=plan.dialect, **manner)
    request = Request(plan.writable.item, plan.content)
    is_confirmed = _ask(connection, request, plan.dialect, manner) is not None
    written = Written(plan, old, is_confirmed, None)
    if plan.writable.read_back is None:
        return written
    again = Request(plan.writable.read_back.item)
    for _ in range(2):
        # An answer on a broadcast id may be one to somebody who asked before the write.
        written = replace(written, read_back=_ask(connection, again, plan.dialect, manner))
        if not written.differences:
            break
    return written


def write(
    connection: Opened,
    name: str,
    *values: object,
    target: Target = BMS,
    dialect: Dialect = WELLING,
    manufacturer: bool = False,
    **manner: Unpack[Manner],
) -> Written:
    """Write an item by name and read it back. Raises UsageError, NoAnswerError when the device is
    silent before anything was written, VerificationError when the write was not confirmed or reads
    back differently.
    """
    plan = plan_write(name, values, target, dialect=dialect, manufacturer=manufacturer)
    written = carry_out(connection, plan, old_content(connection, plan, **manner), **manner)
    error = written.error()
    if error is not None:
        raise error
    return written


# -- looking --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reading:
    """One question of `info` and its answer, None when none came; `misfit` says in words what came
    in another form, and `was_asked` is False when the device was given up before.
    """

    name: str
    item: Item
    answer: Content | None
    misfit: str = ""
    was_asked: bool = True


@dataclass(frozen=True)
class DeviceInfo:
    """What a device says about itself, and the traffic heard meanwhile."""

    target: Target
    dialect: Dialect
    readings: tuple[Reading, ...]
    """In the order of the document; empty for devices that have no queries."""
    survey: Survey

    @property
    def is_there(self) -> bool:
        """True when the device answered or sent anything."""
        return self.target.node in self.survey.heard


def info(
    connection: Opened,
    target: Target = BMS,
    *,
    dialect: Dialect = WELLING,
    **manner: Unpack[Manner],
) -> DeviceInfo:
    """Ask a device everything that the documents let us ask; listen only where they give nothing.

    Silence is no error here: see `DeviceInfo.is_there`. Takes 12 s when nothing is answered by a
    device that is heard, 4 s when it is not heard either. Raises BusError when another tool speaks
    on the bus: a question could end its upgrade.
    """
    asked = [entry for entry in readable(target, dialect).values() if not entry.field]
    requests = [Request(entry.item) for entry in asked]
    listen_s = INFO_LISTEN_S if asked else INFO_LISTEN_ONLY_S
    survey = _survey(connection, requests, listen_s, dialect, manner)
    if requests:
        _check_alone(survey)
    done = dict(zip((entry.name for entry in asked), survey.queries, strict=False))
    readings = tuple(_reading(entry, done.get(entry.name)) for entry in asked)
    return DeviceInfo(target, dialect, readings, survey)


def scan(connection: Opened, *, dialect: Dialect = WELLING, **manner: Unpack[Manner]) -> Survey:
    """Listen for a second, then ask the BMS for its version and state: who was heard, with what."""
    items = readable(BMS, dialect)
    requests = [Request(items[n].item) for n in ("version-information", "running-information")]
    return _survey(connection, requests, SCAN_LISTEN_S, dialect, manner)


def _reading(entry: Readable, asked: Query | None) -> Reading:
    if asked is None:
        return Reading(entry.name, entry.item, None, was_asked=False)
    misfit = ""
    if asked.answer is None and asked.misfit is not None:
        came = asked.misfit
        misfit = f"{came.command:04X} with {len(came.data)} bytes, mode {came.mode:02X}"
    return Reading(entry.name, entry.item, asked.answer, misfit)


def _survey(
    connection: Opened,
    requests: Sequence[Request],
    listen_s: float,
    dialect: Dialect,
    manner: Manner,
) -> Survey:
    survey = Survey(
        requests,
        listen_s=listen_s,
        bitrate_bps=dialect.bitrate_bps,
        dialect=dialect,
        timings=_timings(manner),
    )
    _drive(survey, connection, manner)
    _check_cancelled(survey.cancelled)
    return survey


# -- running --------------------------------------------------------------------------------------


def _ask(connection: Opened, request: Request, dialect: Dialect, manner: Manner) -> Content | None:
    asked = Query(request, bitrate_bps=dialect.bitrate_bps, timings=_timings(manner))
    _drive(asked, connection, manner)
    return asked.answer


def _timings(manner: Manner) -> Timings:
    return manner.get("timings", DEFAULT_TIMINGS)


def _drive(engine: Engine, connection: Opened, manner: Manner) -> None:
    drive(
        engine,
        connection.link,
        connection.clock,
        taps=manner.get("taps", ()),
        on_event=manner.get("on_event"),
        cancelled=manner.get("cancelled"),
    )


def _check_cancelled(cancelled: bool) -> None:  # noqa: FBT001  a guard
    if cancelled:
        raise InterruptedByUserError("Interrupted by the user.")
