"""The options that `flash` and `rescue` share, and what they choose for an upgrade."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Final

from flasher import api
from flasher.cli import arguments
from flasher.cli.profile import add_option as add_profile
from flasher.cli.recording import add_recording
from flasher.host.identity import WAIVABLE, Check
from flasher.host.options import DEFAULT_ATTEMPTS, UpgradeOptions
from flasher.host.verify import Level
from flasher.image.plan import Plan
from flasher.image.release import Release
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.settings.profile import Profile

_WAIVERS: Final = {
    "implausible": arguments.IMPLAUSIBLE,
    "other-target": "an image that its manifest, or a name inside, gives to another target",
    "hardware": "a hardware version that the manifest does not list",
    "downgrade": "an image that is older than what runs",
    "previous-version": "a running version that the manifest does not replace",
    "in-use": "a vehicle whose battery gives much current",
    "boot-name": "a bootloader that gives another name than the target's",
    "boot-version": "a bootloader that is older than the manifest asks for",
}
"""What each --allow-... lets through."""


# -- on the command line --------------------------------------------------------------------------


def add_upgrade(parser: argparse.ArgumentParser) -> None:
    """Everything but the epilog, in the order of the help."""
    arguments.add_image(parser)
    parser.add_argument(
        "--manifest",
        metavar="FILE",
        help="the image's release manifest (default: IMAGE.toml beside the image, if there is one)",
    )
    arguments.add_target(parser)
    arguments.add_dialect(parser)
    add_profile(parser)
    _add_how(parser)
    _add_waivers(parser)
    mock = parser.add_argument_group("without hardware")
    mock.add_argument("--mock", action="store_true", help="upgrade a device model in this process")
    mock.add_argument(
        "--mock-speed",
        type=arguments.speed,
        default=1.0,
        metavar="X",
        help="times as fast as a real bus, from 0.1 on; 0 takes no time (default %(default)s)",
    )
    add_recording(parser)
    arguments.add_bus(parser)


def _add_how(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("upgrade")
    group.add_argument("-n", "--dry-run", action="store_true", help="show the plan and stop")
    group.add_argument(
        "--verify",
        choices=[level.value for level in Level],
        help="after the upgrade: ask the new application for its version, or read the whole image "
        "back as well (default: version where the target has a query for it, else none)",
    )
    group.add_argument(
        "--retries",
        type=arguments.count,
        metavar="N",
        help=f"send a packet up to N times (default {DEFAULT_TIMINGS.packet_tries})",
    )
    group.add_argument(
        "--attempts",
        type=arguments.count,
        metavar="N",
        help="begin the upgrade up to N times: when the device restarts, a packet is lost for good "
        f"or the adapter comes back (default {DEFAULT_ATTEMPTS})",
    )
    group.add_argument(
        "--timeout",
        type=arguments.seconds,
        metavar="S",
        help="overall deadline in seconds, of all attempts together (default: computed from the "
        "plan)",
    )
    group.add_argument(
        "--adapter-wait",
        type=arguments.seconds,
        metavar="S",
        help="seconds that a lost adapter may take to come back "
        f"(default {UpgradeOptions.adapter_return_s})",
    )
    _add_special_bootloaders(group)


def _add_special_bootloaders(group: argparse._ArgumentGroup) -> None:
    arguments.add_gaps(group)
    group.add_argument(
        "--nak-next-is-ack",
        action="store_true",
        help="for bootloaders that answer a repeated packet n with NAK n+1",
    )


def _add_waivers(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "checks before the first write",
        "Each one is waived by its own option. Neither a damaged file nor a second tool is waived "
        "by any.",
    )
    for name, what in _WAIVERS.items():
        group.add_argument(f"--allow-{name}", action="store_true", help=f"let through {what}")
    group.add_argument(
        "-f", "--force", action="store_true", help="the same as every --allow-... together"
    )


# -- what they choose -----------------------------------------------------------------------------


def waived_checks(options: argparse.Namespace) -> frozenset[Check]:
    """The checks of image and device that the user waives."""
    return frozenset(check for check in WAIVABLE if _is_allowed(options, check.value))


def chosen_options(
    options: argparse.Namespace,
    profile: Profile,
    release: Release | None,
    *,
    at_power_up: bool,
    power_up_timeout_s: float | None,
) -> UpgradeOptions:
    """The profile's choices, the command line's where it makes any, and what the manifest asks of
    the bootloader. Raises UsageError where they do not go together.
    """
    chosen = replace(
        profile.upgrade_options(
            packet_tries=options.retries,
            attempts=options.attempts,
            timeout_s=options.timeout,
            adapter_return_s=options.adapter_wait,
            frame_gap_s=options.frame_gap,
            packet_gap_s=options.packet_gap,
            nak_next_is_ack=options.nak_next_is_ack or None,
            allow_boot_name=_is_allowed(options, "boot-name") or None,
        ),
        at_power_up=at_power_up,
        power_up_timeout_s=profile.power_up_timeout_s
        if power_up_timeout_s is None
        else power_up_timeout_s,
    )
    if _is_allowed(options, "boot-version"):
        return chosen
    return api.release_options(chosen, release)


def chosen_level(options: argparse.Namespace, plan: Plan, chosen: UpgradeOptions) -> Level:
    """How far the upgrade is verified. Raises UsageError for a level that the target has no query
    for.
    """
    if options.verify is None:
        return api.default_level(plan.target, chosen)
    level = Level(options.verify)
    api.check_level(plan, level, chosen)
    return level


def _is_allowed(options: argparse.Namespace, name: str) -> bool:
    return bool(options.force or getattr(options, f"allow_{name.replace('-', '_')}"))
