"""Host overhead: whole packet-to-ACK cycles on python-can's `virtual` bus, and bare python-can's.

    python -m tests.benchmarks.packet_cycle [--packets N]

The device model runs in another thread with flash times of zero. "bare" is what python-can alone
takes on this machine, at the same time: 18 frames one way and 2 frames back, nothing else.
"""

from __future__ import annotations

import argparse
import gc
import random
import statistics
import threading
import time
import uuid

import can

from flasher import events
from flasher.bus.adapter import CanLink, open_adapter
from flasher.bus.link import MonotonicClock
from flasher.driver import drive
from flasher.host.upgrade import Upgrade
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, PACKET_DATA_SIZE, WELLING


class Stopwatch:
    """A tap that notes cycles (first frame of a packet to the last of its ACK) and turnarounds
    (last frame of an ACK received to the first frame of the next packet accepted)."""

    def __init__(self) -> None:
        self.cycles_s: list[float] = []
        self.turnarounds_s: list[float] = []
        self._frames = 0
        self._began = 0.0
        self._answered: float | None = None

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        moment = time.perf_counter()
        if sent:
            if self._frames == 0:
                if self._answered is not None:
                    self.turnarounds_s.append(moment - self._answered)
                self._began = moment
            self._frames += 1
        elif len(frame.data) < 8:
            if self._frames == 18:
                self.cycles_s.append(moment - self._began)
            self._answered = moment
            self._frames = 0


def upgrade(packets: int) -> tuple[Stopwatch, float]:
    """One upgrade over the virtual bus; the stopwatch and packets per second."""
    channel = uuid.uuid4().hex
    links = [
        open_adapter(WELLING.bitrate_bps, interface="virtual", channel=channel) for _ in range(2)
    ]
    size = packets * PACKET_DATA_SIZE
    profile = DeviceProfile(erase_time_s=0.0, program_time_s=0.0)
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile)
    image = Image.from_bytes(random.Random(1).randbytes(size))
    engine = Upgrade(plan(image, BMS, WELLING.bitrate_bps))
    finished = threading.Event()
    served = threading.Thread(target=_serve, args=(device, links[1], finished))
    served.start()
    stopwatch = Stopwatch()
    times: list[float] = []

    def note(event: object) -> None:
        if isinstance(event, events.PacketAcknowledged):
            times.append(time.perf_counter())

    gc.disable()
    drive(engine, links[0], MonotonicClock(), taps=[stopwatch], on_event=note)
    gc.enable()
    finished.set()
    served.join()
    for link in links:
        link.close()
    assert engine.outcome.ok, engine.outcome.error()
    assert device.stored_image == image.data
    return stopwatch, (len(times) - 1) / (times[-1] - times[0])


def _serve(device: MockDevice, link: CanLink, finished: threading.Event) -> None:
    drive(device, link, MonotonicClock(), cancelled=finished.is_set)


def bare(packets: int) -> list[float]:
    """The same frames by python-can alone."""
    channel = uuid.uuid4().hex
    near, far = (can.Bus(interface="virtual", channel=channel) for _ in range(2))

    def answer() -> None:
        for _ in range(packets):
            for _ in range(18):
                far.recv(5)
            for data in (b"\x55\xaa\x0c\x04\xc2\x02\x01\x00", b"\x32\xbc\x87\xee\xf0"):
                far.send(can.Message(arbitration_id=0x725, data=data, is_extended_id=False))

    thread = threading.Thread(target=answer)
    thread.start()
    cycles = []
    for _ in range(packets):
        began = time.perf_counter()
        for _ in range(18):
            near.send(can.Message(arbitration_id=0x752, data=bytes(8), is_extended_id=False))
        near.recv(5)
        near.recv(5)
        cycles.append(time.perf_counter() - began)
    thread.join()
    near.shutdown()
    far.shutdown()
    return cycles


def line(name: str, values_s: list[float]) -> str:
    """Median and p99 in milliseconds."""
    ordered = sorted(values_s)
    median_ms = statistics.median(ordered) * 1e3
    p99_ms = ordered[len(ordered) * 99 // 100] * 1e3
    return f"{name:<34} median {median_ms:7.3f} ms   p99 {p99_ms:7.3f} ms"


def main() -> None:
    """Run both and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--packets", type=int, default=4000)
    packets = parser.parse_args().packets
    bare(packets // 4)
    reference = bare(packets)
    stopwatch, rate = upgrade(packets)
    print(line("bare python-can, 18 frames and back", reference))
    print(line("packet to ACK", stopwatch.cycles_s))
    print(line("ACK received to next packet sent", stopwatch.turnarounds_s))
    print(f"{rate:,.0f} packets/s; bare python-can {1 / statistics.mean(reference):,.0f}/s")


if __name__ == "__main__":
    main()
