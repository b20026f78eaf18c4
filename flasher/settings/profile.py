"""Target profile: settings that the documents leave open, or that a product changes.

A file has values for every device, and tables for single devices that override them:

    attempts = 5
    [timings]
    ack_timeout_s = 1.0
    [wmc]
    frame_gap_s = 0.001
    [wmc.version_query]
    command = 0x3300

The table [bus] of the same file names the computer's adapter (`flasher.settings.bus`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from platformdirs import user_config_path

from flasher.errors import ErrorCode, Fault, ImageError, UsageError
from flasher.files import is_regular, read_toml
from flasher.host.identity import Identity
from flasher.host.options import DEFAULT_ATTEMPTS, PACKET_GAP_MAX_S, UpgradeOptions
from flasher.host.query import Request
from flasher.image.image import Image
from flasher.image.plausible import Cpu
from flasher.protocol.catalogue import Item
from flasher.protocol.contents import Empty, VersionInformation
from flasher.protocol.fields import BytesField, Content, TextField, WireText
from flasher.protocol.fields import field as wire_field
from flasher.protocol.spec import (
    COMMAND_SIZE,
    DIALECTS,
    IMAGE_MAX_SIZE,
    LENGTH_MAX,
    TARGETS,
    WELLING,
    Command,
    Dialect,
    Mode,
    Node,
    Target,
    can_id,
    data_size,
    find_target,
)
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings, Tries
from flasher.validation import NumberRange, Parsed

if TYPE_CHECKING:
    from flasher.bus.fallback import Fallback
    from flasher.settings.toml_reader import Reader

FILE_NAME: Final = "flasher.toml"
_BUS: Final = "bus"
"""Table of the adapter (`flasher.settings.bus`), not part of the profile."""
DEFAULT: Final = "default"
DOCUMENT: Final = "document"
_DOCUMENTED: Final = frozenset({"command_repeat_s", "command_timeout_s", "boot_version_spacing_s"})
"""Timings that the documents give; all others are readings (R12)."""
_NOT_IN_FILE: Final = ("target", "dialect", "sources")
"""Fields of `Profile` that are not in the file."""
_TABLES: Final = ("timings", "application_area", "version_query")
_DATA_MAX: Final = LENGTH_MAX - COMMAND_SIZE
_DAY_S: Final = 24 * 3600

Time = Annotated[float, NumberRange(gt=0, le=_DAY_S)]
Number16 = Annotated[int, NumberRange(ge=0, le=0xFFFF)]
Number32 = Annotated[int, NumberRange(ge=0, le=0xFFFF_FFFF)]


def _data(value: object) -> bytes:
    if isinstance(value, str):
        data = value.encode("ascii")
    elif isinstance(value, list) and not any(isinstance(item, bool) for item in value):
        data = bytes(value)
    else:
        raise TypeError
    if len(data) > _DATA_MAX:
        raise ValueError
    return data


Data = Annotated[
    bytes, Parsed(f"a text in ASCII, or a list of bytes, of {_DATA_MAX} bytes at most", _data)
]


def sent_ids(target: Target) -> dict[int, Node | None]:
    """CAN ids on which a device sends, with their receivers; None means broadcast."""
    receivers = (None, *(node for node in Node if node is not target.node))
    return {can_id(target.node, receiver): receiver for receiver in receivers}


@dataclass(frozen=True)
class ApplicationArea:
    """Address range of a device's application; bytes outside must not be sent (R8)."""

    start: Number32
    """Address of the application."""
    size_bytes: Annotated[int, NumberRange(ge=1, le=0xFFFF_FFFF)]
    """Size of the application's area."""

    @property
    def end(self) -> int:
        """One past the last address."""
        return self.start + self.size_bytes


