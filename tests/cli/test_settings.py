"""`--keep-settings` and `backup restore`: settings before and after an upgrade."""

from __future__ import annotations

import json
import shlex
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from flasher.cli.look.backup import backup_folder
from flasher.errors import ExitCode, UsageError
from flasher.mock.bms import BmsApplication
from flasher.protocol.contents import CheckCode, SerialNumber, UserString
from flasher.protocol.fields import Content, WireText
from flasher.protocol.text import encode_text
from tests.cli.conftest import Flasher, Run
from tests.end_to_end.stage import IMAGE, Stage
from tests.loops import each

WORDS = ("-t", "bms", "-i", "virtual")


def _text(text: str) -> WireText:
    return WireText(encode_text(text, 16))


RACK = UserString(_text("RACK 7"))
EMPTY = UserString(_text(""))
CODE = CheckCode(bytes(range(12)))


class Settings:
    """A battery with settings of its own, which an upgrade may lose."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        application = stage.device.application
        assert isinstance(application, BmsApplication)
        self.kept = application.kept
        self.kept["user string 1"] = RACK
        self.kept["check code"] = CODE

    def lose(self, **values: Content) -> None:
        """Change settings in the middle of the transfer."""
        changed = {name.replace("_", " "): value for name, value in values.items()}
        self.stage.at_packet[2] = lambda: self.kept.update(changed)


@pytest.fixture
def battery(monkeypatch: pytest.MonkeyPatch) -> Settings:
    stage = Stage()
    monkeypatch.setattr("flasher.api.connect", stage.connect)
    return Settings(stage)


@pytest.fixture
def flash(flasher: Flasher, tmp_path: Path) -> Callable[..., Run]:
    path = tmp_path / "image.bin"
    path.write_bytes(IMAGE.data)
    return lambda *more: flasher("flash", path, *WORDS, *more)


def saved() -> list[Path]:
    return sorted(backup_folder().glob("*.zip"))


def test_settings_are_saved_before_and_compared_after(
    battery: Settings, flash: Callable[..., Run]
) -> None:
    run = flash("--keep-settings")
    assert run.code == ExitCode.OK, run.err
    (path,) = saved()
    assert run.err.index(f"flasher backup restore {path}") < run.err.index("resetting the appl")
    assert "not kept: " in run.err
    assert "7 of 7 settings read as before" in run.err
    with zipfile.ZipFile(path) as archive:
        items = json.loads(archive.read("backup.json"))["info"]["items"]
    assert items["user-string-1"]["text"] == "RACK 7"
    assert path.stat().st_mode & 0o077 == 0
    assert battery.kept["user string 1"] == RACK


def test_settings_that_changed_are_restored(battery: Settings, flash: Callable[..., Run]) -> None:
    battery.lose(user_string_1=EMPTY, check_code=CheckCode(bytes(12)))
    run = flash("--keep-settings", "--json")
    assert run.code == ExitCode.OK, run.err
    assert (battery.kept["user string 1"], battery.kept["check code"]) == (RACK, CODE)
    sentences = [each["text"] for each in run.document["checks"] if each["check"] == "settings"]
    assert "the user string 1 had changed, and was restored" in sentences
    assert "the check code had changed, and was restored" in sentences
    assert "5 of 7 settings read as before" in sentences


def test_what_only_the_manufacturer_may_write_is_reported_and_not_written(
    battery: Settings, flash: Callable[..., Run]
) -> None:
    production = battery.kept["production information"]
    other = type(production).from_data(bytes(production.data()).replace(b"W", b"X"))
    battery.lose(production_information=other)
    run = flash("--keep-settings")
    assert run.code == ExitCode.OK
    assert "warning: the production information has changed, and only its manufacturer" in run.err
    assert battery.kept["production information"] == other
    assert run.out.splitlines()[-1].startswith("OK  ")
    assert "1 warning" in run.out.splitlines()[-1]


@pytest.mark.slow
def test_another_unit_after_the_upgrade_gets_no_settings(
    battery: Settings, flash: Callable[..., Run]
) -> None:
    battery.lose(serial_number=SerialNumber(_text("W2605999")), user_string_1=EMPTY)
    run = flash("--keep-settings")
    assert run.code == ExitCode.WRONG_DEVICE
    assert "E608" in run.err
    assert battery.kept["user string 1"] == EMPTY


def test_a_unit_that_lost_its_serial_number_gets_no_settings(
    battery: Settings, flash: Callable[..., Run]
) -> None:
    battery.lose(serial_number=SerialNumber(_text("")), user_string_1=EMPTY)
    run = flash("--keep-settings")
    assert run.code == ExitCode.OK
    assert "not all were compared: The BMS has the serial number none" in run.err
    assert battery.kept["user string 1"] == EMPTY


def test_without_the_option_nothing_is_saved_unless_the_profile_sets_it(
    battery: Settings, flash: Callable[..., Run], tmp_path: Path
) -> None:
    assert flash().code == ExitCode.OK
    assert saved() == []
    profile = tmp_path / "keep.toml"
    profile.write_text("keep_settings = true\n")
    assert flash("--profile", profile, "--no-keep-settings", "--force").code == ExitCode.OK
    assert saved() == []
    assert flash("--profile", profile, "--force").code == ExitCode.OK
    assert len(saved()) == 1
    assert battery.kept["user string 1"] == RACK


def test_both_options_contradict_each_other(flash: Callable[..., Run]) -> None:
    run = flash("--keep-settings", "--no-keep-settings")
    assert run.code == ExitCode.USAGE
    assert "contradict each other" in run.err


def test_settings_that_cannot_be_saved_end_the_command_before_anything_is_erased(
    battery: Settings, flash: Callable[..., Run], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "file"))
    run = flash("--keep-settings")
    assert run.code == ExitCode.USAGE
    assert "[E202]" in run.err
    assert battery.stage.has != IMAGE.data


def test_a_failure_names_the_command_that_restores_the_settings_afterwards(
    battery: Settings, flash: Callable[..., Run], flasher: Flasher
) -> None:
    def lose_power() -> None:
        battery.kept["user string 1"] = EMPTY
        battery.stage.cut_power()

    battery.stage.at_packet[2] = lose_power
    run = flash("--keep-settings", "--timeout", "20")
    assert run.code not in (ExitCode.OK, ExitCode.INTERNAL)
    (path,) = saved()
    assert f"can be written back after that: `flasher backup restore {path} -i virtual`" in run.err
    battery.stage.give_power()
    assert flash().code == ExitCode.OK
    restored = flasher("backup", "restore", path, "--yes", "-i", "virtual")
    assert restored.code == ExitCode.OK, restored.err
    assert battery.kept["user string 1"] == RACK
    assert "user-string-1           restored" in restored.out


def test_the_printed_command_restores_the_settings_from_a_folder_with_a_space(
    battery: Settings,
    flash: Callable[..., Run],
    flasher: Flasher,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "my data"))
    run = flash("--keep-settings")
    assert run.code == ExitCode.OK, run.err
    words = shlex.split(run.err.split("settings are saved: `")[1].split("`")[0])
    assert words[1:] == ["backup", "restore", str(saved()[0]), "-i", "virtual"]
    battery.kept["user string 1"] = EMPTY
    assert flasher(*words[1:], "--yes").code == ExitCode.OK
    assert battery.kept["user string 1"] == RACK


@each("number", ["", "    "])
def test_settings_of_a_unit_without_a_serial_number_are_not_written_to_another_one(
    battery: Settings, flash: Callable[..., Run], number: str
) -> None:
    battery.kept["serial number"] = SerialNumber(_text(number))
    battery.lose(user_string_1=EMPTY)
    run = flash("--keep-settings", "--force")
    assert run.code == ExitCode.OK
    assert "not all were compared: The BMS has the serial number none" in run.err
    assert battery.kept["user string 1"] == EMPTY


def test_a_full_disk_ends_the_command_before_anything_is_erased(
    battery: Settings, flash: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_whole(path: Path, *_arguments: object, **_options: object) -> None:
        raise UsageError(f"{path} cannot be written: No space left on device.", remedy="Name one.")

    monkeypatch.setattr("flasher.cli.upgrade.settings.write_whole", write_whole)
    run = flash("--keep-settings")
    assert run.code == ExitCode.USAGE
    assert "what to do: Make room there. Or upgrade with --no-keep-settings." in run.err
    assert battery.stage.has != IMAGE.data


def test_a_rescue_does_not_query_a_device_without_application_for_its_settings(
    flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "image.bin"
    path.write_bytes(IMAGE.data)
    words = ("-t", "bms", "--mock", "--mock-speed", "0", "--keep-settings", "--allow-implausible")
    run = flasher("rescue", path, *words, "--json")
    assert run.code == ExitCode.OK, run.err
    sentences = [each["text"] for each in run.document["checks"] if each["check"] == "settings"]
    assert sentences == ["not saved: no application runs that could report them"]
    assert saved() == []


# -- backup restore --------------------------------------------------------------------------------


def test_settings_of_another_unit_are_refused_unless_forced(
    battery: Settings, flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "b.zip"
    words = ("-i", "virtual")
    run = flasher("backup", "-t", "bms", "-o", path, "--no-memory", *words)
    assert run.code == ExitCode.OK, run.err
    battery.kept |= {"serial number": SerialNumber(_text("W2605999")), "user string 1": EMPTY}
    run = flasher("backup", "restore", path, "--yes", *words)
    assert run.code == ExitCode.WRONG_DEVICE
    assert battery.kept["user string 1"] == EMPTY
    run = flasher("backup", "restore", path, "--yes", "--force", "--json", *words)
    assert run.code == ExitCode.OK
    assert battery.kept["user string 1"] == RACK
    states = {each["name"]: each["state"] for each in run.document["settings"]}
    assert states["user-string-1"] == "restored"
    assert states["serial-number"] == "changed"


@pytest.mark.usefixtures("battery")
def test_every_setting_of_a_backup_reads_as_before_on_the_same_unit(
    flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "b.zip"
    assert flasher("backup", "-t", "bms", "-o", path, "--no-memory", "-i", "virtual").code == 0
    run = flasher("backup", "restore", path, "--yes", "--json", "-i", "virtual")
    assert {each["name"]: each["state"] for each in run.document["settings"]} == dict.fromkeys(
        (
            "check-code", "user-string-1", "user-string-2", "user-string-3",
            "production-information", "model", "serial-number",
        ),
        "kept",
    )  # fmt: skip


def test_a_device_without_application_gets_no_settings(
    battery: Settings, flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "b.zip"
    assert flasher("backup", "-t", "bms", "-o", path, "--no-memory", "-i", "virtual").code == 0
    battery.stage.cut_power()
    run = flasher("backup", "restore", path, "--yes", "-i", "virtual")
    assert run.code == ExitCode.NO_ANSWER
    assert "nothing was written" in run.err


def test_a_file_that_is_no_backup_is_refused(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "b.zip"
    for content in (b"", b"text", b"PK\x05\x06" + bytes(18)):
        path.write_bytes(content)
        run = flasher("backup", "restore", path, "--yes", "--mock")
        assert run.code == ExitCode.USAGE, content
        assert "[E201]" in run.err
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("backup.json", '{"format": 2}')
    assert "its format is 2" in flasher("backup", "restore", path, "--yes", "--mock").err


@pytest.mark.slow
def test_without_a_terminal_a_restore_needs_yes(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "b.zip"
    mock = ("--mock", "--mock-speed", "0")
    assert flasher("backup", "-t", "bms", "-o", path, *mock).code == ExitCode.OK
    assert "[E206]" in flasher("backup", "restore", path, *mock).err
    assert flasher("backup", "restore", path, "--yes", *mock).code == ExitCode.OK
