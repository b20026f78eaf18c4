"""What lies around: files of others that are not taken, and what others may not read."""

from __future__ import annotations

import importlib.util
import os
import platform
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import can.util
import pytest

from flasher.cli.files import write_whole, writing
from flasher.cli.help import CAN_FILES
from flasher.errors import (
    ErrorCode,
    ExitCode,
    UsageError,
    hide_passwords,
    is_secret,
    without_password,
)
from flasher.files import make_private
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS
from flasher.settings.profile import FILE_NAME, find_bus, find_profile, load_profile
from flasher.trace.recorder import Recorder
from tests.cli.conftest import SAMPLES, Flasher, flasher
from tests.loops import each
from tests.rights import permissions_hold

__all__ = ["flasher"]
pytestmark = pytest.mark.skipif(os.name != "posix", reason="rights of another kind")
NOBODY = 65_534
PROFILE = 'cpu = "other"\n[bus]\ninterface = "virtual"\nchannel = "of_another"\n'


@pytest.fixture(autouse=True)
def usual_rights() -> Iterator[None]:
    """As most systems set them: what is made, others may read."""
    before = os.umask(0o022)
    yield
    os.umask(before)


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


# -- flasher.toml ----------------------------------------------------------------------------------


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A flasher.toml in the working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SUDO_UID", raising=False)
    path = tmp_path / FILE_NAME
    path.write_text(PROFILE)
    return path


def of_another(path: Path, patch: pytest.MonkeyPatch) -> None:
    if os.geteuid():
        patch.setattr(os, "geteuid", lambda: NOBODY)
    else:
        os.chown(path, NOBODY, -1, follow_symlinks=False)


def for_all(path: Path, _patch: pytest.MonkeyPatch) -> None:
    path.chmod(0o666)


def for_a_group(path: Path, patch: pytest.MonkeyPatch) -> None:
    path.chmod(0o664)
    patch.setattr("flasher.files._is_own_group", lambda _: False)


def by_a_link_of_another(path: Path, patch: pytest.MonkeyPatch) -> None:
    own = path.rename(path.with_name("own.toml"))
    path.symlink_to(own)
    of_another(path, patch)


def by_a_link_to_anothers(path: Path, patch: pytest.MonkeyPatch) -> None:
    other = path.rename(path.with_name("other.toml"))
    path.symlink_to(other)
    of_another(other, patch)


Change = Callable[[Path, pytest.MonkeyPatch], None]


@pytest.mark.parametrize(
    ("change", "why", "command"),
    [
        (of_another, "it belongs to another user", "mv -f"),
        (for_all, "other users may write it", "chmod go-w"),
        (for_a_group, "other users may write it", "chmod go-w"),
        (by_a_link_of_another, "it belongs to another user", "mv -f"),
        (by_a_link_to_anothers, "it belongs to another user", "mv -f"),
    ],
)
def test_a_file_that_others_have_written_is_not_taken(
    settings: Path, monkeypatch: pytest.MonkeyPatch, change: Change, why: str, command: str
) -> None:
    change(settings, monkeypatch)
    for read in (lambda: load_profile(None, BMS), find_bus):
        with pytest.raises(UsageError) as caught:
            read()
        assert caught.value.code is ErrorCode.FILE_NOT_TRUSTED
        assert f"{settings} is not taken: {why}." in caught.value.what
        assert command in caught.value.remedy


@pytest.mark.parametrize("change", [for_all, for_a_group])
def test_the_command_of_the_message_mends_it(
    settings: Path, monkeypatch: pytest.MonkeyPatch, change: Change
) -> None:
    change(settings, monkeypatch)
    with pytest.raises(UsageError) as caught:
        load_profile(None, BMS)
    assert os.system(caught.value.remedy.split("`")[1]) == 0  # noqa: S605  our own message
    assert load_profile(None, BMS).cpu.value == "other"


