"""Checks whether a unit may be run. All rules are checked in the transaction that starts the run,
so that two sockets cannot both take the last place of a lot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import PurePath
from typing import Any, Final

from sqlalchemy import Connection, func, select

from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.station.recipe import Duplicate, Golden
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records import chain, schema
from flasher.station.records.chain import CLAIM_PARTS, Trail, digests_of
from flasher.station.records.errors import ClaimRefusedError, Refusal
from flasher.station.records.model import (
    Claim,
    RunId,
    RunKind,
    RunState,
    UnitState,
    utc_moment,
    utc_text,
)
from flasher.station.records.rows import insert, named
from flasher.station.records.schema import recipe, run, socket, station, unit

CLOCK_TOLERANCE: Final = timedelta(minutes=5)
"""Network time may set the clock back a little."""


@dataclass(frozen=True)
class Order:
    """A run to be claimed."""

    serial: str
    socket: str
    loaded: LoadedRecipe
    operator: str
    lot: str = ""
    reason: str = ""
    is_virtual: bool = False

    @property
    def part(self) -> str:
        """The product."""
        return self.loaded.recipe.part

    @property
    def is_golden(self) -> bool:
        """True for a unit that tests the station."""
        rule = self.loaded.recipe.golden
        return rule is not None and self.serial in rule.serial_numbers

    def checked(self, now: datetime) -> Order:
        """The order with the lot that its serial number names. Raises ClaimRefusedError,
        UsageError.
        """
        try:
            scan = self.loaded.scan(self.serial, now.astimezone().date(), self.lot)
        except ValueError as error:
            raise ClaimRefusedError(
                Refusal.WRONG_SERIAL,
                f"No serial number of this recipe: {error}.",
                remedy="Scan the label of the unit again.",
            ) from error
        if not self.loaded.is_unchanged():
            path = printable(str(self.loaded.path))
            raise ClaimRefusedError(
                Refusal.RECIPE_CHANGED,
                f"The recipe {path}, or a file that it names, was changed.",
                remedy="Check it with `flasher station check`, then start the station again.",
            )
        if not self.operator.strip() or not self.socket.strip():
            raise UsageError("A run needs an operator and a socket.")
        return replace(self, lot=scan.lot)


def begin_run(trail: Trail, order: Order, now: datetime, monotonic_s: float) -> Claim:
    """Begin a run when every rule allows it. Raises ClaimRefusedError."""
    connection = trail.connection
    last = chain.latest(connection, trail.station)
    if last is not None and now < utc_moment(last) - CLOCK_TOLERANCE:
        # It would stand before the runs that were made.
        raise ClaimRefusedError(
            Refusal.CLOCK,
            f"The clock says {utc_text(now)[:19]} UTC, but {trail.station} has records of"
            f" {last[:19]} UTC.",
            remedy="Set the clock of this computer. If the clock is right and that record is not:"
            " end the station, then flasher station accept clock.",
        )
    unit_id = named(connection, schema.unit, part=order.part, serial=order.serial)
    station_id = named(connection, schema.station, name=trail.station)
    socket_id = named(connection, schema.socket, station_id=station_id, name=order.socket)
    lot_id = None
    if order.lot:
        lot_id = named(connection, schema.lot, part=order.part, name=order.lot)
    kind, before, count = _kind_of(connection, order, unit_id, socket_id, lot_id, now)
    loaded = order.loaded
    run_id = insert(
        connection,
        schema.run,
        unit_id=unit_id,
        socket_id=socket_id,
        recipe_id=_recipe_id(trail, loaded, now),
        lot_id=lot_id,
        operator_id=named(connection, schema.operator, name=order.operator),
        kind=kind.value,
        is_virtual=order.is_virtual,
        reason=order.reason,
        state=RunState.RUNNING.value,
        code="",
        text="",
        begun_at=utc_text(now),
        begun_monotonic_s=monotonic_s,
        verification_required=int(loaded.required),
        allow_completed_not_read_back=loaded.recipe.allow_completed_not_read_back,
    )
    for position, target in enumerate(loaded.targets, 1):
        artifact_id = named(
            connection,
            schema.artifact,
            target=target.name,
            sha256=target.image.sha256,
            name=PurePath(target.image.source).name,
            version=target.version,
            size_bytes=target.image.size_bytes,
        )
        insert(
            connection,
            schema.run_target,
            run_id=run_id,
            artifact_id=artifact_id,
            position=position,
            target=target.name,
            required=int(target.required),
        )
    digests = digests_of(connection, [run_id])[run_id]
    data = {"serial": order.serial, "digests": {name: digests[name] for name in CLAIM_PARTS}}
    trail.append(now, chain.CLAIMED, data, run_id)
    return Claim(RunId(run_id), kind, order.serial, order.part, before, count)


def _recipe_id(trail: Trail, loaded: LoadedRecipe, now: datetime) -> int:
    """The recipe's row; it holds the whole text, so that it can be read years later."""
    query = select(recipe.c.id).where(recipe.c.sha256 == loaded.sha256)
    found = trail.connection.execute(query).scalar_one_or_none()
    if found is not None:
        return int(found)
    rule = loaded.recipe
    facts = {"name": rule.name, "revision": rule.revision, "sha256": loaded.sha256}
    trail.append(now, "recipe", facts)
    return insert(
        trail.connection,
        recipe,
        **facts,
        part=rule.part,
        content=loaded.content,
        verification_required=int(loaded.required),
        allow_completed_not_read_back=rule.allow_completed_not_read_back,
    )


