"""Signed releases on the bench page: what is offered, refused, waived and recorded."""

from __future__ import annotations

from pathlib import Path

import pytest

from flasher.errors import ErrorCode
from flasher.history import FlashHistory
from flasher.protocol.spec import BMS, WMC
from flasher.release.store import TrustStore
from flasher.translation import translator
from flasher.web.bench import BenchController
from flasher.web.bench_page import BenchPage
from flasher.web.bench_state import BenchState, Done, Offer
from flasher.web.pages import Pages
from flasher.web.virtual_bike import BikeFault
from tests.release.maker import Maker, maker, role, trusted
from tests.web.bench_place import IMAGE, BenchPlace, order

__all__ = ["maker"]  # a fixture

RELEASE = "bike.wfw"


@pytest.fixture
def place(tmp_path: Path) -> BenchPlace:
    return BenchPlace(tmp_path)


def put(maker: Maker, folder: Path, counter: int = 1, **options: object) -> None:
    """Put a release of the sample image into the folder."""
    options.setdefault("images", {BMS: folder / IMAGE})
    raw = maker.release(counter, **options)  # type: ignore[arg-type]
    (folder / RELEASE).write_bytes(raw)


def judged(place: BenchPlace, target: str = "bms") -> dict[str, Offer]:
    state = place.do(
        BenchController.start_over,
        order(BenchController.use_adapter, BikeFault.NONE.value),
        order(BenchController.choose_target, target),
    )
    return {each.name: each for each in state.offers}


def code_of(offer: Offer) -> ErrorCode | None:
    return None if offer.refusal is None else offer.refusal.code


def upgraded(place: BenchPlace, state: BenchState) -> Done:
    assert state.target is not None
    assert state.offer is not None
    done = place.do(order(BenchController.upgrade, state.selection)).done
    assert done is not None
    return done


def shown(place: BenchPlace, language: str) -> str:
    """The parts of the page."""
    page = BenchPage(Pages(), place.bench, place.shelf, is_mock=True)
    return "".join(page._parts(translator(language), place.bench.state).values())


@pytest.mark.slow
def test_a_release_is_offered_for_its_target_with_who_signed_it(
    place: BenchPlace, tmp_path: Path, maker: Maker
) -> None:
    put(maker, tmp_path, 7, signers=["anna", "bert"])
    offers = judged(place)
    assert code_of(offers[RELEASE]) is None
    assert "(anna)" in offers[RELEASE].origin
    assert offers[RELEASE].origin.endswith("keys needed: 1, trust file version 1, counter 7")
    place.do(order(BenchController.choose_image, RELEASE))
    for language, word in (("en", "signed by"), ("de", "unterschrieben von"), ("zh", "签名者")):
        assert word in shown(place, language)
    done = upgraded(place, place.bench.state)
    assert done.is_completed
    flash = FlashHistory().flashes()[0][-1]
    assert (flash.began.counter, flash.began.product, flash.began.waived) == (7, "48V", "")


def test_a_dropped_release_is_offered(place: BenchPlace, tmp_path: Path, maker: Maker) -> None:
    put(maker, tmp_path)
    raw = (tmp_path / RELEASE).read_bytes()
    (tmp_path / RELEASE).unlink()
    assert place.shelf.take(RELEASE, raw) is not None
    assert code_of(judged(place)[RELEASE]) is None


def test_a_release_beside_its_image_is_no_image_of_its_own(
    place: BenchPlace, tmp_path: Path, maker: Maker
) -> None:
    raw = maker.release(images={BMS: tmp_path / IMAGE}, is_detached=True)
    (tmp_path / f"{IMAGE}.wfw").write_bytes(raw)
    offers = judged(place)
    assert f"{IMAGE}.wfw" not in offers
    assert offers[IMAGE].origin.startswith("signed by ")


def test_a_release_for_another_target_is_refused_and_cannot_be_waived(
    place: BenchPlace, tmp_path: Path, maker: Maker
) -> None:
    put(maker, tmp_path)
    offer = judged(place, "wmc")[RELEASE]
    assert code_of(offer) is ErrorCode.NOT_FOR_DEVICE
    assert offer.refusal is not None
    assert offer.refusal.waiver == ""
    place.do(order(BenchController.waive, RELEASE, "unsigned"))
    assert place.bench.state.trouble is not None
    assert place.bench.state.waived == frozenset()


