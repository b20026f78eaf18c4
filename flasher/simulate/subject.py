"""Device of a plan that runs a bootloader under test, compiled for this computer or in Python.

An application is never put into its flash: only the bootloader knows what makes one complete. So
the first one comes by an upgrade without faults (`SubjectBench.device`), and what the flash
contains is what the bootloader starts from a copy of it after a power-up (`SubjectBench.started`).
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Final

from flasher import api
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.conformance.dut.device import CompiledDevice, application_image
from flasher.conformance.dut.failing_flash import FailingFlash
from flasher.conformance.dut.pipes import ABI_WITH_ERRORS
from flasher.conformance.dut.process import BootloaderError, BootloaderProcess
from flasher.conformance.results import LINE_JOINT
from flasher.conformance.subject import FlashCall, FlashEffect, FlashFault
from flasher.errors import FlasherError
from flasher.host.identity import Identity, IdentityCheck
from flasher.host.options import UpgradeOptions
from flasher.image.image import Image
from flasher.image.plan import Plan as ImagePlan
from flasher.image.plan import plan as image_plan
from flasher.mock.memory import FlashMemory, Operation
from flasher.protocol.frame import Frame
from flasher.protocol.spec import PACKET_DATA_SIZE, TARGETS, WELLING
from flasher.simulate import plan as plans
from flasher.simulate.draw import drawn_for_subject
from flasher.simulate.oracle import SubjectFailedError

_FIRST_PACKETS: Final = 12
"""Size of the first application."""
_KEPT: Final = 256
"""Contents of the flash of which it is remembered what is started from them."""


class PlanFlash(FailingFlash):
    """Flash whose operations a plan counts, interrupts and makes fail."""

    def __init__(self, device: CompiledDevice) -> None:
        super().__init__(device.flash)
        self.operations = self.failures_left = 0
        self._facts = device.facts
        self.on_operation: Callable[[int, float], float | None] = lambda _number, _takes_s: None
        """Called with the number of an operation, from 1, and its duration in seconds; returns the
        share of it after which the supply fails, or None.
        """

    def execute(self, operation: Operation, now: float) -> bool:
        self.operations += 1
        facts, data = self._facts, operation.data
        takes_us = (
            facts.erase_us if data is None else len(data) // facts.write_bytes * facts.write_us
        )
        share = self.on_operation(self.operations, takes_us / 1e6)
        if share is not None:
            self._memory.tear(operation, share)
            return False
        if self.failures_left and facts.abi >= ABI_WITH_ERRORS:
            self.failures_left -= 1
            call = FlashCall.ERASE if data is None else FlashCall.WRITE
            self.fail(FlashFault(call, 0, FlashEffect.ERROR))
        return super().execute(operation, now)


class SubjectDevice(CompiledDevice):
    """Bootloader under test with its hardware. Raises SubjectFailedError where it does wrong."""

    START_LIMIT_S: Final = 10.0
    """Time from a power-up to the start of a complete application."""

    def __init__(self, bench: SubjectBench, process: BootloaderProcess) -> None:
        super().__init__(bench.target, process, bitrate_bps=WELLING.bitrate_bps)
        self._bench = bench
        self.started: list[bytes | None] = []
        """What the bootloader would have started after each power-up and reset."""
        self.flash_faults: PlanFlash = PlanFlash(self)

    @property
    def state(self) -> str:
        return "application" if self._runs_application else "bootloader"

    @property
    def stored_image(self) -> bytes | None:
        """Application that is started after a power-up."""
        return self._bench.started(self.flash)

    def _expire(self, now: float) -> None:
        if self is not self._bench.probe and not self._is_starting_application:
            self.started.append(self.stored_image)
        super()._expire(now)

    def receive(self, frame: Frame, now: float) -> None:
        try:
            super().receive(frame, now)
        except FlasherError as error:
            raise _failure(error) from error

    def tick(self, now: float) -> None:
        try:
            super().tick(now)
        except FlasherError as error:
            raise _failure(error) from error


class SubjectBench:
    """Makes the devices of plans for the bootloader `what` (see `BootloaderProcess`), one at a
    time. Raises UsageError if it is unusable.
    """

    identity: Final = Identity(waived=frozenset((IdentityCheck.PLAUSIBLE,)))
    """The images that the simulated application runs have no whole vector table."""

    def __init__(self, what: str, target: str) -> None:
        self.target = TARGETS[target]
        self._process, self._probed = BootloaderProcess(what), BootloaderProcess(what)
        try:
            self.probe = SubjectDevice(self, self._probed)
        except BootloaderError as error:
            raise self._probed.unusable(f"does not start: {error.what}", error.cause) from error
        self.facts = self.probe.facts
        self.probe.power_cut(0.0)
        self.probe.quiet_until = lambda: inf
        self._now = 0.0
        """Time of the probe."""
        self._started: dict[bytes, bytes | None] = {}
        self._first = cache(self._with_application)

    def image_plan(self, version: str, size_bytes: int, seed: int) -> ImagePlan:
        """Plan the upgrade to an image that the simulated application runs."""
        content = random.Random(seed).randbytes(size_bytes)
        image = Image.from_bytes(application_image(version, size_bytes, content))
        return image_plan(replace(image, version=version), self.target, WELLING.bitrate_bps)

    def device(self, version: str | None) -> SubjectDevice:
        """Return a device without power, with an application of this version or without one.

        Raises SubjectFailedError if the bootloader does not take the application.
        """
        first = None if version is None else self._first(version)
        device = self._erased()
        if first is not None:
            device.flash.assign(first.flash)
        return device

    def started(self, flash: FlashMemory) -> bytes | None:
        """Return the application that the bootloader starts with this flash after a power-up; None
        if it starts none.
        """
        content = hashlib.sha256(flash.read(flash.start, flash.size_bytes)).digest()
        if content not in self._started:
            if len(self._started) >= _KEPT:
                self._started.clear()
            self._started[content] = self._start(flash)
        return self._started[content]

    def _start(self, flash: FlashMemory) -> bytes | None:
        probe = self.probe
        limit = self._now + probe.START_LIMIT_S
        probe.power_cut(self._now)  # the last start may have ended in an error
        probe.flash.assign(flash)
        probe.power_on(self._now)
        while probe.state == "bootloader" and self._now <= limit:
            probe.tick(self._now)
            while probe.next_frame(self._now) is not None:
                probe.frame_sent(self._now)
            due_at = probe.deadline()
            self._now = limit + 1 if due_at is None else max(self._now, due_at)
        area, is_started = probe.readback(), probe.state == "application"
        probe.power_cut(self._now)
        # `application_image` begins with its size.
        return area[: int.from_bytes(area[16:20], "little")] if is_started else None

    def drawn(self, seed: int) -> plans.Plan:
        """The plan of a seed for this bootloader."""
        erases, writes = 1, _FIRST_PACKETS
        with suppress(SubjectFailedError):  # each plan with an application finds it
            calls = self._first(plans.Subject.version).flash_faults.calls
            erases, writes = calls[FlashCall.ERASE], calls[FlashCall.WRITE]
        packets_max = self.facts.application_bytes // PACKET_DATA_SIZE
        return drawn_for_subject(
            seed, self.target.name, packets_max, erases, writes / _FIRST_PACKETS
        )

    def end_device(self) -> None:
        """Kill the process of the device."""
        self._process.kill()

    def close(self) -> None:
        self._process.close()
        self._probed.close()

    def _erased(self) -> SubjectDevice:
        try:
            device = SubjectDevice(self, self._process)
        except FlasherError as error:
            raise _failure(error) from error
        device.power_cut(0.0)
        return device

    def _with_application(self, version: str) -> SubjectDevice:
        """Return a device after an upgrade without faults."""
        device, clock = self._erased(), VirtualClock()
        bus = SimulatedBus(WELLING.bitrate_bps, clock)
        bus.attach(device)
        device.power_on(0.0)
        connection = api.Connection(bus.link(), clock, "the simulated bus")
        plan = self.image_plan(version, _FIRST_PACKETS * PACKET_DATA_SIZE - 5, seed=0)
        try:
            result = connection.device(self.target).upgrade(
                plan, options=UpgradeOptions(), identity=self.identity
            )
            ending = (
                ""
                if result.outcome.ok
                else f"{result.outcome.ending.value}: {result.outcome.where}"
            )
        except FlasherError as error:
            ending = f"{error.code}: {error.what}"
        finally:
            self.end_device()
        if ending:
            raise SubjectFailedError(
                f"its first upgrade, without faults, with -t {self.target.name}, ends in {ending}"
            )
        return device


def _failure(error: FlasherError) -> SubjectFailedError:
    """What the bootloader did wrong, to be raised past the host, which would take a FlasherError
    for one of its adapter.
    """
    return SubjectFailedError(LINE_JOINT.join(filter(None, (error.what, error.where, error.cause))))


def source_of(subject: str) -> bytes:
    """Return the program, library or source file of a bootloader under test."""
    if Path(subject).is_file():
        return Path(subject).read_bytes()
    name = subject.partition(":")[0]
    here = Path(*name.split("."))  # found first, as for `python -m`
    for path in (here.with_suffix(".py"), here / "__init__.py"):
        if path.is_file():
            return path.read_bytes()
    found = find_spec(name)
    if found is None or found.origin is None or not Path(found.origin).is_file():
        return b""
    return Path(found.origin).read_bytes()


@cache
def bench(subject: str, target: str) -> SubjectBench:
    """The bench of this process for a bootloader. Raises UsageError if it is unusable."""
    return SubjectBench(subject, target)
