"""The table of all keys of a conformance profile in docs/how-to/conformance.md.

    python -m tests.conformance.profile_table

draws it anew; a test holds it against the code.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from flasher.conformance.profile import profile_keys

GUIDE: Final = Path(__file__).parents[2] / "docs" / "how-to" / "conformance.md"
BEGIN: Final = "<!-- keys: python -m tests.conformance.profile_table -->\n"
END: Final = "<!-- end of keys -->"


def table() -> str:
    """The rows of all keys."""
    rows = ["| key | default | allowed | meaning |", "|---|---|---|---|"]
    rows += [
        f"| `{key.path}` | {key.default} | {key.allowed} | {key.text} |"
        for key in profile_keys().values()
    ]
    return "\n".join(rows) + "\n"


def with_table(guide: str) -> str:
    """The guide with the table as it should be."""
    before, _, rest = guide.partition(BEGIN)
    return before + BEGIN + table() + END + rest.partition(END)[2]


if __name__ == "__main__":
    GUIDE.write_text(with_table(GUIDE.read_text(encoding="utf-8")), encoding="utf-8")
