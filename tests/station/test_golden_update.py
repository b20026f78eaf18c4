"""After an update of flasher or of the recipe, a golden unit has to pass before other units."""

from __future__ import annotations

import pytest

from flasher.station import station as station_module
from flasher.station.events import RunEnded, RunStarted, ScanRefused
from flasher.station.recipe_file import load_checked
from flasher.station.records.errors import SchemaVersionError
from flasher.station.records.model import AuditEvent, RunState
from flasher.station.records.schema import SCHEMA_VERSION
from tests.station.factory import DAY, SERIAL, USUAL, Bench
from tests.station.line_bench import LineBench

GOLDEN = "W2605000"
OTHER = "W2605003"
TEXT = USUAL + f'\n[golden]\nserial_numbers = ["{GOLDEN}"]\nevery_h = 100\n'


class Requiring(LineBench):
    """A station whose file has golden_unit = "required"."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench, "A", needs_golden=True)

    def run(self, serial: str, outcome: RunState = RunState.PASS) -> None:
        self.scan(serial)
        self.arrive("A")
        if self.of(RunStarted) and self.last(RunStarted).serial == serial:
            self.work("A")
            self.end("A", outcome, "OK" if outcome is RunState.PASS else "NO_ANSWER")
        self.leave("A")


def begun(line: LineBench) -> list[str]:
    return [each.serial for each in line.of(RunStarted)]


@pytest.mark.slow
def test_a_golden_unit_releases_this_flasher_with_this_recipe(bench: Bench) -> None:
    bench.use(TEXT)
    line = Requiring(bench)
    line.run(SERIAL)
    refused = line.last(ScanRefused)
    assert (refused.code, GOLDEN in refused.remedy) == ("GOLDEN_DUE", True)
    assert begun(line) == []
    line.run(GOLDEN)
    assert line.last(RunEnded).run.state is RunState.PASS
    (row,) = bench.store.read.noted("line-2", AuditEvent.RELEASED)
    assert (row["recipe_sha256"], row["serial"]) == (bench.recipe.sha256, GOLDEN)
    line.run(SERIAL)
    assert begun(line) == [GOLDEN, SERIAL]
    assert bench.store.examine().problems == ()


def test_a_golden_unit_that_fails_releases_nothing(bench: Bench) -> None:
    bench.use(TEXT)
    line = Requiring(bench)
    line.run(GOLDEN, RunState.FAIL)
    line.run(SERIAL)
    assert begun(line) == [GOLDEN]
    assert bench.store.read.noted("line-2", AuditEvent.RELEASED) == []


@pytest.mark.slow
@pytest.mark.parametrize("what", ["flasher", "recipe", "manifest"])
def test_each_update_needs_a_golden_unit_again_and_going_back_does_not(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    bench.use(TEXT)
    Requiring(bench).run(GOLDEN)
    with monkeypatch.context() as updated:
        if what == "flasher":
            updated.setattr(station_module, "__version__", "99.0")
        elif what == "manifest":
            bench.use(TEXT)
            manifest = bench.recipe.path.with_name("bms.bin.toml")
            manifest.write_bytes(manifest.read_bytes() + b"# other\n")
            bench.recipe = load_checked(bench.recipe.path, DAY)
        else:
            bench.use(TEXT.replace('revision = "4"', 'revision = "5"'))
        line = Requiring(bench)
        line.run(SERIAL)
        assert line.last(ScanRefused).code == "GOLDEN_DUE"
        assert begun(line) == []
    bench.use(TEXT)
    line = Requiring(bench)
    line.run(OTHER)
    assert begun(line) == [OTHER], "the records know that it was released"


def test_without_the_rule_nothing_is_recorded(bench: Bench) -> None:
    bench.use(TEXT)
    line = LineBench(bench, "A")
    line.scan(GOLDEN)
    line.arrive("A")
    line.work("A")
    line.end("A")
    assert bench.store.read.noted("line-2", AuditEvent.RELEASED) == []


def test_an_older_flasher_leaves_newer_records_alone_and_names_the_copy(bench: Bench) -> None:
    """What a newer flasher does to them: a copy, then another schema."""
    run_id = bench.make()
    bench.store.close()
    copy = bench.path.with_name(f"{bench.path.name}.schema-{SCHEMA_VERSION}")
    with bench.outsider() as other:
        other.execute("VACUUM INTO ?", (str(copy),))
        other.execute("UPDATE alembic_version SET version_num = '99'")
        other.commit()
    newer = bench.path.read_bytes()
    with pytest.raises(SchemaVersionError) as caught:
        bench.opened()
    assert caught.value.remedy.startswith("Use that newer flasher. To go back for good, put ")
    assert copy.name in caught.value.remedy
    assert bench.path.read_bytes() == newer
    bench.path.rename(bench.path.with_name("newer.sqlite"))
    copy.rename(bench.path)
    bench.store = bench.opened()
    bench.store.recover()
    assert bench.store.read.run(run_id).run.state is RunState.PASS
    assert bench.store.examine().problems == ()
