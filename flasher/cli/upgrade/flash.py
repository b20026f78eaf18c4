"""`flasher flash` and `flasher rescue`: upgrade a device."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Final

import click

from flasher import api, jobs
from flasher.cli import values
from flasher.cli.adapters import check_heard, choose_adapter
from flasher.cli.framework import (
    command,
    missing_option,
    option,
    rebuild_command_line,
)
from flasher.cli.options import (
    Bus,
    ImageOptions,
    bus_options,
    image_options,
    target_option,
)
from flasher.cli.output import Output
from flasher.cli.recording import Recording, RecordingOptions, recording_options
from flasher.cli.stop import stop_on_signal
from flasher.cli.upgrade import text
from flasher.cli.upgrade.choices import (
    EXIT_CODES,
    TRACE_OPTIONS,
    UpgradeChoices,
    image_again,
    repair_command,
    upgrade_options,
)
from flasher.cli.upgrade.progress import Progress
from flasher.cli.upgrade.text import BikeDocument, DryRunDocument, UpgradeDocument
from flasher.cli.upgrade.upgrade_run import UpgradeRun
from flasher.errors import ExitCode, FlasherError, UsageError
from flasher.host.options import (
    DEFAULT_POWER_UP_TIMEOUT_S,
)
from flasher.host.outcome import AGAIN
from flasher.image.cortexm import vector_table
from flasher.protocol.spec import Target
from flasher.settings.profile import Profile, load_profile

DOCUMENTS: Final = (UpgradeDocument, DryRunDocument, BikeDocument)
_FLASH_EXAMPLES: Final = """\
examples:
  flasher flash firmware.hex -t bms --mock              try it without hardware
  flasher flash firmware.hex -t bms -i socketcan -c can0
  flasher flash firmware.bin -t mc -i kvaser -c 0 --base 0x8004000
  flasher flash firmware.hex -t bms --skip-same-version -i socketcan -c can0
  flasher flash firmware.hex -t obc --dry-run           show the plan, open no adapter
  flasher flash --bike bike.wfw -i socketcan -c can0    all devices of a bike
  flasher flash --bike bike.toml --mock

--bike takes a release with several images, or a TOML file with a table for each device:
  [[target]]
  target = "bms"
  image = "battery.hex"
Everything is checked before the first device is erased. A device without an application comes
first; then OBC and WMC, and the battery last: it supplies the others, and has to work as long as
one of them may need a rescue. After an interruption the same command goes on: a device that
reports the version of the set is left alone unless --force; one that cannot report is upgraded
again.

"Transferred" (every packet acknowledged), "completed" (reported by the device) and "running
version X" (the new application answered) are three claims; the last lines report which hold.
"""
_RESCUE_EXAMPLES: Final = """\
examples:
  flasher rescue firmware.hex -t bms -i socketcan -c can0
  flasher rescue firmware.hex -t bms -i pcan -c PCAN_USBBUS1 --wait 300
  flasher rescue firmware.hex -t bms --mock             try it without hardware

