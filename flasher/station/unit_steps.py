"""What each step of a unit's run does: identify, check, flash, write, restart, verify.

An act gets a list for its measurements, returns a few words for the record, and raises
StepFailedError with the code of what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from flasher import events
from flasher.errors import NoAnswerError, VerificationError
from flasher.host.identity import Finding, judge_device
from flasher.host.options import firmware_version
from flasher.host.outcome import DeviceLeft
from flasher.host.session import Result
from flasher.host.verify import Level, Verdict
from flasher.host.write import WritePlan
from flasher.station import codes
from flasher.station.messages import (
    Journal,
    PowerControl,
    Prompt,
    RunOrder,
    StepFailedError,
    Tell,
    flash_value,
    write_key,
)
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import Measurement, RunKind, StepName, Verified
from flasher.station.unit_checks import (
    SERIAL_ITEM,
    UnitReads,
    check_measured,
    check_texts,
    code_of,
    said_of,
    state_words,
    wanted_text,
)
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
        result = device.connection.device(profile=device.loaded.profile).upgrade(
            device.plan,
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


Act = Callable[[list[Measurement]], str]


class UnitSteps:
    """The acts of one run, and what they know of the unit so far."""

    def __init__(
        self,
        order: RunOrder,
        recipe: LoadedRecipe,
        devices: Sequence[UnitDevice],
        journal: Journal,
        power: PowerControl | None,
        progress: Callable[[float], None],
    ) -> None:
        self.devices = devices
        self.verified: dict[str, Verified] = {}
        """How far each target was verified in this run."""
        self._order = order
        self._recipe = recipe
        self._journal = journal
        self._power = power
        self._progress = progress
        self._scan = recipe.scan(order.serial, order.day, order.lot)
        self._identified: dict[str, Identified] = {}
        self.flashing = Flashing(order, recipe, journal, power, progress)
        self._plans = recipe.write_plans(self._scan)
        self._written: set[str] = set()
        self._reads = UnitReads(order, recipe, self._scan, devices)

    def acts(self) -> Sequence[tuple[StepName, str, Act | None]]:
        """Every step in order, with its target where it has one of its own; None: not needed."""
        only_verify = self._order.kind is RunKind.VERIFY_ONLY
        flash: list[tuple[StepName, str, Act | None]] = [
            (StepName.FLASH, device.name, None if only_verify else self._flash_act(device))
            for device in self.devices
        ]
        has_writes = bool(self._plans) and not only_verify
        return [
            (StepName.CONNECT, "", self._connect),
            (StepName.IDENTIFY, "", self._identify),
            (StepName.CHECK, "", self._check),
            *flash,
            (StepName.WRITE, "", self._write if has_writes else None),
            (StepName.RESTART, "", self._restart if self._can_restart(only_verify) else None),
            (StepName.VERIFY, "", self._verify),
        ]

    # -- before anything is written ---------------------------------------------------------------

    def _connect(self, measured: list[Measurement]) -> str:
        connection = self.devices[0].connection
        connection.link.drain()
        error = connection.link.health().error(connection.name)
        if error is not None:
            raise error
        return connection.name

    def _identify(self, measured: list[Measurement]) -> str:
        said = []
        for device in self.devices:
            found = device.identify()
            if is_silent(device, found) and self._power is not None:
                device.restart(self._power)
                found = device.identify()
            self._identified[device.name] = found
            if found.answers > 1:
                raise StepFailedError(
                    codes.TWO_DEVICES, f"{found.answers} devices answer as {device.name}."
                )
            if is_silent(device, found) and self._order.kind is not RunKind.RECHECK:
                raise StepFailedError(
                    codes.NO_ANSWER, f"The {device.name} neither answers nor announces itself."
                )
            measured += said_of(device.name, found)
            said.append(f"{device.name}: {state_words(device, found)}")
        self._check_label()
        measured += self._reads.limits(StepName.IDENTIFY)
        check_measured(measured)
        return "; ".join(said)

    def _check_label(self) -> None:
        """The device's own serial number against the label. A new unit has none yet, or what its
        maker put there; one of this recipe's numbers is that unit's own.
        """
        for found in self._identified.values():
            own = found.serial_number
            if own in ("", self._order.serial):
                continue
            try:
                self._recipe.recipe.serial_number.read(own)
            except ValueError:
                if any(plan.writable.name == SERIAL_ITEM for plan in self._plans):
                    continue  # it gets its number in this run
            raise StepFailedError(
                codes.WRONG_UNIT,
                f"The unit says that it is {own!a:.40}, the label says {self._order.serial!a:.40}.",
            )

    def _check(self, measured: list[Measurement]) -> str:
        findings = []
        for device in self.devices:
            found = self._identified[device.name]
            findings += self._judge(device, found, measured)
        if not all(self._can_be_verified(device) for device in self.devices):
            raise StepFailedError(codes.CANNOT_VERIFY, "A target has no query for its version.")
        in_application = {
            name for name, found in self._identified.items() if found.seen.version is not None
        }
        measured += self._reads.limits(StepName.CHECK, in_application)
        measured += self._reads.before(in_application)
        check_measured(measured)
        return "; ".join(finding.text for finding in findings)

    def _can_be_verified(self, device: UnitDevice) -> bool:
        """False in a run that only verifies, for a target that cannot be asked."""
        only_verify = self._order.kind is RunKind.VERIFY_ONLY
        return not only_verify or device.version_request is not None

    def _judge(
        self, device: UnitDevice, found: Identified, measured: list[Measurement]
    ) -> list[Finding]:
        """The manifest's rules and the recipe's. Raises StepFailedError."""
        firmware = device.loaded.firmware
        findings = list(
            judge_device(device.image, device.loaded.target, device.identity, found.seen)
        )
        for finding in findings:
            measured.append(
                Measurement(f"{device.name} {finding.check.value}", text=finding.verdict.value)
            )
            if finding.ending is not None and self._order.kind is not RunKind.VERIFY_ONLY:
                raise StepFailedError(code_of(finding.check), finding.text)
        check_texts(firmware.hardware_versions, found.seen.hardware_version, codes.WRONG_HARDWARE)
        running = found.seen.firmware_version
        # Who failed after its flash runs the new version already.
        is_new = running == device.loaded.version
        if self._order.kind is RunKind.PRODUCTION and not is_new:
            check_texts(firmware.previous_versions, running, codes.OLD_VERSION)
        return findings

    def _flash_act(self, device: UnitDevice) -> Act:
        def flash(measured: list[Measurement]) -> str:
            return self.flashing.flash(device, self._identified[device.name], measured)

        return flash

    # -- writing ----------------------------------------------------------------------------------

    def _write(self, measured: list[Measurement]) -> str:
        by_name = {device.name: device for device in self.devices}
        for name in dict.fromkeys(plan.target.name for plan in self._plans):
            answer = by_name[name].await_application()
            if answer is None:
                raise StepFailedError(codes.NOT_RUNNING, f"The {name} does not answer.")
            own = self._identified[name]
            # Who sat in its bootloader could not say its serial number before.
            seen = replace(own.seen, version=answer)
            self._identified[name] = replace(own, seen=seen)
        self._check_label()
        for number, plan in enumerate(self._plans, 1):
            key = write_key(plan.target.name, plan.writable.name)
            if key not in self._written:
                self._write_one(by_name[plan.target.name], plan)
                self._written.add(key)
            self._progress(number / len(self._plans))
        return f"{len(self._plans)} written"

    def _write_one(self, device: UnitDevice, plan: WritePlan) -> None:
        writing = device.connection.device(
            profile=device.loaded.profile, taps=device.taps, cancelled=device.cancelled
        )
        device.check_cancelled()
        old = writing.content_before(plan)
        write = self._journal.intent(plan.target.name, plan.writable.name, wanted_text(plan))
        written = writing.carry_out(plan, old)
        error = written.error()
        if isinstance(error, VerificationError):
            code = codes.WRITE_DIFFERS if written.differences else codes.WRITE_FAILED
            raise StepFailedError(code, error.what)
        read = [change.read_back for change in written.changes if change.read_back is not None]
        self._journal.verified(write, ", ".join(read) if read else None)

    # -- restarting and verifying -----------------------------------------------------------------

    def _can_restart(self, only_verify: bool) -> bool:  # noqa: FBT001  a guard
        return not only_verify and any(map(self._restarts, self.devices))

    def _restarts(self, device: UnitDevice) -> bool:
        """It can be told to restart, and asked afterwards."""
        can_reset = self._power is not None or device.loaded.target.has_version_query
        return can_reset and device.version_request is not None

    def _restart(self, measured: list[Measurement]) -> str:
        restarting = list(filter(self._restarts, self.devices))
        for device in restarting[:1] if self._power is not None else restarting:
            try:
                if not device.restart(self._power):
                    raise StepFailedError(
                        codes.NO_RESTART, f"The {device.name} did not announce its bootloader."
                    )
            except NoAnswerError as error:
                raise StepFailedError(codes.NO_RESTART, error.what) from error
        for device in restarting:
            if device.await_application() is None:
                raise StepFailedError(codes.NOT_RUNNING, f"The {device.name} does not answer.")
        return "by power" if self._power is not None else "by reset"

    def _verify(self, measured: list[Measurement]) -> str:
        said = []
        for device in self.devices:
            level = self._verify_image(device, measured)
            self.verified[device.name] = level
            if level < device.loaded.required:
                raise StepFailedError(codes.CANNOT_VERIFY, f"{device.name}: {level.words}.")
            said.append(f"{device.name}: {level.words}")
        self._check_label()
        self._reads.written(self._plans, measured)
        self._reads.unchanged(measured)
        measured += self._reads.limits(StepName.VERIFY)
        check_measured(measured)
        return "; ".join(said)

    def _verify_image(self, device: UnitDevice, measured: list[Measurement]) -> Verified:
        """How far the image is proven now. Raises StepFailedError where something is against it."""
        loaded = device.loaded
        if device.version_request is None:
            return self._completed(device)
        answer = device.await_application()
        if answer is None:
            raise StepFailedError(codes.NOT_RUNNING, f"The {device.name} does not answer.")
        own = self._identified[device.name]
        self._identified[device.name] = replace(own, seen=replace(own.seen, version=answer))
        # What a bootloader alone could not tell before.
        hardware = self._identified[device.name].seen.hardware_version
        check_texts(loaded.release.hardware_versions, hardware, codes.WRONG_HARDWARE)
        check_texts(loaded.firmware.hardware_versions, hardware, codes.WRONG_HARDWARE)
        running = firmware_version(answer)
        if not loaded.version and loaded.required is not Verified.MEMORY:
            return self._completed(device)  # an answer that is compared with nothing proves nothing
        measured.append(
            Measurement(f"{device.name} version", text=running, expected=loaded.version or None)
        )
        if loaded.version and running != loaded.version:
            raise StepFailedError(
                codes.OTHER_VERSION, f"{device.name} runs {running} instead of {loaded.version}."
            )
        if loaded.required is not Verified.MEMORY:
            return Verified.VERSION
        found = device.check_memory(running, self._hear_memory)
        if not found.ok:
            code = OF_VERDICT.get(found.verdict, codes.MEMORY_DIFFERS)
            raise StepFailedError(
                code, f"{device.name}: {found.verdict.value} {found.detail}".strip()
            )
        return Verified.MEMORY

    def _completed(self, device: UnitDevice) -> Verified:
        """Nothing is read back: only the word of the bootloader, in this very run, counts."""
        if device.name not in self.flashing.flashed:
            raise StepFailedError(codes.CANNOT_VERIFY, f"The {device.name} cannot be asked.")
        if not self._recipe.recipe.allow_completed_not_read_back:
            raise StepFailedError(codes.CANNOT_VERIFY, "The recipe wants it read back.")
        return Verified.COMPLETED

    def _hear_memory(self, event: object) -> None:
        if isinstance(event, events.MemoryRead):
            self._progress(event.read_bytes / event.total_bytes)
