"""`flasher flash --profile`: the product's settings decide what is sent and accepted."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from flasher.cli.upgrade.choices import UpgradeChoices
from flasher.errors import ExitCode
from flasher.protocol.spec import TARGETS, WELLING
from flasher.protocol.timing import Timings
from flasher.settings.profile import Profile, load_profile
from tests.cli.conftest import SAMPLES, Flasher, Run

BMS = SAMPLES / "bms.hex"


@pytest.fixture
def flash(flasher: Flasher, tmp_path: Path) -> Flasher:
    """Runs `flasher flash` on the instant mock with a profile of the given text."""

    def run(profile: str, *words: str | Path) -> Run:
        path = tmp_path / "profile.toml"
        path.write_text(profile, encoding="utf-8")
        return flasher("flash", *words, "--profile", path, "--mock", "--mock-speed", "0")

    return run


def test_an_image_outside_of_the_application_area_is_rejected(flash: Flasher) -> None:
    area = "[bms.application_area]\nstart = 0x08010000\nsize_bytes = 0x20000\n"
    run = flash(area, BMS, "-t", "bms")
    assert run.code == ExitCode.IMAGE
    assert "[E307]" in run.err
    assert "0x08010000..0x0802FFFF" in run.err


@pytest.mark.parametrize(
    "limit",
    [
        "[bms]\nimage_limit_bytes = 78350\n",
        "[bms.application_area]\nstart = 0x08008000\nsize_bytes = 0x10000\n",
    ],
)
def test_an_image_that_is_too_large_for_the_device_is_rejected_even_by_force(
    flash: Flasher, limit: str
) -> None:
    run = flash(limit, BMS, "-t", "bms", "--force")
    assert run.code == ExitCode.IMAGE
    assert "[E303]" in run.err


def test_an_image_that_fits_is_flashed(flash: Flasher, short_bms: Path) -> None:
    area = "[bms.application_area]\nstart = 0x08008000\nsize_bytes = 0x20000\n"
    assert flash(area, short_bms, "-t", "bms").code == ExitCode.OK


def test_a_profile_enables_the_upgrade_in_the_dialect_that_cancelled_it(flash: Flasher) -> None:
    obc = SAMPLES / "obc.bin"
    words = (obc, "-t", "obc", "--dialect", "motinova")
    assert flash("", *words).code == ExitCode.USAGE
    enabled = flash("[obc]\nhas_upgrade = true\n", *words)
    assert enabled.code == ExitCode.OK
    assert "at 125 kbit/s" in enabled.err


def test_a_reset_command_of_the_products_own_is_what_is_sent(flash: Flasher) -> None:
    """The device model does not know it: it stays in its application."""
    run = flash(
        '[obc]\nreset_command = 0x4F04\nreset_data = "BOOT"\n[obc.timings]\n'
        "boot_version_timeout_s = 0.5\n",
        SAMPLES / "obc.bin", "-t", "obc",
    )  # fmt: skip
    assert run.code == ExitCode.NO_ANSWER


def test_the_command_line_goes_before_the_profile(flash: Flasher) -> None:
    slow = "[obc]\npacket_gap_s = 0.1\n"
    obc = SAMPLES / "obc.bin"
    by_profile = flash(slow, obc, "-t", "obc", "--json").document
    by_option = flash(slow, obc, "-t", "obc", "--packet-gap", "0", "--json").document
    times = [run["outcome"]["statistics"]["transfer_s"] for run in (by_profile, by_option)]
    assert times[0] > times[1] + 3.0


def test_a_misspelt_key_is_wrong_usage_with_a_suggestion(flash: Flasher) -> None:
    run = flash("[bms]\natempts = 2\n", BMS, "-t", "bms")
    assert run.code == ExitCode.USAGE
    assert "attempts" in run.err


NO_CHOICES = {each.name: None for each in fields(UpgradeChoices)}
IN_BOTH = {
    "packet_tries": ("[timings]\npacket_tries = 5\n", 5, 2),
    "attempts": ("attempts = 5\n", 5, 2),
    "timeout_s": ("timeout_s = 600.0\n", 600.0, 5.0),
    "adapter_return_s": ("adapter_return_s = 9.0\n", 9.0, 0.0),
    "frame_gap_s": ("frame_gap_s = 0.01\n", 0.01, 0.0),
    "packet_gap_s": ("packet_gap_s = 0.5\n", 0.5, 0.0),
    "nak_next_is_ack": ("nak_next_is_ack = false\n", False, True),
}
"""Options that a profile has too: its text, its value, and another one of the command line."""


def test_every_option_that_a_profile_has_too_is_among_these() -> None:
    keys = {each.name for each in (*fields(Profile), *fields(Timings))}
    # keep_settings has an option for each value, and is no option of the engine.
    assert NO_CHOICES.keys() & keys == IN_BOTH.keys() | {"keep_settings"}


@pytest.mark.parametrize("name", IN_BOTH)
def test_an_option_goes_before_the_key_of_its_name_also_where_it_is_zero(
    tmp_path: Path, name: str
) -> None:
    text, stated, typed = IN_BOTH[name]
    path = tmp_path / "profile.toml"
    path.write_text(text, encoding="utf-8")
    profile = load_profile(str(path), TARGETS["bms"], WELLING)
    for value, expected in ((None, stated), (typed, typed)):
        given: dict[str, Any] = {**NO_CHOICES, "allow_boot_name": False, "force": False}
        options = UpgradeChoices(**{**given, name: value}).options(profile, None)
        where = options.timings if name == "packet_tries" else options
        assert getattr(where, name) == expected
