"""The claim that begins a run: the records have to allow it, and have it on disk."""

from __future__ import annotations

from typing import TYPE_CHECKING

from flasher.errors import FlasherError
from flasher.station import codes
from flasher.station.events import RunStarted, ScanRefused, SocketState
from flasher.station.history import Before, before_of
from flasher.station.messages import Begin
from flasher.station.records.errors import ClaimRefusedError, RecordError, Refusal
from flasher.station.records.model import Claim, UnitLife
from flasher.station.run_model import RunOrder
from flasher.station.socket_line import ActiveRun, SocketLine

if TYPE_CHECKING:
    from flasher.station.station import Station


class Claiming:
    """Begins runs. Operator and lot hold for those that follow, a reason for one label."""

    def __init__(self, station: Station, *, operator: str, lot: str) -> None:
        self._station = station
        self.operator = operator
        self.lot = lot
        self._reason = ""
        """For the next label."""
        self._reasons: dict[str, str] = {}
        """Of labels: sockets that begin in between must not take each other's."""

    def give_reason(self, reason: str) -> None:
        """Why the unit of the next label is done again."""
        self._reason = reason

    def take_label(self, serial: str) -> None:
        """The next label is there: the reason is for it alone."""
        if self._reason:
            self._reasons[serial], self._reason = self._reason, ""

    def cancel(self) -> None:
        """Forget all reasons."""
        self._reason = ""
        self._reasons.clear()

    def begin(self, line: SocketLine) -> None:
        """Label and unit are there: claim it, and let its process run it."""
        station = self._station
        serial, line.label, line.begin_at_s = line.label, "", None
        try:
            reason = self._reasons.get(serial, "")
            before = before_of(self._life(serial), station.recipe, is_reworked=bool(reason))
            claim = station.store.claim(
                serial,
                line.name,
                station.recipe,
                self.operator,
                lot=self.lot,
                reason=reason,
                is_virtual=line.is_virtual,
            )
        except ClaimRefusedError as error:
            station.tell(
                ScanRefused(serial, error.refusal.value, error.what, error.remedy, line.name)
            )
            if error.refusal is Refusal.RECIPE_CHANGED:
                station.committing.stop_line(error.refusal.value, error.what, error.remedy)
            self._show_refused(line, error)
            return
        except RecordError as error:
            station.committing.not_saved(line, None, error)
            station.show_rest(line)
            return
        self._reasons.pop(serial, None)
        self._start(line, claim, before)

    def _show_refused(self, line: SocketLine, error: FlasherError) -> None:
        if self._station.is_line_stopped:
            self._station.show_rest(line)
        else:
            self._station.show(line, SocketState.SCAN, f"{error.what} {error.remedy}")

    def _life(self, serial: str) -> UnitLife | None:
        part = self._station.recipe.recipe.part
        lives = self._station.store.read.units(serial)
        return next((life for life in lives if life.part == part), None)

    def _start(self, line: SocketLine, claim: Claim, before: Before) -> None:
        station = self._station
        day = station.clock.utc().astimezone().date()
        order = RunOrder(
            claim.run_id,
            claim.kind,
            claim.serial,
            day,
            self.lot,
            before.known_before,
            before.flashed_before,
            before.written_before,
        )
        trace = station.committing.spool / f"run-{claim.run_id}.log"
        line.serial = claim.serial
        line.run = ActiveRun(claim, trace, station.clock.monotonic_s())
        started = RunStarted(line.name, claim.serial, claim.run_id, claim.kind, line.is_virtual)
        station.tell(started)
        station.show(line, SocketState.RUNNING)
        if not station.send_begin(line, Begin(order, trace)):
            station.committing.end_lost(line, codes.PROCESS_DIED.meaning, hung=False)
