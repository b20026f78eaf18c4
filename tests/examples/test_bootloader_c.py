"""The example bootloader in C: conformance suite, and an emulated Cortex-M."""

from __future__ import annotations

import hashlib
import re
import subprocess
from functools import partial
from pathlib import Path

import pytest

from tests.campaigns.planted_bugs import DUT, plant, read_bugs
from tests.cli.conftest import Flasher
from tests.examples.bootloader import PROFILE, SOURCE, emulated, make, missing

pytestmark = pytest.mark.slow

FLASH_BYTES = 8192
_STRICT = (
    *("gcc", "-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"),
    *("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
)
_SOURCES = ("boot.c", "store.c", "message.c", "crc.c", "host/hal_host.c")


def _need(*programs: str) -> None:
    if why := missing(*programs):
        pytest.skip(why)


@pytest.fixture(scope="session")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where `_compiled` keeps what it makes."""
    return tmp_path_factory.mktemp("objects")


def _compiled(source: Path, name: str, objects: Path) -> Path:
    """The object of a file of a bootloader; most are the same in the one with a bug."""
    read = [path.read_bytes() for path in (source / name, *sorted(source.glob("*.h")))]
    made = objects / f"{hashlib.sha256(b''.join(read)).hexdigest()}.o"
    if not made.exists():
        command: list[str | Path] = [*_STRICT, f"-I{DUT}", f"-I{source}", "-c", source / name]
        subprocess.run([*command, "-o", made], check=True)
    return made


def test_some_of_every_group_under_sanitizers(flasher: Flasher, tmp_path: Path) -> None:
    """`python -m tests.campaigns.planted_bugs none` runs the whole suite on it."""
    _need("make", "gcc")
    make("host", tmp_path, "DEFINES=-DIMAGE_CHECKSUM=1")
    profile = tmp_path / "profile.toml"
    profile.write_text('en_04 = "crc32"\n' + PROFILE.read_text(encoding="utf-8"))
    ran = flasher(
        *(
            "conformance",
            "-t",
            "bms",
            "--subject",
            tmp_path / "boot",
            "--profile",
            profile,
            "--quick",
            "--json",
        )
    )
    results = ran.document["report"]["results"]
    assert [result for result in results if result["status"] != "pass"] == []
    assert ran.code == 0


def test_what_the_suite_reached_can_be_measured(flasher: Flasher, tmp_path: Path) -> None:
    _need("make", "gcc", "gcov")
    make("coverage", tmp_path)
    subject = tmp_path / "coverage" / "boot"
    line = ("conformance", "-t", "bms", "--subject", subject, "--profile", PROFILE)
    assert flasher(*line, "--case", "RS-01", "--case", "TX-01", "--case", "EN-02").code == 0
    printed = subprocess.run(
        ["gcov", "--object-directory", subject.parent, "boot-boot"],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    share = re.search(r"boot\.c'\nLines executed:([\d.]+)%", printed.stdout)
    assert share is not None
    assert 70 < float(share[1]) < 100
    assert re.search(r"^ +\d+\*?: +\d+:", (tmp_path / "boot.c.gcov").read_text(), re.MULTILINE)


def test_every_planted_bug_applies(tmp_path: Path) -> None:
    """`python -m tests.campaigns.planted_bugs` builds them and runs the suite on them."""
    _need("patch")
    bugs = read_bugs()
    assert [int(bug.name[:2]) for bug in bugs] == list(range(1, 94))
    for bug in bugs:
        plant(bug, tmp_path)


@pytest.mark.parametrize(
    ("number", "step"),
    [
        ("91", "flash write 1 of 7 reports an error, once"),
        ("92", "flash erase 1 of 60 reports an error, once"),
        ("93", "flash write 1 of 7 has a wrong bit, without an error"),
    ],
)
def test_a_bootloader_that_trusts_its_flash_fails_where_the_flash_does(
    number: str, step: str, flasher: Flasher, tmp_path: Path
) -> None:
    _need("make", "gcc", "patch")
    (bug,) = [bug for bug in read_bugs() if bug.name.startswith(number)]
    sources = plant(bug, tmp_path)
    make(f"{tmp_path}/boot", tmp_path, f"DUT={DUT}", source=sources)
    subject = ("--subject", tmp_path / "boot", "--profile", PROFILE)
    ran = flasher("conformance", "-t", "bms", *subject, "--case", "PW-04", "--json")
    assert ran.code == 12
    (result,) = ran.document["report"]["results"]
    assert result["findings"][0]["step"] == step
    assert ran.document["report"]["final_image"] == "verified"


def test_a_flash_that_fails_is_no_trouble_for_the_example(flasher: Flasher, tmp_path: Path) -> None:
    _need("make", "gcc")
    make(f"{tmp_path}/boot", tmp_path)
    subject = ("--subject", tmp_path / "boot", "--profile", PROFILE)
    ran = flasher("conformance", "-t", "bms", *subject, "--case", "PW-04", "--json")
    assert ran.code == 0, ran.out
    (result,) = ran.document["report"]["results"]
    assert result["checks"]["passed"] > 30 * 3  # faults; what runs, a later upgrade and its image


@pytest.mark.parametrize(
    ("number", "action"),
    [
        ("37", ("--case", "TX-01")),  # an answer
        ("36", ("--case", "TX-03")),  # a write to flash that is not erased
        ("17", ("--case", "UP-08")),  # an image
        ("24", ("explore", "--replay", "reset update=300 packets=4 packet-beyond")),
    ],
)
def test_what_failed_is_a_test_in_c_that_only_the_right_bootloader_passes(
    number: str,
    action: tuple[str, ...],
    flasher: Flasher,
    tmp_path: Path,
    objects: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One with some more messages will do: test_export.py wants the fewest."""
    _need("make", "gcc", "patch")
    monkeypatch.setattr("flasher.conformance.dut.exported_test._TRIES", 12)
    (bug,) = [bug for bug in read_bugs() if bug.name.startswith(number)]
    wrong = plant(bug, tmp_path)
    make(f"{tmp_path}/boot", tmp_path, f"DUT={DUT}", source=wrong)
    test = tmp_path / "exported.c"
    ran = flasher(
        *("conformance", *action, "-t", "bms", "--subject", tmp_path / "boot"),
        *("--profile", PROFILE, "--export-test", test),
    )
    assert ran.code == 12
    run = partial(subprocess.run, check=True, cwd=tmp_path)
    run([*_STRICT, f"-I{DUT}", "-c", test])
    codes = []
    for source in (wrong, SOURCE):
        made = [_compiled(source, name, objects) for name in _SOURCES]
        run([*_STRICT, "exported.o", *made, "-o", "exported"])
        done = run(["./exported"], check=False, capture_output=True, text=True)
        codes.append((done.returncode, done.stdout.partition(":")[0], done.stderr))
    assert codes == [(1, "FAIL", ""), (0, "PASS", "")]


def test_another_target_in_a_shared_library(flasher: Flasher, tmp_path: Path) -> None:
    """A target whose bootloader reports the name PBU."""
    _need("make", "gcc")
    subject = tmp_path / "libboot.so"
    make(str(subject), tmp_path, "DEFINES=-DTARGET=TARGET_OBC")
    ran = flasher(
        *("conformance", "-t", "obc", "--subject", subject, "--profile", PROFILE),
        *("--case", "RS-01", "--case", "TX-01", "--case", "EN-02"),
    )
    assert ran.code == 0, ran.out


def test_an_emulated_processor_is_flashed_twice_over_slcan(
    flasher: Flasher, tmp_path: Path
) -> None:
    _need("make", "arm-none-eabi-gcc", "qemu-system-arm")
    reported = make("arm", tmp_path)
    sizes = re.findall(
        r"^ *(\d+)\s+(\d+)\s+\d+\s+\d+\s+\w+\s+\S*boot\.elf$", reported, re.MULTILINE
    )
    assert [int(text) + int(data) < FLASH_BYTES for text, data in sizes] == [True], reported
    make("arm", tmp_path / "newer", "APPLICATION_VERSION=V2r0r0_20260202")
    with emulated(tmp_path / "boot.elf", tmp_path / "monitor") as channel:
        line = ("-t", "bms", "-i", "slcan", "-c", channel, "--bus-kwargs", "sleep_after_open=0")
        first = flasher("flash", tmp_path / "application.bin", *line)
        assert "BMS runs V1r0r0_20260101 (version read back)" in first.out, first.err
        newer = tmp_path / "newer" / "application.bin"
        second = flasher("flash", newer, *line, "--base", "0x2000", "--verify", "memory")
        assert "BMS runs V2r0r0_20260202, was V1r0r0_20260101" in second.out, second.err
        assert (first.code, second.code) == (0, 0)


def test_a_unit_longer_than_a_packet_does_not_compile(tmp_path: Path) -> None:
    _need("make", "gcc")
    with pytest.raises(AssertionError, match="a packet begins a unit"):
        make("host", tmp_path, "DEFINES=-DWRITE_BYTES=256u")


def test_the_code_on_the_page_compiles(flasher: Flasher, tmp_path: Path) -> None:
    _need("gcc")
    docs = Path(__file__).parents[2] / "docs"
    page = (docs / "how-to" / "bootloader.md").read_text(encoding="utf-8")
    code = re.search(r"```c\n(.*?)```", page, re.DOTALL)
    assert code is not None
    assert flasher("conformance", "header", tmp_path).code == 0
    (tmp_path / "port.c").write_text(code[1])
    (tmp_path / "YOUR_BOOTLOADER.h").write_text(
        "void YOUR_START(void);\n"
        "void YOUR_MAIN_LOOP_ONCE(void);\n"
        "void YOUR_RECEIVE(uint32_t id, const uint8_t *data, uint8_t length);\n"
        "int YOUR_NEXT_FRAME(uint32_t *id, uint8_t *data, uint8_t *length);\n"
    )
    strict = ("-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I.")
    subprocess.run(["gcc", *strict, "-c", "port.c"], cwd=tmp_path, check=True)
