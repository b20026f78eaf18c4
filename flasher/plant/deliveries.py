# ruff: noqa: S608  all of this SQL is written here
"""Deliveries of runs to receivers in the plant's database: open ones, and their results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final
from uuid import UUID

from sqlalchemy import Connection, text

from flasher.documents import SCHEMA_VERSION, adapter
from flasher.errors import UsageError
from flasher.plant.central import Central
from flasher.plant.claim_list import released_runs
from flasher.plant.queue import TASK
from flasher.protocol.text import printable
from flasher.station.records.errors import NotFoundError
from flasher.station.records.model import RunDetails
from flasher.station.records.queries import details_of
from flasher.station.records.schema import run
from flasher.validation import json_keys

HEARTBEAT_S: Final = 5.0
SILENCE_MAX_S: Final = 20.0
"""Time without a heartbeat after which a worker is regarded as dead."""
JOB_MAX_S: Final = 300.0
"""Time after which a job of a living worker is regarded as lost: its end could not be recorded. An
attempt and its statements take less."""


class DeliveryState(StrEnum):
    """How far the hand-over of a run to a receiver has come."""

    WAITING = "waiting"
    """It was not sent, or the receiver did not take it and will be asked again."""
    SENT = "sent"
    """It is being sent."""
    CONFIRMED = "confirmed"
    """The receiver, or the broker of MQTT, has it."""
    UNKNOWN = "unknown"
    """It was sent, and no answer says whether it was taken; it will be sent again."""
    REFUSED = "refused"
    """The receiver refuses it; it is sent again by hand only."""

    @property
    def is_settled(self) -> bool:
        return self in (DeliveryState.CONFIRMED, DeliveryState.REFUSED)


_OPEN: Final = "({})".format(
    ", ".join(f"'{each}'" for each in DeliveryState if not each.is_settled)
)
"""For `IN`: deliveries that are not settled."""
_OF: Final = "(receiver, station, number) = (:receiver, :station, :number)"
_BEGIN: Final = text(
    f"UPDATE plant_delivery SET state = 'sent', attempts = attempts + 1, sent_at ="
    f" clock_timestamp() WHERE {_OF} AND state IN {_OPEN} RETURNING attempts"
)
_RUN_OF: Final = text(
    "SELECT run_id FROM chain_row WHERE (station, number) = (:station, :number)"
    " AND content IS NOT NULL"
)
# A confirmation is true whatever another attempt found; else the last attempt counts.
_END: Final = text(
    "UPDATE plant_delivery SET state = :state, answered_at = clock_timestamp(), answer = :answer"
    f" WHERE {_OF} AND state <> 'confirmed' AND (attempts = :attempt OR :state = 'confirmed')"
)
_REGISTER: Final = text(
    "INSERT INTO plant_receiver (name) VALUES (:name) ON CONFLICT (name) DO UPDATE"
    " SET stopped_at = NULL WHERE plant_receiver.stopped_at IS NOT NULL"
)
_STOP: Final = text(
    "UPDATE plant_receiver SET stopped_at = clock_timestamp() WHERE name = :name RETURNING name"
)
_LOST: Final = text(f"""
WITH lost AS (
    SELECT j.id FROM procrastinate_jobs j LEFT JOIN procrastinate_workers w ON w.id = j.worker_id
    WHERE j.task_name = '{TASK}' AND j.status = 'doing' AND (w.id IS NULL
        OR w.last_heartbeat < now() - make_interval(secs => :silence_s)
        OR (SELECT max(at) FROM procrastinate_events e WHERE e.job_id = j.id AND e.type = 'started')
            < now() - make_interval(secs => :job_s))
    FOR UPDATE OF j SKIP LOCKED
), marked AS (
    UPDATE plant_delivery d SET state = 'unknown', answered_at = clock_timestamp(),
        answer = 'no answer: the worker ended' FROM lost WHERE d.job = lost.id AND d.state = 'sent'
)
SELECT procrastinate_retry_job_v2(id, now(), NULL, NULL, NULL) FROM lost
""")
"""Jobs of dead workers are due again."""
_JOBLESS: Final = text(f"""
SELECT plant_enqueue(d.receiver, d.station, d.number) FROM plant_delivery d
WHERE d.state IN {_OPEN} AND NOT EXISTS (
    SELECT FROM procrastinate_jobs j WHERE j.id = d.job AND j.status IN ('todo', 'doing'))
""")
"""An open delivery whose job is gone gets another one."""
_ENQUEUE: Final = text("SELECT plant_enqueue(:receiver, :station, :number)")


@dataclass(frozen=True)
class Answer:
    """What is known after an attempt."""

    state: DeliveryState
    text: str
    """What the receiver answered, or what failed."""


def key_of(station: UUID, number: int) -> str:
    """The key of a run for all receivers: from the station's audit trail, and for ever the same."""
    return f"{station}-{number}"


