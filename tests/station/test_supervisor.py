"""Real processes: they start, work, die and are replaced. Power commands."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from flasher.errors import BusError
from flasher.station.config import MockUnits
from flasher.station.messages import AdapterReady, FromWorker, VirtualUnits, WorkerSetup
from flasher.station.power import PowerCommand
from flasher.station.supervisor import ProcessPort, WorkerLost, WorkerSupervisor
from tests.loops import each
from tests.station.factory import make_recipe

pytestmark = pytest.mark.slow

LIMIT_S = 30.0


def setup_of(folder: Path, name: str) -> WorkerSetup:
    recipe = make_recipe(folder)
    files = {str(path): sha256 for path, sha256 in recipe.files.items()}
    return WorkerSetup(name, recipe.path, files, None, VirtualUnits(MockUnits(), arrive_after_s=0))


def until(
    supervisor: WorkerSupervisor,
    enough: Callable[[list[tuple[str, FromWorker | WorkerLost]]], bool],
) -> list[tuple[str, FromWorker | WorkerLost]]:
    found: list[tuple[str, FromWorker | WorkerLost]] = []
    give_up_at = time.perf_counter() + LIMIT_S
    while not enough(found):
        assert time.perf_counter() < give_up_at, found
        supervisor.wait((), 0.1)
        found += supervisor.poll()
    return found


def test_a_killed_process_is_replaced_and_the_other_goes_on(tmp_path: Path) -> None:
    supervisor = WorkerSupervisor([setup_of(tmp_path, name) for name in "AB"], time.perf_counter)
    try:
        until(supervisor, lambda found: sum(isinstance(m, AdapterReady) for _, m in found) == 2)
        other = supervisor.ports["B"]
        port = supervisor.ports["A"]
        assert isinstance(port, ProcessPort)
        port._process.kill()
        found = until(supervisor, lambda f: any(isinstance(m, WorkerLost) for _, m in f))
        lost = [(name, m) for name, m in found if isinstance(m, WorkerLost)]
        assert lost == [("A", WorkerLost("its process ended", hung=False, restart_in_s=1.0))]
        assert supervisor.ports["B"] is other
    finally:
        supervisor.close()
    assert supervisor.ports == {}


class FakeRelay:
    def __init__(self, fails_at: str = "") -> None:
        self.calls: list[list[str]] = []
        self._fails_at = fails_at

    def __call__(self, words: object) -> None:
        assert isinstance(words, list)
        self.calls.append(words)
        if self._fails_at in words:
            raise BusError("The power command failed with exit code 1.")


def test_a_power_cycle_is_off_a_pause_and_on() -> None:
    relay, slept = FakeRelay(), list[float]()
    power = PowerCommand("relay 3 {on|off}", off_s=1.5, run=relay, sleep=slept.append)
    power.begin_cycle()
    power.check()
    assert relay.calls == [["relay", "3", "off"], ["relay", "3", "on"]]
    assert slept == [1.5]


def test_a_power_command_that_fails_is_reported_when_it_is_looked_at() -> None:
    power = PowerCommand("relay 3 {on|off}", run=FakeRelay("on"), sleep=lambda _s: None)
    power.begin_cycle()
    with pytest.raises(BusError, match="exit code 1"):
        power.check()
    power.check()


@each(
    "template, reported",
    [("false {on|off}", "exit code 1"), ("no-such-command {on|off}", "cannot be run")],
)
def test_a_real_power_command_that_does_not_work(template: str, reported: str) -> None:
    power = PowerCommand(template, sleep=lambda _s: None)
    power.begin_cycle()
    with pytest.raises(BusError, match=reported):
        power.check()
