"""The JSON Schema of everything that `--json` prints, drawn from the types themselves.

    python -m tests.schema_document

writes docs/reference/schema.json anew; a test holds it against the code.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tests.schema import build

if TYPE_CHECKING:
    from jsonschema import Draft202012Validator

SCHEMA: Final = Path(__file__).parents[1] / "docs" / "reference" / "schema.json"


def schema_document() -> str:
    """docs/reference/schema.json."""
    return json.dumps(build(), indent=1) + "\n"


def validator(schema: Mapping[str, Any]) -> Draft202012Validator:
    """Makes what checks documents by a JSON Schema (draft 2020-12), and a schema by its own."""
    # Formats are not checked; where this module is installed, it takes 2 s to build its own.
    sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
    from jsonschema import Draft202012Validator  # noqa: PLC0415  not where tests are handed out

    return Draft202012Validator(schema)


def mismatches(instance: object, schema: Mapping[str, Any]) -> list[str]:
    """Lists how an instance differs from what its JSON Schema describes."""
    return [error.message for error in validator(schema).iter_errors(instance)]


if __name__ == "__main__":
    SCHEMA.parent.mkdir(exist_ok=True)
    SCHEMA.write_text(schema_document(), encoding="utf-8")
