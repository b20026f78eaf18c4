"""`flasher backup`: save the memory of a device, and all its answers, in one file."""

from __future__ import annotations

import datetime
import hashlib
import io
import json
import re
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from platformdirs import user_data_path

from flasher import __version__
from flasher.api import as_target
from flasher.cli import values
from flasher.cli.files import check_new, claimed, write_whole
from flasher.cli.framework import argument, group, missing_option, option
from flasher.cli.look.info import InfoDocument, info_document, silence_error
from flasher.cli.look.memory import intel_hex, read_with_bar
from flasher.cli.options import Bus, bus_options, profile_option, target_option
from flasher.cli.output import Output, byte_count
from flasher.cli.recording import RecordingOptions, recorded_device, recording_options
from flasher.cli.terminal import agrees, check_can_ask
from flasher.documents import as_json
from flasher.errors import ErrorCode, ExitCode, UsageError, VerificationError
from flasher.files import parse_json, read
from flasher.host.query import READ_MEMORY
from flasher.i18n import text
from flasher.image.load import load
from flasher.kept_settings import (
    Setting,
    SettingResult,
    SettingState,
    restore_settings,
    settings_of_items,
)
from flasher.mock.store import AREA_START
from flasher.procedures import DeviceInfo, two_devices_error
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.settings.area import Area, area_of_image, area_of_profile
from flasher.settings.profile import load_profile

FORMAT: Final = 1
"""Format version of `backup.json`."""
_DATA: Final = "backup.json"
_MEMORY: Final = "memory.hex"
_OUTPUT: Final = "--output"
_MOCK_AREA_BYTES: Final = 16 * 1024
_EXAMPLES: Final = """\
examples:
  flasher backup -t bms -o battery.zip --image running.hex -i socketcan -c can0
  flasher backup -t bms -o battery.zip --profile bench.toml
  flasher backup -t bms -o battery.zip --no-memory       its answers, without its memory
  flasher backup -t bms -o battery.zip --mock
  flasher backup restore battery.zip -i socketcan -c can0

The documents let a tool read memory by address, and give no addresses. They come from
application_area in the profile (flasher.toml), or from an image like the one that runs; none is
guessed, since an address that does not exist may crash a device.

FILE is a zip archive, written whole or not at all: memory.hex (Intel HEX; the CRC of each message
was right) and backup.json (identity, state, faults, history, strings).
"""


_BACKUP_MAX: Final = 64 * 1024 * 1024
"""Maximum size of a backup in bytes."""
_RESTORE_EXAMPLES: Final = """\
examples:
  flasher backup restore battery.zip -i socketcan -c can0
  flasher backup restore battery.zip --yes --mock

Exit code 10 when a setting is not confirmed or reads back differently, 6 for a unit with another
serial number. Serial number, model and production information are only compared: the manufacturer
writes them, by flasher write.
"""


@dataclass(frozen=True)
class MemoryInBackup:
    """Memory that was read; `end` is exclusive."""

    start: int
    end: int
    sha256: str
    range_from: str
    """Source of the address range."""
    names_running_version: bool | None
    """True if it contains the version that the device answered; null without an answer."""


@dataclass(frozen=True)
class BackupDocument:
    """Contents of a backup, and its omissions."""

    target: str
    file: str
    size_bytes: int
    sha256: str
    """SHA-256 of the file."""
    taken_at: str
    """Local time with its UTC offset."""
    memory: MemoryInBackup | None
    items: list[str]
    """Queries that the device answered."""
    not_in_it: dict[str, str]
    """Omissions, each with the reason."""


@dataclass(frozen=True)
class DataInBackup:
    """Contents of `backup.json`."""

    format: int
    flasher: str
    """Version of flasher that wrote it."""
    taken_at: str
    connection: str
    memory: MemoryInBackup | None
    info: InfoDocument
    """Document of `flasher info --json`."""


@dataclass(frozen=True)
class RestoredDocument:
    """Settings of a device after `backup restore`."""

    target: str
    file: str
    settings: list[SettingResult]


DOCUMENTS: Final = (BackupDocument, RestoredDocument)


@dataclass(frozen=True)
class DeviceBackup:
    """Data read from a device, ready to be written to a file."""

    document: BackupDocument
    archive: bytes
    running_version: str
    """Firmware version of the device; empty without an answer."""


DEVICE_MODEL: Final = Area(AREA_START, AREA_START + _MOCK_AREA_BYTES, text("the device model"))


