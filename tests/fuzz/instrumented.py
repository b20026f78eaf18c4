"""The process of one fuzzer: `python -m tests.fuzz.instrumented NAME [OPTION ...] [FOLDER ...]`.

The options are those of libFuzzer. Instrumented are flasher and, of what it reads with, the readers
in Python that see the bytes first.
"""

from __future__ import annotations

import sys

import atheris

_INSTRUMENTED = ["flasher", "can.io", "bincopy", "tomllib"]

with atheris.instrument_imports(include=_INSTRUMENTED):
    from tests.fuzz.harness import find

    name, *options = sys.argv[1:]
    harness = find(name)
    for seed in harness.seeds():  # what is imported by need is instrumented too
        harness.take(seed)

# libFuzzer merges in processes of its own, which it starts by the first word.
again = f"{sys.executable} -m tests.fuzz.instrumented {name}"
atheris.Setup([again, *options], harness.take)
atheris.Fuzz()
