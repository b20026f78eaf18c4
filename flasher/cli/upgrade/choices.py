"""Options of an upgrade, and the command that repairs a device after a failed one."""

from __future__ import annotations

import shlex
from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import click

from flasher import jobs
from flasher.cli import values
from flasher.cli.framework import Decorator, option, option_set, rebuild_command_line
from flasher.cli.options import STANDARD_INPUT, Bus, gap_options, profile_option
from flasher.errors import ExitCode, UsageError
from flasher.host.options import DEFAULT_ATTEMPTS, PATIENT_TRIES, UpgradeOptions
from flasher.host.verify import Level
from flasher.host.waivers import OF_DEVICE, OUTSIDE_VECTOR, UNSIGNED, WAIVERS
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.settings.profile import Profile
from flasher.way_back import images_beside, images_here

if TYPE_CHECKING:
    from flasher.bike import SetImage


EXIT_CODES: Final = (
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
"""Exit codes of an upgrade."""


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
        help="do not, whatever the profile sets",
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
        opened: jobs.OpenedImage,
        path: str | Path,
        profile: Profile,
        bus: Bus,
        *,
        allow_outside_vector: bool,
        verify: str | None,
        at_power_up: bool = False,
        power_up_timeout_s: float | None = None,
        skip_same_version: bool = False,
    ) -> jobs.Job:
        """Prepare the upgrade of a device with the image of a file. Raises ImageError and
        UsageError.
        """
        waived = [name for name in OF_DEVICE if self.allows(name)]
        waived += [OUTSIDE_VECTOR] * (allow_outside_vector or self.force)
        waived += [UNSIGNED] * self.allow_unsigned
        found = None
        if not self.dry_run and not at_power_up:  # a version is reported
            found = images_here(profile.target, images_beside(path, values.IMAGE_SUFFIXES))
        return jobs.prepare(
            opened,
            profile,
            bitrate_bps=bus.bit_rate.bps,
            options=self.options(profile, power_up_timeout_s),
            verify=None if self.dry_run else verify,
            at_power_up=at_power_up,
            waived=waived,
            skip_same_version=skip_same_version,
            images_here=found,
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


upgrade_options: Final = option_set("choices", UpgradeChoices)


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


def image_again(ctx: click.Context) -> dict[str, str]:
    """Replace an image from standard input in a command that is run again."""
    return {"image": SAME_IMAGE} if ctx.params["image"] == STANDARD_INPUT else {}


def repair_command(
    ctx: click.Context,
    *,
    is_refused: bool,
    of_set: SetImage | None = None,
    without: Collection[str] = (),
) -> str:
    """Return the `flasher rescue` command for the command of `ctx`, quoted for a shell. Options
    about an image that the device refused are omitted. `of_set` is the image of a bike's device,
    `without` are options of the command that a rescue does not have.
    """

    def is_left_out(name: str) -> bool:
        of_the_image = name in _OF_THE_IMAGE or name.startswith("--allow-")
        return name in _LEFT_OUT or name in without or (is_refused and of_the_image)

    image = image_again(ctx) if of_set is None else {"image": str(of_set.path)}
    replaced = {"image": OTHER_IMAGE} if is_refused else image
    words = rebuild_command_line(ctx, "rescue", without=is_left_out, replaced=replaced)
    if of_set is not None:
        words += ["-t", of_set.target.name, *(() if is_refused else of_set.options)]
    return shlex.join(["flasher", *words])
