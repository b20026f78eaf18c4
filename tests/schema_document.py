"""The JSON Schema of everything that `--json` prints, drawn from the types themselves.

    python -m tests.schema_document

writes docs/reference/schema.json anew; a test holds it against the code.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from flasher.cli.schema import build

SCHEMA: Final = Path(__file__).parents[1] / "docs" / "reference" / "schema.json"


def schema_document() -> str:
    """docs/reference/schema.json."""
    return json.dumps(build(), indent=1) + "\n"


if __name__ == "__main__":
    SCHEMA.parent.mkdir(exist_ok=True)
    SCHEMA.write_text(schema_document(), encoding="utf-8")
