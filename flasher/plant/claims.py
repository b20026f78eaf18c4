"""Claims units in the plant's database for a station, and keeps the claims while runs last.

A server that does not answer is asked once; until it answers again, `claim` fails at once, so that
a server that is away delays no unit. Whether a unit that another station claims may be run is the
recipe's matter (`flasher.station.records.claims`).
"""

from __future__ import annotations

import threading
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from typing import Final

from sqlalchemy import Connection, select, text

from flasher.log import log_event
from flasher.plant.central import Central
from flasher.plant.forwarder import ENTER, Head, compare
from flasher.station.records import chain, schema
from flasher.station.records.branch import branches
from flasher.station.records.database import Database, records_id_of
from flasher.station.records.errors import RecordError
from flasher.station.records.model import (
    PLANT_CLAIM,
    Elsewhere,
    ElsewhereState,
    Order,
    RunId,
    StationClock,
    utc_text,
)

LEASE_S: Final = 60.0
"""Time after which a claim expires unless it is renewed."""
KEEP_S: Final = 15.0
"""Interval at which claims are renewed."""
RETRY_S: Final = 5.0
"""Interval at which a server that did not answer is asked again."""
CLOCK_KNOWN_S: Final = 12 * 3600.0
"""Time for which a comparison of the clocks counts: this computer's monotonic clock drifts by less
than a second meanwhile."""
_CLOSE_S: Final = 3.0

_CLAIM: Final = text(
    "SELECT * FROM plant_claim(:token, :part, :serial, :is_virtual, :socket, :lease_s, :records,"
    " :takeover)"
)
_RENEW: Final = text("SELECT plant_renew(:tokens, :lease_s)")
_RELEASE: Final = text("SELECT plant_release(:tokens)")
_NOW: Final = text("SELECT clock_timestamp()")
_CLAIMS: Final = text("SELECT * FROM plant_claims()")
_STATES_RELEASED: Final = text("SELECT to_regprocedure('plant_released()') IS NOT NULL")
"""False for the database of an older flasher."""
_RELEASED: Final = text("SELECT * FROM plant_released()")


def clock_offset_s(central: Central, clock: StationClock) -> float:
    """A computer's clock minus that of a plant's database. Raises RecordError."""
    with central.reading() as connection:
        return _offset_s(_compared(connection, clock), clock)


def _compared(connection: Connection, clock: StationClock) -> tuple[float, float]:
    """The database's time minus this computer's monotonic clock, and the latter."""
    began_s = clock.monotonic_s()
    server: datetime = connection.execute(_NOW).scalar_one()
    now_s = clock.monotonic_s()
    return server.timestamp() - (began_s + now_s) / 2, now_s


def _offset_s(clocks: tuple[float, float], clock: StationClock) -> float:
    return clock.utc().timestamp() - (clock.monotonic_s() + clocks[0])


@dataclass(frozen=True)
class _Own:
    """Which records and which PC a station is."""

    records: str
    """Id of the records."""
    takeover: str
    """Hash of the audit row with which this PC took the station over; "" for the first PC."""
    known: frozenset[str | None]
    """PCs of whose runs these records have all, each by its takeover: this one, unless an older
    copy was restored, and those that were brought in.
    """


