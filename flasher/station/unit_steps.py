"""Steps of a unit's run: identify, check, flash, write, restart, verify.

A step adds measurements to a list, returns a short text for the record, and raises StepFailedError
with a code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Final

from flasher import events
from flasher.errors import BusError, InterruptedByUserError, NoAnswerError, VerificationError
from flasher.host.identity import CheckResult, IdentityCheck, judge_device
from flasher.host.options import firmware_version
from flasher.host.outcome import DeviceLeft
from flasher.host.session import Result
from flasher.host.verify import Verdict, memory_check
from flasher.host.write import WritePlan
from flasher.i18n import text
from flasher.protocol.fields import Content
from flasher.station.codes import NEED_POWER_CYCLE, OF_ENDING, Code
from flasher.station.messages import Journal, flash_value, write_key
from flasher.station.power import PowerControl
from flasher.station.presence import PROBE_S
from flasher.station.recipe import AfterRestart
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import (
    AFTER_RESTART,
    BY_POWER,
    FLASH,
    POWER_CYCLES,
    SERIAL_NUMBER,
    Claim,
    Measurement,
    RunKind,
    Signature,
    StepName,
    Verified,
)
from flasher.station.unit_checks import (
    OF_CHECK,
    UnitReads,
    check_measured,
    check_texts,
    identity_measurements,
    signature_measurements,
    state_text,
    wanted_text,
)
from flasher.station.unit_target import Identified, StepFailedError, UnitTarget
from flasher.wording import wording

_OF_VERDICT: Final = {
    Verdict.VERSION_OTHER: Code.OTHER_VERSION,
    Verdict.NO_ANSWER: Code.NOT_RUNNING,
    Verdict.IN_BOOTLOADER: Code.IN_BOOTLOADER,
    Verdict.MEMORY_OTHER: Code.MEMORY_DIFFERS,
    Verdict.OTHER_UNIT: Code.UNIT_CHANGED,
    Verdict.SECOND_TOOL: Code.SECOND_TOOL,
    Verdict.INTERRUPTED: Code.OPERATOR_ABORT,
}
"""Codes of failed verifications."""
_SPACINGS_OF_WATCH: Final = 3
Act = Callable[[list[Measurement]], str]


class UnitSteps:
    """The steps of one run, with their results so far."""

    def __init__(
        self,
        claim: Claim,
        recipe: LoadedRecipe,
        targets: Sequence[UnitTarget],
        journal: Journal,
        power: PowerControl | None,
        progress: Callable[[float], None],
        prompt: Callable[[str, float | None], None],
    ) -> None:
        self.targets = targets
        self.verified: dict[str, Verified] = {}
        """Verification level that each target reached in this run."""
        self.device_state = ""
        """State of a device that needs a rescue, as a sentence; or ""."""
        self._claim = claim
        self._is_verify_only = claim.kind is RunKind.VERIFY_ONLY
        self._recipe = recipe
        self._journal = journal
        self._power = power
        self._progress = progress
        self._prompt = prompt
        self._identified: dict[str, Identified] = {}
        self._flashed: set[str] = set()
        """Targets that confirmed the complete image in this run."""
        scan = recipe.scan(claim.serial, claim.day, claim.lot)
        self._plans = [recipe.write_plan(write, scan) for write in recipe.recipe.write]
        self._written: set[str] = set()
        self._reads = UnitReads(claim, recipe, scan, targets)

    def acts(self) -> Sequence[tuple[StepName, str, Act | None]]:
        """All steps in order, with their targets ("": all) and functions (None: not needed)."""
        may_write = not self._is_verify_only
        flashes: list[tuple[StepName, str, Act | None]] = [
            (StepName.FLASH, target.name, partial(self._flash, target) if may_write else None)
            for target in self.targets
        ]
        can_restart = may_write and any(map(self._restarts, self.targets))
        return [
            (StepName.CONNECT, "", self._connect),
            (StepName.IDENTIFY, "", self._identify),
            (StepName.CHECK, "", self._check),
            *flashes,
            (StepName.WRITE, "", self._write if self._plans and may_write else None),
            (StepName.RESTART, "", self._restart if can_restart else None),
            (StepName.VERIFY, "", self._verify),
        ]

    @property
    def has_lost_its_session(self) -> bool:
        """True if a device got an update command and has run no application since: it cannot
        identify itself, so no step may be tried again.
        """
        return any(
            each.continuity.has_update_command and not each.may_restart for each in self.targets
        )

    def wait(self, limit_s: float) -> None:
        """Wait between two tries, and request the versions of running applications. Raises
        StepFailedError if one stops answering.
        """
        clock = self.targets[0].clock
        ends_at = clock.now() + limit_s
        while (left_s := ends_at - clock.now()) > 0:
            for target in self.targets:
                target.confirm()
            self.targets[0].listen(min(left_s, PROBE_S))

    # -- before the first write -------------------------------------------------------------------

    def _connect(self, measured: list[Measurement]) -> str:
        connection = self.targets[0].device.connection
        self.targets[0].process_queued_frames()  # queued frames date from before the run
        error = connection.link.health().error(connection.name)
        if error is not None:
            raise error
        return connection.name

    def _identify(self, measured: list[Measurement]) -> str:
        states = []
        for target in self.targets:
            identified = target.identify()
            if target.is_silent(identified) and self._power is not None:
                target.restart(self._power)
                identified = target.identify()
            self._identified[target.name] = identified
            if identified.two_devices:
                raise StepFailedError(
                    Code.TWO_DEVICES,
                    f"Two devices answer as {target.name}: {identified.two_devices}.",
                )
            is_known = target.continuity.has_answered and not target.may_restart
            if is_known and identified.seen.version is None:
                raise StepFailedError(Code.UNIT_CHANGED, f"The {target.name} stopped answering.")
            may_await_power = self._power is not None or target.may_restart
            is_rescue = self._claim.kind is RunKind.RECHECK and may_await_power
            if target.is_silent(identified) and not is_rescue:
                raise StepFailedError(
                    Code.NO_ANSWER, f"The {target.name} neither answers nor announces itself."
                )
            must_answer = target.version_request is not None and not self._claim.has_card
            if must_answer and identified.seen.version is None:
                raise StepFailedError(Code.NO_CARD, f"The {target.name} does not answer.")
            target.continuity.begin(identified.seen.version)
            target.check_cancelled()
            measured += identity_measurements(target, identified)
            states.append(f"{target.name}: {state_text(target, identified)}")
        if self.targets[0].may_restart:
            measured.append(Measurement(AFTER_RESTART, text=AfterRestart.CONTINUE.value))
        self._check_label()
        measured += self._reads.limits(StepName.IDENTIFY)
        check_measured(measured)
        return "; ".join(states)

    def _check_label(self) -> None:
        """Compare reported serial numbers with the label. A new unit has none, or one of its maker;
        only a serial number of this recipe identifies it. Raises StepFailedError.
        """
        for identified in self._identified.values():
            own = identified.serial_number
            if own in ("", self._claim.serial):
                continue
            try:
                self._recipe.recipe.serial_number.read(own)
            except ValueError:
                if any(plan.writable.name == SERIAL_NUMBER for plan in self._plans):
                    continue  # it gets its number in this run
            raise StepFailedError(
                Code.WRONG_UNIT,
                f"The unit reports {own!a:.40}, the label has {self._claim.serial!a:.40}.",
            )

    def _check(self, measured: list[Measurement]) -> str:
        findings: list[CheckResult] = []
        for target in self.targets:
            findings += self._judge(target, measured)
        if self._is_verify_only and any(each.version_request is None for each in self.targets):
            raise StepFailedError(Code.CANNOT_VERIFY, "A target has no query for its version.")
        in_application = {
            name for name, each in self._identified.items() if each.seen.version is not None
        }
        measured += self._reads.limits(StepName.CHECK, in_application)
        measured += self._reads.before(in_application)
        check_measured(measured)
        return "; ".join(finding.text for finding in findings)

    def _judge(self, target: UnitTarget, measured: list[Measurement]) -> list[CheckResult]:
        """Check the rules of manifest and recipe. Raises StepFailedError."""
        loaded, seen = target.loaded, self._identified[target.name].seen
        image, identity = target.job.plan.image, target.job.identity
        measured += signature_measurements(target.name, self._claim)
        findings = list(judge_device(image, loaded.target, identity, seen))
        signature = self._claim.signatures.get(target.name, Signature(""))
        highest = self._claim.counters_before.get(target.name, 0)
        if signature.counter is not None and signature.counter < highest:
            sentence = text(
                "the counter of the release is {counter}; the records have {highest} for this"
                " serial number",
                counter=signature.counter,
                highest=highest,
            )
            findings.append(identity.refusal(IdentityCheck.UNSIGNED, sentence))
        for finding in findings:
            name = f"{target.name} {finding.check.value}"
            measured.append(Measurement(name, text=finding.verdict.value))
            if finding.ending is not None and not self._is_verify_only:
                code = OF_CHECK.get(finding.check, Code.NOT_FOR_DEVICE)
                raise StepFailedError(code, finding.text)
        firmware = loaded.firmware
        check_texts(firmware.hardware_versions, seen.hardware_version, Code.WRONG_HARDWARE)
        # A unit that failed after its flash already runs the new version.
        is_new = seen.firmware_version == loaded.version
        if self._claim.kind is RunKind.PRODUCTION and not is_new:
            check_texts(firmware.previous_versions, seen.firmware_version, Code.OLD_VERSION)
        return findings

    # -- flashing ---------------------------------------------------------------------------------

    def _flash(self, target: UnitTarget, measured: list[Measurement]) -> str:
        """Flash a target, unless an interrupted run has, and record it before and after. Tries a
        power cycle if the device stops answering.
        """
        name, identified = target.name, self._identified[target.name]
        if (
            # The records of the interrupted run must agree with the device.
            self._claim.kind is RunKind.RECHECK
            and target.version_request is not None
            and name in self._claim.flashed_before
            and identified.seen.firmware_version == target.loaded.version
        ):
            return "flashed before the interruption, and the device names the version"
        self._check_flashed()
        value = flash_value(target.loaded.version, target.job.plan.image.sha256)
        write = self._journal.intent(name, FLASH, value)
        self._progress(0.0)
        target.confirm()
        try:
            result = self._upgrade(target, at_power_up=target.is_silent(identified))
        except StepFailedError as failed:
            may_rescue = self._power is not None or failed.needs_rescue
            if failed.code not in NEED_POWER_CYCLE:
                raise
            if self.has_lost_its_session:
                with suppress(BusError, InterruptedByUserError):
                    target.identify_after_failure()
                raise
            if not may_rescue:
                raise
            target.confirm()
            result = self._upgrade(target, at_power_up=True)
        if target.version_request is None:
            target.continuity.complete()
        else:
            target.continuity.settle()
        statistics = result.outcome.statistics
        measured.append(Measurement(f"{name} repetitions", float(statistics.repetitions)))
        measured.append(Measurement(f"{name} transfer", statistics.transfer_s or 0.0, "s"))
        self._journal.verified(write, result.running_version)
        self._flashed.add(name)
        away_s = result.outcome.unobserved_s
        away = f"; unobserved for {away_s:.1f} s" if away_s else ""
        return f"{wording(result.outcome.ending)}; boot version {result.outcome.boot_version}{away}"

    def _check_flashed(self) -> None:
        """Compare the serial numbers of flashed targets before the next one is flashed: one that
        was in its bootloader could not report it before. Raises StepFailedError.
        """
        for target in self.targets:
            if target.name in self._flashed and target.version_request is not None:
                self._await(target)
        self._check_label()

    def _upgrade(self, target: UnitTarget, *, at_power_up: bool) -> Result:
        """Run one upgrade. Raises StepFailedError."""
        limit_s = self._recipe.recipe.rule(StepName.FLASH).time_limit_s
        lost_at, completions_when_lost = 0.0, -1

        def on_event(event: object) -> None:
            nonlocal lost_at, completions_when_lost
            match event:
                case events.AdapterLost():
                    lost_at = target.clock.now()
                    completions_when_lost = target.watcher.completions
                case events.AdapterBack():
                    for each in self.targets:
                        each.continuity.was_away(target.clock.now() - lost_at)
                case events.PacketAcknowledged(number, total):
                    self._progress(number / total)
                case events.PowerCycleAwaited(wait_s) if not target.continuity.is_announcing:
                    self._cycle_power(target, wait_s)

        is_in_bootloader = self._identified[target.name].is_in_bootloader
        options = replace(target.job.options, at_power_up=at_power_up)
        if limit_s is not None:
            options = replace(options, timeout_s=limit_s)
        if is_in_bootloader and target.continuity.is_announcing:
            # The bootloader announces itself. It would ignore a reset (R18), and an announcement
            # of another unit would be taken for its own.
            wait_s = options.timings.boot_version_timeout_s
            options = replace(options, at_power_up=True, power_up_timeout_s=wait_s)
        if is_in_bootloader:
            # Watch it before the erase: a bootloader that ignores a reset keeps announcing itself.
            timings = options.timings
            watch_s = _SPACINGS_OF_WATCH * timings.boot_version_spacing_s
            watched = replace(timings, boot_watch_s=max(timings.boot_watch_s, watch_s))
            options = replace(options, timings=watched)
        job = replace(target.job, options=options)
        result = target.device.run_job(job, on_event=on_event)
        left = result.outcome.device_left
        self.device_state = f"State of the device: {wording(left)}." if left.needs_rescue else ""
        target.check_cancelled()
        if result.ok:
            if target.watcher.completions == completions_when_lost and not target.may_restart:
                raise self._of_lost_adapter(target, result)
            return result
        code = _OF_VERDICT.get(result.verification.verdict)
        error = result.error()
        words = "" if error is None else error.what
        raise StepFailedError(
            code or OF_ENDING.get(result.outcome.ending, Code.TRANSFER_FAILED),
            f"{words} {self.device_state}".strip(),
            needs_rescue=left in (DeviceLeft.NO_APPLICATION, DeviceLeft.PERHAPS_ERASED),
        )

    def _cycle_power(self, target: UnitTarget, wait_s: float) -> None:
        if self._power is not None:
            self._power.begin_cycle()
            return
        name = target.name.upper()
        sentence = text("Switch the {target} off, wait 3 s, and switch it on again.", target=name)
        self._prompt(sentence, wait_s)

    @staticmethod
    def _of_lost_adapter(target: UnitTarget, result: Result) -> StepFailedError:
        """The error for a device that confirmed no image after the adapter was lost."""
        if result.outcome.is_completed:
            return StepFailedError(
                Code.NOT_OBSERVED,
                f"The adapter was away before the {target.name} started its new application:"
                " another unit could have been connected.",
            )
        return StepFailedError(
            Code.UNIT_CHANGED,
            f"The adapter was away, and the {target.name} did not continue its transfer.",
        )

    # -- writes -----------------------------------------------------------------------------------

    def _write(self, measured: list[Measurement]) -> str:
        by_name = {target.name: target for target in self.targets}
        for name in dict.fromkeys(plan.target.name for plan in self._plans):
            # A device that was in its bootloader could not report its serial number before.
            self._await(by_name[name])
        self._check_label()
        for number, plan in enumerate(self._plans, 1):
            key = write_key(plan.target.name, plan.writable.name)
            if key not in self._written:
                self._write_one(by_name[plan.target.name], plan)
                self._written.add(key)
            self._progress(number / len(self._plans))
        return f"{len(self._plans)} written"

    def _await(self, target: UnitTarget) -> Content:
        """Wait for a version answer of the application. Raises StepFailedError."""
        was_running = target.continuity.is_running and not target.may_restart
        answer = target.await_application()
        if answer is None and was_running:
            raise StepFailedError(Code.UNIT_CHANGED, f"The {target.name} stopped answering.")
        if answer is None and target.continuity.is_announcing:
            raise StepFailedError(Code.IN_BOOTLOADER, f"The {target.name} stays in its bootloader.")
        if answer is None:
            raise StepFailedError(Code.NOT_RUNNING, f"The {target.name} does not answer.")
        own = self._identified[target.name]
        self._identified[target.name] = replace(own, seen=replace(own.seen, version=answer))
        return answer

    def _write_one(self, target: UnitTarget, plan: WritePlan) -> None:
        target.check_cancelled()
        old = target.device.read_before_write(plan)
        write = self._journal.intent(target.name, plan.writable.name, wanted_text(plan))
        target.confirm()
        target.continuity.allow(plan.content)
        written = target.device.write_planned(plan, old)
        error = written.error()
        if isinstance(error, VerificationError):
            code = Code.WRITE_DIFFERS if written.differences else Code.WRITE_FAILED
            raise StepFailedError(code, error.what)
        target.continuity.wrote(plan.content)
        read = [change.read_back for change in written.changes if change.read_back is not None]
        self._journal.verified(write, ", ".join(read) if read else None)

    # -- restart and verification -----------------------------------------------------------------

    def _restarts(self, target: UnitTarget) -> bool:
        """True for a target that can be restarted and then asked for its version."""
        can_reset = self._power is not None or target.loaded.target.has_version_query
        return can_reset and target.version_request is not None

    def _restart(self, measured: list[Measurement]) -> str:
        restarting = list(filter(self._restarts, self.targets))
        for target in self.targets:
            target.confirm()
        for target in restarting[:1] if self._power is not None else restarting:
            try:
                if not target.restart(self._power):
                    raise StepFailedError(
                        Code.NO_RESTART, f"The {target.name} did not announce its bootloader."
                    )
            except NoAnswerError as error:
                raise StepFailedError(Code.NO_RESTART, error.what) from error
        for target in restarting:
            self._await(target)
        return BY_POWER if self._power is not None else "by reset"

    def _verify(self, measured: list[Measurement]) -> str:
        levels = []
        for target in self.targets:
            level = self._verify_image(target, measured)
            self.verified[target.name] = level
            if level < target.loaded.required:
                raise StepFailedError(Code.CANNOT_VERIFY, f"{target.name}: {level.words}.")
            levels.append(f"{target.name}: {level.words}")
        self._check_label()
        self._reads.written(self._plans, measured)
        self._reads.unchanged(measured)
        measured += self._reads.limits(StepName.VERIFY)
        for target in self.targets:
            target.confirm()
        measured += self._continuity()
        check_measured(measured)
        return "; ".join(levels)

    def _continuity(self) -> Iterator[Measurement]:
        """Measurements that record whether each target was observed without a gap."""
        for target in self.targets:
            is_watched = target.continuity.is_running and not target.may_restart
            words = "observed" if is_watched else "not observed"
            yield Measurement(f"{target.name} continuity", text=words)
        cycles = self.targets[0].continuity.power_cycles
        if cycles:
            yield Measurement(POWER_CYCLES, float(cycles))

    def _verify_image(self, target: UnitTarget, measured: list[Measurement]) -> Verified:
        """Verify the image of a target; returns the level reached. Raises StepFailedError."""
        loaded, name = target.loaded, target.name
        needs_memory = loaded.required is Verified.MEMORY
        if target.version_request is None:
            return self._completed(target)
        running = firmware_version(self._await(target))
        # A device that was in its bootloader could not report its hardware before.
        hardware = self._identified[name].seen.hardware_version
        check_texts(loaded.release.hardware_versions, hardware, Code.WRONG_HARDWARE)
        check_texts(loaded.firmware.hardware_versions, hardware, Code.WRONG_HARDWARE)
        if not loaded.version and not needs_memory:
            return self._completed(target)  # there is no version to compare the answer with
        version = Measurement(f"{name} version", text=running, expected=loaded.version or None)
        measured.append(version)
        if not version.is_within:
            raise StepFailedError(
                Code.OTHER_VERSION, f"{name} runs {running} instead of {loaded.version}."
            )
        if not needs_memory:
            return Verified.VERSION

        def on_event(event: object) -> None:
            if isinstance(event, events.MemoryRead):
                self._progress(event.read_bytes / event.total_bytes)

        check = memory_check(target.job.plan, target.job.options, running)
        target.run(check, on_event)
        result = check.result
        if not result.ok:
            code = _OF_VERDICT.get(result.verdict, Code.MEMORY_DIFFERS)
            raise StepFailedError(
                code, f"{name}: {wording(result.verdict)} {result.detail}".strip()
            )
        return Verified.MEMORY

    def _completed(self, target: UnitTarget) -> Verified:
        """Level of a target that cannot be read back: its bootloader must have confirmed the image
        in this run. Raises StepFailedError.
        """
        if target.name not in self._flashed:
            raise StepFailedError(Code.CANNOT_VERIFY, f"The {target.name} has no version query.")
        if not self._recipe.recipe.allow_completed_not_read_back:
            raise StepFailedError(Code.CANNOT_VERIFY, "The recipe requires it to be read back.")
        return Verified.COMPLETED
