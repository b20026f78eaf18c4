"""Time and memory that verifying adds to a flash:
`python -m tests.benchmarks.release_verification`.
"""

from __future__ import annotations

import datetime
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from flasher import jobs
from flasher.protocol.spec import BMS
from flasher.settings.profile import load_profile

_ROUNDS = 50


def _milliseconds(run: Callable[[], object]) -> float:
    times = []
    for _ in range(_ROUNDS):
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return statistics.median(times) * 1000


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for name in ("CONFIG_HOME", "CONFIG_DIRS", "DATA_HOME"):
            os.environ[f"XDG_{name}"] = f"{folder}/{name}"
        profile = load_profile(os.devnull, BMS)
        image = Path(__file__).parents[2] / "firmware_samples" / "bms.bin"
        plain = Path(folder) / "bms.bin"
        plain.write_bytes(image.read_bytes())
        jobs.prepare(plain, profile).checked()
        print(f"without a trust file: {_milliseconds(lambda: jobs.prepare(plain, profile)):.2f} ms")
        before = _peak_mb()
        began = time.perf_counter()
        import securesystemslib.signer  # noqa: PLC0415, F401  what it costs is measured

        print(f"loading the packages, once: {(time.perf_counter() - began) * 1000:.0f} ms")
        print(f"  memory: {_peak_mb() - before:.1f} MB more at the peak")
        from flasher.release import verify  # noqa: PLC0415
        from flasher.release.store import TrustStore  # noqa: PLC0415
        from tests.release.maker import (  # noqa: PLC0415
            Maker,
            chain_of,
            first_trust,
            opened,
            role,
        )

        both = role("anna", "bert", threshold=2)
        maker = Maker(chain_of(first_trust(release={"bms": both})))
        TrustStore().install(maker.chain)
        raw = maker.release(signers=("anna", "bert"))
        path = Path(folder) / "bike.wfw"
        path.write_bytes(raw)
        jobs.prepare(path, profile).checked()
        before = _peak_mb()
        signed = _milliseconds(lambda: jobs.prepare(path, profile))
        print(f"a release, 2 of 2 signatures: {signed:.2f} ms")
        package, trust = opened(raw), maker.chain.newest
        print(f"  opening it: {_milliseconds(lambda: opened(raw)):.2f} ms")
        signatures = _milliseconds(lambda: trust.signers(both, package.envelope))
        print(f"  its signatures: {signatures:.2f} ms")
        today = datetime.datetime.now(datetime.UTC).date()
        whole = _milliseconds(lambda: verify.provenance_of(package, BMS, today))
        print(f"  all that the trust file asks for: {whole:.2f} ms")
        print(f"  memory: {_peak_mb() - before:.1f} MB more at the peak")


if __name__ == "__main__":
    main()
