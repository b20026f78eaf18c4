"""`flasher station backup`, `verify`, `key`, `accept`, `upgrade`: maintain the records."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

from flasher.cli.bar import Bar
from flasher.cli.files import check_writable
from flasher.cli.output import Output, byte_count, counted
from flasher.cli.station.commands import RecordsOptions
from flasher.cli.station.documents import (
    AcceptedDocument,
    SigningKeyDocument,
)
from flasher.cli.station.place import open_to_read, operator_of, records_of, the_station
from flasher.errors import ExitCode, UsageError
from flasher.files import read
from flasher.protocol.text import printable
from flasher.station.records.database import locate_records, no_records
from flasher.station.records.model import Examination, Problem
from flasher.station.records.signatures import fingerprint
from flasher.station.records.store import Store, SystemClock
from flasher.station.records.upgrade import upgrade as upgrade_records
from flasher.station.sealed import CERTIFICATE_MAX_SIZE

ELSEWHERE: Final = "heads stored elsewhere"


def open_as_station(records: RecordsOptions, *, changes: bool) -> Store:
    """Open the records as the station in the options, or as their only station."""
    place = records_of(records)
    name = place.station
    if name is None:
        with closing(open_to_read(records)) as store:
            name = the_station(store.read.stations())
    return place.open(name, create=False, read_only=not changes)


def backup(output: Output, records: RecordsOptions, file: Path) -> int:
    with closing(open_to_read(records)) as store:
        output.progress(f"Copies the records to {printable(str(file))}.")
        check_writable(file, "FILE")
        made = store.backup(file)
    output.result(f"{printable(str(made.path))}: {byte_count(made.size_bytes)}, checked")
    output.result(f"  sha256: {made.sha256}")
    output.result(f"  traces: {printable(made.path.name)}.files beside it")
    return output.document(made)


# -- detecting changes ----------------------------------------------------------------------------


def verify(output: Output, records: RecordsOptions, *, is_all: bool) -> int:
    look = {"unit": " rows", "desc": "examined", "unit_scale": True}
    with closing(open_to_read(records)) as store, Bar(output, **look) as bar:
        found = store.examine(incremental=not is_all, progress=bar.move_to)
    for line in problem_lines(found.problems):
        output.result(printable(line))
    for line in found.unreached:
        output.result(printable(f"heads NOT REACHED: {line}"))
    for line in found.remarks:
        output.progress(f"note: {printable(line)}")
    if found.problems:
        output.result(counted(len(found.problems), "problem"))
    else:
        _print_checked(found, output)
    code = ExitCode.VERIFICATION if found.problems else ExitCode.OK
    return output.document(found, exit_code=code)


def verify_certificate(output: Output, records: RecordsOptions, file: Path) -> int:
    from flasher.station.certificate_check import check_certificate  # noqa: PLC0415  loads jinja2

    data = read(file, CERTIFICATE_MAX_SIZE, what="certificate")
    with closing(open_to_read(records)) as store:
        found = check_certificate(store, data)
    shown = f"{found.serial}, part {found.part}: run {found.run_id}, {found.state.value}"
    output.result(printable(shown))
    for line in found.problems:
        output.result(printable(f"  NOT PROVEN: {line}"))
    if not found.problems:
        output.result(printable(f"  signed by {found.station}, key {found.fingerprint}"))
        output.result("  unchanged, and the run is in these records")
    for line in found.remarks:
        output.progress(f"note: {printable(line)}")
    code = ExitCode.VERIFICATION if found.problems else ExitCode.OK
    return output.document(found, exit_code=code)


def problem_lines(problems: Sequence[Problem]) -> Iterator[str]:
    """Format problems as lines: first those of the schema; equal problems share a line."""
    schema, others = "schema, ", []
    alike: dict[str, list[str]] = {}
    for each in problems:
        if each.where.startswith(schema):
            alike.setdefault(each.what, []).append(each.where.removeprefix(schema))
        else:
            others.append(f"{each.where}: {each.what}")
    for what, names in alike.items():
        shown = f"{names[0]}, {names[1]} and {len(names) - 2} more" if len(names) > 3 else None
        yield f"schema, {shown or ', '.join(names)}: {what}"
    yield from others


def _print_checked(found: Examination, output: Output) -> None:
    since = ""
    if found.since is not None:
        since = f" since the examination of {found.since[:16].replace('T', ' ')} UTC"
    if found.is_checked_elsewhere:
        output.result(f"records, traces and audit trails{since} are as they were written")
    elif found.kept:
        output.result(
            f"no difference in the records{since}; NOT CHECKED as a whole against {ELSEWHERE}:"
            " whoever can write beside the key could have forged records and heads"
        )
    else:
        output.result(f"no difference in the records{since}; NOT CHECKED against {ELSEWHERE}")
    if since:
        output.result("  older records were examined then; --all examines everything again")
    for each in found.kept:
        where = "the heads in" if each.is_elsewhere else "the heads beside the key, in"
        rows = f"{each.station}: rows {each.first:,} to {each.last:,}"
        output.result(printable(f"  {rows} match {where} {each.place}"))
        if each.first > 1:
            output.result(f"    rows before row {each.first:,} have no head there")
        if each.last < each.rows:
            output.result(f"    rows after row {each.last:,} have no head there yet")
    beside = {each.station for each in found.kept}
    for name in found.unkept:
        missing = "heads are stored only beside the key"
        if name not in beside:
            missing = "no heads were found; an older copy of the records could not be detected"
        output.result(f"  {printable(name)}: {missing}")
    output.result(f"  {counted(found.traces, 'trace')} of runs that passed agree with the records")
    if found.unkept and not found.unreached:
        output.progress(
            "Name another place for the heads: `heads` in the station file, or --heads."
        )


# -- the key, and decisions of people --------------------------------------------------------------


def key(
    output: Output,
    records: RecordsOptions,
    operator: str | None,
    reason: str | None,
    *,
    rotate: bool,
    lost: bool,
) -> int:
    if rotate and lost:
        raise UsageError("--rotate and --lost cannot be combined.", remedy="Remove one of them.")
    with closing(open_as_station(records, changes=rotate or lost)) as store:
        if lost:
            if not reason:
                raise UsageError("--lost needs a reason.", remedy="Add --reason TEXT.")
            store.replace_lost_key(operator_of(operator), reason)
        elif rotate:
            store.rotate_key(operator_of(operator))
        signer = store.signer
        public, file = signer.public, signer.key_file
        places = (signer.key_locations.beside_key, *signer.key_locations.elsewhere)
        heads = tuple(each.shown for each in places)
    is_there = file.exists()
    output.result(f"{printable(store.station)}: key {fingerprint(public)}")
    output.result(f"  public: {public}")
    output.result(f"  file:   {printable(str(file))}" + ("" if is_there else " (MISSING)"))
    output.result(f"  heads:  {', '.join(heads)}")
    return output.document(
        SigningKeyDocument(
            station=store.station,
            fingerprint=fingerprint(public),
            public=public,
            file=str(file),
            is_there=is_there,
            heads=heads,
        )
    )


def accept(
    output: Output, records: RecordsOptions, what: str, operator: str | None, reason: str
) -> int:
    who = operator_of(operator)
    with closing(open_as_station(records, changes=True)) as store:
        if what == "clock":
            store.release_clock(who, reason)
            done = "the clock was accepted; the station may begin units from now on"
        else:
            lost = store.accept_restored(who, reason)
            done = f"the restored records were accepted; {counted(lost, 'audit row')} lost"
    output.result(f"{printable(store.station)}: {done}")
    return output.document(AcceptedDocument(station=store.station, what=what))


def upgrade(output: Output, records: RecordsOptions) -> int:
    place = records_of(records)
    location = locate_records(place.url, place.files)
    if location.file is None or not location.file.exists():
        raise no_records(location)
    done = upgrade_records(
        location,
        choose=lambda names: place.station or the_station(names),
        key_locations=place.key_locations,
        now=SystemClock().utc,
        lock_timeout_s=place.lock_timeout_s,
    )
    if done.before == done.after:
        output.result(f"schema {done.after}: nothing to do")
    else:
        output.result(f"upgraded from schema {done.before} to schema {done.after}")
    if done.backup is not None:
        output.result(f"  backup: {printable(str(done.backup))}")
    for each in done.problems:
        output.result(f"  {printable(each)}")
    code = ExitCode.VERIFICATION if done.problems else ExitCode.OK
    return output.document(done, exit_code=code)
