"""The kept heads of a long-lived line: how large they are, and what a start and a commit read.

    python -m tests.benchmarks.station_heads [--rows N] [--folder DIR]

The heads are written in bulk, in segments as a station closes them; their signatures sign nothing.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from flasher.station.records.heads import ChainHead, HeadsFile
from flasher.station.records.signatures import SigningKey

BATCH = 10_000
REPEATS = 50


def fill(file: HeadsFile, key: SigningKey, rows: int) -> None:
    """Heads of the audit rows 1 to `rows`."""
    for begin in range(1, rows + 1, BATCH):
        numbers = range(begin, min(begin + BATCH, rows + 1))
        file.append((head(number, key) for number in numbers), key)


def head(number: int, key: SigningKey) -> ChainHead:
    at = f"2026-05-17T09:00:00.{number % 1_000_000:06}"
    return ChainHead("line-2", number, at, f"{number:064x}", "s" * 88, key.public)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=5_000_000)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as temporary:
        folder = Path(temporary)
        key = SigningKey.make(folder / "line.key")
        path = folder / "line.heads"
        began = time.perf_counter()
        fill(HeadsFile(path), key, options.rows)
        segments = list(folder.glob("line.heads*"))
        size_bytes = sum(segment.stat().st_size for segment in segments)
        print(
            f"  {options.rows:,} rows: {size_bytes / 1e6:,.0f} MB in {len(segments)} segments,"
            f" written in {time.perf_counter() - began:.0f} s"
        )
        began = time.perf_counter()
        last = HeadsFile(path).last()
        print(f"  a start finds row {last and last.number:,}: {_ms(began):.1f} ms")
        file, taken_ms = HeadsFile(path), []
        for number in range(options.rows + 1, options.rows + 1 + REPEATS):
            began = time.perf_counter()
            file.append([head(number, key)], key)
            taken_ms.append(_ms(began))
        print(f"  a head is added: {statistics.median(taken_ms):.2f} ms, first {taken_ms[0]:.1f}")
        began = time.perf_counter()
        found = HeadsFile(path).of_row(options.rows // 3)
        print(f"  the head of one row is found ({len(found)}): {_ms(began):.0f} ms")


def _ms(began: float) -> float:
    return (time.perf_counter() - began) * 1000


if __name__ == "__main__":
    main()
