"""Frames a second that tshark takes with the exported dissector.

    python -m tests.benchmarks.wireshark [--frames N]

The capture is that of upgrades, packet after packet with their ACKs, as a .pcapng. The first time
is that of tshark alone, which decodes CAN; then with the dissector, as a list of packets, and with
every field of every message. CPU time is counted, not the time of day.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from flasher.export.wireshark import dissector
from flasher.protocol.frame import Frame
from flasher.protocol.messages import Ack, Packet
from flasher.protocol.spec import BMS
from flasher.protocol.wire import encode, split
from tests.export.tshark import write_capture

PACKETS = 2000
"""Of an image of 250 KiB."""
FRAME_S = 0.0005


def traffic(count: int) -> Iterator[tuple[float, Frame]]:
    """So many frames."""
    frames: list[Frame] = []
    for number in range(1, PACKETS + 1):
        data = Packet(number, PACKETS, bytes([number & 0xFF]) * 128)
        for can_id, row in ((BMS.request_id, data), (BMS.answer_id, Ack(number))):
            frames += split(can_id, encode(row.to_message(can_id)))
    for number in range(count):
        yield 1_700_000_000 + number * FRAME_S, frames[number % len(frames)]


def main() -> None:
    """Run tshark and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=1_000_000)
    count = parser.parse_args().frames
    with TemporaryDirectory() as named:
        folder = Path(named)
        script = folder / "welling.lua"
        script.write_text(dissector("0"), encoding="utf-8")
        capture = write_capture(folder / "bench.pcapng", traffic(count))
        print(f"{count:,} frames, {capture.stat().st_size / 1e6:.0f} MB")
        loaded = ("-X", f"lua_script:{script}")
        for title, options in (
            ("without the dissector", ()),
            ("with it", loaded),
            ("with it, every field (-V)", (*loaded, "-V")),
        ):
            before_s = _cpu_s()
            with (folder / "output").open("wb") as reported:
                subprocess.run(
                    ("tshark", "-r", str(capture), *options), stdout=reported, check=True,
                    stderr=subprocess.DEVNULL, env={**os.environ, "HOME": named},
                )  # fmt: skip
            took_s = _cpu_s() - before_s
            print(f"{title}: {took_s:.1f} s, {count / took_s:,.0f} frames a second")


def _cpu_s() -> float:
    """CPU time of the programs that were run, in seconds."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
