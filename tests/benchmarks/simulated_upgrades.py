"""Simulated upgrades per minute on one core: host, simulated bus and device model.

    python -m tests.benchmarks.simulated_upgrades [--upgrades N]

Each upgrade is whole (reset to complete, an image of 2 KiB), with a bus, a device and a clock of
its own.
The clock is virtual, so nothing waits. CPU time is counted, not the time of day.
"""

from __future__ import annotations

import argparse
import random
import time

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.driver import drive
from flasher.host.upgrade import Upgrade
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import BMS, WELLING

IMAGE_BYTES = 2 * 1024


def upgrade(image: Image) -> None:
    """One upgrade from the beginning to the end."""
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=DeviceProfile())
    bus.attach(device)
    engine = Upgrade(plan(image, BMS, WELLING.bitrate_bps))
    drive(engine, bus.link(), clock)
    assert engine.outcome.ok, engine.outcome.error()
    assert device.stored_image == image.data


def main() -> None:
    """Run them and print the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--upgrades", type=int, default=1000)
    count = parser.parse_args().upgrades
    images = [Image.from_bytes(random.Random(seed).randbytes(IMAGE_BYTES)) for seed in range(count)]
    upgrade(images[0])
    began = time.process_time()
    for image in images:
        upgrade(image)
    cpu_s = time.process_time() - began
    print(
        f"{60 * count / cpu_s:,.0f} simulated upgrades of {IMAGE_BYTES // 1024} KiB a minute and "
        f"core ({1e3 * cpu_s / count:.2f} ms each)"
    )


if __name__ == "__main__":
    main()
