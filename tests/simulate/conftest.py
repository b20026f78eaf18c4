"""Leaves the tests of clusters out where the extra `cluster` is not installed."""

from __future__ import annotations

import os
from importlib.util import find_spec

from tests.conftest import NO_SKIPS

collect_ignore = []
if find_spec("distributed") is None and not os.environ.get(NO_SKIPS):
    collect_ignore.append("test_cluster.py")
