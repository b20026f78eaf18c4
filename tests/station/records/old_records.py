"""Records of schema 2, the last one before schema changes by Alembic: 50 runs of all kinds, with
keys, heads and traces. They were made once, by the flasher of that schema:

    python -m tests.station.records.old_records

It writes `schema_2/sqlite.zip`. Never make them anew with a later
flasher: the tests need what a plant has.
"""

from __future__ import annotations

import tempfile
import zipfile
from datetime import timedelta
from pathlib import Path

from flasher.station.records.model import AuditEvent, Measurement, RunState, StepState
from tests.station.factory import USUAL, Bench

FOLDER = Path(__file__).parent / "schema_2"
GOLDEN = '\n[golden]\nserial_numbers = ["W2600001"]\nshift_starts = ["00:00"]\n'
_VERSIONS = {
    kind: f'duplicate = "{kind}"\n' + USUAL.replace('"4"', f'"{revision}"')
    for revision, kind in enumerate(("verify-only", "reflash-with-reason"), 5)
}


def fill(bench: Bench) -> None:
    """50 runs: of each kind and in each state that this flasher knows."""
    store = bench.store
    store.note(AuditEvent.OPERATOR, {"operator": "jo"})
    serials = [f"W26051{number:02}" for number in range(40)]
    for number, serial in enumerate(serials[:24]):
        bench.make(serial=serial, socket="AB"[number % 2], lot=f"L{number // 10}")
    for number, serial in enumerate(serials[24:32]):
        state = (RunState.FAIL, RunState.ERROR, RunState.ABORTED)[number % 3]
        bench.make(state, serial=serial, code=("VERSION", "NO_ANSWER", "STOPPED")[number % 3])
    for serial in serials[24:28]:
        bench.make(serial=serial, socket="B")  # production after FAIL, recheck after the others
    bench.use(_VERSIONS["verify-only"])
    for serial in serials[:3]:
        bench.make(serial=serial)
    bench.use(_VERSIONS["reflash-with-reason"])
    for serial in serials[3:6]:
        bench.make(serial=serial, reason="label was torn", lot="L0")
    bench.use(USUAL.replace('"4"', '"7"') + GOLDEN)
    bench.make(serial="W2600001", socket="A")
    bench.make(serial=serials[32], socket="A")
    bench.use(USUAL)
    _measured(bench, serials[33])
    _second_station(bench, serials[34])
    store.rotate_key("jo")
    bench.clock.go_on(timedelta(days=1).total_seconds())
    bench.make(serial=serials[35], is_virtual=True)
    bench.make(RunState.FAIL, serial=serials[36], is_virtual=True)
    # Two runs whose station died: one was found at its next start, one goes on.
    bench.claim(serials[37], "A")
    bench.clock.go_on(5.0)
    store.close()
    bench.store = store = bench.opened()
    store.recover()
    running = bench.claim(serials[38], "B")
    store.intent(running.run_id, "bms", "flash", "V1r0r4_20220512")


def _measured(bench: Bench, serial: str) -> None:
    """A run with measurements and a repeated step."""
    run_id = bench.claim(serial).run_id
    voltage = Measurement("voltage", 36.2, "V", 30.0, 42.0)
    name = Measurement("hardware", text="V1r0r0_1", expected="V1r0r0_1")
    for state in (StepState.FAIL, StepState.PASS):
        bench.store.step(
            run_id, "check", state, duration_s=0.5, code="" if state is StepState.PASS else "LOW",
            measurements=[voltage, name],
        )  # fmt: skip
    bench.work(run_id)
    bench.store.finish(run_id, bench.ending(trace=bench.traced(serial)))


def _second_station(bench: Bench, serial: str) -> None:
    """A run of another station in the same records."""
    first = bench.store
    with bench.opened("line-3") as bench.store:
        bench.store.recover()
        bench.make(serial=serial, socket="A")
    bench.store = first


def _pack(folder: Path, names: tuple[str, ...], target: Path) -> None:
    target.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in names:
            top = folder / name
            for path in sorted(top.rglob("*")) if top.is_dir() else [top]:
                if path.is_file() and path.suffix != ".lock":
                    packed.write(path, path.relative_to(folder))


def unpack(folder: Path) -> None:
    """The old records; keys are readable by their user only, as a station wants."""
    with zipfile.ZipFile(FOLDER / "sqlite.zip") as packed:
        packed.extractall(folder)
    for path in (folder / "keys").iterdir():
        path.chmod(0o600)


def main() -> None:
    with tempfile.TemporaryDirectory() as made:
        bench = Bench(Path(made))
        fill(bench)
        bench.store.close()
        kept = ("records.sqlite", "records.sqlite.files", "keys")
        _pack(bench.folder, kept, FOLDER / "sqlite.zip")


if __name__ == "__main__":
    main()
