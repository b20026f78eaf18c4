"""`flasher history`: list the upgrades made from this computer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Final

from flasher.cli import values
from flasher.cli.framework import command, option
from flasher.cli.options import target_option
from flasher.cli.output import Output, byte_count, counted
from flasher.errors import ExitCode
from flasher.history import Began, Flash, FlashHistory, left_open, matching, working_folder
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.wording import wording_of

_EXAMPLES: Final = """\
examples:
  flasher history
  flasher history --serial W2605001
  flasher history -t bms --limit 5 --json | jq '.flashes[].ended.exit_code'

flash and rescue record it, dry runs and stations do not. "No end recorded": the program was killed,
or the computer lost power. The command below it repeats the upgrade.
"""


@dataclass(frozen=True)
class HistoryDocument:
    """Upgrades made from this computer."""

    file: str
    flashes: list[Flash]
    """Upgrades, the latest first."""
    total: int
    """Number of matching upgrades, shown or not."""
    damaged_lines: int
    """Number of unreadable lines in the file."""


DOCUMENTS: Final = (HistoryDocument,)


@command(epilog=_EXAMPLES)
@target_option(required=False)
@option("--serial", metavar="TEXT", brief=True, help="only devices with TEXT in the serial number")
@option(
    "--limit", type=values.count, default="20", metavar="N", brief=True,
    help="show the latest N",
)  # fmt: skip
def history(output: Output, *, target: Target | None, serial: str | None, limit: int) -> int:
    """List the upgrades made from this computer, the latest first: time, image, device and
    result.
    """
    kept = FlashHistory()
    flashes, damaged = kept.flashes()
    name = None if target is None else target.name
    found = list(matching(flashes, target=name, serial_number=serial))
    latest = list(islice(reversed(found), limit))
    for each in latest:
        began = each.began
        is_open = each is left_open(flashes, target=began.target, adapter=began.adapter)
        output.results(_lines(each, is_open=is_open))
        output.result("")
    if not latest:
        output.result("nothing flashed" + (" that fits" if flashes else " yet"))
    elif len(found) > len(latest):
        output.progress(f"the latest {len(latest)} of {len(found):,}; --limit shows more")
    if damaged:
        path = printable(str(kept.path))
        output.error_line(f"warning: {counted(damaged, 'line')} of {path} cannot be read")
    return output.document(
        HistoryDocument(
            file=str(kept.path), flashes=latest, total=len(found), damaged_lines=damaged
        )
    )


def _lines(flash: Flash, *, is_open: bool) -> Iterator[str]:
    began, ended = flash.began, flash.ended
    serial = f" {ended.serial_number}" if ended and ended.serial_number else ""
    virtual = ", virtual" if began.is_virtual else ""
    when = printable(began.at.replace("T", " "))
    yield printable(f"{when}  {began.command} {began.target.upper()}{serial}{virtual}")
    version = f", {began.image_version}" if began.image_version else ""
    yield printable(f"  image    {began.image}, {byte_count(began.image_size_bytes)}{version}")
    yield printable(f"  sha256   {began.image_sha256}")
    yield printable(f"  adapter  {began.adapter}")
    if began.waived:
        yield printable(f"  waived   {began.waived}")
    if flash.is_running:
        yield "  end      none yet: the flash is still running"
        return
    if ended is None:
        yield "  end      began, no end recorded: the program was killed or the computer lost power"
        yield printable(f"  reached  {describe_progress(flash)}")
        if is_open:
            yield printable(f"  device   {flash.device_left}")
            yield from _repair_lines(began)
        return
    if ended.previous_version:
        yield printable(f"  before   {ended.previous_version}")
    yield printable(f"  claims   {', '.join(ended.claims)}")
    code = f"exit code {ended.exit_code}"
    yield printable(f"  end      {f'{code}: {ended.what}' if ended.what else code}")
    if ended.needs_rescue:
        yield "           the device had no application then, or perhaps none: flasher rescue"
    if ended.bundle:
        yield printable(f"  bundle   {ended.bundle}")
    # An image that the device refused repairs nothing.
    if is_open and ended.exit_code != ExitCode.REFUSED:
        yield from _repair_lines(began)


def _repair_lines(began: Began) -> Iterator[str]:
    yield printable(f"  repair   {repeat_command(began)}")
    if began.folder not in ("", working_folder()):
        yield printable(f"           (in {began.folder})")


def describe_progress(flash: Flash) -> str:
    """Describe the progress of an upgrade without a recorded end."""
    found = flash.reached
    if found is None:
        return "nothing that erases, as far as is known"
    packet = f", packet {found.packet} acknowledged" if found.packet else ""
    return f"{wording_of('Phase', found.phase)}{packet}"


def repeat_command(began: Began) -> str:
    """Return the command that repeats an upgrade without a recorded end."""
    return began.again or "flasher ui"
