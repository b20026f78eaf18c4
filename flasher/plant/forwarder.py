"""Sends a station's records to the plant's database, in the order of the station's audit trail.

    with closing(Forwarder(records, files, central, "line-2", SystemClock())) as forwarder:
        while forwarder.forward():     # a batch is one transaction
            pass

The database states which row it has last (`plant_enter`), so nothing is remembered here: whatever
is killed at whatever moment, the next batch begins after that row. Rows that arrive twice are
ignored.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, Final
from uuid import UUID

from pydantic import TypeAdapter, ValidationError
from sqlalchemy import Connection, text

from flasher import __version__
from flasher.files import part_of, read
from flasher.plant.central import Central, ChainRefusedError, Refusal
from flasher.plant.schema import OWN_PARTS, SHARED_PARTS
from flasher.protocol.text import printable
from flasher.station.records import chain
from flasher.station.records.database import Database, in_file_name, records_id_of
from flasher.station.records.errors import RecordError
from flasher.station.records.files import FileStore
from flasher.station.records.model import StationClock, utc_text

BATCH_ROWS: Final = 200
BATCH_BYTES: Final = 4 * 1024 * 1024
"""Traces of a batch; the first run is sent whatever its size."""
_STATE_MAX_SIZE: Final = 64 * 1024
_PART_AGE_S: Final = 3600.0
_ROW: Final = ("number", "at", "event", "data", "previous_hash", "hash", "signature")

ENTER: Final = text("SELECT * FROM plant_enter(:records, :station)")
_REPORT: Final = text("SELECT plant_report(:version, :unsent, :oldest, :offset_s, :free, :refusal)")
_ADD_PART: Final = text(
    "INSERT INTO shared_part (station, sha256, content) VALUES (:station, :sha256, :content)"
    " ON CONFLICT DO NOTHING"
)
_ADD_OPEN: Final = text(
    "INSERT INTO open_run (station, run_number, content) VALUES (:station, :run_number,"
    " CAST(:content AS json)) ON CONFLICT DO NOTHING"
)
_OF_TWO: Final = (Refusal.TAKEN_OVER, Refusal.FORKED, Refusal.REPLAYED)
"""Refusals of one PC while another one, whose reports replace its own, may run as the station."""
_TAKEN_OVER: Final = text("SELECT * FROM plant_taken_over()")
_REPORT_OTHER: Final = text("SELECT plant_report_other(:refusal)")
_ADD_TRACE: Final = text(
    "INSERT INTO trace (sha256, data) VALUES (:sha256, :data) ON CONFLICT DO NOTHING"
)
ADD_ROW: Final = text(
    "INSERT INTO chain_row (station, number, at, event, run_number, data, previous_hash, hash,"
    " signature, content) VALUES (:station, :number, :at, :event, :run_number, :data,"
    " :previous_hash, :hash, :signature, CAST(:content AS json)) ON CONFLICT DO NOTHING"
)


@dataclass(frozen=True)
class ForwarderState:
    """What the forwarder knows about the plant's database; also the content of its file."""

    at: str = ""
    """Time of the last attempt."""
    sent: int = 0
    """Number of the last audit row that the database has."""
    unsent: int = 0
    """Audit rows that it lacks."""
    oldest_unsent_at: str = ""
    """Time of the first of these; "" without any."""
    clock_offset_s: float | None = None
    """This computer's clock minus the database's; null before the first connection."""
    fault: str = ""
    """Why the last attempt failed; "" if it did not."""
    refusal: str = ""
    """Why the database refuses the chain; "" if it does not."""


_STATE: Final = TypeAdapter(ForwarderState)


def state_file(folder: Path, station: str) -> Path:
    """The forwarder's file in the folder of the records' files, which stations may share."""
    return folder / f"plant-{in_file_name(station)}.json"


def load_state(folder: Path, station: str) -> ForwarderState:
    """Read the forwarder's file; the default without one. Raises RecordError."""
    path = state_file(folder, station)
    if not path.exists():
        return ForwarderState()
    try:
        return _STATE.validate_json(read(path, _STATE_MAX_SIZE, error=RecordError))
    except ValidationError as error:
        raise RecordError(
            "The state of sending to the plant cannot be read.",
            where=printable(str(path)),
            remedy="Delete the file; it is written again.",
        ) from error


