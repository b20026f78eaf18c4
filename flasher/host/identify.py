"""Identification: asks a device for its identity and state before anything is written to it.

It asks for the version information (if the target has a query for it) and, for the battery, the
running information. A device in its bootloader announces itself instead of answering: that ends the
queries at once, so that the announcement can be answered within its window. Before the first query
it listens briefly for another tool (`guard`); after the last one it waits for answers of a second
device (`duplicates`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from flasher.events import Phase, PhaseEntered
from flasher.host.identity import DeviceAnswers
from flasher.host.options import UpgradeOptions
from flasher.host.query import Query, Request, ask_all, count_answers
from flasher.host.runner import Runner, Signal, Stage, StageInput, filtered
from flasher.image.plan import Plan
from flasher.protocol import catalogue
from flasher.protocol.contents import RunningInformation
from flasher.protocol.messages import BootVersion, decode
from flasher.protocol.spec import Node, Target
from flasher.protocol.wire import Message

LISTEN_FIRST_S: Final = 0.1
"""How long every querying command listens first. A tool that flashes sends more often, unless it
waits for the device."""


class IdentifyStage:
    """Listens, then sends all queries of the target. With `asks` False it only listens."""

    def __init__(self, plan: Plan, options: UpgradeOptions, *, asks: bool = True) -> None:
        self._requests = _requests(plan.target, options) if asks else []
        self._answer_id = plan.target.answer_id
        version = options.version_request_for(plan.target)
        self._version_item = None if version is None else version.answer_item
        self._queries: list[Query] = []
        self.phase = Phase.LISTEN
        """Current phase."""
        self.announcement: Message | None = None
        """Boot version announced by the device; None without one."""
        self.two_devices = ""
        """Evidence of a second device; may be empty."""
        self.cancelled = False

    @property
    def asks(self) -> bool:
        """False if nothing is queried: only the battery has queries (5.2)."""
        return bool(self._requests)

    @property
    def seen(self) -> DeviceAnswers:
        """Answers of the device."""
        answers = [query.answer for query in self._queries]
        running = next((each for each in answers if isinstance(each, RunningInformation)), None)
        version = next(
            (each for each in answers if each and not isinstance(each, RunningInformation)), None
        )
        return DeviceAnswers(version, running)

    def stage(self, run: Runner[Any]) -> Stage[IdentifyStage]:
        """Listen and query; the result is this object."""
        item = self._version_item
        run.listen_always(self._answer_id, *(() if item is None else (item.can_id,)))
        run.emit(PhaseEntered(Phase.LISTEN, 1))
        yield from self._listen(run, run.now + LISTEN_FIRST_S)
        if self.cancelled:
            return self
        self.phase = Phase.IDENTIFY
        if self._requests and self.announcement is None:
            run.emit(PhaseEntered(Phase.IDENTIFY, 1))
            asking = ask_all(run, self._while_silent(), self._queries, stop_at_silence=True)
            yield from filtered(asking, self._look)
            if not self.cancelled and self.announcement is None:
                yield from filtered(count_answers(run, self._queries), self._look)
        self.two_devices = run.duplicates.evidence
        return self

    def _while_silent(self) -> Iterator[Request]:
        for request in self._requests:
            if self.announcement is None:
                yield request

    def _listen(self, run: Runner[Any], until: float) -> Stage[None]:
        while run.now < until and not self.cancelled:
            self._look((yield until))

    def _look(self, came: StageInput) -> StageInput:
        """Process an input; an announcement ends the current query."""
        self.cancelled = self.cancelled or came is Signal.CANCEL
        if not isinstance(came, Message):
            return came
        if came.can_id == self._answer_id and isinstance(decode(came), BootVersion):
            self.announcement = came
            return Signal.CANCEL
        return came


def identify(plan: Plan, options: UpgradeOptions, *, asks: bool = True) -> Runner[IdentifyStage]:
    """Run `IdentifyStage` as an engine."""
    asked = IdentifyStage(plan, options, asks=asks)
    return Runner(asked.stage, bitrate_bps=plan.bitrate_bps, timings=options.timings)


def _requests(target: Target, options: UpgradeOptions) -> list[Request]:
    """Return the queries of this target; may be empty (chapter 3)."""
    requests = []
    version = options.version_request_for(target)
    if version is not None:
        requests.append(version)
    requests += [
        Request(item)
        for item in catalogue.ITEMS
        if item.sender is Node.CDL and item.receiver is target.node
        if (answer := catalogue.answer_of(item)) and answer.content is RunningInformation
    ]
    return requests
