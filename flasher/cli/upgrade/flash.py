"""`flasher flash` and `flasher rescue`: upgrade a device."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Final

import click

from flasher import api
from flasher.cli import values
from flasher.cli.adapters import check_heard, choose_adapter
from flasher.cli.framework import (
    Decorator,
    command,
    missing_option,
    option,
    option_set,
    rebuild_command_line,
)
from flasher.cli.options import (
    STANDARD_INPUT,
    Bus,
    ImageOptions,
    bus_options,
    gap_options,
    holder,
    image_options,
    profile_option,
    target_option,
)
from flasher.cli.output import Output
from flasher.cli.recording import Recording, RecordingOptions, recording_options
from flasher.cli.stop import stop_on_signal
from flasher.cli.upgrade import text
from flasher.cli.upgrade.progress import Progress
from flasher.cli.upgrade.text import BikeDocument, DryRunDocument, UpgradeDocument
from flasher.cli.upgrade.upgrade_run import UpgradeRun
from flasher.errors import ExitCode, FlasherError, UsageError
from flasher.host.identity import WAIVABLE, IdentityCheck
from flasher.host.options import (
    DEFAULT_ATTEMPTS,
    DEFAULT_POWER_UP_TIMEOUT_S,
    PATIENT_TRIES,
    UpgradeOptions,
)
from flasher.host.outcome import AGAIN
from flasher.host.verify import Level
from flasher.host.waivers import OF_DEVICE, OUTSIDE_VECTOR, UNSIGNED, WAIVERS
from flasher.image.cortexm import vector_table
from flasher.protocol.spec import Target
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.settings.profile import Profile, load_profile
from flasher.way_back import images_beside, images_here

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

--bike takes a release with several images, or a TOML file that names an image for each device.
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
device that announces itself at power-up only as well as for one that announces itself for ever.
Nothing is sent before the device announces itself, unless an upgrade of it has no end: a device
that is still in its transfer is found without a power cycle, which is requested only after that.
Hardware and running version cannot be checked, since no application runs.
"""
_EXIT_CODES: Final = (
    ExitCode.IMAGE,
    ExitCode.BUS,
    ExitCode.NO_ANSWER,
    ExitCode.WRONG_DEVICE,
    ExitCode.TRANSFER,
    ExitCode.REFUSED,
    ExitCode.UNCONFIRMED,
    ExitCode.VERIFICATION,
    ExitCode.INTERRUPTED,
)

# -- options ---------------------------------------------------------------------------------------


def _waiver_option(name: str) -> Decorator:
    return option(
        f"--allow-{name}", is_flag=True, panel="checks before the first write",
        help=f"let through {OF_DEVICE[name].permits}",
    )  # fmt: skip


