"""Imports the modules of the tests as on a computer that has the extra `test` and nothing else:
`python -m tests.collection`. Fails if one of them needs another package for that.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from types import ModuleType
from typing import ClassVar

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def installed_by(name: str, extras: frozenset[str], found: set[tuple[str, str]]) -> set[str]:
    """Return the names of all distributions that one needs with its extras; `found` is filled."""
    needed = {str(canonicalize_name(name))}
    try:
        requirements = map(Requirement, distribution(name).requires or ())
    except PackageNotFoundError:  # for another platform
        return needed
    for requirement in requirements:
        marker = requirement.marker
        if marker and not any(marker.evaluate({"extra": extra}) for extra in extras | {""}):
            continue
        key = (canonicalize_name(requirement.name), ",".join(sorted(requirement.extras)))
        if key not in found:
            found.add(key)
            needed |= installed_by(requirement.name, frozenset(requirement.extras), found)
    return needed


class Without(PathFinder):
    """Finds modules as Python does, but for those of some packages."""

    missing: ClassVar[set[str]] = set()

    @classmethod
    def find_spec(
        cls,
        fullname: str,
        path: Sequence[str] | None = None,
        target: ModuleType | None = None,
    ) -> ModuleSpec | None:
        if fullname.partition(".")[0] in cls.missing:
            return None
        return super().find_spec(fullname, path, target)


def main() -> int:
    known = installed_by("welling-flasher", frozenset({"test"}), set()) | {"pip", "setuptools"}
    Without.missing = {
        module
        for module, names in packages_distributions().items()
        if known.isdisjoint(map(canonicalize_name, names))
    }
    sys.meta_path[sys.meta_path.index(PathFinder)] = Without
    # Without their tests, of which there are thousands.
    modules = ["--collect-only", "--override-ini=python_functions=none", "--numprocesses=0"]
    found = pytest.main([*modules, "--quiet", *sys.argv[1:]])
    return int(found != pytest.ExitCode.NO_TESTS_COLLECTED)


if __name__ == "__main__":
    sys.exit(main())
