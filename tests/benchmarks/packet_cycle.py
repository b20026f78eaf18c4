"""Host overhead: whole packet-to-ACK cycles on python-can's `virtual` bus, beside two peers.

    python -m tests.benchmarks.packet_cycle [--packets N]

The device model runs in another thread with flash times of zero. Peers, measured in the same run:
"bare" is what python-can alone takes, 18 frames one way and 2 frames back, nothing else; "UDS" are
udsoncan and can-isotp, moving blocks of 128 bytes by TransferData. "line time" is an upgrade on the
simulated bus at the pace of a real one with a device of no delay: the exact time of all its bits as
a share of the time that it took.
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
import isotp
from udsoncan.client import Client
from udsoncan.connections import PythonIsoTpConnection

from flasher import events
from flasher.bus.adapter import CanLink, open_adapter
from flasher.bus.link import MonotonicClock
from flasher.bus.simulated import SimulatedBus
from flasher.driver import drive
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, PACKET_DATA_SIZE, WELLING
from tests.host.upgrade import Upgrade

BUSY_WAIT_S = 0.0001
"""Real seconds before a moment that a paced clock spends in a busy loop."""


class Stopwatch:
    """A tap that notes cycles (first frame of a packet to the last of its ACK) and turnarounds
    (last frame of an ACK received to the first frame of the next packet accepted)."""

    def __init__(self) -> None:
        self.cycles_s: list[float] = []
        self.turnarounds_s: list[float] = []
        self.has_packets = False
        """The transfer has begun."""
        self._is_sending = False
        self._began = 0.0
        self._answered: float | None = None

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if sent:
            if not self._is_sending:
                self._is_sending = True
                self._began = time.perf_counter()
                if self._answered is not None:
                    self.turnarounds_s.append(self._began - self._answered)
        elif len(frame[1]) < 8:
            self._answered = time.perf_counter()
            if self._is_sending and self.has_packets:
                self.cycles_s.append(self._answered - self._began)
            self._is_sending = False


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
            stopwatch.has_packets = event.number < event.total

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


def uds(blocks: int) -> list[float]:
    """Blocks of 128 bytes by udsoncan and can-isotp, without separation times or flow control."""
    channel = uuid.uuid4().hex
    near, far = (can.Bus(interface="virtual", channel=channel) for _ in range(2))
    notifiers = [can.Notifier(bus, []) for bus in (near, far)]
    there = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x752, rxid=0x725)
    back = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x725, rxid=0x752)
    fast = {"stmin": 0, "blocksize": 0}
    server = isotp.NotifierBasedCanStack(far, notifiers[1], address=back, params=fast)
    stack = isotp.NotifierBasedCanStack(near, notifiers[0], address=there, params=fast)
    finished = threading.Event()

    def answer() -> None:
        while not finished.is_set():
            request = server.recv(block=True, timeout=0.1)
            if request:
                server.send(bytes((request[0] + 0x40, request[1])))

    server.start()
    thread = threading.Thread(target=answer)
    thread.start()
    cycles = []
    with Client(PythonIsoTpConnection(stack), request_timeout=5) as client:
        for number in range(blocks):
            began = time.perf_counter()
            client.transfer_data(number % 256, bytes(PACKET_DATA_SIZE))
            cycles.append(time.perf_counter() - began)
    finished.set()
    thread.join()
    server.stop()
    for notifier in notifiers:
        notifier.stop()
    near.shutdown()
    far.shutdown()
    return cycles


class PacedClock:
    """Real time multiplied by `speed`, with the delays of this computer.

    A sleep ends about 0.1 ms late, so the last part is waited for in a busy loop.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self._origin = time.perf_counter()

    def now(self) -> float:
        """Simulated seconds since the clock was created."""
        return (time.perf_counter() - self._origin) * self.speed

    def wait_until(self, moment: float) -> None:
        """Sleep until the simulated `moment`."""
        until = self._origin + moment / self.speed
        remaining_s = until - time.perf_counter()
        if remaining_s > BUSY_WAIT_S:
            time.sleep(remaining_s - BUSY_WAIT_S)
        while time.perf_counter() < until:
            pass


def line_share(packets: int) -> float:
    """The exact line time of a transfer as a share of what it took at the pace of a real bus."""
    clock = PacedClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    profile = DeviceProfile(erase_time_s=0.0, program_time_s=0.0)
    bus.attach(MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile))
    size = packets * PACKET_DATA_SIZE
    planned = plan(Image.from_bytes(random.Random(1).randbytes(size)), BMS, WELLING.bitrate_bps)
    engine = Upgrade(planned)
    drive(engine, bus.link(), clock)
    transfer_s = engine.outcome.statistics.transfer_s
    assert transfer_s is not None, engine.outcome.error()
    return planned.transfer_wire_s / transfer_s


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
    peer = uds(max(packets // 20, 50))
    print(line("UDS, a block of 128 bytes", peer))
    cycle_s, bare_s, uds_s = map(statistics.median, (stopwatch.cycles_s, reference, peer))
    print(f"{rate:,.0f} packets/s; bare python-can {1 / statistics.mean(reference):,.0f}/s")
    print(f"packet to ACK is {cycle_s / bare_s:.2f} times bare python-can")
    print(f"UDS takes {uds_s / cycle_s:.1f} times as long")
    print(f"line time / duration {line_share(300):.4f}")


if __name__ == "__main__":
    main()