def _kind_of(
    connection: Connection,
    order: Order,
    unit_id: int,
    socket_id: int,
    lot_id: int | None,
    now: datetime,
) -> tuple[RunKind, UnitState, int]:
    """What kind of run it would be, the unit's state and how many runs it had.

    Raises ClaimRefusedError.
    """
    _check_free(connection, order, unit_id, socket_id)
    _check_nature(connection, order, unit_id)
    states = (
        connection.execute(select(run.c.state).where(run.c.unit_id == unit_id).order_by(run.c.id))
        .scalars()
        .all()
    )
    before = UnitState.after(RunState(states[-1]) if states else None)
    if order.is_golden:
        return RunKind.GOLDEN, before, len(states)
    _check_golden(connection, order, socket_id, now)
    kind = _repeated(order) if before is UnitState.PASS else RunKind.PRODUCTION
    if before is UnitState.RECHECK:
        kind = RunKind.RECHECK
    _check_lot(connection, order, unit_id, lot_id)
    return kind, before, len(states)


def _check_free(connection: Connection, order: Order, unit_id: int, socket_id: int) -> None:
    running = (
        select(run.c.unit_id, socket.c.name.label("socket_name"), station.c.name, unit.c.serial)
        .join_from(run, socket)
        .join(station)
        .join(unit, run.c.unit_id == unit.c.id)
        .where(run.c.state == RunState.RUNNING.value)
    )
    by_unit: Any = connection.execute(running.where(run.c.unit_id == unit_id)).first()
    if by_unit is not None:
        raise ClaimRefusedError(
            Refusal.UNIT_RUNNING,
            f"{order.serial} is running on socket {by_unit.socket_name} of {by_unit.name}.",
            remedy="Wait for its end. If it is not there, check the label of this unit.",
        )
    by_socket: Any = connection.execute(running.where(run.c.socket_id == socket_id)).first()
    if by_socket is not None:
        raise ClaimRefusedError(
            Refusal.SOCKET_BUSY,
            f"Socket {order.socket} is busy with {by_socket.serial}.",
            remedy="Wait for its end.",
        )


def _check_nature(connection: Connection, order: Order, unit_id: int) -> None:
    """A PASS of a virtual unit says nothing about a real one, and the other way round."""
    others = select(run.c.id).where(run.c.unit_id == unit_id, run.c.is_virtual != order.is_virtual)
    if connection.execute(others.limit(1)).first() is not None:
        known = "real" if order.is_virtual else "virtual"
        raise ClaimRefusedError(
            Refusal.OTHER_NATURE,
            f"{order.serial} is a {known} unit in these records.",
            remedy="Keep records of virtual units apart, in a database of their own.",
        )


def _repeated(order: Order) -> RunKind:
    """What is done with a unit that has passed."""
    rule = order.loaded.recipe.duplicate
    if rule is Duplicate.VERIFY_ONLY:
        return RunKind.VERIFY_ONLY
    if rule is Duplicate.BLOCK:
        raise ClaimRefusedError(
            Refusal.DUPLICATE,
            f"{order.serial} has passed already.",
            remedy="Check the label: another unit may carry the same number.",
        )
    if not order.reason.strip():
        raise ClaimRefusedError(
            Refusal.REASON_NEEDED,
            f"{order.serial} has passed already, and is done again only for a reason.",
            remedy="Give the reason, then scan it again.",
        )
    return RunKind.REFLASH


def _check_lot(connection: Connection, order: Order, unit_id: int, lot_id: int | None) -> None:
    rule = order.loaded.recipe.lot
    if lot_id is None:
        if rule.required:
            raise ClaimRefusedError(
                Refusal.LOT_NEEDED, "The unit has no lot.", remedy="Give the station the lot."
            )
        return
    if rule.quantity_max is None:
        return
    query = select(func.count(run.c.unit_id.distinct())).where(
        run.c.lot_id == lot_id,
        run.c.unit_id != unit_id,
        run.c.is_virtual == order.is_virtual,
        run.c.kind != RunKind.GOLDEN.value,
        run.c.state.in_((RunState.RUNNING.value, RunState.PASS.value)),
    )
    used = connection.execute(query).scalar_one()
    if used >= rule.quantity_max:
        raise ClaimRefusedError(
            Refusal.LOT_FULL,
            f"Lot {order.lot} is full: {used} of {rule.quantity_max} units.",
            remedy="Begin the next lot.",
        )


def _check_golden(connection: Connection, order: Order, socket_id: int, now: datetime) -> None:
    rule = order.loaded.recipe.golden
    if rule is None:
        return
    query = (
        select(func.max(run.c.ended_at))
        .join_from(run, recipe)
        .where(
            run.c.socket_id == socket_id,
            run.c.kind == RunKind.GOLDEN.value,
            run.c.is_virtual == order.is_virtual,
            run.c.state == RunState.PASS.value,
            recipe.c.part == order.part,
        )
    )
    last = connection.execute(query).scalar_one()
    if is_due(rule, utc_moment(last) if last else None, now.astimezone()):
        raise ClaimRefusedError(
            Refusal.GOLDEN_DUE,
            f"A golden unit has to pass on socket {order.socket} first.",
            remedy=f"Scan and connect one of: {', '.join(rule.serial_numbers)}.",
        )


def is_due(rule: Golden, last_pass: datetime | None, now: datetime) -> bool:
    """True when a golden unit has to pass first. `last_pass` is when one last did on this socket;
    `now` is in the local time zone, in which the shifts start.
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
