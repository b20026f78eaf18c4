"""`flasher plant deliver`, `deliveries` and `reconcile`: runs for the plant's other systems."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

from flasher.cli.extras import need
from flasher.cli.output import Output, counted, utc_time
from flasher.cli.plant.commands import DeliveryOptions
from flasher.cli.plant.documents import PlantDeliverDocument, PlantDeliveriesDocument
from flasher.cli.station.records import period_of
from flasher.cli.stop import stop_on_signal
from flasher.errors import ExitCode, UsageError
from flasher.plant.central import open_central
from flasher.plant.deliveries import (
    Answer,
    Attempt,
    Deliveries,
    DeliveryState,
    unknown_receiver,
)
from flasher.plant.delivery_list import (
    Delivery,
    DeliveryFilter,
    ReceiverStatus,
    deliveries_of,
    receivers_of,
)
from flasher.plant.receivers import load_receivers
from flasher.plant.reconcile import Reconciliation, compare, read_list
from flasher.protocol.text import printable

_SHOWN_MAX: Final = 20


def deliver(output: Output, url: str, file: Path, *, once: bool) -> int:
    need("Hand-over of runs", "handover")
    from flasher.plant.courier import Courier  # noqa: PLC0415  an extra

    receivers = load_receivers(file)
    counts: Counter[DeliveryState] = Counter()

    def count(_attempt: Attempt, answer: Answer) -> None:
        counts[answer.state] += 1

    def begun() -> None:
        names = ", ".join(each.name for each in receivers)
        output.progress(f"delivers to {names}{'' if once else ' until Ctrl-C'}")

    courier = Courier(url, receivers, count, output.progress, begun)
    with closing(courier), stop_on_signal() as stop:
        courier.deliver(stop, once=once)
    made = ", ".join(f"{count:,} {state}" for state, count in sorted(counts.items()))
    output.result(f"attempts: {made or 'none'}")
    code = ExitCode.OK if once and not stop() else ExitCode.INTERRUPTED
    return output.document(PlantDeliverDocument(dict(counts)), exit_code=code)


# -- deliveries ------------------------------------------------------------------------------------


def deliveries(
    output: Output,
    url: str,
    options: DeliveryOptions,
    limit: int,
    *,
    resend: bool,
    stop: str | None,
) -> int:
    if resend and not any(vars(options).values()):
        raise UsageError(
            "--resend would send every run again.",
            remedy="Choose which: --state refused, --serial SERIAL, --key KEY or --receiver NAME.",
        )
    since, until = period_of(options.since, options.until)
    chosen = DeliveryFilter(
        receiver=options.receiver,
        state=None if options.state is None else DeliveryState(options.state),
        station=options.station,
        serial=options.serial,
        key=options.key,
        since=since,
        until=until,
    )
    with open_central(url) as central:
        found = Deliveries(central)
        if stop is not None:
            found.stop(stop)
            output.progress(printable(f"{stop} gets no run that arrives from now on"))
        with central.reading() as connection:
            known = receivers_of(connection)
            if chosen.receiver not in {None, *(each.name for each in known)}:
                raise unknown_receiver(str(chosen.receiver))
            size = None if resend else limit
            # Without a receiver there may be no queue to read.
            rows = deliveries_of(connection, chosen, size=size).rows[:size] if known else ()
        if resend:
            for name in dict.fromkeys(row.receiver for row in rows):
                found.send_again(name, [row.key for row in reversed(rows) if row.receiver == name])
            output.result(f"{counted(len(rows), 'run')} will be sent again")
            with central.reading() as connection:
                known = receivers_of(connection)
                again = [DeliveryFilter(row.receiver, key=row.key) for row in rows[:limit]]
                rows = tuple(row for each in again for row in deliveries_of(connection, each).rows)
        has_document = chosen.key is not None and rows
        document = found.document(str(chosen.key)) if has_document else None
    output.results(_receiver_lines(known))
    output.results(printable(line) for row in rows for line in _lines(row))
    return output.document(PlantDeliveriesDocument(known, list(rows), document))


def _receiver_lines(receivers: list[ReceiverStatus]) -> Iterator[str]:
    for each in receivers:
        counts = ", ".join(f"{count:,} {state}" for state, count in sorted(each.counts.items()))
        stopped = "" if each.stopped_at is None else f", STOPPED {utc_time(each.stopped_at)}"
        yield f"{each.name}: {counts or 'no runs'}, since {utc_time(each.since)}{stopped}"
        if each.oldest_open_at is not None:
            yield f"  the oldest open one arrived {utc_time(each.oldest_open_at)}"
    if not receivers:
        yield "no receivers: flasher plant deliver --receivers FILE --database URL adds them"


def _lines(row: Delivery) -> Iterator[str]:
    nature = ", VIRTUAL" if row.is_virtual else ""
    yield f"{row.serial}, {row.outcome}{nature}, {row.station}: {row.state} to {row.receiver}"
    yield f"  key {row.key}"
    tried = counted(row.attempts, "attempt")
    later = "" if row.next_at is None else f", next at {utc_time(row.next_at)}"
    yield f"  {tried}{later}{': ' if row.answer else ''}{row.answer}"


# -- reconcile -------------------------------------------------------------------------------------


def reconcile(output: Output, url: str, receiver: str, file: Path, *, resend: bool) -> int:
    listed = read_list(file)
    with open_central(url) as central:
        found = Deliveries(central)
        with central.reading() as connection:
            known = {each.name for each in receivers_of(connection)}
        if receiver not in known:
            raise unknown_receiver(receiver)
        result = compare(receiver, listed, found.keys(receiver))
        retired = found.send_again(receiver, result.missing) if resend else []
    output.results(_differences(result))
    if resend and result.missing:
        output.result(f"{counted(len(result.missing) - len(retired), 'run')} will be sent again")
    for line in _listed("that were retired to files are not sent again", retired):
        output.progress(line)
    code = ExitCode.OK if result.agrees else ExitCode.VERIFICATION
    return output.document(result, exit_code=code)


def _differences(found: Reconciliation) -> Iterator[str]:
    for what, keys in (
        ("confirmed, but missing there", found.missing),
        ("more than once there", found.doubled),
        ("there, but unknown here", found.unknown),
        ("there, but not confirmed yet", found.unconfirmed),
    ):
        yield from _listed(what, keys, " (--json lists them)")
    ending = "agree" if found.agrees else "DIFFER"
    rows = counted(found.listed, "row")
    yield f"{rows} of the list and {found.delivered:,} confirmed runs: they {ending}"


def _listed(what: str, keys: Sequence[str], where_rest: str = "") -> Iterator[str]:
    if keys:
        yield f"{counted(len(keys), 'run')} {what}:"
        yield from (printable(f"  {key}") for key in keys[:_SHOWN_MAX])
    if len(keys) > _SHOWN_MAX:
        yield f"  and {len(keys) - _SHOWN_MAX:,} more{where_rest}"
