"""Claims a unit for a run: checks every rule in the transaction that starts the run.

So two sockets cannot both take the last place of a lot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from datetime import datetime, timedelta
from pathlib import PurePath
from typing import Any, NoReturn

from sqlalchemy import func, select

from flasher.errors import FlasherError, UsageError
from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.recipe import ClockRule, Duplicate, Golden, Unchecked
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records import chain, schema
from flasher.station.records.chain import CLAIM_PARTS, Trail, digests_of
from flasher.station.records.errors import ClaimRefusedError, Refusal
from flasher.station.records.model import (
    CHECKED,
    CLOCK_OFFSET,
    CLOCK_TOLERANCE,
    DUPLICATES,
    PLANT_ANSWER,
    PLANT_CLAIM,
    Admission,
    Claim,
    Elsewhere,
    ElsewhereState,
    Measurement,
    Order,
    RunId,
    RunKind,
    RunState,
    Signature,
    StepName,
    StepState,
    UnitState,
    utc_moment,
    utc_text,
)
from flasher.station.records.rows import find_or_insert, insert
from flasher.station.records.schema import recipe, run, socket, station, unit
from flasher.station.shift_counts import shift_began


def check_order(order: Order, loaded: LoadedRecipe, now: datetime) -> Order:
    """Add the lot of the serial number to an order. Raises ClaimRefusedError for a wrong serial
    number or a changed recipe, UsageError without an operator or socket.
    """
    try:
        scan = loaded.scan(order.serial, now.astimezone().date(), order.lot)
    except ValueError as error:
        raise ClaimRefusedError(
            Refusal.WRONG_SERIAL,
            text("Not a serial number of this recipe: {why}.", why=str(error)),
            remedy=text("Scan the label of the unit again."),
        ) from error
    if not loaded.is_unchanged():
        path = printable(str(loaded.path))
        what = text("The recipe {path}, or a file that it refers to, was changed.", path=path)
        remedy = text("Check it with `flasher station check`, then start the station again.")
        if loaded.digest:
            what = text("The copy of the recipe from the plant is damaged.")
            remedy = text(
                "It is fetched again when the server can be reached: scan RESUME after a minute,"
                " or approve another recipe."
            )
        raise ClaimRefusedError(Refusal.RECIPE_CHANGED, what, remedy=remedy)
    if not order.operator.strip() or not order.socket.strip():
        raise UsageError("A run needs an operator and a socket.")
    return replace(order, lot=scan.lot)


def check_signatures(loaded: LoadedRecipe) -> Mapping[str, Signature]:
    """Check the signatures of the recipe's images against the trust file as it is now. Raises
    ClaimRefusedError.
    """
    try:
        found = {target.name: target.signature() for target in loaded.targets}
    except FlasherError as error:
        raise ClaimRefusedError(
            Refusal.RECIPE_NOT_TRUSTED,
            text("The recipe may not be run any more: {why}", why=error.what),
            remedy=error.remedy,
        ) from error
    return {name: signature for name, signature in found.items() if signature is not None}


class Claiming:
    """Claims a unit for one run, in the transaction of `trail`."""

    def __init__(
        self,
        trail: Trail,
        order: Order,
        loaded: LoadedRecipe,
        signatures: Mapping[str, Signature],
        now: datetime,
    ) -> None:
        """Raises ClaimRefusedError if the clock is earlier than the records."""
        self._signatures = signatures
        self._trail, self._order, self._loaded, self._now = trail, order, loaded, now
        self._part = loaded.recipe.part
        self._connection = connection = trail.connection
        self._check_clock()
        station_id = find_or_insert(connection, schema.station, name=trail.station)
        self._unit_id = find_or_insert(
            connection, schema.unit, part=self._part, serial=order.serial
        )
        self._socket_id = find_or_insert(
            connection, schema.socket, station_id=station_id, name=order.socket
        )
        self._lot_id: int | None = None
        if order.lot:
            self._lot_id = find_or_insert(connection, schema.lot, part=self._part, name=order.lot)

    def begin(self, monotonic_s: float) -> Claim:
        """Start the run if every rule allows it. Raises ClaimRefusedError."""
        order, loaded, connection = self._order, self._loaded, self._connection
        self._check_free()
        self._check_unit_kind()
        self._check_plant(order.admission or Admission())
        last = connection.execute(
            select(run.c.state)
            .where(run.c.unit_id == self._unit_id)
            .order_by(run.c.id.desc())
            .limit(1)
        ).scalar_one_or_none()
        before = UnitState.after(None if last is None else RunState(last))
        kind = self._kind(before)
        run_id = insert(
            connection,
            run,
            **self._first_number(),
            unit_id=self._unit_id,
            socket_id=self._socket_id,
            recipe_id=self._recipe_id(),
            lot_id=self._lot_id,
            operator_id=find_or_insert(connection, schema.operator, name=order.operator),
            kind=kind.value,
            is_virtual=order.is_virtual,
            reason=order.reason,
            state=RunState.RUNNING.value,
            code="",
            text="",
            begun_at=utc_text(self._now),
            begun_monotonic_s=monotonic_s,
            verification_required=int(loaded.required),
            allow_completed_not_read_back=loaded.recipe.allow_completed_not_read_back,
        )
        for position, target in enumerate(loaded.targets, 1):
            artifact_id = find_or_insert(
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
        if order.admission is not None:
            self._note_plant(run_id, order.admission, monotonic_s)
        digests = digests_of(connection, [run_id])[run_id]
        data = {"serial": order.serial, "digests": {name: digests[name] for name in CLAIM_PARTS}}
        self._trail.append(self._now, chain.CLAIMED, data, run_id)
        day = self._now.astimezone().date()
        return Claim(
            RunId(run_id),
            kind,
            order.serial,
            day,
            order.lot,
            signatures=self._signatures,
            unchecked="" if order.admission is None else order.admission.doubt,
        )

    def _note_plant(self, run_id: int, admission: Admission, monotonic_s: float) -> None:
        """Record what the plant answered, with the begin of the run."""
        rule, doubt = self._loaded.recipe.plant, admission.doubt
        measured: list[Measurement] = []
        if admission.claim:
            words = f"not {CHECKED}: {doubt}" if doubt else CHECKED
            measured.append(Measurement(DUPLICATES, text=words))
            measured.append(Measurement(PLANT_CLAIM, text=admission.claim))
        if admission.answer is not None:
            measured.append(Measurement(PLANT_ANSWER, text=admission.answer.text))
        if admission.clock_offset_s is not None:
            most_s = rule.clock_offset_max_s if rule.clock is ClockRule.STOP else None
            least_s = None if most_s is None else -most_s
            offset_s = admission.clock_offset_s
            measured.append(Measurement(CLOCK_OFFSET, offset_s, "s", low=least_s, high=most_s))
        if not measured:
            return
        step_id = insert(
            self._connection,
            schema.step,
            run_id=run_id,
            position=1,
            name=StepName.PLANT.value,
            try_number=1,
            state=(StepState.SKIPPED if doubt else StepState.PASS).value,
            code="",
            text=f"duplicates not {CHECKED}: {doubt}" if doubt else "",
            begun_at=utc_text(self._now - timedelta(seconds=admission.duration_s)),
            begun_monotonic_s=monotonic_s - admission.duration_s,
            duration_s=admission.duration_s,
        )
        for each in measured:
            insert(self._connection, schema.measurement, step_id=step_id, **asdict(each))

    def _first_number(self) -> dict[str, int]:
        """Number of the first run after a takeover, which leaves numbers to the PC before."""
        rows = chain.rows_without_run(self._connection, self._trail.station, [chain.TAKEN_OVER])
        begin = max((chain.runs_from(chain.data_of(row.data)) for row in rows), default=1)
        if begin == 1:
            return {}
        last = self._connection.execute(select(func.max(run.c.id))).scalar_one() or 0
        return {"id": begin} if last < begin else {}

    def _recipe_id(self) -> int:
        """Row id of the recipe. The row holds the whole text, readable years later."""
        loaded, rule = self._loaded, self._loaded.recipe
        query = select(recipe.c.id).where(recipe.c.sha256 == loaded.sha256)
        found = self._connection.execute(query).scalar_one_or_none()
        if found is not None:
            return int(found)
        facts = {"name": rule.name, "revision": rule.revision, "sha256": loaded.sha256}
        self._trail.append(self._now, chain.RECIPE, facts)
        return insert(
            self._connection,
            recipe,
            **facts,
            part=rule.part,
            content=loaded.content,
            verification_required=int(loaded.required),
            allow_completed_not_read_back=rule.allow_completed_not_read_back,
        )

    # -- the rules --------------------------------------------------------------------------------

    def _check_clock(self) -> None:
        """Check that no recorded run is later than the clock. Raises ClaimRefusedError."""
        last = chain.latest(self._connection, self._trail.station)
        if last is not None and self._now < utc_moment(last) - CLOCK_TOLERANCE:
            raise ClaimRefusedError(
                Refusal.CLOCK,
                text(
                    "The clock shows {now} UTC, but {station} has records of {last} UTC.",
                    now=utc_text(self._now)[:19],
                    station=self._trail.station,
                    last=last[:19],
                ),
                remedy=text(
                    "Set the clock of this computer. If the clock is right and that record is"
                    " not: end the station, then flasher station accept clock"
                    " --reason TEXT."
                ),
            )

    def _check_free(self) -> None:
        running = (
            select(run.c.unit_id, socket.c.name.label("socket_name"), station.c.name, unit.c.serial)
            .join_from(run, socket)
            .join(station)
            .join(unit, run.c.unit_id == unit.c.id)
            .where(run.c.state == RunState.RUNNING.value)
        )
        of_unit = running.where(run.c.unit_id == self._unit_id)
        by_unit: Any = self._connection.execute(of_unit).first()
        if by_unit is not None:
            self._refuse_running(by_unit.socket_name, by_unit.name)
        on_socket = running.where(run.c.socket_id == self._socket_id)
        by_socket: Any = self._connection.execute(on_socket).first()
        if by_socket is not None:
            raise ClaimRefusedError(
                Refusal.SOCKET_BUSY,
                text(
                    "Socket {socket} is busy with {serial}.",
                    socket=self._order.socket,
                    serial=by_socket.serial,
                ),
                remedy=text("Wait until that run ends."),
            )

    def _check_plant(self, admission: Admission) -> None:
        """Check what the plant answered. Raises ClaimRefusedError."""
        golden = self._loaded.recipe.golden
        if golden is not None and self._order.serial in golden.serial_numbers:
            return
        self._check_clock_offset(admission.clock_offset_s)
        answer, other = admission.answer, admission.elsewhere
        if answer is not None and not answer.may_begin:
            raise ClaimRefusedError(
                Refusal.PLANT_REFUSED,
                text("The plant: {answer}.", answer=printable(answer.text)),
                remedy=text("Ask the shift leader where this unit belongs.")
                if answer.is_answered
                else text("Try again when the plant's system answers."),
            )
        if other is not None and other.state is ElsewhereState.RUNNING:
            self._refuse_running(other.socket, other.station)
        doubt = admission.doubt if admission.claim else text("this station belongs to no plant")
        if doubt and self._loaded.recipe.plant.unchecked is Unchecked.BLOCK:
            raise ClaimRefusedError(
                Refusal.NOT_CHECKED,
                text(
                    "It was not checked whether {serial} passed at another station: {why}.",
                    serial=self._order.serial,
                    why=doubt,
                ),
                remedy=text(
                    "Repair the connection to the plant's database, or that station; the recipe"
                    " allows no unit without this check."
                ),
            )

    def _check_clock_offset(self, offset_s: float | None) -> None:
        rule = self._loaded.recipe.plant
        if rule.clock is not ClockRule.STOP:
            return
        if offset_s is None and rule.clock_unknown is Unchecked.BLOCK:
            raise ClaimRefusedError(
                Refusal.CLOCK_OFFSET,
                text("The clock was not compared with that of the plant's database."),
                remedy=text("Repair the connection to the plant's database."),
            )
        if offset_s is not None and abs(offset_s) > rule.clock_offset_max_s:
            raise ClaimRefusedError(
                Refusal.CLOCK_OFFSET,
                text(
                    "The clock differs by {offset:+.1f} s from that of the plant's database;"
                    " the recipe allows {most:g} s.",
                    offset=offset_s,
                    most=rule.clock_offset_max_s,
                ),
                remedy=text("Set the clock of this computer."),
            )

    def _refuse_running(self, socket_name: str, station_name: str) -> NoReturn:
        raise ClaimRefusedError(
            Refusal.UNIT_RUNNING,
            text(
                "{serial} is running on socket {socket} of {station}.",
                serial=self._order.serial,
                socket=socket_name,
                station=station_name,
            ),
            remedy=text("Wait until that run ends. If its unit is not there, check this label."),
        )

    def _check_unit_kind(self) -> None:
        """Refuse a real unit recorded as virtual, or the reverse: a PASS of one proves nothing
        about the other. Raises ClaimRefusedError.
        """
        is_virtual = self._order.is_virtual
        others = select(run.c.id).where(
            run.c.unit_id == self._unit_id, run.c.is_virtual != is_virtual
        )
        if self._connection.execute(others.limit(1)).first() is not None:
            known = "real" if is_virtual else "virtual"
            raise ClaimRefusedError(
                Refusal.OTHER_NATURE,
                text(
                    "{serial} is a {nature} unit in these records.",
                    serial=self._order.serial,
                    nature=known,
                ),
                remedy=text("Use a separate database for virtual units."),
            )

    def _kind(self, before: UnitState) -> RunKind:
        """Kind of the run, by the unit's state before it. Raises ClaimRefusedError."""
        golden = self._loaded.recipe.golden
        if golden is not None and self._order.serial in golden.serial_numbers:
            return RunKind.GOLDEN
        self._check_golden()
        kind = RunKind.PRODUCTION
        other = None if self._order.admission is None else self._order.admission.elsewhere
        if other is not None and other.state is not ElsewhereState.PASSED:
            other = None
        if before is UnitState.PASS or other is not None:
            kind = self._repeated(None if before is UnitState.PASS else other)
        elif before is UnitState.RECHECK:
            kind = RunKind.RECHECK
        self._check_lot()
        return kind

    def _check_golden(self) -> None:
        order, rule = self._order, self._loaded.recipe.golden
        if rule is None:
            return
        query = (
            select(func.max(run.c.ended_at))
            .join_from(run, recipe)
            .where(
                run.c.socket_id == self._socket_id,
                run.c.kind == RunKind.GOLDEN.value,
                run.c.is_virtual == order.is_virtual,
                run.c.state == RunState.PASS.value,
                # Of a clock that was ahead, it is not known how long ago that was.
                run.c.ended_at <= utc_text(self._now + CLOCK_TOLERANCE),
                recipe.c.part == self._part,
            )
        )
        last = self._connection.execute(query).scalar_one()
        if is_due(rule, utc_moment(last) if last else None, self._now):
            raise ClaimRefusedError(
                Refusal.GOLDEN_DUE,
                text("A golden unit has to pass on socket {socket} first.", socket=order.socket),
                remedy=text(
                    "Scan and connect one of: {serials}.", serials=", ".join(rule.serial_numbers)
                ),
            )

    def _repeated(self, other: Elsewhere | None) -> RunKind:
        """Kind of run for a unit that has passed before, here or elsewhere. Raises
        ClaimRefusedError.
        """
        order, rule = self._order, self._loaded.recipe.duplicate
        if rule is Duplicate.VERIFY_ONLY:
            return RunKind.VERIFY_ONLY
        has_passed = text("{serial} has passed already.", serial=order.serial)
        if other is not None:
            has_passed = text(
                "{serial} has passed already, on socket {socket} of {station}, at {at} (its run"
                " {run}).",
                serial=order.serial,
                socket=printable(other.socket),
                station=printable(other.station),
                at=other.moment,
                run=other.run,
            )
        if rule is Duplicate.BLOCK:
            raise ClaimRefusedError(
                Refusal.DUPLICATE,
                has_passed,
                remedy=text("Check the label: another unit may carry the same number."),
            )
        if not order.reason.strip():
            raise ClaimRefusedError(
                Refusal.REASON_NEEDED,
                text("{passed} Another run needs a reason.", passed=has_passed),
                remedy=text("Give the reason, then scan it again."),
            )
        return RunKind.REFLASH

    def _check_lot(self) -> None:
        order, rule = self._order, self._loaded.recipe.lot
        if self._lot_id is None and rule.required:
            raise ClaimRefusedError(
                Refusal.LOT_NEEDED,
                text("The unit has no lot."),
                remedy=text("Enter the lot at the station."),
            )
        if self._lot_id is None or rule.quantity_max is None:
            return
        query = select(func.count(run.c.unit_id.distinct())).where(
            run.c.lot_id == self._lot_id,
            run.c.unit_id != self._unit_id,
            run.c.is_virtual == order.is_virtual,
            run.c.kind != RunKind.GOLDEN.value,
            run.c.state.in_((RunState.RUNNING.value, RunState.PASS.value)),
        )
        used = self._connection.execute(query).scalar_one()
        if used >= rule.quantity_max:
            raise ClaimRefusedError(
                Refusal.LOT_FULL,
                text(
                    "Lot {lot} is full: {used} of {most} units.",
                    lot=order.lot,
                    used=used,
                    most=rule.quantity_max,
                ),
                remedy=text("Start the next lot."),
            )


def is_due(rule: Golden, last_pass: datetime | None, now: datetime) -> bool:
    """True if a golden unit has to pass before the next run. `last_pass` is the time of the last
    golden PASS on this socket.
    """
    if last_pass is None:
        return True
    if rule.every_h is not None and now - last_pass >= timedelta(hours=rule.every_h):
        return True
    start = shift_began(rule.shift_starts, now)
    return start is not None and last_pass < start
