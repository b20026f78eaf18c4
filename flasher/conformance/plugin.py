"""The pytest plugin: the conformance suite, and a team's own cases beside it, as pytest tests.

pytest loads this module wherever flasher is installed, so it only declares options and fixtures;
what they need is imported when a test asks for it. Without a `--btl-*` option nothing is changed.

    pytest --btl-mock --btl-suite
    pytest --btl-target bms --btl-interface socketcan --btl-channel can0 --btl-good-image ok.hex
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from flasher.conformance.bench import Bench
    from flasher.conformance.plugin_bench import Measurements, PluginRun, TestTrace
    from flasher.conformance.profile import ConformanceProfile
    from flasher.conformance.subject import Port, Subject

_MARKERS = (
    "destructive: erases the application of the device under test, which is put back afterwards",
    "needs_power: switches the device under test off and on; skipped without power control",
    "timing: judges times; what the adapter's time stamps are worth decides",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """The options, which all begin with --btl."""
    group = parser.getgroup("btl", "bootloader under test (flasher conformance)")
    add = group.addoption
    add("--btl-target", metavar="wmc|bms|obc", help="the device (default with --btl-mock: bms)")
    add("--btl-interface", metavar="BACKEND", help="python-can's back end for the adapter")
    add("--btl-channel", metavar="CHANNEL", help="which adapter or port: can0, ...")
    add("--btl-bitrate", metavar="BPS", type=int, help="bits per second (default 250000)")
    add(
        "--btl-bus-kwarg",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="one more argument for the back end; may be repeated",
    )
    add("--btl-profile", metavar="FILE", help="the product's choices and limits (TOML)")
    add("--btl-good-image", metavar="IMAGE", help="an image that runs on the device")
    add("--btl-second-image", metavar="IMAGE", help="another one, smaller, of another version")
    add("--btl-allow-implausible", action="store_true", help="whatever these images look like")
    add("--btl-power-cmd", metavar="COMMAND", help="switches the device, as 'relay 3 {on|off}'")
    add("--btl-readback-cmd", metavar="COMMAND", help="dumps the flash, as 'dump {file}'")
    add("--btl-uncertainty", metavar="SECONDS", type=float, help="how far times may be off")
    add(
        "--btl-mock", action="store_true", help="test the built-in device model, on a virtual clock"
    )
    add("--btl-variant", metavar="NAME", help="with --btl-mock: one that is deliberately wrong")
    add(
        "--btl-set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="with --btl-mock: a choice of the device model; may be repeated",
    )
    add("--btl-seed", metavar="SEED", default="1", help="decides all that is left to chance")
    add("--btl-suite", action="store_true", help="collect the cases of the conformance suite too")
    add("--btl-quick", action="store_true", help="of the suite only what takes under a minute")


def pytest_configure(config: pytest.Config) -> None:
    """Declare the markers; everything else only where a bench is named."""
    for line in _MARKERS:
        config.addinivalue_line("markers", line)
    if is_active(config):
        from flasher.conformance.plugin_hooks import Hooks  # noqa: PLC0415  not for others

        config.pluginmanager.register(Hooks(config), "flasher-conformance-hooks")
    elif config.getoption("btl_suite"):
        raise pytest.UsageError("--btl-suite needs a device: --btl-target, or --btl-mock")


def is_active(config: pytest.Config) -> bool:
    """True when the command line names a device under test."""
    return bool(config.getoption("btl_mock") or config.getoption("btl_target"))


# -- the bench, once a session --------------------------------------------------------------------


@pytest.fixture(scope="session")
def btl_power_control() -> Callable[[bool], None] | None:
    """To be overridden, in the conftest.py of the root directory: a function that switches the
    device on (True) or off, in place of --btl-power-cmd.
    """
    return None


@pytest.fixture(scope="session")
def btl_readback_control() -> Callable[[], bytes] | None:
    """To be overridden as `btl_power_control`: a function that yields the application area."""
    return None


@pytest.fixture(scope="session")
def btl_run(
    request: pytest.FixtureRequest,
    btl_power_control: Callable[[bool], None] | None,
    btl_readback_control: Callable[[], bytes] | None,
) -> Iterator[PluginRun]:
    """The run on the one device: opened with the first test that needs it; at the end the good
    image is flashed and verified.
    """
    if not is_active(request.config):
        pytest.skip("no device under test: give --btl-target with an adapter, or --btl-mock")
    from flasher.conformance.plugin_bench import opened_run  # noqa: PLC0415  only where it is used

    with opened_run(request.config, btl_power_control, btl_readback_control) as run:
        yield run


@pytest.fixture(scope="session")
def btl_device(btl_run: PluginRun) -> Subject:
    """The device under test: its images, and what this bench can do to it."""
    return btl_run.subject


@pytest.fixture(scope="session")
def btl_bus(btl_device: Subject) -> Port:
    """The way to the bus: single frames, with their times."""
    return btl_device.port


@pytest.fixture(scope="session")
def btl_profile(btl_run: PluginRun) -> ConformanceProfile:
    """What the product is judged by."""
    return btl_run.profile


@pytest.fixture(scope="session")
def btl_measurements(btl_run: PluginRun) -> Measurements:
    """The times of the whole session, by name."""
    return btl_run.measurements


# -- for one test ---------------------------------------------------------------------------------


@pytest.fixture
def btl_bench(request: pytest.FixtureRequest, btl_run: PluginRun) -> Iterator[Bench]:
    """What a case works with. The good image's application runs before the test and after it; a
    check that failed fails the test, even where the test went on.
    """
    node: Any = request.node
    yield from btl_run.bench_for(node)


@pytest.fixture
def btl_power(btl_bench: Bench) -> Callable[[bool], None]:
    """A function that switches the device on (True) or off; skips without power control."""
    if not btl_bench.subject.has_power:
        pytest.skip("needs power control")

    def switch(on: bool) -> None:  # noqa: FBT001  it is the one argument
        if on:
            btl_bench.power_on()
        else:
            btl_bench.power_off()

    return switch


@pytest.fixture
def btl_trace(btl_bench: Bench) -> TestTrace:
    """The frames of this test so far, and how to save them."""
    from flasher.conformance.plugin_bench import TestTrace  # noqa: PLC0415

    return TestTrace(btl_bench)