@dataclass
class _Batch:
    """Values of the rows that one transaction inserts."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    parts: dict[str, str] = field(default_factory=dict)
    """Shared parts of runs by their digest."""
    open_runs: list[dict[str, Any]] = field(default_factory=list)
    """Runs that are claimed in this batch and do not end in it."""
    traces: list[dict[str, Any]] = field(default_factory=list)
    size_bytes: int = 0
    """Size of the traces."""

    def add_parts(self, content: Mapping[str, Any]) -> None:
        """Add the shared parts of a run."""
        for name in SHARED_PARTS:
            part = chain.canonical(content[name])
            self.parts[hashlib.sha256(part.encode("ascii")).hexdigest()] = part


@dataclass(frozen=True)
class Head:
    """The last row that the database has of this station, and its clock."""

    station: UUID
    number: int
    hash: str
    now: datetime


def compare(
    head: Head, station: str, local: Connection, central: Connection, *, where: str
) -> None:
    """Compare the database's last row with the station's. Raises ChainRefusedError."""
    found = chain.hash_at(local, station, head.number)
    if found == head.hash:
        return
    taken: Any = central.execute(_TAKEN_OVER).one_or_none()
    if taken and chain.last_takeover(local, station) != taken.hash:
        what = "another PC runs the station"
        if taken.data is not None:
            computer = chain.data_of(taken.data).get("computer")
            what = f"{computer} runs the station since {taken.at[:19]} UTC"
        raise ChainRefusedError(Refusal.TAKEN_OVER, what, where=where)
    if found is None:
        what = f"the plant has row {head.number}, the station does not"
        raise ChainRefusedError(Refusal.REPLAYED, what, where=where)
    what = f"the plant has row {head.number} with another hash"
    raise ChainRefusedError(Refusal.FORKED, what, where=where)


class Forwarder:
    """Sends the records of one station. `forward` raises RecordError if the station's records
    cannot be read; whatever concerns the plant's database is in `state`.
    """

    def __init__(
        self,
        records: Database,
        files: FileStore,
        central: Central,
        station: str,
        clock: StationClock,
    ) -> None:
        self._records = records
        self._files = files
        self._central = central
        self._station = station
        self._clock = clock
        self._parts: set[str] = set()
        """Digests of shared parts that the database has."""
        self.state = ForwarderState()
        self.error: RecordError | None = None
        """Why the last batch was not sent."""

    def close(self) -> None:
        self._central.close()
        self._records.close()

    def forward(self) -> bool:
        """Send a batch, and report the state; True if more rows wait."""
        self.error = None
        fault = refusal = ""
        head: Head | None = None
        try:
            head = self._enter()
            batch = self._batch_after(head)
            if batch.rows:
                self._send(batch)
                head = self._enter()  # what was committed, not what was sent
        except ChainRefusedError as error:
            self._parts.clear()  # an older copy of the database may lack them
            self.error, refusal = error, error.text
        except RecordError as error:
            if error.where != self._central.shown:
                raise
            self._parts.clear()
            self.error, fault = error, error.cause or error.what
        self.state = self._state_after(head, fault, refusal)
        self._report()
        self._save_state()
        return not (fault or refusal) and self.state.unsent > 0

    def has_new(self) -> bool:
        """True if the station has rows that were not sent."""
        with self._records.reading() as local:
            query = chain.rows_after(self._station, self.state.sent).limit(1)
            return local.execute(query).first() is not None

    def _enter(self) -> Head:
        """Ask the database for the last row that it has. Raises RecordError."""
        with self._central.writing() as central:
            named = {"records": self._records_id, "station": self._station}
            return Head(*central.execute(ENTER, named).one())

    @cached_property
    def _records_id(self) -> str:
        with self._records.reading() as local:
            return records_id_of(local)

    def _batch_after(self, head: Head) -> _Batch:
        """Read the rows after the database's last one. Raises ChainRefusedError for a last row that
        the station does not have.
        """
        batch = _Batch()
        with self._records.reading() as local:
            if head.number:
                with self._central.writing() as central:
                    compare(head, self._station, local, central, where=self._central.shown)
            following = chain.rows_after(self._station, head.number).limit(BATCH_ROWS)
            rows = local.execute(following).mappings().all()
            runs = {row["run_id"] for row in rows if row["event"] in chain.WITH_DIGESTS}
            contents = chain.contents_of(local, runs)
        for row in rows:
            content = contents.get(row["run_id"]) if row["event"] in chain.ENDINGS else None
            if content is not None:
                traces = list(self._traces_of(content))
                batch.size_bytes += sum(len(each["data"]) for each in traces)
                if batch.traces and batch.size_bytes > BATCH_BYTES:
                    break
                batch.traces += traces
                batch.add_parts(content)
            own = content and chain.canonical({name: content[name] for name in OWN_PARTS})
            batch.rows.append(row_values(row, head.station) | {"content": own})
        ended = {row["run_number"] for row in batch.rows if row["content"] is not None}
        for sent in batch.rows:
            number = sent["run_number"]
            if sent["event"] == chain.CLAIMED and number not in ended and number in contents:
                batch.add_parts(contents[number])
                parts = {name: contents[number][name] for name in ("run", "targets", "unit")}
                batch.open_runs.append(
                    {
                        "station": head.station,
                        "run_number": number,
                        "content": chain.canonical(parts),
                    }
                )
        return batch

    def _traces_of(self, content: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        """Attachments of a run. One that is missing or damaged is left out: `plant verify` reports
        it, and the runs after it are not held up.
        """
        for file in content["attachments"]:
            with suppress(RecordError):
                yield {"sha256": file["sha256"], "data": self._files.read(file["sha256"])}

    def _send(self, batch: _Batch) -> None:
        """Insert a batch in one transaction. Raises RecordError."""
        station = batch.rows[0]["station"]
        new = [
            {"station": station, "sha256": sha256, "content": part}
            for sha256, part in sorted(batch.parts.items())
            if sha256 not in self._parts
        ]
        # Sorted, so that two senders that insert the same rows cannot deadlock.
        traces = sorted(batch.traces, key=itemgetter("sha256"))
        with self._central.writing() as central:
            for statement, values in (
                (_ADD_PART, new), (_ADD_TRACE, traces), (_ADD_OPEN, batch.open_runs),
                (ADD_ROW, batch.rows),
            ):  # fmt: skip
                if values:
                    central.execute(statement, values)
        self._parts |= {each["sha256"] for each in new}

    # -- state ------------------------------------------------------------------------------------

    def _state_after(self, head: Head | None, fault: str, refusal: str) -> ForwarderState:
        now, number, offset_s = self._clock.utc(), self.state.sent, self.state.clock_offset_s
        if head is not None:
            number, offset_s = head.number, (now - head.now).total_seconds()
        with self._records.reading() as local:
            last, oldest = _rest(local, self._station, number)
        return ForwarderState(
            utc_text(now), number, last - number, oldest, offset_s, fault, refusal
        )

    def _save_state(self) -> None:
        """Write the state to its file, if the disk takes it: sending goes on without."""
        path = state_file(self._files.folder, self._station)
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            # `flasher plant send` may write it too while the station runs.
            part = part_of(path, left_s=_PART_AGE_S)
            try:
                part.write_bytes(_STATE.dump_json(self.state))
                part.replace(path)  # not flushed to the disk: the next attempt writes it again
            finally:
                part.unlink(missing_ok=True)

    def _report(self) -> None:
        """Report the state to the database, if it can be reached."""
        state = self.state
        if state.fault:
            return
        values = {
            "version": __version__,
            "unsent": state.unsent,
            "oldest": state.oldest_unsent_at,
            "offset_s": state.clock_offset_s,
            "free": None,
            "refusal": state.refusal,
        }
        with suppress(OSError):
            values["free"] = shutil.disk_usage(self._files.folder).free
        try:
            with self._central.writing() as central:
                if state.refusal.startswith(_OF_TWO):
                    central.execute(_REPORT_OTHER, {"refusal": state.refusal})
                if not state.refusal.startswith(Refusal.TAKEN_OVER):
                    central.execute(_REPORT, values)
        except RecordError as error:
            self.state = replace(state, fault=error.cause or error.what)


def row_values(row: Mapping[Any, Any], station: UUID) -> dict[str, Any]:
    """Values of an audit row for `ADD_ROW`."""
    named = {name: row[name] for name in _ROW}
    return named | {"station": station, "run_number": row["run_id"], "content": None}


def _rest(local: Connection, station: str, number: int) -> tuple[int, str]:
    """Number of the last row, and time of the first row after `number`."""
    first = local.execute(chain.rows_after(station, number).limit(1)).mappings().one_or_none()
    if first is None:
        return number, ""
    return chain.last_number(local, station), str(first["at"])
