"""Finds, reads and checks a profile file, and puts the profile of one target together.

A file holds values for every device, and tables for single ones that go before them:

    attempts = 5
    [timings]
    ack_timeout_s = 1.0
    [wmc]
    frame_gap_s = 0.001
    [wmc.version_query]
    command = 0x3300
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

from flasher.errors import UsageError
from flasher.files import read_toml
from flasher.profile.keys import GROUPS, KEYS, explain_unknown, read_value
from flasher.profile.model import (
    ApplicationArea,
    Profile,
    VersionQuery,
    documented_query,
    sent_ids,
)
from flasher.protocol.spec import TARGETS, WELLING, Dialect, Target, data_size, find_target
from flasher.protocol.text import printable

FILE_NAME: Final = "flasher.toml"
DEFAULT: Final = "default"
DOCUMENT: Final = "document"
_DOCUMENTED: Final = frozenset({"command_repeat_s", "command_timeout_s", "boot_version_spacing_s"})
"""The timings that the documents give; all others are readings (R12)."""


# -- finding and reading --------------------------------------------------------------------------


def load_profile(
    path: str | os.PathLike[str] | None,
    target: Target,
    dialect: Dialect = WELLING,
    *,
    working_directory: str | os.PathLike[str] | None = None,
    environment: Mapping[str, str] | None = None,
) -> Profile:
    """The profile of a target: of the file `path`, else of the first `flasher.toml` that
    `find_profile` finds, else the defaults. With os.devnull as `path` no file is looked for.

    Raises UsageError naming file and key for a file that cannot be read, is no TOML, or holds a key
    or a value that is not allowed.
    """
    found = Path(path) if path is not None else find_profile(working_directory, environment)
    given: dict[str, Any] = {}
    if found is not None and found != Path(os.devnull):
        given = _read(found).for_target(target)
    return _build(target, dialect, given, str(found))


def check_profile(path: str | os.PathLike[str]) -> tuple[Target, ...]:
    """Check a whole file, for every target and dialect; returns the targets it has a table for.

    Raises UsageError as `load_profile`.
    """
    contents = _read(Path(path))
    for target in TARGETS.values():
        _build(target, WELLING, contents.for_target(target), os.fspath(path))
    return tuple(target for target in TARGETS.values() if target.name in contents.tables)


def find_profile(
    working_directory: str | os.PathLike[str] | None = None,
    environment: Mapping[str, str] | None = None,
) -> Path | None:
    """The `flasher.toml` of the working directory, else the one of the user; None without any."""
    here = Path.cwd() if working_directory is None else Path(working_directory)
    for directory in (here, user_directory(os.environ if environment is None else environment)):
        path = directory / FILE_NAME
        if path.is_file():
            return path
    return None


def user_directory(environment: Mapping[str, str], system: str | None = None) -> Path:
    """Where the user's configuration of flasher lies; `system` as platform.system() says it."""
    system = platform.system() if system is None else system
    home = Path(environment.get("HOME") or environment.get("USERPROFILE") or Path.home())
    if system == "Windows":
        base = Path(environment.get("APPDATA") or home / "AppData" / "Roaming")
    elif system == "Darwin":
        base = home / "Library" / "Application Support"
    else:
        base = Path(environment.get("XDG_CONFIG_HOME", ""))
        if not base.is_absolute():  # so the XDG rule wants it
            base = home / ".config"
    return base / "flasher"


@dataclass(frozen=True)
class _Contents:
    """A checked file: values for all, and for single targets."""

    common: dict[str, Any]
    tables: dict[str, dict[str, Any]]

    def for_target(self, target: Target) -> dict[str, Any]:
        return self.common | self.tables.get(target.name, {})


def _read(path: Path) -> _Contents:
    document = read_toml(path, what="profile")
    shown = printable(str(path))
    tables: dict[str, dict[str, Any]] = {}
    common: dict[str, Any] = {}
    for key, value in document.items():
        target = find_target(key)
        if target is None:
            common |= _flatten({key: value}, shown, "")
        elif not isinstance(value, dict):
            raise UsageError(f"{key} is a table, [{key}].", where=shown)
        elif target.name in tables:
            raise UsageError(
                f"[{key}] is a second table for the {target.node.name}.",
                where=shown,
                remedy="Put both into one; mc is another name for wmc, pbu for obc.",
            )
        else:
            tables[target.name] = _flatten(value, shown, f"{key}.")
    return _Contents(common, tables)