Start it, then disconnect the device's supply for some seconds and connect it again. It works for a
device that announces itself only at power-up, and for one that never stops announcing itself.
Nothing is sent before the device announces itself, unless the history has an upgrade of it without
an end: a device still in its transfer is found first, without a power cycle.
Hardware and running version cannot be checked, since no application runs.
"""


# -- the commands ----------------------------------------------------------------------------------


@command(epilog=_FLASH_EXAMPLES, exit_codes=(*EXIT_CODES, ExitCode.NOTHING_TO_DO))
@target_option(required=False)
@image_options
@upgrade_options
@option(
    "--bike", is_flag=True, panel="upgrade", brief=True,
    help="IMAGE is a set: upgrade each device that it has an image for, in a safe order",
)  # fmt: skip
@option(
    "--without", type=values.target, multiple=True, metavar="TARGET", panel="upgrade",
    help="with --bike: leave this device of the set alone; may be repeated",
)  # fmt: skip
@option(
    "--skip-same-version", is_flag=True, panel="upgrade",
    help="leave a device alone that already runs the image's version: exit code 11",
)  # fmt: skip
@bus_options(mock="upgrade a device model in this process")
@recording_options
def flash(
    output: Output,
    target: Target | None,
    image: ImageOptions,
    choices: UpgradeChoices,
    bus: Bus,
    recorded: RecordingOptions,
    *,
    bike: bool,
    without: tuple[Target, ...],
    skip_same_version: bool,
) -> int:
    """Upgrade a device: ask for its identity, check that the image fits, reset it into its
    bootloader, transfer, wait for the final answer, verify. A device whose bootloader announces
    itself starts at once, and so does one that still waits in an interrupted upgrade; one that
    announces itself only at power-up needs `flasher rescue`. With --bike it upgrades all devices
    of a bike, one after the other.
    """
    if bike:
        from flasher.cli.upgrade.bike import BikeUpgrade  # noqa: PLC0415  for sets alone

        return BikeUpgrade(output, image, choices, bus, recorded, frozenset(without)).run(target)
    if without:
        raise UsageError("--without needs --bike.", remedy="Add --bike, or leave --without out.")
    if target is None:
        raise missing_option("target")
    upgrade = _Upgrade(output, target, image, choices, bus, recorded)
    return upgrade.run(skip_same_version=skip_same_version)


@command(epilog=_RESCUE_EXAMPLES, exit_codes=EXIT_CODES)
@target_option()
@image_options
@upgrade_options
@option(
    "--wait", type=values.seconds, metavar="S", panel="upgrade", brief=True,
    help=f"seconds to wait for the announcement (default {DEFAULT_POWER_UP_TIMEOUT_S:g})",
)  # fmt: skip
@bus_options(mock="upgrade a device model in this process")
@recording_options
def rescue(
    output: Output,
    target: Target,
    image: ImageOptions,
    choices: UpgradeChoices,
    bus: Bus,
    recorded: RecordingOptions,
    *,
    wait: float | None,
) -> int:
    """Upgrade a device that no longer starts: wait for the announcement of its bootloader at
    power-up, answer it, transfer, wait for the final answer, verify.
    """
    upgrade = _Upgrade(output, target, image, choices, bus, recorded)
    return upgrade.run(at_power_up=True, power_up_timeout_s=wait)


@dataclass
class _Upgrade:
    """Upgrade by `flash` or `rescue`, and its output."""

    output: Output
    target: Target
    image: ImageOptions
    choices: UpgradeChoices
    bus: Bus
    recorded: RecordingOptions

    def run(
        self,
        *,
        at_power_up: bool = False,
        power_up_timeout_s: float | None = None,
        skip_same_version: bool = False,
    ) -> int:
        """Prepare and run the upgrade, or show its plan; return the exit code."""
        output, choices = self.output, self.choices
        output.ending = text.failed
        profile = load_profile(choices.profile, self.target, self.bus.dialect)
        # Check the file before looking for an adapter.
        opened = self._open()
        image = opened.image
        profile.check_fits(image)
        self.bus = self.bus.with_profile(choices.profile)
        if not choices.dry_run:
            self.bus = choose_adapter(self.bus, output)
        job = choices.job(
            opened,
            self.image.image,
            profile,
            self.bus,
            allow_outside_vector=self.image.allow_outside_vector,
            verify=choices.verify,
            at_power_up=at_power_up,
            power_up_timeout_s=power_up_timeout_s,
            skip_same_version=skip_same_version,
        )
        show = output.result if choices.dry_run else output.progress
        table = vector_table(image)
        for line in text.job_lines(job):
            show(line)
        job.checked()
        for warning in opened.provenance.warnings if opened.provenance else ():
            output.error_line(f"warning: {warning}")
        if not choices.dry_run:
            return self._carry_out(job, profile)
        checks = [each.event for each in job.checks]
        for check in checks:
            output.result(text.check_line(check))
        output.result("dry run: nothing was sent")
        return output.document(
            DryRunDocument(
                dry_run=True,
                image=text.image_document(image, table),
                plan=text.plan_document(job.plan, job.options),
                checks=checks,
            )
        )

    def _open(self) -> jobs.OpenedImage:
        choices = self.choices
        choices.check_contradictions()
        return jobs.open_image(
            self.image.source,
            self.target,
            manifest=choices.manifest,
            require_signed=choices.require_signed,
            **self.image.options(force=choices.force),
        )

    def _carry_out(self, job: jobs.Job, profile: Profile) -> int:
        output = self.output
        ctx = click.get_current_context()

        def again() -> str:
            name, replaced = str(ctx.info_name), image_again(ctx)
            words = rebuild_command_line(
                ctx, name, without=TRACE_OPTIONS.__contains__, replaced=replaced
            )
            return shlex.join(["flasher", *words])

        upgrade_run = UpgradeRun(job, self.bus, self.recorded, output, self._add_repair, again)
        upgrade_run.keeps_settings = self.choices.keeps_settings(profile)
        result = upgrade_run.write_planned(
            lambda: self.bus.connect(
                self.target,
                profile=None,
                system=False,
                has_application=not job.options.at_power_up,
            ),
            lambda connection, record: self._watching(upgrade_run.job, connection, record),
        )
        # Print the bundle before the error, so that the verdict is last.
        error, document = upgrade_run.error, upgrade_run.document
        show = output.result if error is None else output.progress
        if result.outcome.ok:
            for line in text.summary_lines(result, job.plan):
                show(line)
        if document is not None and document.link is not None:
            for line in text.link_lines(document.link):
                output.progress(line, level=1)
            for warning in text.adapter_warnings(document.link):
                output.error_line(f"warning: {warning}")
        verdict = text.verdict_of(result, upgrade_run.checks, upgrade_run.took_s)
        if error is None:
            output.verdict(verdict)
            output.document(document, exit_code=result.exit_code)
        else:
            output.ending = lambda _error: verdict
            output.failure(error, document)
        return result.exit_code

    @contextmanager
    def _watching(
        self, job: jobs.Job, connection: api.Connection, record: Recording
    ) -> Iterator[api.CallOptions]:
        """Show the upgrade on the terminal, and stop it on request."""
        output = self.output
        output.progress(f"on {connection.name} at {connection.bit_rate}")
        with (
            Progress(job.plan, output) as progress,
            stop_on_signal(
                lambda: output.error_line("stopping at the end of the message ...")
            ) as stop,
        ):
            # A device before power-up, or in an open session, may be silent.
            if not job.options.at_power_up and not job.options.in_session:
                device = connection.device(self.target, dialect=self.bus.dialect)
                check_heard(device, self.bus, output, taps=record.taps, cancelled=stop.asked)
            hung_up = partial(record.hung_up, stop, output)
            yield {"on_event": progress, "cancelled": stop.asked, "hung_up": hung_up}

    def _add_repair(self, error: FlasherError) -> None:
        """Add the command that repairs a device left without an application."""
        if error.needs_rescue and not self.bus.mock:
            # An image that the device refused repairs nothing.
            is_refused = error.exit_code is ExitCode.REFUSED
            error.command = repair_command(click.get_current_context(), is_refused=is_refused)
            error.remedy = error.remedy.replace(f"{AGAIN} ", "")
