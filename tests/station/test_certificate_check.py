"""A certificate that is checked: one changed character of it is reported."""

from __future__ import annotations

import base64
import json
import random
import re
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import segno

from flasher.errors import FlasherError, UsageError
from flasher.station.certificate import code_lines, proven, render_certificate
from flasher.station.certificate_check import check_certificate
from flasher.station.records.chain import canonical, digest
from flasher.station.records.errors import UnprovenError
from flasher.station.records.model import Measurement, RunId, RunState, StepState
from flasher.station.records.signatures import SigningKey
from flasher.station.sealed import CheckedCertificate
from tests.loops import each, sample
from tests.station.factory import SERIAL, Bench

MARKS = ("-----BEGIN FLASHER CERTIFICATE-----", "-----END FLASHER CERTIFICATE-----")


@pytest.fixture(autouse=True, scope="module")
def each_code_is_drawn_once() -> Iterator[None]:
    """Half the time of a check is that of the QR code, which is the same in all of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segno, "make", cache(segno.make))
        yield


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """A unit that failed first, and one with a text that a page has to escape."""
    made = Bench(tmp_path_factory.mktemp("plant"))
    made.make(RunState.FAIL)
    made.make(lot="L<1> & ﬁ")
    run_id = made.claim("W2605003").run_id
    made.work(run_id)
    reported = [Measurement("voltage", 36.25, "V", 30.0, 42.0), Measurement("model", text="<b>M1")]
    made.store.step(run_id, "check", StepState.PASS, duration_s=1.0, measurements=reported)
    made.store.finish(run_id, made.ending(trace=made.traced("W2605003")))
    yield made
    made.store.close()


def page(bench: Bench, serial: str = SERIAL, language: str = "en") -> str:
    life = bench.store.read.unit(serial)
    now = bench.clock.utc()
    return render_certificate(life, now, proven(bench.store, life, now), language)


def checked(bench: Bench, text: str) -> CheckedCertificate:
    return check_certificate(bench.store, text.encode("utf-8"))


def is_refused(bench: Bench, text: str) -> bool:
    try:
        return bool(checked(bench, text).problems)
    except (UsageError, UnprovenError):
        return True


def carried(text: str) -> dict[str, Any]:
    block = re.search(f"{MARKS[0]}(.*?){MARKS[1]}", text, re.DOTALL)
    assert block is not None
    found: dict[str, Any] = json.loads(zlib.decompress(base64.b64decode(block[1])))
    return found


def carrying(text: str, content: dict[str, Any]) -> str:
    data = base64.b64encode(zlib.compress(canonical(content).encode(), 9)).decode()
    lines = "\n".join(data[at : at + 96] for at in range(0, len(data), 96))
    block = f"{MARKS[0]}\n{lines}\n{MARKS[1]}"
    return re.sub(f"{MARKS[0]}.*?{MARKS[1]}", block, text, flags=re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("serial", [SERIAL, "W2605003"])
def test_a_certificate_as_it_was_written_is_proven(plant: Bench, serial: str) -> None:
    found = checked(plant, page(plant, serial))
    assert found.problems == ()
    assert found.remarks == ()
    assert (found.serial, found.state, found.station) == (serial, RunState.PASS, "line-2")
    assert found.fingerprint == checked(plant, page(plant)).fingerprint


@pytest.mark.slow
@pytest.mark.parametrize(("language", "measured"), [("de", "36,25 V"), ("zh", "36.25 V")])
def test_a_certificate_in_another_language_is_checked(
    plant: Bench, language: str, measured: str
) -> None:
    text = page(plant, "W2605003", language)
    assert measured in text
    assert "Written to the unit" not in text
    assert checked(plant, text).problems == ()
    assert is_refused(plant, text.replace(measured, "36.9 V"))
    assert is_refused(plant, text.replace(f'lang="{language}"', 'lang="en"'))


@pytest.mark.slow
def test_its_signed_lines_alone_are_enough(plant: Bench) -> None:
    block = re.search(f"{MARKS[0]}.*?{MARKS[1]}", page(plant), re.DOTALL)
    assert block is not None
    assert checked(plant, block[0].replace("\n", "  \r\n ")).problems == ()


@pytest.mark.slow
def test_one_changed_character_is_reported(plant: Bench) -> None:
    text = page(plant)
    chance = random.Random(24)
    for _ in range(sample(40, 150)):
        at = chance.randrange(len(text))
        other = chance.choice([char for char in "0aZ=<" if char != text[at]])
        assert is_refused(plant, text[:at] + other + text[at + 1 :]), text[at - 20 : at + 20]


@pytest.mark.slow
def test_every_word_that_a_reader_sees_is_covered(plant: Bench) -> None:
    text = page(plant)
    for reported, changed in {
        "PASS</span>": "FAIL</span>", "bms.bin": "bmw.bin", ">jo<": ">al<",
        "line-2, A": "line-2, B", "NO_ANSWER": "NONE", "8 s": "7 s",
        "version read back": "memory read back", "2026-05-17 09:00:18": "2026-05-18 09:00:18",
    }.items():  # fmt: skip
        assert reported in text
        found = checked(plant, text.replace(reported, changed, 1))
        assert any("its page was changed: it shows" in each for each in found.problems), reported


CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "the run": lambda c: c["content"]["run"].update(state="FAIL"),
    "the unit": lambda c: c["content"]["unit"].update(serial="W2605009"),
    "a target": lambda c: c["content"]["targets"][0].update(reached=None),
    "a step": lambda c: c["content"]["steps"][0].update(duration_s=1.0),
    "a step less": lambda c: c["content"]["steps"].clear(),
    "an image": lambda c: c["content"]["artifacts"][0].update(version="V9"),
    "the row": lambda c: c["row"].update(at="2026-05-18"),
    "the signature": lambda c: c.update(signature="x"),
    "the key": lambda c: c.update(key="00" * 32),
    "no key": lambda c: c.update(key="zz"),
    "the station": lambda c: c.update(station="line-3"),
    "which run": lambda c: c["row"].update(run_id=3),
    "the recipe": lambda c: c["recipe"].update(revision="5"),
    "an earlier run": lambda c: c["earlier"][0].update(state="PASS"),
    "no earlier run": lambda c: c.update(earlier=[]),
    "more earlier runs": lambda c: c.update(earlier_left_out=1),
    "no run": lambda c: c["content"].pop("run"),
    "a wrong kind": lambda c: c["content"].update(run=7),
    "no digests": lambda c: c["row"].update(data="{}"),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", CHANGES)
def test_carried_content_that_was_changed_is_reported(plant: Bench, what: str) -> None:
    content = carried(page(plant))
    CHANGES[what](content)
    text = carrying(page(plant), content)
    block = re.search(f"{MARKS[0]}.*?{MARKS[1]}", text, re.DOTALL)
    assert block is not None
    assert is_refused(plant, block[0])  # the lines alone, whatever the page says


@pytest.mark.slow
def test_a_certificate_signed_with_another_key_is_reported(plant: Bench, tmp_path: Path) -> None:
    key = SigningKey.make(tmp_path / "own.key")
    content = carried(page(plant))
    content["content"]["run"]["text"] = "all was well"
    row = content["row"]
    data = json.loads(row["data"])
    data["digests"]["run"] = digest(content["content"]["run"])
    row["data"] = canonical(data)
    columns = ("previous_hash", "number", "at", "event", "run_id", "data")
    row["hash"] = digest([row[name] for name in columns])
    content |= {"signature": key.sign(row["hash"]), "key": key.public}
    text = carrying(page(plant), content)
    found = checked(plant, re.search(f"{MARKS[0]}.*?{MARKS[1]}", text, re.DOTALL)[0])  # type: ignore[index]
    assert found.problems == ("the run is not in these records",)


@pytest.mark.slow
def test_a_certificate_of_other_records_is_reported(plant: Bench, bench: Bench) -> None:
    bench.make(RunState.FAIL)
    bench.make()
    found = checked(bench, page(plant))
    assert found.problems == ("the run is not in these records",)


@pytest.mark.slow
def test_records_that_were_changed_prove_nothing(bench: Bench) -> None:
    bench.make()
    text = page(bench)
    with bench.outsider() as connection:
        connection.execute("DROP TRIGGER run_update")
        connection.execute("UPDATE run SET text = 'x'")
        connection.commit()
    assert any("the run itself" in each for each in checked(bench, text).problems)


@pytest.mark.slow
def test_a_later_run_of_the_unit_is_reported(bench: Bench) -> None:
    bench.make(RunState.FAIL)
    text = page(bench)
    bench.make()
    found = checked(bench, text)
    assert found.problems == ()
    assert found.remarks == ("the unit had a later run: 2, 2026-05-17, PASS",)


def code_of(bench: Bench, run_id: int = 2) -> str:
    head = bench.store.read.head_of(RunId(run_id))
    assert head is not None
    details = bench.store.read.run(RunId(run_id))
    return "\n".join(code_lines(details, bench.store.read.record_sha256(RunId(run_id)), head))


@pytest.mark.slow
def test_the_text_of_the_qr_code_is_checked(plant: Bench) -> None:
    code = code_of(plant)
    assert checked(plant, code).problems == ()
    assert checked(plant, code + "\r\n").serial == SERIAL
    for line in code.split("\n")[1:]:
        assert is_refused(plant, code.replace(line, line[:-1] + ("0" if line[-1] != "0" else "1")))


@each("data", [b"", b"nothing", b"\xff\xfe", b"%PDF-1.4 nothing", b"<html></html>", "".join(MARKS)])
def test_what_is_no_certificate_is_refused(plant: Bench, data: bytes | str) -> None:
    with pytest.raises(FlasherError):
        check_certificate(plant.store, data if isinstance(data, bytes) else data.encode())


@pytest.mark.slow
def test_what_swells_when_it_is_unpacked_is_refused(plant: Bench) -> None:
    data = base64.b64encode(zlib.compress(b" " * 100_000_000, 9)).decode()
    with pytest.raises(UnprovenError):
        checked(plant, f"{MARKS[0]}\n{data}\n{MARKS[1]}")
