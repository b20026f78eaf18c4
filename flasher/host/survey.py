"""Bus survey for `scan`: listens to all traffic, then queries the battery; an engine.

The survey records the traffic of every node. A silent node is not reported as absent: it may have
nothing to send.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from flasher.host.query import Query, Request, ask_all, count_answers, report_two_devices
from flasher.host.runner import Runner, Signal, Stage, StageInput, filtered
from flasher.protocol import catalogue, messages
from flasher.protocol.contents import BatteryFault, Faults
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.spec import MOTINOVA, WELLING, Command, Dialect, Node, can_id
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Damage, Message

_SENDERS: Final = {can_id(node, to): node for node in Node for to in (None, *Node)}
"""Sending node of each documented CAN id."""
_UPGRADE: Final = {int(command): command.name.lower().replace("_", " ") for command in Command}
_GIVE_UP_AFTER: Final = 3
"""Number of unanswered queries after which a silent device is not queried any more."""


@dataclass
class NodeTraffic:
    """Traffic of one node."""

    node: Node
    frames: int = 0
    messages: Counter[str] = field(default_factory=Counter)
    """Number of messages by title, which contains id and command."""
    last: dict[str, Content] = field(default_factory=dict)
    """Last content of each documented message."""
    damaged: int = 0
    """Number of damaged stretches of bytes."""
    boot_version: str = ""
    """Name and version in its boot versions, escaped; may be empty."""
    not_in_dialect: set[str] = field(default_factory=set)
    """Titles of messages that the chosen dialect lacks."""


class Survey(Runner[None]):
    """Listens for `listen_s` seconds, then sends `requests`, unless another tool was detected,
    whose upgrade they would disturb. `heard` is valid at any time.
    """

    def __init__(
        self,
        requests: Iterable[Request] = (),
        *,
        listen_s: float,
        bitrate_bps: int,
        dialect: Dialect,
        timings: Timings = DEFAULT_TIMINGS,
    ) -> None:
        self.heard: dict[Node, NodeTraffic] = {}
        self.queries: list[Query] = []
        """Queries sent, in order."""
        self.foreign_frames = 0
        """Number of frames with undocumented CAN ids."""
        self.cancelled = False
        """The survey was cancelled while listening or during a query."""
        self.other_tool_heard = False
        """Another tool sent as CDL, so that no query was sent."""
        self.faults: Faults | None = None
        """Fault flags that the BMS sent during the survey; None if it sent none."""
        self._dialect = dialect
        self._ids: set[int] = set()
        super().__init__(
            lambda run: self._listen_and_ask(run, listen_s, requests),
            bitrate_bps=bitrate_bps,
            timings=timings,
        )
        self.watch = self._count

    def guess_dialect(self) -> tuple[Dialect | None, str]:
        """Guess the dialect from the traffic; return it (None if unclear) and the reason."""
        if Node.HMI in self.heard:
            return MOTINOVA, "a display unit (HMI) sends, which the other dialect lacks"
        for heard in self.heard.values():
            if heard.boot_version:
                return WELLING, "a bootloader announces itself, which the other dialect lacks"
        wmc = self.heard.get(Node.WMC)
        for item in catalogue.ITEMS:
            if wmc and item.dialects == (WELLING,) and _title(item) in wmc.messages:
                return WELLING, f"the WMC sent {item.title!r}, which the other dialect lacks"
        return None, "the received traffic is the same in both dialects"

    # -- listening and asking ---------------------------------------------------------------------

    def _listen_and_ask(
        self, run: Runner[None], listen_s: float, requests: Iterable[Request]
    ) -> Stage[None]:
        self.cancelled = yield from run.listen_for(listen_s, self._take)
        if self.cancelled:
            return
        self.other_tool_heard = Node.CDL in self.heard
        if not self.other_tool_heard:
            asking = ask_all(run, self._while_answered(requests), self.queries)
            yield from filtered(asking, self._take)
            yield from filtered(count_answers(run, self.queries), self._take)
            self.cancelled = any(query.cancelled for query in self.queries)
        report_two_devices(run)

    def _while_answered(self, requests: Iterable[Request]) -> Iterable[Request]:
        """Yield the requests until a device has left so many unanswered that it seems absent."""
        for count, request in enumerate(requests):
            node = request.item.receiver
            if count >= _GIVE_UP_AFTER and node is not None and node not in self.heard:
                return
            yield request

    def _count(self, frame: Frame) -> bool:
        """Count a frame for its sender, and receive messages with its CAN id from now on."""
        if frame.is_echo:
            return True
        node = _SENDERS.get(frame.can_id)
        if node is None or not frame.is_payload:
            self.foreign_frames += 1
            return True
        heard = self.heard.setdefault(node, NodeTraffic(node))
        heard.frames += 1
        if frame.can_id not in self._ids:
            self._ids.add(frame.can_id)
            self.also_listen_on(frame.can_id)
        return False

    def _take(self, came: StageInput) -> StageInput:
        if not isinstance(came, Signal) and came.can_id in self._ids:
            self._note(self.heard[_SENDERS[came.can_id]], came)
        return came

    def _note(self, heard: NodeTraffic, found: Message | Damage) -> None:
        if isinstance(found, Damage):
            heard.damaged += 1
            return
        decoded = catalogue.decode(found, self._dialect) or catalogue.decode(found)
        if decoded is not None:
            title = _title(decoded.item)
            heard.last[title] = decoded.content
            if isinstance(decoded.content, Faults) and heard.node is Node.BMS:
                before = BatteryFault(0) if self.faults is None else self.faults.faults
                self.faults = Faults(before | decoded.content.faults)
        elif found.command in _UPGRADE:
            row = messages.decode(found)
            if isinstance(row, messages.BootVersion):
                heard.boot_version = printable(f"{row.name} {row.version}")
            title = f"{found.can_id:03X} {found.command:04X} {_UPGRADE[found.command]}"
        else:
            title = f"{found.can_id:03X} {found.command:04X} (not in the documents)"
        heard.messages[title] += 1
        if not catalogue.has_message(self._dialect, found):
            heard.not_in_dialect.add(title)


def _title(item: catalogue.Item) -> str:
    return f"{item.name} {item.title}"
