"""Flashing one target: noted before, rescued by a power cycle where it fell silent, noted after."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from flasher import api, events
from flasher.host.outcome import DeviceLeft
from flasher.host.session import Result
from flasher.host.verify import Level, Verdict
from flasher.station import codes
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import Measurement, RunKind
from flasher.station.run_model import (
    Journal,
    PowerControl,
    Prompt,
    RunOrder,
    StepFailedError,
    Tell,
    flash_value,
)
from flasher.station.steps import StepName
from flasher.station.unit_device import Identified, UnitDevice, is_silent

OF_VERDICT: Final = {
    Verdict.VERSION_OTHER: codes.OTHER_VERSION,
    Verdict.NO_ANSWER: codes.NOT_RUNNING,
    Verdict.MEMORY_OTHER: codes.MEMORY_DIFFERS,
    Verdict.SECOND_TOOL: codes.SECOND_TOOL,
    Verdict.INTERRUPTED: codes.OPERATOR_ABORT,
}
"""What a bad verification is in the records."""


class Flashing:
    """The flashes of one run."""

    def __init__(
        self,
        order: RunOrder,
        recipe: LoadedRecipe,
        journal: Journal,
        power: PowerControl | None,
        progress: Callable[[float], None],
    ) -> None:
        self.flashed: set[str] = set()
        """Targets that confirmed the complete image in this run."""
        self.left_behind = ""
        """The state that the device would be left in now, where that matters."""
        self.tell: Tell = lambda _note: None
        self._order = order
        self._recipe = recipe
        self._journal = journal
        self._power = power
        self._progress = progress

    def flash(self, device: UnitDevice, found: Identified, measured: list[Measurement]) -> str:
        """Flash it, unless that is proven to be done. Raises StepFailedError."""
        if self._is_done(device, found):
            return "flashed before the interruption, and the device names the version"
        value = flash_value(device.loaded.version, device.image.sha256)
        write = self._journal.intent(device.name, "flash", value)
        self._progress(0.0)
        try:
            result = self._upgrade(device, at_power_up=is_silent(device, found))
        except StepFailedError as failed:
            if failed.code not in codes.NEED_POWER_CYCLE or not self._may_rescue(failed):
                raise
            result = self._upgrade(device, at_power_up=True)
        statistics = result.outcome.statistics
        measured.append(Measurement(f"{device.name} repetitions", float(statistics.repetitions)))
        measured.append(Measurement(f"{device.name} transfer", statistics.transfer_s or 0.0, "s"))
        read_back = result.running_version
        self._journal.verified(write, read_back)
        self.flashed.add(device.name)
        return f"{result.outcome.ending.value}; boot version {result.outcome.boot_version}"

    def _is_done(self, device: UnitDevice, found: Identified) -> bool:
        """An interrupted run had flashed it, and the device says the same: both have to agree."""
        if self._order.kind is not RunKind.RECHECK or device.version_request is None:
            return False
        running = found.seen.firmware_version
        return device.name in self._order.flashed_before and running == device.loaded.version

    def _may_rescue(self, failed: StepFailedError) -> bool:
        return self._power is not None or failed.needs_rescue

    def _upgrade(self, device: UnitDevice, *, at_power_up: bool) -> Result:
        """One upgrade to a good end. Raises StepFailedError."""
        limit_s = self._recipe.recipe.rule(StepName.FLASH).time_limit_s
        options = device.options(timeout_s=limit_s)
        options = replace(options, at_power_up=at_power_up)
        asks = device.version_request is not None
        result = api.upgrade(
            device.plan,
            device.connection,
            options=options,
            verify=Level.VERSION if asks else Level.NONE,
            identity=device.identity,
            taps=device.taps,
            on_event=lambda event: self._hear(event, device),
            cancelled=device.cancelled,
        )
        left = result.outcome.device_left
        self.left_behind = f"State of the device: {left.value}." if left.needs_rescue else ""
        if result.ok:
            return result
        verdict = OF_VERDICT.get(result.verification.verdict)
        code = codes.OF_ENDING.get(result.outcome.ending) if verdict is None else verdict
        device.check_cancelled()
        error = result.error()
        words = "" if error is None else error.what
        raise StepFailedError(
            code or codes.TRANSFER_FAILED,
            f"{words} {self.left_behind}".strip(),
            needs_rescue=left in (DeviceLeft.NO_APPLICATION, DeviceLeft.PERHAPS_ERASED),
        )

    def _hear(self, event: object, device: UnitDevice) -> None:
        match event:
            case events.PacketAcknowledged(number, total):
                self._progress(number / total)
            case events.PowerCycleAwaited(limit_s):
                if self._power is not None:
                    self._power.begin_cycle()
                else:
                    text = f"Switch the {device.name.upper()} off, wait 3 s, and on again."
                    self.tell(Prompt(text, limit_s))
