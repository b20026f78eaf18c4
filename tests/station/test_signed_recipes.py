"""Recipes with signed releases: what is refused, when, and what the records state."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.mock.model import MockDevice
from flasher.protocol.spec import BMS
from flasher.release.store import TrustStore
from flasher.settings.manifest import release_of, to_toml
from flasher.station.certificate import proven, render_certificate
from flasher.station.certificate_check import check_certificate
from flasher.station.codes import Code
from flasher.station.recipe_file import load_checked, load_recipe
from flasher.station.records.errors import ClaimRefusedError, Refusal
from flasher.station.records.model import (
    Claim,
    Measurement,
    Order,
    RunState,
    Signature,
    StepState,
)
from flasher.station.runs import with_history
from flasher.station.unit_checks import signature_measurements
from tests.release.maker import Maker, chain_of, first_trust, maker, role, trusted
from tests.station.factory import DAY, HEAD, IMAGES, SERIAL, SERIAL_NUMBER, Bench, target_table
from tests.station.unit_bench import NEW_UNIT, WRITES, UnitBench

__all__ = ["maker"]  # a fixture

USUAL = HEAD + SERIAL_NUMBER


def table(signature: str = "", image: str = "bike.wfw") -> str:
    """A `[[target]]` with a release."""
    more = f'signature = "{signature}"\n' if signature else ""
    return target_table(BMS, more).replace("bms.bin", image)


def recipe_with(folder: Path, text: str, release: bytes | None = None) -> Path:
    """A recipe whose folder has a release, and an unsigned image with its manifest."""
    (folder / "bms.bin").write_bytes(IMAGES[BMS].data)
    (folder / "bms.bin.toml").write_text(to_toml(release_of(IMAGES[BMS], BMS)), encoding="utf-8")
    if release is not None:
        (folder / "bike.wfw").write_bytes(release)
    path = folder / "recipe.toml"
    path.write_text(USUAL + text, encoding="utf-8")
    return path


def released(maker: Maker, folder: Path, counter: int = 1, **options: object) -> bytes:
    """A release of the station's image."""
    (folder / "bms.bin").write_bytes(IMAGES[BMS].data)
    return maker.release(counter, images={BMS: folder / "bms.bin"}, **options)  # type: ignore[arg-type]


def refused(path: Path) -> str:
    """Everything that is wrong with a recipe."""
    with pytest.raises(UsageError) as caught:
        load_checked(path, DAY)
    return "\n".join(map(str, caught.value.faults))


def signature_of(path: Path) -> Signature | None:
    (target,) = load_checked(path, DAY).targets
    return target.signature()


# -- when the recipe is read -----------------------------------------------------------------------


def test_a_signed_release_is_read_with_its_manifest(tmp_path: Path, maker: Maker) -> None:
    path = recipe_with(tmp_path, table("required"), released(maker, tmp_path, 7))
    loaded = load_checked(path, DAY)
    (target,) = loaded.targets
    assert target.image.data == IMAGES[BMS].data
    assert tmp_path / "bike.wfw" in loaded.files
    found = target.signature()
    assert found is not None
    assert (found.product, found.counter) == ("48V", 7)
    assert "(anna), keys needed: 1, trust file version 1" in found.text


def test_a_release_beside_its_image_is_read_too(tmp_path: Path, maker: Maker) -> None:
    path = recipe_with(tmp_path, table("required", "bms.bin"))
    raw = released(maker, tmp_path, 7, is_detached=True)
    (tmp_path / "bms.bin.wfw").write_bytes(raw)
    loaded = load_checked(path, DAY)
    assert tmp_path / "bms.bin.wfw" in loaded.files
    assert loaded.targets[0].release.counter == 7


@pytest.mark.parametrize("signature", ["", "checked", "required"])
def test_an_unsigned_image_is_refused_where_a_trust_file_is(
    tmp_path: Path, maker: Maker, signature: str
) -> None:
    assert maker
    reported = refused(recipe_with(tmp_path, table(signature, "bms.bin")))
    assert "bms.bin is not signed." in reported
    assert "signature = 'waived'" in reported
    assert "--allow" not in reported


def test_a_required_signature_is_required_without_a_trust_file(
    tmp_path: Path, maker: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw = released(maker, tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "none"))
    unsigned = recipe_with(tmp_path, table("required", "bms.bin"), raw)
    assert "is not signed" in refused(unsigned)
    signed = recipe_with(tmp_path, table("required"), raw)
    assert "cannot be checked" in refused(signed)
    found = signature_of(recipe_with(tmp_path, table(), raw))
    assert found is not None
    assert (found.text, found.counter) == (
        "no trust file on this computer: signatures are not checked",
        None,
    )
    assert signature_of(recipe_with(tmp_path, table("", "bms.bin"))) is None


