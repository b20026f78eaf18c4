"""A device on a simulated bus, for whole sessions and for the command line.

    stage = Stage("bms")
    stage.at_packet[7] = stage.cut_power
    result = stage.flash(IMAGE)

The clock is virtual: minutes of waiting take no time. `heard` has what the host put on the wire.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from flasher import api, events
from flasher.bus.link import Link, VirtualClock
from flasher.bus.simulated import DEFAULT_QUEUE_FRAMES, Disturbance, SimulatedBus, SimulatedLink
from flasher.host.identity import Identity
from flasher.host.options import UpgradeOptions
from flasher.host.session import Result
from flasher.host.verify import Level
from flasher.image.image import Image
from flasher.image.plan import Plan, plan
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import TARGETS, WELLING
from tests.firmware import VECTORS

SMALL = DeviceProfile(application_area_bytes=16 * 1024)
"""Many devices are made; a large flash takes time to make."""
OLD, NEW, NEWER = "V1r0r0_20220512", "V2r0r1_20260102", "V3r0r0_20260301"
"""The first one is the model's factory version."""


def image_of(packets: int = 4, version: str = NEW, seed: int = 5) -> Image:
    """An image that names its version, its last packet not full."""
    head = VECTORS + version.encode() + b"\0"
    body = random.Random(seed).randbytes(packets * 128 - 5 - len(head))
    return replace(Image.from_bytes(head + body), version=version)


IMAGE = image_of()


def packet_number(frame: Frame) -> int | None:
    """The packet that begins with this frame; None when none does."""
    head = bytes.fromhex("55AA1687A38501")
    return frame.data[7] if frame.data[:7] == head else None


class WatchedClock(VirtualClock):
    """Tells when somebody lets time pass."""

    on_wait: Callable[[float], None] | None = None

    def wait_until(self, moment: float) -> None:
        super().wait_until(moment)
        if self.on_wait is not None:
            self.on_wait(moment)


class Stage:
    """One device, its bus, and what befalls them while a session runs."""

    def __init__(
        self, target: str = "bms", *, profile: DeviceProfile = SMALL, has_application: bool = True
    ) -> None:
        self.target = TARGETS[target]
        self.clock = WatchedClock()
        self.bus = SimulatedBus(WELLING.bitrate_bps, self.clock, self._carry)
        self.device = MockDevice(
            self.target,
            bitrate_bps=WELLING.bitrate_bps,
            profile=profile,
            has_application=has_application,
        )
        self.bus.attach(self.device)
        self.at_packet: dict[int, Callable[[], None]] = {}
        """What happens, once, when a packet has begun."""
        self.at_event: dict[type, Callable[[], None]] = {}
        """What happens, each time, when the host reports something of a kind."""
        self.at_next_frame: Callable[[], None] | None = None
        """What happens, once, when the next frame is on the wire."""
        self.disturb: Disturbance | None = None
        self.cancelled: Callable[[], bool] | None = None
        self.heard: list[Frame] = []
        """What the host has sent, as far as it got onto the wire."""
        self.events: list[object] = []
        self.wrap: Callable[[SimulatedLink], Link] = lambda link: link
        """What is put around the adapter."""
        self.queue_frames = DEFAULT_QUEUE_FRAMES

    # -- what befalls them -----------------------------------------------------------------------

    def cut_power(self) -> None:
        self.device.power_cut(self.clock.now())

    def give_power(self) -> None:
        self.device.power_on(self.clock.now())

    def cycle_power(self) -> None:
        """Off and on at once, whatever it does."""
        if self.device.has_power:
            self.cut_power()
        self.give_power()

    def _carry(self, frame: Frame, now: float) -> Iterable[Frame]:
        if (happens := self.at_next_frame) is not None:
            self.at_next_frame = None
            happens()
        if frame.can_id == self.target.request_id:
            self.heard.append(frame)
            number = packet_number(frame)
            if number is not None and number in self.at_packet:
                self.at_packet.pop(number)()
        return (frame,) if self.disturb is None else self.disturb(frame, now)

    def note(self, event: object) -> None:
        """For a session: keep an event and let happen what is wanted then."""
        self.events.append(event)
        for kind, happens in self.at_event.items():
            if isinstance(event, kind):
                happens()

    # -- sessions ---------------------------------------------------------------------------------

    def connection(self) -> api.Connection:
        """A new adapter on the bus."""
        return api.Connection(
            self.wrap(self.bus.link(self.queue_frames)), self.clock, "the simulated bus"
        )

    @contextmanager
    def connect(self, *_arguments: Any, **_options: Any) -> Iterator[api.Connection]:
        """In the place of `flasher.api.connect`."""
        yield self.connection()

    def plan(self, image: Image = IMAGE) -> Plan:
        return plan(image, self.target, WELLING.bitrate_bps)

    def flash(
        self,
        image: Image = IMAGE,
        options: UpgradeOptions | None = None,
        *,
        verify: Level | None = None,
        identity: Identity | None = None,
        taps: Sequence[Any] = (),
    ) -> Result:
        """One session, as `flasher flash` runs it."""
        self.heard.clear()
        self.events.clear()
        return (
            self.connection()
            .device(self.target)
            .upgrade(
                self.plan(image),
                options=options,
                verify=verify,
                identity=identity,
                taps=taps,
                on_event=self.note,
                cancelled=self.cancelled,
            )
        )

    def rescue(self, image: Image = IMAGE, **options: Any) -> Result:
        """One session, as `flasher rescue` runs it; the power is cycled when it asks for it."""
        self.at_event[events.PowerCycleAwaited] = self.cycle_power
        return self.flash(image, UpgradeOptions(at_power_up=True, **options))

    def wait(self, seconds: float) -> None:
        """Let time pass without a host."""
        link, end = self.bus.link(), self.clock.now() + seconds
        while self.clock.now() < end:
            link.receive(end)

    def seen(self, kind: type) -> list[Any]:
        """The events of a kind in the last session."""
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def has(self) -> bytes | None:
        """The whole image in the device's flash; None without one."""
        return self.device.stored_image


class Speaker:
    """An engine that sends frames in turn, one every `every_s` seconds, and hears nothing; for ever
    unless it has `limit` frames to send.
    """

    done = False

    def __init__(
        self, *frames: Frame, every_s: float, begins_at: float = 0.0, limit: int | None = None
    ) -> None:
        self._frames, self._every_s, self._next = frames, every_s, begins_at
        self._limit = limit
        self._sent = 0
        self._is_due = False

    def receive(self, frame: Frame, now: float) -> None:
        pass

    def tick(self, now: float) -> None:
        self._is_due = True
        self._next = now + self._every_s

    def deadline(self) -> float | None:
        if self._is_due:
            return float("-inf")
        return None if self._sent == self._limit else self._next

    def next_frame(self, now: float) -> Frame | None:
        return self._frames[self._sent % len(self._frames)] if self._is_due else None

    def frame_sent(self, now: float) -> None:
        self._is_due = False
        self._sent += 1
        if self._sent == self._limit:
            self._next = float("inf")

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> list[object]:
        return []
