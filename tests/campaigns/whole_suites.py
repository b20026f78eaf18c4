"""Runs the whole suite where its tests leave the longest cases out:
`python -m tests.campaigns.whole_suites`.

A right device on bare benches and on a full one, a device of others, and a bootloader in a process
of its own by the profile that its answers give. What is found is a fault of the suite.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from functools import partial
from typing import Final

from flasher.conformance.catalogue import CASES, WEAR, catalogue_order
from tests.conformance import test_gaps, test_init, test_other_device

_CASES: Final = tuple(catalogue_order(CASES))
_CHECKS: Final = (
    *(partial(test_gaps.check_bare_bench, *bench, _CASES) for bench in test_gaps.BENCHES),
    partial(test_gaps.check_full_bench, _CASES),
    partial(test_other_device.check_right_device, _CASES),
    partial(test_init.check_python_bootloader, [one for one in _CASES if one not in WEAR]),
)


def main() -> int:
    argparse.ArgumentParser(description=__doc__).parse_args()
    wrong = 0
    for check in _CHECKS:
        name = f"{check.func.__name__}{check.args[:-1] or ''}"
        try:
            check()
        except AssertionError:
            wrong += 1
            sys.stdout.write(f"{name}: {traceback.format_exc()}\n")
        else:
            sys.stdout.write(f"{name}: nothing is wrong\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
