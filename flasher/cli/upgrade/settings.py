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
from flasher.i18n import text
from flasher.kept_settings import Setting, SettingState, restore_settings, settings_in, settings_of
from flasher.protocol.text import printable

_NOT_KEPT: Final = text(
    "not kept: what the new firmware does to serial number, model and production information (only "
    "the manufacturer may write them), to the history (no message writes it) and to an odometer "
    "(no query reads it)"
)


@dataclass(frozen=True)
class SavedSettings:
    """Settings of a device before its upgrade, in a file."""

    values: Mapping[str, Setting]

    command: str
    """Command that writes them back."""


def restore_command(path: Path) -> str:
    """Build the command that writes settings back, with the options of the adapter of this one."""
    ctx = click.get_current_context()
    options = [each for each in ctx.command.params if getattr(each, "panel", "") == "bus"]
    of_bus = {"--dialect", "--mock", "--mock-speed", *(each.opts[-1] for each in options)}
    words = rebuild_command_line(
        ctx, "backup", without=lambda name: name not in of_bus,
        replaced={"image": ["restore", str(path)]},
    )  # fmt: skip
    return printable(shlex.join(["flasher", *words]))


def page_restore_command(path: Path) -> str:
    """Build the command for the page, whose adapter a user has chosen there."""
    return printable(shlex.join(["flasher", "backup", "restore", str(path)]))


Emit = Callable[[CheckMade], None]


def save_settings(
    device: Device, emit: Emit, command: Callable[[Path], str], **watch: Unpack[CallOptions]
) -> SavedSettings | None:
    """Save the settings; None for a device that has or answers none. Raises UsageError if they
    cannot be written to a file.
    """
    node = device.target.node.name
    if not settings_of(device.target, device.profile.dialect):
        emit(
            CheckMade(
                SETTINGS, "unknown", text("the documents give no settings of the {node}", node=node)
            )
        )
        return None
    found = device.identify(**watch)
    values = settings_in(found)
    if not values:
        emit(
            CheckMade(
                SETTINGS,
                "unknown",
                text("the {node} answers no query: nothing was saved", node=node),
            )
        )
        return None
    path = own_backup_path(found)
    archive = backup_of(found, None, b"", device.connection.name, path).archive
    try:
        write_whole(path, archive, "", is_private=True)
    except UsageError as error:
        error.remedy = "Make room there. Or upgrade with --no-keep-settings."
        raise
    saved = SavedSettings(values, command(path))
    what = text("the settings are saved: `{command}` restores them", command=saved.command)
    emit(CheckMade(SETTINGS, "passed", what))
    emit(CheckMade(SETTINGS, "unknown", _NOT_KEPT))
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
                    what = text("the {name} had changed, and was restored", name=name)
                    emit(CheckMade(SETTINGS, "passed", what))
                case SettingState.CHANGED:
                    what = text(
                        "the {name} has changed, and only its manufacturer may write it", name=name
                    )
                    emit(CheckMade(SETTINGS, "warned", what))
                case SettingState.NOT_RESTORED | SettingState.UNKNOWN:
                    what = text(
                        "the {name} was not restored: {why} `{command}` tries again",
                        name=name,
                        why=each.detail or text("it was not answered"),
                        command=saved.command,
                    )
                    emit(CheckMade(SETTINGS, "warned", what))
    except FlasherError as error:
        what = text(
            "not all were compared: {what} {remedy} `{command}` goes on",
            what=error.what,
            remedy=error.remedy,
            command=saved.command,
        )
        emit(CheckMade(SETTINGS, "warned", what))
    else:
        what = text("{kept} of {count} settings read as before", kept=kept, count=len(saved.values))
        emit(CheckMade(SETTINGS, "passed", what))
