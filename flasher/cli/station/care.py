"""`flasher station backup`, `verify`, `key`, `accept` and `migrate`: care for the records."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from types import SimpleNamespace
from typing import Final

from flasher.cli.files import check_writable
from flasher.cli.output import Output, byte_count, counted
from flasher.cli.station.documents import (
    AcceptedDocument,
    BackupDocument,
    KeptHeadsDocument,
    MigratedDocument,
    ProblemDocument,
    SigningKeyDocument,
    VerifiedRecordsDocument,
)
from flasher.cli.station.records import open_to_read, records_of
from flasher.cli.station.setup import operator_of
from flasher.errors import ExitCode, UsageError
from flasher.protocol.text import printable
from flasher.station.records import Examination, Problem, Store
from flasher.station.records.keys import fingerprint
from flasher.station.records.migration import migrate

ELSEWHERE: Final = "a head kept elsewhere"


def run(options: SimpleNamespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    if options.action == "migrate":
        return _migrate(options, output)
    if options.action in ("backup", "verify"):
        with closing(open_to_read(options)) as store:
            return (
                _backup(options, output, store)
                if options.action == "backup"
                else _verify(output, store)
            )
    with closing(_open_as_station(options)) as store:
        return (
            _key(options, output, store)
            if options.action == "key"
            else _accept(options, output, store)
        )


def _open_as_station(options: SimpleNamespace) -> Store:
    """The records, as the one station that the options or the records name."""
    changes = options.action == "accept" or options.rotate or options.lost
    place = records_of(options)
    name = place.station
    if name is None:
        with closing(open_to_read(options)) as store:
            name = the_station(store.read.stations())
    return place.open(name, create=False, read_only=not changes)


def the_station(names: tuple[str, ...]) -> str:
    """The only station of the records. Raises UsageError."""
    if len(names) != 1:
        found = ", ".join(map(printable, names)) or "none"
        raise UsageError(
            f"Which station is meant? The records know: {found}.",
            remedy="Name its file with --sockets.",
        )
    return names[0]


def _backup(options: SimpleNamespace, output: Output, store: Store) -> int:
    check_writable(options.file, "FILE")
    made = store.backup(options.file)
    output.result(f"{printable(str(made.path))}: {byte_count(made.size_bytes)}, checked")
    output.result(f"  sha256: {made.sha256}")
    output.result(f"  traces: {printable(made.path.name)}.files beside it")
    output.document(
        BackupDocument(path=str(made.path), sha256=made.sha256, size_bytes=made.size_bytes)
    )
    return ExitCode.OK


# -- what was changed -----------------------------------------------------------------------------


def _verify(output: Output, store: Store) -> int:
    found = store.examine()
    for line in _problem_lines(found.problems):
        output.result(printable(line))
    for line in found.remarks:
        output.progress(f"note: {printable(line)}")
    if found.problems:
        output.result(counted(len(found.problems), "problem"))
    else:
        _say_what_was_checked(found, output)
    code = ExitCode.VERIFICATION if found.problems else ExitCode.OK
    document = VerifiedRecordsDocument(
        problems=[ProblemDocument(where=each.where, what=each.what) for each in found.problems],
        remarks=list(found.remarks),
        kept=[
            KeptHeadsDocument(
                station=each.station, path=str(each.path), first=each.first, last=each.last
            )
            for each in found.kept
        ],
        unkept=list(found.unkept),
        traces=found.traces,
        is_checked_elsewhere=found.is_checked_elsewhere,
    )
    output.document(document, exit_code=code)
    return code


def _problem_lines(problems: Sequence[Problem]) -> Iterator[str]:
    """A line for each problem; many of the schema with one cause share one, and come first, so
    that they hide nothing.
    """
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


def _say_what_was_checked(found: Examination, output: Output) -> None:
    if found.is_checked_elsewhere:
        output.result("records, traces and audit trails are as they were written")
    else:
        output.result(f"nothing in the records differs; NOT CHECKED against {ELSEWHERE}")
    for name in found.unkept:
        output.result(f"  {printable(name)}: no heads are kept; an older copy would look the same")
    for each in found.kept:
        rows = f"{each.station}: rows {each.first:,} to {each.last:,}"
        output.result(printable(f"  {rows} held against the heads in {each.path}"))
        if each.first > 1:
            output.result(f"    the rows before row {each.first:,} are held against no kept head")
    output.result(f"  {counted(found.traces, 'trace')} of runs that passed agree with the records")
    if found.unkept:
        output.progress("Name the folder of the kept heads with --heads.")


# -- the key and what a person answers for --------------------------------------------------------


def _key(options: SimpleNamespace, output: Output, store: Store) -> int:
    if options.lost:
        if not options.reason:
            raise UsageError("A lost key needs a reason.", remedy="Add --reason TEXT.")
        store.replace_lost_key(operator_of(options), options.reason)
    elif options.rotate:
        store.rotate_key(operator_of(options))
    signer = store.signer
    shown = fingerprint(signer.public)
    output.result(f"{printable(store.station)}: key {shown}")
    output.result(f"  public: {signer.public}")
    is_there = signer.key_file.exists()
    where = printable(str(signer.key_file))
    output.result(f"  file:   {where}" + ("" if is_there else " (NOT THERE)"))
    output.result(f"  heads:  {printable(str(signer.heads_file.path))}")
    output.document(
        SigningKeyDocument(
            station=store.station,
            fingerprint=shown,
            public=signer.public,
            file=str(signer.key_file),
            is_there=is_there,
            heads=str(signer.heads_file.path),
        )
    )
    return ExitCode.OK


def _accept(options: SimpleNamespace, output: Output, store: Store) -> int:
    operator = operator_of(options)
    if options.what == "clock":
        store.release_clock(operator, options.reason)
        said = "the clock is released; the station may begin units from now on"
    else:
        lost = store.accept_restored(operator, options.reason)
        said = f"the station goes on; {counted(lost, 'audit row')} of it given up as lost"
    output.result(f"{printable(store.station)}: {said}")
    output.document(AcceptedDocument(station=store.station, what=options.what))
    return ExitCode.OK


def _migrate(options: SimpleNamespace, output: Output) -> int:
    place = records_of(options)
    done = migrate(
        place.url,
        folder=place.files,
        keeping=place.keeping,
        choose=lambda names: place.station or the_station(names),
        lock_timeout_s=place.lock_timeout_s,
    )
    output.result(f"{counted(done.runs, 'run')} brought up to date as {printable(done.station)}")
    output.result(f"  backup: {printable(str(done.backup))}")
    for each in done.problems:
        output.result(f"  {printable(each)}")
    code = ExitCode.VERIFICATION if done.problems else ExitCode.OK
    document = MigratedDocument(
        station=done.station, runs=done.runs, backup=str(done.backup), problems=list(done.problems)
    )
    output.document(document, exit_code=code)
    return code
