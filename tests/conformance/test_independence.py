"""The import contract that keeps the suite independent lists every module that it must."""

from __future__ import annotations

import tomllib
from pathlib import Path

import flasher.conformance

_PACKAGE = Path(flasher.conformance.__file__).parent
_EDGES = {"mock", "simulated", "real"}
"""Modules that depend on the rest of flasher."""
_REPORTING = {
    *("trace_excerpt", "diff", "html_report", "reports"),
    *("bench_options", "plugin", "summary_page", "side_by_side", "matrix", "parallel", "replay"),
}
"""Modules that open a bench, send what was recorded or report a run, but neither make nor judge
bytes."""


def test_every_module_but_the_edges_is_under_the_contract() -> None:
    project = tomllib.loads((_PACKAGE.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    (contract,) = (
        one for one in contracts if "flasher.conformance.wire" in one.get("source_modules", ())
    )
    named = {name.removeprefix("flasher.conformance.") for name in contract["source_modules"]}
    found = {path.stem for path in _PACKAGE.glob("*.py")} | {"cases"}
    assert found - {"__init__"} - named <= _EDGES | _REPORTING
    assert not named & (_EDGES | _REPORTING)
    assert {"flasher.protocol", "flasher.host", "flasher.image", "flasher.mock"} <= set(
        contract["forbidden_modules"]
    )
    assert "allow_indirect_imports" not in contract
