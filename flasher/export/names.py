"""Value names shared by all exports: `running_information.voltage_mv` is the filter
`welling.running_information.voltage_mv` in Wireshark, a column and a signal elsewhere.
"""

from __future__ import annotations

import re
from typing import Final

_NO_WORD: Final = re.compile(r"[^a-z0-9]+")


def key(title: str) -> str:
    """A message title or the name of a bit as a part of such a name."""
    return _NO_WORD.sub("_", title.lower()).strip("_")
