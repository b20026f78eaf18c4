"""`flasher info`: identity, versions, state, faults, production and history of a device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.cli.documents import FieldValue, HeardDocument, content_document
from flasher.cli.framework import command
from flasher.cli.look.content import content_lines, heard_document, heard_lines, rows_lines
from flasher.cli.options import Bus, bus_options, target_option
from flasher.cli.output import Output
from flasher.cli.recording import RecordingOptions, recorded_device, recording_options
from flasher.errors import ErrorCode, ExitCode, FlasherError, NoAnswerError
from flasher.procedures import INFO_LISTEN_ONLY_S, DeviceInfo, in_bootloader_error
from flasher.protocol.spec import Target

_EXAMPLES: Final = """\
examples:
  flasher info -t bms --mock
  flasher info -t bms -i socketcan -c can0
  flasher info -t bms -i socketcan -c can0 --json > record.json
  flasher info -t wmc -i socketcan -c can0       has no queries: shows what it sends

Missing answers are shown as such: an older device does not know every question.
"""


@dataclass(frozen=True)
class InfoDocument:
    """Identity, versions, state and history of a device."""

    target: str
    dialect: str
    can_be_asked: bool
    """False if the documents have no query for the device."""
    items: dict[str, dict[str, FieldValue] | None]
    """Items with their fields; null for one that was not answered."""
    unanswered: dict[str, str]
    """Reason for each null item."""
    faults: FieldValue
    heard: HeardDocument | None
    two_devices: str | None = None
    """Evidence of a second device, such as an answer that came twice."""


DOCUMENTS: Final = (InfoDocument,)


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.BUS, ExitCode.NO_ANSWER, ExitCode.INTERRUPTED))
@target_option()
@bus_options()
@recording_options
def info(output: Output, target: Target, bus: Bus, recorded: RecordingOptions) -> int:
    """Ask one device everything that the documents let a tool ask (identity, versions, state,
    history), and show the answers with what it sends by itself. Nothing is written, and nothing is
    reset.
    """
    with recorded_device(recorded, bus, output, target) as (device, record):
        output.progress(f"asking the {target.node.name} on {device.connection.name} ...")
        found = device.identify()
        error: FlasherError | None
        if found.is_there:
            error = no_application_error(found)
        else:
            connection = device.connection
            error = connection.link.health().error(connection.name) or silence_error(found)
        if error is not None:
            record.failed(error)
    if error is not None:
        return output.failure(error, info_document(found))
    output.results(_lines(found))
    return output.document(info_document(found))


def no_application_error(found: DeviceInfo) -> NoAnswerError | None:
    """Create the error for a device that answers nothing, because its bootloader announces itself;
    None for any other.
    """
    heard = found.survey.heard[found.target.node]
    if not heard.boot_version or not found.readings or any(each.answer for each in found.readings):
        return None
    return in_bootloader_error(found.target, heard.boot_version)


def silence_error(found: DeviceInfo) -> NoAnswerError:
    """Create the error for a device that did not answer."""
    node = found.target.node.name
    if found.readings:
        return NoAnswerError(
            f"The {node} answered nothing and sent nothing.",
            cause="it is off, asleep or not connected, or the bit rate or dialect is wrong",
            remedy="Wake it with its key; list the devices on the bus with flasher scan.",
            code=ErrorCode.NOBODY_HEARD,
        )
    return NoAnswerError(
        f"The {node} sent nothing in {INFO_LISTEN_ONLY_S:g} s, and the documents give no"
        " query for it.",
        cause="it is off, or silent: it sends by itself only now and then",
        remedy="Try again while it is switched on; flasher scan lists all devices.",
        code=ErrorCode.NOBODY_HEARD,
    )


def _lines(found: DeviceInfo) -> list[str]:
    node = found.target.node.name
    lines = [f"{node}, {found.dialect.name} dialect"]
    if not found.readings:
        lines.append("The documents give no query for it; this is what it sent by itself:")
        lines += heard_lines(found.survey.heard[found.target.node], contents=True)
        if found.survey.faults:
            lines += ["", "faults of the battery", *content_lines(found.survey.faults)]
        return lines
    for reading in found.readings:
        if reading.answer is not None:
            lines += ["", reading.title, *content_lines(reading.answer)]
    faults = found.survey.faults
    none_heard = rows_lines([("faults", found.no_faults)])
    lines += ["", "faults", *(content_lines(faults) if faults else none_heard)]
    missing = [reading for reading in found.readings if reading.answer is None]
    if missing:
        lines += ["", "not answered"]
        lines += rows_lines([(reading.title, reading.why) for reading in missing])
    heard = found.survey.heard[found.target.node]
    if heard.boot_version:
        lines += ["", f"its bootloader sent announcements meanwhile: {heard.boot_version}"]
    if heard.damaged:
        lines += ["", f"bytes from it outside any message: {heard.damaged} times"]
    return lines


def info_document(found: DeviceInfo) -> InfoDocument:
    faults = found.survey.faults
    heard = found.survey.heard.get(found.target.node)
    return InfoDocument(
        target=found.target.name,
        dialect=found.dialect.name,
        can_be_asked=bool(found.readings),
        items={
            reading.name: content_document(reading.answer) if reading.answer else None
            for reading in found.readings
        },
        unanswered={
            reading.name: reading.why for reading in found.readings if reading.answer is None
        },
        faults=content_document(faults)["faults"] if faults else [],
        heard=heard_document(heard) if heard else None,
        two_devices=found.survey.duplicates.evidence or None,
    )