@group(
    runs_alone=True,
    epilog=_EXAMPLES,
    exit_codes=(
        ExitCode.BUS, ExitCode.NO_ANSWER, ExitCode.WRONG_DEVICE, ExitCode.VERIFICATION,
        ExitCode.INTERRUPTED,
    ),
)  # fmt: skip
@target_option(required=False)
@option(
    "-o", _OUTPUT, "file", metavar="FILE", type=values.FilePath("zip", gives=Path),
    panel="backup", brief=True, help="the archive to write",
)  # fmt: skip
@option(
    "--image", metavar="IMAGE", type=values.FilePath(*values.IMAGE_SUFFIXES), panel="backup",
    brief=True, help="read the addresses of this image, which is like the one that runs",
)  # fmt: skip
@option("--no-memory", is_flag=True, panel="backup", brief=True, help="leave the memory out")
@option("--force", is_flag=True, panel="backup", brief=True, help="write over a file that exists")
@profile_option
@bus_options()
@recording_options
def backup(
    output: Output,
    target: Target | None,
    bus: Bus,
    recorded: RecordingOptions,
    *,
    file: Path | None,
    image: str | None,
    no_memory: bool,
    force: bool,
    profile: str | None,
) -> int:
    """Save the application's memory of a device, and all its answers, to a file. Nothing is written
    to the device. The documents let a tool read the BMS only. `restore` writes settings back.
    """
    if target is None or file is None:
        raise missing_option("target" if target is None else "file")
    if READ_MEMORY.receiver is not target.node:
        raise UsageError(
            f"The {target.node.name} has nothing to back up: the documents give no way to read its "
            "memory, and no query for it.",
            remedy="Use -t bms; keep the image file that was flashed.",
        )
    check_new(file, _OUTPUT, force=force)
    area = None if no_memory else _address_range(image, profile, target, bus)
    bus = bus.with_profile(profile)
    with (
        claimed(file, _OUTPUT, force=force),
        recorded_device(recorded, bus, output, target) as (device, record),
    ):
        output.progress(f"asking the {target.node.name} on {device.connection.name} ...")
        found = device.identify()
        data = b""
        if area is not None and found.is_there:
            data = read_with_bar(device, area.start, area.end, output, record)
        if record.two_devices is not None:
            raise two_devices_error(target, record.two_devices, "No file was written.")
        made = backup_of(found, area, data, device.connection.name, file)
        write_whole(file, made.archive, _OUTPUT, is_private=True)
    document, memory = made.document, made.document.memory
    output.results(_lines(document))
    output.table(document.not_in_it.items(), indent=2)
    if memory is not None and memory.names_running_version is False:
        output.error_line(
            f"warning: the version that runs, {made.running_version}, is not in this memory: "
            "these may not be the addresses of the application"
        )
    return output.document(document)


@backup.action("restore", epilog=_RESTORE_EXAMPLES)
@argument("file", metavar="FILE", type=values.FilePath("zip", gives=Path), help="the archive")
@option("-y", "--yes", is_flag=True, panel="restore", brief=True, help="do not ask")
@option(
    "--force", is_flag=True, panel="restore", brief=True,
    help="write them to a unit with another serial number too",
)  # fmt: skip
@profile_option
@bus_options()
@recording_options
def restore(
    output: Output,
    bus: Bus,
    recorded: RecordingOptions,
    *,
    file: Path,
    yes: bool,
    force: bool,
    profile: str | None,
) -> int:
    """Write the settings of a backup back, those that changed and that a tool may write: user
    strings and check code. Each is read back. Memory is not written: flash memory.hex for that.
    """
    target, settings = _settings_of_file(file, bus)
    bus = bus.with_profile(profile)
    chosen = load_profile(profile, target, bus.dialect)
    if not yes:
        check_can_ask("Writing settings needs a confirmation")
    node = target.node.name
    if not yes and not agrees(
        f"Write the settings of {printable(str(file))} to the {node}?",
        interrupted="nothing was sent.",
    ):
        output.progress("nothing was written")
        return output.document(
            RestoredDocument(target.name, str(file), []), exit_code=ExitCode.INTERRUPTED
        )
    with recorded_device(recorded, bus, output, target, chosen) as (device, record):
        results = list(restore_settings(device, settings, allow_other_unit=force))
        failed = [each for each in results if each.state is SettingState.NOT_RESTORED]
        error = None
        if failed:
            error = VerificationError(
                f"{len(failed)} of {len(results)} settings of the {node} were not restored.",
                where=f"{failed[0].name}: {failed[0].detail}",
                remedy="Run the same command again.",
                code=ErrorCode.WRITE_DIFFERS,
            )
            record.failed(error)
    output.table((each.name, each.state.value.replace("_", " "), each.detail) for each in results)
    document = RestoredDocument(target.name, str(file), results)
    return output.document(document) if error is None else output.failure(error, document)


def _settings_of_file(file: Path, bus: Bus) -> tuple[Target, dict[str, Setting]]:
    """Read the target and the settings of a backup. Raises UsageError."""
    raw = read(file, _BACKUP_MAX, what="backup")
    try:
        target, items = _inside(raw)
        return target, settings_of_items(items, target, bus.dialect)
    except (
        zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError,
        LookupError, TypeError, AttributeError,
    ) as error:  # fmt: skip
        raise UsageError(
            f"{printable(str(file))} is no backup of flasher, or is damaged.",
            cause=printable(str(error)),
            remedy="Name an archive that flasher backup, a flash with --keep-settings or the page "
            "has written.",
            code=ErrorCode.FILE_NOT_READ,
        ) from error


