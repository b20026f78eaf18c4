"""JSON report of a run: output of `--json` and `--json-report`, input of `diff`.

Only `started_at`, keys that end in `_s` and histograms depend on the clock; otherwise two runs with
the same seed are equal. Frames are in separate trace files.
"""

from __future__ import annotations

import json
from functools import cache
from typing import TYPE_CHECKING, Any

from flasher.conformance.results import RunReport

if TYPE_CHECKING:
    from pydantic import TypeAdapter


@cache
def adapter() -> TypeAdapter[RunReport]:
    """Reads and writes reports. Raises pydantic.ValidationError for invalid data."""
    from pydantic import TypeAdapter  # noqa: PLC0415  slow

    return TypeAdapter(RunReport)


def to_json(report: RunReport) -> dict[str, Any]:
    """Convert the report to plain JSON types."""
    plain: dict[str, Any] = adapter().dump_python(report, mode="json", by_alias=True)
    return plain


def to_bytes(report: RunReport) -> bytes:
    """Encode the report with one key per line, so that files can be compared as text."""
    return (json.dumps(to_json(report), indent=1) + "\n").encode("ascii")
