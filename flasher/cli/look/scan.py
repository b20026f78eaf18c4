"""`flasher scan`: list the devices on the bus."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

from flasher.bus.bit_rate import BitRate
from flasher.cli.adapters import choose_adapter
from flasher.cli.documents import HeardDocument
from flasher.cli.framework import command
from flasher.cli.look.content import heard_document, heard_lines
from flasher.cli.options import Bus, bus_options, target_option
from flasher.cli.output import Output
from flasher.cli.recording import RecordingOptions, recorded_connection, recording_options
from flasher.cli.stop import stop_on_signal
from flasher.errors import ExitCode
from flasher.host.survey import Survey
from flasher.procedures import SCAN_LISTEN_S, nothing_received_error
from flasher.protocol.spec import BMS, DIALECTS, Dialect, Target

_EXAMPLES: Final = """\
examples:
  flasher scan --mock
  flasher scan -i socketcan -c can0
  flasher scan --dialect motinova -i pcan -c PCAN_USBBUS1      listens at 125 kbit/s

Listens for a second, then asks the BMS, the only device with queries in the documents. A device
that is not listed may still be there: most send only now and then.
"""


@dataclass(frozen=True)
class ScanDocument:
    """Devices on the bus."""

    bitrate_bps: int
    bitrate_source: str
    """Source of the bit rate."""
    bitrate_is_assumed: Literal[True]
    """Frames do not show their bit rate."""
    dialect: str | None
    dialect_because: str
    nodes: dict[str, HeardDocument]
    foreign_frames: int
    """Frames with undocumented CAN ids."""
    two_devices: str | None = None
    """Evidence of a second device of one kind, such as an answer that came twice."""


DOCUMENTS: Final = (ScanDocument,)


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.BUS, ExitCode.NO_ANSWER, ExitCode.INTERRUPTED))
@target_option(required=False)
@bus_options()
@recording_options
def scan(output: Output, target: Target | None, bus: Bus, recorded: RecordingOptions) -> int:
    """List the devices on the bus, and identify its dialect. Sends one round of queries to the
    battery, and nothing else: other bit rates are not tried, since a wrong one disturbs a live bus.
    """
    bus = choose_adapter(bus, output)
    dialect, rate = bus.dialect, bus.bit_rate
    with (
        recorded_connection(recorded, bus, output, target or BMS) as (connection, record),
        stop_on_signal() as stopped,
    ):
        output.progress(f"listening for {SCAN_LISTEN_S:g} s on {connection.name} ...")
        survey = connection.scan(
            dialect, taps=record.taps, cancelled=stopped, on_event=partial(record.warn, output),
        )  # fmt: skip
        error = None if survey.heard else nothing_received_error(survey, rate.bps)
        if error is not None:
            record.failed(error)
    guessed, why = judge_dialect(survey, rate.bps)
    document = ScanDocument(
        bitrate_bps=rate.bps,
        bitrate_source=rate.source,
        bitrate_is_assumed=True,
        dialect=guessed.name if guessed else None,
        dialect_because=why,
        nodes={node.name.lower(): heard_document(h) for node, h in survey.heard.items()},
        foreign_frames=survey.foreign_frames,
        two_devices=survey.duplicates.evidence or None,
    )
    if error is not None:
        return output.failure(error, document)
    output.results(_lines(survey, rate, dialect, guessed, why))
    return output.document(document)


def judge_dialect(survey: Survey, bitrate_bps: int) -> tuple[Dialect | None, str]:
    """Return the dialect and its evidence: the traffic, or else the bit rate in use."""
    guessed, why = survey.guess_dialect()
    if guessed is not None:
        return guessed, why
    if any(heard.messages for heard in survey.heard.values()):
        for dialect in DIALECTS.values():
            if dialect.bitrate_bps == bitrate_bps:
                return dialect, f"by the bit rate alone, which is an assumption; {why}"
    return None, why


def _lines(
    survey: Survey, rate: BitRate, asked: Dialect, guessed: Dialect | None, why: str
) -> list[str]:
    lines = [
        f"bit rate: {rate}; not visible in frames",
        f"dialect:  {guessed.name if guessed else 'unknown'} ({why})",
    ]
    if guessed is not None and guessed is not asked:
        lines.append(f"          it was asked as {asked.name}: use --dialect {guessed.name}")
    for node, heard in sorted(survey.heard.items(), key=lambda pair: pair[0].value):
        unasked = ": nothing was asked" if survey.other_tool_heard else ""
        note = f" (another tool{unasked})" if node.name == "CDL" else ""
        lines += ["", f"{node.name}{note}", *heard_lines(heard)]
    if survey.foreign_frames:
        lines += ["", f"frames under ids of other protocols: {survey.foreign_frames}"]
    return lines
