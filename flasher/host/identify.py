"""Identification of a device before an upgrade: version query, running information, second device.

It queries the version information (if the target has a query for it) and, from the battery, the
running information. A device in its bootloader sends boot versions instead of answers: that ends
the queries at once, so that the update command is in time. Before the first query it listens
briefly for another tool (`guard`); after the last one it waits for answers of a second device
(`duplicates`).
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
"""Time in seconds for which a command listens before its first query. A tool that flashes sends
more often, unless it waits for the device."""


class IdentifyStage:
    """Listens for another tool, then sends the target's queries. Without `asks` it only listens."""

    def __init__(self, plan: Plan, options: UpgradeOptions, *, asks: bool = True) -> None:
        self._requests = _requests(plan.target, options) if asks else []
        self._answer_id = plan.target.answer_id
        version = options.version_request_for(plan.target)
        self._version_item = None if version is None else version.answer_item
        self._queries: list[Query] = []
        self.phase = Phase.LISTEN
        self.announcement: Message | None = None
        """Boot version received from the device; None without one."""
        self.two_devices = ""
        """Evidence of a second device; may be empty."""
        self.cancelled = False

    @property
    def asks(self) -> bool:
        """False if there is no query to send: only the battery has queries (table 7)."""
        return bool(self._requests)

    @property
    def answers(self) -> DeviceAnswers:
        """Answers of the device so far."""
        answers = [query.answer for query in self._queries]
        running = next((each for each in answers if isinstance(each, RunningInformation)), None)
        version = next(
            (each for each in answers if each and not isinstance(each, RunningInformation)), None
        )
        return DeviceAnswers(version, running)

    def stage(self, run: Runner[Any]) -> Stage[IdentifyStage]:
        """Listen, then query; the result is this object."""
        item = self._version_item
        run.listen_always(self._answer_id, *(() if item is None else (item.can_id,)))
        run.emit(PhaseEntered(Phase.LISTEN, 1))
        yield from run.listen_for(LISTEN_FIRST_S, self._look)
        if self.cancelled:
            return self
        self.phase = Phase.IDENTIFY
        if self._requests and self.announcement is None:
            run.emit(PhaseEntered(Phase.IDENTIFY, 1))
            asking = ask_all(run, self._until_announced(), self._queries, stop_at_silence=True)
            yield from filtered(asking, self._look)
            if not self.cancelled and self.announcement is None:
                yield from filtered(count_answers(run, self._queries), self._look)
        self.two_devices = run.duplicates.evidence
        return self

    def _until_announced(self) -> Iterator[Request]:
        for request in self._requests:
            if self.announcement is None:
                yield request

    def _look(self, came: StageInput) -> StageInput:
        """Process an input of a query; a boot version cancels the query."""
        self.cancelled = self.cancelled or came is Signal.CANCEL
        if not isinstance(came, Message):
            return came
        if came.can_id == self._answer_id and isinstance(decode(came), BootVersion):
            self.announcement = came
            return Signal.CANCEL
        return came


def identify(plan: Plan, options: UpgradeOptions, *, asks: bool = True) -> Runner[IdentifyStage]:
    """Create an engine that runs an `IdentifyStage`."""
    asked = IdentifyStage(plan, options, asks=asks)
    return Runner(asked.stage, bitrate_bps=plan.bitrate_bps, timings=options.timings)


def _requests(target: Target, options: UpgradeOptions) -> list[Request]:
    """Return the version and state queries of a target; may be empty."""
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
