"""Explanations of the recorded bus traces of runs."""

from __future__ import annotations

from dataclasses import replace

from flasher.errors import FlasherError
from flasher.protocol.text import printable
from flasher.station.records.errors import RecordError
from flasher.station.records.files import FileStore
from flasher.station.records.model import AttachmentFile
from flasher.trace.source import explain_path
from flasher.trace.story import Story


def explained(files: FileStore, file: AttachmentFile) -> Story | str:
    """Explain a recorded trace. Returns a text with the reason if that fails."""
    try:
        with files.temporary_copy(file) as path:
            return replace(explain_path(path), source=printable(file.name))
    except RecordError as error:
        return error.what
    except FlasherError as error:
        return f"The trace cannot be explained: {error.cause or error.what}"
    except OSError as error:
        return f"The trace cannot be explained: {error.strerror or error}."
