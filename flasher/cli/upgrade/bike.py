"""`flasher flash --bike`: upgrade all devices of a bike, with one verdict."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final, Literal

import click

from flasher import api, jobs
from flasher.bike import (
    ORDER_REASON,
    SetImage,
    check_same_battery,
    in_safe_order,
    judge_bike,
    look_at_bike,
    open_bike_set,
    silence_text,
)
from flasher.cli.adapters import check_heard, choose_adapter
from flasher.cli.framework import rebuild_command_line
from flasher.cli.options import Bus, ImageOptions
from flasher.cli.output import ClosingLine, Output
from flasher.cli.recording import Recording, RecordingOptions, recording
from flasher.cli.stop import Stop, stop_on_signal
from flasher.cli.upgrade import text
from flasher.cli.upgrade.choices import TRACE_OPTIONS, UpgradeChoices, repair_command
from flasher.cli.upgrade.progress import Progress
from flasher.cli.upgrade.text import (
    BikeDeviceDocument,
    BikeDocument,
    DeviceState,
    UpgradeDocument,
)
from flasher.cli.upgrade.upgrade_run import UpgradeRun
from flasher.errors import (
    ExitCode,
    FlasherError,
    InterruptedByUserError,
    UsageError,
)
from flasher.events import CheckMade
from flasher.host.identity import CheckVerdict
from flasher.host.options import serial_number
from flasher.host.outcome import AGAIN
from flasher.host.session import Result
from flasher.host.verify import Level, possible_levels
from flasher.protocol.spec import BMS, Target
from flasher.protocol.text import printable
from flasher.settings.profile import Profile, load_profile

_OF_ONE_IMAGE: Final = {
    "format": "--format",
    "base": "--base",
    "range_": "--range",
}


@dataclass
class _Device:
    """A device of the set, and what is known of its upgrade."""

    part: SetImage
    job: jobs.Job
    state: DeviceState = DeviceState.NOT_BEGUN
    was_in_bootloader: bool = False
    checks: list[CheckMade] = field(default_factory=list)
    upgrade: UpgradeDocument | None = None
    summary: str = ""
    """What it runs now; empty before its end."""
    is_sure: bool = False

    @property
    def name(self) -> str:
        return self.part.target.node.name

    def document(self) -> BikeDeviceDocument:
        return BikeDeviceDocument(
            self.part.target.name,
            self.state,
            self.was_in_bootloader,
            self.checks,
            self.upgrade,
        )


_WORDS: Final = {
    DeviceState.UPGRADED: "done",
    DeviceState.UP_TO_DATE: "up to date",
    DeviceState.FAILED: "failed",
    DeviceState.NOT_BEGUN: "not begun",
    DeviceState.LEFT_OUT: "left out",
}


@dataclass
class BikeUpgrade:
    """Upgrade of all devices of a set, and its output."""

    output: Output
    image: ImageOptions
    choices: UpgradeChoices
    bus: Bus
    recorded: RecordingOptions
    without: frozenset[Target]

    def __post_init__(self) -> None:
        self._devices: list[_Device] = []
        self._left_out: list[SetImage] = []
        self._battery = ""
        """Serial number of the battery before the first upgrade; empty if not known."""

    def _again(self) -> str:
        """Command that goes on with the set."""
        ctx = click.get_current_context()
        # A deadline that has passed once would pass again.
        without = TRACE_OPTIONS | {"--timeout"}
        words = rebuild_command_line(ctx, str(ctx.info_name), without=without.__contains__)
        return shlex.join(["flasher", *words])

    def run(self, target: Target | None) -> int:
        """Check the set, look at the bike, upgrade its devices; return the exit code."""
        output, choices = self.output, self.choices
        output.ending = self._failed
        self._check_options(target)
        parts = open_bike_set(
            Path(self.image.image),
            require_signed=choices.require_signed,
            allow_outside_vector=self.image.allow_outside_vector or choices.force,
        )
        self._left_out = [each for each in parts if each.target in self.without]
        chosen = [each for each in parts if each.target not in self.without]
        for absent in self.without - {each.target for each in parts}:
            output.error_line(
                f"warning: --without {absent.name} changes nothing: the set has no image for it"
            )
        if not chosen:
            raise UsageError(
                "--without leaves no device of the set.", remedy="Leave one --without out."
            )
        self.bus = self.bus.with_profile(choices.profile)
        if not choices.dry_run:
            self.bus = choose_adapter(self.bus, output)
        self._devices = [_Device(part, self._job(part)) for part in chosen]
        show = output.result if choices.dry_run else output.progress
        show(f"order: {', '.join(each.name for each in self._devices)}: {ORDER_REASON}")
        for device in self._devices:
            for line in text.job_lines(device.job):
                show(line)
            device.job.checked()
            device.checks = [each.event for each in device.job.checks]
            provenance = device.part.opened.provenance
            for warning in provenance.warnings if provenance else ():
                output.error_line(f"warning: {warning}")
        if choices.dry_run:
            for device in self._devices:
                for check in device.checks:
                    output.result(f"{device.name}: {text.check_line(check)}")
            output.result("dry run: nothing was sent")
            return output.document(self._document())
        return self._carry_out()

    def _check_options(self, target: Target | None) -> None:
        image, choices = self.image, self.choices
        choices.check_contradictions()
        given = [name for key, name in _OF_ONE_IMAGE.items() if getattr(image, key) is not None]
        given += ["--manifest"] * (choices.manifest is not None)
        given += ["-t"] * (target is not None)
        given += ["--in-session"] * choices.in_session
        if image.is_piped or given:
            what = "standard input has" if image.is_piped else f"{given[0]} is for"
            raise UsageError(
                f"--bike takes the images of a set, and {what} one image.",
                remedy="Name a release (*.wfw) or a TOML file of images, and leave the option out; "
                "--without leaves a device alone.",
            )

    def _job(self, part: SetImage) -> jobs.Job:
        profile = self._profile(part.target)
        profile.check_fits(part.opened.image)
        options = profile.upgrade_options()
        # Asked of all devices, a level holds for those that can be asked.
        wanted = self.choices.verify
        is_possible = wanted and Level(wanted) in possible_levels(part.target, options)
        return self.choices.job(
            part.opened,
            part.path,
            profile,
            self.bus,
            allow_outside_vector=self.image.allow_outside_vector,
            verify=wanted if is_possible else None,
            skip_same_version=not self.choices.force,
        )

    def _profile(self, target: Target) -> Profile:
        return load_profile(self.choices.profile, target, self.bus.dialect)

    # -- on the bus --------------------------------------------------------------------------------

    def _carry_out(self) -> int:
        output = self.output
        error: FlasherError | None = None
        with ExitStack() as stack:
            connection = stack.enter_context(self.bus.connect(BMS, profile=None))
            stop = stack.enter_context(
                stop_on_signal(lambda: output.error_line("stopping at the end of the message ..."))
            )
            output.progress(f"on {connection.name} at {connection.bit_rate}")
            began_at = connection.clock.now()
            self._look(connection, stop)
            for number, device in enumerate(self._devices, 1):
                if stop.asked():
                    error = InterruptedByUserError(
                        f"Interrupted before the upgrade of the {device.name}.",
                        remedy="The same command goes on with it.",
                    )
                    break
                output.progress(f"{device.name}, {number} of {len(self._devices)}")
                error = self._upgrade(device, connection, stop)
                if error is not None:
                    break
            took_s = connection.clock.now() - began_at
        if error is not None:
            return output.failure(error, self._document())
        colour: Literal["green", "yellow"] = "yellow"
        if all(each.is_sure for each in self._devices):
            colour = "green"
        summaries = "; ".join(each.summary for each in self._devices)
        output.verdict(ClosingLine("OK", f"{summaries}  {took_s:.1f} s", colour))
        return output.document(self._document())

    def _look(self, connection: api.Connection, stop: Stop) -> None:
        """Check the whole bike before anything is written, and put its devices in order."""
        output, devices = self.output, self._devices
        jobs = {each.part.target: each.job for each in devices}
        profiles = {each: self._profile(each) for each in (*jobs, *self.without)}
        output.progress("looking at the whole bike ...")
        options = replace(self.recorded, trace_file=None)
        with recording(options, self.bus, output, target=BMS) as record:
            record.opened(connection)
            watch: api.CallOptions = {
                "taps": record.taps, "cancelled": stop, "on_event": partial(record.warn, output),
            }  # fmt: skip
            if BMS not in jobs:
                first = connection.device(devices[0].part.target, dialect=self.bus.dialect)
                check_heard(first, self.bus, output, **watch)
            found = look_at_bike(connection, self.bus.dialect, profiles, **watch)
            for device in devices:
                device.was_in_bootloader = device.part.target in found.broken
                device.job = found.ready(device.job)
            checks = judge_bike(found, jobs, self._left_out)
            self._battery = serial_number(found.answers[BMS].version)
        for target, check in checks:
            device = next(each for each in devices if each.part.target is target)
            device.checks.append(check.event)
            if check.verdict in (CheckVerdict.WARNED, CheckVerdict.WAIVED, CheckVerdict.SKIPPED):
                output.progress(f"{device.name}: {text.check_line(check.event)}")
        for target in found.silent:
            if target in jobs:  # one that is left out is not reset
                output.progress(silence_text(target))
        if found.broken:
            targets = in_safe_order(list(jobs), found.broken)
            devices.sort(key=lambda each: targets.index(each.part.target))
            names = ", ".join(each.name for each in devices)
            output.progress(f"order: {names}: {ORDER_REASON}")

    def _upgrade(
        self, device: _Device, connection: api.Connection, stop: Stop
    ) -> FlasherError | None:
        """Upgrade a device; return the error of a failure."""
        output = self.output
        recorded = replace(self.recorded, trace_file=self._trace_file(device))
        upgrade_run = UpgradeRun(
            device.job, self.bus, recorded, output, partial(self._add_repair, device), self._again
        )
        profile = self._profile(device.part.target)
        upgrade_run.keeps_settings = self.choices.keeps_settings(profile)

        @contextmanager
        def watching(_: api.Connection, record: Recording) -> Iterator[api.CallOptions]:
            hung_up = partial(record.hung_up, stop, output)
            with Progress(device.job.plan, output) as progress:
                yield {"on_event": progress, "cancelled": stop.asked, "hung_up": hung_up}

        try:
            if device is not self._devices[0]:
                check_same_battery(
                    connection, self._profile(BMS), self._battery, cancelled=stop.asked
                )
            device.state = DeviceState.FAILED
            result = upgrade_run.write_planned(lambda: nullcontext(connection), watching)
        except FlasherError as error:
            return upgrade_run.error or error
        device.upgrade = upgrade_run.document
        if upgrade_run.error is None:
            closing = text.verdict_of(result, upgrade_run.checks, upgrade_run.took_s)
            output.progress(f"{closing.word}  {closing.text}")
            device.is_sure = closing.colour == "green"
            device.state, device.summary = _ending(device.name, result)
        return upgrade_run.error

    def _trace_file(self, device: _Device) -> str | None:
        """Return the trace file of a device: the name of the option, with that of the device."""
        if self.recorded.trace_file is None:
            return None
        path = Path(self.recorded.trace_file)
        return str(path.with_stem(f"{path.stem}-{device.part.target.name}"))

    def _add_repair(self, device: _Device, error: FlasherError) -> None:
        """Add the command that repairs a device left without an application: this one again, or a
        rescue with another image or a power cycle.
        """
        if not error.needs_rescue or self.bus.mock:
            return
        is_refused = error.exit_code is ExitCode.REFUSED
        if is_refused or error.exit_code is ExitCode.NO_ANSWER:
            ctx = click.get_current_context()
            error.command = repair_command(ctx, is_refused=is_refused, of_set=device.part)
        else:
            error.command = self._again()
        error.remedy = error.remedy.replace(f"{AGAIN} ", "")

    # -- the result --------------------------------------------------------------------------------

    def _failed(self, error: FlasherError) -> ClosingLine:
        closing = text.failed(error)
        others = [each for each in self._devices if each.state is not DeviceState.FAILED]
        states = ", ".join(f"{each.name} {_WORDS[each.state]}" for each in others)
        return closing._replace(text=f"{closing.text}; {states}") if states else closing

    def _document(self) -> BikeDocument:
        left_out = [
            BikeDeviceDocument(
                each.target.name,
                DeviceState.LEFT_OUT,
                was_in_bootloader=False,
                checks=[],
                upgrade=None,
            )
            for each in self._left_out
        ]
        return BikeDocument(
            printable(self.image.image),
            ORDER_REASON,
            self.choices.dry_run,
            [*(each.document() for each in self._devices), *left_out],
        )


def _ending(name: str, result: Result) -> tuple[DeviceState, str]:
    """Return what became of a device, and what it runs as far as it reported that."""
    if result.outcome.nothing_to_do:
        return DeviceState.UP_TO_DATE, f"{name} was {_WORDS[DeviceState.UP_TO_DATE]}"
    if result.running_version is None:
        return DeviceState.UPGRADED, f"{name} confirmed its image (no version query)"
    return DeviceState.UPGRADED, f"{name} runs {result.running_version}"