def _inside(raw: bytes) -> tuple[Target, dict[str, Any]]:
    """Return the target and the items of a backup. Raises errors of zipfile and JSON, ValueError
    and LookupError.
    """
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        if archive.getinfo(_DATA).file_size > _BACKUP_MAX:
            raise ValueError(f"{_DATA} in it is too large")
        inside = parse_json(archive.read(_DATA))
    if inside["format"] != FORMAT:
        raise ValueError(f"its format is {inside['format']!a}")
    return as_target(inside["info"]["target"]), inside["info"]["items"]


def _address_range(image: str | None, profile: str | None, target: Target, bus: Bus) -> Area:
    """Return the address range of the application. Raises UsageError if no option or profile gives
    it.
    """
    if image is not None:
        found = area_of_image(load(image))
        if found is None:
            raise UsageError(
                f"{printable(image)} has no addresses: it is a raw binary.",
                where="--image",
                remedy="Name an Intel HEX, S-record or ELF file of it, or a profile with its area.",
            )
        return found
    found = area_of_profile(load_profile(profile, target, bus.dialect))
    if found is not None:
        return found
    if bus.mock:
        return DEVICE_MODEL
    raise UsageError(
        f"The addresses of the {target.node.name}'s application are not known.",
        cause="the documents give no addresses, and a wrong one may crash a device",
        remedy=f"Name an image like the one that runs (--image), or write [{target.name}"
        ".application_area] with start and size_bytes into flasher.toml; --no-memory saves the "
        "rest.",
    )


def backup_of(
    found: DeviceInfo, area: Area | None, data: bytes, connection: str, file: Path
) -> DeviceBackup:
    """Build the backup. Raises NoAnswerError for a device that did not answer."""
    if not found.is_there:
        raise silence_error(found)
    running = "" if found.version is None else printable(str(found.version.firmware_version))
    memory = None
    if area is not None:
        memory = MemoryInBackup(
            start=area.start,
            end=area.end,
            sha256=hashlib.sha256(data).hexdigest(),
            range_from=area.source,
            names_running_version=running.encode("ascii") in data if running else None,
        )
    not_in_it = {
        text("other memory"): text("bootloader, settings, RAM: the documents give no addresses")
    }
    if memory is None:
        not_in_it = {text("memory"): text("left out on request")}
    taken_at = datetime.datetime.now().astimezone()
    info = info_document(found)
    at = taken_at.isoformat(timespec="seconds")
    inside = DataInBackup(FORMAT, __version__, at, connection, memory, info)
    archive = _archive(inside, data, taken_at)
    document = BackupDocument(
        target=found.target.name,
        file=str(file),
        size_bytes=len(archive),
        sha256=hashlib.sha256(archive).hexdigest(),
        taken_at=at,
        memory=memory,
        items=[*(name for name, answer in info.items.items() if answer is not None), "faults"],
        not_in_it=not_in_it | info.unanswered,
    )
    return DeviceBackup(document, archive, running)


def backup_folder() -> Path:
    """Folder of the backups that flasher makes by itself."""
    return user_data_path("flasher", appauthor=False) / "backups"


def own_backup_path(found: DeviceInfo) -> Path:
    """Path of a new backup in that folder, named by device, serial number and time. Raises
    UsageError if the folder cannot be created.
    """
    folder = backup_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            text(
                "Cannot create the folder for backups: {value}.", value=error.strerror or str(error)
            ),
            where=printable(str(folder)),
            remedy=text("Make room, or create the folder by hand."),
            code=ErrorCode.FILE_NOT_WRITTEN,
        ) from error
    version = found.version
    serial = "" if version is None else re.sub(r"[^A-Za-z0-9]+", "-", str(version.serial_number))
    at = f"{datetime.datetime.now().astimezone():%Y%m%d-%H%M%S}"
    name = "-".join(each for each in (found.target.name, serial.strip("-"), at) if each)
    return folder / f"{name}.zip"


def _archive(inside: DataInBackup, data: bytes, taken_at: datetime.datetime) -> bytes:
    files = {_DATA: f"{json.dumps(as_json(inside), indent=2)}\n".encode()}
    if inside.memory is not None:
        files[_MEMORY] = intel_hex(inside.memory.start, data)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, taken_at.timetuple()[:6])
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return packed.getvalue()


def _lines(document: BackupDocument) -> Iterator[str]:
    memory = document.memory
    yield f"{printable(document.file)}, {byte_count(document.size_bytes)}, has"
    if memory is not None:
        size = byte_count(memory.end - memory.start)
        yield f"  {_MEMORY}   0x{memory.start:08X}..0x{memory.end - 1:08X}, {size}"
        yield f"    sha256     {memory.sha256}"
        yield f"               addresses of {printable(memory.range_from)}"
        if memory.names_running_version:
            yield "               it contains the version that runs"
    yield f"  {_DATA}  {', '.join(name.replace('-', ' ') for name in document.items)}"
    yield "and has not"
