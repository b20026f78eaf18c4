"""Memory reading with a progress bar, and conversion to Intel HEX."""

from __future__ import annotations

import io

from flasher.api import Device
from flasher.cli.bar import Bar
from flasher.cli.output import Output
from flasher.cli.recording import Recording
from flasher.errors import NoAnswerError
from flasher.events import QueryAnswered
from flasher.host.query import memory_bytes
from flasher.protocol.contents import Memory

MEMORY = "memory"


def read_with_bar(device: Device, start: int, end: int, output: Output, record: Recording) -> bytes:
    """Read memory with a progress bar. Raises UsageError and NoAnswerError."""
    done = 0

    def show(event: object) -> None:
        nonlocal done
        output.event(event)
        record.warn(output, event)
        if isinstance(event, QueryAnswered) and isinstance(event.content, Memory):
            done += len(memory_bytes(event.content))
            bar.move_to(done, end - start)

    with Bar(output, unit="B", unit_scale=True, desc=MEMORY) as bar:
        try:
            return device.read_memory(start, end, on_event=show)
        except NoAnswerError as error:
            error.remedy = f"{error.remedy} No file was written."
            raise


def intel_hex(start: int, data: bytes) -> bytes:
    from intelhex import IntelHex  # noqa: PLC0415  only where it is asked for

    image = IntelHex()
    image.frombytes(data, offset=start)
    text = io.StringIO()
    image.write_hex_file(text)
    return text.getvalue().encode("ascii")
