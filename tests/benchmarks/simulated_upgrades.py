"""Simulated upgrades per minute on one core, alone and in a campaign with faults.

    python -m tests.benchmarks.simulated_upgrades [--upgrades N]

"alone" is host, simulated bus and device model: each upgrade is whole (reset to complete, an image
of 2 KiB), with a bus, a device and a clock of its own. "with faults" is what `flasher simulate`
does with images of the same size: a random plan of adapter, device and faults, the upgrade, all
rules of the oracle, and bringing the device back if it failed, which are one or two upgrades more.
So its figure is also given for each frame. The last lines show what larger images cost.
The clock is virtual, so nothing waits. CPU time is counted, not the time of day.
"""

from __future__ import annotations

import argparse
import random
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.driver import drive
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import BMS, PACKET_DATA_SIZE, WELLING
from flasher.simulate import plan as plans
from flasher.simulate.campaign import without_log
from flasher.simulate.draw import drawn
from flasher.simulate.play import Player
from tests.host.upgrade import Upgrade

PACKETS = 16
"""Of an image of 2 KiB."""
NEARLY = (12, 20)
"""Drawn sizes whose faults fall into an image of 2 KiB too, nearly all."""
SIZES = (4, 16, 64, 256, 1024)


def upgrade(image: Image) -> int:
    """One upgrade from the beginning to the end; return its frames."""
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=DeviceProfile())
    bus.attach(device)
    engine = Upgrade(plan(image, BMS, WELLING.bitrate_bps))
    drive(engine, bus.link(), clock)
    assert engine.outcome.ok, engine.outcome.error()
    assert device.stored_image == image.data
    return bus.frames_carried


def with_faults() -> Iterator[plans.Plan]:
    """Yield the random plans of a campaign that are of about this size, with exactly this size."""
    for seed in count():
        found = drawn(seed)
        if len(found.devices) == 1 and found.job.packets in NEARLY:
            job = replace(found.job, packets=PACKETS, short=0)
            others = (each for each in found.clauses if not isinstance(each, plans.Job))
            yield plans.Plan((job, *others))


def play(played: plans.Plan) -> int:
    """One run of a campaign; return its frames."""
    player = Player(played)
    verdict = player.play()
    assert all(each.is_excused for each in verdict.violations), (verdict.plan, verdict.violations)
    return player.bus.frames_carried


def main() -> None:
    """Run them and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--upgrades", type=int, default=1000)
    number = parser.parse_args().upgrades
    size_bytes = PACKETS * PACKET_DATA_SIZE
    images = [Image.from_bytes(random.Random(seed).randbytes(size_bytes)) for seed in range(number)]
    faulty = [*islice(with_faults(), number)]
    upgrade(images[0])
    play(faulty[0])
    alone_s = faulty_s = 0.0
    alone_frames = faulty_frames = 0
    with without_log():
        for image, played in zip(
            images, faulty, strict=True
        ):  # by turns: the machine's pace varies
            began = time.process_time()
            alone_frames += upgrade(image)
            halfway = time.process_time()
            faulty_frames += play(played)
            faulty_s += time.process_time() - halfway
            alone_s += halfway - began
    kib = size_bytes // 1024
    print(
        f"alone:       {60 * number / alone_s:6,.0f} upgrades of {kib} KiB a minute and core "
        f"({1e3 * alone_s / number:.2f} ms and {alone_frames / number:.0f} frames each, "
        f"{1e6 * alone_s / alone_frames:.1f} us a frame)"
    )
    print(
        f"with faults: {60 * number / faulty_s:6,.0f} runs of {kib} KiB a minute and core "
        f"({1e3 * faulty_s / number:.2f} ms and {faulty_frames / number:.0f} frames each, "
        f"{1e6 * faulty_s / faulty_frames:.1f} us a frame)"
    )
    print(
        f"ratio:       {alone_s / faulty_s:.2f} of the runs, "
        f"{alone_s / alone_frames / (faulty_s / faulty_frames):.2f} of the frames"
    )
    for packets in SIZES:
        text = f"job packets={packets} ; independent ; @packet{packets // 2} drop sender=host"
        played = plans.Plan.parse(text)
        times = max(1, SIZES[-1] // packets)
        with without_log():
            began = time.process_time()
            frames = sum(play(played) for _ in range(times))
            took_s = time.process_time() - began
        print(
            f"{packets:5} packets, one frame lost: {1e3 * took_s / times:7.2f} ms, "
            f"{1e6 * took_s / frames:.1f} us a frame"
        )


if __name__ == "__main__":
    main()
