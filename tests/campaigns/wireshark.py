"""What tshark decodes with the exported dissector against what flasher decodes, on random streams:

    python -m tests.campaigns.wireshark [--rounds N] [--seed S]

Each round is a capture of messages of several senders among each other, cut, doubled and damaged,
and of every message of both dialects with random values. FLASHER_TEST_TSHARK_PROGRAM names another
tshark.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from pathlib import Path

from flasher.protocol.spec import WELLING
from tests.export import test_wireshark as cases
from tests.export.tshark import items, write_capture


def main() -> int:
    """Run the rounds and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seed", type=int, default=1)
    wanted = parser.parse_args()
    frames = messages = fields = differences = 0
    with tempfile.TemporaryDirectory() as named:
        folder = Path(named)
        for seed in range(wanted.seed, wanted.seed + wanted.rounds):
            chance, reel = random.Random(seed), cases.Reel()
            cases.damaged(reel, chance, count=4000)
            cases.upgrade_messages(reel, chance)
            cases.catalogue_messages(reel, chance)
            cases.damaged(reel, chance, count=1000)
            capture = write_capture(folder / "reel.pcapng", reel.frames)
            found, expected = list(items(capture, folder)), list(cases.decoded(reel, WELLING))
            differences += abs(len(found) - len(expected))
            for item, (number, event) in zip(found, expected, strict=False):
                reported = (item.frame, item.one("kind"), item.one("message"), cases.shown(item))
                values = cases.expected_of(event)
                differences += reported != (number, event.kind.value, event.title, values)
                fields += len(values)
            frames += len(reel.frames)
            messages += len(expected)
    sys.stdout.write(
        f"{frames:,} frames, {messages:,} messages and pieces of damage, {fields:,} fields, "
        f"{differences:,} differences\n"
    )
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