@dataclass(frozen=True)
class VersionQuery:
    """Query for a device's firmware version: its command, and the position of the text in the
    answer.
    """

    command: Number16
    """Command of the query."""
    answer_id: Annotated[int, NumberRange(ge=0, le=0x7FF)]
    """CAN id of the answer."""
    answer_command: Number16
    """Command of the answer."""
    offset: Annotated[int, NumberRange(ge=0, le=_DATA_MAX)]
    """Position of the text in the data."""
    size_bytes: Annotated[int, NumberRange(ge=1, le=_DATA_MAX)]
    """Size of the text."""

    def request(self, target: Target) -> Request:
        """Create the request; its answer is a `VersionAnswer`."""
        rest_bytes = data_size(self.answer_command) - self.offset - self.size_bytes
        answer = Item(
            target.node,
            sent_ids(target)[self.answer_id],
            Mode.REPORT,
            self.answer_command,
            _version_answer(self.offset, self.size_bytes, rest_bytes),
            "version",
        )
        item = Item(Node.CDL, target.node, Mode.READ, self.command, Empty, "read version")
        return Request(item, answer=answer)


class VersionAnswer(Content):
    """Answer to the version query of a profile."""

    firmware_version: WireText


def _version_answer(before_bytes: int, text_bytes: int, after_bytes: int) -> type[Content]:
    """Create the content type of a version answer; bytes around the text are kept."""
    return make_dataclass(
        "VersionAnswer",
        [
            ("before", bytes, wire_field(BytesField(before_bytes))),
            ("firmware_version", WireText, wire_field(TextField(text_bytes))),
            ("after", bytes, wire_field(BytesField(after_bytes))),
        ],
        bases=(VersionAnswer,),
        frozen=True,
    )


def documented_query(target: Target) -> VersionQuery | None:
    """Documented version query (table 7), for the BMS only; None for other targets."""
    if not target.has_version_query:
        return None
    offset = 0
    for name, codec in VersionInformation.LAYOUT:
        if name == "firmware_version":
            break
        offset += codec.size_bytes
    return VersionQuery(
        Command.READ_VERSION,
        target.broadcast_id,
        Command.VERSION_INFORMATION,
        offset,
        codec.size_bytes,
    )


