"""Random upgrades in a simulated world: `python -m tests.campaigns.world --runs 20000`.

Each run is a plan (see `plans`): one or two devices, and what befalls them, the wire, the adapter
and the host's computer. The production session upgrades; an oracle looks into the flash of every
device. A seed gives the same plan each time; `--replay LINE` plays a plan that was printed. Two
devices are on the bus in a quarter of the plans. A success while one of them was left without the
image is false; it is counted as unseen where that one, or the other, sent nothing of its own in the
transfer (docs/explanation/safety.md, "What stays unseen").

`--settings` runs the plans that fail again with other patience, and counts what each saves.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from flasher.host.options import UpgradeOptions
from flasher.protocol.spec import BMS
from flasher.settings.profile import Profile
from tests.campaigns.world.draw import TWIN_SHARE, drawn
from tests.campaigns.world.plans import Plan
from tests.campaigns.world.play import Player, Verdict, play

_AT_ONCE = 20


def setting(text: str) -> UpgradeOptions:
    """Options by name: "attempts=10,packet_tries=20"."""
    given = dict(word.split("=") for word in text.split(",") if word)
    whole = {"attempts", "patient_tries", "packet_tries", "end_tries"}
    values = {name: int(value) if name in whole else float(value) for name, value in given.items()}
    return Profile(BMS).upgrade_options(**values)


def played(seed: int, options: str = "", twin_share: float = TWIN_SHARE) -> Verdict:
    return play(drawn(seed, twin_share), setting(options))


def verdicts(
    seeds: Sequence[int], chosen: argparse.Namespace, options: str = ""
) -> Iterator[tuple[int, Verdict]]:
    with ProcessPoolExecutor(chosen.jobs, initializer=partial(os.nice, 10)) as pool:
        work = partial(played, options=options, twin_share=chosen.duplicates)
        yield from zip(seeds, pool.map(work, seeds, chunksize=_AT_ONCE), strict=True)


def say(line: str = "") -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def table(rows: Iterable[Sequence[object]], head: Sequence[str]) -> None:
    texts = [list(head), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(row[index]) for row in texts) for index in range(len(head))]
    for number, row in enumerate(texts):
        say(
            "| "
            + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            + " |"
        )
        if number == 0:
            say("|" + "|".join("-" * (width + 2) for width in widths) + "|")


def _kind(verdict: Verdict) -> str:
    return "two devices" if verdict.had_twin else "one device"


def report(found: Sequence[tuple[int, Verdict]]) -> bool:
    """The tables; True when the oracle found nothing wrong."""
    counts: Counter[tuple[str, str]] = Counter()
    bricked: Counter[tuple[str, str]] = Counter()
    for _, verdict in found:
        key = (_kind(verdict), verdict.ending)
        counts[key] += 1
        bricked[key] += verdict.left.startswith("none")
    say()
    rows = [
        (kind, ending, count, bricked[kind, ending])
        for (kind, ending), count in sorted(counts.items(), key=lambda each: (each[0][0], -each[1]))
    ]
    table(rows, ("bus", "ending", "runs", "left without an application"))
    wrong: dict[str, list[tuple[int, str, Verdict]]] = {}
    for seed, verdict in found:
        for fault in verdict.faults:
            wrong.setdefault(fault.partition(":")[0], []).append((seed, fault, verdict))
    unseen = wrong.pop("UNSEEN", [])
    latest = max((verdict.lateness for _, verdict in found), default=0.0)
    say(f"\nlatest end: {latest:.5f} of the announced deadline")
    for word in ("FALSE", "DISHONEST", "HANG", "LATE", "UNDOCUMENTED", "INTERNAL"):
        say(f"{word.lower()}: {len(wrong.get(word, ()))}")
    say(f"unseen: {len(unseen)} (one of two devices sent nothing of its own: docs, safety)")
    for word, entries in wrong.items():
        for seed, fault, verdict in entries[:200]:
            say(f"\n{fault}\n  seed {seed}, {verdict.ending}\n  {verdict.plan}")
        if len(entries) > 200:
            say(f"... {len(entries) - 200} more {word}")
    return not wrong


def compare(found: Sequence[tuple[int, Verdict]], chosen: argparse.Namespace) -> None:
    """What other patience saves of the runs that left the device without an application."""
    lost = [(seed, v) for seed, v in found if v.left.startswith("none") and v.ending != "cancelled"]
    rows: list[tuple[object, ...]] = [_row(chosen.options or "default", lost)]
    before = dict(lost)
    for each in chosen.settings:
        again = list(verdicts([seed for seed, _ in lost], chosen, each))
        rows.append(_row(each or "default", again))
        saved = Counter(before[s].ending for s, v in again if v.is_good)
        counts = ", ".join(f"{count} {ending}" for ending, count in saved.most_common())
        say(f"{each or 'default'}: saved {counts}")
    say()
    table(rows, ("setting", "lost", "saved", "median time to give up", "longest", "faults"))


def _row(name: str, now: Sequence[tuple[int, Verdict]]) -> tuple[object, ...]:
    saved = sum(v.is_good for _, v in now)
    times = sorted(v.took_s for _, v in now if not v.is_good) or [0.0]
    faults = sum(bool(v.faults) for _, v in now)
    median, most = times[len(times) // 2], times[-1]
    return name, len(now) - saved, saved, f"{median:.1f} s", f"{most:.1f} s", faults


def replay(line: str, options: str, *, verbose: bool) -> int:
    player = Player(Plan.parse(line), setting(options), verbose=verbose)
    verdict = player.play()
    for each in player.log:
        say(each)
    for name, value in vars(verdict).items():
        say(f"{name}: {value}")
    return int(any(not fault.startswith("UNSEEN") for fault in verdict.faults))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--twins", type=float, default=TWIN_SHARE, help="share with two devices")
    parser.add_argument("--options", default="", help="for all runs, as attempts=10,packet_tries=9")
    parser.add_argument("--settings", nargs="*", default=[], metavar="OPTIONS")
    parser.add_argument("--show", type=int, metavar="SEED", help="print the plan of a seed")
    parser.add_argument("--replay", metavar="LINE", help="play this plan; - reads it from stdin")
    parser.add_argument("-v", "--verbose", action="store_true", help="with every frame")
    chosen = parser.parse_args()
    if chosen.show is not None:
        for clause in drawn(chosen.show, chosen.duplicates).clauses:
            say(str(clause))
        return 0
    if chosen.replay is not None:
        line = sys.stdin.read() if chosen.replay == "-" else chosen.replay
        return replay(line, chosen.options, verbose=chosen.verbose)
    seeds = range(chosen.first_seed, chosen.first_seed + chosen.runs)
    began = time.perf_counter()
    found = []
    for number, each in enumerate(verdicts(seeds, chosen, chosen.options), 1):
        found.append(each)
        if number % 1000 == 0:
            rate = 60 * number / (time.perf_counter() - began)
            say(f"{number} of {len(seeds)} runs, {rate:,.0f} a minute")
    say(f"{len(found)} runs, {60 * len(found) / (time.perf_counter() - began):,.0f} a minute")
    is_clean = report(found)
    if chosen.settings:
        compare(found, chosen)
    return int(not is_clean)


if __name__ == "__main__":
    sys.exit(main())
