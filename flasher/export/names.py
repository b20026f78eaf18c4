"""Value names shared by all exports.

`running_information.voltage_mv` is the filter `welling.running_information.voltage_mv` in
Wireshark, a column and a signal elsewhere.
"""

from __future__ import annotations

import re
from typing import Final

_NO_WORD: Final = re.compile(r"[^a-z0-9]+")


def key(title: str) -> str:
    """Convert a message title or flag name to a part of a value name."""
    return _NO_WORD.sub("_", title.lower()).strip("_")
