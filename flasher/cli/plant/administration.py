"""`flasher plant init`, `status` and `send`."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import make_url

from flasher.cli.output import Output, counted, duration, utc_time
from flasher.cli.plant.documents import (
    PlantFetchDocument,
    PlantInitDocument,
    PlantSendDocument,
    PlantStatusDocument,
)
from flasher.cli.station.place import station_of_plant
from flasher.cli.station.records import passed_twice_lines
from flasher.errors import ExitCode
from flasher.plant.alerts import CheckKind, CheckState, StationOverview, alerts, overviews
from flasher.plant.bounds import Bounds
from flasher.plant.central import open_central, plant_location
from flasher.plant.process import Sending
from flasher.plant.schema import PLANT_SCHEMA
from flasher.plant.setup import create_database, role_of, setup
from flasher.plant.store import passed_twice
from flasher.protocol.text import printable
from flasher.report.scale import share_text
from flasher.station.records.database import Location
from flasher.station.records.model import RunState, Units
from flasher.station.reports import TWICE_MAX
from flasher.station.shift_counts import DEFAULT_SHIFTS


def init(
    output: Output, url: str, stations: Sequence[str], renewed: Sequence[str], *, prints: bool
) -> int:
    location = plant_location(url)
    if prints:
        roles = {name: role_of(name) for name in (*stations, *renewed)}
        lines = [
            *_before(location, url, stations, renewed),
            *_after(location, roles, roles.values()),
        ]
        output.results(lines)
        return output.document(PlantInitDocument(is_new=False, roles=roles, to_run=lines))
    if create_database(url):
        output.result(printable(f"created the database {location.url.database}"))
    made = setup(url, stations, datetime.now(UTC), renewed=renewed)
    if made.before is None:
        output.result("created the tables")
    elif made.before != PLANT_SCHEMA:
        output.result(f"upgraded the tables from schema {made.before} to {PLANT_SCHEMA}")
    else:
        output.result("the tables are up to date")
    for each in made.stations:
        is_new = each in made.created
        what = "created its role" if is_new else "has its role"
        output.result(printable(f"{each.station}: {what}, {each.role}"))
    roles = {each.station: each.role for each in made.stations}
    lines = list(_after(location, roles, [each.role for each in made.created]))
    output.results(lines)
    return output.document(PlantInitDocument(is_new=made.before is None, roles=roles, to_run=lines))


def _before(
    location: Location, url: str, stations: Sequence[str], renewed: Sequence[str]
) -> Iterator[str]:
    """What an administrator of the server runs first, and then `init`."""
    user, name = location.url.username or "flasher_plant", str(location.url.database)
    yield "-- as an administrator of the server (psql postgres):"
    yield printable(f'CREATE ROLE "{user}" LOGIN CREATEROLE;')
    yield printable(f'\\password "{user}"')
    yield printable(f'CREATE DATABASE "{name}" OWNER "{user}";')
    yield from _allowed(f"{name},postgres", [user])  # `init` asks there for the database
    words = ["--database", make_url(url)._replace(password=None).render_as_string()]
    words += [word for each in stations for word in ("--station", each)]
    words += [word for each in renewed for word in ("--renew", each)]
    yield "# then, which creates the tables and the roles of the stations:"
    yield printable(f"flasher plant init {shlex.join(words)}")


def _allowed(name: str, roles: Collection[str]) -> Iterator[str]:
    """Rules of the server that let roles connect to a database."""
    yield "# in pg_hba.conf, above lines that allow more:"
    yield from (printable(f"hostssl {name} {role} samenet scram-sha-256") for role in roles)
    yield "-- then, in psql:"
    yield "SELECT pg_reload_conf();"


def _after(location: Location, roles: Mapping[str, str], created: Collection[str]) -> Iterator[str]:
    """What is to be done by hand for the stations."""
    host, name = location.url.host or "localhost", location.url.database
    port = f":{location.url.port}" if location.url.port else ""
    if created:
        yield "-- in psql, a password for each new role (stations read theirs from ~/.pgpass):"
        yield from (printable(f"\\password {role}") for role in created)
    if roles:
        yield from _allowed(str(name), roles.values())
    for station, role in roles.items():
        yield printable(f"# in the station file of {station}:")
        yield printable(f'plant = "postgresql://{role}@{host}{port}/{name}?sslmode=verify-full"')


# -- status ----------------------------------------------------------------------------------------


def status(output: Output, url: str, bounds: Bounds) -> int:
    now = datetime.now().astimezone()
    with open_central(url) as central, central.reading() as connection:
        found = overviews(connection, bounds, DEFAULT_SHIFTS, now)
        twice = passed_twice(connection, TWICE_MAX)
    for each in found:
        output.results(_lines(each))
    if not found:
        output.result("no stations: flasher plant init --station NAME --database URL adds one")
    for station, check in alerts(found):
        output.result(printable(f"ALERT {station}: {check.text}"))
    output.results(passed_twice_lines(twice))
    code = ExitCode.PARTIAL if any(alerts(found)) else ExitCode.OK
    if any(check.kind is CheckKind.REFUSED for _, check in alerts(found)):
        code = ExitCode.VERIFICATION
    return output.document(PlantStatusDocument(found, twice), exit_code=code)


def _lines(of: StationOverview) -> Iterator[str]:
    each, name = of.status, printable(of.status.station)
    if each.silent_s is None:
        yield f"{name}: has never connected"
        return
    silent = next(check for check in of.checks if check.kind is CheckKind.SILENT)
    seen = "SILENT for" if silent.state is CheckState.ALERT else "reported"
    ago = "" if silent.state is CheckState.ALERT else " ago"
    yield f"{name}: {seen} {duration(each.silent_s)}{ago}, flasher {printable(each.version)}"
    if each.refusal:
        yield printable(f"  REFUSED: {each.refusal}")
    if each.other_reported_at is not None:
        at = utc_time(each.other_reported_at)
        yield printable(f"  another PC, REFUSED at {at}: {each.other_refusal}")
    at = f", of {printable(each.head_at)}" if each.head_at else ""
    yield f"  last row:  {each.head_number:,}{at}, hash {(each.head_hash or 'none')[:16]}"
    if (last := of.activity.last_run) is not None:
        code = "" if last.state is RunState.PASS else f" {last.code}"
        yield printable(
            f"  last run:  {last.serial}, {utc_time(last.begun_at)}, {last.state.value}{code}"
        )
    yield f"  yield:     shift {_yield_text(of.activity.shift)}, day {_yield_text(of.activity.day)}"
    if each.unsent:
        oldest = printable(each.oldest_unsent_at or "")
        yield f"  unsent:    {counted(each.unsent, 'row')}, the first of {oldest}"
    if each.clock_offset_s is not None:
        yield f"  clock:     {each.clock_offset_s:+.1f} s"
    for used in each.recipes:
        recipe = f"{used.name}, revision {used.revision}, {used.digest[:16] or 'a local file'}"
        withdrawn = ", WITHDRAWN: begins no unit" if used.is_withdrawn else ""
        yield printable(f"  socket {used.socket}:  {recipe}{withdrawn}")
        if used.published:
            yield printable(f"    not approved yet: {used.published[:16]}")
    if each.disk_free_bytes is not None:
        yield f"  disk:      {each.disk_free_bytes / 1024**3:.1f} GiB free"
    for check in of.checks:
        if check.state is CheckState.UNKNOWN:
            yield printable(f"  not known: {check.kind.value}: {check.text}")


def _yield_text(found: Units) -> str:
    share = "" if found.yield_share is None else f" ({share_text(found.yield_share)})"
    return f"{found.passed:,} of {counted(found.units, 'unit')}{share}"


# -- sending ---------------------------------------------------------------------------------------


def sending_of(file: Path) -> Sending:
    """What a station file asks to send. Raises UsageError."""
    config = station_of_plant(file)
    files = Path(config.files) if config.files else None
    sockets = tuple(each.name for each in config.socket)
    return Sending(config.plant, config.name, config.records, files, sockets)


def fetch(output: Output, sockets: Path) -> int:
    with closing(sending_of(sockets).open_fetcher()) as fetcher:
        found = fetcher.fetch()
    for given in found.recipes:
        state = given.fault or ("fetched now" if given.digest in found.new else "was here")
        output.result(printable(f"{given.digest}, sockets {', '.join(given.sockets)}: {state}"))
    for digest in found.withdrawn:
        output.result(f"{digest}: WITHDRAWN")
    if not found.recipes:
        output.result("the plant gives no recipe to this station")
    code = ExitCode.PARTIAL if any(each.fault for each in found.recipes) else ExitCode.OK
    return output.document(PlantFetchDocument(found), exit_code=code)


def send(output: Output, sockets: Path) -> int:
    with closing(sending_of(sockets).open()) as forwarder:
        while forwarder.forward():
            output.progress(f"{counted(forwarder.state.unsent, 'row')} left")
        state = forwarder.state
        if forwarder.error is not None:
            raise forwarder.error
    output.result(f"everything is sent: {counted(state.sent, 'row')}")
    return output.document(PlantSendDocument(state))