@dataclass(frozen=True)
class Profile:
    """Settings for one target in one dialect. `sources` maps each name of `values()` to "default"
    (a reading of this project), "document", or the path of a file.
    """

    target: Annotated[Target, Parsed("a target", TARGETS.__getitem__)]
    dialect: Annotated[Dialect, Parsed("a dialect", DIALECTS.__getitem__)] = WELLING
    has_upgrade: bool = WELLING.has_upgrade
    """Upgrade, even if the document has cancelled it (section 6)."""
    timings: Timings = DEFAULT_TIMINGS
    attempts: Tries = DEFAULT_ATTEMPTS
    """Maximum number of attempts. The default applies until the device is erased."""
    timeout_s: Time | None = None
    """Overall deadline; by default computed from the plan."""
    power_up_timeout_s: Time = UpgradeOptions.power_up_timeout_s
    """Wait for a power cycle."""
    adapter_return_s: Annotated[float, NumberRange(ge=0, le=3600)] = UpgradeOptions.adapter_return_s
    """Wait for a lost adapter."""
    cpu: Cpu = Identity.cpu
    """The device's processor; other: images need no vector table."""
    low_charge_percent: Annotated[int, NumberRange(ge=0, le=100)] = Identity.low_charge_percent
    """Warn before an upgrade below this state of charge."""
    minimum_charge_percent: Annotated[int, NumberRange(ge=0, le=100)] = (
        Identity.minimum_charge_percent
    )
    """Refuse an upgrade below this state of charge, unless a charger is connected."""
    in_use_ma: Annotated[int, NumberRange(ge=0, le=0x7FFF)] = Identity.in_use_ma
    """A larger discharge current means a vehicle in use."""
    keep_settings: bool = False
    """Save the settings before an upgrade, and restore those that changed and may be written."""
    frame_gap_s: Annotated[float, NumberRange(ge=0, le=1)] = UpgradeOptions.frame_gap_s
    """Silence between the frames of a message."""
    packet_gap_s: Annotated[float, NumberRange(ge=0, le=PACKET_GAP_MAX_S)] = (
        UpgradeOptions.packet_gap_s
    )
    """Silence before each packet."""
    nak_next_is_ack: bool = UpgradeOptions.nak_next_is_ack
    """NAK n+1 after a repeated packet n is ACK n (R10)."""
    reset_command: Number16 = Command.RESET
    """Restarts the application into the bootloader (R3)."""
    reset_data: Data = b"RESET"
    """The data of reset_command."""
    image_limit_bytes: Annotated[int, NumberRange(ge=1, le=IMAGE_MAX_SIZE)] | None = None
    """Largest image that the device accepts."""
    application_area: ApplicationArea | None = None
    version_query: VersionQuery | None = None
    sources: Mapping[str, str] = field(default_factory=dict)

    def check_fits(self, image: Image) -> None:
        """Raise ImageError if the image is too large for the device, or outside its application
        area (R8). Unknown limits are not checked.
        """
        area = self.application_area
        limits = (self.image_limit_bytes, area.size_bytes if area else None)
        limit = min((each for each in limits if each is not None), default=None)
        if limit is not None and image.size_bytes > limit:
            raise ImageError(
                f"{image.source}: {image.size_bytes} bytes exceed the limit of the device, {limit}",
                where="the profile's limit",
                cause="a merged file, or an image for another device",
                remedy="Choose the application with --range START:END.",
                code=ErrorCode.IMAGE_TOO_LARGE,
            )
        if area is None or image.base is None:
            return
        if not area.start <= image.base <= image.base + image.size_bytes <= area.end:
            raise ImageError(
                f"{image.source} is outside the device's application area",
                where=f"0x{image.base:08X}..0x{image.base + image.size_bytes - 1:08X}, the area is "
                f"0x{area.start:08X}..0x{area.end - 1:08X}",
                cause="a merged file, an image for another device, or a raw binary with a wrong "
                "--base",
                remedy="Choose the application with --range START:END, or correct --base.",
                code=ErrorCode.IMAGE_OUTSIDE,
            )

    def upgrade_options(self, **overrides: Any) -> UpgradeOptions:
        """Create the options of an upgrade. `overrides` are fields of `UpgradeOptions` or
        `Timings`, by name; None means not given. Raises TypeError for another name.

        They include the product's own version query, but not the documented one, whose answer also
        has the hardware version.
        """
        given = {name: value for name, value in overrides.items() if value is not None}
        names = {known.name for known in fields(UpgradeOptions)}
        shared = {known.name: getattr(self, known.name) for known in fields(self)}
        timings = {
            known.name: given.pop(known.name) for known in fields(Timings) if known.name in given
        }
        options = {name: value for name, value in shared.items() if name in names}
        query = self.version_query
        if query is not None and query != documented_query(self.target):
            options["version_request"] = query.request(self.target)
        if self.attempts == DEFAULT_ATTEMPTS and not self._is_chosen("attempts"):
            options["attempts"] = None
        options |= given
        base: Timings = options["timings"]
        options["timings"] = chosen = replace(base, **timings)
        if "packet_tries" in timings or self._is_chosen("timings.packet_tries"):
            options.setdefault("patient_tries", chosen.packet_tries)
        return UpgradeOptions(**options)

    def _is_chosen(self, name: str) -> bool:
        """True if this value was set, even to its default."""
        return self.sources.get(name, DEFAULT) != DEFAULT

    def identity(self, **overrides: Any) -> Identity:
        """Create the settings of identity checks; `overrides` are other fields of `Identity`."""
        return Identity(
            low_charge_percent=self.low_charge_percent,
            minimum_charge_percent=self.minimum_charge_percent,
            in_use_ma=self.in_use_ma,
            cpu=self.cpu,
            **overrides,
        )

    def values(self) -> Iterator[tuple[str, object]]:
        """Yield name (TABLE.NAME in a table) and value of each setting; None for no table."""
        for name in (known.name for known in fields(self)):
            value = getattr(self, name)
            if name in _TABLES and value is not None:
                for part in fields(value):
                    yield f"{name}.{part.name}", getattr(value, part.name)
            elif name not in _NOT_IN_FILE:
                yield name, value