def parse_key(key: str) -> tuple[UUID, int]:
    """The inverse. Raises UsageError."""
    station, _, number = key.rpartition("-")
    try:
        found = UUID(station), int(number)
    except ValueError:
        found = None
    if found is None or key_of(*found) != key:
        raise UsageError(
            f"{printable(key)[:80]} is not the key of a run.",
            remedy="Copy it from flasher plant deliveries, such as"
            " 0a6c3e42-7d1f-4b58-9c3a-5d2e8f901b47-1204.",
        )
    return found


@json_keys("schema key station_id row run")
@dataclass(frozen=True)
class RunDocument:
    """A run as receivers get it."""

    key: str
    """The same for ever, and different for each run: a receiver that has it already ignores this
    document."""
    station_id: UUID
    """Identifies the audit trail of the station."""
    row: int
    """Row of the audit trail that states the end of the run."""
    run: RunDetails

    @property
    def schema(self) -> int:
        """Schema of the documents of --json."""
        return SCHEMA_VERSION


@dataclass(frozen=True)
class Attempt:
    """An attempt to deliver a run."""

    receiver: str
    station: UUID
    number: int
    attempt: int
    document: bytes

    @property
    def key(self) -> str:
        return key_of(self.station, self.number)


class Deliveries:
    """The deliveries of a plant. Methods raise RecordError."""

    def __init__(self, central: Central) -> None:
        self._central = central

    # -- what the worker does ---------------------------------------------------------------------

    def register(self, receivers: Iterable[str]) -> None:
        """Hand over the runs that arrive from now on to these receivers."""
        with self._central.writing() as connection:
            for name in receivers:
                connection.execute(_REGISTER, {"name": name})

    def begin(self, receiver: str, station: UUID, number: int) -> Attempt | None:
        """Record that a run is being sent, and make its document; None if it is settled."""
        of = {"receiver": receiver, "station": station, "number": number}
        with self._central.writing() as connection:
            attempt = connection.execute(_BEGIN, of).scalar_one_or_none()
            if attempt is None:
                return None
            made = document_of(connection, station, number)
        return Attempt(receiver, station, number, attempt, adapter(RunDocument).dump_json(made))

    def end(self, attempt: Attempt, answer: Answer) -> None:
        """Record the result of an attempt."""
        values = {
            "receiver": attempt.receiver, "station": attempt.station, "number": attempt.number,
            "attempt": attempt.attempt, "state": answer.state.value, "answer": answer.text,
        }  # fmt: skip
        with self._central.writing() as connection:
            connection.execute(_END, values)

    def sweep(self) -> int:
        """Make jobs due again whose worker is dead, or whose end was not recorded. Returns how many
        jobs.
        """
        limits = {"silence_s": SILENCE_MAX_S, "job_s": JOB_MAX_S}
        with self._central.writing() as connection:
            lost = len(connection.execute(_LOST, limits).all())
            return lost + len(connection.execute(_JOBLESS).all())

    # -- what people do ---------------------------------------------------------------------------

    def document(self, key: str) -> RunDocument:
        """The document of a run as it is sent. Raises UsageError, NotFoundError."""
        station, number = parse_key(key)
        with self._central.reading() as connection:
            return document_of(connection, station, number)

    def keys(self, receiver: str) -> dict[str, DeliveryState]:
        """Keys of all deliveries to a receiver, with their states."""
        query = text("SELECT station, number, state FROM plant_delivery WHERE receiver = :receiver")
        with self._central.reading() as connection:
            rows = connection.execute(query, {"receiver": receiver})
            return {key_of(row.station, row.number): DeliveryState(row.state) for row in rows}

    def send_again(self, receiver: str, keys: Sequence[str]) -> list[str]:
        """Hand runs over again, or sooner than planned. Returns the keys of those that cannot be:
        they were retired. Raises UsageError.
        """
        retired = []
        with self._central.writing() as connection:
            for key in keys:
                station, number = parse_key(key)
                of = {"receiver": receiver, "station": station, "number": number}
                if connection.execute(_RUN_OF, of).first() is None:
                    retired.append(key)
                else:
                    connection.execute(_ENQUEUE, of)
        return retired

    def stop(self, receiver: str) -> None:
        """Hand over no further runs to a receiver. Raises UsageError."""
        with self._central.writing() as connection:
            if connection.execute(_STOP, {"name": receiver}).first() is None:
                raise unknown_receiver(receiver)


def unknown_receiver(name: str) -> UsageError:
    return UsageError(
        f"There is no receiver {printable(name)} in the plant's database.",
        remedy="flasher plant deliveries --database URL lists them.",
    )


def document_of(connection: Connection, station: UUID, number: int) -> RunDocument:
    """Make the document of the run that ended with a row of a chain. Raises NotFoundError."""
    key = key_of(station, number)
    run_id = connection.execute(_RUN_OF, {"station": station, "number": number}).scalar()
    for details in details_of(connection, run.c.id == run_id):
        ended = details.run.marked(released_runs(connection))
        return RunDocument(key, station, number, replace(details, run=ended))
    raise NotFoundError(f"There is no run with the key {key}.")
