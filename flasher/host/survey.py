"""Listening to everything that is on the bus, and asking a little: an engine.

It hears for a while without sending, then asks its questions one after the other, and keeps what it
heard of every sender meanwhile. It says nothing about nodes that it did not hear: a device that is
on may have nothing to say.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from flasher.host.query import Queries, Query, Request
from flasher.protocol import catalogue, messages
from flasher.protocol.contents import Fault, Faults
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.spec import MOTINOVA, WELLING, Command, Dialect, Node, can_id
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Damage, Message, Reassembler

_SENDERS: Final = {can_id(node, to): node for node in Node for to in (None, *Node)}
"""Who sends under each CAN id of the documents."""
_UPGRADE: Final = {int(command): command.name.lower().replace("_", " ") for command in Command}
_GIVE_UP_AFTER: Final = 3
"""Questions without an answer after which a device that was never heard is asked no more."""


@dataclass
class Heard:
    """What was heard of one node."""

    node: Node
    frames: int = 0
    messages: Counter[str] = field(default_factory=Counter)
    """How often each message came, by its title with id and command."""
    last: dict[str, Content] = field(default_factory=dict)
    """The last content of each, where the documents describe it."""
    damaged: int = 0
    """Stretches of bytes that made no message."""
    boot_version: str = ""
    """What its bootloader announced, escaped; empty when it did not."""
    not_in_dialect: set[str] = field(default_factory=set)
    """Titles of messages that the dialect which was asked for does not have."""


class Survey:
    """Hears for `listen_s`, then asks `requests`, unless another tool was heard: a question in the
    midst of its upgrade would look like a second tool to it. An engine; `heard` is there at any
    time.
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
        self.heard: dict[Node, Heard] = {}
        self._faults: Faults | None = None
        self.foreign_frames = 0
        """Frames under ids that the documents do not give."""
        self.cancelled = False
        self.other_tool_heard = False
        """Somebody else spoke as CDL while it listened, so that nothing was asked."""
        self._listen_s = listen_s
        self._dialect = dialect
        self._timings = timings
        self._reassemblers: dict[int, Reassembler] = {}
        self._offered: Frame | None = None
        self._own: Counter[Frame] = Counter()
        """Frames of ours that may still come back: some adapters hear themselves."""
        self._listen_until: float | None = None
        self._began = False
        self._queries = Queries(
            self._while_worth_it(requests), bitrate_bps=bitrate_bps, timings=timings
        )

    @property
    def queries(self) -> Sequence[Query]:
        """The questions that were asked, in order."""
        was_asked = self._has_listened and not self.other_tool_heard
        return self._queries.queries if was_asked else ()

    @property
    def faults(self) -> Faults | None:
        """All faults that the BMS reported, also those that it did not report last; None when it
        reported none.
        """
        return self._faults

    def guess_dialect(self) -> tuple[Dialect | None, str]:
        """The dialect that the traffic speaks, and why; None when nothing tells."""
        if Node.HMI in self.heard:
            return MOTINOVA, "a display unit (HMI) sends, which the other dialect does not have"
        for heard in self.heard.values():
            if heard.boot_version:
                return WELLING, "a bootloader announces itself, and the other dialect has none"
        wmc = self.heard.get(Node.WMC)
        for item in catalogue.ITEMS:
            if wmc and item.dialects == (WELLING,) and _title(item) in wmc.messages:
                return WELLING, f"the WMC sent {item.title!r}, which the other dialect has not"
        return None, "what was heard is the same in both dialects"

    # -- the engine interface ---------------------------------------------------------------------

    @property
    def done(self) -> bool:
        """True when it has listened and every question is over."""
        return self.cancelled or (self._has_listened and self._queries.done)

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        self._hear(frame, now)
        if self._has_listened:
            self._queries.receive(frame, now)

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        if not self._began:
            self._began = True
            self._listen_until = now + self._listen_s
        for reassembler in list(self._reassemblers.values()):
            for found in reassembler.tick(now):
                self._take(reassembler.can_id, found)
        if self._listen_until is not None and now >= self._listen_until:
            self._listen_until = None
            self.other_tool_heard = Node.CDL in self.heard
            if self.other_tool_heard:
                self._queries.cancel(now)
        if self._has_listened:
            self._queries.tick(now)

    def deadline(self) -> float | None:
        """When `tick` or `next_frame` is wanted next; at once before the beginning."""
        if self.done:
            return None
        if not self._began:
            return 0.0
        times = [r.deadline() for r in self._reassemblers.values()]
        times.append(self._queries.deadline() if self._has_listened else self._listen_until)
        return min((time for time in times if time is not None), default=None)

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send; nothing while it listens."""
        self._offered = self._queries.next_frame(now) if self._has_listened else None
        return self._offered

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted the frame."""
        if self._offered is not None:
            self._own[self._offered] += 1
        self._queries.frame_sent(now)

    def cancel(self, now: float) -> None:
        """End at the next message boundary."""
        self._queries.cancel(now)
        self.cancelled = not self._has_listened or self._queries.cancelled
        self._began, self._listen_until = True, None

    def take_events(self) -> Sequence[object]:
        """What happened since the last call."""
        return self._queries.take_events() if self._has_listened else ()

    # -- hearing ----------------------------------------------------------------------------------

    @property
    def _has_listened(self) -> bool:
        return self._began and self._listen_until is None

    def _while_worth_it(self, requests: Iterable[Request]) -> Iterable[Request]:
        """The questions, until a device is silent to so many that it seems not to be there."""
        for count, request in enumerate(requests):
            node = request.item.receiver
            if count >= _GIVE_UP_AFTER and node is not None and node not in self.heard:
                return
            yield request

    def _hear(self, frame: Frame, now: float) -> None:
        if self._own.get(frame):
            self._own[frame] -= 1
            return
        node = _SENDERS.get(frame.can_id)
        if node is None or not frame.is_payload:
            self.foreign_frames += 1
            return
        heard = self.heard.setdefault(node, Heard(node))
        heard.frames += 1
        reassembler = self._reassemblers.get(frame.can_id)
        if reassembler is None:
            reassembler = Reassembler(frame.can_id, self._timings.inter_frame_timeout_s)
            self._reassemblers[frame.can_id] = reassembler
        for found in reassembler.feed(frame.data, now):
            self._take(frame.can_id, found)

    def _take(self, from_id: int, found: Message | Damage) -> None:
        heard = self.heard[_SENDERS[from_id]]
        if isinstance(found, Damage):
            heard.damaged += 1
            return
        decoded = catalogue.decode(found, self._dialect) or catalogue.decode(found)
        if decoded is not None:
            title = _title(decoded.item)
            heard.last[title] = decoded.content
            if isinstance(decoded.content, Faults) and heard.node is Node.BMS:
                before = Fault(0) if self._faults is None else self._faults.faults
                self._faults = Faults(before | decoded.content.faults)
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
