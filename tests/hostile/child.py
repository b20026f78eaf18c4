"""Runs commands of flasher, each in a process of its own, and tells what each of them cost.

`python -m tests.hostile.child` reads [[folder, words], ...] as JSON from stdin. For each it writes
[exit code, stdout, stderr, seconds of processor time, megabytes at the peak]. Processes are made by
forks: what it takes to start Python is neither paid nor counted each time.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import signal
import sys
import tempfile

# What they need, once.
import flasher.cli.bench.conformance
import flasher.cli.look.explain
import flasher.cli.look.monitor
import flasher.cli.station.check
import flasher.cli.station.run
import flasher.cli.upgrade.flash
import flasher.cli.upgrade.image_info
import flasher.cli.upgrade.manifest
import flasher.cli.upgrade.profile
import flasher.conformance.bench_options
import flasher.conformance.diff
import flasher.conformance.runner
import flasher.trace.source  # noqa: F401
from flasher.cli.main import main

PROCESSOR_LIMIT_S = 30
WALL_LIMIT_S = 60
MEMORY_LIMIT = 3 << 30
"""A command that gets near to these has failed long before; they keep the machine alive."""


def run(folder: str, words: list[str]) -> tuple[int, str, str, float, float]:
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if not child:
            os.chdir(folder)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(out.fileno(), 1)
            os.dup2(err.fileno(), 2)
            resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_LIMIT_S, PROCESSOR_LIMIT_S))
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT, MEMORY_LIMIT))
            signal.alarm(WALL_LIMIT_S)
            code = 1
            try:
                code = main(words)
                sys.stdout.flush()
                sys.stderr.flush()
            finally:
                os._exit(code)
        _, status, used = os.wait4(child, 0)
        reported = []
        for file in (out, err):
            file.seek(0)
            reported.append(file.read().decode("utf-8", "replace"))
    seconds = used.ru_utime + used.ru_stime
    return (
        os.waitstatus_to_exitcode(status),
        reported[0],
        reported[1],
        seconds,
        used.ru_maxrss / 1024,
    )


if __name__ == "__main__":
    gc.freeze()  # or each fork copies what the collector touches
    json.dump([run(folder, words) for folder, words in json.load(sys.stdin)], sys.stdout)
