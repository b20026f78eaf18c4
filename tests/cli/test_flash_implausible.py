"""What is no firmware is not flashed, and which words let it through."""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from flasher.errors import ExitCode
from flasher.image.image import Image
from tests.cli.conftest import Flasher
from tests.cli.test_flash_checks import Workbench, bench, wrote
from tests.end_to_end.stage import Stage

__all__ = ["bench"]

PAGE = Image.from_bytes(b"<!doctype html>\n<title>404</title>\n" * 9)
ENCRYPTED = Image.from_bytes(random.Random(3).randbytes(500))
OTHER_CPU = 'cpu = "other"\n'
HOLDS = "not plausible as firmware"


@pytest.mark.parametrize("image", [PAGE, ENCRYPTED], ids=["page", "encrypted"])
def test_it_is_refused_before_anything_is_sent(bench: Workbench, image: Image) -> None:
    stage = Stage()
    run = bench.flash(stage, image=image)
    assert run.code == ExitCode.IMAGE
    assert HOLDS in run.err
    assert ("--allow-implausible" in run.err) is (image is ENCRYPTED)
    assert ("cpu = " in run.err) is ("manifest create" in run.err) is (image is ENCRYPTED)
    assert stage.heard == []
    assert bench.flash(stage, "--dry-run", image=image).code == ExitCode.IMAGE


@pytest.mark.parametrize(
    ("image", "has_manifest", "has_profile", "words", "code"),
    [
        (ENCRYPTED, True, False, (), ExitCode.OK),
        (ENCRYPTED, False, True, (), ExitCode.OK),
        (ENCRYPTED, False, False, ("--allow-implausible",), ExitCode.OK),
        (ENCRYPTED, False, False, ("--force",), ExitCode.OK),
        (PAGE, True, True, (), ExitCode.IMAGE),
        (PAGE, True, True, ("--allow-implausible",), ExitCode.OK),
    ],
)
def test_what_lets_it_through(
    bench: Workbench,
    tmp_path: Path,
    image: Image,
    has_manifest: bool,
    has_profile: bool,
    words: Sequence[str],
    code: ExitCode,
) -> None:
    profile = tmp_path / "profile.toml"
    profile.write_text(OTHER_CPU if has_profile else "")
    stage = Stage()
    manifest: dict[str, Any] | None = {} if has_manifest else None
    words = ("--verify", "none", "--profile", str(profile), *words)
    run = bench.flash(stage, *words, image=image, manifest=manifest)
    assert run.code == code, run.err
    assert wrote(stage) is (code is ExitCode.OK)
    if code is ExitCode.OK:
        assert stage.has == image.data
        assert "the image " in run.err


def test_a_profile_that_names_no_known_processor_is_refused(
    bench: Workbench, tmp_path: Path
) -> None:
    profile = tmp_path / "profile.toml"
    profile.write_text('cpu = "z80"\n')
    run = bench.flash(Stage(), "--profile", str(profile))
    assert run.code == ExitCode.USAGE
    assert "It is cortex-m, other" in run.err


@pytest.mark.parametrize("image", [PAGE, ENCRYPTED], ids=["page", "encrypted"])
def test_no_manifest_is_made_for_it_unasked(flasher: Flasher, tmp_path: Path, image: Image) -> None:
    path = tmp_path / "it.bin"
    path.write_bytes(image.data)
    run = flasher("manifest", "create", path, "-t", "bms")
    assert run.code == ExitCode.IMAGE
    assert ("--allow-implausible" in run.err) is (image is ENCRYPTED)
    assert list(tmp_path.iterdir()) == [path]
    words = ("manifest", "create", path, "-t", "bms", "--allow-implausible")
    assert flasher(*words).code == ExitCode.OK


def test_it_is_no_good_image_of_a_bench(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "it.bin"
    path.write_bytes(PAGE.data)
    words = ("conformance", "-t", "bms", "--mock", "--good-image", path, "--case", "RS-01")
    run = flasher(*words)
    assert run.code == ExitCode.IMAGE
    assert "an HTML page" in run.err
    assert flasher(*words, "--allow-implausible").code == ExitCode.OK
