"""`flasher station export`, `take-over`, `bring-in`: another PC continues the station."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from flasher.cli.documents import document_of
from flasher.cli.files import check_writable
from flasher.cli.output import Output, counted
from flasher.cli.station.commands import RecordsOptions
from flasher.cli.station.documents import BroughtInDocument, ExportDocument, TakenOverDocument
from flasher.cli.station.maintenance import open_as_station
from flasher.cli.station.place import operator_of, records_of, station_of_plant
from flasher.cli.station.setup import ask_secret
from flasher.errors import UsageError
from flasher.files import TOML_MAX_SIZE, read
from flasher.protocol.text import printable
from flasher.station.config import load_config
from flasher.station.export import EXPORT_MAX_SIZE, KEY_NAME, seal, unseal
from flasher.station.recipe_file import load_recipe
from flasher.station.records.branch import BroughtIn, bring_in
from flasher.station.records.database import (
    Database,
    Location,
    StationLock,
    locate_records,
    open_read_only,
)
from flasher.station.records.errors import KeyMissingError, NotFoundError, mapped
from flasher.station.records.files import FileStore, whole_file
from flasher.station.records.queries import Records
from flasher.station.records.signatures import KEY_MAX_SIZE
from flasher.station.records.store import Store, SystemClock

_PASSPHRASE_MAX_SIZE = 4096


def export(
    output: Output,
    sockets: Path,
    recipes: tuple[Path, ...],
    file: Path,
    passphrase_file: Path | None,
) -> int:
    check_writable(file, "FILE")
    config = load_config(sockets)
    members = {"station.toml": read(sockets, TOML_MAX_SIZE)}
    left_out = []
    named = [Path(config.badges)] if config.badges else []
    named += [Path(config.label.template)] if config.label else []
    for recipe in recipes:
        named += load_recipe(recipe).files
    for path in named:
        try:
            name = path.resolve().relative_to(sockets.resolve().parent).as_posix()
        except ValueError:
            left_out.append(str(path))
            continue
        members[name] = read(path, EXPORT_MAX_SIZE)
    records = RecordsOptions(sockets=sockets)
    with closing(open_as_station(records, changes=False)) as store:
        key = store.signer.key_file
        if not key.exists():
            raise KeyMissingError(
                "The signing key is not there, and an export without it is of no use.",
                where=printable(str(key)),
                remedy="Put the key file back, or start the station once, which makes it.",
            )
        members[KEY_NAME] = read(key, KEY_MAX_SIZE)
    seal(file, members, _passphrase(passphrase_file, repeat=True))
    output.result(printable(f"{file}: {config.name}, {counted(len(members), 'file')}, sealed"))
    for each in left_out:
        output.result(printable(f"  NOT in it, as it is not beside the station file: {each}"))
    output.progress("Keep the passphrase apart from the file. Both together are the station's key.")
    return output.document(
        ExportDocument(
            station=config.name, file=str(file), members=sorted(members), left_out=left_out
        )
    )


def take_over(
    output: Output,
    sockets: Path,
    url: str,
    sealed: Path | None,
    archive: Path | None,
    passphrase_file: Path | None,
    operator: str | None,
    reason: str,
) -> int:
    from flasher.plant.central import plant_location  # noqa: PLC0415  an extra
    from flasher.plant.forwarder import state_file  # noqa: PLC0415
    from flasher.plant.process import Sending  # noqa: PLC0415
    from flasher.plant.takeover import Takeover  # noqa: PLC0415

    plant_location(url)
    members = {} if sealed is None else unseal(sealed, _passphrase(passphrase_file, repeat=False))
    key = members.pop(KEY_NAME, None)
    written = list(_unpack(members, sockets))
    config = station_of_plant(sockets)
    records = RecordsOptions(sockets=sockets)
    place, clock, who = records_of(records), SystemClock(), operator_of(operator)
    location = locate_records(place.url, place.files)
    _check_alone(location, config.name)
    lock = StationLock(config.name, location.folder)
    lock.acquire()
    try:
        found = Takeover(
            config.name, url, config.plant, location, place.key_locations, who, reason, archive
        ).run(key, clock.utc)
    finally:
        lock.release()
    for path in written:
        output.result(printable(f"wrote {path}"))
    output.result(
        f"{printable(found.station)}: taken over with {counted(found.rows, 'audit row')} and"
        f" {counted(found.runs, 'run')}"
    )
    state_file(location.folder, config.name).unlink(missing_ok=True)
    brought = None
    with place.open(config.name, create=False) as store:
        store.recover()
        for serial in found.active:
            output.result(
                printable(f"  {serial} was active at the other PC: check it, then scan it again")
            )
        if found.set_aside is not None:
            output.result(printable(f"  the records of this PC are now {found.set_aside}"))
            brought = _bring(output, store, found.set_aside, location.folder, who, reason)
    with closing(Sending(config.plant, config.name, place.url, place.files).open()) as forwarder:
        while forwarder.forward():
            pass
        if forwarder.error is not None:
            output.progress(f"not all is sent to the plant: {printable(forwarder.error.what)}")
    return output.document(
        document_of(
            TakenOverDocument,
            found,
            set_aside=None if found.set_aside is None else str(found.set_aside),
            written=written,
            brought_in=brought,
        )
    )


def bring(
    output: Output, records: RecordsOptions, file: Path, operator: str | None, reason: str
) -> int:
    with closing(open_as_station(records, changes=True)) as store:
        store.recover()
        folder = locate_records(str(file)).folder
        brought = _bring(output, store, file, folder, operator_of(operator), reason)
        if brought is None:
            output.result("nothing to do: the station has every row of these records")
        station = store.station
    return output.document(BroughtInDocument(station=station, brought_in=brought))


def _bring(
    output: Output, store: Store, file: Path, folder: Path, who: str, reason: str
) -> BroughtIn | None:
    clock = SystemClock()
    with closing(_opened(file, folder)) as branch:
        try:
            brought = bring_in(
                store, branch, FileStore(folder), by=who, reason=reason, now=clock.utc()
            )
        except NotFoundError:
            return None
    output.result(
        f"brought in as a branch: rows {brought.first} to {brought.last},"
        f" {counted(len(brought.runs), 'run')}"
    )
    for serial in brought.conflicts:
        output.result(printable(f"  {serial} passed at both PCs: check the unit and its label"))
    return brought


def _opened(file: Path, folder: Path) -> Database:
    return open_read_only(locate_records(str(file), folder), SystemClock().utc())


def _check_alone(location: Location, station: str) -> None:
    """Check that no other station has records in the file that would be replaced. Raises
    UsageError, RecordError.
    """
    if location.file is None or not location.file.exists():
        return
    with closing(_opened(location.file, location.folder)) as database:
        others = [name for name in Records(database).stations() if name != station]
    if others:
        raise UsageError(
            f"These records have other stations too: {', '.join(map(printable, others))}.",
            where=location.shown,
            remedy="Name another file in `records` of the station file.",
        )


def _unpack(members: dict[str, bytes], sockets: Path) -> Iterator[str]:
    """Write the settings that this PC does not have; yields their paths."""
    for name, data in members.items():
        path = sockets if name == "station.toml" else sockets.parent / name
        if not path.exists():
            with mapped(printable(str(path)), writes=True):
                path.parent.mkdir(parents=True, exist_ok=True)
                with whole_file(path) as part:
                    part.write_bytes(data)
            yield str(path)


def _passphrase(file: Path | None, *, repeat: bool) -> str:
    """The passphrase from a file, a terminal, or the first line of a pipe. Raises UsageError."""
    if file is not None:
        return read(file, _PASSPHRASE_MAX_SIZE).decode("utf-8", "replace").strip()
    typed = ask_secret("Passphrase: ")
    is_typed = sys.stdin is not None and sys.stdin.isatty()
    if repeat and is_typed and ask_secret("Repeat the passphrase: ") != typed:
        raise UsageError("The two passphrases differ.", remedy="Run the command again.")
    return typed