def test_a_release_by_a_revoked_key_is_refused(tmp_path: Path, maker: Maker) -> None:
    raw = released(maker, tmp_path)
    maker.next_version(keys=trusted("root a", "root b", "bert"), release={"bms": role("bert")})
    TrustStore().install(maker.chain)
    reported = refused(recipe_with(tmp_path, table(), raw))
    assert "0 of the 1 signatures" in reported
    assert "(anna) was revoked" in reported


def test_a_release_for_another_target_is_refused(tmp_path: Path, maker: Maker) -> None:
    raw = released(maker, tmp_path)
    wmc = table("waived").replace('target = "bms"', 'target = "wmc"')
    assert "no image for the WMC" in refused(recipe_with(tmp_path, wmc, raw))


@pytest.mark.parametrize("signature", ["required", "waived"])
def test_a_tampered_release_is_refused_in_any_case(
    tmp_path: Path, maker: Maker, signature: str
) -> None:
    raw = bytearray(released(maker, tmp_path))
    at = raw.index(IMAGES[BMS].data[:20])
    raw[at + 100] ^= 1
    assert refused(recipe_with(tmp_path, table(signature), bytes(raw)))


def test_keys_for_unsigned_files_do_not_go_with_a_release(tmp_path: Path, maker: Maker) -> None:
    path = recipe_with(tmp_path, table() + "base = 0\n", released(maker, tmp_path))
    assert "Remove manifest and base" in refused(path)


def test_a_waiver_is_for_the_named_target_and_states_what_it_waives(
    tmp_path: Path, maker: Maker
) -> None:
    found = signature_of(recipe_with(tmp_path, table("waived", "bms.bin")))
    assert found == Signature("waived by the recipe: the image is not signed")
    raw = released(maker, tmp_path, signers=["a stranger"])
    found = signature_of(recipe_with(tmp_path, table("waived"), raw))
    assert found is not None
    assert found.text.startswith("waived by the recipe: bike.wfw has 0 of the 1 signatures")
    assert found.counter is None
    found = signature_of(recipe_with(tmp_path, table("waived"), released(maker, tmp_path)))
    assert found is not None
    assert found.text.startswith("signed by "), "nothing had to be waived"


# -- when a unit is claimed ------------------------------------------------------------------------


def claimed(bench: Bench, serial: str = SERIAL) -> Claim:
    """A claim as the station sends it to the process of the socket."""
    lives = bench.store.read.units(serial)
    claim = bench.store.claim(Order(serial, "A", "jo"), bench.recipe)
    return with_history(claim, lives, bench.recipe)


def passed(bench: Bench, claim: Claim, state: RunState = RunState.PASS) -> None:
    """Record a run as the process of the socket reports it."""
    noted = list(signature_measurements("bms", claim))
    bench.store.step(claim.run_id, "check", StepState.PASS, duration_s=1.0, measurements=noted)
    bench.work(claim.run_id)
    code = "OK" if state is RunState.PASS else "NO_ANSWER"
    bench.store.finish(claim.run_id, bench.ending(state, code, bench.traced(claim.serial)))
    bench.clock.go_on(2.0)


def use(bench: Bench, path: Path) -> None:
    bench.recipe = load_checked(path, DAY)


def test_a_key_that_is_revoked_during_the_shift_refuses_the_next_unit(
    bench: Bench, maker: Maker
) -> None:
    use(bench, recipe_with(bench.folder, table(), released(maker, bench.folder)))
    passed(bench, claimed(bench))
    maker.next_version(keys=trusted("root a", "root b", "bert"), release={"bms": role("bert")})
    TrustStore().install(maker.chain)
    with pytest.raises(ClaimRefusedError, match="was revoked") as caught:
        claimed(bench, "W2605003")
    assert caught.value.refusal is Refusal.RECIPE_NOT_TRUSTED
    assert len(bench.store.read.table()) == 1, "nothing was recorded"


def test_a_release_that_is_exchanged_during_the_shift_is_a_changed_recipe(
    bench: Bench, maker: Maker
) -> None:
    use(bench, recipe_with(bench.folder, table(), released(maker, bench.folder)))
    (bench.folder / "bike.wfw").write_bytes(released(maker, bench.folder, 2))
    with pytest.raises(ClaimRefusedError) as caught:
        claimed(bench)
    assert caught.value.refusal is Refusal.RECIPE_CHANGED