class PlantClaims:
    """Claims of one station (`flasher.station.gate.Claims`). `is_kept` starts the thread that
    renews them; otherwise the owner calls `tend`.
    """

    def __init__(
        self,
        central: Central,
        records: Database,
        station: str,
        clock: StationClock,
        *,
        is_kept: bool = True,
    ) -> None:
        self._central, self._records = central, records
        self._station, self._clock = station, clock
        self._mutex = threading.Lock()
        self._asked: set[str] = set()
        """Claims of this process, until those of an earlier one are released."""
        self._kept: set[str] = set()
        self._left: set[str] = set()
        """Claims with which no run began."""
        self._released: set[RunId] = set()
        """Runs whose claim the plant has released, until they are taken."""
        self._is_swept = False
        self._own: _Own | None = None
        """None before this station has stated it in a transaction that was committed."""
        self._fault: RecordError | None = None
        """Why the server did not answer last; None if it did."""
        self._clocks: tuple[float, float] | None = None
        """As of `_compared`; None before."""
        self._is_over = False
        self._poke = threading.Event()
        self._thread: threading.Thread | None = None
        if is_kept:
            self._thread = threading.Thread(target=self._keep, name="claims", daemon=True)
            self._thread.start()

    # -- `Claims` of a gate -----------------------------------------------------------------------

    def claim(self, token: str, order: Order, part: str) -> Elsewhere | None:
        with self._mutex:
            fault = self._fault
            if not self._is_swept:
                self._asked.add(token)
        if fault is not None:
            raise fault
        values = {
            "token": token,
            "part": part,
            "serial": order.serial,
            "is_virtual": order.is_virtual,
            "socket": order.socket,
            "lease_s": LEASE_S,
        }
        try:
            with self._central.writing() as central:
                own = self._enter(central)
                values |= {"records": own.records, "takeover": own.takeover}
                found = central.execute(_CLAIM, values).mappings().one()
                self._compare(central, own)
            self._own = own
        except RecordError as error:
            with self._mutex:
                self._fault = error
            self._poke.set()
            raise
        if found["state"] != ElsewhereState.RUNNING:
            with self._mutex:
                self._kept.add(token)
        if found["state"] is None:
            return None
        at = utc_text(found["at"])
        return Elsewhere(
            ElsewhereState(found["state"]), found["station"], found["socket"], at, found["run"]
        )

    def clock_offset_s(self) -> float | None:
        with self._mutex:
            clocks = self._clocks
        if clocks is None or self._clock.monotonic_s() - clocks[1] > CLOCK_KNOWN_S:
            return None
        return _offset_s(clocks, self._clock)

    def ended(self, token: str) -> None:
        with self._mutex:
            self._kept.discard(token)

    def dropped(self, token: str) -> None:
        with self._mutex:
            self._kept.discard(token)
            self._left.add(token)
        self._poke.set()

    def take_released(self) -> set[RunId]:
        with self._mutex:
            found, self._released = self._released, set()
        return found

    def close(self) -> None:
        self._is_over = True
        self._poke.set()
        if self._thread is None:
            self._central.close()
        else:
            self._thread.join(_CLOSE_S)

    # -- keeping ----------------------------------------------------------------------------------

    def tend(self) -> None:
        """Renew the claims, release those that are not needed, and learn which ones the plant has
        released.
        """
        with self._mutex:
            kept, left = sorted(self._kept), sorted(self._left)
        try:
            with self._central.writing() as central:
                own = self._enter(central)
                if not self._is_swept:
                    self._compare(central, own)
                    left += self._unknown(central, own)
                if left:
                    central.execute(_RELEASE, {"tokens": left})
                central.execute(_RENEW, {"tokens": kept, "lease_s": LEASE_S})
                clocks = _compared(central, self._clock)
                states = central.execute(_STATES_RELEASED).scalar_one()
                released = central.execute(_RELEASED).all() if states else ()
            self._own = own
            runs = {self._recorded(each.part, each.serial).get(each.token) for each in released}
        except RecordError as error:
            with self._mutex:
                self._fault = error
            return
        with self._mutex:
            self._clocks = clocks
            self._is_swept = True
            self._asked.clear()
            self._left.difference_update(left)
            self._released |= {run_id for run_id in runs if run_id is not None}
            self._fault = None

    def _enter(self, central: Connection) -> _Own:
        """State from which records this station sends, unless a transaction that is over did: the
        two threads are not to rely on what may still be rolled back.
        """
        own = self._own
        if own is None:
            own = self._read()
            self._head(central, own)
        return own

    def _head(self, central: Connection, own: _Own) -> Head:
        named = {"records": own.records, "station": self._station}
        return Head(*central.execute(ENTER, named).one())

    def _compare(self, central: Connection, own: _Own) -> None:
        """Raise ChainRefusedError if the plant has other records of this station: another PC may
        have passed the unit as this station.
        """
        head = self._head(central, own)
        if head.number:
            with self._records.reading() as local:
                compare(head, self._station, local, central, where=self._central.shown)

    def _read(self) -> _Own:
        with self._records.reading() as local:
            records = records_id_of(local)
            takeover = chain.last_takeover(local, self._station)
            last = {each.takeover: each for each in branches(local, self._station)}
            is_restored = bool(chain.rows_without_run(local, self._station, [chain.RESTORED]))
        known = {each for each, branch in last.items() if branch.is_whole}
        if not is_restored:  # the rows that are lost may have had runs
            known.add(takeover)
        return _Own(records, takeover, frozenset(known))

    def _unknown(self, central: Connection, own: _Own) -> list[str]:
        """Claims of this station with which no run began: the station died in between. What another
        PC has run as this station is not known before its records are brought in.
        """
        claims = [each for each in central.execute(_CLAIMS).all() if each.takeover in own.known]
        with self._mutex:
            earlier = [each for each in claims if each.token not in self._asked]
        return [
            each.token
            for each in earlier
            if each.token not in self._recorded(each.part, each.serial)
        ]

    def _recorded(self, part: str, serial: str) -> dict[str, RunId]:
        """The recorded runs of a unit by their claim."""
        run, step, measurement = schema.run, schema.step, schema.measurement
        query = (
            select(measurement.c.text, run.c.id)
            .join_from(schema.unit, run, run.c.unit_id == schema.unit.c.id)
            .join(step, step.c.run_id == run.c.id)
            .join(measurement, measurement.c.step_id == step.c.id)
            .where(
                schema.unit.c.part == part,
                schema.unit.c.serial == serial,
                step.c.position == 1,
                measurement.c.name == PLANT_CLAIM,
            )
        )
        with self._records.reading() as local:
            return {token: RunId(run_id) for token, run_id in local.execute(query)}

    def _keep(self) -> None:
        with closing(self._central):
            while not self._is_over:
                self._poke.clear()
                try:
                    self.tend()
                except Exception as error:  # noqa: BLE001  claims expire, and runs are marked
                    log_event(error)
                with self._mutex:
                    is_away = self._fault is not None
                if is_away:  # `dropped` must not ask a dead server again and again
                    self._wait(RETRY_S)
                else:
                    self._poke.wait(KEEP_S)
            with self._mutex:
                has_left = bool(self._left) and self._fault is None
            if has_left:
                self.tend()

    def _wait(self, limit_s: float) -> None:
        """Wait, or until the station ends."""
        until_s = self._clock.monotonic_s() + limit_s
        while not self._is_over and (left_s := until_s - self._clock.monotonic_s()) > 0:
            self._poke.wait(left_s)
            self._poke.clear()
