"""The target profile: where it is found, what it may hold, and what comes of it."""

from __future__ import annotations

import dataclasses
import sys
from contextlib import chdir
from pathlib import Path

import pytest

from flasher.errors import ExitCode, UsageError
from flasher.host.options import UpgradeOptions
from flasher.protocol.spec import BMS, MOTINOVA, OBC, WELLING, WMC
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Message
from flasher.settings.profile import (
    ApplicationArea,
    Profile,
    VersionAnswer,
    VersionQuery,
    check_profile,
    find_profile,
    load_profile,
    reader,
)


def written(directory: Path, text: str) -> Path:
    path = directory / "flasher.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refused(directory: Path, text: str) -> UsageError:
    path = written(directory, text)
    with pytest.raises(UsageError) as caught:
        check_profile(path)
    assert caught.value.exit_code == ExitCode.USAGE
    assert str(path) in caught.value.where
    return caught.value


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The home of a user who has no configuration."""
    for name in ("HOME", "XDG_CONFIG_HOME", "APPDATA"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    return tmp_path / "home"


def without_file(directory: Path) -> Profile:
    with chdir(directory):
        return load_profile(None, BMS)


# -- values and sources ----------------------------------------------------------------------------


def test_without_a_file_everything_is_a_default_or_the_documents(tmp_path: Path) -> None:
    profile = without_file(tmp_path)
    assert profile.timings == Timings()
    assert profile.upgrade_options() == UpgradeOptions()
    assert set(profile.sources.values()) == {"default", "document"}
    assert set(profile.sources) == {name for name, _ in profile.values()}
    assert profile.sources["timings.command_repeat_s"] == "document"
    assert profile.sources["timings.ack_timeout_s"] == "default"


def test_a_file_names_its_path_as_the_source_of_its_values_only(tmp_path: Path) -> None:
    path = written(tmp_path, "attempts = 7\n[timings]\nack_timeout_s = 1\n")
    profile = load_profile(path, WMC)
    assert profile.attempts == 7
    assert profile.timings == dataclasses.replace(Timings(), ack_timeout_s=1.0)
    from_file = {name for name, source in profile.sources.items() if source == str(path)}
    assert from_file == {"attempts", "timings.ack_timeout_s"}


def test_a_targets_table_goes_before_the_values_for_all(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "attempts = 7\nframe_gap_s = 0.002\n[timings]\npacket_tries = 9\n"
        "[mc]\nattempts = 2\n[mc.timings]\npacket_tries = 3\n",
    )
    wmc, bms = load_profile(path, WMC), load_profile(path, BMS)
    assert (wmc.attempts, wmc.timings.packet_tries, wmc.frame_gap_s) == (2, 3, 0.002)
    assert (bms.attempts, bms.timings.packet_tries, bms.frame_gap_s) == (7, 9, 0.002)
    assert check_profile(path) == (WMC,)


def test_every_kind_of_value_is_taken(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "has_upgrade = true\ntimeout_s = 600\nnak_next_is_ack = true\npacket_gap_s = 0.01\n"
        'image_limit_bytes = 0x1C000\nreset_command = 0x4203\nreset_data = "RST"\n'
        "[application_area]\nstart = 0x08004000\nsize_bytes = 0x1C000\n",
    )
    profile = load_profile(path, OBC, MOTINOVA)
    assert profile.has_upgrade
    assert profile.timeout_s == 600.0
    assert profile.nak_next_is_ack
    assert profile.image_limit_bytes == 0x1C000
    assert (profile.reset_command, profile.reset_data) == (0x4203, b"RST")
    assert profile.application_area == ApplicationArea(0x08004000, 0x1C000)


def test_reset_data_may_be_bytes(tmp_path: Path) -> None:
    path = written(tmp_path, "reset_command = 0x4202\nreset_data = [0x00, 0xFF]\n")
    assert load_profile(path, WMC).reset_data == b"\x00\xff"


def test_the_upgrade_is_allowed_where_the_document_has_it(tmp_path: Path) -> None:
    path = written(tmp_path, "")
    assert load_profile(path, BMS, WELLING).has_upgrade
    assert not load_profile(path, BMS, MOTINOVA).has_upgrade
    assert load_profile(path, BMS, MOTINOVA).sources["has_upgrade"] == "document"


def test_the_reset_of_wmc_and_obc_is_a_reading(tmp_path: Path) -> None:
    path = written(tmp_path, "")
    sources = {t.name: load_profile(path, t).sources["reset_command"] for t in (WMC, BMS, OBC)}
    assert sources == {"wmc": "default", "bms": "document", "obc": "default"}


def test_every_field_of_the_timings_may_be_set(tmp_path: Path) -> None:
    names = [field.name for field in dataclasses.fields(Timings)]
    text = "[timings]\n" + "".join(f"{name} = 2\n" for name in names)
    profile = load_profile(written(tmp_path, text), BMS)
    assert set(dataclasses.asdict(profile.timings).values()) == {2}


def test_every_key_is_a_value_of_the_profile() -> None:
    full = Profile(
        WMC,
        application_area=ApplicationArea(0, 1),
        version_query=VersionQuery(0x3300, 0x710, 0x1540, 48, 16),
    )
    assert {name for name, _ in full.values()} == set(reader().keys)


# -- options ---------------------------------------------------------------------------------------


def test_what_is_given_beside_it_goes_before_the_profile(tmp_path: Path) -> None:
    path = written(tmp_path, "attempts = 7\nframe_gap_s = 0.002\n[timings]\nack_timeout_s = 1\n")
    options = load_profile(path, BMS).upgrade_options(
        attempts=1, frame_gap_s=None, packet_tries=9, allow_boot_name=True
    )
    assert (options.attempts, options.frame_gap_s, options.allow_boot_name) == (1, 0.002, True)
    assert (options.timings.packet_tries, options.timings.ack_timeout_s) == (9, 1.0)


def test_an_option_that_does_not_exist_is_a_mistake_of_the_caller(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="atempts"):
        without_file(tmp_path).upgrade_options(atempts=3)


# -- the version query -----------------------------------------------------------------------------


def test_the_bms_has_the_documents_version_query(tmp_path: Path) -> None:
    query = without_file(tmp_path).version_query
    assert query == VersionQuery(0x3300, 0x720, 0x1540, 48, 16)


def test_a_product_names_its_own_version_query(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "[wmc.version_query]\ncommand = 0x6000\nanswer_id = 0x715\nanswer_command = 0x6114\n"
        "offset = 3\nsize_bytes = 16\n",
    )
    query = load_profile(path, WMC).version_query
    assert query is not None
    assert load_profile(path, BMS).version_query != query
    assert load_profile(path, OBC).version_query is None
    request = query.request(WMC)
    assert (request.item.can_id, request.item.command, request.item.mode) == (0x751, 0x6000, 0x11)
    answer = request.answer_item
    assert (answer.can_id, answer.command, answer.mode) == (0x715, 0x6114, 0x0C)
    data = b"abcV1r2r3_20260102.z"
    content = answer.content.from_data(data)
    assert isinstance(content, VersionAnswer)
    assert str(content.firmware_version) == "V1r2r3_20260102"
    assert content.data() == data
    assert Message(answer.can_id, answer.mode, answer.command, content.data()).data == data


def test_part_of_the_documents_query_may_be_changed(tmp_path: Path) -> None:
    path = written(tmp_path, "[bms.version_query]\noffset = 32\n")
    profile = load_profile(path, BMS)
    assert profile.version_query == VersionQuery(0x3300, 0x720, 0x1540, 32, 16)
    assert profile.sources["version_query.offset"] == str(path)
    assert profile.sources["version_query.command"] == "document"


# -- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "key", "meant"),
    [
        ("atempts = 3\n", "atempts", "attempts"),
        ("[wmc]\nack_timout_s = 1\n", "ack_timout_s", "wmc.timings.ack_timeout_s"),
        ("ack_timeout_s = 1\n", "ack_timeout_s", "timings.ack_timeout_s"),
        ("[timings]\npacket_trys = 1\n", "packet_trys", "packet_tries"),
        ("[timing]\npacket_tries = 1\n", "timing", "timings"),
        ("[bms.version_query]\nofset = 1\n", "ofset", "offset"),
    ],
)
def test_an_unknown_key_is_refused_with_the_one_that_was_meant(
    tmp_path: Path, text: str, key: str, meant: str
) -> None:
    error = refused(tmp_path, text)
    assert f"unknown key {key!r}" in error.what
    assert f"Did you mean {meant}?" in error.remedy


def test_a_key_like_no_other_gets_the_list_only(tmp_path: Path) -> None:
    error = refused(tmp_path, "zzzz = 1\n")
    assert "Did you mean" not in error.remedy
    assert "attempts" in error.remedy
    assert "wmc, bms, obc" in error.remedy


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("attempts = 0\n", "attempts"),
        ("attempts = 2.5\n", "attempts"),
        ("attempts = true\n", "attempts"),
        ('attempts = "3"\n', "attempts"),
        ("nak_next_is_ack = 1\n", "nak_next_is_ack"),
        ("frame_gap_s = -0.1\n", "frame_gap_s"),
        ("frame_gap_s = nan\n", "frame_gap_s"),
        ("packet_gap_s = inf\n", "packet_gap_s"),
        ("timeout_s = 0\n", "timeout_s"),
        ("[timings]\nack_timeout_s = 0\n", "timings.ack_timeout_s"),
        ("[timings]\npacket_tries = 1001\n", "timings.packet_tries"),
        ("reset_command = 0x10000\n", "reset_command"),
        ('reset_data = "RÉSET"\n', "reset_data"),
        ("reset_data = [256]\n", "reset_data"),
        ("reset_data = [true]\n", "reset_data"),
        ("reset_data = 5\n", "reset_data"),
        ("image_limit_bytes = 8388481\n", "image_limit_bytes"),
        ("[wmc.version_query]\nanswer_id = 0x800\n", "wmc.version_query.answer_id"),
        ("[wmc.application_area]\nstart = 0x100000000\n", "wmc.application_area.start"),
    ],
)
def test_a_wrong_type_or_range_is_refused_with_its_key(tmp_path: Path, text: str, key: str) -> None:
    error = refused(tmp_path, text)
    assert error.what.startswith(f"{key} cannot be ")
    assert error.remedy.startswith("It is ")


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ('reset_data = "RST"\n', "reset_data has 3 bytes, but reset_command 0x4205 carries 5"),
        ("frame_gap_s = 0.1\n", "0.1 s between frames is more than 0.08 s"),
        ("[application_area]\nstart = 0xFFFFFFFF\nsize_bytes = 2\n", "beyond 32 bits"),
        ("[application_area]\nstart = 0\n", "has no size_bytes"),
        ("[wmc.version_query]\ncommand = 0x3300\n", "has no answer_id and no answer_command"),
        ("[bms.version_query]\ncommand = 0x3301\n", "but a query has none"),
        ("[bms.version_query]\noffset = 49\n", "lies beyond the 64 bytes"),
        ("[bms.version_query]\nanswer_id = 0x715\n", "0x715, which the BMS does not send"),
        ("timings = 3\n", "timings is a table, [timings]"),
        ("wmc = 3\n", "wmc is a table, [wmc]"),
        ("[wmc]\n[mc]\n", "[mc] is a second table for the WMC"),
    ],
)
def test_values_that_do_not_fit_together_are_refused(
    tmp_path: Path, text: str, reported: str
) -> None:
    assert reported in refused(tmp_path, text).what


def test_what_is_no_toml_is_reported_with_its_line(tmp_path: Path) -> None:
    error = refused(tmp_path, "attempts 3\n")
    assert "is not a readable TOML file" in error.what
    assert "line 1" in error.what


def test_bytes_that_are_no_text_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "flasher.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="is not a readable TOML file"):
        check_profile(path)


def test_a_byte_order_mark_does_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "flasher.toml"
    path.write_bytes(b"\xef\xbb\xbfattempts = 4\n")
    assert load_profile(path, BMS).attempts == 4


def test_a_file_that_was_asked_for_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be read: there is no file"):
        load_profile(tmp_path / "none.toml", BMS)
    with pytest.raises(UsageError, match="cannot be read"):
        load_profile(tmp_path, BMS)


def test_hostile_names_and_keys_are_shown_harmlessly(tmp_path: Path) -> None:
    error = refused(tmp_path, '"\\u001b[2J" = 1\n')
    assert "\x1b" not in str(error)
    with pytest.raises(UsageError) as caught:
        load_profile(tmp_path / "\x1b[2J", BMS)
    assert "\x1b" not in str(caught.value)


# -- where it is found -----------------------------------------------------------------------------


def test_the_working_directory_goes_before_the_users(
    tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, mine = tmp_path / "here", home / "flasher"
    for directory in (here, mine):
        directory.mkdir(parents=True)
    monkeypatch.chdir(here)
    assert find_profile() is None
    users = written(mine, "attempts = 4\n")
    assert find_profile() == users
    local = written(here, "attempts = 5\n")
    assert find_profile() == local
    assert load_profile(None, BMS).attempts == 5


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps a folder that is in use")
def test_a_working_directory_that_was_deleted_has_no_profile(
    tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (home / "flasher").mkdir(parents=True)
    users = written(home / "flasher", "attempts = 4\n")
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert find_profile() == users


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other places")
@pytest.mark.parametrize(
    ("configured", "expected"),
    [("/x", "/x/flasher"), ("relative", "/h/.config/flasher"), ("", "/h/.config/flasher")],
)
def test_the_users_directory_is_the_systems_own(
    monkeypatch: pytest.MonkeyPatch, configured: str, expected: str
) -> None:
    looked_at: list[Path] = []
    monkeypatch.setenv("HOME", "/h")
    monkeypatch.setenv("XDG_CONFIG_HOME", configured)
    monkeypatch.setattr("flasher.settings.profile.is_regular", looked_at.append)
    monkeypatch.setattr(Path, "cwd", lambda: Path("/here"))
    find_profile()
    assert looked_at == [Path("/here/flasher.toml"), Path(expected, "flasher.toml")]


def test_all_faults_are_reported_at_once(tmp_path: Path) -> None:
    error = refused(
        tmp_path,
        'atempts = 1\nframe_gap_s = -1\n[timings]\npacket_tries = 0\n[wmc]\ncpu = "cortex"\n'
        "[wmc.timings]\nack_timeout_s = 1979-05-27\n",
    )
    path = tmp_path / "flasher.toml"
    assert error.what == f"The profile {path} has 5 faults."
    for fault in (
        "frame_gap_s cannot be -1. It is seconds from 0 to 1: Silence between the frames",
        "timings.packet_tries cannot be 0. It is a whole number from 1 to 1000: Maximum number",
        "wmc.cpu cannot be 'cortex'. Did you mean cortex-m? It is cortex-m, other: The device's",
        "wmc.timings.ack_timeout_s cannot be datetime.date(1979, 5, 27). It is seconds above 0",
        "atempts: unknown key. Did you mean attempts? Known are: wmc, bms, obc, bus, has_upgrade",
    ):
        assert f"{path}: {fault}" in error.where
