"""The pytest plugin of flasher: the conformance suite, and a team's own cases beside it, as tests.

pytest loads this module wherever flasher is installed (`-p no:pytest_flasher` leaves it out), so it
only declares options and fixtures, and is not part of the package: flasher is imported when a test
asks for a device. Without a `--btl-*` option nothing is changed.

    pytest --btl-mock --btl-suite
    pytest --btl-target bms --btl-interface socketcan --btl-channel can0 --btl-good-image ok.hex
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from flasher.conformance.bench import Bench
    from flasher.conformance.plugin import BenchTrace, Measurements, PluginRun
    from flasher.conformance.profile import ConformanceProfile
    from flasher.conformance.subject import BusPort, Subject

_MARKERS = (
    "destructive: erases the application of the device under test, which is restored afterwards",
    "needs_power: switches the device under test off and on; skipped without power control",
    "timing: judges times, so the accuracy of the adapter's time stamps matters",
)


_SEVERAL: dict[str, Any] = {"action": "append", "default": []}
_FLAG: dict[str, Any] = {"action": "store_true"}
BENCH_OPTIONS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "--btl-target": ("wmc|bms|obc", "the device (default without hardware: bms)", {}),
    "--btl-interface": ("BACKEND", "python-can's back end for the adapter", {}),
    "--btl-channel": ("CHANNEL", "the adapter or port: can0, ...", {}),
    "--btl-bitrate": ("BPS", "bits per second (default 250000)", {"type": int}),
    "--btl-bus-kwarg": ("KEY=VALUE", "additional argument for the back end; repeatable", _SEVERAL),
    "--btl-profile": ("FILE", "the product's choices and limits (TOML)", {}),
    "--btl-good-image": ("IMAGE", "an image that runs on the device", {}),
    "--btl-second-image": ("IMAGE", "another one, smaller, of another version", {}),
    "--btl-allow-implausible": ("", "accept images that do not look like programs", _FLAG),
    "--btl-power-cmd": ("COMMAND", "command that switches the device: 'relay 3 {on|off}'", {}),
    "--btl-readback-cmd": ("COMMAND", "command that dumps the flash: 'dump {file}'", {}),
    "--btl-uncertainty": ("SECONDS", "uncertainty of measured times", {"type": float}),
    "--btl-mock": ("", "test the built-in device model, on a virtual clock", _FLAG),
    "--btl-subject": ("BOOTLOADER", "test a bootloader compiled for this computer", {}),
    "--btl-variant": ("NAME", "with --btl-mock: a deliberately wrong device", {}),
    "--btl-set": (
        "KEY=VALUE",
        "with --btl-mock: an option of the device model; repeatable",
        _SEVERAL,
    ),
    "--btl-seed": ("SEED", "determines all random values", {"default": "1"}),
}
"""Options that select and describe the device: metavar (none for a flag), help, and arguments."""
_RUN_OPTIONS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "--btl-suite": ("", "collect the cases of the conformance suite too", _FLAG),
    "--btl-quick": ("", "only the cases that take less than a minute", _FLAG),
    "--btl-strict": ("", "fail on a pass in part and on a resolved deviation", _FLAG),
    "--btl-json-report": ("FILE", "the suite's report, for `flasher conformance diff`", {}),
    "--btl-html": ("FILE", "the report as one self-contained page", {}),
    "--btl-trace-dir": ("DIR", "directory for the frames (candump) of failed cases", {}),
}


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("btl", "bootloader under test (flasher conformance)")
    for name, (metavar, text, more) in (BENCH_OPTIONS | _RUN_OPTIONS).items():
        group.addoption(name, help=text, **({"metavar": metavar} if metavar else {}), **more)


def pytest_configure(config: pytest.Config) -> None:
    """Declare the markers; register the hooks only when a device is given."""
    for line in _MARKERS:
        config.addinivalue_line("markers", line)
    if _is_active(config):
        from flasher.conformance.plugin import Hooks  # noqa: PLC0415  not for others

        config.pluginmanager.register(Hooks(config), "flasher-conformance-hooks")
    elif config.getoption("btl_suite"):
        devices = "--btl-target, --btl-mock or --btl-subject"
        raise pytest.UsageError(f"--btl-suite needs a device: {devices}")


def _is_active(config: pytest.Config) -> bool:
    """True when the command line selects a device under test."""
    return any(config.getoption(f"btl_{name}") for name in ("mock", "subject", "target"))


# -- bench, once per session --------------------------------------------------------------------


@pytest.fixture(scope="session")
def btl_power_control() -> Callable[[bool], None] | None:
    """Override in the root directory's conftest.py: a function that switches the device on (True)
    or off, instead of --btl-power-cmd.
    """
    return None


@pytest.fixture(scope="session")
def btl_readback_control() -> Callable[[], bytes] | None:
    """Override like `btl_power_control`: a function that returns the application area."""
    return None


@pytest.fixture(scope="session")
def btl_run(
    request: pytest.FixtureRequest,
    btl_power_control: Callable[[bool], None] | None,
    btl_readback_control: Callable[[], bytes] | None,
) -> Iterator[PluginRun]:
    """The run on the device: opened by the first test that needs it; flashes and verifies the good
    image at the end.
    """
    if not _is_active(request.config):
        pytest.skip("no device under test: give --btl-target with an adapter, or --btl-mock")
    from flasher.conformance.plugin import open_run  # noqa: PLC0415  only where it is used

    with open_run(request.config, btl_power_control, btl_readback_control) as run:
        yield run


@pytest.fixture(scope="session")
def btl_device(btl_run: PluginRun) -> Subject:
    """The device under test: its images and capabilities."""
    return btl_run.subject


@pytest.fixture(scope="session")
def btl_bus(btl_device: Subject) -> BusPort:
    """The bus of the device: single frames with their times."""
    return btl_device.port


@pytest.fixture(scope="session")
def btl_profile(btl_run: PluginRun) -> ConformanceProfile:
    """The product's profile."""
    return btl_run.profile


@pytest.fixture(scope="session")
def btl_measurements(btl_run: PluginRun) -> Measurements:
    """Times measured in the session, by name."""
    return btl_run.measurements


# -- for one test ---------------------------------------------------------------------------------


@pytest.fixture
def btl_bench(request: pytest.FixtureRequest, btl_run: PluginRun) -> Iterator[Bench]:
    """Bench for one test. The good image's application runs before and after the test; a failed
    check fails the test, even if the test continued.
    """
    node: Any = request.node
    yield from btl_run.bench_for(node)


@pytest.fixture
def btl_power(btl_bench: Bench) -> Callable[[bool], None]:
    """A function that switches the device on (True) or off; skips without power control."""
    if not btl_bench.subject.has_power:
        pytest.skip("needs power control")
    return lambda on: btl_bench.power_on() if on else btl_bench.power_off()


@pytest.fixture
def btl_trace(btl_bench: Bench) -> BenchTrace:
    """The frames of this test so far; can be saved to a file."""
    from flasher.conformance.plugin import BenchTrace  # noqa: PLC0415

    return BenchTrace(btl_bench)