@dataclass(frozen=True)
class UpgradeChoices:
    """Options of an upgrade, with its waived checks."""

    manifest: Annotated[str | None, option(
        "--manifest", metavar="FILE", type=values.FilePath("toml"), panel="image",
        help="the image's release manifest (default: IMAGE.toml beside the image, if there is one)",
    )]  # fmt: skip
    profile: Annotated[str | None, profile_option]
    dry_run: Annotated[bool, option(
        "-n", "--dry-run", is_flag=True, panel="upgrade", brief=True,
        help="show the plan and stop",
    )]  # fmt: skip
    verify: Annotated[str | None, option(
        "--verify", type=click.Choice([level.value for level in Level]), panel="upgrade",
        help="after the upgrade: ask the new application for its version, or read the whole image "
        "back as well (default: version where the target has a query for it, else none)",
    )]  # fmt: skip
    packet_tries: Annotated[int | None, option(
        "--retries", "packet_tries", type=values.count, metavar="N", panel="upgrade",
        help=f"send a packet up to N times (default {DEFAULT_TIMINGS.packet_tries}, and "
        f"{PATIENT_TRIES} once the device has no application)",
    )]  # fmt: skip
    attempts: Annotated[int | None, option(
        "--attempts", type=values.count, metavar="N", panel="upgrade",
        help="begin the upgrade up to N times: when the device restarts, a packet is lost for good "
        f"or the adapter comes back (default {DEFAULT_ATTEMPTS}, and until the overall deadline "
        "once the device has no application)",
    )]  # fmt: skip
    timeout_s: Annotated[float | None, option(
        "--timeout", "timeout_s", type=values.seconds, metavar="S", panel="upgrade",
        help="overall deadline in seconds, of all attempts together (default: computed from the "
        "plan)",
    )]  # fmt: skip
    adapter_return_s: Annotated[float | None, option(
        "--adapter-wait", "adapter_return_s", type=values.seconds, metavar="S", panel="upgrade",
        help="seconds that a lost adapter may take to come back, once anything was sent "
        f"(default {UpgradeOptions.adapter_return_s:g})",
    )]  # fmt: skip
    frame_gap_s: Annotated[float | None, gap_options]
    packet_gap_s: float | None
    nak_next_is_ack: Annotated[bool, option(
        "--nak-next-is-ack", is_flag=True, panel="upgrade",
        help="for bootloaders that answer a repeated packet n with NAK n+1",
    )]  # fmt: skip
    keep_settings: Annotated[bool, option(
        "--keep-settings", is_flag=True, panel="upgrade",
        help="save what may be written (user strings, check code) before the upgrade, and restore "
        "what changed (default: keep_settings of the profile)",
    )]  # fmt: skip
    no_keep_settings: Annotated[bool, option(
        "--no-keep-settings", is_flag=True, panel="upgrade",
        help="do not, whatever the profile has",
    )]  # fmt: skip
    in_session: Annotated[bool, option(
        "--in-session", is_flag=True, panel="upgrade",
        help="an upgrade of this device was broken off, and it may still wait in it: when it "
        "answers nothing, send it an update command",
    )]  # fmt: skip
    allow_implausible: Annotated[bool, _waiver_option("implausible")]
    allow_other_target: Annotated[bool, _waiver_option("other-target")]
    allow_hardware: Annotated[bool, _waiver_option("hardware")]
    allow_downgrade: Annotated[bool, _waiver_option("downgrade")]
    allow_previous_version: Annotated[bool, _waiver_option("previous-version")]
    allow_in_use: Annotated[bool, _waiver_option("in-use")]
    allow_low_charge: Annotated[bool, _waiver_option("low-charge")]
    allow_boot_name: Annotated[bool, _waiver_option("boot-name")]
    allow_boot_version: Annotated[bool, _waiver_option("boot-version")]
    force: Annotated[bool, option(
        "-f", "--force", is_flag=True, panel="checks before the first write",
        help="the same as every --allow-... together but --allow-unsigned; neither a damaged file "
        "nor a second tool is waived by any",
    )]  # fmt: skip
    require_signed: Annotated[bool, option(
        "--require-signed", is_flag=True, panel="checks before the first write",
        help="refuse an image that no trusted key has signed (default once this computer has a "
        "trust file)",
    )]  # fmt: skip
    allow_unsigned: Annotated[bool, option(
        "--allow-unsigned", is_flag=True, panel="checks before the first write",
        help=f"let through {WAIVERS[UNSIGNED].permits}; --force does not",
    )]  # fmt: skip

    def allows(self, name: str) -> bool:
        """True if --allow-NAME was given, or --force, which does not waive signatures."""
        given: bool = getattr(self, f"allow_{name.replace('-', '_')}")
        return given or (self.force and name != UNSIGNED)

    def waived_checks(self) -> frozenset[IdentityCheck]:
        """Waived checks of image and device."""
        return frozenset(check for check in WAIVABLE if self.allows(check.value))

    def options(self, profile: Profile, wait: float | None) -> UpgradeOptions:
        """Return the options of the command line, with the profile as default. Raises UsageError
        for options that exclude each other.
        """
        names = {each.name for each in (*fields(UpgradeOptions), *fields(Timings))}
        chosen = {name: value for name, value in vars(self).items() if name in names}
        chosen["allow_boot_name"] = self.allows("boot-name")
        given = {name: None if value is False else value for name, value in chosen.items()}
        return profile.upgrade_options(**given, power_up_timeout_s=wait)

    def job(
        self,
        opened: api.OpenedImage,
        path: str | Path,
        profile: Profile,
        bus: Bus,
        *,
        allow_outside_vector: bool,
        verify: str | None,
        at_power_up: bool = False,
        power_up_timeout_s: float | None = None,
        skip_same_version: bool = False,
    ) -> api.Job:
        """Prepare the upgrade of a device with the image of a file. Raises ImageError and
        UsageError.
        """
        waived = [name for name in OF_DEVICE if self.allows(name)]
        waived += [OUTSIDE_VECTOR] * (allow_outside_vector or self.force)
        waived += [UNSIGNED] * self.allow_unsigned
        return api.prepare(
            opened.image,
            profile,
            bitrate_bps=bus.bit_rate.bps,
            options=self.options(profile, power_up_timeout_s),
            verify=None if self.dry_run else verify,
            identity=profile.identity(
                release=opened.release,
                provenance=opened.provenance,
                waived=self.waived_checks(),
                skip_same_version=skip_same_version,
                reports_unchecked=at_power_up,
                images_here=images_here(profile.target, images_beside(path, values.IMAGE_SUFFIXES)),
            ),
            at_power_up=at_power_up,
            waived=waived,
        )

    def keeps_settings(self, profile: Profile) -> bool:
        """True if the settings are saved and restored."""
        return (profile.keep_settings or self.keep_settings) and not self.no_keep_settings

    def check_contradictions(self) -> None:
        """Raise UsageError for options that contradict each other."""
        if self.keep_settings and self.no_keep_settings:
            raise UsageError(
                "--keep-settings and --no-keep-settings contradict each other.",
                remedy="Leave one of them out.",
            )
        if self.require_signed and self.allow_unsigned:
            raise UsageError(
                "--require-signed and --allow-unsigned contradict each other.",
                remedy="Leave one of them out.",
            )


_upgrade_options: Final = option_set("choices", UpgradeChoices)


# -- the commands ----------------------------------------------------------------------------------