def test_a_set_gives_each_target_its_image(place: BenchPlace, tmp_path: Path, maker: Maker) -> None:
    other = tmp_path / "data" / "other.bin"
    other.parent.mkdir(exist_ok=True)
    other.write_bytes((tmp_path / IMAGE).read_bytes() + bytes(100))
    maker.next_version(release={"bms": role("anna"), "wmc": role("anna")})
    TrustStore().install(maker.chain)
    put(maker, tmp_path, images={BMS: tmp_path / IMAGE, WMC: other})
    sizes = {target: judged(place, target)[RELEASE].size_bytes for target in ("bms", "wmc")}
    assert sizes["wmc"] == sizes["bms"] + 100


@pytest.mark.parametrize("signers", [(), ("a stranger",)])
def test_a_release_that_no_trusted_key_signed_is_refused(
    place: BenchPlace, tmp_path: Path, maker: Maker, signers: tuple[str, ...]
) -> None:
    put(maker, tmp_path, signers=signers)
    assert code_of(judged(place)[RELEASE]) is ErrorCode.RELEASE_UNSIGNED


def test_a_key_that_is_revoked_while_the_page_is_open_stops_the_upgrade(
    place: BenchPlace, tmp_path: Path, maker: Maker
) -> None:
    put(maker, tmp_path)
    judged(place)
    state = place.do(order(BenchController.choose_image, RELEASE))
    maker.next_version(keys=trusted("root a", "root b", "bert"), release={"bms": role("bert")})
    TrustStore().install(maker.chain)
    assert state.target is not None
    assert state.offer is not None
    state = place.do(order(BenchController.upgrade, state.selection))
    assert state.done is None
    assert state.trouble is not None
    assert state.trouble.code is ErrorCode.RELEASE_UNSIGNED
    assert "was revoked" in state.trouble.cause


def test_a_tampered_release_is_refused_and_cannot_be_waived(
    place: BenchPlace, tmp_path: Path, maker: Maker
) -> None:
    put(maker, tmp_path)
    raw = bytearray((tmp_path / RELEASE).read_bytes())
    raw[len(raw) // 2] ^= 1
    (tmp_path / RELEASE).write_bytes(raw)
    offer = judged(place)[RELEASE]
    assert offer.refusal is not None
    assert offer.refusal.waiver == ""


def test_an_unsigned_image_is_waived_like_any_check_and_recorded(
    place: BenchPlace, maker: Maker
) -> None:
    assert maker
    offer = judged(place)[IMAGE]
    assert code_of(offer) is ErrorCode.RELEASE_UNSIGNED
    assert "[E312]" in shown(place, "en")
    state = place.do(order(BenchController.waive, IMAGE, "unsigned"))
    assert state.offer is not None
    assert state.offer.origin == "the image is not signed"
    assert state.offer.waived == ("unsigned",)
    done = upgraded(place, state)
    assert ("unsigned", "waived") in {(each.check, each.verdict) for each in done.checks}
    assert FlashHistory().flashes()[0][-1].began.waived == "unsigned"
    assert IMAGE not in {name for name, each in judged(place).items() if not each.refusal}


@pytest.mark.slow
def test_an_older_release_than_the_device_received_is_refused(
    place: BenchPlace, tmp_path: Path, maker: Maker
) -> None:
    put(maker, tmp_path, 7)
    judged(place)
    assert upgraded(place, place.do(order(BenchController.choose_image, RELEASE))).is_completed
    put(maker, tmp_path, 6)
    offer = judged(place)[RELEASE]
    assert offer.refusal is not None
    assert "this device received 7 before" in offer.refusal.what + offer.refusal.cause
    assert offer.refusal.waiver == "unsigned"
    put(maker, tmp_path, 7)
    assert code_of(judged(place)[RELEASE]) is None


def test_without_a_trust_file_nothing_is_asked_for_and_nothing_claimed(place: BenchPlace) -> None:
    offer = judged(place)[IMAGE]
    assert (offer.refusal, offer.origin) == (None, "the image is not signed")
