"""The pytest plugin, run by pytest inside of pytest."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from flasher.conformance.mock import GOOD_IMAGE
from tests.cli.conftest import Flasher

PLUGIN: Final = "pytest_flasher"
ALONE: Final = ("-p", PLUGIN, "-p", "no:xdist", "-p", "no:cacheprovider", "--strict-markers")
MOCK: Final = (*ALONE, "--btl-mock")
pytest_plugins = ("pytester",)

OWN: Final = """
import pytest

def test_the_name(btl_bench, btl_profile, btl_bus):
    first = btl_bench.reset_to_bootloader()
    btl_bench.check(first.boot_name == "BMS", "the name BMS", first.boot_name)
    assert btl_profile.choice("tx_02") == "ack"
    assert btl_bus.bitrate_bps == 250_000

@pytest.mark.destructive
def test_a_transfer_that_is_left_alone(btl_bench, btl_trace, tmp_path):
    btl_bench.start_transfer(1000)
    assert any(entry.sent for entry in btl_trace.frames)
    btl_trace.save(tmp_path / "frames.log")
    assert "752#" in (tmp_path / "frames.log").read_text()

def test_the_application_is_back(btl_bench, btl_device):
    btl_bench.check_application()
    assert btl_device.target == "bms"

@pytest.mark.needs_power
@pytest.mark.timing
def test_power_up(btl_bench, btl_power, btl_measurements):
    btl_power(False)
    btl_bench.expect_silence(0.1)
    btl_power(True)
    btl_bench.wait_for(*[type(btl_bench.next_message(1.0).kind).BOOT_VERSION], within_s=1.0)
    btl_measurements.record("mine", 0.5)
    assert btl_measurements.of("mine").count == 1
"""


@pytest.mark.slow
def test_a_team_adds_its_own_tests_beside_the_suite(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(test_own=OWN)
    done = pytester.runpytest_inprocess(*MOCK, "--btl-suite", "-k", "test_own or RS", "-v")
    done.assert_outcomes(passed=9, deselected=done.parseoutcomes()["deselected"])
    done.stdout.fnmatch_lines(["btl::RS-01 PASSED*", "*times in ms*", "mine*500.0*"])


@pytest.mark.slow
def test_a_failed_check_fails_a_test_that_went_on(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        from flasher.conformance.results import Unsupported

        def test_a_check(btl_bench):
            btl_bench.check(False, "one", "two")
            btl_bench.check(True, "three", "three")

        def test_that_it_ends(btl_bench):
            btl_bench.require(False, "four", "five")

        def test_what_cannot_be_done(btl_bench):
            raise Unsupported("no such thing")
        """
    )
    done = pytester.runpytest_inprocess(*MOCK)
    done.assert_outcomes(failed=2, skipped=1)
    done.stdout.fnmatch_lines(["expected one; got two", "expected four; got five"])


@pytest.mark.slow
def test_the_verdicts_of_the_suite_are_those_of_pytest(pytester: pytest.Pytester) -> None:
    Path("p.toml").write_text(
        '[deviations]\n"RS-05" = "by design"\n[limits]\nversion_spacing_s = 0.02\n'
    )
    words = ("--btl-suite", "--btl-profile", "p.toml", "-k", "RS-01 or RS-05 or EN-04")
    done = pytester.runpytest_inprocess(*MOCK, *words, "-rxs")
    done.assert_outcomes(
        failed=1, xfailed=1, skipped=1, deselected=done.parseoutcomes()["deselected"]
    )
    done.stdout.fnmatch_lines(["*fail: expected *", "seed: 1/RS-01/1", "XFAIL*by design*"])


@pytest.mark.slow
def test_what_a_run_keeps_is_what_the_command_line_keeps(
    pytester: pytest.Pytester, flasher: Flasher
) -> None:
    words = ("--btl-suite", "-k", "RS-01 or RS-04 or EN-04", "--btl-variant=no-feedback")
    kept = ("--btl-json-report=r.json", "--btl-html=r.html", "--btl-trace-dir=traces")
    done = pytester.runpytest_inprocess(*MOCK, *words, *kept, "--junitxml=j.xml")
    done.stdout.fnmatch_lines(
        [
            "clause: Welling 3.2, table 5 (5503): general feedback*",
            "replay: pytest --btl-mock --btl-variant=no-feedback --btl-suite -k RS-01",
            "*Captured frames call*",
            "*CDL > BMS  reset  text RESET",
            "* > 752 ?8? 55 AA 16 07*",
            "1 of 1 passes were judged in full",
            "good image at the end: flashed and verified by version and readback",
        ]
    )
    assert 'name="RS-01 reset of the application"' in Path("j.xml").read_text()
    cases = ("--case", "RS-01", "--case", "RS-04", "--case", "EN-04")
    bench = ("conformance", "-t", "bms", "--mock", "--variant", "no-feedback")
    assert flasher(*bench, *cases, "--json-report", "cli.json", "--trace-dir", "cli").code == 12
    assert Path("traces/RS-01.log").read_bytes() == Path("cli/RS-01.log").read_bytes()
    same = flasher("conformance", "diff", "cli.json", "r.json")
    assert (same.code, "2 unchanged" in same.out) == (0, True)
    assert "good image at the end" in Path("r.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_pass_in_part_states_what_was_not_tried_and_fails_a_strict_run(
    pytester: pytest.Pytester,
) -> None:
    words = ("--btl-suite", "-k", "EN-07", "--btl-good-image", "good.bin", "-rP")
    Path("good.bin").write_bytes(GOOD_IMAGE)
    done = pytester.runpytest_inprocess(*MOCK, *words, "--btl-allow-implausible")
    done.stdout.fnmatch_lines(
        ["not tried: a smaller image (the bench has no second good image)", "0 of 1 passes*"]
    )
    assert done.ret == 0
    strict = pytester.runpytest_inprocess(*MOCK, *words, "--btl-allow-implausible", "--btl-strict")
    strict.stdout.fnmatch_lines(["pass in part: not tried: a smaller image*"])
    assert strict.parseoutcomes()["failed"] == 1