@command(epilog=_FLASH_EXAMPLES, exit_codes=(*_EXIT_CODES, ExitCode.NOTHING_TO_DO))
@target_option(required=False)
@image_options
@_upgrade_options
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
        from flasher.cli.upgrade.bike import BikeUpgrade  # noqa: PLC0415  it imports this module

        return BikeUpgrade(output, image, choices, bus, recorded, frozenset(without)).run(target)
    if without:
        raise UsageError("--without needs --bike.", remedy="Add --bike, or leave --without out.")
    if target is None:
        raise missing_option("target")
    upgrade = _Upgrade(output, target, image, choices, bus, recorded)
    return upgrade.run(skip_same_version=skip_same_version)


@command(epilog=_RESCUE_EXAMPLES, exit_codes=_EXIT_CODES)
@target_option()
@image_options
@_upgrade_options
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

    def _open(self) -> api.OpenedImage:
        choices = self.choices
        choices.check_contradictions()
        with self.image.advice():
            return api.open_image(
                self.image.source,
                self.target,
                manifest=choices.manifest,
                require_signed=choices.require_signed,
                **self.image.options(force=choices.force),
            )

    def _carry_out(self, job: api.Job, profile: Profile) -> int:
        output = self.output
        ctx = click.get_current_context()
        name, replaced = str(ctx.info_name), _image_again(ctx)
        words = rebuild_command_line(
            ctx, name, without=TRACE_OPTIONS.__contains__, replaced=replaced
        )
        again = shlex.join(["flasher", *words])
        upgrade_run = UpgradeRun(job, self.bus, self.recorded, output, self._add_repair, again)
        upgrade_run.keeps_settings = self.choices.keeps_settings(profile)
        result = upgrade_run.write_planned(
            lambda: self._connect(at_power_up=job.options.at_power_up),
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
            if document.link.unreadable:
                output.error_line(f"warning: {text.unreadable_line(document.link.unreadable)}")
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
        self, job: api.Job, connection: api.Connection, record: Recording
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

            def hung_up() -> bool:
                if stop.has_hung_up:
                    record.leave_terminal(output)
                return stop.has_hung_up

            def on_event(event: object) -> None:
                output.event(event)
                progress(event)

            # A device before power-up, or in an open session, may be silent.
            if not job.options.at_power_up and not job.options.in_session:
                device = connection.device(self.target, dialect=self.bus.dialect)
                check_heard(device, self.bus, output, taps=record.taps, cancelled=stop.asked)
            yield {"on_event": on_event, "cancelled": stop.asked, "hung_up": hung_up}

    def _connect(self, *, at_power_up: bool) -> AbstractContextManager[api.Connection]:
        bus = self.bus
        if bus.mock:
            return api.connect_mock(
                self.target, bus.dialect, speed=bus.mock_speed, has_application=not at_power_up
            )
        return api.connect(bus.dialect, holder=holder(), fallback=bus.fallback, **bus.config)

    def _add_repair(self, error: FlasherError) -> None:
        """Add the command that repairs a device left without an application."""
        if error.needs_rescue and not self.bus.mock:
            # An image that the device refused repairs nothing.
            is_refused = error.exit_code is ExitCode.REFUSED
            error.command = repair_command(click.get_current_context(), is_refused=is_refused)
            error.remedy = error.remedy.replace(f"{AGAIN} ", "")


# -- the command that repairs ----------------------------------------------------------------------

OTHER_IMAGE: Final = "OTHER_IMAGE"
"""Placeholder for another image, after the device refused the one sent."""
SAME_IMAGE: Final = "IMAGE"
"""Placeholder for an image from standard input, which is read once."""
TRACE_OPTIONS: Final = frozenset({"--trace-file", "--overwrite-trace"})
_LEFT_OUT: Final = TRACE_OPTIONS | {"--timeout", "--skip-same-version", "--bike", "--without"}
"""Options that the repair command omits: a deadline for a device that answers at once (a rescue
waits until it is switched off and on), a trace that is evidence now, options without `rescue`."""
_OF_THE_IMAGE: Final = frozenset(
    {"--format", "--base", "--range", "--fill-gaps-up-to", "--manifest", "--force"}
)


def _image_again(ctx: click.Context) -> dict[str, str]:
    return {"image": SAME_IMAGE} if ctx.params["image"] == STANDARD_INPUT else {}


def repair_command(
    ctx: click.Context, *, is_refused: bool, of_set: tuple[Target, str] | None = None
) -> str:
    """Return the `flasher rescue` command for the command of `ctx`, quoted for a shell. Options
    about an image that the device refused are omitted. `of_set` is a device of a bike, and the file
    of its image.
    """

    def is_left_out(name: str) -> bool:
        of_the_image = name in _OF_THE_IMAGE or name.startswith("--allow-")
        return name in _LEFT_OUT or (is_refused and of_the_image)

    image = _image_again(ctx) if of_set is None else {"image": of_set[1]}
    replaced = {"image": OTHER_IMAGE} if is_refused else image
    words = rebuild_command_line(ctx, "rescue", without=is_left_out, replaced=replaced)
    return shlex.join(["flasher", *words, *(() if of_set is None else ("-t", of_set[0].name))])