@pytest.mark.slow
@pytest.mark.parametrize(
    ("signature", "sentence"),
    [("required", "signed by"), ("waived", "waived by the recipe: the image is not signed")],
)
def test_record_and_certificate_state_who_signed_or_what_was_waived(
    bench: Bench, maker: Maker, signature: str, sentence: str
) -> None:
    image = "bms.bin" if signature == "waived" else "bike.wfw"
    raw = released(maker, bench.folder, 7)
    use(bench, recipe_with(bench.folder, table(signature, image), raw))
    passed(bench, claimed(bench))
    life = bench.store.read.unit(SERIAL)
    assert life.last is not None
    (target,) = life.last.targets
    assert target.signature is not None
    assert target.signature.startswith(sentence)
    now = bench.clock.utc()
    page = render_certificate(life, now, proven(bench.store, life, now))
    assert sentence in page
    assert page.count(sentence) == 1
    assert check_certificate(bench.store, page.encode()).problems == ()
    forged = page.replace(sentence, "signed by the works")
    assert check_certificate(bench.store, forged.encode()).problems


@pytest.mark.slow
def test_counters_are_those_of_the_serial_number_and_product_that_a_device_confirmed(
    bench: Bench, maker: Maker
) -> None:
    use(bench, recipe_with(bench.folder, table(), released(maker, bench.folder, 7)))
    assert claimed(bench).counters_before == {}
    bench.store.end_unknown(set())
    use(bench, recipe_with(bench.folder, table(), released(maker, bench.folder, 6)))
    assert claimed(bench).counters_before == {}, "nothing was flashed"
    bench.store.end_unknown(set())
    use(bench, recipe_with(bench.folder, table(), released(maker, bench.folder, 7)))
    passed(bench, claimed(bench), RunState.FAIL)
    older = recipe_with(bench.folder, table(), released(maker, bench.folder, 6))
    older.write_text(older.read_text().replace("BAT-36", "BAT-36-2"), encoding="utf-8")
    use(bench, older)
    assert claimed(bench).counters_before == {"bms": 7}, "of another part number, same label"
    bench.store.end_unknown(set())
    assert claimed(bench, "W2605003").counters_before == {}


# -- in the run ------------------------------------------------------------------------------------


def run(bench: UnitBench, signature: Signature, counter: int) -> tuple[str, bool]:
    """Code of a run of a unit that received a counter before, and whether it was flashed."""
    before = bench.device.stored_image
    result = bench.run(signatures={"bms": signature}, counters_before={"bms": counter})
    return result.code, bench.device.stored_image != before


def checks(bench: UnitBench) -> dict[str, Measurement]:
    return {each.name: each for step in bench.journal.reports for each in step.measurements}


@pytest.mark.parametrize("has_application", [True, False])
def test_an_older_release_than_the_records_have_for_the_unit_is_not_flashed(
    tmp_path: Path, *, has_application: bool
) -> None:
    bench = UnitBench(tmp_path)
    bench.put(
        MockDevice(BMS, bitrate_bps=250_000, profile=NEW_UNIT, has_application=has_application)
    )
    assert run(bench, Signature("signed by anna", "48V", 6), 7) == (Code.OLD_RELEASE.name, False)
    assert checks(bench)["bms signature"].text == "signed by anna"


def test_a_waived_older_release_is_flashed_and_the_record_states_it(tmp_path: Path) -> None:
    text = HEAD + SERIAL_NUMBER + target_table(BMS, 'signature = "waived"\n') + WRITES
    bench = UnitBench(tmp_path, text)
    assert run(bench, Signature("signed by anna", "48V", 6), 7) == ("OK", True)
    assert checks(bench)["bms unsigned"].text == "waived"


def test_the_same_release_and_a_newer_one_are_flashed(tmp_path: Path) -> None:
    for number, counter in enumerate((7, 8)):
        folder = tmp_path / str(number)
        folder.mkdir()
        bench = UnitBench(folder)
        code, was_flashed = run(bench, Signature("signed by anna", "48V", counter), 7)
        assert (code, was_flashed) == ("OK", True)
        assert checks(bench)["bms release counter"].value == counter
        assert checks(bench)["bms release product"].text == "48V"


def test_a_trust_file_that_comes_during_a_run_refuses_an_unsigned_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = UnitBench(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    TrustStore().install(chain_of(first_trust()))
    assert bench.run().code == Code.NOT_TRUSTED.name
    assert bench.device.stored_image != IMAGES[BMS].data


def test_the_process_of_a_socket_checks_for_itself(tmp_path: Path, maker: Maker) -> None:
    path = recipe_with(tmp_path, table(), released(maker, tmp_path, signers=["a stranger"]))
    with pytest.raises(UsageError):
        load_recipe(path)


def test_dates_decide_nothing(tmp_path: Path, maker: Maker) -> None:
    path = recipe_with(tmp_path, table(), released(maker, tmp_path))
    assert load_checked(path, date(2040, 1, 1)).targets