def test_a_copy_of_anothers_file_is_ones_own(
    settings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_a_link_of_another(settings, monkeypatch)
    with pytest.raises(UsageError) as caught:
        load_profile(None, BMS)
    monkeypatch.undo()
    monkeypatch.chdir(settings.parent)
    assert os.system(caught.value.remedy.split("`")[1]) == 0  # noqa: S605  our own message
    assert load_profile(None, BMS).cpu.value == "other"


def test_a_file_that_is_named_is_taken_as_it_is(settings: Path) -> None:
    settings.chmod(0o666)
    assert load_profile(FILE_NAME, BMS).cpu.value == "other"
    found = find_bus(FILE_NAME)
    assert found is not None
    assert found.bus["channel"] == "of_another"
    settings.write_text('cpu = "other"\n')  # names no adapter: no other file does either
    assert find_bus(FILE_NAME) is None


def test_ones_own_file_and_that_of_root_are_taken(
    settings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for mode in (0o600, 0o644, 0o755):
        settings.chmod(mode)
        assert load_profile(None, BMS).cpu.value == "other"
    monkeypatch.setattr("flasher.files._is_own_group", lambda _: True)
    settings.chmod(0o664)  # as users have it who have a group of their own
    assert load_profile(None, BMS).cpu.value == "other"
    if not os.geteuid():
        monkeypatch.setattr(os, "geteuid", lambda: NOBODY)
        assert load_profile(None, BMS).cpu.value == "other", "root's"


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="root alone gives files away")
def test_with_sudo_the_file_of_who_called_it_is_taken(
    settings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.chown(settings, NOBODY, -1)
    monkeypatch.setenv("SUDO_UID", str(NOBODY))
    assert load_profile(None, BMS).cpu.value == "other"
    monkeypatch.setenv("SUDO_UID", "4711")
    with pytest.raises(UsageError):
        load_profile(None, BMS)


def test_noise_is_not_let_through_by_a_strangers_file(
    flasher: Flasher, settings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = settings.with_name("noise.bin")
    noise.write_bytes(bytes(range(1, 255)) * 40)
    words = ("flash", noise, "-t", "bms", "--mock", "--mock-speed", "0")
    assert flasher(*words).code == ExitCode.OK, "one's own word"
    of_another(settings, monkeypatch)
    run = flasher(*words)
    assert run.code == ExitCode.USAGE
    assert "[E209]" in run.err
    assert str(settings) in run.err


# -- who may read what is written ------------------------------------------------------------------


@each("is_there", [False, True])
@each("suffix", [".asc", ".asc.gz", ".blf", ".csv", ".db", ".log", ".pcapng", ".trc", ".txt"])
def test_a_trace_is_its_owners_in_every_format(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, is_there: bool
) -> None:
    path = tmp_path_factory.mktemp("traces") / f"upgrade{suffix}"
    if is_there:
        path.write_bytes(b"of before")
        path.chmod(0o644)
    with Recorder(path) as recorder:
        assert mode_of(path) == 0o600, "from its first byte on"
        recorder(Frame(0x752, b"secret"), sent=True, now=0.0)
    assert mode_of(path) == 0o600
    assert path.stat().st_size > len(b"of before")


@each("name", ["notes.md", "x\x1b.y", "trace.asc.zip", "upgrade"])
def test_a_file_that_no_trace_can_be_written_to_is_neither_made_nor_emptied(
    tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    path = tmp_path_factory.mktemp("traces") / name
    with pytest.raises(UsageError, match="no trace format"):
        Recorder(path)
    assert list(path.parent.iterdir()) == []
    path.write_bytes(b"of before")
    with pytest.raises(UsageError, match="no trace format"):
        Recorder(path)
    assert path.read_bytes() == b"of before"


@pytest.mark.slow
def test_what_a_device_reported_is_its_owners(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Log, trace, bundle, history, backup, memory, exports."""
    monkeypatch.chdir(tmp_path)
    for name, folder in (("DATA", "d"), ("STATE", "s")):
        monkeypatch.setenv(f"XDG_{name}_HOME", str(tmp_path / folder))
    monkeypatch.delenv("FLASHER_BUNDLE_DIR", raising=False)
    (tmp_path / "old.log").write_text("of before\n")
    quick = ("-t", "bms", "--mock", "--mock-speed", "0")
    sample = SAMPLES / "bms.hex"
    flasher("flash", sample, *quick, "--trace-file", "t.log", "--log-file", "old.log")
    flasher("flash", sample, *quick, "--timeout", "2")
    flasher("backup", *quick, "-o", "b.zip")
    flasher("read", "memory", "0x08008000", "0x08008100", *quick, "-o", "m.bin")
    flasher("export", "trace", "t.log", "-o", "t.blf")
    flasher("export", "csv", "t.log", "-o", "t.csv")
    written = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert written >= {
        "old.log", "t.log", "t.blf", "t.csv", "b.zip", "m.bin", "history.jsonl", "trace.blf",
        "transcript.txt", "report.json",
    }  # fmt: skip
    seen = {path.name: oct(mode_of(path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert {name for name, mode in seen.items() if mode != oct(0o600)} <= {"ui.json"}
    assert (tmp_path / "old.log").read_text().startswith("of before\n")


def test_what_is_made_for_others_is_not_hidden_from_them(flasher: Flasher, tmp_path: Path) -> None:
    flasher("export", "dbc", "-o", tmp_path / "welling.dbc")
    assert mode_of(tmp_path / "welling.dbc") == 0o644


def test_pipes_and_devices_are_left_alone(tmp_path: Path) -> None:
    before = mode_of(Path(os.devnull))
    make_private(os.devnull)
    assert mode_of(Path(os.devnull)) == before
    os.mkfifo(tmp_path / "pipe", 0o644)
    make_private(tmp_path / "pipe")
    assert mode_of(tmp_path / "pipe") == 0o644


def test_a_disk_without_rights_is_written_to_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_descriptor: int, _mode: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    path = tmp_path / "t.log"
    path.write_text("of before")
    monkeypatch.setattr(os, "fchmod", refuse)
    make_private(path)
    assert path.read_text() == ""
    if not os.geteuid():
        os.chown(path, NOBODY, -1)
        with pytest.raises(PermissionError, match="belongs to another user"):
            make_private(path)


def test_whoever_writes_a_file_anew_does_not_open_it_to_others(tmp_path: Path) -> None:
    path = tmp_path / "x.mf4"
    with writing(path, "-o") as part:
        assert mode_of(part) == 0o600
        part.unlink()
        part.write_bytes(b"x")
    assert mode_of(path) == 0o600
    write_whole(path, b"y", "-o", is_private=True)
    assert mode_of(path) == 0o600
    write_whole(path, b"z", "-o")
    assert mode_of(path) == 0o644


# -- passwords -------------------------------------------------------------------------------------

HARD = "x7Q&'9"
"""A password that has everything in it by which a word could end."""


@each(
    "word, shown",
    [
        (f"password={HARD}", "password=***"),
        (f"--bus-kwargs=api_token={HARD}", "--bus-kwargs=api_token=***"),
        (f"Client-Secret={HARD} {HARD}", "Client-Secret=***"),
        ("bitrate=250000", "bitrate=250000"),
        ("tokens", "tokens"),
        (
            "postgresql://me:x@host/db?password=y&ssl=on",
            "postgresql://me:***@host/db?password=***&ssl=on",
        ),
    ],
)
def test_a_word_of_the_command_line_is_shown_without_its_password(word: str, shown: str) -> None:
    assert without_password(word) == shown
    assert hide_passwords(shown) == shown


@each(
    "text, shown",
    [
        (
            "can config: {'interface': 'x', 'password': 'y z', 'n': 1}",
            "can config: {'interface': 'x', 'password': ***, 'n': 1}",
        ),
        ('{"CAN_TOKEN": "y", "n": 1}', '{"CAN_TOKEN": ***, "n": 1}'),
        ("Bus(channel='x', password='y')", "Bus(channel='x', password=***)"),
        ("flasher info --bus-kwargs password=y -v", "flasher info --bus-kwargs password=*** -v"),
        ("Give it a password: in psql, \\password x", "Give it a password: in psql, \\password x"),
    ],
)
def test_a_text_is_shown_without_passwords(text: str, shown: str) -> None:
    assert hide_passwords(text) == shown
    assert hide_passwords(shown) == shown


def test_names_of_secrets() -> None:
    assert all(map(is_secret, ("password", "PASSWORD", "api_token", "apikey", "my-secret")))
    assert not any(map(is_secret, ("bitrate", "key", "pass", "channel")))


@pytest.mark.slow
def test_no_file_and_no_output_has_a_password_of_the_bus(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("XDG_DATA_HOME", "XDG_STATE_HOME", "FLASHER_BUNDLE_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setenv("CAN_CONFIG", '{"password": "s3cret"}')
    bus = ("-i", "virtual", "-c", "passwords", "--bus-kwargs", "password=s3cret")
    more = ("--bus-kwargs=api_token=s3cret", "--log-file", "all.log", "-vv")
    shown = ""
    for words in (
        ("flash", SAMPLES / "obc.bin", "-t", "obc", *bus, "--timeout", "0.2"),
        ("rescue", SAMPLES / "obc.bin", "-t", "obc", *bus, "--wait", "0.1", "--json"),
        ("doctor", *bus, "--json", "--listen", "0.1"),
        ("flash", "absent.hex", "-t", "obc", *bus),
        ("history",),
    ):
        run = flasher(*words, *(more if "-i" in words else ()))
        shown += run.out + run.err
    assert "s3cret" not in shown
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert {"all.log", "report.json", "history.jsonl"} <= {path.name for path in files}
    assert [path for path in files if b"s3cret" in path.read_bytes()] == []
    assert "api_token=***" in (tmp_path / "all.log").read_text()


# -- python-can's configuration files --------------------------------------------------------------


@pytest.mark.parametrize("system", ["Linux", "Darwin", "Windows", "FreeBSD"])
def test_help_names_the_configuration_files_that_python_can_reads(
    system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In python-can a later file goes before an earlier one."""
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setenv("APPDATA", "%APPDATA%")
    spec = importlib.util.spec_from_file_location("can.another_util", can.util.__file__)
    assert spec is not None
    assert spec.loader is not None
    again = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(again)
    read = [name.replace("%APPDATA%/", "%APPDATA%\\") for name in reversed(again.CONFIG_FILES)]
    assert list(CAN_FILES.get(system, ("~/can.conf",))) == read


def test_the_first_of_these_files_goes_before_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / "can.conf", tmp_path / ".canrc"]
    for number, path in enumerate(files):
        path.write_text(f"[default]\nchannel = {number}\n")
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(path) for path in files])
    assert can.util.load_file_config()["channel"] == "1"


def test_a_home_that_may_not_be_entered_is_reported_and_not_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It might hold a profile with stricter rules."""
    home = tmp_path / "home"
    home.mkdir(mode=0)
    monkeypatch.setattr(
        "flasher.settings.profile.user_config_path", lambda *_, **__: home / "flasher"
    )
    monkeypatch.chdir(tmp_path)
    with permissions_hold(), pytest.raises(UsageError, match="Permission denied"):
        find_profile()
