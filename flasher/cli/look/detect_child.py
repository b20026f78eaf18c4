"""The process that asks python-can's back ends what is plugged in: `python -m ... NAME...`.

Vendors' libraries hang, print and crash: they do it here, and `detect`, beside this module, ends
it. Every back end is asked in a thread of its own and its answer is said at once.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Final

import can

from flasher.cli.look.detect import MARK

_LIFE_S: Final = 30.0
"""A process whose parent was killed ends itself after this."""


def main(names: Sequence[str]) -> None:
    """Ask these interfaces and say what they answer, a line each."""
    threads = [threading.Thread(target=_ask, args=(name,), daemon=True) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _ask(name: str) -> None:
    answer: dict[str, Any] = {"interface": name, "channels": [], "error": ""}
    try:
        answer["channels"] = [_simple(config) for config in can.detect_available_configs(name)]
    except BaseException as error:  # noqa: BLE001  whatever a vendor's library does
        answer["error"] = f"{type(error).__name__}: {error}"
    sys.stdout.write(f"{MARK}{json.dumps(answer)}\n")
    sys.stdout.flush()


def _simple(config: Mapping[str, Any]) -> dict[str, Any]:
    """What JSON holds of a configuration: some have objects of their library in it."""
    return {
        key: value
        for key, value in config.items()
        if isinstance(value, str | int | float) and key != "interface"
    }


if __name__ == "__main__":
    watchdog = threading.Timer(_LIFE_S, os._exit, (1,))
    watchdog.daemon = True
    watchdog.start()
    main(sys.argv[1:])
