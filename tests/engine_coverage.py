"""Coverage of the packages of engines by their own tests, measured while the lanes run them: each
process of the tests leaves a file of data beside COVERAGE_FILE. The gate combines them.
"""

from __future__ import annotations

from collections.abc import Generator
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import Final

import coverage
import pytest

ENGINES: Final = ("protocol", "image", "host", "mock")
_TESTS: Final = Path(__file__).parent
_OWN: Final = tuple(_TESTS / name for name in ENGINES)
_VARIANTS: Final = tuple(_TESTS / name / "test_variants.py" for name in ("mock", "conformance"))


class EngineCoverage:
    """A plugin of pytest. Under coverage Python takes twice its time: other tests run without."""

    def __init__(self) -> None:
        folders = [str(_TESTS.parent / "flasher" / name) for name in ENGINES]
        config = _TESTS.parent / "pyproject.toml"
        self._coverage = coverage.Coverage(
            data_suffix=True, config_file=str(config), source=folders
        )
        self._is_measuring = False
        self._measure(True)
        for name, folder in zip(ENGINES, folders, strict=True):
            for module in walk_packages([folder], f"flasher.{name}."):
                import_module(module.name)
        self._measure(False)

    def _measure(self, wanted: bool) -> None:
        if wanted != self._is_measuring:
            (self._coverage.start if wanted else self._coverage.stop)()
            self._is_measuring = wanted

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        path = item.path
        is_own = any(folder in path.parents for folder in _OWN)
        self._measure(path in _VARIANTS or (is_own and item.get_closest_marker("slow") is None))
        return (yield)

    def pytest_sessionfinish(self) -> None:
        self._measure(False)
        self._coverage.save()
