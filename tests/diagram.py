"""The state diagrams of the documentation, drawn from the tables themselves.

    python -m tests.diagram

writes them anew, into docs/explanation/upgrade.md and docs/reference/states.md; a test holds both
against the tables.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from enum import Enum
from pathlib import Path
from typing import Final

from flasher.host import table as host
from flasher.host.table import Ending
from flasher.mock import table as device
from flasher.prose import prose

_ROOT: Final = Path(__file__).parents[1]
UPGRADE: Final = _ROOT / "docs" / "explanation" / "upgrade.md"
STATES: Final = _ROOT / "docs" / "reference" / "states.md"
_MARKED: Final = re.compile(
    r"(<!-- state diagram -->\n).*?(<!-- end of state diagram -->)", re.DOTALL
)

_QUIET: Final = {"ignore", "report"}
_EVERYWHERE: Final = {"CANCEL", "OUT_OF_TIME", "POWER_CUT", "SECOND_TOOL", "UNEXPECTED"}
_GOOD: Final = {Ending.COMPLETED, Ending.CONFIRMED_BY_VERSION}

_INTRODUCTION: Final = """\
# State diagrams

Drawn from the tables in the code by `python -m tests.diagram`; a test keeps them so. Each arrow is
*event / action*. Left out are events that are ignored or only reported, and those that are possible
in every state: for the host the overall deadline, the user's cancellation and a second tool (all
end the upgrade; a mere query of it is reported, and no event of the table), for the device a power
cut.
"""

_Arrow = tuple[Enum, Enum, str, Enum | None]
"""From a state, by an event, with the words of an action, to a state; None is the end."""


def host_arrows(*, overview: bool = False) -> Iterator[_Arrow]:
    """The arrows of the host's table; an overview has neither bad endings nor a lost adapter."""
    for state, row in host.TABLE.items():
        for event, move in row.items():
            if event.name in _EVERYWHERE or move.action in _QUIET:
                continue
            if overview and event is host.Event.LINK_BACK:
                continue
            words = move.action.replace("_", " ")
            for target in move.leads_to or (state,):
                if isinstance(target, host.State):
                    yield state, event, words, target
                elif not overview or target in _GOOD:
                    yield state, event, f"ends, {prose(target)}", None


def device_arrows() -> Iterator[_Arrow]:
    """The arrows of the device model's table."""
    for state, row in device.TABLE.items():
        for event, move in row.items():
            if event.name not in _EVERYWHERE and move.action not in _QUIET:
                yield state, event, move.action.replace("_", " "), move.state or state


def diagram(arrows: Iterable[_Arrow], states: type[Enum], *, overview: bool = False) -> str:
    """A Mermaid state diagram. An overview leaves the actions out."""
    lines = ["```mermaid", "stateDiagram-v2"]
    lines += [f'    state "{state.value}" as {state.name.lower()}' for state in states]
    lines.append(f"    [*] --> {next(iter(states)).name.lower()}")
    drawn: dict[str, None] = {}
    for state, event, words, target in arrows:
        label = event.value if overview else f"{event.value} / {words}"
        to = "stopping" if target is None else target.name.lower()
        drawn[f"    {state.name.lower()} --> {to} : {label.replace(':', ',')}"] = None
    lines += drawn
    if states is host.State:
        lines += ["    stopping --> done : the last message has left", "    done --> [*]"]
    return "\n".join([*lines, "```", ""])


def states_document() -> str:
    """docs/reference/states.md."""
    return "\n".join(
        [
            _INTRODUCTION,
            "## The host: `flasher/host/table.py`\n",
            diagram(host_arrows(), host.State),
            "## The device model: `flasher/mock/table.py`\n",
            diagram(device_arrows(), device.State),
        ]
    )


def upgrade_document(text: str) -> str:
    """docs/explanation/upgrade.md with its diagram drawn anew."""
    overview = diagram(host_arrows(overview=True), host.State, overview=True)
    return _MARKED.sub(lambda match: f"{match[1]}{overview}{match[2]}", text)


if __name__ == "__main__":
    STATES.parent.mkdir(exist_ok=True)
    STATES.write_text(states_document(), encoding="utf-8")
    UPGRADE.write_text(upgrade_document(UPGRADE.read_text(encoding="utf-8")), encoding="utf-8")
