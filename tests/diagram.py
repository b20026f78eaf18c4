"""The states of the documentation, drawn from the tables themselves.

    python -m tests.diagram

writes them anew, into docs/explanation/upgrade.md and docs/reference/states.md; a test holds both
against the tables.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from enum import Enum
from pathlib import Path
from typing import Final

from flasher.host import table as host
from flasher.host.table import Ending
from flasher.mock import table as device
from flasher.wording import wording

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
# States

Drawn from the tables in the code by `python -m tests.diagram`; a test keeps them so. Left out are
events that are ignored or only reported, and those that are possible in every state: for the host
the overall deadline, the user's cancellation (both end the upgrade) and a second tool (that ends it
too, or leads from every state to *yielding to another tool*; a mere query of it is reported, and no
event of the table), for the device a power cut.
"""

_Arrow = tuple[Enum, Enum, str, Enum | None]
"""From a state, by an event, with the words of an action, to a state; None is the end."""


def host_arrows(*, is_overview: bool = False) -> Iterator[_Arrow]:
    """The arrows of the host's table; an overview has neither bad endings nor a lost adapter."""
    for state, row in host.TABLE.items():
        for event, move in row.items():
            if event.name in _EVERYWHERE or move.action in _QUIET:
                continue
            if is_overview and event is host.UpgradeEvent.LINK_BACK:
                continue
            words = move.action.replace("_", " ")
            for target in move.leads_to or (state,):
                if isinstance(target, host.UpgradeState):
                    yield state, event, words, target
                elif not is_overview or target in _GOOD:
                    yield state, event, f"ends, {wording(target)}", None


def device_arrows() -> Iterator[_Arrow]:
    """The arrows of the device model's table."""
    for state, row in device.TABLE.items():
        for event, move in row.items():
            if event.name not in _EVERYWHERE and move.action not in _QUIET:
                yield state, event, move.action.replace("_", " "), move.state or state


def overview() -> str:
    """A Mermaid state diagram of the host, with one arrow from a state to another."""
    lines = ["```mermaid", "stateDiagram-v2"]
    lines += [f'    state "{state.value}" as {state.name.lower()}' for state in host.UpgradeState]
    lines.append(f"    [*] --> {next(iter(host.UpgradeState)).name.lower()}")
    drawn: dict[tuple[str, str], dict[str, None]] = {}
    for state, event, _words, target in host_arrows(is_overview=True):
        to = "stopping" if target is None else target.name.lower()
        drawn.setdefault((state.name.lower(), to), {})[event.value.replace(":", ",")] = None
    lines += [
        f"    {state} --> {to} : {'<br/>'.join(noted)}" for (state, to), noted in drawn.items()
    ]
    lines += ["    stopping --> done : the last message has left", "    done --> [*]"]
    return "\n".join([*lines, "```", ""])


def _table(arrows: Iterable[_Arrow]) -> Iterator[str]:
    """What each state does at each event, state by state."""
    for state, rows in itertools.groupby(arrows, lambda arrow: arrow[0]):
        yield from (f"### {state.value}", "", "| event | does | leads to |", "|---|---|---|")
        for (event, words), same in itertools.groupby(rows, lambda arrow: arrow[1:3]):
            targets = dict.fromkeys(each[3].value if each[3] else "the end" for each in same)
            yield f"| {event.value} | {words} | {', '.join(targets)} |"
        yield ""


def states_document() -> str:
    """docs/reference/states.md."""
    return "\n".join(
        [
            _INTRODUCTION,
            "## The host: `flasher/host/table.py`\n",
            *_table(host_arrows()),
            "## The device model: `flasher/mock/table.py`\n",
            *_table(device_arrows()),
        ]
    )


def upgrade_document(text: str) -> str:
    """docs/explanation/upgrade.md with its diagram drawn anew."""
    return _MARKED.sub(lambda match: f"{match[1]}{overview()}{match[2]}", text)


if __name__ == "__main__":
    STATES.parent.mkdir(exist_ok=True)
    STATES.write_text(states_document(), encoding="utf-8")
    UPGRADE.write_text(upgrade_document(UPGRADE.read_text(encoding="utf-8")), encoding="utf-8")
