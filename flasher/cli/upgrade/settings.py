"""Settings around an upgrade: saved in a backup before it, compared and restored after it."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Unpack

import click

from flasher.api import CallOptions, Device
from flasher.cli.files import write_whole
from flasher.cli.framework import rebuild_command_line
from flasher.cli.look.backup import backup_of, own_backup_path
from flasher.errors import FlasherError, UsageError
from flasher.events import SETTINGS, CheckMade
from flasher.kept_settings import Setting, SettingState, restore_settings, settings_in, settings_of
from flasher.protocol.text import printable

_NOT_KEPT: Final = (
    "not kept: what the new firmware does to serial number, model and production information (only "
    "the manufacturer may write them), to the history (no message writes it) and to an odometer "
    "(no query reads it)"
)


@dataclass(frozen=True)
class SavedSettings:
    """Settings of a device before its upgrade, in a file."""

    path: Path
    values: Mapping[str, Setting]

    @property
    def command(self) -> str:
        """Command that writes them back, with the options of the adapter."""
        ctx = click.get_current_context()
        options = [each for each in ctx.command.params if getattr(each, "panel", "") == "bus"]
        of_bus = {"--dialect", "--mock", "--mock-speed", *(each.opts[-1] for each in options)}
        words = rebuild_command_line(
            ctx, "backup", without=lambda name: name not in of_bus,
            replaced={"image": ["restore", str(self.path)]},
        )  # fmt: skip
        return printable(shlex.join(["flasher", *words]))


Emit = Callable[[CheckMade], None]


def save_settings(device: Device, emit: Emit, **watch: Unpack[CallOptions]) -> SavedSettings | None:
    """Save the settings; None for a device that has or answers none. Raises UsageError if they
    cannot be written to a file.
    """
    node = device.target.node.name
    if not settings_of(device.target, device.profile.dialect):
        emit(CheckMade(SETTINGS, "unknown", f"the documents give no settings of the {node}"))
        return None
    found = device.identify(**watch)
    values = settings_in(found)
    if not values:
        emit(CheckMade(SETTINGS, "unknown", f"the {node} answers no query: nothing was saved"))
        return None
    path = own_backup_path(found)
    archive = backup_of(found, None, b"", device.connection.name, path).archive
    try:
        write_whole(path, archive, "", is_private=True)
    except UsageError as error:
        error.remedy = "Make room there, or upgrade with --no-keep-settings."
        raise
    saved = SavedSettings(path, values)
    emit(CheckMade(SETTINGS, "passed", f"the settings are saved: `{saved.command}` restores them"))
    emit(CheckMade(SETTINGS, "passed", _NOT_KEPT))
    return saved


def compare_settings(
    device: Device, saved: SavedSettings, emit: Emit, **watch: Unpack[CallOptions]
) -> None:
    """Compare the settings after an upgrade, and restore those that changed. What fails is a
    warning: the upgrade itself has succeeded.
    """
    kept = 0
    try:
        for each in restore_settings(device, saved.values, **watch):
            name = each.name.replace("-", " ")
            match each.state:
                case SettingState.KEPT:
                    kept += 1
                case SettingState.RESTORED:
                    emit(CheckMade(SETTINGS, "passed", f"the {name} had changed, and was restored"))
                case SettingState.CHANGED:
                    what = f"the {name} has changed, and only its manufacturer may write it"
                    emit(CheckMade(SETTINGS, "warned", what))
                case SettingState.NOT_RESTORED | SettingState.UNKNOWN:
                    why = each.detail or "it was not answered"
                    what = f"the {name} was not restored: {why} `{saved.command}` tries again"
                    emit(CheckMade(SETTINGS, "warned", what))
    except FlasherError as error:
        what = f"not all were compared: {error.what} {error.remedy} `{saved.command}` goes on"
        emit(CheckMade(SETTINGS, "warned", what))
    else:
        emit(
            CheckMade(SETTINGS, "passed", f"{kept} of {len(saved.values)} settings read as before")
        )
