"""The state diagrams of the documentation, drawn from the tables themselves.

    python -m tests.diagram

writes them anew, into docs/upgrade.md and docs/states.md; a test holds both against the tables.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any, Final

from flasher.host import table as host
from flasher.host.table import Ending
from flasher.mock import table as device

_ROOT: Final = Path(__file__).parents[1]
UPGRADE: Final = _ROOT / "docs" / "upgrade.md"
STATES: Final = _ROOT / "docs" / "states.md"
_MARKED: Final = re.compile(
    r"(<!-- state diagram -->\n).*?(<!-- end of state diagram -->)", re.DOTALL
)

_QUIET: Final = {"NOTHING", "REPORT", "IMPOSSIBLE"}
_EVERYWHERE: Final = {"CANCEL", "OUT_OF_TIME", "POWER_CUT", "SECOND_TOOL", "UNEXPECTED"}
_NOT_IN_THE_OVERVIEW: Final = {"LINK_BACK", "LINK_BACK_UPDATING"}
_GOOD: Final = {Ending.COMPLETED, Ending.CONFIRMED_BY_VERSION}

_INTRODUCTION: Final = """\
# State diagrams

Drawn from the tables in the code by `python -m tests.diagram`; a test keeps them so. Each arrow is
*event / action*. Left out are events that are ignored or only reported, and those that are possible
in every state: for the host the overall deadline, the user's cancellation and a second tool (all
end the upgrade; a mere query of it is reported, and no event of the table), for the device a power
cut.
"""

_Table = Mapping[Any, Mapping[Any, Any]]


def diagram(table: _Table, first: Enum, *, overview: bool = False) -> str:
    """A Mermaid state diagram. An overview leaves the bad endings and the actions out."""
    lines = ["```mermaid", "stateDiagram-v2"]
    lines += [f'    state "{state.value}" as {state.name.lower()}' for state in table]
    lines.append(f"    [*] --> {first.name.lower()}")
    for state, row in table.items():
        for event, move in row.items():
            is_bad = isinstance(move.action, Ending) and move.action not in _GOOD
            if event.name in _EVERYWHERE or move.action.name in _QUIET:
                continue
            if overview and (is_bad or event.name in _NOT_IN_THE_OVERVIEW):
                continue
            label = event.value if overview else f"{event.value} / {_action(move.action)}"
            arrow = f"{state.name.lower()} --> {move.state.name.lower()}"
            lines.append(f"    {arrow} : {label.replace(':', ',')}")
    if isinstance(first, host.State):
        lines += ["    stopping --> done : the last message has left", "    done --> [*]"]
    return "\n".join([*lines, "```", ""])


def _action(action: Enum) -> str:
    return f"ends, {action.value}" if isinstance(action, Ending) else str(action.value)


def states_document() -> str:
    """docs/states.md."""
    return "\n".join(
        [
            _INTRODUCTION,
            "## The host: `flasher/host/table.py`\n",
            diagram(host.TABLE, host.State.RESETTING),
            "## The device model: `flasher/mock/table.py`\n",
            diagram(device.TABLE, device.State.APPLICATION),
        ]
    )


def upgrade_document(text: str) -> str:
    """docs/upgrade.md with its diagram drawn anew."""
    overview = diagram(host.TABLE, host.State.RESETTING, overview=True)
    return _MARKED.sub(lambda match: f"{match[1]}{overview}{match[2]}", text)


if __name__ == "__main__":
    STATES.parent.mkdir(exist_ok=True)
    STATES.write_text(states_document(), encoding="utf-8")
    UPGRADE.write_text(upgrade_document(UPGRADE.read_text(encoding="utf-8")), encoding="utf-8")
