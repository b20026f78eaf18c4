"""Fuzzes what flasher reads, guided by coverage: `python -m tests.fuzz [NAME ...] --seconds 600`.

    python -m tests.fuzz                          every harness, each in a process of its own
    python -m tests.fuzz reassembler --jobs 2     one or several
    python -m tests.fuzz manifest FILE            run an input again, without atheris
    python -m tests.fuzz --merge                  keep of what was found what reaches more

Ends with 1 if an input breaks a harness, and names the file with it. What was found is kept in
FOLDER, and is where the next run begins. Needs atheris (Linux on x86-64, with the extra `dev`).
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from tests.fuzz.harness import CORPUS, MODULES, find

ROOT: Final = Path(__file__).parents[2]
CHILD: Final = ("-m", "tests.fuzz.instrumented")
HANG_S: Final = 60
MEMORY_MAX_MB: Final = 1024
"""Of the whole process, most of which is Python and what it imports."""
FINDINGS: Final = ("crash-", "oom-", "timeout-")
_REACHED: Final = re.compile(r"cov: (\d+) ft: (\d+)")
_STATISTIC: Final = re.compile(r"stat::(\w+): +(\d+)")


@dataclass(frozen=True)
class Outcome:
    """What a fuzzer did."""

    name: str
    executions: int
    per_s: int
    edges: int
    features: int
    findings: tuple[Path, ...]
    failure: str
    """The end of its output, if it ended otherwise than it should."""

    def __str__(self) -> str:
        return (
            f"{self.name:20} {self.executions:>11,} {self.per_s:>9,} {self.edges:>7,} "
            f"{self.features:>9,} {len(self.findings):>9}"
        )


HEAD: Final = (
    f"{'harness':20} {'executions':>11} {'a second':>9} {'edges':>7} {'features':>9} "
    f"{'findings':>9}\n"
)


@contextmanager
def isolated() -> Iterator[dict[str, str]]:
    """An environment whose files are in memory if possible, and go."""
    memory = Path("/dev/shm")  # noqa: S108
    where = memory if memory.is_dir() else None
    with tempfile.TemporaryDirectory(dir=where, prefix="flasher-fuzz-") as folder:
        own = ("TMPDIR", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "HOME")
        yield {**os.environ, **dict.fromkeys(own, folder)}


def _run(
    name: str, options: Sequence[object], child: Sequence[str] = CHILD
) -> subprocess.CompletedProcess[str]:
    with isolated() as environment:
        return subprocess.run(
            [sys.executable, *child, name, *map(str, options)],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            check=False,
        )


def _write_seeds(name: str, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(find(name).seeds()):
        (folder / f"seed-{number:03}").write_bytes(seed)


def _dictionary(name: str, folder: Path) -> list[str]:
    words = [word if isinstance(word, bytes) else word.encode() for word in find(name).words()]
    if not words:
        return []
    path = folder / "words.txt"
    quoted = ("".join(f"\\x{byte:02x}" for byte in word) for word in words)
    path.write_text("".join(f'"{word}"\n' for word in quoted))
    return [f"-dict={path}"]


def fuzz(
    name: str, folder: Path, *, seconds: int = 0, runs: int = -1, child: Sequence[str] = CHILD
) -> Outcome:
    """Fuzz one harness for some seconds or runs, in `folder`."""
    own = folder / name
    found, seeds = own / "corpus", own / "seeds"
    found.mkdir(parents=True, exist_ok=True)
    _write_seeds(name, seeds)
    kept = CORPUS / name
    before = set(own.iterdir())
    done = _run(
        name,
        [
            f"-max_total_time={seconds}",
            f"-runs={runs}",
            f"-max_len={find(name).max_size}",
            f"-timeout={HANG_S}",
            f"-rss_limit_mb={MEMORY_MAX_MB}",
            f"-artifact_prefix={own}/",
            "-print_final_stats=1",
            *_dictionary(name, own),
            found,
            seeds,
            *([kept] if kept.is_dir() else []),
        ],
        child,
    )
    (own / "log.txt").write_text(done.stdout)
    statistics = {key: int(value) for key, value in _STATISTIC.findall(done.stdout)}
    reached = _REACHED.findall(done.stdout)
    edges, features = map(int, reached[-1]) if reached else (0, 0)
    findings = tuple(
        sorted(path for path in set(own.iterdir()) - before if path.name.startswith(FINDINGS))
    )
    return Outcome(
        name,
        statistics.get("number_of_executed_units", 0),
        statistics.get("average_exec_per_sec", 0),
        edges,
        features,
        findings,
        _cause(done.stdout) if done.returncode else "",
    )


def _cause(output: str) -> str:
    """The end of the traceback or, without one, of the output."""
    lines = [line for line in output.splitlines() if not line.startswith(("INFO:", "#"))]
    ends = [at for at, line in enumerate(lines) if "ERROR: libFuzzer" in line]
    end = ends[0] + 1 if ends else len(lines)
    return "\n".join(lines[max(0, end - 14) : end])


def merge(name: str, folder: Path) -> str:
    """Put what reaches more than the seeds do into the corpus that is committed; a line on it."""
    own, kept = folder / name, CORPUS / name
    merged, seeds = own / "merged", own / "seeds"
    for each in (merged, seeds):
        shutil.rmtree(each, ignore_errors=True)
    _write_seeds(name, seeds)
    shutil.copytree(seeds, merged)
    sources = [path for path in (own / "corpus", kept) if path.is_dir()]
    # Edges alone, not how often each was passed: a hundredth of the files.
    options = ["-set_cover_merge=1", "-use_counters=0", f"-max_len={find(name).max_size}"]
    done = _run(name, [*options, merged, *sources])
    if done.returncode:
        return f"{name}: {_cause(done.stdout)}"
    fresh = {path.name: path.read_bytes() for path in merged.iterdir()}
    fresh = {name: data for name, data in fresh.items() if not (seeds / name).exists()}
    shutil.rmtree(kept, ignore_errors=True)
    if fresh:
        kept.mkdir(parents=True)
    for file_name, data in fresh.items():
        (kept / file_name).write_bytes(data)
    return f"{name}: {len(fresh)} files, {sum(map(len, fresh.values())):,} bytes"


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=f"Harnesses: {', '.join(MODULES)}.",
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="harnesses, or one and a FILE")
    parser.add_argument("--seconds", type=int, default=600, help="for each (600)")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time (1)")
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "fuzz")
    parser.add_argument("--merge", action="store_true", help="renew tests/fuzz/corpus")
    options = parser.parse_args()
    names = [name for name in options.names if name in MODULES]
    others = [name for name in options.names if name not in MODULES]
    if len(names) == len(others) == 1 and Path(others[0]).is_file():
        with isolated() as environment:
            os.environ.update(environment)
            find(names[0]).take(Path(others[0]).read_bytes())
        sys.stdout.write("The harness takes it.\n")
        return 0
    if others:
        parser.error(f"no harness: {', '.join(others)}")
    if find_spec("atheris") is None:
        parser.error(
            "atheris is not installed: it is in the extra `dev`, for Linux on x86-64 and Python up "
            "to 3.13"
        )
    folder = options.folder.resolve()
    work = merge if options.merge else partial(fuzz, seconds=options.seconds)
    if not options.merge:
        sys.stdout.write(HEAD)
    is_bad = False
    with ThreadPoolExecutor(options.jobs) as pool:
        for done in pool.map(lambda name: work(name, folder), names or MODULES):
            sys.stdout.write(f"{done}\n")
            sys.stdout.flush()
            if isinstance(done, Outcome) and (done.failure or done.findings):
                is_bad = True
                found = "".join(
                    f"python -m tests.fuzz {done.name} {path}\n" for path in done.findings
                )
                sys.stdout.write(f"{done.failure}\n{found}")
    return int(is_bad)


if __name__ == "__main__":
    sys.exit(main())
