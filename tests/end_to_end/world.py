"""One upgrade on a simulated bus and a virtual clock."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import Disturbance, SimulatedBus
from flasher.driver import drive
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import Outcome
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame
from flasher.protocol.spec import TARGETS, WELLING
from tests.host.upgrade import Upgrade

IMAGE = random.Random(7).randbytes(10 * 128 - 3)


@dataclass
class Traffic:
    """A tap that keeps what the host sent and received."""

    sent: list[Frame] = field(default_factory=list)
    received: list[Frame] = field(default_factory=list)

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        (self.sent if sent else self.received).append(frame)

    def update_commands(self, target: str) -> int:
        """How often the update command went out."""
        head = bytes.fromhex("55AA160DA10B")
        request_id = TARGETS[target].request_id
        return sum(frame.can_id == request_id and frame.data[:6] == head for frame in self.sent)


def upgrade(
    device: Engine,
    target: str = "bms",
    image: bytes | Image = IMAGE,
    *,
    options: UpgradeOptions | None = None,
    disturbance: Disturbance | None = None,
    others: tuple[Engine, ...] = (),
    traffic: Traffic | None = None,
    linger_s: float = 2.0,
) -> Outcome:
    """flasher's host upgrades `device`; afterwards the device has `linger_s` to start."""
    loaded = image if isinstance(image, Image) else Image.from_bytes(image)
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock, disturbance)
    for engine in (device, *others):
        bus.attach(engine)
    engine = Upgrade(plan(loaded, TARGETS[target], WELLING.bitrate_bps), options)
    link = bus.link()
    drive(engine, link, clock, taps=[traffic] if traffic else ())
    end = clock.now() + linger_s
    while clock.now() < end:
        link.receive(end)
    return engine.outcome