# -- finding and reading --------------------------------------------------------------------------


def load_profile(
    path: str | os.PathLike[str] | None, target: Target, dialect: Dialect = WELLING
) -> Profile:
    """Load the profile of a target: from the file `path`, else from the `flasher.toml` of
    `find_profile`, else the defaults. With os.devnull as `path` no file is searched.

    Raises UsageError with all problems of the file.
    """
    found = Path(path) if path is not None else find_profile()
    if found is not None and found != Path(os.devnull):
        return _ProfileFile(found, was_named=path is not None).profile(target, dialect)
    profile = Profile(
        target, dialect, has_upgrade=dialect.has_upgrade, version_query=documented_query(target)
    )
    return replace(profile, sources=_sources(profile, {}, ""))


def check_profile(path: str | os.PathLike[str]) -> tuple[Target, ...]:
    """Check a profile file for every target; return the targets that have a table.

    Raises UsageError with all problems of the file.
    """
    file = _ProfileFile(Path(path))
    for target in TARGETS.values():
        file.profile(target, WELLING)
    return tuple(target for target in TARGETS.values() if target.name in file.tables)


def find_profile() -> Path | None:
    """Find the `flasher.toml` of the working directory, else the user's; None without any."""
    return next(_profile_paths(), None)


def _profile_paths() -> Iterator[Path]:
    directories = [user_config_path("flasher", appauthor=False, roaming=True)]
    with suppress(FileNotFoundError):  # the working directory was deleted
        directories.insert(0, Path.cwd())
    for directory in directories:
        path = directory / FILE_NAME
        if is_regular(path):
            yield path


def find_bus(path: str | os.PathLike[str] | None = None) -> Fallback | None:
    """Return the adapter of the first file with a table [bus]: the file `path`, the `flasher.toml`
    of the working directory, or the user's; None without any. With os.devnull as `path` no file is
    searched. Other contents of a file are ignored.

    Raises UsageError with all problems of the table.
    """
    if path is not None and Path(path) == Path(os.devnull):
        return None
    named = [] if path is None else [Path(path)]
    for place in (*named, *_profile_paths()):
        was_named = place.resolve() in [each.resolve() for each in named]
        document = read_toml(place, what="profile", was_named=was_named)
        if _BUS in document:
            from flasher.settings.bus import read_bus  # noqa: PLC0415  loads python-can

            return read_bus(document[_BUS], place)
    return None


@cache
def reader() -> Reader[Profile]:
    from flasher.settings.toml_reader import Reader  # noqa: PLC0415

    return Reader(Profile, "profile", beside=_NOT_IN_FILE, also=(*TARGETS, _BUS))


