"""Which targets an image names by itself: texts that a firmware carries about its own device.

Only strong evidence counts, since a wrong guess would refuse a good image: the name of a device
right beside a firmware version, or the whole text of an update command.
"""

from __future__ import annotations

import re
from typing import Final

from flasher.protocol.spec import TARGETS, Target
from flasher.protocol.text import firmware_version_spans

NEIGHBOURHOOD_SIZE: Final = 64
"""In bytes, before and behind a firmware version: a name in there belongs to it."""


def _whole_words(texts: dict[str, Target]) -> re.Pattern[bytes]:
    """Finds each of these texts where no letter, digit or underscore touches it."""
    choice = "|".join(map(re.escape, texts)).encode("ascii")
    return re.compile(rb"(?<![A-Za-z0-9_])(?:" + choice + rb")(?![A-Za-z0-9_])")


_NAMES: Final = {
    name: target for target in TARGETS.values() for name in (target.node.name, target.boot_name)
}
_UPDATE_TEXTS: Final = {target.update_text: target for target in TARGETS.values()}
_NAME: Final = _whole_words(_NAMES)
_UPDATE_TEXT: Final = _whole_words(_UPDATE_TEXTS)


def named_targets(data: bytes) -> frozenset[Target]:
    """The targets that an image names; empty when it names none, several for mixed texts."""
    found = {_UPDATE_TEXTS[match[0].decode("ascii")] for match in _UPDATE_TEXT.finditer(data)}
    for start, end in firmware_version_spans(data):
        # The version itself ends a word: in a packed structure nothing else separates them.
        before = _NAME.finditer(data, max(0, start - NEIGHBOURHOOD_SIZE), start)
        behind = _NAME.finditer(data[end : end + NEIGHBOURHOOD_SIZE + 1])
        found |= {_NAMES[match[0].decode("ascii")] for match in before}
        found |= {
            _NAMES[match[0].decode("ascii")]
            for match in behind
            if match.end() <= NEIGHBOURHOOD_SIZE
        }
    return frozenset(found)