@pytest.mark.slow
def test_the_frames_of_an_own_test_that_failed_are_kept(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        def test_it(btl_bench):
            btl_bench.reset_to_bootloader()
            btl_bench.check(False, "one", "two")
        """
    )
    done = pytester.runpytest_inprocess(*MOCK, "--btl-trace-dir=traces")
    done.stdout.fnmatch_lines(["*CDL > BMS  reset  text RESET"])
    assert "752#55AA1607" in Path("traces/test_it.log").read_text()


@pytest.mark.slow
def test_markers_choose_cases_of_the_suite_and_a_wrong_device_fails_in_its_own(
    pytester: pytest.Pytester,
) -> None:
    words = ("--btl-suite", "--btl-variant", "no-feedback", "--btl-quick", "-v")
    done = pytester.runpytest_inprocess(*MOCK, *words, "-m", "timing and not destructive")
    done.stdout.fnmatch_lines(["btl::RS-01 FAILED*", "btl::RS-05 PASSED*"])
    done.stdout.no_fnmatch_line("*RS-04*")
    assert done.parseoutcomes()["failed"] == 1


@pytest.mark.slow
def test_power_and_readback_can_be_functions_of_a_conftest(pytester: pytest.Pytester) -> None:
    pytester.makeconftest(
        """
        import pytest

        @pytest.fixture(scope="session")
        def btl_power_control():
            return lambda on: None
        """
    )
    pytester.makepyfile("def test_it(btl_device): pass")
    # A mock has its own power control; rejecting the function shows that it was passed on.
    done = pytester.runpytest_inprocess(*MOCK)
    done.assert_outcomes(errors=1)
    done.stdout.fnmatch_lines(["*The mock has its own power control and readback.*"])


@pytest.mark.slow
def test_what_is_wrong_with_the_bench_is_reported_without_a_traceback(
    pytester: pytest.Pytester,
) -> None:
    pytester.makepyfile("def test_it(btl_bench): pass")
    done = pytester.runpytest_inprocess(*MOCK, "--btl-variant", "no-such")
    done.assert_outcomes(errors=1)
    done.stdout.fnmatch_lines(["*variant*no-such*"])
    done.stdout.no_fnmatch_line("*Traceback*")


# -- for those who do not use it ------------------------------------------------------------------


@pytest.mark.slow
def test_without_a_device_its_fixtures_skip_and_nothing_else_changes(
    pytester: pytest.Pytester,
) -> None:
    pytester.makepyfile(
        """
        def test_with(btl_bench): pass
        def test_without(): pass
        """
    )
    done = pytester.runpytest_inprocess(*ALONE, "-rs")
    done.assert_outcomes(passed=1, skipped=1)
    done.stdout.fnmatch_lines(["*no device under test: give --btl-target*"])
    done.stdout.no_fnmatch_line("*times in ms*")


def test_the_suite_without_a_device_is_wrong_usage(pytester: pytest.Pytester) -> None:
    done = pytester.runpytest_inprocess(*ALONE, "--btl-suite")
    assert done.ret == pytest.ExitCode.USAGE_ERROR
    done.stderr.fnmatch_lines(["*--btl-suite needs a device*"])


@pytest.mark.slow
def test_loading_the_plugin_loads_nothing_of_the_suite_and_no_adapter() -> None:
    code = (
        f"import sys, {PLUGIN}\n"
        "print(*(name for name in sys.modules "
        "if name.partition('.')[0] in ('flasher', 'can', 'jinja2')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_one_device_is_not_tested_by_several_processes(pytester: pytest.Pytester) -> None:
    words = ("-p", PLUGIN, "-p", "no:cacheprovider", "-n", "2", "--btl-target", "bms")
    done = pytester.runpytest_inprocess(*words)
    assert done.ret == pytest.ExitCode.USAGE_ERROR
    done.stderr.fnmatch_lines(["*one device cannot be tested by several processes*"])