def _flatten(values: Mapping[str, Any], file: str, prefix: str) -> dict[str, Any]:
    """Checked values by their names in `KEYS`."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if name in GROUPS:
            if not isinstance(value, dict):
                raise UsageError(f"{prefix}{name} is a table, [{prefix}{name}].", where=file)
            inner = {f"{name}.{key}": inner_value for key, inner_value in value.items()}
        else:
            inner = {name: value}
        for key, inner_value in inner.items():
            if key not in KEYS:
                raise explain_unknown(key, file, prefix)
            flat[key] = read_value(key, inner_value, file, prefix)
    return flat


# -- putting together -----------------------------------------------------------------------------


def _build(target: Target, dialect: Dialect, given: Mapping[str, Any], path: str) -> Profile:
    file = printable(path)
    defaults = Profile(
        target,
        dialect,
        has_upgrade=dialect.has_upgrade,
        version_query=documented_query(target),
    )
    parts = {name: _group(name, getattr(defaults, name), given, file) for name in GROUPS}
    plain = {name: value for name, value in given.items() if "." not in name}
    profile = replace(defaults, **plain, **parts)
    _check_together(profile, file)
    sources = {
        name: path if name in given else _source(name, target) for name, _ in profile.values()
    }
    return replace(profile, sources=sources)


def _group(name: str, default: Any, given: Mapping[str, Any], file: str) -> Any:
    """One table of a profile: what the file gives, over what holds without it."""
    start = f"{name}."
    values = {key.removeprefix(start): given[key] for key in given if key.startswith(start)}
    if not values:
        return default
    if default is not None:
        return replace(default, **values)
    kind = ApplicationArea if name == "application_area" else VersionQuery
    missing = [part.name for part in fields(kind) if part.name not in values]
    if missing:
        raise UsageError(
            f"[{name}] has no {' and no '.join(missing)}.",
            where=file,
            remedy="Give all of " + ", ".join(part.name for part in fields(kind)) + ".",
        )
    return kind(**values)


def _source(name: str, target: Target) -> str:
    group, _, part = name.rpartition(".")
    documented = (
        name == "has_upgrade"
        or (group == "timings" and part in _DOCUMENTED)
        or group == "version_query"
        # Chapter 3 covers the BMS; the others' reset is a reading (R3).
        or (name in ("reset_command", "reset_data") and target.has_version_query)
    )
    return DOCUMENT if documented else DEFAULT


def _check_together(profile: Profile, file: str) -> None:
    """What depends on more than one value. Raises UsageError."""
    wanted = data_size(profile.reset_command)
    if len(profile.reset_data) != wanted:
        raise UsageError(
            f"reset_data has {len(profile.reset_data)} bytes, but reset_command "
            f"0x{profile.reset_command:04X} carries {wanted}: its second byte says so.",
            where=file,
        )
    try:
        replace(profile, version_query=None).upgrade_options()  # that is checked below
    except UsageError as error:
        error.where = file
        raise
    area = profile.application_area
    if area is not None and area.start + area.size_bytes > 1 << 32:
        raise UsageError("application_area goes beyond 32 bits of address.", where=file)
    query = profile.version_query
    if query is None:
        return
    if query.answer_id not in sent_ids(profile.target):
        raise UsageError(
            f"version_query.answer_id is 0x{query.answer_id:03X}, which the "
            f"{profile.target.node.name} does not send.",
            where=file,
            remedy=f"Put it into the table of its device, as [{profile.target.name}.version_query];"
            " a file's first lines are for every device.",
        )
    if data_size(query.command):
        raise UsageError(
            f"version_query.command is 0x{query.command:04X}: its second byte says that it carries "
            "data, but a query has none.",
            where=file,
        )
    if query.offset + query.size_bytes > data_size(query.answer_command):
        raise UsageError(
            f"version_query: the text at {query.offset} of {query.size_bytes} bytes lies beyond "
            f"the {data_size(query.answer_command)} bytes of answer_command "
            f"0x{query.answer_command:04X}.",
            where=file,
        )