class _ProfileFile:
    """Profile file whose keys and values are valid individually. Raises UsageError."""

    def __init__(self, path: Path, *, was_named: bool = True) -> None:
        self._path = path
        self._common: dict[str, Any] = {}
        self.tables: dict[str, Any] = {}
        """Tables by target name."""
        faults: list[Fault] = []
        document = read_toml(path, what="profile", was_named=was_named)
        for key, value in document.items():
            target = find_target(key)
            if key == _BUS:
                from flasher.settings.bus import bus_faults  # noqa: PLC0415  loads python-can

                faults += bus_faults(value)
            elif target is None:
                self._common[key] = value
            elif not isinstance(value, dict):
                faults.append(reader().fault((key,), f"is a table, [{key}]."))
            elif target.name in self.tables:
                remedy = "Put both into one; mc is another name for wmc, pbu for obc."
                what = f"is a second table for the {target.node.name}."
                faults.append(Fault(key, what, remedy, f"[{key}] {what}"))
            else:
                self.tables[target.name] = value
                faults += self._check(value, (key,))
        faults += self._check(self._common, ())
        if faults:
            raise reader().refusal(path, faults)

    def _check(self, table: Mapping[str, Any], prefix: tuple[str, ...]) -> list[Fault]:
        """Return the problems of the given values; others may be in another table."""
        names = {"target": "bms", "dialect": WELLING.name, "sources": {}}
        return reader().check(table, prefix, is_whole=False, **names)[1]

    def profile(self, target: Target, dialect: Dialect) -> Profile:
        """Merge the file's values for a target over the defaults."""
        given = _merged(self._common, self.tables.get(target.name, {}))
        query = documented_query(target)
        without = {
            "has_upgrade": dialect.has_upgrade,
            "version_query": None if query is None else asdict(query),
        }
        names = {"target": target.name, "dialect": dialect.name, "sources": {}}
        profile = reader().read(_merged(without, given), self._path, **names)
        faults = list(_contradictions(profile))
        if faults:
            raise reader().refusal(self._path, faults)
        try:
            profile.upgrade_options()
        except UsageError as error:
            error.where = printable(str(self._path))
            raise
        return replace(profile, sources=_sources(profile, given, str(self._path)))


def _merged(base: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Merge `values` over `base`, table by table."""
    tables = {
        name: {**base[name], **values[name]}
        for name in values
        if isinstance(values[name], dict) and isinstance(base.get(name), dict)
    }
    return {**base, **values, **tables}


def _sources(profile: Profile, given: Mapping[str, Any], path: str) -> dict[str, str]:
    sources = {}
    for name, _ in profile.values():
        table, _, key = name.rpartition(".")
        documented = (
            name == "has_upgrade"
            or (table == "timings" and key in _DOCUMENTED)
            or table == "version_query"
            # Chapter 3 covers the BMS; the others' reset is a reading (R3).
            or (name in ("reset_command", "reset_data") and profile.target.has_version_query)
        )
        is_given = key in (given.get(table, {}) if table else given)
        sources[name] = path if is_given else DOCUMENT if documented else DEFAULT
    return sources


def _contradictions(profile: Profile) -> Iterator[Fault]:
    """Yield settings that contradict each other."""
    fault = reader().fault
    wanted = data_size(profile.reset_command)
    if len(profile.reset_data) != wanted:
        yield fault(
            ("reset_data",),
            f"has {len(profile.reset_data)} bytes, but reset_command "
            f"0x{profile.reset_command:04X} carries {wanted}, by its second byte.",
        )
    area = profile.application_area
    if area is not None and area.end > 1 << 32:
        yield fault(("application_area",), "goes beyond 32 bits of address.")
    query = profile.version_query
    if query is None:
        return
    if query.answer_id not in sent_ids(profile.target):
        yield fault(
            ("version_query", "answer_id"),
            f"is 0x{query.answer_id:03X}, which the {profile.target.node.name} does not send.",
            f"Put it into the table of its device, as [{profile.target.name}.version_query]; "
            "a file's first lines are for every device.",
        )
    if data_size(query.command):
        yield fault(
            ("version_query", "command"),
            f"is 0x{query.command:04X}: by its second byte it carries data, but a query has none.",
        )
    size_bytes = data_size(query.answer_command)
    if query.offset + query.size_bytes > size_bytes:
        yield fault(
            ("version_query",),
            f"has its text of {query.size_bytes} bytes at {query.offset}, which lies beyond the "
            f"{size_bytes} bytes of answer_command 0x{query.answer_command:04X}.",
        )
