"""`flasher station roles`: users of a PostgreSQL server that can add or read records, no more."""

from __future__ import annotations

from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

from flasher.cli.output import Output
from flasher.cli.station.documents import RoleDocument, StationRolesDocument
from flasher.cli.station.records import records_of
from flasher.errors import ExitCode
from flasher.protocol.text import printable
from flasher.station.records.database import locate, open_database
from flasher.station.records.roles import check_roles, grant_roles


def run(options: SimpleNamespace, output: Output) -> int:
    """Run the command; returns the exit code. Records that are not there yet are made: a station
    that may not make tables needs them.
    """
    place = records_of(options)
    location = locate(place.url, Path())
    check_roles(location, options.station_role, options.reader_role)
    with closing(
        open_database(location, datetime.now(UTC), lock_timeout_s=place.lock_timeout_s)
    ) as database:
        made = grant_roles(database, options.station_role, options.reader_role)
    roles = [
        RoleDocument(name=options.station_role, may="add", is_new=options.station_role in made),
        RoleDocument(name=options.reader_role, may="read", is_new=options.reader_role in made),
    ]
    for role in roles:
        new = ", new" if role["is_new"] else ""
        output.result(f"{printable(role['name'])}: may {role['may']} records{new}")
    for name in made:
        output.progress(f"Give {printable(name)} a password: in psql, \\password {printable(name)}")
    output.document(StationRolesDocument(records=location.shown, roles=roles))
    return ExitCode.OK
