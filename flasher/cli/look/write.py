"""`flasher write`: write an item of a device by its name, and read it back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import click

from flasher.api import as_dialect
from flasher.cli import values
from flasher.cli.adapters import check_heard, choose_adapter
from flasher.cli.framework import argument, command, option
from flasher.cli.options import Bus, bus_options, target_option
from flasher.cli.output import Output
from flasher.cli.recording import RecordingOptions, recorded_connection, recording_options
from flasher.cli.stop import stop_on_signal
from flasher.cli.terminal import agrees, check_can_ask
from flasher.errors import ExitCode, UsageError
from flasher.host.items import writable
from flasher.host.write import FieldChange, WriteResult, field_changes, plan_write
from flasher.protocol.fields import label
from flasher.protocol.spec import BMS, WELLING, Dialect, Target

_EXAMPLES: Final = """\
examples:
  flasher write --list
  flasher write user-string-1 -t bms "rack 7" -i socketcan -c can0
  flasher write serial-number -t bms W2605001 --manufacturer --yes -i socketcan -c can0
  flasher write production-information -t bms ACME SUZHOU 20260517 --manufacturer --mock
  flasher write check-code -t bms 00112233445566778899AABB --mock

Shows the old and the new value and asks before it writes; without a terminal --yes is needed. Exit
code 10 when the write is not confirmed or reads back differently, 5 when the device is silent.
"""


@dataclass(frozen=True)
class WrittenDocument:
    """Result of a write."""

    target: str
    item: str
    confirmed: bool
    """True if the device acknowledged the write."""
    fields: dict[str, FieldChange]


@dataclass(frozen=True)
class NotWrittenDocument:
    """Result of a write that the user declined."""

    written: Literal[False]


@dataclass(frozen=True)
class WritableItem:
    """Fields of an item that can be written."""

    fields: list[str]
    manufacturer_only: bool


@dataclass(frozen=True)
class WritableDocument:
    """Items that can be written."""

    items: dict[str, WritableItem]


DOCUMENTS: Final = (WrittenDocument, NotWrittenDocument, WritableDocument)


def _items(ctx: click.Context) -> list[str]:
    """Complete the items that can be written, of the target if it is given."""
    dialect = as_dialect(ctx.params.get("dialect_name") or WELLING.name)
    return list(writable(ctx.params.get("target") or BMS, dialect))


@command(
    epilog=_EXAMPLES,
    exit_codes=(
        ExitCode.BUS, ExitCode.NO_ANSWER, ExitCode.WRONG_DEVICE, ExitCode.VERIFICATION,
        ExitCode.INTERRUPTED,
    ),
)  # fmt: skip
@argument(
    "item", required=False, shell_complete=values.offers(_items),
    help="what to write; see --list",
)  # fmt: skip
@argument("value", nargs=-1, help="one for each of its fields")
@target_option(required=False)
@option(
    "--list", "is_list", is_flag=True, panel="write", brief=True, help="list the items and stop"
)  # fmt: skip
@option("-y", "--yes", is_flag=True, panel="write", brief=True, help="do not ask")
@option(
    "--manufacturer", is_flag=True, panel="write",
    help="write items that the document reserves for the manufacturer",
)  # fmt: skip
@bus_options()
@recording_options
def write(
    output: Output,
    target: Target | None,
    bus: Bus,
    recorded: RecordingOptions,
    *,
    item: str | None,
    value: tuple[str, ...],
    is_list: bool,
    yes: bool,
    manufacturer: bool,
) -> int:
    """Write an item of a device by its name, and read it back. --list names the items. Firmware is
    not written by this command: see flasher flash.
    """
    target = target or BMS
    if is_list:
        return _list(target, bus.dialect, output)
    if item is None:
        raise UsageError("Name an item to write.", remedy="See flasher write --list.")
    plan = plan_write(item, list(value), target, dialect=bus.dialect, manufacturer=manufacturer)
    if not yes:
        check_can_ask(f"Writing {plan.writable.name} needs a confirmation")
    bus = choose_adapter(bus, output)
    with recorded_connection(recorded, bus, output, target) as (connection, record):
        device = connection.device(target, dialect=bus.dialect, taps=record.taps)
        with stop_on_signal() as stopped:
            check_heard(device, bus, output, cancelled=stopped)
            old = device.read_before_write(plan, cancelled=stopped)
        output.result(f"{target.node.name} {plan.writable.name}")
        output.table(
            (
                (each.name, f"old {'unknown' if each.old is None else repr(each.old)}",
                 f"new {each.new!r}")
                for each in field_changes(plan, old)
            ),
            indent=2,
        )  # fmt: skip
        node = target.node.name
        if not yes and not agrees(
            f"Write {plan.writable.name} to the {node}?",
            interrupted=f"nothing was written to the {node}, and nothing was sent to it but the "
            "question for the old value.",
        ):
            output.progress("nothing was written")
            return output.document(
                NotWrittenDocument(written=False), exit_code=ExitCode.INTERRUPTED
            )
        with stop_on_signal(lambda: output.error_line("the write ends first ...")):
            written = device.write_planned(plan, old)
        error = written.error()
        if error is not None:
            record.failed(error)
    if error is not None:
        return output.failure(error, _document(written))
    output.result("written: confirmed by the device, read back right")
    return output.document(_document(written))


def _document(written: WriteResult) -> WrittenDocument:
    return WrittenDocument(
        target=written.plan.target.name,
        item=written.plan.writable.name,
        confirmed=written.is_confirmed,
        fields={each.name.replace(" ", "_"): each for each in written.changes},
    )


def _list(target: Target, dialect: Dialect, output: Output) -> int:
    items = writable(target, dialect)
    output.table(
        (
            name,
            " ".join(label(n, codec).upper().replace(" ", "_") for n, codec in entry.fields),
            "(manufacturer only)" if entry.item.manufacturer_only else "",
        )
        for name, entry in items.items()
    )
    if not items:
        output.result(f"The documents give no writable item of the {target.node.name}.")
    document = {
        name: WritableItem(
            fields=[field for field, _ in entry.fields],
            manufacturer_only=entry.item.manufacturer_only,
        )
        for name, entry in items.items()
    }
    return output.document(WritableDocument(items=document))
