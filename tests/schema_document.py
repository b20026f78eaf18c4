"""The JSON Schema of everything that `--json` prints, drawn from the types themselves.

    python -m tests.schema_document

writes docs/reference/schema.json anew; a test holds it against the code.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from flasher.cli.schema import build

SCHEMA: Final = Path(__file__).parents[1] / "docs" / "reference" / "schema.json"


def schema_document() -> str:
    """docs/reference/schema.json."""
    return json.dumps(build(), indent=1) + "\n"


def mismatches(instance: object, schema: Mapping[str, Any]) -> list[str]:
    """Lists how an instance differs from what its JSON Schema (draft 2020-12) describes."""
    # Importing it builds 38 grammars: 2 s in each process that only collects the tests.
    from jsonschema import Draft202012Validator  # noqa: PLC0415

    return [error.message for error in Draft202012Validator(schema).iter_errors(instance)]


if __name__ == "__main__":
    SCHEMA.parent.mkdir(exist_ok=True)
    SCHEMA.write_text(schema_document(), encoding="utf-8")
