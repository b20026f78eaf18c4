"""The power of the device, and the adapter, are lost at every packet of an upgrade, and the device
is rescued each time: `python -m tests.campaigns.rescues`.

What does not hold is an AssertionError.
"""

from __future__ import annotations

import sys

from tests.end_to_end.test_rescue import PACKETS, lose_power_at, lose_the_adapter_at


def main() -> int:
    for number in range(1, PACKETS + 1):
        lose_power_at(number)
        lose_the_adapter_at(number)
    sys.stdout.write(f"lost at each of {PACKETS} packets, rescued each time\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
