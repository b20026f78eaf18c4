"""Host and device model as two processes on a bus: 300 KiB, and a host that is killed at every
packet of an upgrade: `python -m tests.campaigns.two_processes`.

What does not hold is an AssertionError.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.end_to_end.test_host_killed import PACKETS, kill_and_repair
from tests.end_to_end.test_processes import bus_words, free_port, long_upgrade


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kib", type=int, default=300)
    parser.add_argument("--step", type=int, default=1, help="kill at every such packet")
    options = parser.parse_args()
    bus = bus_words(free_port())
    with tempfile.TemporaryDirectory() as folder:
        done = long_upgrade(bus, Path(folder), options.kib * 1024)
        sys.stdout.write(done.stdout)
    with tempfile.TemporaryDirectory() as folder:
        numbers = range(1, PACKETS, options.step)
        kill_and_repair(bus, Path(folder), numbers)
        sys.stdout.write(f"killed at {len(numbers)} packets, repaired each time\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
